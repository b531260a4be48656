"""`StateInversionDiagnoser`: which fault of a system with states explains its outputs.

No training. The evidence for a fault is the likelihood of the measured outputs, each given all
earlier ones, by the extended Kalman filter of the corrected dynamics, as a mean over the sizes,
onsets and ends that the fault can have, and over the posterior of the twin's parameters. What no
fault explains is `unknown`: process and measurement noise that are larger than in calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from retwin.checks import nothing, require
from retwin.data.trajectories import UNKNOWN, Trajectories
from retwin.diagnosis.estimate import Estimate, ImplausibleError
from retwin.diagnosis.inversion.adaptive_grid import Integral
from retwin.diagnosis.inversion.fault_evidence import NOTHING, FaultEvidence
from retwin.progress import Progress, tracked
from retwin.serialisation.configs import from_config, to_config
from retwin.serialisation.models import read_model, write_model
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.system_faults import FAULTS, TimedFault, check_faults
from retwin.twins.twin import check_channels
from retwin.update.dynamics import DynamicsTwin
from retwin.workers.threads import in_threads

UNEXPLAINED = "larger noise than in calibration explains the outputs better than every class"
"""The reason for which a trajectory is unknown."""
KINDS = tuple(kind for kind in FAULTS if issubclass(kind, TimedFault))
"""The faults that can be inverted."""


@dataclass(frozen=True, eq=False)
class StateDiagnosis:
    """The diagnosis of n trajectories; severities as if each class were the true one.

    Attributes
    ----------
    classes : tuple of str
        Names, C.
    probabilities : NDArray
        (n, C), each row sums to one: what holds if one of the classes is the true one.
    unknown : NDArray
        (n,), the probability that none of them is.
    evidence : NDArray
        (n, C + 1), log marginal likelihood of the outputs for each class and for `unknown`.
        Probabilities take its differences over the dispersion of the errors with the most probable
        class, which is 1 unless the twin lacks something.
    size, onset, end : Estimate
        (n, C), size of each fault in the unit of what it changes, and its times in s; NaN where a
        class has none.
    outside : NDArray
        (n,) bool, whether commands leave the range that they had in calibration.

    """

    classes: tuple[str, ...]
    probabilities: NDArray
    unknown: NDArray
    evidence: NDArray
    size: Estimate
    onset: Estimate
    end: Estimate
    outside: NDArray

    @property
    def labels(self) -> NDArray:
        """The most probable class of each trajectory (n,), or "unknown"."""
        return np.array([*self.classes, UNKNOWN])[self.evidence.argmax(axis=1)]

    @property
    def reason(self) -> NDArray:
        """Why each trajectory is unknown (n,); "" where it is not."""
        return np.where(self.labels == UNKNOWN, UNEXPLAINED, "")


class StateInversionDiagnoser:
    """Class probabilities from the evidence for each fault of a system; see `fit_inversion`.

    Parameters
    ----------
    twin : DynamicsTwin
        The corrected dynamics of the healthy system (`fit_dynamics`).
    faults : mapping of str to Fault or None
        Class name to fault, None for healthy, in the order of the probabilities. What a fault
        leaves open, as a pair (low, high), is inferred.

    Attributes
    ----------
    classes : tuple of str
        Class names, in the order of the probabilities.

    Raises
    ------
    InputError
        There are fewer than two classes, none is healthy, or a fault that the twin cannot have.

    """

    def __init__(self, twin: DynamicsTwin, faults: Mapping[str, Fault | None]) -> None:
        complete = len(faults) > 1 and sum(each is None for each in faults.values()) == 1
        expected = "one healthy class, None, and faults"
        remedy = 'give for instance {"Healthy": None, "leak": ParameterShift(...)}'
        require(complete, "faults", expected=expected, got=faults, remedy=remedy)
        for fault in faults.values():
            invertible = fault is None or isinstance(fault, TimedFault)
            expected = f"None, or one of {', '.join(each.__name__ for each in KINDS)}"
            remedy = "leave out what cannot be inverted, or train a diagnoser"
            require(invertible, "faults", expected=expected, got=repr(fault), remedy=remedy)
        check_faults(list(faults.values()), len(twin.inputs), len(twin.outputs), twin.shiftable)
        self.twin = twin
        self.classes = tuple(faults)
        self.faults: dict[str, TimedFault | None] = dict(faults)  # type: ignore[arg-type]

    def with_faults(self, more: Mapping[str, Fault | None]) -> StateInversionDiagnoser:
        """The same with further classes."""
        return StateInversionDiagnoser(self.twin, {**self.faults, **more})

    def predict_proba(self, trajectories: Trajectories) -> NDArray:
        """Probabilities (n, classes), see `Diagnoser`."""
        return self.diagnose(trajectories).probabilities

    def diagnose(
        self,
        trajectories: Trajectories,
        *,
        known_start: bool = True,
        progress: Progress | None = None,
    ) -> StateDiagnosis:
        """Probabilities, sizes and times of every fault; classes are equally probable beforehand.

        Parameters
        ----------
        trajectories : Trajectories
            n records, or windows of records (`Trajectories.between`).
        known_start : bool, default True
            Whether they start as those in calibration do. The states at the start of a window may
            be anywhere in their range in calibration.
        progress : callable, optional
            Called with the finished fraction, from 0 to 1.

        Returns
        -------
        StateDiagnosis
            The diagnosis.

        Raises
        ------
        InputError
            The channels or the sample rate are not those of the twin, or a trajectory is shorter
            than the earliest onset of a fault; an `ImplausibleError` for readings that are no
            measurements.

        """
        check_channels(self.twin, trajectories, "trajectories")
        empty = trajectories.ids[~trajectories.mask.any(axis=(1, 2))]
        none = (f"none in {each}" for each in empty)
        nothing("trajectories", none, "measured samples in each", remedy="leave them out")
        single = [trajectories[i : i + 1] for i in range(len(trajectories))]
        rows = in_threads(lambda each: self._integrals(each, known_start), single)
        found, dispersions = zip(*tracked(rows, len(single), progress), strict=True)
        evidence = np.array([[each.evidence for each in row] for row in found])
        if not np.isfinite(evidence).any(axis=1).all():
            expected = "outputs with which the filter stays finite"
            got = f"{int((~np.isfinite(evidence).any(axis=1)).sum())} with which it does not"
            remedy = "check their units"
            raise ImplausibleError("trajectories", expected=expected, got=got, remedy=remedy)
        parts = np.array([[(e.mean, e.low, e.high) for e in row[:-1]] for row in found])
        size, onset, end = (Estimate(*np.moveaxis(parts[..., k], 2, 0)) for k in range(3))
        top = evidence.max(axis=1, keepdims=True)
        tempered = (evidence - top) / np.array(dispersions)[:, None]
        known = tempered[:, :-1]
        share = np.exp(tempered - logsumexp(tempered, axis=1, keepdims=True))
        return StateDiagnosis(
            self.classes,
            np.exp(known - logsumexp(known, axis=1, keepdims=True)),
            share[:, -1],
            evidence,
            size,
            onset,
            end,
            self.twin.outside(trajectories.commands),
        )

    def _integrals(
        self, trajectory: Trajectories, known_start: bool, *, implausible: float = 1e6
    ) -> tuple[list[Integral], float]:
        """Those of all faults for one trajectory, and of something else besides.

        The second part is the dispersion of the errors that the most probable fault leaves.

        Parameters
        ----------
        implausible : float, default 1e6
            Error of a prediction, in standard deviations, from which on an output is no
            measurement.

        """
        record = FaultEvidence.of(self.twin, trajectory, known_start)
        error = record.largest_error()
        if not error < implausible:
            expected = "finite outputs that the twin's sensors could measure"
            got = f"one {error:.1g} standard deviations away in {trajectory.ids[0]}"
            remedy = "check their units, and mask values that stand for missing ones"
            raise ImplausibleError("trajectories", expected=expected, got=got, remedy=remedy)
        faults = self.faults.values()
        row = [record.integral(fault) for fault in faults]
        unknown = record.unknown(faults, row)
        row = [record.tolerated(*each) for each in zip(faults, row, strict=True)]
        leading = max(range(len(row)), key=lambda i: row[i].evidence)
        known = np.isfinite(row[leading].evidence)
        point = list(faults)[leading], row[leading].best
        dispersion = record.dispersion(*point) if known else 1.0
        return [*row, Integral(unknown, *[NOTHING] * 4)], dispersion

    def save(self, folder: str | Path) -> None:
        """Write one folder with the twin inside, or nothing."""
        faults = [[name, each and to_config(each, FAULTS)] for name, each in self.faults.items()]
        with write_model(folder, "state inversion", {"faults": faults}, {}) as inside:
            self.twin.save(inside / "twin")

    @classmethod
    def load(cls, folder: str | Path) -> StateInversionDiagnoser:
        """Read what `save` wrote; InputError when it is no such inversion or damaged."""
        about, _ = read_model(folder, "state inversion")
        twin = DynamicsTwin.load(Path(folder) / "twin")
        faults = {name: each and from_config(each, FAULTS) for name, each in about["faults"]}
        return cls(twin, faults)
