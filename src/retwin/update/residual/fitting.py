"""`fit_residual`: z* from outputs alone, then the law of z (Eq. 7–10)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.segments import Segments
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.errors import InputError
from retwin.nets.mixtures import BernoulliHead
from retwin.nets.training import Loss, isolated, train
from retwin.progress import Progress
from retwin.twins.faults import Fault, draw_faults, faulty_commands, frozen_from
from retwin.update.corrections import (
    Context,
    Correction,
    DelayOffset,
    Discrepancy,
    fit_sensor,
    sample_mask,
)
from retwin.update.residual.model import ResidualModel, segment
from retwin.update.residual.penalties import penalties
from retwin.update.residual.refining import refine
from retwin.update.residual.sequence import SequenceMixture, SequenceResidual
from retwin.update.residual.sequence_fitting import fit_sequence
from retwin.update.residual.settings import Density, Mixture
from retwin.update.residual.targets import Targets
from retwin.update.surrogate import Surrogate

__all__ = ["fit_residual", "infer_discrepancy"]

LEAST = 1e-12
"""The largest |z| of a gap that is none: what is a millionth of it has squares in float32 still."""


def infer_discrepancy(
    surrogate: Surrogate,
    trajectories: Trajectories,
    correction: Correction,
    *,
    segments: Segments | None = None,
    faults: Sequence[Fault | None] | None = None,
) -> tuple[Context, Discrepancy]:
    """z* of measured trajectories: what g must add to the surrogate to explain them (for Eq. 7).

    `faults`, one per trajectory or none, are what is known to be broken: how much is inferred
    beside z* by operators that can (`Discrepancy.severity`).
    """
    context = _context(surrogate, trajectories, segments, faults)
    return context, correction.infer(context, *_measured(trajectories))


@overload
def fit_residual(
    surrogate: Surrogate,
    calibration: Trajectories,
    correction: Correction = ...,
    density: Density = ...,
    *,
    seed: int,
    calibrate_on: str | Mapping[str, Fault | None] = ...,
    bounds: NDArray | None = ...,
    segments: Segments | str = ...,
    progress: Progress | None = ...,
) -> ResidualModel: ...


@overload
def fit_residual(
    surrogate: Surrogate,
    calibration: Trajectories,
    correction: Correction,
    density: SequenceMixture,
    *,
    seed: int,
    calibrate_on: str | Mapping[str, Fault | None] = ...,
    bounds: NDArray | None = ...,
    segments: Segments | str = ...,
    progress: Progress | None = ...,
) -> SequenceResidual: ...


def fit_residual(
    surrogate: Surrogate,
    calibration: Trajectories,
    correction: Correction = DelayOffset(),  # noqa: B008 - a frozen config
    density: Density | SequenceMixture = Mixture(),  # noqa: B008 - a frozen config
    *,
    seed: int,
    calibrate_on: str | Mapping[str, Fault | None] = "healthy",
    bounds: NDArray | None = None,
    segments: Segments | str = "commands",
    progress: Progress | None = None,
) -> ResidualModel | SequenceResidual:
    """Fit the RG to measured trajectories, outputs only (Eq. 7–10).

    Parameters
    ----------
    surrogate: the IBG.
    calibration: real trajectories with commands. As few as six do; fewer than three leave none to
        validate on (a warning).
    correction: what z means; a sensor in it is fitted too.
    density: what the law of z may look like; a `SequenceMixture` for an operator with one z per
        sample, which learns from one record too.
    calibrate_on: "healthy" by default: the offset would absorb the faults of others. "all", as if
        there were no faults. Or what fault each label stands for, `case.faults`: then all
        trajectories serve, and an operator that can (`severities`) tells fault and gap apart.
    bounds: b of Eq. 9, (d_z,); by default 1.25 times the largest |z*|.
    segments: "commands", "path", or the movements themselves, one row per trajectory; generated
        trajectories then get theirs from command events.

    Raises
    ------
    InputError: no trajectory to calibrate on, no movement in any, nothing measured that tells of
        the gap, an unknown `calibrate_on`.

    """
    _check_match(surrogate, calibration)
    stepwise = correction.resolution == "step" or isinstance(density, SequenceMixture)
    keep, faults = _chosen(
        calibration, calibrate_on, getattr(correction, "severities", False), 1 if stepwise else 3
    )
    used = calibration[keep]
    if isinstance(segments, str):
        rule, parts = segments, segment(used.commands, used.nominal, segments)
    else:
        rule, parts = "commands", segments[keep]
    if not (stepwise or parts.valid.any()):
        raise InputError(
            "calibration",
            expected="trajectories with movements",
            got="commands that never change",
            remedy="give segments='path', or the movements themselves",
        )
    context = _context(surrogate, used, parts, faults)
    correction, found = fit_sensor(correction, context, *_measured(used))
    if not found.identified.any():
        raise InputError(
            "calibration",
            expected="measurements that tell something of the gap",
            got=f"{int(used.mask.all(axis=2).sum())} samples with all outputs measured",
            remedy="check the mask; leave an output out that is never measured",
        )
    if isinstance(density, SequenceMixture):
        return fit_sequence(
            used, correction, density, context, found, seed=seed, bounds=bounds, progress=progress
        )
    with isolated(seed):
        model = ResidualModel(
            correction, density, inputs=used.inputs, outputs=used.outputs, segmentation=rule
        )
    targets = Targets.of(model, context, found, seed=seed)
    _prepare(model, targets, bounds, seed)
    fitted, held = _validation_split(used, seed)
    result = train(
        model,
        _objective(density),
        targets.examples(model, fitted),
        None if held is None else targets.examples(model, held),
        density.training,
        seed=seed,
        progress=progress,
    )
    if targets.posterior:
        model.persistence.copy_(targets.persistence(model))
    figures = {"trajectories": float(len(used)), "movements": float(parts.valid.sum())}
    if density.refinement is not None and held is not None:
        observed, mask = _measured(used)
        read = sample_mask(correction, observed, mask)
        figures |= refine(
            model, context, observed, read, fitted=fitted, held_out=held,
            how=density.refinement, seed=seed, progress=progress,
        )  # fmt: skip
    model.emulated = used.emulated
    onsets = Segments.from_commands(calibration.commands)
    model.timing = np.where(onsets.valid, onsets.start, np.nan)
    model.fitted = replace(result, figures=figures)
    return model.eval()


def _context(
    surrogate: Surrogate,
    trajectories: Trajectories,
    segments: Segments | None,
    faults: Sequence[Fault | None] | None,
) -> Context:
    """What is corrected; of a known fault any severity, since that is inferred."""
    commands = trajectories.commands
    parts = Segments.from_commands(commands) if segments is None else segments
    # What follows the last sample is padding, and no rest that was measured.
    parts = parts.until(trajectories.lengths)
    if faults is None:
        return Context.of(surrogate, commands, parts, rate=trajectories.rate)
    drawn = draw_faults(faults, parts, seed=0)
    return Context.of(
        surrogate,
        commands,
        parts,
        rate=trajectories.rate,
        faulty_commands=faulty_commands(commands, drawn, parts),
        frozen=frozen_from(drawn, *commands.shape[1:]),
    )


def _measured(trajectories: Trajectories) -> tuple[Tensor, Tensor]:
    """Outputs and where they were measured, (n, T, d_y) each."""
    return torch.tensor(trajectories.observed), torch.tensor(trajectories.mask)


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


def _chosen(
    calibration: Trajectories,
    calibrate_on: str | Mapping[str, Fault | None],
    severities: bool,
    enough: int,
) -> tuple[NDArray, list[Fault | None] | None]:
    """Which trajectories serve, and the faults in them, where they are known and can be told."""
    labels = calibration.labels
    faults = None
    if isinstance(calibrate_on, Mapping):
        keep = np.isin(labels, list(calibrate_on))
        faults = [calibrate_on[str(label)] for label in labels[keep]] if severities else None
    elif calibrate_on in ("healthy", "all"):
        keep = (labels == HEALTHY) | (calibrate_on == "all")
    else:
        raise InputError(
            "calibrate_on",
            expected="'healthy', 'all', or what fault each label stands for",
            got=repr(calibrate_on),
            remedy="'all' lets the offset absorb faults; use it for comparison only",
        )
    if not keep.any():
        wanted = repr(HEALTHY) if isinstance(calibrate_on, str) else ", ".join(calibrate_on)
        raise InputError(
            "calibration",
            expected=f"at least one trajectory labelled {wanted}",
            got=f"labels {sorted(calibration.known_labels) or 'none'}",
            remedy="label healthy trajectories, or calibrate on 'all'",
        )
    if keep.sum() < enough:
        warnings.warn(
            f"calibration: {keep.sum()} trajectories to calibrate on, at least three are needed to "
            "hold one out; training runs to its last epoch without validation",
            stacklevel=3,
        )
    return np.flatnonzero(keep), faults


@torch.no_grad()
def _prepare(model: ResidualModel, targets: Targets, bounds: NDArray | None, seed: int) -> None:
    """Standardise, bound and start the model from the data it is trained on."""
    valid, z = targets.valid, targets.z
    model.before.fit(targets.features[valid])
    for head, part in model.parts():
        if isinstance(head, BernoulliHead):
            model.shift[part], model.scale[part], model.bounds[part] = 0.0, 1.0, 1.0
            head.initialise(z[:, valid][..., part].flatten(0, 1).double().numpy(), seed)
            continue
        known = targets.told[..., part].all(dim=-1) & valid
        values = z[:, known if known.any() else valid][..., part].flatten(0, 1)
        # Robust: a few missed movements must not set the unit in which the others are told.
        shift = values.median(dim=0).values
        scale = 1.4826 * (values - shift).abs().median(dim=0).values
        spread = values.std(dim=0, correction=0)
        largest = values.abs().amax(dim=0).clamp_min(LEAST)
        scale = torch.maximum(scale, 0.1 * spread).maximum(1e-6 * largest)
        model.shift[part], model.scale[part] = shift, scale
        model.bounds[part] = 1.25 * largest
        head.initialise(((values - shift) / scale).double().numpy(), seed)
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


def _objective(density: Density) -> Loss:
    """L_RG of Eq. 10, averaged over movements."""

    def loss(model: Any, batch: tuple[Tensor, ...]) -> Tensor:
        features, z, known, valid = batch
        law = model.distribution(features)
        # Unknown blocks are left out of the likelihood; a placeholder keeps them finite.
        told = law.block_log_prob(z)
        nll = -torch.where(known, told, 0.0).sum() / known.sum().clamp_min(1) * known.shape[-1]
        return nll + penalties(
            law.mean, model.bounds, model.scale, valid, density.smoothness, density.boundedness
        )

    return loss
