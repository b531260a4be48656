"""Predictions of a bundle: class probabilities, and checks of whether to trust them.

Only numpy is needed, so that the ONNX export uses the same checks as the bundle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from retwin.arrays import floats
from retwin.checks import agree, given, require
from retwin.data.trajectories import UNKNOWN, Trajectories
from retwin.twins.commands.range import TOLERANCE, excess, extremes
from retwin.twins.twin import Twin

T = TypeVar("T")
CHECKS = (
    *("commands", "speed", "outputs", "nominal", "missing", "length", "residual"),
    "probabilities",
)
"""Names of the checks, in the order of their scores; the last checks the diagnoser's output."""
COMMANDS, OUTPUTS = ("low", "high", "speed"), ("floor", "ceiling", "spread")
"""Fields of `Domain` that have one number per command, and per output."""
OUTSIDE = 10.0
"""Score, in multiples of a check's limit, above which a trajectory is outside."""

Function = Callable[[Trajectories], NDArray]
"""Function of n trajectories to numbers (n,) or (n, k)."""


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Scores of n trajectories in the guard's checks, and the verdicts that follow from them.

    Attributes
    ----------
    scores : ndarray, shape (n, 8)
        For each of `CHECKS`, a trajectory's value divided by the check's limit, at least 0. A score
        is 0 if it was not computed because an earlier check had found the trajectory outside, and
        counts as infinite if it is not finite.

    """

    scores: NDArray

    @property
    def max_score(self) -> NDArray:
        """The largest score of each trajectory (n,), infinite if one is not finite."""
        return self._ordered.max(axis=1)

    @property
    def verdict(self) -> NDArray:
        """Verdicts (n,): "outside" for scores above 10, "unusual" above 1, "ok" otherwise."""
        level = (self.max_score > 1).astype(int) + (self.max_score > OUTSIDE)
        return np.array(["ok", "unusual", "outside"])[level]

    @property
    def reason(self) -> NDArray:
        """Names (n,) of the checks with the largest score; "" if the verdict is "ok"."""
        worst = np.array(CHECKS)[self._ordered.argmax(axis=1)]
        return np.where(self.max_score > 1, worst, "")

    @property
    def _ordered(self) -> NDArray:
        """The scores with infinity for NaN, which no comparison finds large."""
        return np.where(np.isfinite(self.scores), self.scores, np.inf)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Class probabilities and verdicts of n trajectories.

    Attributes
    ----------
    classes : tuple of str
        Names, in the order of the probabilities.
    probabilities : ndarray, shape (n, len(classes))
        Probabilities, NaN for a trajectory that is outside.
    verdicts : Verdicts
        Verdicts; a trajectory is also outside if the given probabilities are not finite, not
        between 0 and 1, or do not sum to 1.

    """

    classes: tuple[str, ...]
    probabilities: NDArray
    verdicts: Verdicts

    def __post_init__(self) -> None:
        outside = self.verdicts.verdict == "outside"
        unsound = ~(are_probabilities(self.probabilities) | outside)
        scores = self.verdicts.scores.copy()
        scores[unsound, CHECKS.index("probabilities")] = np.inf
        empty = (outside | unsound)[:, None]
        object.__setattr__(self, "verdicts", Verdicts(scores))
        object.__setattr__(self, "probabilities", np.where(empty, np.nan, self.probabilities))

    @classmethod
    def of(
        cls,
        classes: tuple[str, ...],
        verdicts: Verdicts,
        trajectories: Trajectories,
        probabilities: Function,
    ) -> Prediction:
        """A prediction for which `probabilities` is called only with trajectories not outside."""
        rows = verdicts.verdict != "outside"
        found = np.full((len(trajectories), len(classes)), np.nan)
        if rows.any():
            found[rows] = probabilities(_subset(trajectories, rows))
        return cls(classes, found, verdicts)

    @property
    def diagnosis(self) -> NDArray:
        """The most probable class of each trajectory (n,); "unknown" if it is outside."""
        best = np.array(self.classes)[self.probabilities.argmax(axis=1)]
        return np.where(self.verdicts.verdict == "outside", UNKNOWN, best)


