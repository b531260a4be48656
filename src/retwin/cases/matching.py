"""What was measured as trajectories of a twin: channels by name, units, and what is usable."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from retwin.cases.named_signals import check_there
from retwin.checks import require
from retwin.data.logs.units import converted
from retwin.data.trajectories import HEALTHY, Channels, Trajectories
from retwin.errors import InputError
from retwin.twins.collected import SimulationError
from retwin.twins.twin import Twin
from retwin.update.forecast_errors import value_range

Notes = dict[str, list[str]]
"""What was done while logs were read, and the names of the files to which that applies."""
Places = list[int | None]
"""The column of each channel among those of a log; None for one that the log does not have."""
CONSTANT = "constant in what was read, which therefore shows no dynamics of it."
"""What is noted of channels that never change."""


def match_twin(
    found: Trajectories,
    twin: Twin,
    names: Mapping[str, str],
    name: str,
    notes: Notes,
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
        Another rate, a unit that is not converted, a command that is missing, or all outputs.

    """
    require(
        np.isclose(found.rate, twin.rate, rtol=1e-3, atol=0),
        name,
        expected=f"{twin.rate:g} Hz, the sample rate of the twin",
        got=f"{found.rate:g} Hz",
        remedy="resample the log, or give --rate to a twin that takes one",
    )
    inputs = _places(found.inputs, twin.inputs, names, name, "u")
    outputs = _places(found.outputs, twin.outputs, names, name, "y")
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
    taken = _describe_units(found.inputs, twin.inputs, inputs)
    taken += _describe_units(found.outputs, twin.outputs, outputs)
    if taken:
        text = f"the twin states no units of {', '.join(taken)}: taken as those of the log"
        text += ", so that 100 % is 100 and not 1" * any("(%)" in each for each in taken)
        notes.setdefault(text, []).append(name)
    commands = _columns(found.commands, found.inputs, inputs, twin.inputs, name, notes)
    observed = _columns(found.observed, found.outputs, outputs, twin.outputs, name, notes)
    none = np.zeros(found.mask.shape[:2], dtype=bool)
    mask = np.stack([none if at is None else found.mask[..., at] for at in outputs], axis=-1)
    try:
        nominal = twin.simulate(commands, seed=0).nominal
    except SimulationError as error:
        ends = zip(twin.inputs.names, *value_range(commands), strict=True)
        ranges = ", ".join(f"{channel} {low:.4g} to {high:.4g}" for channel, low, high in ends)
        expected = "commands that the twin can simulate"
        got = f"{ranges}, with which {error}"
        remedy = "is each in the unit of the twin? Otherwise its equations or starts do not hold"
        raise InputError(name, expected=expected, got=got, remedy=remedy) from error
    return found.replace(
        commands=commands,
        nominal=nominal,
        observed=observed,
        mask=mask,
        rate=twin.rate,
        inputs=twin.inputs,
        outputs=twin.outputs,
    )


def _places(
    own: Channels, wanted: Channels, names: Mapping[str, str], name: str, prefix: str
) -> Places:
    """Where each channel of the twin is among those of a log; None where it is not."""
    if own == Channels.numbered(prefix, len(wanted)):
        return list(range(len(wanted)))  # a log whose channels nobody has named
    places: Places = []
    for channel in wanted.names:
        column = names.get(channel, channel)
        if channel in names:
            check_there(name, column, own.names)
        places.append(own.names.index(column) if column in own.names else None)
    return places


def _columns(
    values: NDArray, own: Channels, places: Places, wanted: Channels, name: str, notes: Notes
) -> NDArray:
    """Values (n, T, d) of the channels of the twin in its units; 0 of those that are not there."""
    made = np.zeros((*values.shape[:2], len(places)))
    for place, (at, channel) in enumerate(zip(places, wanted.names, strict=True)):
        if at is None:
            continue
        source, target = own.units[at], wanted.units[place]
        made[..., place] = values[..., at]
        if source != target and "1" not in (source, target):
            made[..., place] = converted(values[..., at], source, target, f"{name}, {channel}")
            notes.setdefault(f"{channel}: {source} to {target}", []).append(name)
    return made


def _describe_units(own: Channels, wanted: Channels, places: Places) -> list[str]:
    """Channels of a twin without a unit, with the unit that the log has."""
    channels = zip(wanted.names, wanted.units, places, strict=True)
    return [
        f"{channel} ({own.units[at]})"
        for channel, unit, at in channels
        if at is not None and unit == "1" and own.units[at] != "1"
    ]


def usable(found: Trajectories, notes: Notes, transient: float) -> Trajectories:
    """The healthy and the unlabelled trajectories, without their outputs in the first seconds.

    Parameters
    ----------
    found : Trajectories
        Those of all logs.
    notes : dict of str to list of str
        Takes notes about all logs together.
    transient : float
        Duration in s.

    Raises
    ------
    InputError
        None is healthy, a number stands for a missing measurement, or no output is left.

    """
    kept = found.maybe_healthy
    expected = f"a trajectory without a label, or labelled {HEALTHY}"
    got = f"labels {', '.join(sorted(found.known_labels))}"
    remedy = "identify the parameters of a healthy system"
    require(kept.any(), "logs", expected=expected, got=got, remedy=remedy)
    if not kept.all():
        notes[f"{int((~kept).sum())} trajectories of other classes are not used."] = []
    joined = found[kept]
    _check_size(joined)
    mask = joined.mask.copy()
    mask[:, : round(transient * joined.rate)] = False
    expected = f"less than the {joined.steps / joined.rate:g} s of the longest trajectory"
    got = f"{transient:g} s"
    remedy = "give a shorter transient"
    require(mask.any() or not transient, "transient", expected=expected, got=got, remedy=remedy)
    joined = joined.replace(mask=mask)
    unseen = ~joined.mask.any(axis=(0, 1))
    if unseen.any():
        lacking = ", ".join(np.array(joined.outputs.names)[unseen])
        notes[f"No log holds {lacking}."] = []
    constant = ", ".join(_constant(joined))
    if constant:
        notes[f"{constant}: {CONSTANT}"] = []
    return joined


def _check_size(found: Trajectories, *, largest: float = 1e30) -> None:
    """Refuse numbers that stand for missing measurements.

    Parameters
    ----------
    largest : float, default 1e+30
        Magnitude from which a number is no measurement: programs write 3.4e38 for a missing one.

    """
    for name, values in (("observed", found.observed), ("commands", found.commands)):
        large = np.argwhere(np.abs(values) >= largest)
        channels = found.outputs if name == "observed" else found.inputs
        if len(large):
            row, sample, channel = large[0]
            expected = f"numbers below {largest:g}"
            got = f"{values[row, sample, channel]:g} for {channels.names[channel]} at "
            got += f"{sample / found.rate:g} s"
            remedy = "leave the cell empty, or write NaN, where a measurement is missing"
            raise InputError(str(found.ids[row]), expected=expected, got=got, remedy=remedy)


def _constant(found: Trajectories) -> list[str]:
    """Channels that never change, among the commands and the outputs that were measured."""
    every = np.moveaxis(np.concatenate([found.commands, found.measured], axis=2), 2, 0)
    return [
        name
        for name, each in zip((*found.inputs.names, *found.outputs.names), every, strict=True)
        if np.isfinite(each).any() and float(np.nanmax(each)) == float(np.nanmin(each))
    ]
