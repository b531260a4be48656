"""`RebuiltTwin`: a twin that is built anew for each combination of parameter values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from retwin.checks import require
from retwin.twins.twin import Chunk, Twin
from retwin.twins.wrappers.parameter_values import AdjustableTwin
from retwin.twins.wrappers.wrapper import TwinWrapper, simulate_chunk


@dataclass(frozen=True)
class RebuiltTwin(AdjustableTwin, TwinWrapper):
    """A twin that is built anew for each combination of parameter values.

    Trajectories with equal values are simulated together.

    Parameters
    ----------
    build : callable
        From values by name to a twin, whose channels, rate and limits do not depend on them.
        Other processes must be able to import it.
    defaults : mapping of str to float
        Values of all parameters.

    """

    build: Callable[[Mapping[str, float]], Twin]
    defaults: Mapping[str, float]

    @cached_property
    def twin(self) -> Twin:
        """The twin at the defaults.

        Raises
        ------
        InputError
            `build` returns no twin.

        """
        made = self.build(dict(self.defaults))
        require(
            isinstance(made, Twin),
            "build",
            expected="a function that returns a twin",
            got=type(made).__name__,
            remedy="return a FunctionTwin, or any object that satisfies Twin",
        )
        return made

    @property
    def _adjustable(self) -> tuple[str, ...]:
        return tuple(self.defaults)

    def _run(self, chunk: Chunk) -> tuple[NDArray, NDArray]:
        """Nominal and observed outputs."""
        count, steps, _ = chunk.commands.shape
        columns = {name: np.full(count, value) for name, value in self.defaults.items()}
        columns |= chunk.parameters
        nominal = np.zeros((count, steps, len(self.outputs)))
        observed = np.zeros_like(nominal)
        table = np.stack(list(columns.values()), 1)
        distinct, group = np.unique(table, axis=0, return_inverse=True)
        for i, theta in enumerate(distinct):
            rows = np.flatnonzero(group.ravel() == i)
            twin = self.build(dict(zip(columns, theta.tolist(), strict=True)))
            nominal[rows], observed[rows] = simulate_chunk(twin, chunk, rows, seed=chunk.seed)
        return nominal, observed
