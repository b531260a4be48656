"""Residual Generator (RG), Eq. 6–10: the distribution of the gap z, given what was commanded."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from retwin.configs import from_config, to_config
from retwin.corrections import OPERATORS, Context, Correction, DelayOffset, Discrepancy
from retwin.errors import InputError
from retwin.mixture import BernoulliHead, Blocks, MixtureHead
from retwin.models import read_model, write_model
from retwin.networks import Standardise
from retwin.segments import Segments
from retwin.surrogate import Surrogate
from retwin.training import Fit, Loss, Training, isolated, train
from retwin.trajectories import Channels, Trajectories
from retwin.twins.protocol import HEALTHY, Progress

__all__ = ["Mixture", "ResidualModel", "fit_residual", "infer_discrepancy", "segment"]


@dataclass(frozen=True)
class Mixture:
    """How the residual model looks and learns.

    Parameters
    ----------
    components: K of Eq. 6, for each head.
    hidden: widths of the shared encoder.
    dropout: of the encoder.
    smoothness, boundedness: λ_s and λ_b of Eq. 10, on z in standard units.
    training: epochs, rate, patience.

    """

    components: int = 3
    hidden: tuple[int, ...] = (32,)
    dropout: float = 0.3
    smoothness: float = 0.01
    boundedness: float = 1.0
    training: Training = Training(  # noqa: RUF009 - frozen
        epochs=300, batch=64, rate=3e-3, decay="step", patience=40, weight_decay=1e-2
    )

    def __post_init__(self) -> None:
        if self.components < 1 or not 0 <= self.dropout < 1:
            raise InputError(
                "mixture",
                expected="at least one component and a dropout from 0 to below 1",
                got=f"{self.components} components, dropout {self.dropout}",
                remedy="see the parameters of Mixture",
            )


class ResidualModel(nn.Module):
    """Call it on a `Context`: out comes a torch `Distribution` over z (n, M, d_z).

    Holds its correction operator, so that it knows what z means.
    """

    bounds: Tensor
    shift: Tensor
    scale: Tensor
    persistence: Tensor

    def __init__(
        self,
        correction: Correction,
        mixture: Mixture,
        *,
        inputs: Channels,
        outputs: Channels,
        segmentation: str = "commands",
    ) -> None:
        super().__init__()
        self.correction = correction
        self.mixture = mixture
        self.inputs = inputs
        self.outputs = outputs
        self.segmentation = segmentation
        self.latent = correction.latent(inputs, outputs)
        if correction.resolution != "segment":
            raise InputError(
                "correction",
                expected="an operator with one z per movement",
                got=f"{type(correction).__name__}, one z per {correction.resolution}",
                remedy="use DelayOffset",
            )
        self.emulated = False
        self.timing: NDArray = np.empty((0, 0))
        self.fitted: Fit | None = None
        features = 3 * (len(inputs) + len(outputs)) + 2
        self.before = Standardise(features)
        layers: list[nn.Module] = []
        width = features
        for following in mixture.hidden:
            layers += [nn.Linear(width, following), nn.SiLU(), nn.Dropout(mixture.dropout)]
            width = following
        self.encoder = nn.Sequential(*layers)
        blocks = correction.heads(inputs, outputs)
        self.heads = nn.ModuleList(
            MixtureHead(width, block.width, mixture.components)
            if block.kind == "mixture"
            else BernoulliHead(width, block.width)
            for block in blocks
        )
        self.sizes = [block.width for block in blocks]
        for name in ("bounds", "shift", "scale"):
            self.register_buffer(name, torch.ones(len(self.latent)))
        self.register_buffer("persistence", torch.zeros(len(self.latent)))

    def context(
        self,
        surrogate: Surrogate,
        commands: NDArray,
        segments: Segments | None = None,
        *,
        told: NDArray | None = None,
        frozen: NDArray | None = None,
    ) -> Context:
        """What this model is called on, for commands (n, T, d_u), movements found by its rule."""
        if segments is None or self.segmentation == "path":
            nominal = surrogate.predict(commands) if self.segmentation == "path" else commands
            segments = segment(commands, nominal, self.segmentation)
        return Context.of(
            surrogate, commands, segments, rate=surrogate.rate, told=told, frozen=frozen
        )

    def forward(self, context: Context) -> Blocks:
        """q_ψ(z | u, ŷ), in physical units."""
        return self.distribution(describe(context))

    def distribution(self, features: Tensor) -> Blocks:
        """q_ψ for described movements (..., F), see `describe`."""
        encoded = self.encoder(self.before(features))
        parts = zip(
            self.heads, self.shift.split(self.sizes), self.scale.split(self.sizes), strict=True
        )
        return Blocks([head(encoded, shift, scale) for head, shift, scale in parts])

    @torch.no_grad()
    def sample(self, context: Context, *, generator: torch.Generator) -> Tensor:
        """Draws of z (n, M, d_z), clipped at b: regularising z̄ does not bound samples.

        Errors persist within a trajectory: the noise of its movements has a part in common, such
        that normal scores of z correlate by `persistence`. What each movement's z is distributed
        like does not change by that.
        """
        law = self(context)
        shape = law.batch_shape
        uniform = torch.rand(*shape, len(law.blocks), generator=generator)
        own = torch.randn(*shape, len(self.latent), generator=generator)
        if self.persistence.any():
            common = torch.randn(shape[0], 1, len(self.latent), generator=generator)
            own = self.persistence.sqrt() * common + (1 - self.persistence).sqrt() * own
        return law.from_noise(uniform, own).clamp(-self.bounds, self.bounds)

    def save(self, folder: str | Path) -> None:
        """Write weights and description, see `retwin.models`."""
        about = {
            "correction": to_config(self.correction, OPERATORS),
            "mixture": asdict(self.mixture),
            "inputs": vars(self.inputs),
            "outputs": vars(self.outputs),
            "segmentation": self.segmentation,
            "emulated": self.emulated,
            "timing": [[None if np.isnan(t) else t for t in row] for row in self.timing],
            "fitted": None if self.fitted is None else asdict(self.fitted),
        }
        with write_model(folder, "residual", about, self.state_dict()):
            pass

    @classmethod
    def load(cls, folder: str | Path) -> ResidualModel:
        """Read what `save` wrote; InputError when it is not a residual model or damaged."""
        about, weights = read_model(folder, "residual")
        mixture = dict(about["mixture"])
        mixture["hidden"] = tuple(mixture["hidden"])
        mixture["training"] = Training(**mixture["training"])
        model = cls(
            from_config(about["correction"], OPERATORS),
            Mixture(**mixture),
            inputs=Channels.of(about["inputs"]),
            outputs=Channels.of(about["outputs"]),
            segmentation=about["segmentation"],
        )
        model.load_state_dict(weights)
        model.emulated = about["emulated"]
        model.timing = np.array(about["timing"], dtype=float)
        model.fitted = Fit.of(about["fitted"])
        return model.eval()


def describe(context: Context) -> Tensor:
    """What the RG may know of each movement, (n, M, F).

    Commands and nominal output before, amid and after the motion; length of the motion and of the
    steady part in s. Always of the clean commands: the RG is not told of faults.
    """
    segments = context.segments
    start, settle, stop = (
        torch.as_tensor(times) for times in (segments.start, segments.settle, segments.stop)
    )
    last = segments.steps - 1
    columns = []
    for when in (start, (start + settle) / 2, settle):
        index = when.round().long().clamp(0, last)[..., None]
        for values in (context.commands, context.nominal):
            columns.append(values.gather(1, index.expand(-1, -1, values.shape[2])))
    lengths = torch.stack([settle - start, stop - settle], dim=-1) / context.rate
    return torch.cat([*columns, lengths.to(context.nominal)], dim=-1)


def segment(commands: NDArray, nominal: NDArray, rule: str = "commands") -> Segments:
    """Movements by `rule`: "commands" from command events, "path" from the nominal path's speed."""
    if rule not in ("commands", "path"):
        raise InputError(
            "segments",
            expected="'commands' or 'path'",
            got=repr(rule),
            remedy="use 'path' for a twin without command events",
        )
    return Segments.from_commands(commands) if rule == "commands" else Segments.from_path(nominal)


