"""Histograms of two samples in common bins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Histogram:
    """Observed and generated values in common bins.

    Attributes
    ----------
    edges : array (bins + 1,)
        The edges, increasing.
    observed, generated : array (bins,)
        Shares of all values, so that those of each sum to the share that lies within the edges.
    counts, outside : (int, int)
        Number of observed and of generated values: all, and those outside the edges.

    """

    edges: NDArray
    observed: NDArray
    generated: NDArray
    counts: tuple[int, int]
    outside: tuple[int, int]


def common_histogram(observed: NDArray, generated: NDArray) -> Histogram | None:
    """The histogram of two samples.

    Parameters
    ----------
    observed, generated : array (n,), array (m,)
        Values in the same unit; those that are not finite are left out.

    Returns
    -------
    Histogram or None
        None if either has no finite value.

    Notes
    -----
    The bins cover the values without outliers. Their width is Freedman and Diaconis' for the
    observed values, within 12 to 48 bins.

    References
    ----------
    Freedman and Diaconis, On the histogram as a density estimator, 1981.

    """
    observed, generated = (each[np.isfinite(each)] for each in (observed, generated))
    if not len(observed) or not len(generated):
        return None
    ranges = [_range_without_outliers(each) for each in (observed, generated)]
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    spread = float(np.subtract(*np.percentile(observed, [75, 25])))
    width = 2 * spread / len(observed) ** (1 / 3)
    count = int(np.clip((high - low) / width if width > 0 else 30, 12, 48))
    edges = np.linspace(low, high, count + 1)
    inside = [np.histogram(values, edges)[0] for values in (observed, generated)]
    return Histogram(
        edges,
        inside[0] / len(observed),
        inside[1] / len(generated),
        (len(observed), len(generated)),
        (len(observed) - int(inside[0].sum()), len(generated) - int(inside[1].sum())),
    )


def _range_without_outliers(values: NDArray) -> tuple[float, float]:
    """The range of the values within three interquartile ranges of the quartiles."""
    lower, upper = np.percentile(values, [25, 75])
    margin = 3 * (upper - lower)
    if margin == 0:
        margin = max(float(np.percentile(np.abs(values - lower), 95)), 1e-9)
    inside = values[(values >= lower - margin) & (values <= upper + margin)]
    low, high = float(inside.min()), float(inside.max())
    pad = 0.02 * (high - low) or max(abs(low) * 0.05, 1e-6)
    return low - pad, high + pad
