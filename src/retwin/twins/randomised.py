"""`RandomisedTwin`: domain randomisation, parameters anew for every trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.data.trajectories import Trajectories
from retwin.progress import Progress
from retwin.twins.faults import Fault
from retwin.twins.parametric import ParametricTwin
from retwin.twins.twin import Chunk, nominal_outputs, simulate_in_chunks
from retwin.twins.wrapper import TwinWrapper, chunk_generator, simulate_chunk

__all__ = ["RandomisedTwin", "simulate_with_parameters"]


@dataclass(frozen=True)
class RandomisedTwin(TwinWrapper):
    """A twin whose every parameter is drawn uniformly within its bounds, per trajectory.

    Domain randomisation (Tobin et al. 2017): the rival that asks for no real data. It is as good as
    its bounds, which somebody who has not seen the data has to set by hand.

    Parameters
    ----------
    twin: says which parameters there are, and their bounds. Its values give the nominal output
        where the twin has none that is free of parameters.

    """

    twin: ParametricTwin

    def simulate(
        self,
        commands: NDArray,
        *,
        faults: Sequence[Fault | None] | None = None,
        seed: int,
        progress: Progress | None = None,
    ) -> Trajectories:
        """See `Twin.simulate`."""
        low, high = self.twin.bounds

        def run(chunk: Chunk) -> tuple[NDArray, NDArray]:
            rng = chunk_generator(seed, chunk, 3)
            drawn = rng.uniform(low, high, size=(len(chunk.commands), len(low)))
            return simulate_with_parameters(self.twin, chunk, drawn, seed=seed)

        return simulate_in_chunks(self, run, commands, faults, seed=seed, progress=progress)


def simulate_with_parameters(
    twin: ParametricTwin, chunk: Chunk, values: NDArray, *, seed: int
) -> tuple[NDArray, NDArray]:
    """Nominal and observed outputs of a chunk, every trajectory with parameters (n, k) of its own.

    The nominal output does not depend on them: it is the twin's own, or else what the twin says at
    its present values.
    """
    rows = np.arange(len(chunk.commands))
    named = dict(zip(twin.names, values.T, strict=True))
    _, observed = simulate_chunk(twin, chunk, rows, seed=seed, parameters=named)
    if twin.nominal is not None:
        return nominal_outputs(twin.nominal, chunk.commands, len(twin.outputs)), observed
    ideal, _ = simulate_chunk(twin, chunk, rows, faults=[None] * len(rows), seed=seed)
    return ideal, observed
