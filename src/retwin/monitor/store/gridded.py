"""Samples of a machine at the sample rate of its twin and within limits, and as a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.arrays import held
from retwin.checks import one_of, require
from retwin.data.trajectories import Trajectories
from retwin.monitor.store.samples import EARLIEST, SECOND, places
from retwin.monitor.store.store import Store
from retwin.update.dynamics.twin import DynamicsTwin


@dataclass(frozen=True, eq=False)
class Limits:
    """The limits of d channels, commands first: `low` and `high` (d,), infinite where none are."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: NDArray
    high: NDArray

    @classmethod
    def of(cls, twin: Any, declared: Mapping[str, Sequence[float]]) -> Limits:
        """Those that are declared for channels of a twin; InputError if they are none."""
        names = (*twin.inputs.names, *twin.outputs.names)
        units = (*twin.inputs.units, *twin.outputs.units)
        low, high = np.full((2, len(names)), [[-np.inf], [np.inf]])
        for name, (least, most) in declared.items():
            place, got = names.index(one_of("limits", name, names)), f"{least:g} and {most:g}"
            expected, remedy = f"the smallest and then the largest value of {name}", "swap them"
            require(least < most, "limits", expected=expected, got=got, remedy=remedy)
            low[place], high[place] = least, most
        return cls(names, units, low, high)

    def outside(self, values: NDArray) -> NDArray:
        """Whether values (..., d) are impossible; one that is missing is not."""
        return np.asarray((values < self.low) | (values > self.high))

    def kept(self, values: NDArray) -> NDArray:
        """Values (..., d) of which those that are impossible are missing."""
        return np.where(self.outside(values), np.nan, values)

    def text(self, place: int, value: float | None = None) -> str:
        """What is wrong with the channel of that place, with the value if that is known."""
        unit = f" {self.units[place]}" if self.units[place] != "1" else ""
        shown = "" if value is None else f" {value:.6g}{unit}"
        return (
            f"{self.names[place]}{shown} is outside its limits {self.low[place]:g} to "
            f"{self.high[place]:g}{unit}: the sensor or its line is at fault"
        )


def gridded(
    store: Store, asset: str, twin: DynamicsTwin, first: int, last: int
) -> tuple[NDArray, NDArray]:
    """Times (T,) and values (T, d_u + d_y) of stored samples, at the sample rate of the twin.

    Parameters
    ----------
    store : Store
        The store.
    asset : str
        Name of the machine.
    twin : DynamicsTwin
        Its twin.
    first, last : int
        Times in nanoseconds between which samples are read.

    Returns
    -------
    NDArray, NDArray
        From the first sample with all commands on; NaN where there is no sample, or a value that
        is outside the limits of its channel. A command that is missing later is the one before.

    """
    commands = len(twin.inputs)
    times, values = [np.zeros(0, dtype=np.int64)], [np.zeros((0, commands + len(twin.outputs)))]
    for part, rows in store.samples(asset, max(EARLIEST, first - 1)):
        times.append(part[part <= last])
        values.append(rows[part <= last])
        if part[-1] > last:
            break
    settings = next(each.settings for each in store.assets() if each.name == asset)
    limits = Limits.of(twin, settings.get("limits", {}))
    found, given = np.concatenate(times), limits.kept(np.concatenate(values))
    begun = np.logical_or.accumulate(np.isfinite(given[:, :commands]).all(axis=1))
    found, given = found[begun], given[begun]
    if not len(found):
        return found, given
    period = SECOND / twin.rate
    place, chosen = places(found, found[0], twin.rate)
    inside = place <= (last - first) / period
    rows = np.full((int(place[inside][-1]) + 1, given.shape[1]), np.nan)
    rows[place[inside]] = given[chosen[inside]]
    rows[:, :commands] = held(rows[:, :commands], 0)
    return found[0] + np.round(np.arange(len(rows)) * period).astype(np.int64), rows


def record_of(twin: Any, values: NDArray) -> Trajectories:
    """Samples (T, d_u + d_y) at the sample rate of a twin as one trajectory.

    A command that is missing is the one before; the first ones must be there.
    """
    commands, measured = np.split(values, [len(twin.inputs)], axis=1)
    return Trajectories(
        commands=held(commands, 0)[None],
        nominal=np.zeros_like(measured)[None],
        observed=np.where(np.isfinite(measured), measured, 0.0)[None],
        mask=np.isfinite(measured)[None],
        rate=twin.rate,
        ids=np.array([""]),
        inputs=twin.inputs,
        outputs=twin.outputs,
    )
