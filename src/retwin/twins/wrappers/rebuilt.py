"""`RebuiltTwin`: a twin that is built anew for each combination of parameter values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import require
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Chunk, Twin, checked_commands, simulate_in_chunks
from retwin.twins.wrappers.parameter_values import values_per_simulation
from retwin.twins.wrappers.wrapper import TwinWrapper, simulate_chunk

TRAJECTORIES_PER_CHUNK = 512
"""Number of trajectories that are passed to the wrapped twin together."""


@dataclass(frozen=True)
class RebuiltTwin(TwinWrapper):
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

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> Trajectories:
        """See `TakesParameters.simulate`."""
        commands = checked_commands(commands, self.inputs)
        names = tuple(self.defaults)
        values = values_per_simulation(parameters, len(commands), allowed=names)
        table = np.stack(
            [values.get(n, np.full(len(commands), self.defaults[n])) for n in names], 1
        )

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            nominal = np.zeros((*chunk.commands.shape[:2], len(self.outputs)))
            observed = np.zeros_like(nominal)
            distinct, group = np.unique(table[chunk.index], axis=0, return_inverse=True)
            for i, theta in enumerate(distinct):
                rows = np.flatnonzero(group.ravel() == i)
                twin = self.build(dict(zip(names, theta.tolist(), strict=True)))
                nominal[rows], observed[rows] = simulate_chunk(twin, chunk, rows, seed=seed)
            return nominal, observed

        return simulate_in_chunks(
            self, run, commands, faults, seed=seed, progress=progress, size=TRAJECTORIES_PER_CHUNK
        )
