"""`CommandRange`: the values, the speeds and the frequencies that a set of commands contains."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from math import ceil, inf
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.signal import windows

from retwin.arrays import floats, row_blocks
from retwin.checks import one_per
from retwin.data.trajectories import Channels
from retwin.twins.compiled import commands as compiled_commands
from retwin.workers.threads import in_threads

TOLERANCE = 0.02
"""How far a value may leave its range, as a share of the range's width."""
BAND_SHARE = 0.999
"""Share of the power of all trajectories together that lies within the band."""
SPEED_TOLERANCE = 0.25
"""Share by which a speed may exceed the greatest one, which is the largest of few random ones."""
POWER_TOLERANCE = 0.01
"""Share of a trajectory's power that may lie above the band beyond what such trajectories have:
a tenth of the amplitude."""
SMALLEST_POWER = 1e-4
"""Power, relative to the mean of all trajectories, below which a trajectory hardly varies: a
hundredth of the amplitude. Its spectrum is that of rounding."""
ROUNDING = 1e-6
"""Relative difference of equal values at most: that of numbers in single precision."""
MARGIN_OF_ONE = 3.0
"""A further draw of n leaves their range by more than 3 / n of its width in one of twenty cases at
most: 1 - 0.05 ** (1 / n), for uniform values."""
LEAKAGE = 2.0
"""Half the width of a sine's peak in the spectrum of a Hann window, in frequency steps."""


