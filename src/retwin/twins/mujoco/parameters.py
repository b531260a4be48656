"""Fields of a MuJoCo model that differ between simulations, named by their place in the model."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np
from mujoco import batch as mujoco_batch
from numpy.typing import NDArray

from retwin.checks import require
from retwin.errors import InputError

PLACE = re.compile(
    r"opt\.(?P<option>\w+)(\[(?P<at>\d+)\])?"
    r"|(?P<kind>actuator|body|geom|joint|site|tendon)\.(?P<name>[^\[\]]+)\.(?P<field>\w+)"
    r"(\[(?P<index>\d+)\])?"
)
SHARED_OPTIONS = ("timestep", "integrator")
"""Options that are equal in all simulations, because their samples lie on one time grid."""


SUGGESTED = {
    "joint": ("damping", "frictionloss", "stiffness", "armature"),
    "actuator": ("gainprm", "biasprm"),
    "body": ("mass",),
}
"""The fields that are uncertain most often. There are many more."""
ALWAYS = ("damping", "frictionloss")
"""Of these, those that are suggested where they are 0 too: a model often leaves them out."""


def suggested_parameters(model: mujoco.MjModel) -> list[tuple[str, float]]:
    """Names and values of the numbers of a model that are uncertain most often.

    Parameters
    ----------
    model : mujoco.MjModel
        The model.

    Returns
    -------
    list of (str, float)
        Each as `set_parameter` takes it, with the model's value; numbers that are 0 are left out
        but for damping and friction.

    """
    found = []
    for kind, fields in SUGGESTED.items():
        count = {"joint": model.njnt, "actuator": model.nu, "body": model.nbody}[kind]
        for i in range(count):
            place = getattr(model, kind)(i)
            for field in fields if place.name else ():
                values = np.ravel(getattr(place, field)) if hasattr(place, field) else np.empty(0)
                for index, value in enumerate(values[:3].tolist()):
                    if value or (field in ALWAYS and index == 0):
                        at = f"[{index}]" if len(values) > 1 else ""
                        found.append((f"{kind}.{place.name}.{field}{at}", float(value)))
    return found


def parameter_value(model: mujoco.MjModel, name: str) -> float:
    """The value of a field of a model.

    Parameters
    ----------
    model : mujoco.MjModel
        The model.
    name : str
        Place of the field, see `set_parameter`.

    Raises
    ------
    InputError
        There is no such field.

    """
    with _parts(name) as (parts, index):
        if parts["option"]:
            return float(np.ravel(getattr(model.opt, parts["option"]))[index])
        kind, field = parts["kind"], parts["field"]
        place = getattr(model, kind)(parts["name"])
        if hasattr(place, field):
            return float(np.ravel(getattr(place, field))[index])
        # MuJoCo 4 hides the fields of tendons behind other names, but not the arrays of them all.
        return float(np.ravel(getattr(model, f"{kind}_{field}")[place.id])[index])


@contextmanager
def _parts(name: str) -> Iterator[tuple[re.Match[str], int]]:
    """The parts of a field's name, and its index; what fails in the block is an InputError."""
    try:
        parts = PLACE.fullmatch(name)
        if parts is None:
            raise KeyError("no such form")
        yield parts, int(parts["index"] or parts["at"] or 0)
    except InputError:
        raise
    except (KeyError, AttributeError, ValueError, IndexError, TypeError) as error:
        expected = '"KIND.NAME.FIELD[INDEX]" as in "joint.hip.damping", or "opt.FIELD[INDEX]"'
        got = f"{name!r} ({' '.join(str(error.args[0]).split())})"
        remedy = "name a body, joint, actuator, … of the model and one of its number fields"
        raise InputError("parameters", expected=expected, got=got, remedy=remedy) from None


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
    with _parts(name) as (parts, index):
        fits = parts["option"] not in SHARED_OPTIONS
        expected = "numbers that may differ between simulations"
        got = f"{name!r}, which they share"
        remedy = "set it in the model, or give the twin another step"
        require(fits, "parameters", expected=expected, got=got, remedy=remedy)
        if parts["option"]:
            field = batch.expand(f"opt.{parts['option']}")
            field.reshape(len(values), -1)[:, index] = values
            return
        place = getattr(batch, parts["kind"])(parts["name"])
        if not hasattr(place, parts["field"]):  # a field of a tendon
            every = batch.expand(f"{parts['kind']}_{parts['field']}")
            every.reshape(len(values), len(every[0]), -1)[:, place.id, index] = values
            return
        field = np.array(getattr(place, parts["field"]))
        field.reshape(len(values), -1)[:, index] = values
        setattr(place, parts["field"], field)
