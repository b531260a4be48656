"""`TrajectoryMonitor`: watches a machine whose work is trajectories, such as a robot's.

What a healthy trajectory leaves unexplained depends on the place in it, so that its samples are no
stream of errors of one distribution. Its evidence as a whole is: for each fault against the healthy
machine, from a diagnosis by inversion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.checks import finite, instance, require, whole
from retwin.data.trajectories import Trajectories
from retwin.diagnosis.diagnoser import load_diagnoser
from retwin.diagnosis.estimate import UNKNOWN
from retwin.diagnosis.inversion import InversionDiagnoser
from retwin.diagnosis.state_inversion import StateInversionDiagnoser
from retwin.errors import InputError
from retwin.monitor.detector import LARGEST, Detector, DetectorState
from retwin.monitor.promise import duration, false_alarms
from retwin.monitor.scores import ConformalScores, fit_scores, middle
from retwin.monitor.slack import Slack
from retwin.monitor.validity import Validity, ValidityState
from retwin.progress import Progress
from retwin.serialisation.models import read_model, refusing, write_model
from retwin.twins.faults import Fault

__all__ = [
    "TrajectoryAlarm",
    "TrajectoryMonitor",
    "TrajectoryState",
    "WatchedTrajectories",
    "fit_trajectory_monitor",
]

KIND = "trajectory_monitor"
"""Kind of the saved model."""
FEWEST = 8
"""Healthy trajectories of a calibration, at least."""
LARGEST_RATIO = 300.0
"""Logarithms of likelihood ratios count up to this, far more than any threshold; the largest of a
trajectory is reduced to it, and the others by as much."""
FACTORS = np.arange(1.0, 10.005, 0.01)
"""Factors of the errors of which the smallest is taken with which the calibration agrees."""
CERTAIN = 1.645
"""Standard errors up to which the calibration may disagree: 95 %, one-sided."""

Inversion = InversionDiagnoser | StateInversionDiagnoser
"""Diagnosers whose evidence is that of a model."""


@dataclass(frozen=True, eq=False)
class TrajectoryState:
    """What a monitor remembers of the trajectories of one machine.

    Attributes
    ----------
    evidence : NDArray
        (F,), that of each fault, and of `unknown` where the diagnoser has a model of it.
    detector, validity
        Of the errors that the healthy machine leaves unexplained.
    count : int
        Trajectories so far.

    """

    evidence: NDArray
    detector: DetectorState
    validity: ValidityState
    count: int = 0


@dataclass(frozen=True)
class TrajectoryAlarm:
    """A change that a monitor of trajectories has found.

    Attributes
    ----------
    trajectory : str
        The id of the trajectory after which the alarm was raised.
    number : int
        How many trajectories were watched before it.
    name : str
        The fault with most evidence since the last alarm, or "unknown": a change that no fault
        explains.
    evidence : float
        At least the average run length of the promise.

    """

    trajectory: str
    number: int
    name: str
    evidence: float


@dataclass(frozen=True, eq=False)
class WatchedTrajectories:
    """What a monitor found in n trajectories.

    Attributes
    ----------
    score : NDArray
        (n,), of what the healthy machine leaves unexplained: standard Gaussian if it is healthy.
    evidence : NDArray
        (n,), that of a change; an alarm is raised from the average run length on.
    void, outside : NDArray
        (n,) bool, whether the promise does not apply any more, and whether the commands of the
        trajectory leave their range in training, where the twin extrapolates.
    alarms : list of TrajectoryAlarm
        The alarms.

    """

    score: NDArray
    evidence: NDArray
    void: NDArray
    outside: NDArray
    alarms: list[TrajectoryAlarm]


@dataclass(frozen=True, eq=False)
class TrajectoryMonitor:
    """A diagnoser by inversion that watches trajectories, with a promise on false alarms.

    With the evidence l_f of fault f, l_0 of the healthy machine, and errors that are at most
    kappa times those of the model,

        M_f(t) = (M_f(t-1) + 1) exp((l_f - l_0) / kappa^2),

    is an e-detector: the expectation of the factor is 1 where errors are Gaussian and kappa times
    as large, and less where they are smaller. The mean over faults is averaged with the e-detector
    of the ranks of l_0 among those of the calibration, for changes that no fault explains
    (`Detector`).

    Attributes
    ----------
    diagnoser : InversionDiagnoser or StateInversionDiagnoser
        With the faults.
    scores : ConformalScores
        Of what healthy trajectories of the calibration leave unexplained.
    slack : Slack
        The class of distributions of these scores.
    kappa : float
        By how much errors may exceed those of the model.
    arl : float
        Average number of trajectories to a false alarm, at least.
    duration : float
        Of a trajectory of the calibration, in s.
    alpha : float
        Probability of declaring a promise void that applies.

    """

    diagnoser: Inversion
    scores: ConformalScores
    slack: Slack
    kappa: float
    arl: float
    duration: float
    alpha: float = 0.01

    @property
    def promise(self) -> str:
        """What is promised, for which machines, in one sentence."""
        return (
            f"On average at least {self.arl:.6g} trajectories ({duration(self.arl * self.duration)}"
            f" of {self.duration:.3g} s each) pass until a false alarm, as long as errors are at "
            f"most {self.kappa:.3g} times those of the model, and {self.slack}. Where that is so, "
            f"it is declared void with a probability of at most {self.alpha:g}."
        )

    @cached_property
    def _tests(self) -> tuple[Detector, Validity]:
        detector = Detector(self.slack)
        return detector, Validity(detector, self.arl, self.alpha)

    def start(self) -> TrajectoryState:
        """What is known of a machine before its first trajectory."""
        detector, validity = self._tests
        count = len(_alternatives(self.diagnoser))
        return TrajectoryState(np.zeros(count), detector.start(1), validity.start(1))

    def watch(
        self,
        trajectories: Trajectories,
        state: TrajectoryState | None = None,
        *,
        progress: Progress | None = None,
    ) -> tuple[TrajectoryState, WatchedTrajectories]:
        """Watch trajectories of one machine in the order of time.

        Parameters
        ----------
        trajectories : Trajectories
            n of them.
        state : TrajectoryState, optional
            After those before; by default these are the first ones.
        progress : callable, optional
            Called with the finished share.

        Raises
        ------
        InputError
            Other channels or another rate than those of the twin.

        """
        ratio, error, outside = _compared(self.diagnoser, trajectories, progress)
        state = state or self.start()
        detector, validity = self._tests
        low, high = self.scores.score(error[None, :])
        half = len(trajectories), 2
        made, void, alarms = np.empty(half), np.zeros(half[0], dtype=bool), []
        for t, factor in enumerate(_factor(ratio, self.kappa)):
            own = np.minimum((state.evidence + 1) * factor, LARGEST)
            ends = low[:, t], high[:, t]
            detected, against = detector.step(state.detector, *ends)
            made[t] = own.mean(), against[0]
            alarm = made[t].mean() >= self.arl
            tested, _ = validity.step(state.validity, [alarm], *ends)
            void[t] = validity.void(tested)[0]
            if alarm:
                likely = _alternatives(self.diagnoser)[int(own.argmax())]
                name = UNKNOWN if against[0] > own.max() else likely
                alarms.append(
                    TrajectoryAlarm(
                        str(trajectories.ids[t]), state.count, name, float(made[t].mean())
                    )
                )
                own = np.zeros_like(own)
            detected = detector.reset(detected, np.array([alarm]))
            state = TrajectoryState(own, detected, tested, state.count + 1)
        return state, WatchedTrajectories(
            middle(low, high)[0], made.mean(axis=1), void, outside, alarms
        )

    def save(self, folder: str | Path) -> None:
        """Write the diagnoser, the calibration and the promise."""
        about = {
            "slack": [self.slack.kappa, self.slack.shift],
            "copies": self.scores.copies,
            **{name: getattr(self, name) for name in NUMBERS},
        }
        arrays = self.scores.arrays()
        tensors = {name: torch.tensor(np.ascontiguousarray(each)) for name, each in arrays.items()}
        with write_model(folder, KIND, about, tensors) as temporary:
            self.diagnoser.save(temporary / "diagnoser")

    @classmethod
    def load(cls, folder: str | Path) -> TrajectoryMonitor:
        """Read what `save` wrote. Raises InputError if it is no such monitor or is damaged."""
        about, weights = read_model(folder, KIND)
        with refusing(folder, expected="a monitor of trajectories"):
            diagnoser = _checked(load_diagnoser(Path(folder) / "diagnoser"))
            arrays = {name: each.numpy() for name, each in weights.items()}
            scores = ConformalScores.of_arrays(arrays, about["copies"])
            require(
                len(scores.independent) == 1,
                "weights",
                expected="the calibration of one stream",
                got=len(scores.independent),
                remedy="save the monitor again",
            )
            numbers = {name: finite(name, about[name], least=0.0) for name in NUMBERS}
            return cls(diagnoser, scores, Slack(*about["slack"]), **numbers)


NUMBERS = ("kappa", "arl", "duration", "alpha")
"""Attributes that are saved as numbers."""


def fit_trajectory_monitor(
    diagnoser: Inversion,
    healthy: Trajectories,
    false_alarms_at_most: str | float = "1 per month",
    *,
    causes: Mapping[str, Fault] | None = None,
    alpha: float = 0.01,
    progress: Progress | None = None,
) -> TrajectoryMonitor:
    """Calibrate a monitor on trajectories of the healthy machine.

    Parameters
    ----------
    diagnoser : InversionDiagnoser or StateInversionDiagnoser
        Of `fit_inversion`, with the faults.
    healthy : Trajectories
        Healthy trajectories, at least 8, best of several days, that the twin was not fitted to.
    false_alarms_at_most : str or float
        See `false_alarms`; "1 per month" is one of a machine that works without pause, and
        "1000 trajectories" or a number is the average run length itself.
    causes : mapping of str to Fault, optional
        Further faults to watch for, beside those of the diagnoser, such as `Case.causes`.
    alpha : float
        Probability of declaring the promise void although it applies.
    progress : callable, optional
        Called with the finished share.

    Returns
    -------
    TrajectoryMonitor
        With its promise.

    Raises
    ------
    InputError
        Too few trajectories, other channels or another rate than those of the twin, no diagnoser
        by inversion, or trajectories that look faulty to it.

    """
    diagnoser = _checked(diagnoser).with_faults(causes or {})
    instance("healthy", healthy, Trajectories, remedy="load recorded ones")
    whole("healthy", len(healthy), least=FEWEST, remedy="record more healthy trajectories")
    length = healthy.steps / healthy.rate
    arl = false_alarms(false_alarms_at_most, 1 / length)
    ratio, error, _ = _compared(diagnoser, healthy, progress)
    scores = fit_scores(error[None, :])
    (slack,) = scores.slack(1)
    for kappa in FACTORS[slack.kappa <= FACTORS]:
        factor = _factor(ratio, kappa).mean(axis=1)
        bound = factor.mean() + CERTAIN * factor.std(ddof=1) / np.sqrt(len(factor))
        if bound <= 1:
            return TrajectoryMonitor(
                diagnoser, scores, slack, float(kappa), arl, length, float(alpha)
            )
    likely = _alternatives(diagnoser)[int(np.median(ratio, axis=0).argmax())]
    raise InputError(
        "healthy",
        expected="trajectories that the diagnoser takes for healthy ones",
        got=f"some that look like {likely}",
        remedy="leave out faulty ones, or calibrate the twin on more healthy trajectories",
    )


def _checked(diagnoser: object) -> Inversion:
    got = type(diagnoser).__name__
    if isinstance(diagnoser, Inversion):
        if None in diagnoser.faults.values():
            return diagnoser
        got = "one without a healthy class"
    raise InputError(
        "diagnoser",
        expected="a diagnoser by inversion, with a healthy class",
        got=got,
        remedy="derive it from the twin by fit_inversion",
    )


def _factor(ratio: NDArray, kappa: float) -> NDArray:
    """Likelihood ratios for errors that may be `kappa` times as large, from their logarithms."""
    logs = ratio / kappa**2
    logs = np.clip(logs, -np.inf, 1e300)  # differences of infinite ones would not be numbers
    logs -= np.maximum(logs.max(axis=1, keepdims=True) - LARGEST_RATIO, 0.0)
    made: NDArray = np.exp(logs)
    return made


def _healthy(diagnoser: Inversion) -> int:
    """The index of the healthy class."""
    return [each is None for each in diagnoser.faults.values()].index(True)


def _alternatives(diagnoser: Inversion) -> list[str]:
    """The names of all for which there is evidence, but the healthy machine."""
    names = [name for name, fault in diagnoser.faults.items() if fault is not None]
    return [*names, UNKNOWN] if isinstance(diagnoser, StateInversionDiagnoser) else names


def _compared(
    diagnoser: Inversion, trajectories: Trajectories, progress: Progress | None
) -> tuple[NDArray, NDArray, NDArray]:
    """Evidence for each fault against the healthy machine, (n, F); what that leaves; `outside`."""
    found = diagnoser.diagnose(trajectories, progress=progress)
    healthy = _healthy(diagnoser)
    own = found.evidence[:, healthy]
    measured = np.maximum(trajectories.mask.any(axis=2).sum(axis=1), 1)
    with np.errstate(invalid="ignore"):
        ratio = np.delete(found.evidence, healthy, axis=1) - own[:, None]
    # Where neither explains the trajectory, it is no evidence for that fault.
    return (
        np.nan_to_num(ratio, nan=-np.inf, neginf=-np.inf, posinf=np.inf),
        -own / measured,
        found.outside,
    )