def infer_discrepancy(
    surrogate: Surrogate,
    trajectories: Trajectories,
    correction: Correction,
    *,
    segments: Segments | None = None,
) -> tuple[Context, Discrepancy]:
    """z* of measured trajectories: what g must add to the surrogate to explain them (for Eq. 7)."""
    if segments is None:
        segments = Segments.from_commands(trajectories.commands)
    context = Context.of(surrogate, trajectories.commands, segments, rate=trajectories.rate)
    found = correction.infer(
        context,
        torch.as_tensor(trajectories.observed.copy()),
        torch.as_tensor(trajectories.mask.copy()),
    )
    return context, found


def fit_residual(
    surrogate: Surrogate,
    calibration: Trajectories,
    correction: Correction = DelayOffset(),  # noqa: B008 - a frozen config
    mixture: Mixture = Mixture(),
    *,
    seed: int,
    calibrate_on: str = "healthy",
    bounds: NDArray | None = None,
    segments: Segments | str = "commands",
    progress: Progress | None = None,
) -> ResidualModel:
    """Fit the RG to measured trajectories, outputs only (Eq. 7–10).

    Parameters
    ----------
    surrogate: the IBG.
    calibration: real trajectories with commands; by default only the healthy ones are used, since
        the offset would absorb the fault of others. As few as six do; fewer than three leave no
        trajectory to validate on (a warning).
    correction: what z means.
    calibrate_on: "healthy" or "all".
    bounds: b of Eq. 9, (d_z,); by default 1.25 times the largest |z*|.
    segments: "commands", "path", or the movements themselves, one row per trajectory; generated
        trajectories then get theirs from command events.

    Raises
    ------
    InputError: no trajectory to calibrate on, no movement in any, an unknown `calibrate_on`.

    """
    _check_match(surrogate, calibration)
    keep = _chosen(calibration, calibrate_on)
    used = calibration[keep]
    if isinstance(segments, str):
        rule, parts = segments, segment(used.commands, used.nominal, segments)
    else:
        rule, parts = "commands", segments[keep]
    if not parts.valid.any():
        raise InputError(
            "calibration",
            expected="trajectories with movements",
            got="commands that never change",
            remedy="give segments='path', or the movements themselves",
        )
    context, found = infer_discrepancy(surrogate, used, correction, segments=parts)
    with isolated(seed):
        model = ResidualModel(
            correction, mixture, inputs=used.inputs, outputs=used.outputs, segmentation=rule
        )
    features = describe(context)
    valid = torch.as_tensor(parts.valid)
    draws = _draws(model, found, valid, seed)
    repeats = len(draws) // len(used)
    told = found.identified
    if found.posterior:
        told = valid[..., None].expand_as(found.z)
    _prepare(model, features, draws, told.repeat(repeats, 1, 1), valid, bounds, seed)
    train_rows, valid_rows = _validation_split(used, seed)
    data = (
        features.repeat(repeats, 1, 1),
        draws.float(),
        _known(model, told).repeat(repeats, 1, 1),
        valid.repeat(repeats, 1),
    )
    # Every draw of a trajectory is a row; those of one trajectory are all on the same side.
    train_rows = _repeated(train_rows, repeats, len(used))
    if valid_rows is not None:
        valid_rows = _repeated(valid_rows, repeats, len(used))
    result = train(
        model,
        _objective(mixture),
        tuple(each[train_rows] for each in data),
        None if valid_rows is None else tuple(each[valid_rows] for each in data),
        mixture.training,
        seed=seed,
        progress=progress,
    )
    if found.posterior:
        model.persistence.copy_(_persistence(model.eval(), features, draws, valid))
    model.emulated = used.emulated
    onsets = Segments.from_commands(calibration.commands)
    model.timing = np.where(onsets.valid, onsets.start, np.nan)
    model.fitted = replace(
        result, figures={"trajectories": float(len(used)), "movements": float(valid.sum())}
    )
    return model.eval()


