"""`ForecastErrors`: how far predictions from measurements are off, by how far they are ahead.

A prediction h ahead of the last measurement is a simulation that is continued from there. Where the
twin has states these are filtered; of any other twin the simulation runs from the commands alone,
and a share of its last error, which falls with h, is added. Both are calibrated on samples that the
model was not fitted to.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.update.training_range import OutsideTrainingWarning

LEVEL = 0.9
"""Probability of the intervals that are calibrated."""
USUAL = float(ndtri((1 + LEVEL) / 2))
"""Their half width in standard deviations of a Gaussian distribution."""
FEW = 5
"""Independent samples below which no band is promised: the 90 % quantile of four is none."""
BY_LEAD = ("persistence", "deviation", "independent")
"""Fields of `ForecastErrors` with a row for each time ahead, in their order."""
BEYOND = 0.05
"""Share of the width of its range by which a value may leave it, as noise makes it."""


@dataclass(frozen=True, eq=False)
class ForecastErrors:
    """Errors of predictions from measurements, by output and time ahead.

    Attributes
    ----------
    leads : NDArray
        (L,) times ahead in s, ascending; the last one is infinite: free simulation from commands.
    persistence : NDArray
        (L, d_y), the share of the last error that is added; 0 where states are filtered.
    deviation : NDArray
        (L, d_y), standard deviations in output units whose central 90 % interval has held 90 % of
        the errors of samples that were left out of the fit.
    independent : NDArray
        (L, d_y), how many independent samples these are worth.
    memory : float
        Time in s after which the system forgets: five correlation times of the errors of free
        simulation.
    low, high : NDArray
        (d_u + d_y,), least and greatest value of the commands, and then of the outputs, in the
        calibration.
    beyond : NDArray
        (d_u + d_y,), how far a value may leave that range, in widths of it: as far as the parts
        that were left out left the range of the others while the bands held.
    longest : float
        Time in s of the longest record of the calibration; infinite where it is not known.
    drifts : bool
        Whether errors of free simulation depended on the time in the record.
    started : NDArray or None
        (d_y,), the deviation of free simulations from starts that the first tenth of each record
        gives; None for models whose starts are known, or cannot be set.

    """

    leads: NDArray
    persistence: NDArray
    deviation: NDArray
    independent: NDArray
    memory: float
    low: NDArray
    high: NDArray
    beyond: NDArray
    longest: float = np.inf
    drifts: bool = False
    started: NDArray | None = None

    def at(self, lead: float) -> tuple[NDArray, NDArray]:
        """Persistence and deviation (d_y,) of any time ahead in s, interpolated over its log."""
        finite = np.isfinite(self.leads)
        if not np.isfinite(lead) or not finite.any():
            return self.persistence[-1], self.deviation[-1]
        logs, own = np.log(self.leads[finite]), np.log(lead)
        columns = (self.persistence[finite].T, self.deviation[finite].T)
        one, other = (np.array([np.interp(own, logs, each) for each in rows]) for rows in columns)
        return one, other

    @property
    def promised(self) -> bool:
        """Whether errors were enough to promise bands of free simulation."""
        return bool(self.independent[-1].min() >= FEW)

    def outside(self, values: NDArray, rate: float) -> NDArray:
        """Samples (n, T) at which a value is outside of its range, or was so not long ago.

        Parameters
        ----------
        values : ndarray, shape (n, T, d_u + d_y)
            Commands and predicted outputs, which may be NaN.
        rate : float
            Sample rate in Hz.

        """
        steps = np.arange(values.shape[1])
        far = (channel_excess(values, self.low, self.high) > self.beyond).any(axis=2)
        last = np.maximum.accumulate(np.where(far, steps, -np.inf), axis=1)
        return np.asarray(steps - last <= self.memory * rate)

    def late(self, steps: int, rate: float) -> NDArray:
        """Samples (T,) of a free simulation after the time of the longest record."""
        return np.arange(steps) > self.longest * rate - 0.5

    @property
    def values(self) -> dict[str, Any]:
        """As JSON values; an infinite time is null."""
        return {name: _to_json(each) for name, each in vars(self).items()}

    @classmethod
    def of(cls, values: Mapping[str, Any] | None) -> ForecastErrors | None:
        """What `values` gave; None for None.

        Raises InputError for arrays that do not fit together.
        """
        if values is None:
            return None
        leads = np.array([np.inf if each is None else each for each in values["leads"]], float)
        arrays = {name: np.array(values[name], dtype=float) for name in (*BY_LEAD, "low", "high")}
        rows, low, high = [arrays[name] for name in BY_LEAD], arrays["low"], arrays["high"]
        require(
            all(each.ndim == 2 and len(each) == len(leads) for each in rows)
            and all(np.isfinite(each).all() and (each >= 0).all() for each in rows)
            and low.shape == high.shape
            and bool((low <= high).all()),
            "forecast",
            expected="one finite row for each time ahead, and ranges from low to high",
            got=[each.shape for each in arrays.values()],
            remedy="save the model again",
        )
        # Models that were saved before have none of these, and one number `beyond`.
        longest, started = values.get("longest"), values.get("started")
        return cls(
            leads=leads,
            longest=np.inf if longest is None else float(longest),
            drifts=bool(values.get("drifts")),
            started=None if started is None else np.array(started, dtype=float),
            memory=float(values["memory"]),
            beyond=np.broadcast_to(np.asarray(values["beyond"], dtype=float), low.shape),
            **arrays,
        )


def warn_unlike(model: object, records: Trajectories, *, unlike: float = 0.5) -> None:
    """Warn of channels of which half of the samples are far outside the range of the calibration.

    Nothing is known of a model without calibrated bands.

    Parameters
    ----------
    unlike : float, default 0.5
        Share of the width of its range by which half of the samples leave it in another unit or
        another channel.

    """
    errors: ForecastErrors | None = getattr(model, "forecast", None)
    if errors is None:
        return
    measured = np.where(records.mask, records.observed, np.nan)
    values = np.concatenate([records.commands, measured], axis=2)
    names = (*records.inputs.names, *records.outputs.names)
    ends = zip(names, *value_range(values), errors.low, errors.high, strict=True)
    found = []
    for i, (name, least, most, low, high) in enumerate(ends):
        own = values[np.isfinite(values[..., i])][:, None, [i]]
        excess = range_excess(own, errors.low[[i]], errors.high[[i]])
        if own.size and np.median(excess) > unlike:
            found.append(f"{name} is {least:.4g} to {most:.4g} here, {low:.4g} to {high:.4g} there")
    if found:
        warnings.warn(
            f"these records are unlike those of the calibration: {'; '.join(found)}. Is it another "
            "unit, or another column?",
            OutsideTrainingWarning,
            stacklevel=3,
        )


def _to_json(value: Any) -> Any:
    """A field as JSON values, infinite numbers as null."""
    if isinstance(value, np.ndarray):
        made = value.astype(object)
        made[~np.isfinite(value)] = None
        return made.tolist()
    return None if value == np.inf else value


def value_range(values: NDArray) -> tuple[NDArray, NDArray]:
    """Least and greatest of values (n, T, d), each (d,); 0 where all are NaN."""
    seen = np.isfinite(values)
    low = np.where(seen, values, np.inf).min(axis=(0, 1), initial=np.inf)
    high = np.where(seen, values, -np.inf).max(axis=(0, 1), initial=-np.inf)
    known = low <= high
    return np.where(known, low, 0.0), np.where(known, high, 0.0)


def range_excess(values: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """How far each sample (n, T) of values (n, T, d) leaves a range (d,), in widths of that.

    See `channel_excess`; the furthest channel counts.
    """
    return channel_excess(values, low, high).max(axis=2, initial=0.0)


def channel_excess(values: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """How far each of values (n, T, d) leaves its range (d,), in widths of that; 0 inside.

    NaN counts as inside; the width of a constant is its size, or 1 if that is 0.
    """
    size = np.where(high != 0, np.abs(high), 1.0)
    width = np.where(high > low, high - low, size)
    distance = np.nan_to_num(np.maximum(values - high, low - values) / width)
    return np.asarray(np.maximum(distance, 0.0))


def predictive_deviation(errors: NDArray, independent: float) -> float:
    """The deviation whose central 90 % interval holds 90 % of further errors.

    It is the 90 % quantile of the errors' sizes; as the scale of few independent errors is
    uncertain, it is widened by the ratio of the quantiles of Student's t distribution, with so
    many degrees of freedom, and the Gaussian one.

    Parameters
    ----------
    errors : NDArray
        (K,), of samples that were left out of the fit.
    independent : float
        How many independent ones they are worth.

    """
    student = stdtrit(max(independent, 1.0), (1 + LEVEL) / 2)
    return float(np.quantile(np.abs(errors), LEVEL) * student / USUAL**2)
