"""Numbers behind the figures: ROC curves over runs, binned latents, the floor of the ECE."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.report.results import Results
from retwin.report.words import quantity

__all__ = ["Band", "Latent", "Roc", "bands", "ece_floor", "latents", "micro_roc"]

GRID = np.linspace(0, 1, 201)


@dataclass(frozen=True)
class Roc:
    """Micro-averaged ROC over runs: false positive rate, mean true positive rate, its spread."""

    rate: NDArray
    mean: NDArray
    spread: NDArray
    areas: NDArray

    @property
    def band(self) -> tuple[NDArray, NDArray]:
        """Mean ± one standard deviation, inside [0, 1]."""
        return np.clip(self.mean - self.spread, 0, 1), np.clip(self.mean + self.spread, 0, 1)


def micro_roc(probabilities: NDArray, truth: NDArray) -> Roc:
    """ROC of (runs, n, classes) with every (trajectory, class) pair taken as one decision."""
    positive = (truth[:, None] == np.arange(probabilities.shape[2])).ravel()
    curves, areas = [], []
    for scores in probabilities:
        false, true = _roc(scores.ravel(), positive)
        areas.append(np.trapezoid(true, false))
        # Where the curve rises straight up, its upper end counts.
        last = np.append(np.flatnonzero(np.diff(false)), len(false) - 1)
        curves.append(np.interp(GRID, false[last], true[last]))
    stacked = np.array(curves)
    spread = stacked.std(axis=0, ddof=1) if len(stacked) > 1 else np.zeros(len(GRID))
    return Roc(GRID, stacked.mean(axis=0), spread, np.array(areas))


def _roc(scores: NDArray, positive: NDArray) -> tuple[NDArray, NDArray]:
    falling = np.argsort(-scores, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(scores[falling])), len(scores) - 1)
    true = np.cumsum(positive[falling])[ends]
    false = ends + 1 - true
    return np.r_[0, false] / max(false[-1], 1), np.r_[0, true] / max(true[-1], 1)


def ece_floor(probabilities: NDArray, *, draws: int = 200, bins: int = 10) -> float:
    """ECE that a perfectly calibrated classifier with these confidences would still show.

    Whether each answer is right is drawn with its confidence as the chance; the mean of the
    top-label ECE over equal-mass bins is the floor, which comes from few trajectories alone.
    """
    rng = np.random.default_rng(0)
    floors = []
    for confidence in np.sort(probabilities.max(axis=2), axis=1):
        right = rng.random((draws, len(confidence))) < confidence
        gaps = np.zeros(draws)
        for bin_ in np.array_split(np.arange(len(confidence)), bins):
            if len(bin_):
                gap = right[:, bin_].mean(axis=1) - confidence[bin_].mean()
                gaps += len(bin_) / len(confidence) * np.abs(gap)
        floors.append(gaps.mean())
    return float(np.mean(floors))


@dataclass(frozen=True)
class Latent:
    """One latent in bins that observed and predicted share; what lies outside is counted.

    The shares are of all values, so the bars of each sum to the part that is inside.
    """

    name: str
    unit: str
    edges: NDArray
    observed: NDArray
    predicted: NDArray
    counts: tuple[int, int]
    outside: tuple[int, int]


def latents(results: Results, source: str) -> list[Latent]:
    """All that is told per movement and of which the arrays hold measured and generated values."""
    observed = results.arrays.get(f"z/{source}/observed")
    predicted = results.arrays.get(f"z/{source}/predicted")
    if observed is None or predicted is None:
        return []
    told = results.fidelity[source]
    units = [*told.movement_units, *[""] * len(told.movement)]
    found = []
    for column, name in enumerate(told.movement):
        factor, unit = quantity(units[column])
        seen = factor * observed[:, column]
        said = factor * predicted[:, column]
        seen, said = seen[np.isfinite(seen)], said[np.isfinite(said)]
        if len(seen) and len(said):
            found.append(_bin(name, unit, seen, said))
    return found


@dataclass(frozen=True)
class Band:
    """One output of one trajectory, minus the nominal one: measured (P,), quantiles (5, P)."""

    trajectory: str
    output: str
    unit: str
    time: NDArray
    observed: NDArray
    quantiles: NDArray


def bands(results: Results, source: str) -> list[Band]:
    """Trajectories one after the other, each with all outputs; NaN where nothing was measured."""
    parts, told = results.bands(source), results.fidelity[source]
    if not parts:
        return []
    units = [*told.units, *[""] * len(told.outputs)]
    residual = np.where(parts["seen"][..., None], parts["observed"] - parts["nominal"], np.nan)
    quantiles = parts["quantiles"] - parts["nominal"][:, None]
    time = np.arange(residual.shape[1]) / float(parts["rate"])
    found = []
    for i, trajectory in enumerate(parts["ids"].tolist()):
        for c, output in enumerate(told.outputs):
            factor, unit = quantity(units[c])
            seen, said = factor * residual[i, :, c], factor * quantiles[i, :, :, c]
            found.append(Band(str(trajectory), output, unit, time, seen, said))
    return found


def _bin(name: str, unit: str, seen: NDArray, said: NDArray) -> Latent:
    low = min(_bulk(seen)[0], _bulk(said)[0])
    high = max(_bulk(seen)[1], _bulk(said)[1])
    width = 2 * float(np.subtract(*np.percentile(seen, [75, 25]))) / len(seen) ** (1 / 3)
    count = int(np.clip((high - low) / width if width > 0 else 30, 12, 48))
    edges = np.linspace(low, high, count + 1)
    shares = [np.histogram(values, edges)[0] for values in (seen, said)]
    return Latent(
        name,
        unit,
        edges,
        shares[0] / len(seen),
        shares[1] / len(said),
        (len(seen), len(said)),
        (len(seen) - int(shares[0].sum()), len(said) - int(shares[1].sum())),
    )


def _bulk(values: NDArray) -> tuple[float, float]:
    """Range without far outliers: three interquartile ranges beyond the quartiles at most."""
    lower, upper = np.percentile(values, [25, 75])
    reach = 3 * (upper - lower)
    if reach == 0:
        reach = max(float(np.percentile(np.abs(values - lower), 95)), 1e-9)
    inside = values[(values >= lower - reach) & (values <= upper + reach)]
    low, high = float(inside.min()), float(inside.max())
    pad = 0.02 * (high - low) or max(abs(low) * 0.05, 1e-6)
    return low - pad, high + pad
