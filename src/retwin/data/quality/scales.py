"""`find_scales`: channels of a record in another unit than in the others, by a power of ten."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from retwin.data.quality.finding import Finding
from retwin.data.trajectories import Trajectories


def find_scales(records: Trajectories) -> Iterator[Finding]:
    """Channels whose values are larger by a power of ten than in all other records.

    Magnitude and range are compared, as far as the other records agree in them.
    """
    commands = np.where(
        (np.arange(records.steps) < records.lengths[:, None])[..., None], records.commands, np.nan
    )
    measured = records.measured
    for channels, values in ((records.inputs, commands), (records.outputs, measured)):
        for k, name in enumerate(channels.names):
            known = [own[np.isfinite(own)] for own in values[..., k].astype(float)]
            ends = np.full((len(known), 3), np.nan)
            for row, own in zip(ends, known, strict=True):
                if len(own):
                    row[:] = *np.quantile(own, [0.02, 0.98]), np.quantile(np.abs(own), 0.98)
            low, high, size = ends.T
            powers = [each for each in map(_powers, (size, high - low)) if each is not None]
            for i in range(len(records) if powers else 0):
                power = {int(each[i]) for each in powers}
                if len(power) == 1 and power != {0}:
                    text = f"10^{power.pop()} times as large as in the others: another unit than "
                    text += f"{channels.units[k]}?"
                    yield Finding(str(records.ids[i]), name, "unit", text)


def _powers(sizes: NDArray, *, alike: float = 0.3, close: float = 0.05) -> NDArray | None:
    """The power of ten (n,) by which each size differs, 0 for none; None if sizes do not agree.

    Parameters
    ----------
    alike : float, default 0.3
        Decades within which the other records agree, so that one that differs is named.
    close : float, default 0.05
        Decades from a power of ten, at most, beside half of those within which the others agree.

    """
    known = np.isfinite(sizes) & (sizes > 0)
    if known.sum() < 3:
        return None
    decades = np.log10(np.where(known, sizes, 1.0))
    off = np.abs(decades - np.median(decades[known])) > 0.5
    others = decades[known & ~off]
    if len(others) <= max(1, (known & off).sum()) or np.ptp(others) > alike:
        return None
    apart = np.where(known & off, decades - np.median(others), 0.0)
    power = np.rint(apart)
    return np.where(np.abs(apart - power) < close + np.ptp(others) / 2, power, 0.0)
