"""Evidence of trajectories: for each fault against the healthy machine, and what that leaves.

Each trajectory has one of four behaviours, whatever it contains: it is used; or its ratios are used
and its error is not ranked, since it was measured otherwise than those of the calibration; or it is
implausible, which counts as the largest error and for no fault; or nothing was measured in it.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import UNKNOWN, Trajectories
from retwin.diagnosis.estimate import ImplausibleError
from retwin.diagnosis.inversion.states import StateInversionDiagnoser
from retwin.diagnosis.inversion.trajectories import InversionDiagnoser
from retwin.errors import InputError
from retwin.progress import Progress, tracked
from retwin.twins.twin import check_channels

Inversion = InversionDiagnoser | StateInversionDiagnoser
"""Diagnosers whose evidence is that of a model."""
LARGEST_RATIO = 300.0
"""Logarithms of likelihood ratios count up to this, far more than any threshold; the largest of a
trajectory is reduced to it, and the others by as much."""


@dataclass(frozen=True, eq=False)
class Compared:
    """What n trajectories are evidence of.

    Attributes
    ----------
    ratio : NDArray
        (n, F), logarithm of the likelihood ratio of each alternative to the healthy machine: 0
        where the trajectory is no evidence, -inf where the alternative does not explain it.
    error : NDArray
        (n,), minus the log evidence of the healthy machine per measured sample; NaN where nothing
        was measured, infinite where it is implausible.
    measured : NDArray
        (n, d_y), measured values of each output.
    offset : NDArray
        (n, M, d_u), the offset of each actuator in each segment (`Diagnosis.offset`); NaN where
        none is inferred, and M = 0 for a diagnoser of states.
    implausible, outside : NDArray
        (n,) bool: the healthy machine cannot have produced these readings, whatever its noise; and
        commands leave their range in training.

    """

    ratio: NDArray
    error: NDArray
    measured: NDArray
    offset: NDArray
    implausible: NDArray
    outside: NDArray

    @property
    def unmeasured(self) -> NDArray:
        """Whether nothing was measured, (n,) bool."""
        return np.asarray(~self.measured.any(axis=1))


def checked(diagnoser: object) -> Inversion:
    """A diagnoser by inversion with exactly one healthy class and none that is called "unknown"."""
    got = type(diagnoser).__name__
    if isinstance(diagnoser, Inversion):
        healthy = [name for name, fault in diagnoser.faults.items() if fault is None]
        if len(healthy) == 1 and UNKNOWN not in diagnoser.faults:
            return diagnoser
        got = f"healthy classes {healthy} among {list(diagnoser.faults)}"
    raise InputError(
        "diagnoser",
        expected=f"a diagnoser by inversion, with one healthy class and none called {UNKNOWN!r}",
        got=got,
        remedy="derive it from the twin by fit_inversion, and name the classes so",
    )


def twin_of(diagnoser: Inversion) -> Any:
    """The twin or surrogate that a diagnoser inverts."""
    return diagnoser.twin if isinstance(diagnoser, StateInversionDiagnoser) else diagnoser.surrogate


def alternatives(diagnoser: Inversion) -> list[str]:
    """The names of all for which there is evidence, but the healthy machine."""
    names = [name for name, fault in diagnoser.faults.items() if fault is not None]
    return [*names, UNKNOWN] if isinstance(diagnoser, StateInversionDiagnoser) else names


def compared(
    diagnoser: Inversion, trajectories: Trajectories, progress: Progress | None = None
) -> Compared:
    """What trajectories are evidence of.

    Raises
    ------
    InputError
        Other channels or another rate than those of the twin, or trajectories that are shorter than
        the earliest onset of a fault.

    """
    check_channels(twin_of(diagnoser), trajectories, "trajectories")
    measured = trajectories.mask.sum(axis=1)
    evidence = np.zeros((len(trajectories), len(alternatives(diagnoser)) + 1))
    outside = np.zeros(len(trajectories), dtype=bool)
    some = np.flatnonzero(measured.any(axis=1)).tolist()
    # One by one: the last digits of a batch depend on what else is in it, and a monitor that is
    # continued later has to find the same bytes.
    found = [_diagnose(diagnoser, trajectories[[i]]) for i in tracked(some, len(some), progress)]
    most = max((each.shape[1] for _, _, each in found), default=0)  # each has its own segments
    offset = np.full((len(trajectories), most, len(trajectories.inputs)), np.nan)
    for i, (explained, beyond, offsets) in zip(some, found, strict=True):
        evidence[i], outside[i] = explained[0], beyond[0]
        offset[i, : offsets.shape[1]] = offsets[0]
    healthy = list(diagnoser.faults.values()).index(None)
    own = evidence[:, healthy]
    implausible: NDArray = ~np.isfinite(own)
    ratio: NDArray = np.delete(evidence, healthy, axis=1) - np.where(implausible, 0.0, own)[:, None]
    ratio = np.nan_to_num(ratio, nan=-np.inf, neginf=-np.inf, posinf=np.inf)
    ratio[implausible] = 0.0
    samples = trajectories.mask.any(axis=2).sum(axis=1)
    error = np.where(samples, -own / np.maximum(samples, 1), np.nan)
    error = np.where(implausible, np.inf, error)
    offset[implausible] = np.nan
    return Compared(ratio, error, measured, offset, implausible, outside)


def factors(ratio: NDArray, kappa: float) -> NDArray:
    """Likelihood ratios for errors that may be `kappa` times as large, from their logarithms."""
    logs = np.clip(ratio / kappa**2, -np.inf, 1e300)  # infinite ones have no differences
    logs -= np.maximum(logs.max(axis=1, keepdims=True) - LARGEST_RATIO, 0.0)
    return np.exp(logs)


def _diagnose(diagnoser: Inversion, trajectory: Trajectories) -> tuple[NDArray, NDArray, NDArray]:
    """Evidence (1, F + 1) of classes for a trajectory, NaN if implausible; `outside`; offsets."""
    if isinstance(diagnoser, InversionDiagnoser):
        found = diagnoser.diagnose(trajectory)
        return found.evidence, found.outside, found.offset
    evidence = np.full((1, len(diagnoser.faults) + 1), np.nan)
    with suppress(ImplausibleError):
        evidence = diagnoser.diagnose(trajectory).evidence
    none = np.zeros((1, 0, len(trajectory.inputs)))
    return evidence, diagnoser.twin.outside(trajectory.commands), none
