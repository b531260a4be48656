"""Trajectories of a file as those of a twin: channels by name, units, and nominal outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from retwin.cases.named_signals import check_there
from retwin.checks import require
from retwin.data.trajectories import Channels, Trajectories
from retwin.twins.twin import Twin


def match_twin(
    found: Trajectories,
    twin: Twin,
    names: Mapping[str, str],
    name: str,
    notes: dict[str, list[str]],
    *,
    mapped: bool = False,
) -> Trajectories:
    """Trajectories with the channels of the twin, in its order.

    Parameters
    ----------
    found : Trajectories
        What was read.
    twin : Twin
        Its channels and sample rate are wanted; its outputs are the nominal ones.
    names : mapping of str to str
        The name in what was read, by channel of the twin; by default the same.
    name : str
        The file, for messages.
    notes : dict of str to list of str
        Notes with the files to which they apply, to which others are added.
    mapped : bool, default False
        Whether a mapping made the channels.

    Raises
    ------
    InputError
        Another rate or unit, a command that is missing, or all outputs.

    """
    require(
        np.isclose(found.rate, twin.rate, rtol=1e-3, atol=0),
        name,
        expected=f"{twin.rate:g} Hz, the sample rate of the twin",
        got=f"{found.rate:g} Hz",
        remedy="resample the log, or give --rate to a twin that takes one",
    )
    inputs = _places(found.inputs, twin.inputs, names, name, "command")
    outputs = _places(found.outputs, twin.outputs, names, name, "output")
    lacking = [n for n, at in zip(twin.inputs.names, inputs, strict=True) if at is None]
    there = [at is not None for at in outputs]
    require(
        not lacking and any(there),
        name,
        expected=f"the commands {', '.join(twin.inputs.names)} and at least one of the outputs "
        f"{', '.join(twin.outputs.names)}",
        got=f"commands {found.inputs}, outputs {found.outputs}",
        remedy="give --column CHANNEL=NAME for channels that have another name in the log"
        if not mapped
        else "rename the tables of the mapping, or have it proposed for the twin: retwin data map "
        "LOG --case plant.fmu",
    )
    taken = _units_taken(found.inputs, twin.inputs, inputs)
    taken += _units_taken(found.outputs, twin.outputs, outputs)
    if taken:
        text = f"the twin states no units of {', '.join(taken)}: taken as those of the log"
        notes.setdefault(text, []).append(name)
    shape = (*found.observed.shape[:2], len(outputs))
    observed, mask = np.zeros(shape), np.zeros(shape, dtype=bool)
    for channel, at in enumerate(outputs):
        if at is not None:
            observed[..., channel] = found.observed[..., at]
            mask[..., channel] = found.mask[..., at]
    commands = found.commands[..., [at for at in inputs if at is not None]]
    return found.replace(
        commands=commands,
        nominal=twin.simulate(commands, seed=0).nominal,
        observed=observed,
        mask=mask,
        rate=twin.rate,
        inputs=twin.inputs,
        outputs=twin.outputs,
    )


def _places(
    own: Channels, wanted: Channels, names: Mapping[str, str], name: str, what: str
) -> list[int | None]:
    """Where each channel of the twin is among those of a log; None where it is not."""
    prefix = "u" if what == "command" else "y"
    if own == Channels.numbered(prefix, len(wanted)):
        return list(range(len(wanted)))  # a log whose channels nobody has named
    places: list[int | None] = []
    for channel, unit in zip(wanted.names, wanted.units, strict=True):
        column = names.get(channel, channel)
        if channel in names:
            check_there(name, column, own.names)
        at = own.names.index(column) if column in own.names else None
        if at is not None:
            other = own.units[at]
            require(
                unit == other or "1" in (unit, other),
                name,
                expected=f"{what} {channel} in {unit}, the unit of the twin",
                got=other,
                remedy="convert the log",
            )
        places.append(at)
    return places


def _units_taken(own: Channels, wanted: Channels, places: Sequence[int | None]) -> list[str]:
    """Channels of a twin without a unit, with the unit that the log has."""
    channels = zip(wanted.names, wanted.units, places, strict=True)
    return [
        f"{channel} ({own.units[at]})"
        for channel, unit, at in channels
        if at is not None and unit == "1" and own.units[at] != "1"
    ]
