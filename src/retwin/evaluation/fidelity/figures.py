"""`Fidelity`: scores of simulated against measured trajectories, and figures with intervals.

The statistical unit is the trajectory, because samples within one are correlated: intervals are
Student's over trajectories, on the scale of the logarithm for scores and of the logit for shares.
Some figures would not be at their ideal value even for a perfect generator, because there are few
trajectories. For these, each of the twin's draws takes the place of the measured trajectory in
turn, which gives the distribution under a perfect generator.

`StoredArrays`, which `Fidelity` is, writes results of arrays to an NPZ file and reads them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Channels
from retwin.scores.distributions import central_band, cumulative_counts, ks_distance, share_as_far
from retwin.scores.intervals import grouped_share_interval, jackknife_interval
from retwin.serialisation.files import write_atomically


class StoredArrays:
    """The base of a dataclass of arrays, channels, numbers, and pairs of arrays by their names."""

    def save(self, file: str | Path) -> None:
        """Write an NPZ file; `load` reads it."""
        arrays: dict[str, Any] = {}
        for name in get_type_hints(type(self)):
            value = getattr(self, name)
            if isinstance(value, Mapping):
                pairs = [(key, i, own) for key, pair in value.items() for i, own in enumerate(pair)]
                arrays |= {f"{name}/{key}/{i}": own for key, i, own in pairs}
            else:
                is_channels = isinstance(value, Channels)
                arrays[name] = np.array([value.names, value.units] if is_channels else value)
        with write_atomically(Path(file)) as part:
            np.savez_compressed(part, allow_pickle=False, **arrays)

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of several results as one; where some have fewer segments, NaN follows."""
        joined: dict[str, Any] = {}
        for name in get_type_hints(cls):
            values = [getattr(part, name) for part in parts]
            first = joined[name] = values[0]
            if isinstance(first, np.ndarray):
                joined[name] = _concatenate(values)
            elif isinstance(first, Mapping):
                joined[name] = {
                    key: tuple(map(_concatenate, zip(*(each[key] for each in values), strict=True)))
                    for key in first
                }
        return cls(**joined)

    @classmethod
    def load(cls, file: str | Path) -> Self:
        """Read what `save` wrote."""
        values: dict[str, Any] = {}
        with np.load(file, allow_pickle=False) as found:
            for name, kind in get_type_hints(cls).items():
                if get_origin(kind) is Mapping:
                    keys = [
                        each.split("/")[1] for each in found.files if each.startswith(f"{name}/")
                    ]
                    values[name] = {
                        key: (found[f"{name}/{key}/0"], found[f"{name}/{key}/1"])
                        for key in dict.fromkeys(keys)
                    }
                elif kind is Channels:
                    values[name] = Channels(*(tuple(row.tolist()) for row in found[name]))
                else:
                    values[name] = kind(found[name]) if kind in (int, float) else found[name]
        return cls(**values)


def _concatenate(arrays: Sequence[NDArray]) -> NDArray:
    """Arrays along their first axis, filled with NaN up to the largest of the others."""
    shape = np.max([each.shape[1:] for each in arrays], axis=0).astype(int)
    padded = []
    for each in arrays:
        missing = [(0, 0), *((0, n) for n in shape - each.shape[1:])]
        padded.append(np.pad(each, missing, constant_values=np.nan) if np.any(missing) else each)
    return np.concatenate(padded)


BINS = 100
"""Bins of the PIT histograms, which are stored; pages show fewer."""


@dataclass(frozen=True)
class Figure:
    """A figure with its uncertainty.

    Attributes
    ----------
    value : float
        NaN where it is not defined.
    interval : (float, float) or None
        95 % interval over trajectories; None for fewer than five of them.
    p : float or None
        Monte Carlo p-value that the generator is perfect, for figures that have one: the share of
        members, the measured one included, whose figure is at least as bad when each takes the
        place of the measured one in turn. It stays valid where samples are correlated.

    """

    value: float
    interval: tuple[float, float] | None = None
    p: float | None = None


