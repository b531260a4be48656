"""A case as a file, `case.toml`: what a user's system is, without a change to retwin.

A table whose `kind` is a class of retwin holds that class's parameters, under their own names. Code
is named as `module:object`; a module that lies beside the file is found. Nothing else is run.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from retwin import catalog
from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords
from retwin.cases.named_twin import imported, parametric_twin, read_twin
from retwin.checks import positive
from retwin.data.io import load
from retwin.data.trajectories import HEALTHY, Channels, Trajectories
from retwin.errors import InputError
from retwin.nets.networks import NETWORKS, Network
from retwin.nets.training import Training
from retwin.serialisation.configs import (
    at,
    checked,
    fits,
    from_config,
    from_settings,
    key,
    named,
    table,
)
from retwin.twins.faults import ActuatorBias, Fault, Stuck
from retwin.twins.limits import Limits
from retwin.twins.parametric import Parameter
from retwin.twins.samplers import (
    CommandSampler,
    HoldSampler,
    MultisineSampler,
    RampSampler,
    RecordedSampler,
)
from retwin.twins.twin import Twin
from retwin.update.corrections import OPERATORS, Correction, DelayOffset
from retwin.update.residual import (
    Density,
    Flow,
    Mixture,
    Refinement,
    SequenceMixture,
)

__all__ = ["check_density", "read_case"]

SAMPLERS: tuple[type, ...] = (RampSampler, HoldSampler, MultisineSampler, RecordedSampler)
FAULTS: tuple[type, ...] = (Stuck, ActuatorBias)
MODELS: tuple[type, ...] = (
    *OPERATORS,
    *(Mixture, Flow, Refinement, SequenceMixture, Training),
    *NETWORKS,
)


@dataclass(frozen=True)
class _File:
    """What a case.toml may hold; see docs/own_twin.md."""

    name: str
    twin: Any
    title: str = ""
    rate: float | None = None
    sensor_rate: float | None = None
    inputs: Mapping[str, Any] | tuple[str, ...] = ()
    outputs: Mapping[str, Any] | tuple[str, ...] = ()
    parameters: Mapping[str, Any] = field(default_factory=dict)
    commands: Any = None
    faults: Mapping[str, Any] = field(default_factory=dict)
    correction: Correction | str = "delay_offset"
    output_correction: Correction | str | None = None
    density: Density | SequenceMixture | str | None = None
    network: Network | str = "mlp"
    training: Training | None = None
    records: Any = None


def read_case(path: str | Path) -> Case:
    """The case that a file *.toml describes; other files that it names lie relative to it.

    Raises
    ------
    InputError: no TOML, an unknown or missing key, a value of another type or that cannot be, a
        file or a Python name that is not there. It names the file and the key.

    """
    path, place = Path(path), f"{path}:"
    told = from_settings(_File, _read(path), MODELS, place=place)
    twin = read_twin(told.twin, told.inputs, told.outputs, told.rate, path.parent, place)
    parametric = None
    if told.parameters:
        inside = key(place, "parameters")
        free = [_parameter(name, value, inside) for name, value in told.parameters.items()]
        twin = parametric = parametric_twin(twin, free, inside)
    correction = _chosen(told.correction, catalog.CORRECTIONS, key(place, "correction"))
    stepwise = correction.resolution == "step"
    density = told.density or (SequenceMixture() if stepwise else Mixture())
    density = _chosen(density, catalog.DENSITIES, key(place, "density"))
    at_outputs = told.output_correction or (correction if stepwise else DelayOffset())
    at_outputs = _chosen(at_outputs, catalog.CORRECTIONS, key(place, "output_correction"))
    for operator in (correction, at_outputs):
        check_density(operator, density, key(place, "density"))
    sensor_rate = twin.rate if told.sensor_rate is None else told.sensor_rate
    with at(place):
        positive("sensor_rate", sensor_rate, unit="Hz")
    return Case(
        name=told.name,
        title=told.title or told.name,
        faults=_faults(told.faults, twin.inputs, path.parent, key(place, "faults")),
        twin=twin,
        emulator=None,
        sampler=_sampler(told.commands, twin, path.parent, key(place, "commands")),
        correction=correction,
        output_correction=at_outputs,
        sensor_rate=sensor_rate,
        parametric=parametric,
        network=_chosen(told.network, catalog.NETWORKS, key(place, "network")),
        training=told.training,
        density=density,
        records=_records(told.records, twin, path.parent, key(place, "records")),
    )


def check_density(
    correction: Correction, density: Density | SequenceMixture, place: str = "density"
) -> None:
    """InputError when a density cannot be that of the correction's z: per movement, or sample."""
    stepwise = correction.resolution == "step"
    if stepwise != isinstance(density, SequenceMixture):
        raise InputError(
            place,
            expected="SequenceMixture, for a correction with one z per sample"
            if stepwise
            else "Mixture or Flow, for a correction with one z per movement",
            got=type(density).__name__,
            remedy="leave it out, or choose another correction",
        )


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:  # UnicodeDecodeError and TOMLDecodeError are such
        raise InputError(
            str(path),
            expected="a case as a TOML file",
            got=f"{type(error).__name__}: {error}",
            remedy="see docs/own_twin.md for what it holds",
        ) from None


