"""Values of parameters that differ between simulations, and twins that take them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import one_of, require
from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.twin import Chunk, Twin, checked_commands, simulate_in_chunks
from retwin.twins.wrappers.wrapper import TwinWrapper, simulate_chunk


def values_per_simulation(
    parameters: Mapping[str, ArrayLike] | None, count: int, *, allowed: Sequence[str] | None = None
) -> dict[str, NDArray]:
    """Check the values of parameters and give each simulation its own.

    Parameters
    ----------
    parameters : mapping of str to array_like, optional
        Finite values by name, each () for all simulations or (count,).
    count : int
        The number of simulations.
    allowed : sequence of str, optional
        Names that exist; by default all do.

    Returns
    -------
    dict of str to ndarray, shape (count,)
        The values of each parameter.

    Raises
    ------
    InputError
        An unknown name, or anything but finite numbers of those shapes.

    """
    values = {}
    for name, given in (parameters or {}).items():
        if allowed is not None:
            one_of("parameters", name, allowed)
        array = np.asarray(given)
        shape = f"{array.dtype} of shape {array.shape}" if array.ndim else repr(array.item())
        numbers = array.dtype.kind in "biuf" and bool(np.isfinite(array).all())
        fits = numbers and array.shape in ((), (count,))
        expected = f"finite numbers: one for all, or one per trajectory, {count}"
        remedy = "give as many values as there are trajectories"
        require(fits, "parameters", expected=expected, got=f"{name}: {shape}", remedy=remedy)
        values[name] = np.broadcast_to(array.astype(float), count)
    return values


class AdjustableTwin:
    """The base of twins that simulate by `_run` with parameters, `Chunk.parameters`."""

    @property
    def _adjustable(self) -> Sequence[str] | None:
        """Names of its parameters; None where any are passed on."""
        return None

    def _count(self, steps: int) -> int:
        """Trajectories of so many samples that are simulated together, at most."""
        return 512

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
        twin: Any = self  # with the channels and the rate of the subclass
        commands = checked_commands(commands, twin.inputs)
        values = values_per_simulation(parameters, len(commands), allowed=self._adjustable)
        how: Any = {"size": self._count(commands.shape[1]), "parameters": values}
        return simulate_in_chunks(
            twin, twin._run, commands, faults, seed=seed, progress=progress, **how
        )


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
        fits = isinstance(made, Twin)
        expected = "a function that returns a twin"
        remedy = "return a FunctionTwin, or any object that satisfies Twin"
        require(fits, "build", expected=expected, got=type(made).__name__, remedy=remedy)
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
