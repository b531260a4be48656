"""`TrajectoryMonitor`: watches a machine whose work is trajectories, such as a robot's.

What a healthy trajectory leaves unexplained depends on the place in it, so that its samples are no
stream of errors of one distribution. Its evidence as a whole is: for each fault against the healthy
machine, from a diagnosis by inversion.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from retwin.checks import finite, instance, nothing, positive, require, whole
from retwin.data.trajectories import HEALTHY, UNKNOWN, Trajectories
from retwin.diagnosis.diagnoser import load_diagnoser
from retwin.errors import InputError
from retwin.monitor.detect.detector import LARGEST, Detector
from retwin.monitor.detect.offsets import SIZES, OffsetModel, biases, fit_offsets, is_bias
from retwin.monitor.detect.promise import (
    MAX_RUN_LENGTH,
    MIN_RUN_LENGTH,
    duration,
    false_alarms,
)
from retwin.monitor.detect.scores import ConformalScores, fit_scores, middle
from retwin.monitor.detect.slack import Slack
from retwin.monitor.detect.validity import Validity
from retwin.monitor.models.trajectory.evidence import (
    LARGEST_RATIO,
    Compared,
    Inversion,
    alternatives,
    checked,
    compared,
    factors,
    twin_of,
)
from retwin.monitor.models.trajectory.state import (
    TrajectoryAlarm,
    TrajectoryState,
    WatchedTrajectories,
)
from retwin.progress import Progress
from retwin.serialisation.models import check_weights, read_model, refusing, write_model
from retwin.twins.faults.actuator_faults import Fault
from retwin.update.dynamics.filter.noise import CERTAIN

KIND = "trajectory_monitor"
"""Kind of the saved model."""
SHOWN = 0.01
"""Smallest share of a cause that an alarm states."""
COMPARABLE = 1.25
"""Factor by which an output may have fewer or more measured values than in any trajectory of the
calibration: the mean error of a trajectory then varies by an eighth more or less."""
MIN_TRAJECTORIES = 8
"""Healthy trajectories of a calibration, at least."""
FACTORS = np.arange(1.0, 10.005, 0.01)
"""Factors of the errors of which the smallest is taken with which the calibration agrees."""
NUMBERS = ("kappa", "arl", "duration", "alpha", "used", "given")
"""Attributes that are saved as numbers."""


@dataclass(frozen=True, eq=False)
class TrajectoryMonitor:
    """A diagnoser by inversion that watches trajectories, with a promise on false alarms.

    With the evidence l_f of fault f, l_0 of the healthy machine, and errors that are at most
    kappa times those of the model,

        M_f(t) = (M_f(t-1) + 1) exp((l_f - l_0) / kappa^2),

    is an e-detector: the expectation of the factor is 1 where errors are Gaussian and kappa times
    as large, and less where they are smaller. The mean over faults is averaged with the e-detector
    of the ranks of l_0 among those of the calibration, for changes that no fault explains
    (`Detector`), and, where the diagnoser knows biases of actuators, with that of the offsets over
    all trajectories (`OffsetModel`).

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
    measured : NDArray
        (2, d_y), the fewest and the most measured values of each output in a trajectory of the
        calibration.
    offsets : OffsetModel or None
        Of the actuators; None where the diagnoser knows no bias of one.
    alpha : float
        Probability of declaring a promise void that applies.
    used, given : int
        Trajectories of the calibration that were used, and all of them: some may have nothing
        measured, implausible readings, or commands outside their range in training.

    """

    diagnoser: Inversion
    scores: ConformalScores
    slack: Slack
    kappa: float
    arl: float
    duration: float
    measured: NDArray
    offsets: OffsetModel | None = None
    alpha: float = 0.01
    used: int = 0
    given: int = 0

    @property
    def twin(self) -> Any:
        """The twin or surrogate that the diagnoser inverts, with the machine's channels."""
        return twin_of(self.diagnoser)

    @property
    def promise(self) -> str:
        """What is promised, for which machines, in one sentence."""
        offsets = ""
        if self.offsets is not None:
            wide = ", ".join(f"{each:.3g}" for each in self.offsets.kappa)
            offsets = (
                "the standard deviations of the actuators' offsets are at most "
                f"{wide} times those of the calibration, "
            )
        unused = ""
        if self.used < self.given:
            unused = (
                f" Of the {self.given} trajectories of the calibration {self.used} were used, since"
                " in the others nothing was measured, readings are implausible or commands leave"
                " their range in training."
            )
        return (
            f"On average at least {self.arl:.6g} trajectories ({duration(self.arl * self.duration)}"
            f" of {self.duration:.3g} s each) pass until a false alarm, as long as commands stay "
            f"in their range in training, errors are at most {self.kappa:.3g} times those of the "
            f"model, {offsets}and {self.slack}. Where that is so, it is declared void with a "
            f"probability of at most {self.alpha:g}.{unused}"
        )

    @property
    def promises(self) -> dict[str, str]:
        """The promise by what it is about, as other monitors have one for each output."""
        return {"trajectories": self.promise}

    @cached_property
    def _validity(self) -> Validity:
        return Validity(Detector(self.slack), self.arl, self.alpha)

    def start(self) -> TrajectoryState:
        """What is known of a machine before its first trajectory."""
        own, pooled = np.zeros(len(alternatives(self.diagnoser))), np.zeros((0, 0))
        if self.offsets is not None:
            pooled = np.zeros((len(biases(self.diagnoser.faults.values())), len(SIZES)))
        tests = self._validity.detector.start(1), self._validity.start(1)
        return TrajectoryState(own, pooled, *tests)

    def watch(
        self,
        trajectories: Trajectories,
        state: TrajectoryState | None = None,
        *,
        progress: Progress | None = None,
    ) -> tuple[TrajectoryState, WatchedTrajectories]:
        """Watch trajectories of one machine in the order of time.

        Whatever a trajectory contains has one behaviour, which the result states. An empty set
        changes nothing, and a trajectory that is given twice counts twice.

        Parameters
        ----------
        trajectories : Trajectories
            n of them, of any length, complete or not.
        state : TrajectoryState, optional
            After those before; by default these are the first ones.
        progress : callable, optional
            Called with the finished share.

        Raises
        ------
        InputError
            Other channels or another rate than those of the twin, trajectories shorter than the
            earliest onset of a fault, or the state of another monitor.

        """
        first = self.start()
        state = first if state is None else TrajectoryState.checked(state, first)
        found = compared(self.diagnoser, trajectories, progress)
        unranked = self._unranked(found)
        low, high = self.scores.score(np.where(unranked, np.nan, found.error)[None, :])
        evidence, void = np.empty(len(trajectories)), np.zeros(len(trajectories), dtype=bool)
        alarms = []
        for t, steps in enumerate(self._factors(found)):
            state, evidence[t], shares = self._step(state, steps, low[:, t], high[:, t])
            void[t] = self._validity.void(state.validity)[0]
            if shares:
                name, probability = next(iter(shares.items()))
                about = str(trajectories.ids[t]), state.count - 1, name, float(evidence[t])
                shown = {each: share for each, share in shares.items() if share >= SHOWN}
                alarms.append(TrajectoryAlarm(*about, probability, shown, bool(found.outside[t])))
        flags = void, found.outside, found.unmeasured, unranked, found.implausible
        return state, WatchedTrajectories(middle(low, high)[0], evidence, *flags, alarms)

    def _unranked(self, found: Compared) -> NDArray:
        """Whether trajectories (n,) were measured otherwise than those of the calibration."""
        fewest, most = self.measured
        other = (found.measured * COMPARABLE < fewest) | (found.measured > COMPARABLE * most)
        return other.any(axis=1) & ~found.unmeasured

    def _factors(self, found: Compared) -> Iterator[tuple[NDArray | None, NDArray | None]]:
        """Per trajectory, factors of the evidence for faults and for biases; None for no news."""
        own = factors(found.ratio, self.kappa)
        used = ~(found.unmeasured | found.implausible)
        estimated = used & np.isfinite(found.offset).any(axis=(1, 2))
        pooled = np.ones((len(own), 0, 0))
        if self.offsets is not None:
            logs = self.offsets.ratio(found.offset, self.diagnoser.faults.values())
            pooled = np.exp(np.minimum(logs, LARGEST_RATIO))
        for t in range(len(own)):
            yield own[t] if used[t] else None, pooled[t] if estimated[t] else None

    def _step(
        self,
        state: TrajectoryState,
        step: tuple[NDArray | None, NDArray | None],
        low: NDArray,
        high: NDArray,
    ) -> tuple[TrajectoryState, float, dict[str, float]]:
        """The state after a trajectory, the evidence, and at an alarm the shares of its causes."""
        validity = self._validity
        own, pooled = (
            before if factor is None else np.minimum((before + 1) * factor, LARGEST)
            for before, factor in zip((state.evidence, state.pooled), step, strict=True)
        )
        detected, against = validity.detector.step(state.detector, low, high)
        parts = [own.mean(), against[0], *([pooled.mean()] if pooled.size else [])]
        evidence = float(np.mean(parts))
        alarm = evidence >= self.arl
        tested, _ = validity.step(state.validity, [alarm], low, high)
        shares = self._shares(own, pooled, against[0]) if alarm else {}
        if alarm:
            own, pooled = np.zeros_like(own), np.zeros_like(pooled)
        detected = validity.detector.reset(detected, np.array([alarm]))
        return TrajectoryState(own, pooled, detected, tested, state.count + 1), evidence, shares

    def _shares(self, own: NDArray, pooled: NDArray, against: float) -> dict[str, float]:
        """The share of each cause in the evidence, the largest first."""
        total = dict(zip(alternatives(self.diagnoser), own.tolist(), strict=True))
        faults = {name: each for name, each in self.diagnoser.faults.items() if is_bias(each)}
        for name, found in zip(faults, pooled, strict=False):  # none without a model of offsets
            total[name] += float(found.mean())
        total[UNKNOWN] = total.get(UNKNOWN, 0.0) + float(against)
        every = sum(total.values())
        ordered = sorted(total.items(), key=lambda each: -each[1])  # keeps the order of equal ones
        return {name: value / every for name, value in ordered}

    def save(self, folder: str | Path) -> None:
        """Write the diagnoser, the calibration and the promise."""
        about = {
            "slack": [self.slack.kappa, self.slack.shift],
            "copies": self.scores.copies,
            **{name: getattr(self, name) for name in NUMBERS},
        }
        arrays = {**self.scores.arrays(), "measured": self.measured}
        if self.offsets is not None:
            arrays |= self.offsets.arrays()
        tensors = {name: torch.tensor(np.ascontiguousarray(each)) for name, each in arrays.items()}
        with write_model(folder, KIND, about, tensors) as temporary:
            self.diagnoser.save(temporary / "diagnoser")

    @classmethod
    def load(cls, folder: str | Path) -> TrajectoryMonitor:
        """Read what `save` wrote. Raises InputError if it is no such monitor or is damaged."""
        about, weights = read_model(folder, KIND)
        with refusing(folder, expected="a monitor of trajectories"):
            diagnoser = checked(load_diagnoser(Path(folder) / "diagnoser"))
            arrays = {name: each.numpy() for name, each in weights.items()}
            scores = ConformalScores.of_arrays(arrays, about["copies"])
            twin = twin_of(diagnoser)
            measured = arrays["measured"]
            shapes = len(scores.independent), measured.shape
            expected = f"the calibration of one stream with {len(twin.outputs)} outputs"
            check_weights(shapes == (1, (2, len(twin.outputs))), expected, shapes)
            return cls(
                diagnoser,
                scores,
                Slack(*about["slack"]),
                finite("kappa", about["kappa"], at_least=1.0),
                finite("arl", about["arl"], at_least=MIN_RUN_LENGTH, at_most=MAX_RUN_LENGTH),
                positive("duration", about["duration"], unit="s"),
                measured,
                OffsetModel.of_arrays(arrays, len(twin.inputs)),
                finite("alpha", about["alpha"], at_least=1e-12, at_most=0.5),
                whole("used", about["used"], at_least=0),
                whole("given", about["given"], at_least=0),
            )


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
    diagnoser = checked(checked(diagnoser).with_faults(causes or {}))
    instance("healthy", healthy, Trajectories, remedy="load recorded ones")
    finite("alpha", alpha, at_least=1e-12, at_most=0.5)
    allowed = {HEALTHY, *(name for name, fault in diagnoser.faults.items() if fault is None)}
    faulty = [f"some labelled {name}" for name in sorted(healthy.known_labels - allowed)[:3]]
    expected = f"trajectories without labels, or labelled {' or '.join(sorted(allowed))}"
    nothing("healthy", faulty, expected, remedy="leave these out")
    length = healthy.steps / healthy.rate
    arl = false_alarms(false_alarms_at_most, 1 / length)
    found = compared(diagnoser, healthy, progress)
    used = np.isfinite(found.error) & ~found.outside
    require(
        used.sum() >= MIN_TRAJECTORIES,
        "healthy",
        expected=f"at least {MIN_TRAJECTORIES} trajectories",
        got=f"{len(healthy)}, of which {int(found.unmeasured.sum())} without measured samples, "
        f"{int(found.implausible.sum())} with implausible readings and "
        f"{int(found.outside.sum())} with commands outside their range in training",
        remedy="record more healthy trajectories, with commands as those of the twin's training",
    )
    ratio, count = found.ratio[used], found.measured[used]
    scores = fit_scores(found.error[None, used])
    (slack,) = scores.slack(1)
    some = bool(biases(diagnoser.faults.values()))
    offsets = fit_offsets(found.offset[used]) if some else None
    for kappa in FACTORS[slack.kappa <= FACTORS]:
        factor = factors(ratio, kappa).mean(axis=1)
        bound = factor.mean() + CERTAIN * factor.std(ddof=1) / np.sqrt(len(factor))
        if bound <= 1:
            measured = np.stack([count.min(axis=0), count.max(axis=0)]).astype(float)
            about = float(kappa), arl, length, measured, offsets, float(alpha)
            counts = int(used.sum()), len(healthy)
            return TrajectoryMonitor(diagnoser, scores, slack, *about, *counts)
    likely = alternatives(diagnoser)[int(np.median(ratio, axis=0).argmax())]
    raise InputError(
        "healthy",
        expected="trajectories that the diagnoser takes for healthy ones",
        got=f"some that look like {likely}",
        remedy="leave out faulty ones, or calibrate the twin on more healthy trajectories",
    )
