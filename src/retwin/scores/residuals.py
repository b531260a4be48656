"""Residual analysis: whiteness, correlation with commands, spectra, error over amplitude and time.

Residuals are measured minus simulated, or predicted, outputs. They are arrays (n, T) of n records
with T samples, NaN where nothing was measured; pairs of samples are of one record only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtri

LEVEL = 0.95
"""Probability of the limits of correlations."""
BINS = 12
"""Bins of an amplitude, about."""
PER_BIN = 20
"""Samples per bin of amplitudes, at least."""
SHORTEST = 16
"""Samples of the segments of a spectrum, at least."""
LONGEST = 1024
"""Samples of these segments, at most: a page shows no finer resolution."""


@dataclass(frozen=True)
class Correlogram:
    """Correlations by lag.

    Attributes
    ----------
    lags : array (K,)
        In samples.
    values : array (K,)
        Correlations, from -1 to 1 but for errors of sampling; NaN for a lag without a pair.
    limits : array (K,)
        A correlation of series without any lies between -limit and limit with probability 0.95,
        each by itself.

    """

    lags: NDArray
    values: NDArray
    limits: NDArray

    @property
    def outside(self) -> NDArray:
        """Whether each correlation is beyond its limits (K,); False for NaN."""
        return np.abs(self.values) > self.limits

    @property
    def largest(self) -> int:
        """The index of the correlation that is largest, in multiples of its limit."""
        ratio = np.abs(self.values) / self.limits
        return int(np.argmax(np.nan_to_num(ratio)))

    def thinned(self, count: int) -> Correlogram:
        """The same at `count` lags at most, the first and the last among them."""
        kept = np.unique(np.linspace(0, len(self.lags) - 1, count).round().astype(int))
        return Correlogram(self.lags[kept], self.values[kept], self.limits[kept])


@dataclass(frozen=True)
class Binned:
    """Errors in bins of an amplitude, which increases from bin to bin.

    Attributes
    ----------
    low, high, centre : array (b,)
        Least, greatest and mean amplitude of each bin.
    rms, mean : array (b,)
        Root mean square and mean of the errors.
    counts : array (b,)
        Samples.
    extrapolated : array (b,) of bool
        Whether the bin is outside the range of the calibration.

    """

    low: NDArray
    high: NDArray
    centre: NDArray
    rms: NDArray
    mean: NDArray
    counts: NDArray
    extrapolated: NDArray


def default_lags(residual: NDArray) -> int:
    """Number of lags: 10 log10 of the number of measured samples, at most a quarter of a record."""
    count = max(int(np.isfinite(residual).sum()), 1)
    return max(1, min(round(10 * np.log10(count)), residual.shape[1] // 4))


def decorrelated_after(residual: NDArray) -> int:
    """Lags that show the correlation of a residual: twice those until it is within its limits.

    At least `default_lags`, and at most a quarter of a record.
    """
    found = autocorrelation(residual, residual.shape[1] // 4)
    within = np.flatnonzero(~found.outside)
    first = int(found.lags[within[0]]) if len(within) else len(found.lags)
    return max(default_lags(residual), min(2 * first, len(found.lags)))


def autocorrelation(residual: NDArray, lags: int | None = None) -> Correlogram:
    """Autocorrelation of a residual at lags from 1 on.

    Parameters
    ----------
    residual : array (n, T)
        See the module. Its mean is not subtracted: a constant error is correlated too.
    lags : int, optional
        Number of lags; by default 10 log10 of the number of samples, at most T / 4.

    Returns
    -------
    Correlogram
        With the limits for white noise.

    References
    ----------
    Ljung, System Identification, 2nd ed., 1999, section 16.6. Ljung and Box, On a measure of lack
    of fit in time series models, Biometrika 65 (1978): the variance of a correlation.

    """
    count = default_lags(residual) if lags is None else lags
    seen = np.isfinite(residual)
    filled = np.where(seen, residual, 0.0)
    sums, pairs = _lagged(filled, filled), _pairs(seen, seen)
    samples = seen.sum()
    with np.errstate(invalid="ignore", divide="ignore"):
        values = (sums / pairs) / (sums[0] / samples)
        limits = ndtri((1 + LEVEL) / 2) * np.sqrt(samples / (samples + 2) / pairs)
    chosen = slice(1, count + 1)
    return Correlogram(np.arange(1, len(sums))[:count], values[chosen], limits[chosen])


def ljung_box(found: Correlogram) -> tuple[float, float]:
    """Portmanteau test of white noise.

    Parameters
    ----------
    found : Correlogram
        Of `autocorrelation`.

    Returns
    -------
    (float, float)
        The statistic of Ljung and Box and its p-value, by the chi-squared distribution with one
        degree of freedom per lag. Both are NaN if no lag has a pair.

    References
    ----------
    Ljung and Box, 1978; with missing samples Stoffer and Toloi, A note on the Ljung-Box-Pierce
    portmanteau statistic with missing data, Statistics & Probability Letters 13 (1992).

    """
    known = np.isfinite(found.values)
    if not known.any():
        return np.nan, np.nan
    deviations = found.limits[known] / ndtri((1 + LEVEL) / 2)
    statistic = float(np.sum((found.values[known] / deviations) ** 2))
    return statistic, float(chdtrc(known.sum(), statistic))


def cross_correlation(residual: NDArray, command: NDArray, lags: int | None = None) -> Correlogram:
    """Correlation of a residual with a command that is so many samples earlier.

    Parameters
    ----------
    residual, command : array (n, T)
        See the module; the mean of either is subtracted.
    lags : int, optional
        Largest lag, see `autocorrelation`; the lags are from minus this to this. Correlations at
        negative lags, with later commands, are signs of feedback.

    Returns
    -------
    Correlogram
        With limits that allow for the autocorrelation of both series.

    References
    ----------
    Bartlett, On the theoretical specification and sampling properties of autocorrelated time
    series, 1946; Haugh, Checking the independence of two covariance-stationary time series, 1976.

    """
    count = default_lags(residual) if lags is None else lags
    parts = [np.isfinite(each) for each in (residual, command)]
    filled = [_centred(each) for each in (residual, command)]
    samples = [max(int(each.sum()), 1) for each in parts]
    powers = [_lagged(each, each) for each in filled]
    pairs = [_pairs(each, each) for each in parts]
    with np.errstate(invalid="ignore", divide="ignore"):
        own = [
            np.where(number > 0, power / number / (power[0] / size), 0.0)
            for power, number, size in zip(powers, pairs, samples, strict=True)
        ]
        # Samples per effective one, by Bartlett's formula.
        weights = np.minimum(*pairs) / min(samples)
        time = max(1.0, float(2 * np.sum(own[0] * own[1] * weights) - 1))
        scale = np.sqrt((powers[0][0] / samples[0]) * (powers[1][0] / samples[1]))
        both = [
            np.concatenate([make(*reversed(of))[count:0:-1], make(*of)[: count + 1]])
            for make, of in ((_lagged, filled), (_pairs, parts))
        ]
        values = both[0] / both[1] / scale
        limits = ndtri((1 + LEVEL) / 2) * np.sqrt(time / both[1])
    last = (len(values) - 1) // 2
    return Correlogram(np.arange(-last, last + 1), values, limits)


def spectra(
    series: Sequence[NDArray], rate: float, segment: int | None = None
) -> tuple[NDArray, NDArray]:
    """Power spectral densities of several series by Welch's method, in the same segments.

    Parameters
    ----------
    series : sequence of array (n, T)
        See the module. Segments in which a sample of any series is missing are left out.
    rate : float
        In Hz.
    segment : int, optional
        Samples of a segment: by default the power of 2 from T / 8 on, and shorter where gaps leave
        no whole one.

    Returns
    -------
    frequencies, densities : array (F,), array (k, F)
        In Hz from the second one on, and in squared units per Hz; both are empty if no segment of
        16 samples is whole.

    """
    from scipy.signal import periodogram  # takes longer to import than all else here

    samples = series[0].shape[1]
    wanted = 2 ** int(np.ceil(np.log2(max(samples / 8, SHORTEST))))
    size = min(wanted, LONGEST, samples) if segment is None else segment
    while size >= SHORTEST:
        frames = [
            np.lib.stride_tricks.sliding_window_view(each, size, axis=1)[:, :: size // 2]
            for each in series
        ]
        whole = np.all([np.isfinite(each).all(axis=-1) for each in frames], axis=0)
        if whole.any():
            made = [periodogram(each[whole], rate, "hann") for each in frames]
            found = np.stack([density.mean(axis=0) for _, density in made])
            return made[0][0][1:], found[:, 1:]
        size //= 2
    return np.empty(0), np.empty((len(series), 0))


def error_by_amplitude(
    residual: NDArray, amplitude: NDArray, within: tuple[float, float] = (-np.inf, np.inf)
) -> Binned:
    """Errors in about `BINS` bins of equal counts of an amplitude, such as an output or a command.

    An amplitude of so few different values has a bin for each.

    Parameters
    ----------
    residual, amplitude : array (n, T)
        See the module.
    within : (float, float)
        The range of the amplitude in calibration, which no bin crosses.

    """
    seen = np.isfinite(residual) & np.isfinite(amplitude)
    error, value = residual[seen], amplitude[seen]
    low, high = within
    place, first = np.zeros(len(value), dtype=int), 0
    for part in (value < low, (low <= value) & (value <= high), value > high):
        own = value[part]
        if not len(own):
            continue
        different, inverse = np.unique(own, return_inverse=True)
        if len(different) > BINS:
            number = max(1, min(round(BINS * len(own) / len(value)), len(own) // PER_BIN))
            ends = np.unique(np.quantile(own, np.linspace(0, 1, number + 1)))
            inverse = np.searchsorted(ends[1:-1], own, side="right")
        place[part] = first + inverse
        first += int(inverse.max()) + 1
    made = [np.flatnonzero(place == i) for i in range(first)]
    made = [each for each in made if len(each)]
    lows = np.array([value[i].min() for i in made])
    return Binned(
        lows,
        np.array([value[i].max() for i in made]),
        np.array([value[i].mean() for i in made]),
        np.array([np.sqrt(np.mean(error[i] ** 2)) for i in made]),
        np.array([error[i].mean() for i in made]),
        np.array([len(i) for i in made]),
        (lows < low) | (lows > high),
    )


def rms_over_time(residual: NDArray, blocks: int) -> tuple[NDArray, NDArray]:
    """Root mean square of a residual over all records, in so many blocks of samples.

    Returns
    -------
    edges, rms : array (b + 1,), array (b,)
        Indices of the samples where blocks begin and end, and values, NaN where nothing was
        measured.

    """
    samples = residual.shape[1]
    edges = np.unique(np.linspace(0, samples, min(blocks, samples) + 1).astype(int))
    seen = np.isfinite(residual)
    parts = [np.where(seen, residual, 0.0) ** 2, seen]
    sums = [np.add.reduceat(each.sum(axis=0), edges[:-1]) for each in parts]
    with np.errstate(invalid="ignore"):
        return edges, np.sqrt(sums[0] / sums[1])


def _centred(values: NDArray) -> NDArray:
    """Values minus their mean; 0 where missing."""
    seen = np.isfinite(values)
    mean = values[seen].mean() if seen.any() else 0.0
    return np.where(seen, values - mean, 0.0)


def _lagged(later: NDArray, earlier: NDArray) -> NDArray:
    """Sums (T,) over records and samples of products with the sample k earlier, k from 0."""
    samples = later.shape[1]
    parts = (np.fft.rfft(each, 2 * samples, axis=1) for each in (later, earlier))
    spectrum = next(parts) * next(parts).conj()
    return np.fft.irfft(spectrum.sum(axis=0), 2 * samples)[:samples]


def _pairs(later: NDArray, earlier: NDArray) -> NDArray:
    """Numbers (T,) of pairs of samples that are both there."""
    return np.round(_lagged(later.astype(float), earlier.astype(float)))
