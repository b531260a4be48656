"""`InversionDiagnoser`: which fault explains the outputs, by physics and evidence alone.

No training. Every class is a hypothesis about the effective commands of the actuators, under the
discrepancy that the residual model has learned from healthy trajectories. The marginal likelihood
of the measured outputs under each gives the probabilities of the classes, and the commands that
explain them best give the severity of the fault.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit, logsumexp
from torch import Tensor

from retwin.checks import one_of, require
from retwin.data.measured import unmeasured_outputs
from retwin.data.trajectories import UNKNOWN, Trajectories
from retwin.diagnosis.estimate import Calibration, Estimate
from retwin.diagnosis.inversion.hypotheses import Hypotheses, StuckPair, checked, stuck_pairs
from retwin.diagnosis.inversion.latent_prior import command_space
from retwin.diagnosis.inversion.missed_segments import best_fit
from retwin.diagnosis.inversion.onsets import Onsets
from retwin.diagnosis.inversion.samples import DiagnosisInputs
from retwin.diagnosis.inversion.severity import biases, central_interval, stuck_level
from retwin.inference.noise import Noise
from retwin.progress import Progress, tracked
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, write_model
from retwin.twins.faults.actuator_faults import ActuatorBias, Fault, Stuck
from retwin.twins.twin import Twin
from retwin.update.corrections.commands.missed_segments import CommandFit
from retwin.update.exact import exact_surrogate, load_surrogate
from retwin.update.residual import ResidualModel
from retwin.update.surrogate import Surrogate
from retwin.update.training_range import outside_training
from retwin.workers.threads import one_thread

TRAJECTORIES_PER_BATCH = 16
"""Trajectories inverted together, which bounds memory."""
UNEXPLAINED = "no class explains the outputs nearly as well as in calibration"
"""The reason for which a trajectory is unknown although it was measured."""
COVERAGE = 0.9
"""Coverage of all intervals."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The diagnosis of n trajectories; severities as if each class were the true one.

    Attributes
    ----------
    classes : tuple of str
        Names, C.
    probabilities : NDArray
        (n, C), each row sums to one.
    evidence : NDArray
        (n, C), log marginal likelihood of the outputs, up to a constant of each trajectory.
    explained : NDArray
        (n, C), the evidence without what it has lost to the open onset and bias of a fault: on
        average the log likelihood with their true values. It states how well a class explains the
        outputs, whatever its freedom, and is compared with `InversionDiagnoser.bound`.
    level : Estimate
        (n, C), where a stuck actuator stands, in its command's unit.
    onset : Estimate
        (n, C), the time in s from which it is stuck.
    bias : Estimate
        (n, C, M), error of a biased actuator in each segment, in its command's unit.
    outside : NDArray
        (n,) bool, whether the commands are outside the training range of the surrogate.
    unknown : NDArray
        (n,), the probability that none of the classes is the true one.
    offset : NDArray
        (n, M, d_u), the most probable offset of each actuator in each segment, from the mean of its
        prior and in its command's unit, if the machine is healthy (if several classes are, as the
        first of them); NaN where there is no such segment, or none was executed.
    reason : NDArray
        (n,), why a trajectory is unknown; "" where it is not.
    several : NDArray
        (n,), the probability that two actuators are stuck, and not one of the classes true; 0 where
        `max_faults` was 1.

    """

    classes: tuple[str, ...]
    probabilities: NDArray
    evidence: NDArray
    explained: NDArray
    level: Estimate
    onset: Estimate
    bias: Estimate
    outside: NDArray
    unknown: NDArray
    offset: NDArray
    reason: NDArray
    several: NDArray

    @property
    def labels(self) -> NDArray:
        """The most probable class of each trajectory (n,), or "unknown"."""
        names = np.array(self.classes)[self.probabilities.argmax(axis=1)]
        return np.where(self.reason != "", UNKNOWN, names)


@dataclass(frozen=True, eq=False)
class Inversion:
    """What was inferred of R hypotheses.

    Attributes
    ----------
    evidence : Tensor
        (R,), log marginal likelihood, up to a constant of each trajectory.
    information : Tensor
        (R,), in nats, what the outputs have added to the prior of the fault's onset and bias.
    level, level_deviation : Tensor
        (R,), where the faulty actuator is in the end, in its command's unit.
    onsets : Onsets
        Of a stuck actuator.
    bias : Tensor
        (R, M, 3), mean and interval of the bias in every segment; NaN where there is none.
    fit : CommandFit
        The most probable z.

    """

    evidence: Tensor
    information: Tensor
    level: Tensor
    level_deviation: Tensor
    onsets: Onsets
    bias: Tensor
    fit: CommandFit


def invert(rows: Hypotheses, noise: Noise) -> Inversion:
    """The evidence for every hypothesis, and the severity of its fault."""
    onsets = Onsets.of(rows, noise)
    held = rows.held(onsets.best)
    trajectory = torch.arange(len(held.actuator)) // held.classes
    found = best_fit(held.problem, held.prior, noise, held.start, trajectory)
    fit = found.fit
    # What is beyond the limits of a bias counted in the search; `biases` integrates over them.
    evidence = found.evidence + held.prior.excess(fit.x).sum(dim=1)
    bias, gain, of_bias = biases(held, fit, COVERAGE)
    level, deviation = stuck_level(held, fit, onsets.best, noise)
    information = onsets.information + of_bias
    evidence = evidence + onsets.gain + gain
    return Inversion(evidence, information, level, deviation, onsets, bias, fit)


class InversionDiagnoser:
    """Class probabilities from the evidence for each fault; see `fit_inversion`.

    Parameters
    ----------
    surrogate : Surrogate or Twin
        The IBG, or a twin in its place.
    residual : ResidualModel
        With `CommandSpace`, fitted on healthy trajectories.
    faults : mapping of str to Fault or None
        Class name to fault, None for healthy, in the order of the probabilities. What a fault
        leaves open is inferred: an onset between its limits, the bias of every segment.
    noise : Noise
        What a healthy sample leaves unexplained, in the outputs' units.
    surrogate_variance : Tensor, optional
        (d_y,), mean square of the surrogate's own error, in the outputs' units squared; by default
        it has none.
    bound : float, optional
        Evidence per measured sample below which a trajectory is unknown (see `lower_bound`); by
        default none is.
    calibration : Calibration, optional
        What that bound rests on.

    Raises
    ------
    InputError
        There are fewer than two classes, a fault cannot be inverted, or the residual model has
        another correction.

    """

    def __init__(
        self,
        surrogate: Surrogate | Twin,
        residual: ResidualModel,
        faults: Mapping[str, Fault | None],
        *,
        noise: Noise,
        surrogate_variance: Tensor | None = None,
        bound: float = -np.inf,
        calibration: Calibration = Calibration(),  # noqa: B008 - frozen
    ) -> None:
        self.surrogate = exact_surrogate(surrogate)
        self.residual = residual
        self.faults = checked(faults)
        self.noise = noise
        none = torch.zeros(len(residual.outputs), dtype=torch.float64)
        self.surrogate_variance = none if surrogate_variance is None else surrogate_variance
        self.bound = bound
        self.calibration = calibration
        command_space(residual.correction)

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names, in the order of the probabilities."""
        return tuple(self.faults)

    def with_faults(self, more: Mapping[str, Fault | None]) -> InversionDiagnoser:
        """The same with further classes."""
        made = copy.copy(self)
        made.faults = checked({**self.faults, **more})
        return made

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes), see `Diagnoser`."""
        return self.diagnose(trajectories).probabilities

    @torch.no_grad()
    @one_thread()
    def diagnose(
        self, trajectories: Trajectories, *, max_faults: int = 1, progress: Progress | None = None
    ) -> Diagnosis:
        """Probabilities and severities of every class; all classes are equally probable beforehand.

        Parameters
        ----------
        trajectories : Trajectories
            Commands and measured outputs.
        max_faults : int, default 1
            2 also tries each pair of stuck actuators, which are stuck from the same moment on; a
            trajectory that a pair explains better is "unknown", and the reason names the pair.
        progress : callable, optional
            Called with the share of the work that is done.

        Raises
        ------
        InputError
            The channels or the sample rate are not those of the surrogate; 2 faults of a diagnoser
            without two stuck actuators; another number.

        """
        pairs = self._pairs(max_faults)
        given = DiagnosisInputs.of(self.surrogate, self.residual, trajectories)
        given = given.with_error(self.surrogate_variance)
        faults = (*self.faults.values(), *pairs.values())
        parts = []
        healthy = faults.index(None) if None in faults else -1
        begins = range(0, len(trajectories), TRAJECTORIES_PER_BATCH)
        for begin in tracked(begins, len(begins), progress):
            part = given[begin : begin + TRAJECTORIES_PER_BATCH]
            rows = Hypotheses.of(faults, self.residual, *part)
            found = invert(rows, self.noise)
            offset = _offsets(rows, found, len(faults), healthy)
            parts.append((*_severities(rows, found, len(faults)), offset))
        *by_class, offset = (np.concatenate(each) for each in zip(*parts, strict=True))
        count = len(self.classes)
        each, named = _several(by_class[0], count, list(pairs))
        evidence, explained, level, onset, bias = (found[:, :count] for found in by_class)
        share = np.exp(evidence - evidence.max(axis=1, keepdims=True))
        missing = unmeasured_outputs(trajectories, self.calibration.outputs)
        measured = given.mask.any(dim=2).sum(dim=1).clamp_min(1).numpy()
        unknown = expit(self.bound * measured - explained.max(axis=1))
        unknown = np.where(missing == "", unknown, 1.0)
        severities = (level, onset / trajectories.rate, bias)
        levels, onsets, offsets = (Estimate(*np.moveaxis(each, -1, 0)) for each in severities)
        doubts = [missing != "", each > 0.5, unknown > 0.5]
        return Diagnosis(
            self.classes,
            share / share.sum(axis=1, keepdims=True),
            evidence,
            explained,
            levels,
            onsets,
            offsets,
            outside_training(self.surrogate, trajectories),
            unknown,
            offset,
            np.select(doubts, [missing, named, UNEXPLAINED], ""),
            each,
        )

    def _pairs(self, max_faults: int) -> dict[tuple[str, str], StuckPair]:
        """The pairs of stuck actuators that are tried, by the names of their classes."""
        one_of("max_faults", max_faults, (1, 2))
        pairs = stuck_pairs(self.faults) if max_faults > 1 else {}
        possible = max_faults == 1 or len(pairs) > 0
        expected = "1 for a diagnoser without two actuators that can be stuck"
        remedy = "add their classes to its faults"
        require(possible, "max_faults", expected=expected, got=max_faults, remedy=remedy)
        return pairs

    def save(self, folder: str | Path) -> None:
        """Write one folder with `surrogate` and `residual` inside, or nothing."""
        faults = [[name, each and to_config(each, FAULTS)] for name, each in self.faults.items()]
        about = {"faults": faults, "calibration": to_config(self.calibration, (Calibration,))}
        learned = {"scale": self.noise.scale, "thinning": self.noise.thinning}
        learned["surrogate_variance"] = self.surrogate_variance
        if np.isfinite(self.bound):
            learned["bound"] = torch.tensor(self.bound, dtype=torch.float64)
        with write_model(folder, "inversion", about, learned) as inside:
            self.surrogate.save(inside / "surrogate")
            self.residual.save(inside / "residual")

    @classmethod
    def load(cls, folder: str | Path) -> InversionDiagnoser:
        """Read what `save` wrote; InputError when it is not an inversion or damaged."""
        about, weights = read_model(folder, "inversion")
        folder, calibration = Path(folder), about.get("calibration", {"kind": "Calibration"})
        surrogate = load_surrogate(folder / "surrogate")
        faults = {name: each and from_config(each, FAULTS) for name, each in about["faults"]}
        return cls(
            surrogate,
            ResidualModel.load(folder / "residual"),
            faults,
            noise=Noise(weights["scale"], weights["thinning"]),
            surrogate_variance=weights["surrogate_variance"],
            bound=float(weights.get("bound", -np.inf)),
            calibration=from_config(calibration, (Calibration,)),
        )


FAULTS: tuple[type, ...] = (Stuck, ActuatorBias)
"""The faults that can be inverted, and that a model folder may name."""


def _several(
    evidence: NDArray, classes: int, pairs: Sequence[tuple[str, str]], *, prior_odds: float = 0.01
) -> tuple[NDArray, NDArray]:
    """The probability (n,) that a pair is true, and a sentence with the most probable pair.

    `evidence` (n, C + pairs); beforehand all pairs are `prior_odds` as probable as all C classes.

    Parameters
    ----------
    prior_odds : float, default 0.01
        Probability, beforehand, of two stuck actuators over that of a single fault or none.

    """
    if not pairs:
        return np.zeros(len(evidence)), np.full(len(evidence), "", dtype=object)
    one = logsumexp(evidence[:, :classes], axis=1) - np.log(classes)
    two = logsumexp(evidence[:, classes:], axis=1) - np.log(len(pairs))
    best = evidence[:, classes:].argmax(axis=1)
    text = [f"more than one fault: {' and '.join(pairs[i])} explain the outputs best" for i in best]
    return expit(two - one + np.log(prior_odds)), np.array(text, dtype=object)


def _offsets(rows: Hypotheses, found: Inversion, classes: int, healthy: int) -> NDArray:
    """Offsets (n, M, d_u) if the machine is healthy, NaN where none is inferred or none is."""
    problem = rows.problem
    away = problem.per_segment(found.fit.x - rows.prior.gaussian.mean)[..., 1:]
    absent = ~problem.valid[..., None] | (found.fit.missed > 0.5)
    every = away.masked_fill(absent, torch.nan).unflatten(0, (-1, classes))
    chosen = every[:, healthy] if healthy >= 0 else torch.full_like(every[:, 0], torch.nan)
    return chosen.numpy()


def _severities(rows: Hypotheses, found: Inversion, classes: int) -> tuple[NDArray, ...]:
    """Evidence and what is explained (n, C); value, low and high of level, onset and bias.

    The latter are (n, C, 3) and (n, C, M, 3).
    """
    half = NormalDist().inv_cdf(0.5 + COVERAGE / 2) * found.level_deviation
    level = torch.stack([found.level, found.level - half, found.level + half], dim=1)
    onset = central_interval(found.onsets.samples, found.onsets.probability, COVERAGE)
    # An actuator lags its command by up to the delay, and only the level shows when it stopped.
    delay = rows.problem.per_segment(found.fit.x)[..., 0]
    onset = onset + delay.abs().mean(dim=1, keepdim=True) * torch.tensor([0.0, -1.0, 1.0])
    free = rows.onsets[:, :1] >= rows.problem.reference.shape[1]
    level, onset = (each.masked_fill(free, torch.nan) for each in (level, onset))
    every = (found.evidence, found.evidence + found.information, level, onset, found.bias)
    return tuple(each.unflatten(0, (-1, classes)).numpy() for each in every)