def _check_match(surrogate: Surrogate, calibration: Trajectories) -> None:
    """Calibration data must speak of the same channels at the same rate as the surrogate."""
    for name in ("inputs", "outputs", "rate"):
        ours, theirs = getattr(surrogate, name), getattr(calibration, name)
        if ours != theirs:
            raise InputError(
                f"calibration.{name}",
                expected=f"what the surrogate was trained on, {ours}",
                got=f"{theirs}",
                remedy="load the file with its case, or convert it",
            )


def _chosen(calibration: Trajectories, calibrate_on: str) -> NDArray:
    if calibrate_on not in ("healthy", "all"):
        raise InputError(
            "calibrate_on",
            expected="'healthy' or 'all'",
            got=repr(calibrate_on),
            remedy="'all' lets the offset absorb faults; use it for comparison only",
        )
    everything = np.ones(len(calibration), dtype=bool)
    keep = calibration.labels == HEALTHY if calibrate_on == "healthy" else everything
    if not keep.any():
        raise InputError(
            "calibration",
            expected=f"at least one trajectory labelled {HEALTHY!r}",
            got=f"labels {sorted(calibration.known_labels) or 'none'}",
            remedy="label healthy trajectories, or calibrate on 'all'",
        )
    if keep.sum() < 3:
        warnings.warn(
            f"calibration: {keep.sum()} trajectories to calibrate on, at least three are needed to "
            "hold one out; training runs to its last epoch without validation",
            stacklevel=3,
        )
    return np.flatnonzero(keep)


