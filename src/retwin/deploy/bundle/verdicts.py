"""What a bundle says of a trajectory: probabilities of the classes, and whether to trust them.

Only numpy: the ONNX export uses it too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError

__all__ = ["CHECKS", "OUTSIDE", "Domain", "Prediction", "Verdicts", "distributions"]

CHECKS = (
    *("commands", "speed", "outputs", "nominal", "missing", "length", "residual"),
    "probabilities",
)
"""The checks, in the order of their scores; the last one is of the diagnoser's output."""
RANGES = ("low", "high", "speed", "floor", "ceiling", "spread")
TOLERANCE = 0.02
"""Share of a range by which a value may leave it and still be usual."""
UNMEASURED = 0.25
"""Share of missing measurements that is usual at most."""
LENGTHS = 2.0
"""A trajectory may usually be so many times longer or shorter than those of the bundle."""
OUTSIDE = 10.0
"""A trajectory is outside when a score is so many times what is usual."""
SUM = 1e-3
"""Greatest difference from one of the sum of a trajectory's probabilities."""

Function = Callable[[Trajectories], NDArray]
"""Numbers (n,) or (n, k) of n trajectories."""


@dataclass(frozen=True, eq=False)
class Verdicts:
    """How far n trajectories can be trusted to be of the kind that the bundle was made for.

    Attributes
    ----------
    scores: (n, 8), for each of CHECKS, how many times its usual limit a trajectory reaches; 0 where
        it was not computed, because an earlier check had found the trajectory outside. A score
        that is not finite counts as infinite.

    """

    scores: NDArray

    @property
    def suspicion(self) -> NDArray:
        """The largest score (n,), infinite where one is not finite."""
        largest: NDArray = self._finite.max(axis=1)
        return largest

    @property
    def verdict(self) -> NDArray:
        """(n,) "ok"; "unusual" above 1; "outside" above 10: the diagnosis then means nothing."""
        level = (self.suspicion > 1).astype(int) + (self.suspicion > OUTSIDE)
        return np.array(["ok", "unusual", "outside"])[level]

    @property
    def reason(self) -> NDArray:
        """(n,) the check with the largest score; "" where all is ok."""
        worst = np.array(CHECKS)[self._finite.argmax(axis=1)]
        return np.where(self.suspicion > 1, worst, "")

    @property
    def _finite(self) -> NDArray:
        """The scores, infinite where they are not finite: NaN compares as if it were usual."""
        return np.where(np.isfinite(self.scores), self.scores, np.inf)


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a bundle says of n trajectories.

    Attributes
    ----------
    classes: names, in the order of the probabilities.
    probabilities: (n, classes), NaN for a trajectory that is outside.
    verdicts: whether to trust them; outside where the given probabilities are not finite, not
        between 0 and 1, or do not sum to one.

    """

    classes: tuple[str, ...]
    probabilities: NDArray
    verdicts: Verdicts

    def __post_init__(self) -> None:
        outside = self.verdicts.verdict == "outside"
        unsound = ~(distributions(self.probabilities) | outside)
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
        """With the `probabilities` of the trajectories that are not outside: no others are run."""
        rows = verdicts.verdict != "outside"
        found = np.full((len(trajectories), len(classes)), np.nan)
        if rows.any():
            found[rows] = probabilities(_some(trajectories, rows))
        return cls(classes, found, verdicts)

    @property
    def diagnosis(self) -> NDArray:
        """(n,) the most probable class; "" for a trajectory that is outside."""
        best = np.array(self.classes)[self.probabilities.argmax(axis=1)]
        return np.where(self.verdicts.verdict == "outside", "", best)


@dataclass(frozen=True)
class Domain:
    """What a bundle was made for, in plain numbers.

    Attributes
    ----------
    low, high: least and greatest command of each input, in its unit.
    speed: greatest change of each command from sample to sample.
    floor, ceiling: least and greatest observed value of each output.
    spread: standard deviation of each nominal output, of the first set.
    mismatch: difference of nominal output and surrogate that is usual at most, in spreads.
    energy: the guard's energy that is usual at most.

    Raises
    ------
    InputError: a number, or the width of a range, that is not finite.

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
        with np.errstate(over="ignore", invalid="ignore"):
            widths = [
                np.subtract(self.high, self.low),
                np.subtract(self.ceiling, self.floor),
            ]
        numbers = [getattr(self, each.name) for each in fields(self)]
        if not all(np.isfinite(each).all() for each in [*numbers, *widths]):
            raise InputError(
                "domain",
                expected="finite ranges and limits",
                got=f"{self}",
                remedy="make the bundle and its export anew",
            )

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Domain:
        """From the values that `asdict` gave, JSON lists or tuples alike."""
        return cls(
            **{name: _plain(values[name]) for name in RANGES},
            mismatch=float(values["mismatch"]),
            energy=float(values["energy"]),
        )

    @classmethod
    def around(cls, sets: Sequence[Trajectories]) -> Domain:
        """The ranges that these sets cover; limits of mismatch and energy stay open."""
        seen = [np.ma.array(each.observed, mask=~each.mask) for each in sets]
        speeds = [np.abs(np.diff(each.commands, axis=1)) for each in sets]
        spread = sets[0].nominal.std(axis=(0, 1), dtype=np.float64)
        return cls(
            low=_plain(np.min([each.commands.min(axis=(0, 1)) for each in sets], axis=0)),
            high=_plain(np.max([each.commands.max(axis=(0, 1)) for each in sets], axis=0)),
            speed=_plain(np.max([each.max(axis=(0, 1)) for each in speeds], axis=0)),
            floor=_plain(np.ma.min([each.min(axis=(0, 1)) for each in seen], axis=0).filled(0.0)),
            ceiling=_plain(np.ma.max([each.max(axis=(0, 1)) for each in seen], axis=0).filled(0.0)),
            spread=_plain(_positive(spread)),
        )

    def differences(self, nominal: NDArray, predicted: NDArray) -> NDArray:
        """Root mean square (n,) of nominal minus predicted outputs, in spreads."""
        error = np.subtract(nominal, predicted, dtype=np.float64) / np.array(self.spread)
        return np.sqrt(np.square(error).mean(axis=(1, 2)))

    def judge(
        self,
        trajectories: Trajectories,
        mismatch: Function,
        energy: Function,
        *,
        steps: int | None = None,
    ) -> Verdicts:
        """The verdicts on trajectories.

        Parameters
        ----------
        trajectories: their magnitudes are checked first, in float64.
        mismatch, energy: each is called with the trajectories that no check before it has found
            outside, so that a network only gets numbers of the size that it was trained on.
        steps: samples of the trajectories that the bundle was made for; by default any number.

        Raises InputError where there are no commands, or other channels.

        """
        if trajectories.commands.shape[2] != len(self.low):
            raise InputError(
                "trajectories.commands",
                expected=f"{len(self.low)} columns: without commands nothing says what is usual",
                got=f"{trajectories.commands.shape[2]}",
                remedy="read the file with its case, which recovers commands",
            )

        def nominal(some: Trajectories) -> NDArray:
            return mismatch(some) / self.mismatch

        def residual(some: Trajectories) -> NDArray:
            # Energies are log odds: this is by how much the odds are worse than is usual.
            energies = energy(some)
            worse = np.exp(np.clip(energies - self.energy, -50, 50))
            return np.where(np.isfinite(energies), worse, np.inf)

        # What overflows is not finite, and what is not finite is outside.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            columns = self._magnitudes(trajectories, steps or trajectories.steps)
            empty = np.zeros(len(trajectories))
            scores = np.stack([columns.get(name, empty) for name in CHECKS], axis=1)
            for name, score in (("nominal", nominal), ("residual", residual)):
                rows = np.all(scores <= OUTSIDE, axis=1)
                if rows.any():
                    scores[rows, CHECKS.index(name)] = score(_some(trajectories, rows))
        return Verdicts(scores)

    def _magnitudes(self, trajectories: Trajectories, steps: int) -> dict[str, NDArray]:
        """The scores (n,) that need no network, by check."""
        speed = np.abs(np.diff(trajectories.commands.astype(np.float64), axis=1)).max(axis=1)
        there = trajectories.mask.mean(axis=(1, 2))
        ratio = max(trajectories.steps / steps, steps / trajectories.steps)
        # The limit of nominal outputs is their mismatch. Here is only excluded what would overflow:
        # more than a whole range beyond the range of the observed ones.
        far = _beyond(trajectories.nominal, self.floor, self.ceiling) > 1 / TOLERANCE
        return {
            "commands": _beyond(trajectories.commands, self.low, self.high),
            "speed": _beyond(speed[:, None], np.zeros(len(self.speed)), self.speed),
            "outputs": _beyond(trajectories.observed, self.floor, self.ceiling, trajectories.mask),
            "nominal": np.where(far, np.inf, 0.0),
            "missing": np.where(there > 0, (1 - there) / UNMEASURED, np.inf),
            "length": np.full(len(trajectories), ratio / LENGTHS),
        }


def _some(trajectories: Trajectories, rows: NDArray) -> Trajectories:
    """The trajectories at these flags (n,), without a copy where they are all."""
    return trajectories if rows.all() else trajectories[rows]


def distributions(probabilities: NDArray) -> NDArray:
    """Which rows (n,) are probabilities that sum to one; NaN and infinities compare false."""
    between = np.all((probabilities >= 0) & (probabilities <= 1), axis=1)
    sound: NDArray = between & (np.abs(probabilities.sum(axis=1) - 1) <= SUM)
    return sound


def _beyond(values: NDArray, low: Any, high: Any, mask: NDArray | None = None) -> NDArray:
    """How far (n,) values (n, T, d) leave their range at most, in tolerated shares of it."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    over = np.maximum(low - values, values - high) / _positive(high - low)
    if mask is not None:
        over = np.where(mask, over, 0.0)
    farthest: NDArray = np.maximum(over, 0.0).max(axis=(1, 2)) / TOLERANCE
    return farthest


def _positive(sizes: NDArray) -> NDArray:
    """The sizes, 1 where one is 0: a channel that never varies has no unit of its own."""
    return np.where(sizes > 0, sizes, 1.0)


def _plain(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
