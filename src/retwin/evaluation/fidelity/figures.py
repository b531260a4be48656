"""`Fidelity`: what was found per trajectory, and the figures with intervals that sum it up.

The unit is the trajectory: samples within one are alike. Intervals come from drawing trajectories
again. Where a figure would not be at its best even for a perfect generator, because there are few
trajectories, the twin's own draws stand in for the measured ones and tell what such a one reaches.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Channels
from retwin.scores.bootstrap import bootstrap_weights
from retwin.serialisation.files import write_atomically

__all__ = ["BINS", "LEVELS", "Fidelity", "Figure"]

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
BINS = 100
RESAMPLED = 2000
ENOUGH = 8
"""Trajectories below which a classifier has too little to learn from."""
GRID = 512
"""Values at most at which two distributions of a movement's figure are compared."""
_PER_TRAJECTORY = (
    "ids",
    "nominal",
    "observed",
    "seen",
    "bands",
    "crps",
    "energy",
    "pit",
    "movements",
    "features",
    "widening",
)


@dataclass(frozen=True)
class Figure:
    """One figure with its 95 % bootstrap interval over trajectories, and a p-value if it has one.

    `p` is the share of perfect generators that look at least as bad: each of the twin's draws in
    turn taken for the measured one. So it holds however alike the samples of a trajectory are.
    """

    value: float
    interval: tuple[float, float] | None = None
    p: float | None = None