@dataclass(frozen=True)
class Domain:
    """The ranges and limits of the trajectories that a bundle was made for.

    Attributes
    ----------
    low, high : tuple of float
        Least and greatest value of each command, in its unit.
    speed : tuple of float
        Greatest change of each command from one sample to the next, in its unit.
    floor, ceiling : tuple of float
        Least and greatest observed value of each output, in its unit.
    spread : tuple of float
        Standard deviation of each nominal output, in its unit.
    mismatch : float
        Limit of the root mean square difference between nominal output and surrogate, in spreads.
    energy : float
        Limit of the guard's energy, in log odds.

    Raises
    ------
    InputError
        If a number, or the width of a range, is not finite, or a width or limit is negative; or if
        one per channel is missing.

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    speed: tuple[float, ...]
    floor: tuple[float, ...]
    ceiling: tuple[float, ...]
    spread: tuple[float, ...]
    mismatch: float = 0.0
    energy: float = 0.0

    def __post_init__(self) -> None:
        counts = [[len(getattr(self, name)) for name in names] for names in (COMMANDS, OUTPUTS)]
        fits = all(len(set(each)) == 1 for each in counts)
        expected = "one number per channel in every range"
        remedy = "make the bundle and its export anew"
        require(fits, "domain", expected=expected, got=counts, remedy=remedy)
        with np.errstate(over="ignore", invalid="ignore"):
            widths = [np.subtract(self.high, self.low), np.subtract(self.ceiling, self.floor)]
        numbers = [getattr(self, each.name) for each in fields(self)]
        sizes = [*widths, self.speed, self.spread, self.mismatch]
        sound = all(np.isfinite(each).all() for each in [*numbers, *widths]) and all(
            np.greater_equal(each, 0).all() for each in sizes
        )
        expected = "finite ranges and limits, none of them negative"
        remedy = "make the bundle and its export anew"
        require(sound, "domain", expected=expected, got=self, remedy=remedy)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Domain:
        """The domain from the values of `dataclasses.asdict`, with JSON lists or tuples."""
        return TypeAdapter(cls).validate_python(values)

    @classmethod
    def around(cls, sets: Sequence[Trajectories]) -> Domain:
        """The ranges that these sets cover, spreads of the first one; both limits are 0."""
        measured = [np.ma.array(each.observed, mask=~each.mask) for each in sets]
        speeds = [np.abs(np.diff(each.commands, axis=1)) for each in sets]
        spread = sets[0].nominal.std(axis=(0, 1), dtype=np.float64)
        floors, ceilings = (
            [getattr(each, end)(axis=(0, 1)) for each in measured] for end in ("min", "max")
        )
        return cls(
            low=floats(np.min([each.commands.min(axis=(0, 1)) for each in sets], axis=0)),
            high=floats(np.max([each.commands.max(axis=(0, 1)) for each in sets], axis=0)),
            speed=floats(np.max([each.max(axis=(0, 1)) for each in speeds], axis=0)),
            floor=floats(np.ma.min(floors, axis=0).filled(0.0)),
            ceiling=floats(np.ma.max(ceilings, axis=0).filled(0.0)),
            spread=floats(np.where(spread > 0, spread, 1.0)),  # 1 where an output never varies
        )

    def differences(self, nominal: NDArray, predicted: NDArray) -> NDArray:
        """Root mean square difference of outputs (n, T, d_y) per trajectory (n,), in spreads."""
        error = np.subtract(nominal, predicted, dtype=np.float64) / np.array(self.spread)
        return np.sqrt(np.square(error).mean(axis=(1, 2)))

    def assess(
        self,
        trajectories: Trajectories,
        mismatch: Function,
        energy: Function,
        *,
        steps: int | None = None,
        max_log_odds: float = 50.0,
    ) -> Verdicts:
        """Score trajectories in all checks but the last.

        Magnitudes are checked first, in float64. A network therefore only gets numbers of the size
        that it was trained on.

        Parameters
        ----------
        trajectories : Trajectories
            The n trajectories.
        mismatch, energy : callable
            Functions of trajectories to numbers (n,), called only with the trajectories that no
            check before has found outside.
        steps : int, optional
            Samples of the trajectories that the bundle was made for; by default any number.
        max_log_odds : float, default 50.0
            Bound of the log odds before `exp`, far beyond every limit and below any overflow.

        Raises
        ------
        InputError
            If commands or outputs have another number of channels.

        """
        require(
            trajectories.commands.shape[2] == len(self.low),
            "trajectories.commands",
            expected=f"{len(self.low)} columns, since the ranges of commands are checked",
            got=trajectories.commands.shape[2],
            remedy="read the file with its case, which recovers commands",
        )
        fits = trajectories.nominal.shape[2] == len(self.floor)
        expected = f"ranges of {trajectories.nominal.shape[2]} outputs"
        remedy = "make the bundle and its export anew"
        require(fits, "domain", expected=expected, got=f"those of {len(self.floor)}", remedy=remedy)

        def nominal(some: Trajectories) -> NDArray:
            return mismatch(some) / self.mismatch

        def residual(some: Trajectories) -> NDArray:
            # Energies are log odds, so this is the ratio of the odds to those at the limit.
            energies = energy(some)
            odds = np.exp(np.clip(energies - self.energy, -max_log_odds, max_log_odds))
            return np.where(np.isfinite(energies), odds, np.inf)

        # What overflows is not finite, and what is not finite is outside.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            columns = self._magnitudes(trajectories, steps or trajectories.steps)
            empty = np.zeros(len(trajectories))
            scores = np.stack([columns.get(name, empty) for name in CHECKS], axis=1)
            for name, score in (("nominal", nominal), ("residual", residual)):
                rows = np.all(scores <= OUTSIDE, axis=1)
                if rows.any():
                    scores[rows, CHECKS.index(name)] = score(_subset(trajectories, rows))
        return Verdicts(scores)

    def _magnitudes(self, trajectories: Trajectories, steps: int) -> dict[str, NDArray]:
        """The scores (n,) that need no network, by check."""
        speed = extremes(trajectories.commands)[2]
        measured = trajectories.mask.mean(axis=(1, 2))
        ratio = max(trajectories.steps / steps, steps / trajectories.steps)
        # The limit of nominal outputs is their mismatch. Excluded here is only what would overflow:
        # more than a whole range beyond the range of the observed outputs.
        far = _excess(trajectories.nominal, self.floor, self.ceiling) > 1 / TOLERANCE
        # Limit of the share of missing measurements.
        # Limit of the ratio between a trajectory's length and that of the bundle's, or its inverse.
        return {
            "commands": _excess(trajectories.commands, self.low, self.high),
            "speed": _excess(speed[:, None], np.zeros(len(self.speed)), self.speed),
            "outputs": _excess(trajectories.observed, self.floor, self.ceiling, trajectories.mask),
            "nominal": np.where(far, np.inf, 0.0),
            "missing": np.where(measured > 0, (1 - measured) / 0.25, np.inf),
            "length": np.full(len(trajectories), ratio / 2.0),
        }


def present_diagnoser(diagnoser: T | None) -> T:
    """The diagnoser of a bundle, or of its export, that is to predict."""
    remedy = "train a diagnoser, then make the bundle and its export anew"
    return given("bundle", diagnoser, "one with a diagnoser", got="one without", remedy=remedy)


def check_channels(trajectories: Trajectories, model: Twin) -> None:
    """Raise InputError unless inputs, outputs and rate of the trajectories are the model's."""
    remedy = "resample or rename, and read files with their case, which recovers commands"
    agree("trajectories", trajectories, model, "what the bundle was made for", remedy=remedy)


def _subset(trajectories: Trajectories, rows: NDArray) -> Trajectories:
    """The trajectories at these flags (n,), not copied if the flags are all true."""
    return trajectories if rows.all() else trajectories[rows]


def are_probabilities(values: NDArray, *, sum_tolerance: float = 1e-3) -> NDArray:
    """Flags (n,) of the rows (n, classes) that are between 0 and 1 and sum to 1; NaN is false.

    Parameters
    ----------
    sum_tolerance : float, default 1e-3
        Greatest difference from 1 of the sum of probabilities, far above the rounding of float32.

    """
    between = np.all((values >= 0) & (values <= 1), axis=1)
    return between & (np.abs(values.sum(axis=1) - 1) <= sum_tolerance)


def _excess(values: NDArray, low: Any, high: Any, mask: NDArray | None = None) -> NDArray:
    """How far (n,) values (n, T, d) leave their range at most, in tolerated shares of its width."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if mask is not None:
        values = np.where(mask, values, low)
    least, greatest, _ = extremes(values)
    return excess(least, greatest, low, high).max(axis=1)
