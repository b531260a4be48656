"""What a bundle says of a trajectory: probabilities of the classes, and whether to trust them.

Only numpy: the ONNX export uses it too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.errors import InputError

__all__ = ["CHECKS", "OUTSIDE", "Domain", "Prediction", "Verdicts"]

CHECKS = ("commands", "speed", "outputs", "nominal", "missing", "residual")
"""What the guard looks at, in the order of its scores."""
RANGES = ("low", "high", "speed", "floor", "ceiling", "spread")
TOLERANCE = 0.02
"""Share of a range by which a value may leave it and still be usual."""
UNMEASURED = 0.25
"""Share of missing measurements that is usual at most."""
OUTSIDE = 10.0
"""A trajectory is outside when a score is so many times what is usual."""


@dataclass(frozen=True, eq=False)
class Verdicts:
    """How far n trajectories can be trusted to be of the kind that the bundle was made for.

    Attributes
    ----------
    scores: (n, 6), for each of CHECKS, how many times its usual limit a trajectory reaches.

    """

    scores: NDArray

    @property
    def suspicion(self) -> NDArray:
        """The largest score (n,)."""
        largest: NDArray = self.scores.max(axis=1)
        return largest

    @property
    def verdict(self) -> NDArray:
        """(n,) "ok"; "unusual" above 1; "outside" above 10: the diagnosis then means nothing."""
        level = (self.suspicion > 1).astype(int) + (self.suspicion > OUTSIDE)
        return np.array(["ok", "unusual", "outside"])[level]

    @property
    def reason(self) -> NDArray:
        """(n,) the check with the largest score; "" where all is ok."""
        worst = np.array(CHECKS)[self.scores.argmax(axis=1)]
        return np.where(self.suspicion > 1, worst, "")


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a bundle says of n trajectories.

    Attributes
    ----------
    classes: names, in the order of the probabilities.
    probabilities: (n, classes).
    verdicts: whether to trust them.

    """

    classes: tuple[str, ...]
    probabilities: NDArray
    verdicts: Verdicts

    @property
    def diagnosis(self) -> NDArray:
        """(n,) the most probable class."""
        return np.array(self.classes)[self.probabilities.argmax(axis=1)]


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

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    speed: tuple[float, ...]
    floor: tuple[float, ...]
    ceiling: tuple[float, ...]
    spread: tuple[float, ...]
    mismatch: float = 0.0
    energy: float = 0.0

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
        error = (nominal - predicted) / np.array(self.spread)
        return np.sqrt(np.square(error, dtype=np.float64).mean(axis=(1, 2)))

    def judge(self, trajectories: Trajectories, mismatch: NDArray, energy: NDArray) -> Verdicts:
        """The verdicts on trajectories with this `mismatch` (n,) and `energy` (n,).

        Raises InputError where there are no commands, or other channels.
        """
        if trajectories.commands.shape[2] != len(self.low):
            raise InputError(
                "trajectories.commands",
                expected=f"{len(self.low)} columns: without commands nothing says what is usual",
                got=f"{trajectories.commands.shape[2]}",
                remedy="read the file with its case, which recovers commands",
            )
        speed = np.abs(np.diff(trajectories.commands, axis=1)).max(axis=1)
        columns = {
            "commands": _beyond(trajectories.commands, self.low, self.high),
            "speed": _beyond(speed[:, None], np.zeros(len(self.speed)), self.speed),
            "outputs": _beyond(trajectories.observed, self.floor, self.ceiling, trajectories.mask),
            "nominal": mismatch / self.mismatch,
            "missing": (1 - trajectories.mask.mean(axis=(1, 2))) / UNMEASURED,
            # Energies are log odds: this is by how much the odds are worse than is usual.
            "residual": np.exp(np.clip(energy - self.energy, -50, 50)),
        }
        return Verdicts(np.stack([columns[name] for name in CHECKS], axis=1))


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
