"""`ForecastErrors`: how far predictions from measurements are off, by how far they are ahead.

A prediction h ahead of the last measurement is a simulation that is continued from there. Where the
twin has states these are filtered; of any other twin the simulation runs from the commands alone,
and a share of its last error, which falls with h, is added. Both are calibrated on samples that the
model was not fitted to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from retwin.checks import require

LEVEL = 0.9
"""Probability of the intervals that are calibrated."""
USUAL = float(ndtri((1 + LEVEL) / 2))
"""Their half width in standard deviations of a Gaussian distribution."""
FEW = 5
"""Independent samples below which no band is promised: the 90 % quantile of four is none."""


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

    """

    leads: NDArray
    persistence: NDArray
    deviation: NDArray
    independent: NDArray

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

    @property
    def values(self) -> dict[str, Any]:
        """As JSON values; an infinite time is null."""
        leads = [each if np.isfinite(each) else None for each in self.leads.tolist()]
        names = ("persistence", "deviation", "independent")
        return {"leads": leads} | {name: getattr(self, name).tolist() for name in names}

    @classmethod
    def of(cls, values: Mapping[str, Any] | None) -> ForecastErrors | None:
        """What `values` gave; None for None.

        Raises InputError for arrays that do not fit together.
        """
        if values is None:
            return None
        leads = np.array([np.inf if each is None else each for each in values["leads"]], float)
        names = ("persistence", "deviation", "independent")
        arrays = [np.array(values[name], dtype=float) for name in names]
        require(
            all(each.ndim == 2 and len(each) == len(leads) for each in arrays)
            and all(np.isfinite(each).all() and (each >= 0).all() for each in arrays),
            "forecast",
            expected="one finite row for each time ahead",
            got=[each.shape for each in arrays],
            remedy="save the model again",
        )
        return cls(leads, *arrays)


def conformal_deviation(errors: NDArray, independent: float) -> float:
    """The deviation whose central 90 % interval holds 90 % of further errors.

    Parameters
    ----------
    errors : NDArray
        (K,), of samples that were left out of the fit.
    independent : float
        How many independent ones they are worth; the fewer, the higher the quantile.

    """
    level = min(1.0, LEVEL * (1 + 1 / max(independent, 1.0)))
    return float(np.quantile(np.abs(errors), level) / USUAL)
