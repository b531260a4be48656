"""Numbers behind the figures of fidelity: binned latents, and bands around what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.report.results import Results
from retwin.report.words import quantity

__all__ = ["Band", "Latent", "bands", "latents"]


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