@dataclass(frozen=True, eq=False)
class Fidelity:
    """n trajectories at P moments in d outputs, judged; `figures` sums them up.

    Attributes
    ----------
    outputs, rate, draws: names and units, samples per second, simulations per trajectory.
    movement: names and units of what is told per movement: z*, then `noise_*`, the standard
        deviation of each output in the second half of the steady part.
    ids: (n,).
    nominal, observed, seen: (n, P, d), (n, P, d) and (n, P) bool: ideal, measured, and where.
    bands: (n, 5, P, d), the 5, 25, 50, 75 and 95 % quantiles of the draws.
    crps, energy: (n, d) in each output's unit, and (n,), root mean square over samples.
    rivals: name to the same two of another twin.
    pit: (n, 1 + 99, d, 100), shares of the PIT in bins of 0.01, of the measured trajectory and of
        draws held against the others.
    movements: (n, 1 + 19, M, k), measured and drawn; NaN where outputs do not tell it.
    features: (n, 1 + 19, F), by which a classifier may tell measured from drawn.
    widening: (n,), factor of the widened bands, NaN for none.

    """

    outputs: Channels
    movement: Channels
    rate: float
    draws: int
    ids: NDArray
    nominal: NDArray
    observed: NDArray
    seen: NDArray
    bands: NDArray
    crps: NDArray
    energy: NDArray
    rivals: Mapping[str, tuple[NDArray, NDArray]]
    pit: NDArray
    movements: NDArray
    features: NDArray
    widening: NDArray

    def __len__(self) -> int:
        return len(self.ids)

    def __str__(self) -> str:
        told = ", ".join(f"{name} {each.value:.4g}" for name, each in self.figures.items())
        return f"{told} ({len(self)} trajectories)"

    @classmethod
    def concatenate(cls, parts: Sequence[Fidelity]) -> Fidelity:
        """Several sets of trajectories as one, each judged by the twin it was given to."""
        most = max(part.movements.shape[2] for part in parts)
        wide = [replace(part, movements=_lengthened(part.movements, most)) for part in parts]
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in wide]) for name in _PER_TRAJECTORY
        }
        rivals = {
            name: (
                np.concatenate([part.rivals[name][0] for part in parts]),
                np.concatenate([part.rivals[name][1] for part in parts]),
            )
            for name in parts[0].rivals
        }
        return replace(parts[0], rivals=rivals, **arrays)

    def save(self, file: str | Path) -> None:
        """Write an NPZ file; `load` reads it."""
        arrays = {name: getattr(self, name) for name in _PER_TRAJECTORY}
        for name, (crps, energy) in self.rivals.items():
            arrays |= {f"rival/{name}/crps": crps, f"rival/{name}/energy": energy}
        for name in ("outputs", "movement"):
            told: Channels = getattr(self, name)
            arrays[name] = np.array([told.names, told.units])
        about = {"rate": np.array(self.rate), "draws": np.array(self.draws)}
        with write_atomically(Path(file)) as part:
            np.savez_compressed(part, allow_pickle=False, **arrays, **about)

    @classmethod
    def load(cls, file: str | Path) -> Fidelity:
        """Read what `save` wrote."""
        with np.load(file, allow_pickle=False) as found:
            names = [key.split("/")[1] for key in found.files if key.endswith("/crps")]
            outputs, movement = (
                Channels(*(tuple(row.tolist()) for row in found[name]))
                for name in ("outputs", "movement")
            )
            return cls(
                outputs=outputs,
                movement=movement,
                rate=float(found["rate"]),
                draws=int(found["draws"]),
                rivals={
                    name: (found[f"rival/{name}/crps"], found[f"rival/{name}/energy"])
                    for name in names
                },
                **{name: found[name] for name in _PER_TRAJECTORY},
            )

    def inside(self, level: int, *, widened: bool = False) -> NDArray:
        """Share (n, d) of each trajectory's points inside its central 50 or 90 % band."""
        low, high = (self.bands[:, i] for i in ((1, 3) if level == 50 else (0, 4)))
        if widened:
            factor, middle = self.widening[:, None, None], self.bands[:, 2]
            low, high = middle + factor * (low - middle), middle + factor * (high - middle)
        hit = (low <= self.observed) & (self.observed <= high) & self.seen[..., None]
        share: NDArray = hit.sum(axis=1) / self.seen.sum(axis=1)[:, None]
        return share

    @cached_property
    def figures(self) -> dict[str, Figure]:
        """Every figure by its name; see docs/theory.md, How a generator is scored."""
        found = {"energy": self._mean(self.energy)}
        for c, name in enumerate(self.outputs.names):
            found[f"crps/{name}"] = self._mean(self.crps[:, c])
        for name, (crps, energy) in self.rivals.items():
            found |= self._against(name, crps, energy)
        for level in (50, 90):
            found[f"coverage{level}"] = self._mean(self.inside(level).mean(axis=1))
        if np.isfinite(self.widening).all():
            widened = self.inside(90, widened=True)
            found["coverage90_widened"] = self._mean(widened.mean(axis=1))
        found["pit"] = self._pit()
        for k, name in enumerate(self.movement.names):
            found |= self._of_movements(name, self.movements[..., k])
        return found | self._classifier()

    def as_dict(self) -> dict[str, Any]:
        """Everything but the arrays, as plain JSON values."""
        told = np.isfinite(self.movements[:, 0]).any(axis=-1)
        return {
            "trajectories": len(self),
            "draws": self.draws,
            "rate": self.rate,
            "outputs": list(self.outputs.names),
            "units": list(self.outputs.units),
            "movement": list(self.movement.names),
            "movement_units": list(self.movement.units),
            "movements": int(told.sum()),
            "rivals": list(self.rivals),
            "widening": float(self.widening.mean()) if np.isfinite(self.widening).all() else None,
            "figures": {
                name: {
                    "value": each.value,
                    "interval": None if each.interval is None else list(each.interval),
                    "p": each.p,
                }
                for name, each in self.figures.items()
            },
        }

    def pit_shares(self, bins: int = 20) -> NDArray:
        """(3, bins) shares of the PIT, all outputs together: of the measured trajectories, and the
        5 and 95 % quantiles of what perfect generators show on as many.
        """
        pooled = self.pit.mean(axis=(0, 2))
        shares = pooled.reshape(len(pooled), bins, -1).sum(axis=2)
        return np.stack([shares[0], *np.quantile(shares[1:], [0.05, 0.95], axis=0)])

    @cached_property
    def _weights(self) -> NDArray:
        """(RESAMPLED, n), how much each trajectory counts in each drawing."""
        one = np.zeros(len(self), dtype=int)
        return bootstrap_weights(one, draws=RESAMPLED, seed=0) / len(self)

    def _mean(self, values: NDArray) -> Figure:
        return self._figure(lambda weights: weights @ values)

    def _figure(self, of: Callable[[NDArray], NDArray], p: float | None = None) -> Figure:
        """`of` gives the figure (b,) when trajectory i has the weight weights[:, i], (b, n)."""
        value = float(of(np.full((1, len(self)), 1 / len(self)))[0])
        if len(self) < 2 or not np.isfinite(value):
            return Figure(value, None, p)
        low, high = np.nanquantile(of(self._weights), [0.025, 0.975])
        return Figure(value, (float(low), float(high)), p)

    def _distance(self, of: Callable[[NDArray], NDArray], p: float) -> Figure:
        """The same for a distance. It grows when trajectories repeat: that bias is taken off."""
        plain = self._figure(of, p)
        if plain.interval is None:
            return plain
        bias = float(np.nanmean(of(self._weights))) - plain.value
        low, high = (min(max(0.0, end - bias), 1.0) for end in plain.interval)
        return Figure(plain.value, (low, high), p)

    def _against(self, name: str, crps: NDArray, energy: NDArray) -> dict[str, Figure]:
        """Scores of another twin, and by which share this one's are below them, paired."""
        found = {f"energy/{name}": self._mean(energy)}
        for c, output in enumerate(self.outputs.names):
            found[f"crps/{output}/{name}"] = self._mean(crps[:, c])
            found[f"crps_below/{output}/{name}"] = self._below(self.crps[:, c], crps[:, c])
        found[f"crps_below/{name}"] = self._below(self.crps, crps)
        found[f"energy_below/{name}"] = self._below(self.energy, energy)
        return found

    def _below(self, ours: NDArray, theirs: NDArray) -> Figure:
        """By which share our mean is below theirs, averaged over outputs if there are several.

        None of nothing, where neither errs at all.
        """

        def share(w: NDArray) -> NDArray:
            a, b = w @ ours, w @ theirs
            return ((b - a) / np.where(b == 0, 1, b)).reshape(len(w), -1).mean(axis=1)

        return self._figure(share)

    def _pit(self) -> Figure:
        """The greatest gap between the cumulative PIT and a uniform one."""
        cumulative = self.pit.mean(axis=2).cumsum(axis=2)
        uniform = np.arange(1, BINS + 1) / BINS
        each = np.abs(cumulative.mean(axis=0) - uniform).max(axis=1)
        return self._distance(
            lambda w: np.abs(w @ cumulative[:, 0] - uniform).max(axis=1), p=_share(each)
        )

    def _of_movements(self, name: str, values: NDArray) -> dict[str, Figure]:
        """KS distance of measured and drawn values (n, 1 + 19, M); coverage where it is z*."""
        known = np.isfinite(values)
        if not (known[:, 0].any() and known[:, 1:].any()):
            return {}
        grid = np.unique(values[known])
        grid = grid[:: -(-len(grid) // GRID)]
        below = (values[..., None] <= grid).sum(axis=2).astype(float)
        count = known.sum(axis=2)[..., None].astype(float)

        def gap(weights: NDArray, member: int) -> NDArray:
            others = np.arange(values.shape[1]) != member
            with np.errstate(invalid="ignore", divide="ignore"):
                one = (weights @ below[:, member]) / (weights @ count[:, member])
                rest = (weights @ below[:, others].sum(1)) / (weights @ count[:, others].sum(1))
            distance: NDArray = np.abs(one - rest).max(axis=1)
            return distance

        whole = np.ones((1, len(self)))
        each = np.array([gap(whole, member)[0] for member in range(values.shape[1])])
        found = {f"ks/{name}": self._distance(lambda w: gap(w, 0), p=_share(each))}
        if not name.startswith("noise_"):
            found[f"coverage90/{name}"] = self._range_coverage(values)
        return found

    def _range_coverage(self, values: NDArray) -> Figure:
        """Share of measured values between the least and the greatest of their draws."""
        with warnings.catch_warnings():
            # A movement that no draw tells has no range, and lies outside of it.
            warnings.filterwarnings("ignore", message="All-NaN slice")
            low, high = np.nanmin(values[:, 1:], axis=1), np.nanmax(values[:, 1:], axis=1)
        hit = ((low <= values[:, 0]) & (values[:, 0] <= high)).sum(axis=1)
        count = np.isfinite(values[:, 0]).sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return self._figure(lambda w: (w @ hit) / (w @ count))

    def _classifier(self) -> dict[str, Figure]:
        """AUROC of a forest that never saw the trajectory, or any draw of it, which it judges."""
        if len(self) < ENOUGH:
            return {}
        from sklearn.ensemble import ExtraTreesClassifier
        from sklearn.model_selection import GroupKFold

        n, members, size = self.features.shape
        rows = self.features.reshape(n * members, size)
        measured = np.tile(np.arange(members) == 0, n)
        group = np.repeat(np.arange(n), members)
        scores = np.empty(len(rows))
        for train, test in GroupKFold(min(n, 10)).split(rows, measured, group):
            forest = ExtraTreesClassifier(100, class_weight="balanced", random_state=0)
            forest.fit(rows[train], measured[train])
            scores[test] = forest.predict_proba(rows[test])[:, 1]
        # Within a trajectory, so that commands of their own cannot give the measured one away.
        own, drawn = scores.reshape(n, members)[:, :1], scores.reshape(n, members)[:, 1:]
        return {"auroc": self._mean(((own > drawn) + 0.5 * (own == drawn)).mean(axis=1))}


def _share(distances: NDArray) -> float:
    """Share of perfect generators (all members, the measured one first) at least as far off."""
    known = distances[np.isfinite(distances)]
    return float((known >= distances[0] - 1e-12).mean())


def _lengthened(movements: NDArray, most: int) -> NDArray:
    missing = most - movements.shape[2]
    return np.pad(movements, ((0, 0), (0, 0), (0, missing), (0, 0)), constant_values=np.nan)