def _known(model: ResidualModel, told: Tensor) -> Tensor:
    """(n, M, heads): whether the outputs tell that block of z, by `told` (n, M, d_z)."""
    parts = told.split(model.sizes, dim=-1)
    return torch.stack([part.all(dim=-1) for part in parts], dim=-1)


DRAWS = 20
"""Draws of z per trajectory from its posterior: together they tell what the outputs do not."""


def _draws(model: ResidualModel, found: Discrepancy, valid: Tensor, seed: int) -> Tensor:
    """What to learn z from, (R n, M, d_z): z* itself, or draws from its posterior."""
    if not found.posterior:
        return found.z
    generator = torch.Generator().manual_seed(seed)
    values, vectors = torch.linalg.eigh(found.covariance)
    root = vectors * values.clamp_min(0).sqrt()[..., None, :]
    noise = torch.randn(DRAWS, *found.z.shape, generator=generator, dtype=found.z.dtype)
    drawn = found.z + torch.einsum("nmij,rnmj->rnmi", root, noise)
    # What is decided, one way or the other, has no width to draw from.
    begin = 0
    for head, size in zip(model.heads, model.sizes, strict=True):
        part = slice(begin, begin + size)
        begin += size
        if isinstance(head, BernoulliHead):
            drawn[..., part] = found.z[..., part]
    return (drawn * valid[..., None]).flatten(0, 1)


def _repeated(rows: Tensor, repeats: int, count: int) -> Tensor:
    """The rows of all draws of those trajectories."""
    return (rows + count * torch.arange(repeats)[:, None]).flatten()


