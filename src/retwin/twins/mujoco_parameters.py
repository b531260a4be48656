"""Fields of a MuJoCo model that differ between simulations, named by their place in the model."""

from __future__ import annotations

import re

import numpy as np
from mujoco import batch as mujoco_batch
from numpy.typing import NDArray

from retwin.checks import require
from retwin.errors import InputError

__all__ = ["set_parameter"]

PLACE = re.compile(
    r"opt\.(?P<option>\w+)(\[(?P<at>\d+)\])?"
    r"|(?P<kind>actuator|body|geom|joint|site|tendon)\.(?P<name>[^\[\]]+)\.(?P<field>\w+)"
    r"(\[(?P<index>\d+)\])?"
)
SHARED_OPTIONS = ("timestep", "integrator")
"""Options that are equal in all simulations, because their samples lie on one time grid."""


def set_parameter(batch: mujoco_batch.Batch, name: str, values: NDArray) -> None:
    """Give a model field a different value in each simulation.

    Parameters
    ----------
    batch : mujoco.batch.Batch
        n simulations of one model.
    name : str
        Place of the field: "KIND.NAME.FIELD[INDEX]", as "joint.hip.damping", or
        "opt.FIELD[INDEX]", as "opt.gravity[2]".
    values : ndarray, shape (n,)
        One value per simulation, in the model's unit.

    Raises
    ------
    InputError
        There is no such field, or all simulations must share it.

    """
    parts = PLACE.fullmatch(name)
    require(
        parts is None or parts["option"] not in SHARED_OPTIONS,
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
