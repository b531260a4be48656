"""`RandomisedTwin`: domain randomisation, with parameters drawn anew for every trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from retwin.twins.twin import Chunk, ChunkedTwin, nominal_outputs
from retwin.twins.wrappers.parametric import ParametricTwin
from retwin.twins.wrappers.wrapper import TwinWrapper, chunk_generator, simulate_chunk

PARAMETERS = 3
"""The purpose of the random numbers that are the parameters, see `chunk_generator`."""


@dataclass(frozen=True)
class RandomisedTwin(ChunkedTwin, TwinWrapper):
    """A twin whose parameters are drawn uniformly within their bounds, per trajectory.

    The baseline that needs no real data. It is as good as its bounds, which have to be set without
    data of the real system.

    Parameters
    ----------
    twin : ParametricTwin
        Declares the parameters and their bounds. Its present values give the nominal output
        where the twin has no nominal output that is free of parameters.

    References
    ----------
    J. Tobin et al., "Domain randomization for transferring deep neural networks from simulation
    to the real world", IROS (2017).

    """

    twin: ParametricTwin

    def _run(self, chunk: Chunk) -> tuple[NDArray, NDArray]:
        """Nominal and observed outputs."""
        low, high = self.twin.bounds
        rng = chunk_generator(chunk.seed, chunk, PARAMETERS)
        drawn = rng.uniform(low, high, size=(len(chunk.commands), len(low)))
        return simulate_with_parameters(self.twin, chunk, drawn, seed=chunk.seed)


def simulate_with_parameters(
    twin: ParametricTwin, chunk: Chunk, values: NDArray, *, seed: int
) -> tuple[NDArray, NDArray]:
    """Outputs of a chunk whose trajectories have different parameters.

    Parameters
    ----------
    twin : ParametricTwin
        The twin.
    chunk : Chunk
        n trajectories; those that fail are entered in its `failed`.
    values : ndarray, shape (n, k)
        One row of values per trajectory, one column per free parameter.
    seed : int
        Seed of the whole simulation.

    Returns
    -------
    nominal, observed : ndarray, shape (n, T, d_y)
        Outputs. The nominal ones do not depend on `values`: they are the twin's own, or else what
        it predicts at its present values.

    """
    rows = np.arange(len(chunk.commands))
    named = dict(zip(twin.names, values.T, strict=True))
    _, observed = simulate_chunk(twin, chunk, rows, seed=seed, parameters=named)
    if twin.nominal is not None:
        return nominal_outputs(twin.nominal, chunk.commands, len(twin.outputs)), observed
    ideal, _ = simulate_chunk(twin, chunk, rows, faults=[None] * len(rows), seed=seed)
    return ideal, observed
