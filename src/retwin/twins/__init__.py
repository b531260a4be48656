"""Simulators: the `Twin` protocol, faults, command samplers, and one file per kind of twin.

Belongs here: whatever turns commands into outputs and needs nothing but its own equations or files.
Not here: learned twins (see `update`) and the twins of built-in systems (see `cases`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from retwin.catalog import TWINS, resolve
from retwin.data.trajectories import Channels
from retwin.errors import InputError

if TYPE_CHECKING:  # whoever needs one twin need not load what another one needs
    from retwin.twins.twin import Twin

__all__ = ["get"]

FORMS = "package.module:object, *.fmu, *.xml or *.urdf"


def get(
    name: str,
    *,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    rate: float | None = None,
    outside: Literal["refuse", "clip"] = "refuse",
) -> Twin:
    """The twin of that name.

    | name | is |
    |---|---|
    | `armpi`, `armpi-kinematic`, … | one of `retwin.catalog.TWINS` |
    | `package.module:object` | a twin, or what makes one when called without arguments |
    | `package.module:function` | a function from commands (n, T, d_u) to outputs (n, T, d_y) |
    | `*.fmu` | an FMU for co-simulation |
    | `*.xml`, `*.urdf` | a MuJoCo model |

    Parameters
    ----------
    name: see above.
    inputs, outputs: names of the channels. Of a file, by default all; a function needs both.
    rate: samples per second. Of a file, by default 100; a function needs it.
    outside: what files do with commands outside their limits, "refuse" or "clip".

    Raises
    ------
    InputError: there is no such twin, it cannot be made, a package is missing, or channels or a
        rate are given for a twin that has its own.

    """
    suffix = Path(name).suffix.lower()
    if name in TWINS or ":" in name:
        return _from_module(name, inputs, outputs, rate)
    options: dict[str, Any] = {"inputs": tuple(inputs), "outputs": tuple(outputs)}
    if rate is not None:
        options["rate"] = rate
    if suffix in (".fmu", ".xml", ".urdf"):
        if not Path(name).is_file():
            raise _unknown(name, "no file of that name")
        if suffix == ".fmu":
            from retwin.twins.fmu import FMUTwin

            return FMUTwin.from_file(name, outside=outside, **options)
        from retwin.twins.mujoco import MuJoCoTwin

        return MuJoCoTwin.from_file(name, outside=outside, **options)
    raise _unknown(name, "no such twin")


def _from_module(
    name: str, inputs: Sequence[str], outputs: Sequence[str], rate: float | None
) -> Twin:
    from retwin.twins.twin import Twin

    try:
        found = resolve(TWINS[name].target if name in TWINS else name)
    except (ImportError, AttributeError, ValueError) as error:
        raise _unknown(name, str(error)) from None
    # A class satisfies the protocol too, but it makes a twin and is none.
    if isinstance(found, type) or not isinstance(found, Twin):
        if callable(found) and not _takes_none(found):
            return _of_function(name, found, inputs, outputs, rate)
        found = found() if callable(found) else found
    if not isinstance(found, Twin):
        raise _unknown(name, f"a {type(found).__name__}")
    if inputs or outputs or rate is not None:
        raise InputError(
            f"twin {name!r}",
            expected="neither channels nor a rate, since it has its own",
            got=f"inputs {list(inputs)}, outputs {list(outputs)}, rate {rate}",
            remedy="leave them out",
        )
    return found


def _of_function(
    name: str,
    function: Callable[..., Any],
    inputs: Sequence[str],
    outputs: Sequence[str],
    rate: float | None,
) -> Twin:
    if not (inputs and outputs and rate):
        raise InputError(
            f"twin {name!r}",
            expected="inputs, outputs and rate, which a function does not tell",
            got=f"inputs {list(inputs)}, outputs {list(outputs)}, rate {rate}",
            remedy="name the channels and the rate, or name an object that is a FunctionTwin",
        )
    from retwin.twins.function import FunctionTwin

    told, made = (Channels(tuple(each), ("1",) * len(each)) for each in (inputs, outputs))
    return FunctionTwin(function, told, made, rate)


def _takes_none(function: Callable[..., Any]) -> bool:
    """Whether it can be called without arguments: then it makes a twin, and is none itself."""
    try:
        inspect.signature(function).bind()
    except (TypeError, ValueError):  # arguments are missing, or it does not tell
        return False
    return True


def _unknown(name: str, got: str) -> InputError:
    return InputError(
        f"twin {name!r}",
        expected=f"{', '.join(TWINS)}, {FORMS}",
        got=" ".join(got.split()),
        remedy="check the spelling, or that the module or file can be read",
    )