@dataclass(frozen=True)
class CommandRange:
    """What a set of commands contains, one number for each input channel.

    Attributes
    ----------
    low, high : tuple of float
        Least and greatest value, in the channel's unit.
    speed : tuple of float
        Greatest rate of change, in the unit per second.
    band : tuple of float
        Frequency in Hz below which 99.9 % of the power lies, the mean of each trajectory left out.
    share : tuple of float
        Greatest share of a trajectory's power that lies above the band.
    power : tuple of float
        Mean power of a trajectory, in the unit squared.
    resolution : float
        Frequency step of the spectra in Hz: one over the duration of a trajectory.
    count : int
        Trajectories: others like a few of these leave their range by chance; 0 for a given range.

    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    speed: tuple[float, ...]
    band: tuple[float, ...]
    share: tuple[float, ...]
    power: tuple[float, ...]
    resolution: float
    count: int

    def __post_init__(self) -> None:
        for name in ARRAYS:
            one_per(name, getattr(self, name), len(self.low), "input channel")

    @classmethod
    def of(cls, commands: NDArray, rate: float) -> CommandRange:
        """Of commands (n, T, d_u) at `rate` Hz."""
        ends = in_threads(lambda rows: extremes(commands[rows]), list(row_blocks(commands)))
        least, greatest, steps = (np.concatenate(each) for each in zip(*ends, strict=True))
        low, high = least.min(axis=0), greatest.max(axis=0)
        change = rate * steps.max(axis=0)
        mean = np.add.reduce(list(_of_spectra(lambda each: each.sum(axis=0), commands, rate)))
        frequency = _frequencies(commands, rate)
        below = mean.cumsum(axis=0) / len(chosen_for_spectra(len(commands)))
        index = (below < BAND_SHARE * below[-1]).sum(axis=0)
        band, power, resolution = frequency[index], below[-1], rate / commands.shape[1]
        limit = band + LEAKAGE * resolution
        above = _of_spectra(lambda each: _above(frequency, each, limit, power), commands, rate)
        share = np.concatenate(list(above)).max(axis=0)
        numbers = dict(zip(ARRAYS, (low, high, change, band, share, power), strict=True))
        return cls(
            **{k: floats(v) for k, v in numbers.items()}, resolution=resolution, count=len(commands)
        )

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> CommandRange:
        """The range from the values of `dataclasses.asdict`, with JSON lists."""
        parts = {name: floats(np.atleast_1d(values[name])) for name in ARRAYS}
        return cls(**parts, resolution=float(values["resolution"]), count=int(values["count"]))

    @property
    def sampling_margin(self) -> float:
        """Share of its width by which other draws like these trajectories may leave the range."""
        return min(1.0, MARGIN_OF_ONE / self.count) if self.count else 0.0

    def scores(self, commands: NDArray, rate: float) -> NDArray:
        """How far commands (n, T, d_u) leave the range in value, speed and spectrum, (n, 3, d_u).

        Numbers above 1 are outside. Of more than a thousand trajectories some have no spectrum.
        """
        low, high, speed = (np.array(each) for each in (self.low, self.high, self.speed))
        found = np.zeros((len(commands), 3, len(low)))
        still = high <= low
        tolerated = TOLERANCE / (TOLERANCE + self.sampling_margin)
        blocks = list(row_blocks(commands))
        ends = in_threads(lambda rows: extremes(commands[rows]), blocks)
        for rows, (least, greatest, steps) in zip(blocks, ends, strict=True):
            # The training of a constant channel does not contain any other value.
            changed = np.maximum(low - least, greatest - low) > ROUNDING * np.abs(low)
            beyond = excess(least, greatest, low, high)
            found[rows, 0] = np.where(still, np.where(changed, inf, 0.0), beyond * tolerated)
            # Both the distance and the duration of a motion are drawn.
            tolerance = (1 + SPEED_TOLERANCE) * (1 + 2 * self.sampling_margin)
            limit = tolerance * np.where(speed > 0, speed, inf)
            found[rows, 1] = rate * steps / limit
        if np.isfinite(self.band).all():
            shares = self.shares(commands, rate)
            found[chosen_for_spectra(len(commands)), 2] = shares / self.largest_share
        return found

    @property
    def bounds(self) -> tuple[NDArray, NDArray, NDArray]:
        """Lowest and highest value, and highest speed, (d_u,) each, that are within the range.

        See `scores`, which compares the spectrum too.
        """
        low, high, speed = (np.array(each) for each in (self.low, self.high, self.speed))
        margin = (TOLERANCE + self.sampling_margin) * (high - low)
        margin = np.where(high > low, margin, ROUNDING * np.abs(low))
        fastest = (
            (1 + SPEED_TOLERANCE) * (1 + 2 * self.sampling_margin) * np.where(speed > 0, speed, inf)
        )
        return low - margin, high + margin, fastest

    @property
    def largest_share(self) -> NDArray:
        """Share (d_u,) of a trajectory's power above `band_limit` that is within the range."""
        return (1 + self.sampling_margin) * np.array(self.share) + POWER_TOLERANCE

    def band_limit(self, resolution: float) -> NDArray:
        """Frequency (d_u,) in Hz above which power is not that of the band, in spectra of a step.

        `resolution` is that step in Hz: the peak of a sine is as wide as some of them.
        """
        return np.array(self.band) + LEAKAGE * max(self.resolution, resolution)

    def shares(self, commands: NDArray, rate: float) -> NDArray:
        """Share of the power of each trajectory's commands that lies above the band, (n, d_u)."""
        frequency = _frequencies(commands, rate)
        limit, power = self.band_limit(rate / commands.shape[1]), np.array(self.power)
        above = _of_spectra(lambda each: _above(frequency, each, limit, power), commands, rate)
        return np.concatenate(list(above))

    def outside(self, commands: NDArray, rate: float, inputs: Channels) -> str:
        """What of the commands is outside the range, by channel, in words; "" if nothing is."""
        scores = self.scores(commands, rate)
        wrong = scores > 1
        texts = []
        for channel, kind in np.argwhere(wrong.any(axis=0).T):
            farthest = commands[[scores[:, kind, channel].argmax()]]
            value, trained = (self._values, self._speeds, self._spectra)[kind](
                farthest[..., channel], channel, rate
            )
            unit = inputs.units[channel]
            unit = f" in {unit}" if unit not in ("", "1") and kind < 2 else ""
            texts.append(f"{inputs.names[channel]} {value} (training: {trained}{unit})")
        if not texts:
            return ""
        count = int(wrong.any(axis=(1, 2)).sum())
        return f"{'; '.join(texts)}; in {count} of {len(commands)} trajectories"

    def _values(self, values: NDArray, channel: int, rate: float) -> tuple[str, str]:
        """The value of (1, T) that is farthest from the range of a channel, and that range."""
        low, high = self.low[channel], self.high[channel]
        values = values.astype(np.float64)
        farthest = values.flat[np.maximum(low - values, values - high).argmax()]
        return f"is {farthest:.4g}", f"{low:.4g} to {high:.4g}"

    def _speeds(self, values: NDArray, channel: int, rate: float) -> tuple[str, str]:
        """The greatest speed of (1, T), and that of the channel."""
        fastest = rate * extremes(values[..., None])[2][0, 0]
        return f"changes by {fastest:.4g} per s", f"up to {self.speed[channel]:.4g}"

    def _spectra(self, values: NDArray, channel: int, rate: float) -> tuple[str, str]:
        """The share of the power of (1, T) above the channel's band, and that of training."""
        every = np.broadcast_to(values[..., None], (*values.shape, len(self.low)))
        share, band = self.shares(every, rate)[0, channel], self.band[channel]
        return f"has {share:.1%} of its power above {band:.3g} Hz", f"{self.share[channel]:.1%}"


