"""Numbers of a MuJoCo model that differ from one simulation to the next, by their place in it."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from mujoco import batch as mujoco_batch
from numpy.typing import ArrayLike, NDArray

from retwin.errors import InputError

__all__ = ["per_simulation", "set_parameter"]

PLACE = re.compile(
    r"opt\.(?P<option>\w+)(\[(?P<at>\d+)\])?"
    r"|(?P<kind>actuator|body|geom|joint|site|tendon)\.(?P<name>[^\[\]]+)\.(?P<field>\w+)"
    r"(\[(?P<index>\d+)\])?"
)
OF_TIME = ("timestep", "integrator")
"""Options that all simulations share: samples lie on one time grid."""


def per_simulation(parameters: Mapping[str, ArrayLike] | None, count: int) -> dict[str, NDArray]:
    """The values of each parameter, (count,).

    Raises InputError for anything but finite numbers, one for all simulations or one each.
    """
    own = {}
    for name, values in (parameters or {}).items():
        array = np.asarray(values)
        numbers = array.dtype.kind in "biuf" and bool(np.isfinite(array).all())
        if not numbers or array.shape not in ((), (count,)):
            got = f"{array.dtype} of shape {array.shape}" if array.ndim else repr(values)
            raise InputError(
                "parameters",
                expected=f"finite numbers, one for all simulations or one each, {count}",
                got=f"{name}: {got}",
                remedy="give as many values as there are trajectories",
            )
        own[name] = np.broadcast_to(array.astype(float), count)
    return own


def set_parameter(batch: mujoco_batch.Batch, name: str, values: NDArray) -> None:
    """Give a model field a value of its own in every simulation, (n,).

    Raises InputError when there is no such field, or all simulations must share it.
    """
    parts = PLACE.fullmatch(name)
    if parts is not None and parts["option"] in OF_TIME:
        raise InputError(
            "parameters",
            expected="numbers that may differ between simulations",
            got=f"{name!r}, which they share",
            remedy="set it in the model, or give the twin another step",
        )
    try:
        if parts is None:
            raise KeyError("no such form")
        index = int(parts["index"] or parts["at"] or 0)
        if parts["option"]:
            field = batch.expand(f"opt.{parts['option']}")
            field.reshape(len(values), -1)[:, index] = values
            return
        place = getattr(batch, parts["kind"])(parts["name"])
        field = np.array(getattr(place, parts["field"]))
        field.reshape(len(values), -1)[:, index] = values
        setattr(place, parts["field"], field)
    except (KeyError, AttributeError, ValueError, IndexError) as error:
        raise InputError(
            "parameters",
            expected='"KIND.NAME.FIELD[INDEX]" as in "joint.hip.damping", or "opt.FIELD[INDEX]"',
            got=f"{name!r} ({' '.join(str(error.args[0]).split())})",
            remedy="name a body, joint, actuator, … of the model and one of its number fields",
        ) from None
