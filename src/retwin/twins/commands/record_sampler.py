"""`sampler_from`: a distribution of commands that are like those of a record."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import floats
from retwin.data.segments import Segments
from retwin.twins.commands.range import CommandRange, power_spectra
from retwin.twins.commands.samplers import MultisineSampler, RampSampler
from retwin.twins.limits import Limits

MARGIN = 0.1
"""Share of the width of a record's range by which commands go beyond it, at either end."""
BAND_MARGIN = 1.2
"""Highest frequency of multisines, in that of the record: the surrogate is needed up to there."""
MAX_SAMPLES = 2048
"""Largest number of samples of a multisine; a longer record is cut into parts of that length."""
DURATIONS = (0.1, 0.5, 0.9)
"""Quantiles of the durations of a record's ramps that the ramps of drawn commands have."""
CORNER_SHARE = 0.95
"""Share of the power that lies below the frequency up to which the amplitude is full."""
MIN_WEAK = 0.1
"""Least amplitude of the higher frequencies, relative to the full one."""


def sampler_from(
    commands: NDArray, rate: float, *, limits: Limits | None = None
) -> RampSampler | MultisineSampler:
    """Commands such as those of a record, of other levels and phases and slightly wider.

    Commands that move and rest give ramps between random levels, with the record's number of
    segments and its durations of ramps. Others give multisines with the record's mean, standard
    deviation and band, per channel, in whose upper part amplitudes are lower, as in the record.

    Parameters
    ----------
    commands : ndarray, shape (n, T, d_u)
        Recorded commands, in the units of the channels.
    rate : float
        Sample rate in Hz.
    limits : Limits, optional
        Of the twin; the commands stay within them.

    Returns
    -------
    RampSampler or MultisineSampler
        With the duration of the record, or of at most 2048 samples.

    """
    values = np.asarray(commands, np.float64)
    contained = CommandRange.of(values, rate)
    low, high = _widen(contained, limits)
    segments = Segments.from_commands(values)
    if moves_and_rests(segments):
        return _ramps(values, rate, segments, low, high)
    steps = min(values.shape[1], MAX_SAMPLES)
    parts = values[:, : values.shape[1] // steps * steps].reshape(-1, steps, values.shape[2])
    frequency, spectra = power_spectra(parts, rate)
    power = spectra.mean(axis=0, dtype=np.float64)
    share = (power / np.maximum(power.sum(axis=0), 1e-300)).mean(axis=1)
    lowest = rate / steps
    highest = max(lowest, min(BAND_MARGIN * max(contained.band), rate / 2))  # of constants too
    corner = float(frequency[np.searchsorted(share.cumsum(), CORNER_SHARE * share.sum())])
    corner = min(max(corner, lowest), highest)
    full = share[frequency <= corner].mean()
    above = share[(frequency > corner) & (frequency <= highest)]
    weak = float(np.sqrt(above.mean() / full)) if len(above) and full > 0 else 1.0
    mean = np.clip(values.mean(axis=(0, 1)), low, high)
    deviation = (1 + MARGIN) * values.std(axis=(0, 1))
    return MultisineSampler(
        floats(low),
        floats(high),
        rate,
        steps / rate,
        (lowest, max(highest, lowest)),
        corner=corner,
        weak=min(max(weak, MIN_WEAK), 1.0),
        mean=floats(mean),
        deviation=floats(deviation),
    )


def _widen(contained: CommandRange, limits: Limits | None) -> tuple[NDArray, NDArray]:
    """The range of the record (d_u,) with a margin, within the twin's limits."""
    low, high = np.array(contained.low), np.array(contained.high)
    size = np.maximum(np.abs(low), np.abs(high))
    width = np.where(high > low, high - low, np.where(size > 0, size, 1.0))
    wide = low - MARGIN * width, high + MARGIN * width
    if limits is None:
        return wide
    return np.maximum(wide[0], limits.low), np.minimum(wide[1], limits.high)


def moves_and_rests(segments: Segments, *, resting: float = 0.3) -> bool:
    """Whether the commands of a record have several segments, with rest in them.

    Parameters
    ----------
    resting : float, default 0.3
        Least share of the time that commands with segments are at rest, on average.

    """
    if segments.max_count < 2:
        return False
    rest, whole = segments.stop - segments.settle, segments.stop - segments.start
    return bool(rest[segments.valid].sum() >= resting * whole[segments.valid].sum())


def _ramps(
    values: NDArray, rate: float, segments: Segments, low: NDArray, high: NDArray
) -> RampSampler:
    """Ramps and holds between levels within a range (d_u,)."""
    steps = values.shape[1]
    count = max(1, int(np.median(segments.valid.sum(axis=1))))
    ramps = np.quantile((segments.settle - segments.start)[segments.valid], DURATIONS)
    ramps = np.clip(ramps.round(), 1, steps // count)
    start = np.clip(np.median(values[:, 0], axis=0), low, high)
    return RampSampler(
        floats(low),
        floats(high),
        rate,
        steps / rate,
        count,
        ramp_durations=floats(np.unique(ramps) / rate),
        start=floats(start),
    )
