"""Values of parameters that differ between simulations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from retwin.checks import one_of, require


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
        require(
            numbers and array.shape in ((), (count,)),
            "parameters",
            expected=f"finite numbers: one for all, or one per trajectory, {count}",
            got=f"{name}: {shape}",
            remedy="give as many values as there are trajectories",
        )
        values[name] = np.broadcast_to(array.astype(float), count)
    return values
