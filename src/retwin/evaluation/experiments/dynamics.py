"""What is not yet known of corrected state equations, and what would reduce it.

The unknowns are the parameters theta and psi in units of their posterior, that of the fit. The
information of a trajectory is that of the one-step errors of an extended Kalman filter, linearised
at the most probable parameters; in it an unknown start and process noise count as what they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from retwin.checks import require
from retwin.inference.design import Knowledge
from retwin.update.dynamics.twin import DynamicsTwin


@dataclass(frozen=True, eq=False)
class DynamicsKnowledge:
    """The posterior of the parameters.

    Attributes
    ----------
    twin : DynamicsTwin
        Its `factor` is that of the parameters alone: a new trajectory has another start.

    """

    twin: DynamicsTwin

    @classmethod
    def of(cls, twin: DynamicsTwin) -> DynamicsKnowledge:
        """What the fit has left open.

        Raises
        ------
        InputError
            Equations without uncertain parameters.

        """
        factor = twin.factor.copy()
        factor[-len(twin.process) :] = 0.0
        factor = factor[:, factor.any(axis=0)]
        expected = "corrected dynamics with uncertain parameters"
        got = "equations that are certain"
        remedy = "fit them with a discrepancy or with parameters that are estimated"
        require(factor.size > 0, "twin", expected=expected, got=got, remedy=remedy)
        return cls(replace(twin, factor=factor))

    def knowledge(self, commands: NDArray, *, max_predictions: int = 2000) -> Knowledge:
        """The knowledge about outputs in free simulation, in deviations by noise alone.

        Parameters
        ----------
        max_predictions : int, default 2000
            Outputs at most, evenly chosen from those of all reference trajectories.

        """
        given = self._unseen(commands)
        slopes = self.twin.filter.slopes(*given)
        scaled = slopes / np.sqrt(self.twin.simulation.noise_variance(given[0]))[..., None]
        rows = scaled.reshape(-1, scaled.shape[-1])
        rows = rows[:: max(1, len(rows) // max_predictions)]
        unit = torch.eye(rows.shape[1], dtype=torch.float64)
        return Knowledge(unit, torch.tensor(rows), torch.ones(len(rows), dtype=torch.float64))

    def roots(self, commands: NDArray) -> Tensor:
        """(n, r, r) roots of the information that outputs of commands would give."""
        given = self._unseen(commands)
        expected = self.twin.filter(*given)[0]
        seen = np.ones(expected.shape, dtype=bool)
        covariance = self.twin.filter(given[0], expected, seen)[1]
        slopes = self.twin.filter.slopes(given[0], expected, seen)
        white = np.linalg.solve(np.linalg.cholesky(covariance), slopes)
        return torch.tensor(np.linalg.qr(white.reshape(len(white), -1, white.shape[-1]), mode="r"))

    def _unseen(self, commands: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Commands without measured outputs, as `DynamicsFilter` takes them."""
        shape = (*commands.shape[:2], len(self.twin.outputs))
        return commands.astype(np.float64), np.zeros(shape), np.zeros(shape, dtype=bool)