@torch.no_grad()
def _persistence(model: ResidualModel, features: Tensor, draws: Tensor, valid: Tensor) -> Tensor:
    """How alike the movements of a trajectory err: the intraclass correlation of normal scores.

    One-way analysis of variance, averaged over draws; shrunk where trajectories are few.
    """
    law = model.distribution(features)
    scores = []
    for z in draws.float().split(len(features)):
        share = law.marginal_cdf(z).clamp(1e-4, 1 - 1e-4)
        scores.append(torch.where(valid[..., None], torch.special.ndtri(share), torch.nan))
    score = torch.stack(scores).mean(dim=0)
    count = valid.sum(dim=1).clamp_min(1)[:, None]
    own = score.nanmean(dim=1)
    enough = valid.sum(dim=1) > 1
    if enough.sum() < 3:
        return torch.zeros(len(model.latent))
    within = torch.nansum((score - own[:, None]).square(), dim=1)[enough].sum(0)
    within = within / (count[enough] - 1).sum().clamp_min(1)
    between = (count[enough] * (own[enough] - own[enough].mean(dim=0)).square()).sum(0)
    between = between / (enough.sum() - 1)
    size = count[enough].double().mean().float()
    alike = (between - within) / (between + (size - 1) * within).clamp_min(1e-9)
    return (alike * (len(own) - 1) / (len(own) + 3)).nan_to_num(0.0).clamp(0.0, 0.9)


@torch.no_grad()
def _prepare(
    model: ResidualModel,
    features: Tensor,
    z: Tensor,
    told: Tensor,
    valid: Tensor,
    bounds: NDArray | None,
    seed: int,
) -> None:
    """Standardise, bound and start the model from the data it is trained on."""
    model.before.fit(features[valid])
    valid = valid.repeat(len(z) // len(valid), 1)
    begin = 0
    for head, size in zip(model.heads, model.sizes, strict=True):
        part = slice(begin, begin + size)
        begin += size
        if isinstance(head, BernoulliHead):
            model.shift[part], model.scale[part], model.bounds[part] = 0.0, 1.0, 1.0
            head.initialise(z[..., part][valid].double().numpy(), seed)
            continue
        known = told[..., part].all(dim=-1) & valid
        values = z[..., part][known if known.any() else valid].float()
        # Robust: a few missed movements must not set the unit in which the others are told.
        shift = values.median(dim=0).values
        scale = 1.4826 * (values - shift).abs().median(dim=0).values
        spread = values.std(dim=0, correction=0)
        scale = torch.maximum(scale, 0.1 * spread).clamp_min(1e-9)
        model.shift[part], model.scale[part] = shift, scale
        model.bounds[part] = 1.25 * values.abs().amax(dim=0).clamp_min(1e-9)
        cast(MixtureHead, head).initialise(((values - shift) / scale).double().numpy(), seed)
    if bounds is not None:
        if np.shape(bounds) != (len(model.latent),) or not (np.asarray(bounds) > 0).all():
            raise InputError(
                "bounds",
                expected=f"one positive bound for each of {', '.join(model.latent.names)}",
                got=repr(bounds),
                remedy="leave bounds out to take them from the data",
            )
        model.bounds.copy_(torch.as_tensor(bounds, dtype=torch.float32))


def _validation_split(used: Trajectories, seed: int) -> tuple[Tensor, Tensor | None]:
    """Rows to train on, and about a fifth of the trajectories (one at least) to validate on."""
    if len(used) < 3:
        return torch.arange(len(used)), None
    order = torch.as_tensor(np.random.default_rng(seed).permutation(len(used)))
    held = max(1, round(0.2 * len(used)))
    return order[held:], order[:held]


def _objective(mixture: Mixture) -> Loss:
    """L_RG of Eq. 10, averaged over movements."""

    def loss(model: Any, batch: tuple[Tensor, ...]) -> Tensor:
        features, z, known, valid = batch
        law = model.distribution(features)
        # Unknown blocks are left out of the likelihood; a placeholder keeps them finite.
        told = law.block_log_prob(z)
        nll = -torch.where(known, told, 0.0).sum() / known.sum().clamp_min(1) * known.shape[-1]
        mean = law.mean
        step = (mean[:, 1:] - mean[:, :-1]) / model.scale
        both = valid[:, 1:] & valid[:, :-1]
        rough = (step.square().sum(-1) * both).sum() / both.sum().clamp_min(1)
        beyond = torch.relu(mean.abs() - model.bounds) / model.scale
        outside = (beyond.square().sum(-1) * valid).sum() / valid.sum().clamp_min(1)
        return nll + mixture.smoothness * rough + mixture.boundedness * outside

    return loss
