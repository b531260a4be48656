"""`InversionDiagnoser`: which fault explains the outputs, by physics and evidence alone.

No training. Every class is a hypothesis about what the actuators were effectively told, under the
discrepancy that the residual model has learned from healthy trajectories. The marginal likelihood
of the measured outputs under each gives the probabilities of the classes, and the commands that
explain them best give the severity of the fault.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.diagnosis.evidence import Noise, best_pattern
from retwin.diagnosis.hypotheses import (
    COVER,
    Hypotheses,
    Inversion,
    checked,
    command_space,
    healthy_belief,
    posed,
)
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, write_model
from retwin.twins.faults import ActuatorBias, Fault, Stuck
from retwin.update.corrections import Context, sample_mask
from retwin.update.residual import Residual, ResidualModel
from retwin.update.surrogate import Surrogate

__all__ = ["Diagnosis", "Estimate", "InversionDiagnoser", "fit_inversion"]

CHUNK = 16
"""Trajectories inverted together."""
ROUNDS = 5
"""Of expectation and maximisation of the noise."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A severity and its central 90 % interval; NaN where a class has none."""

    value: NDArray
    low: NDArray
    high: NDArray


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What an inversion says of n trajectories; severities as if each class were the true one.

    Attributes
    ----------
    classes: names, C.
    probabilities: (n, C).
    evidence: (n, C), log marginal likelihood of the outputs, up to a constant of each trajectory.
    level: (n, C), where a stuck actuator stands, in its command's unit.
    onset: (n, C), the sample from which on it does.
    bias: (n, C, M), error of a biased actuator in each movement, in its command's unit.

    """

    classes: tuple[str, ...]
    probabilities: NDArray
    evidence: NDArray
    level: Estimate
    onset: Estimate
    bias: Estimate


class InversionDiagnoser:
    """Tells classes of faults apart by the evidence for each; see `fit_inversion`.

    Parameters
    ----------
    surrogate: the IBG.
    residual: an RG with `CommandSpace`, fitted on healthy trajectories.
    faults: class name to fault, None for healthy, in the order of the probabilities. What a fault
        leaves open is inferred: an onset between its limits, the bias of every movement.
    noise: what a healthy reading leaves unexplained.

    Raises
    ------
    InputError: fewer than two classes, a fault that cannot be inverted, a residual model of
        something else than commands.

    """

    def __init__(
        self,
        surrogate: Surrogate,
        residual: ResidualModel,
        faults: Mapping[str, Fault | None],
        *,
        noise: Noise,
    ) -> None:
        self.surrogate = surrogate
        self.residual = residual
        self.faults = checked(faults)
        self.noise = noise
        command_space(residual.correction)

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names, in the order of the probabilities."""
        return tuple(self.faults)

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes), see `Diagnoser`."""
        return self.diagnose(trajectories).probabilities

    @torch.no_grad()
    def diagnose(
        self, trajectories: Trajectories, *, progress: Progress | None = None
    ) -> Diagnosis:
        """Probabilities and severities of every class; all classes are alike beforehand.

        Raises
        ------
        InputError: other channels or another sample rate than the surrogate's.

        """
        given = _Readings.of(self.surrogate, self.residual, trajectories)
        faults = tuple(self.faults.values())
        parts = []
        for begin in range(0, len(trajectories), CHUNK):
            part = given[begin : begin + CHUNK]
            rows = Hypotheses.of(faults, self.residual, *part)
            parts.append(_severities(rows, rows.inverted(self.noise), len(faults)))
            if progress is not None:
                progress(min(1.0, (begin + CHUNK) / len(trajectories)))
        evidence, level, onset, bias = (np.concatenate(each) for each in zip(*parts, strict=True))
        chance = np.exp(evidence - evidence.max(axis=1, keepdims=True))
        return Diagnosis(
            self.classes,
            chance / chance.sum(axis=1, keepdims=True),
            evidence,
            *(Estimate(*np.moveaxis(each, -1, 0)) for each in (level, onset, bias)),
        )

    def save(self, folder: str | Path) -> None:
        """Write one folder with `surrogate` and `residual` inside, or nothing."""
        faults = [
            [name, None if fault is None else to_config(fault, FAULTS)]
            for name, fault in self.faults.items()
        ]
        about = {"faults": faults}
        with write_model(folder, "inversion", about, vars(self.noise)) as inside:
            self.surrogate.save(inside / "surrogate")
            self.residual.save(inside / "residual")

    @classmethod
    def load(cls, folder: str | Path) -> InversionDiagnoser:
        """Read what `save` wrote; InputError when it is not an inversion or damaged."""
        about, weights = read_model(folder, "inversion")
        folder = Path(folder)
        faults = {
            name: None if config is None else from_config(config, FAULTS)
            for name, config in about["faults"]
        }
        return cls(
            Surrogate.load(folder / "surrogate"),
            ResidualModel.load(folder / "residual"),
            faults,
            noise=Noise(**weights),
        )


FAULTS: tuple[type, ...] = (Stuck, ActuatorBias)
"""Those that can be inverted, and that a model folder may name."""


@torch.no_grad()
def fit_inversion(
    surrogate: Surrogate,
    residual: Residual,
    calibration: Trajectories,
    faults: Mapping[str, Fault | None],
) -> InversionDiagnoser:
    """A diagnoser by physics: only its noise is learned, from healthy trajectories.

    Parameters
    ----------
    surrogate, residual: of the updated twin; the residual model with `CommandSpace`.
    calibration: those the residual model was fitted to; healthy ones are used, others left out.
    faults: class name to fault, as a case has them.

    Raises
    ------
    InputError: no healthy trajectory, and whatever `InversionDiagnoser` refuses.

    """
    if not isinstance(residual, ResidualModel):
        raise InputError(
            "residual",
            expected="a residual model with one z per movement",
            got=type(residual).__name__,
            remedy="fit it with CommandSpace",
        )
    healthy = calibration.with_label(HEALTHY)
    if not len(healthy):
        raise InputError(
            "calibration",
            expected=f"at least one trajectory labelled {HEALTHY!r}",
            got=f"labels {sorted(calibration.known_labels) or 'none'}",
            remedy="label healthy trajectories",
        )
    context, observed, mask = _Readings.of(surrogate, residual, healthy)[:]
    problem = posed(residual, context, observed, mask)
    belief = healthy_belief(residual, context)
    x = belief.mean.unflatten(1, (context.segments.max_count, -1))
    noise = Noise.first(problem.residual(x, torch.zeros_like(x[..., 1:])), problem)
    each = torch.arange(len(healthy))
    for _ in range(ROUNDS):
        fit, _ = best_pattern(problem, x, belief, noise, each)
        x, noise = fit.x, noise.learned(problem, fit)
    return InversionDiagnoser(surrogate, residual, faults, noise=noise)


class _Precise:
    """A surrogate in double precision: what it says does not depend on the batch it is asked in."""

    def __init__(self, surrogate: Surrogate) -> None:
        self.memoryless = surrogate.memoryless
        self.predict = surrogate.predict
        self.model = copy.deepcopy(surrogate).double()

    def __call__(self, commands: Tensor) -> Tensor:
        return self.model(commands.double()).to(commands.dtype)


@dataclass(frozen=True, eq=False)
class _Readings:
    """What a diagnoser looks at: commands and their context, outputs at the true readings."""

    context: Context
    observed: Tensor
    mask: Tensor

    @classmethod
    def of(
        cls, surrogate: Surrogate, residual: ResidualModel, trajectories: Trajectories
    ) -> _Readings:
        """Those of `trajectories`, which must have the channels and the rate of the surrogate."""
        for name in ("inputs", "outputs", "rate"):
            ours, theirs = getattr(surrogate, name), getattr(trajectories, name)
            if ours != theirs:
                raise InputError(
                    f"trajectories.{name}",
                    expected=f"what the surrogate was trained on, {ours}",
                    got=f"{theirs}",
                    remedy="resample or rename, or load the file with its case",
                )
        context = residual.context(surrogate, np.ascontiguousarray(trajectories.commands))
        observed = torch.as_tensor(trajectories.observed.astype(np.float64))
        mask = torch.as_tensor(trajectories.mask.copy())
        correction = residual.correction
        # One by one: when a sensor was read must not be told by the trajectories beside.
        read = torch.cat(
            [
                sample_mask(correction, observed[i : i + 1], mask[i : i + 1])
                for i in range(len(mask))
            ]
        )
        # Where there are many, every so many of them tell enough.
        order = read.all(dim=-1).cumsum(dim=1)
        every = -(-order[:, -1:] // command_space(correction).most)
        read &= ((order - 1) % every.clamp_min(1) == 0)[..., None]
        return cls(replace(context, surrogate=_Precise(surrogate)), observed, read)

    def __getitem__(self, rows: slice) -> tuple[Context, Tensor, Tensor]:
        return self.context[rows], self.observed[rows], self.mask[rows]


def _severities(rows: Hypotheses, found: Inversion, classes: int) -> tuple[NDArray, ...]:
    """Evidence (n, C), and value, low and high of level, onset (n, C, 3) and bias (n, C, M, 3)."""
    reach = NormalDist().inv_cdf(0.5 + COVER / 2) * found.doubt
    level = torch.stack([found.level, found.level - reach, found.level + reach], dim=1)
    samples, chance = found.onsets.samples, found.onsets.chance
    below, last = chance.cumsum(dim=1), samples.shape[1] - 1
    ends = [
        samples.gather(1, (below < share).sum(dim=1, keepdim=True).clamp_max(last))
        for share in ((1 - COVER) / 2, (1 + COVER) / 2)
    ]
    onset = torch.cat([(chance * samples).sum(dim=1, keepdim=True), *ends], dim=1)
    # An actuator lags its command by up to the delay, and only the level tells when it stopped.
    lag = found.fit.x[..., 0].abs().mean(dim=1, keepdim=True)
    onset = onset + lag * torch.tensor([0.0, -1.0, 1.0])
    loose = ~rows.stuck[:, None]
    level, onset = (each.masked_fill(loose, torch.nan) for each in (level, onset))
    told = (found.evidence, level, onset, found.bias)
    return tuple(each.unflatten(0, (-1, classes)).numpy() for each in told)
