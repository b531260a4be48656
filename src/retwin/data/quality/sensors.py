"""What a sensor shows that its machine did not do: frozen, at a limit, white noise, a code.

Every threshold is relative to what the same output shows elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from retwin.data.measured import stand_in
from retwin.data.quality.finding import Finding
from retwin.data.quality.readings import MOVED, WINDOW, Readings, readings_of
from retwin.data.trajectories import Trajectories

CONSTANT = "never changes"
"""What is wrong with an output that has one value in all records."""
LIMIT = "limit"
"""What is wrong with an output that stops at a value that its sensor does not exceed."""


def find_constant(every: Sequence[Readings]) -> Iterator[Finding]:
    """An output that never changes in any record, or a value that stands for none."""
    values = np.concatenate([each.values for each in every])
    coded = stand_in(values)
    if len(values) > 1 and np.ptp(values) == 0:
        text = f"is {values[0]:.6g} all the time, so that it shows no dynamics: check its sensor"
        yield Finding("", every[0].channel, CONSTANT, text)
    elif coded:
        text = f"{coded[0]:g} at {coded[1]} samples, far from all others: replace it by NaN if it "
        own = next(each for each in every if np.isclose(each.values, coded[0]).any())
        at = np.flatnonzero(np.isclose(own.values, coded[0]))
        text += "stands for a missing measurement"
        yield own.finding("code", text, int(at[0]), int(at[-1]) + 1)


def find_stretches(every: Sequence[Readings]) -> Iterator[Finding]:
    """Values that last while everything that drives the output moves: frozen, or a limit."""
    for each, level in _find_levels(every):
        start, end, count = each.span_of(level)
        yield each.finding(*_name(each, level, start, end, count), start, end)


def limits_of(records: Trajectories) -> NDArray:
    """The lowest and highest value (2, d_y) that sensors give, infinite where none is seen.

    At it an output stays exactly and again and again, or for long, and never goes beyond it in any
    record.
    """
    limits = np.repeat([[-np.inf], [np.inf]], len(records.outputs), axis=1)
    for every in readings_of(records):
        own = limits[:, records.outputs.names.index(every[0].channel)]
        ends = min(each.values.min() for each in every), max(each.values.max() for each in every)
        for each, level in _find_levels(every):
            if _name(each, level, *each.span_of(level))[0] == LIMIT and level in ends:
                own[ends.index(level)] = level
    return limits


def _find_levels(every: Sequence[Readings]) -> Iterator[tuple[Readings, float]]:
    """Levels at which an output stays longer than any should, with their records."""
    longest = np.array([each.still.max(initial=0) for each in every])
    noisy = _noisy(every)
    for place, each in enumerate(every):
        others = np.delete(longest, place)
        usual = float(np.quantile(others, 0.25)) if len(others) else 0.0
        yield from ((each, level) for level in _unusual(each, usual, noisy=noisy))


def _name(each: Readings, level: float, start: int, end: int, count: int) -> tuple[str, str]:
    """What a level is, and in words."""
    why = "while its twin moves" if each.ideal else "while the commands change"
    if end - start == each.size and count == 1:
        return "frozen", f"is {level:.6g} all the time, {why}"
    if level in (each.values.min(), each.values.max()) and (count > 1 or end < each.size):
        return LIMIT, f"stays at exactly {level:.6g} and never beyond, {why}"
    return "frozen", f"stays at exactly {level:.6g}, {why} or its noise is seen elsewhere"


def _unusual(each: Readings, usual: float, *, noisy: bool, longer: float = 5.0) -> list[float]:
    """The levels that last longer than any should, or while the twin is far from them.

    Parameters
    ----------
    longer : float, default 5.0
        Factor by which a stretch of one value must be longer than all that are as usual.

    """
    values, lengths, still = each.levels
    inside = (values != each.values.min()) & (values != each.values.max())
    found = np.zeros(len(values), dtype=bool)
    for sums, least, needed in ((still, usual, True), (lengths, 0.0, noisy)):
        # The largest of the other levels at which a machine comes to rest, again and again.
        ranked = np.sort(sums[inside])[::-1]
        first, second = np.append(ranked, [0.0, 0.0])[:2]
        normal = np.where(inside & (sums == first), second, first)
        found |= needed & (sums >= np.maximum(WINDOW, longer * np.maximum(normal, least)))
    if each.ideal:
        apart = np.abs(each.values - each.drive[:, 0])
        for place in np.flatnonzero(still >= WINDOW).tolist():
            own = np.isin(each.values, values[place])
            elsewhere = np.quantile(apart[~own], 0.9) if (~own).any() else 0.0
            found[place] |= np.median(apart[own]) > max(longer * elsewhere, MOVED * each.span[0])
    return values[found].tolist()


def _noisy(every: Sequence[Readings], *, noisy: float = 0.8, floor: float = 1e-5) -> bool:
    """Whether an output shows noise wherever it is not still, so that stillness is no rest.

    The value that lasts longest in a record does not count: it is what is asked about.

    Parameters
    ----------
    noisy : float, default 0.8
        Share of the windows with noise from which it is expected everywhere.
    floor : float, default 1e-5
        Noise over the range of an output from which it is that of a sensor, and no rounding.

    """
    expected, found = 0, []
    for own in every:
        longest = int(own.levels[1].max(initial=0)) // WINDOW
        expected += len(own.noise) - min(longest, int((own.noise == 0).sum()))
        found.append(own.noise[own.noise > 0])
    noise = np.concatenate(found)
    values = np.unique(np.concatenate([own.values for own in every]))
    if len(noise) < max(1, noisy * expected) or len(values) < 2:
        return False
    resolution = max(np.diff(values).min(), 4 * np.spacing(np.float32(np.abs(values).max())))
    return bool(np.median(noise) > max(floor * (values[-1] - values[0]), resolution))


def find_noise(every: Sequence[Readings], *, correlated: float = 0.5) -> Iterator[Finding]:
    """Records in which an output is white noise, although what drives it moves.

    Parameters
    ----------
    correlated : float, default 0.5
        Correlation from one sample to the next from which on motion is no noise.

    """
    related = [_next(each.values) for each in every]
    for place, each in enumerate(every):
        moving = np.ptp(each.drive, axis=0) > 3 * MOVED * each.span
        if not moving.any():
            continue
        drive = each.drive[:, moving]
        others = related[:place] + related[place + 1 :]
        motion = max(map(_next, drive.T)) if each.ideal or not others else np.median(others)
        limit = 4 / np.sqrt(each.size)
        if motion > correlated and abs(related[place]) < limit and not _follows(each, drive, limit):
            text = "white noise, on which nothing that was commanded has an effect"
            yield each.finding("noise", text, 0, each.size)


def _next(values: NDArray) -> float:
    """Correlation from one sample to the next; 1 for what never changes."""
    centred = values - values.mean()
    power = centred @ centred
    return float(centred[1:] @ centred[:-1] / power) if power > 0 else 1.0


def _follows(each: Readings, drive: NDArray, limit: float, *, lags: int = 10) -> bool:
    """Whether an output is correlated with what drives it, at any of the lags.

    Parameters
    ----------
    lags : int, default 10
        Lags in samples at which an output may depend on what drives it.

    """
    y, u = each.values - each.values.mean(), drive - drive.mean(axis=0)
    scale = np.sqrt((y @ y) * (u**2).sum(axis=0))
    most = min(lags, each.size // 4)
    found = [np.abs(y[lag:] @ u[: each.size - lag]) / scale for lag in range(most + 1)]
    return bool(np.max(found) > limit)