ARRAYS = ("low", "high", "speed", "band", "share", "power")
"""Fields of `CommandRange` with one number per channel."""


def extremes(values: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Least and greatest value, and greatest change by one sample, (n, d) each, of (n, T, d)."""
    series = np.asarray(values)
    made = compiled_commands.extremes(series)
    if made is not None:
        return tuple(each.astype(np.float64) for each in made)  # type: ignore[return-value]
    if series.dtype.kind != "f" or series.dtype.itemsize < 4:
        series = series.astype(np.float64)
    change = np.abs(series[:, 1:] - series[:, :-1])
    found = (
        _reduce(np.minimum, series),
        _reduce(np.maximum, series),
        _reduce(np.maximum, change) if change.shape[1] else np.zeros_like(series[:, 0]),
    )
    return tuple(each.astype(np.float64) for each in found)  # type: ignore[return-value]


def _reduce(function: np.ufunc, series: NDArray) -> NDArray:
    """The reduction (n, d) of (n, T, d) over time, by halves: numpy's own is many times slower
    where d is small.
    """
    while series.shape[1] > 1:
        half = series.shape[1] // 2
        rest = series[:, 2 * half :]
        series = function(series[:, :half], series[:, half : 2 * half])
        if rest.shape[1]:
            series[:, :1] = function(series[:, :1], rest)
    return series[:, 0]


def excess(least: NDArray, greatest: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """How far (n, d) extremes (n, d) leave their ranges, in tolerated shares of their widths."""
    width = high - low
    over = np.maximum(low - least, greatest - high) / np.where(width > 0, width, 1.0)
    return np.maximum(over, 0.0) / TOLERANCE


def power_spectra(commands: NDArray, rate: float) -> tuple[NDArray, NDArray]:
    """Frequencies (F,) in Hz, and the power (n, F, d_u) of each in commands about their mean.

    The window is Hann's. Of more than a thousand trajectories that many are taken.
    """
    return _frequencies(commands, rate), np.concatenate(
        list(_of_spectra(np.asarray, commands, rate))
    )


def _frequencies(commands: NDArray, rate: float) -> NDArray:
    return fft.rfftfreq(commands.shape[1], 1 / rate)


def _of_spectra(
    function: Callable[[NDArray], NDArray], commands: NDArray, rate: float
) -> Iterator[NDArray]:
    """A function of the power spectra (n, F, d_u) of the chosen trajectories, block by block."""
    chosen = chosen_for_spectra(len(commands))
    window = windows.hann(commands.shape[1] + 2)[1:-1, None].astype(np.float32)
    scale = 2 / len(window) / np.sum(window**2)

    def of_block(rows: slice) -> NDArray:
        values = np.asarray(commands[chosen[rows]], np.float32)
        values = (values - values.mean(axis=1, keepdims=True)) * window
        found = fft.rfft(np.ascontiguousarray(np.moveaxis(values, 1, 2)), axis=2)
        spectra = found.real**2 + found.imag**2
        return function(np.moveaxis(spectra, 2, 1) * scale)

    return in_threads(of_block, list(row_blocks(commands, len(chosen))))


def _above(frequency: NDArray, spectra: NDArray, limit: NDArray, power: NDArray) -> NDArray:
    """Share (n, d_u) of the power of each spectrum above a frequency (d_u,)."""
    above = (spectra * (frequency[:, None] > limit)).sum(axis=1, dtype=np.float64)
    whole = spectra.sum(axis=1, dtype=np.float64) + SMALLEST_POWER * power
    return np.divide(above, whole, out=np.zeros_like(above), where=power > 0)


_WHOLE: ContextVar[int] = ContextVar("whole", default=0)


@contextmanager
def part_of(count: int) -> Iterator[None]:
    """In this block commands are a part of `count` such, of which a thousand spectra are enough."""
    token = _WHOLE.set(count)
    try:
        yield
    finally:
        _WHOLE.reset(token)


def chosen_for_spectra(count: int, *, max_spectra: int = 1000) -> NDArray:
    """Indices of at most a thousand trajectories, evenly chosen; of fewer in `part_of` a set.

    Parameters
    ----------
    max_spectra : int, default 1000
        Largest number of trajectories whose spectra are computed, evenly chosen.

    """
    share = min(1.0, max_spectra / max(count, _WHOLE.get(), 1))
    return np.unique(np.linspace(0, count - 1, ceil(share * count)).round().astype(int))