def _chosen(value: Any, entries: Mapping[str, catalog.Entry], place: str) -> Any:
    """What the catalog has by that name; or what a table has described already."""
    return catalog.make(entries, value, place) if isinstance(value, str) else value


def _own(name: str, folder: Path, place: str, protocol: type) -> Any:
    """An object of the user's own; of a class, one made without arguments."""
    found = imported(name, folder, place)
    found = found() if isinstance(found, type) else found
    if not fits(found, protocol):
        raise InputError(
            place,
            expected=f"a {protocol.__name__}",
            got=f"{name!r}, a {type(found).__name__}",
            remedy=f"see {protocol.__module__}.{protocol.__name__} for what it must have",
        )
    return found


def _parameter(name: str, value: Any, place: str) -> Parameter:
    inside = key(place, name)
    return from_settings(Parameter, {"name": name, **table(value, inside)}, place=inside)


def _faults(
    tables: Mapping[str, Any], inputs: Channels, folder: Path, place: str
) -> dict[str, Fault | None]:
    """Class name to fault, healthy first; an actuator is named as its channel is."""
    made: dict[str, Fault | None] = {HEALTHY: None}
    for name, value in tables.items():
        inside = key(place, name)
        if isinstance(value, str):
            made[name] = _own(value, folder, inside, Fault)
            continue
        settings = table(value, inside)
        if isinstance(settings.get("actuator"), str):
            numbers = {channel: i for i, channel in enumerate(inputs.names)}
            settings["actuator"] = named(settings["actuator"], numbers, key(inside, "actuator"))
        made[name] = from_config(settings, FAULTS, place=inside)
    return made


def _sampler(value: Any, twin: Twin, folder: Path, place: str) -> CommandSampler:
    """How commands are drawn: by one of our kinds, ramps if not told; or by the user's own."""
    if isinstance(value, str):
        own: CommandSampler = _own(value, folder, place, CommandSampler)
        return own
    settings = {"kind": RampSampler.__name__, **table({} if value is None else value, place)}
    if settings["kind"] == RecordedSampler.__name__:
        return _recorded(settings, twin, folder, place)
    limits: Limits | None = getattr(twin, "limits", None)
    if limits is not None:
        settings = {"low": list(limits.low), "high": list(limits.high), **settings}
    made: CommandSampler = from_config(settings, SAMPLERS, place=place)
    return made


def _recorded(settings: dict[str, Any], twin: Twin, folder: Path, place: str) -> RecordedSampler:
    """The commands of trajectories in a `file`."""
    file = settings.pop("file", None)
    if not isinstance(file, str):
        raise InputError(
            key(place, "file"),
            expected="the name of a file of trajectories",
            got=repr(file),
            remedy="write what `retwin data convert` wrote, *.npz or *.zarr",
        )
    with at(key(place, "file")):
        found = load(folder / file)
    if (found.inputs, found.rate) != (twin.inputs, twin.rate):
        raise InputError(
            key(place, "file"),
            expected=f"commands of {', '.join(twin.inputs.names)} at {twin.rate:g} Hz",
            got=f"{', '.join(found.inputs.names) or 'none'} at {found.rate:g} Hz",
            remedy="take data of this system",
        )
    settings.pop("kind")
    own = checked(RecordedSampler, settings, place=place, besides=("commands",))
    with at(place):
        return RecordedSampler(found.commands, **own)


def _records(
    value: Any, twin: Twin, folder: Path, place: str
) -> Callable[[Path], tuple[Trajectories, Trajectories]] | None:
    """How one file is split: by columns, or by the user's own function of its path."""
    if value is None:
        return None
    if isinstance(value, str):
        split: Callable[[Path], tuple[Trajectories, Trajectories]] = imported(value, folder, place)
        return split
    columns = checked(ColumnRecords, value, place=place, besides=("twin",))
    with at(place):
        return ColumnRecords(twin, **{"calibration": {}, "test": {}, **columns})