@dataclass(frozen=True, eq=False)
class Fidelity(StoredArrays):
    """Scores of n trajectories at P samples of d outputs; `figures` sums them up.

    Attributes
    ----------
    outputs : Channels
        The d outputs.
    segment_channels : Channels
        Names and units of the k quantities per segment: the components of z, then `noise_*`, the
        standard deviation of each output in the second half of the steady part.
    rate : float
        Sample rate of the comparison in Hz.
    draws : int
        Simulations per trajectory.
    ids : NDArray
        Names of the trajectories (n,).
    nominal, observed : NDArray
        Nominal and measured outputs (n, P, d).
    seen : NDArray
        Whether all outputs of a sample were measured (n, P), bool.
    bands : NDArray
        5, 25, 50, 75 and 95 % quantiles of the draws (n, 5, P, d).
    crps : NDArray
        Mean CRPS of each output (n, d) in its unit.
    energy : NDArray
        Energy score (n,) of a whole trajectory, as a root mean square over samples.
    rivals : mapping of str to (NDArray, NDArray)
        `crps` and `energy` of other twins by name.
    pit : NDArray
        PIT histograms (n, 1 + 99, d, 100) of the measured trajectory and of draws, each among all
        other members.
    segment_values : NDArray
        (n, 1 + 19, M, k), measured and drawn; NaN where outputs do not identify them.
    features : NDArray
        (n, 1 + 19, F), measured and drawn: the input of the classifier two-sample test.
    widening : NDArray
        Factor (n,) of the widened bands; NaN for none.
    at_bound : NDArray
        Share (n,) of the delays at a bound of their range when the twin was calibrated; NaN where
        the correction has none.

    """

    outputs: Channels
    segment_channels: Channels
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
    segment_values: NDArray
    features: NDArray
    widening: NDArray
    at_bound: NDArray

    def __len__(self) -> int:
        return len(self.ids)

    def __str__(self) -> str:
        figures = ", ".join(f"{name} {each.value:.4g}" for name, each in self.figures.items())
        return f"{figures} ({len(self)} trajectories)"

    def inside(self, level: int, *, widened: bool = False) -> NDArray:
        """Share (n, d) of each trajectory's samples inside its central 50 or 90 % band."""
        low, high = central_band(self.bands, level)
        if widened:
            factor, middle = self.widening[:, None, None], self.bands[:, 2]
            low, high = middle + factor * (low - middle), middle + factor * (high - middle)
        hit = (low <= self.observed) & (self.observed <= high) & self.seen[..., None]
        return hit.sum(axis=1) / self.seen.sum(axis=1)[:, None]

    @cached_property
    def figures(self) -> dict[str, Figure]:
        """Every figure by its name; see docs/theory.md, How a generator is scored."""
        found = {"energy": self._positive(self.energy)}
        for c, name in enumerate(self.outputs.names):
            found[f"crps/{name}"] = self._positive(self.crps[:, c])
        for name, (crps, energy) in self.rivals.items():
            found |= self._compare(name, crps, energy)
        for level in (50, 90):
            found[f"coverage{level}"] = _share(self.inside(level).mean(axis=1))
        if np.isfinite(self.widening).all():
            found["coverage90_widened"] = _share(self.inside(90, widened=True).mean(axis=1))
        found["pit"] = self._pit()
        for k, name in enumerate(self.segment_channels.names):
            found |= self._per_segment(name, self.segment_values[..., k])
        return found | self._classifier()

    def as_dict(self) -> dict[str, Any]:
        """Everything but the arrays, as plain JSON values."""
        known = np.isfinite(self.segment_values[:, 0]).any(axis=-1)
        return {
            "trajectories": len(self),
            "draws": self.draws,
            "rate": self.rate,
            "outputs": list(self.outputs.names),
            "units": list(self.outputs.units),
            "movement": list(self.segment_channels.names),
            "movement_units": list(self.segment_channels.units),
            "movements": int(known.sum()),
            "rivals": list(self.rivals),
            "widening": float(self.widening.mean()) if np.isfinite(self.widening).all() else None,
            "at_bound": float(self.at_bound.mean()) if np.isfinite(self.at_bound).all() else None,
            "figures": {name: asdict(each) for name, each in self.figures.items()},
        }

    def pit_shares(self, *, shown_bins: int = 20) -> NDArray:
        """PIT histogram (3, `shown_bins`) over all outputs.

        That of the measured trajectories, and its 5 and 95 % quantiles for a perfect generator on
        as many trajectories.

        Parameters
        ----------
        shown_bins : int, default 20
            Bins of a PIT histogram on a page, of which each joins several of the computed ones.

        """
        pooled = self.pit.mean(axis=(0, 2))
        shares = pooled.reshape(len(pooled), shown_bins, -1).sum(axis=2)
        return np.stack([shares[0], *np.quantile(shares[1:], [0.05, 0.95], axis=0)])

    def _positive(self, values: NDArray) -> Figure:
        """The mean of positive values (n,)."""
        return Figure(
            float(values.mean()), jackknife_interval(lambda w: w @ values, len(self), positive=True)
        )

    def _distance(self, of: Callable[[NDArray], NDArray], p: float) -> Figure:
        """A distance from 0 to 1, which `of` computes (b,) from weights (b, n)."""
        value = float(of(np.full((1, len(self)), 1 / len(self)))[0])
        ends = jackknife_interval(of, len(self))
        interval = None if ends is None else (max(ends[0], 0.0), min(ends[1], 1.0))
        return Figure(value, interval, p)

    def _compare(self, name: str, crps: NDArray, energy: NDArray) -> dict[str, Figure]:
        """Scores of another twin, and the paired relative differences of this one's from them."""
        found = {f"energy/{name}": self._positive(energy)}
        for c, output in enumerate(self.outputs.names):
            found[f"crps/{output}/{name}"] = self._positive(crps[:, c])
            found[f"crps_below/{output}/{name}"] = self._below(self.crps[:, c], crps[:, c])
        found[f"crps_below/{name}"] = self._below(self.crps, crps)
        found[f"energy_below/{name}"] = self._below(self.energy, energy)
        return found

    def _below(self, own: NDArray, other: NDArray) -> Figure:
        """Relative difference (other - own) / other of mean scores, averaged over outputs.

        It is 0 where both scores are 0.
        """

        def ratio(w: NDArray) -> NDArray:
            a, b = w @ own, w @ other
            share = np.where(b == 0, 1 + a, a / np.where(b == 0, 1, b))
            return share.reshape(len(w), -1).mean(axis=1)

        value = 1 - float(ratio(np.full((1, len(self)), 1 / len(self)))[0])
        ends = jackknife_interval(ratio, len(self), positive=True)
        return Figure(value, None if ends is None else (1 - ends[1], 1 - ends[0]))

    def _pit(self) -> Figure:
        """Kolmogorov–Smirnov distance of the PIT from the uniform distribution."""
        cumulative = self.pit.mean(axis=2).cumsum(axis=2)
        uniform = np.arange(1, BINS + 1) / BINS
        each = np.abs(cumulative.mean(axis=0) - uniform).max(axis=1)
        return self._distance(
            lambda w: np.abs(w @ cumulative[:, 0] - uniform).max(axis=1), p=share_as_far(each)
        )

    def _per_segment(
        self, name: str, values: NDArray, *, max_places: int = 512
    ) -> dict[str, Figure]:
        """KS distance of measured and drawn values (n, 1 + 19, M); for z coverage too.

        Parameters
        ----------
        max_places : int, default 512
            Largest number of values at which two distributions are compared, which bounds the
            memory.

        """
        known = np.isfinite(values)
        if not (known[:, 0].any() and known[:, 1:].any()):
            return {}
        below, count = cumulative_counts(values, max_places)
        equal = np.ones((1, len(self)))
        members = range(values.shape[1])
        each = np.array([ks_distance(below, count, equal, member)[0] for member in members])
        distance = self._distance(lambda w: ks_distance(below, count, w, 0), p=share_as_far(each))
        found = {f"ks/{name}": distance}
        if not name.startswith("noise_"):
            found[f"coverage90/{name}"] = self._range_coverage(values)
        return found

    def _range_coverage(self, values: NDArray) -> Figure:
        """Share of measured values within the range of their draws."""
        with warnings.catch_warnings():
            # A segment whose value no draw identifies has no range, and counts as outside.
            warnings.filterwarnings("ignore", message="All-NaN slice")
            low, high = np.nanmin(values[:, 1:], axis=1), np.nanmax(values[:, 1:], axis=1)
        hit = ((low <= values[:, 0]) & (values[:, 0] <= high)).sum(axis=1)
        return _share(hit, np.isfinite(values[:, 0]).sum(axis=1))

    def _classifier(self, *, min_trajectories: int = 8, folds: int = 5) -> dict[str, Figure]:
        """AUROC of a forest that separates measured from drawn, cross-validated by trajectory.

        Parameters
        ----------
        min_trajectories : int, default 8
            Least number of trajectories for the classifier two-sample test: fewer do not train it.
        folds : int, default 5
            Folds of its cross-validation.

        """
        if len(self) < min_trajectories:
            return {}
        from sklearn.ensemble import ExtraTreesClassifier
        from sklearn.model_selection import GroupKFold

        n, members, size = self.features.shape
        rows = self.features.reshape(n * members, size)
        measured = np.tile(np.arange(members) == 0, n)
        group = np.repeat(np.arange(n), members)
        scores = np.empty(len(rows))
        for train, test in GroupKFold(min(n, folds)).split(rows, measured, group):
            forest = ExtraTreesClassifier(100, class_weight="balanced", random_state=0)
            forest.fit(rows[train], measured[train])
            scores[test] = forest.predict_proba(rows[test])[:, 1]
        # Within a trajectory, so that commands cannot reveal the measured one.
        own, drawn = scores.reshape(n, members)[:, :1], scores.reshape(n, members)[:, 1:]
        return {"auroc": _share(((own > drawn) + 0.5 * (own == drawn)).mean(axis=1))}


def _share(hits: NDArray, counts: NDArray | None = None) -> Figure:
    """Successes over trials of all trajectories (n,), by default of one trial each."""
    trials = np.ones(len(hits)) if counts is None else counts
    return Figure(float(hits.sum() / trials.sum()), grouped_share_interval(hits, trials))
