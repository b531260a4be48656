"""A case as a file, `case.toml`: a user's own system, without a change to retwin.

A table whose `kind` is a class of retwin holds the parameters of that class, under their own names.
Code is named as `module:object`; a module beside the file is found. No other code is run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin import catalog
from retwin.cases.based_on import merge_bases, parameters_of, updated_built_in
from retwin.cases.case import Case
from retwin.cases.columns import ColumnRecords, Record
from retwin.cases.named_signals import LogSettings
from retwin.cases.named_twin import TwinKeys, delayed_twin, imported, parametric_twin, read_twin
from retwin.checks import agree, one_of, require
from retwin.data.io import load
from retwin.data.segments import Segments
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.nets.networks import Network
from retwin.nets.training import Training
from retwin.serialisation.configs import at, checked, fits, from_config, from_settings, key
from retwin.serialisation.places import real_path
from retwin.times import sample_rate
from retwin.twins.commands.record_sampler import sampler_from
from retwin.twins.commands.samplers import (
    CommandSampler,
    HoldSampler,
    MultisineSampler,
    RampSampler,
    RecordedSampler,
)
from retwin.twins.equations.state_twin import StateTwin
from retwin.twins.faults.actuator_faults import Fault
from retwin.twins.faults.system_faults import FAULTS, check_faults
from retwin.twins.fmu.twin import FMUTwin
from retwin.twins.limits import Limits
from retwin.twins.mujoco.twin import MuJoCoTwin
from retwin.twins.twin import Twin
from retwin.update.corrections import Correction, DelayOffset
from retwin.update.dynamics import Dynamics
from retwin.update.residual import Density, Mixture, SequenceMixture
from retwin.update.state_surrogate import StateSurrogate

SAMPLERS: tuple[type, ...] = (RampSampler, HoldSampler, MultisineSampler, RecordedSampler)
Records = Callable[[Path], tuple[Trajectories, Trajectories]]
"""A function that splits a file into calibration records and test records."""


@dataclass(frozen=True)
class _Columns:
    """The records of each set in a table: the column of each channel, a `Record`, or several."""

    calibration: Any = field(default_factory=dict)
    test: Any = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class CaseFile(TwinKeys):
    """The keys of a case.toml; see docs/own_twin.md."""

    title: str = ""
    folder: str = ""
    sensor_rate: float | None = None
    delays: dict[str, dict[str, Any]] = field(default_factory=dict)
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    commands: dict[str, Any] | str = field(default_factory=dict)
    faults: dict[str, dict[str, Any] | str] = field(default_factory=dict)
    causes: dict[str, dict[str, Any] | str] = field(default_factory=dict)
    correction: Correction | str | None = None
    output_correction: Correction | str | None = None
    density: Density | SequenceMixture | str | None = None
    dynamics: Dynamics = Dynamics()  # noqa: RUF009 - frozen
    state_surrogate: StateSurrogate = StateSurrogate()  # noqa: RUF009 - frozen
    network: Network | str | None = None
    training: Training | None = None
    records: _Columns | str | None = None
    logs: LogSettings = LogSettings()  # noqa: RUF009 - frozen


def read_case(path: str | Path) -> Case:
    """The case that a file *.toml describes; other files that it names lie relative to it.

    Raises
    ------
    InputError
        The file is no TOML, a key is unknown or missing, a value is of another type or refused by
        what it sets, or a file or Python name is not there. The message names the file and the key.

    """
    path, place = Path(path), f"{path}:"
    settings, home = merge_bases(path)
    if isinstance(home, str):
        return updated_built_in(home, settings, place)
    named = (catalog.CORRECTIONS, catalog.DENSITIES, catalog.NETWORKS)
    kinds = [kind for entries in named for kind in catalog.classes(entries)]
    keys = from_settings(CaseFile, settings, kinds, place=place)
    folder = home / keys.folder
    with at(key(place, "folder")):
        real_path(folder)
    twin = read_twin(keys, folder, place)
    inside = key(place, "delays")
    tables = {f"delay_{name}": {"unit": "s", **each} for name, each in keys.delays.items()}
    delays = parameters_of(tables, inside)
    if delays:
        twin = delayed_twin(twin, dict(zip(keys.delays, delays, strict=True)), inside)
    parametric = None
    if keys.parameters:
        inside = key(place, "parameters")
        free = parameters_of(keys.parameters, inside)
        free += [each for each in delays if each.name not in keys.parameters]
        twin = parametric = parametric_twin(twin, free, inside)
    elif isinstance(twin, StateTwin) and twin.free:
        twin = parametric = twin.parametric()
    records = _records(keys.records, twin, folder, key(place, "records"))
    # A sampler is code; a file of commands is data, which lies beside this file.
    beside = folder if isinstance(keys.commands, str) else home
    sampler = _sampler(keys.commands, twin, records, beside, key(place, "commands"))
    correction, density, at_outputs = _residual(keys, sampler, place)
    network = keys.network or ("mlp" if _is_static(twin, sampler) else "lstm")
    sensor_rate = twin.rate if keys.sensor_rate is None else keys.sensor_rate
    faults = {HEALTHY: None, **_faults(keys.faults, twin, folder, key(place, "faults"))}
    causes = _faults(keys.causes, twin, folder, key(place, "causes"))
    network = _choose(network, catalog.NETWORKS, key(place, "network"))
    sensor_rate = sample_rate(key(place, "sensor_rate"), sensor_rate)
    with at(place):
        return Case(
            name=keys.name,
            title=keys.title or keys.name,
            faults=faults,
            twin=twin,
            sampler=sampler,
            correction=correction,
            output_correction=at_outputs,
            sensor_rate=sensor_rate,
            parametric=parametric,
            network=network,
            training=keys.training,
            density=density,
            records=records,
            logs=keys.logs.of_folder(home, key(place, "logs")),
            dynamics=keys.dynamics,
            state_surrogate=keys.state_surrogate,
            causes=causes,
        )


def _residual(
    keys: CaseFile, sampler: CommandSampler, place: str
) -> tuple[Correction, Density | SequenceMixture, Correction]:
    """The correction, its density, and the correction at the outputs; defaults by the commands."""
    correction = _choose(
        keys.correction or ("delay_offset" if _has_segments(sampler) else "additive"),
        catalog.CORRECTIONS,
        key(place, "correction"),
    )
    stepwise = correction.resolution == "step"
    density = keys.density or (SequenceMixture() if stepwise else Mixture())
    density = _choose(density, catalog.DENSITIES, key(place, "density"))
    at_outputs = keys.output_correction or (correction if stepwise else DelayOffset())
    at_outputs = _choose(at_outputs, catalog.CORRECTIONS, key(place, "output_correction"))
    check_density(correction, density, key(place, "density"))
    require(
        at_outputs.resolution == correction.resolution,
        key(place, "output_correction"),
        expected=f"a correction with one z per {'sample' if stepwise else 'segment'}, as that of "
        "`correction`",
        got=type(at_outputs).__name__,
        remedy="leave it out, or choose another correction",
    )
    return correction, density, at_outputs


def check_density(
    correction: Correction, density: Density | SequenceMixture, place: str = "density"
) -> None:
    """Check that a density has one z where the correction has one: per segment, or per sample.

    Raises InputError, about `place`, if it has not.
    """
    stepwise = correction.resolution == "step"
    require(
        stepwise == isinstance(density, SequenceMixture),
        place,
        expected="SequenceMixture, for a correction with one z per sample"
        if stepwise
        else "Mixture or Flow, for a correction with one z per segment",
        got=type(density).__name__,
        remedy="leave it out, so that it suits the correction, or choose another correction",
    )


def _has_segments(sampler: CommandSampler) -> bool:
    """Whether commands move and rest, so that a discrepancy per segment is more than an offset."""
    drawn = sampler.sample(2, rng=np.random.default_rng(0))
    return Segments.from_commands(drawn).max_count > 1


def _is_static(twin: Twin, sampler: CommandSampler) -> bool:
    """Whether each ideal output depends on the command of the same sample alone.

    Then samples in another order give the same outputs in that order. MuJoCo models and FMUs are
    taken to have memory, without a simulation.
    """
    inner = getattr(twin, "twin", twin)
    if isinstance(inner, FMUTwin | MuJoCoTwin):
        return False
    rng = np.random.default_rng(0)
    drawn = np.asarray(sampler.sample(1, rng=rng), dtype=float)
    order = rng.permutation(drawn.shape[1])
    try:
        ideal, other = (twin.simulate(u, seed=0).nominal for u in (drawn, drawn[:, order]))
    except (Exception, SystemExit):  # of the user's code: reported where the twin is used
        return False
    scale = float(np.abs(ideal).max(initial=0.0))
    return bool(np.allclose(ideal[:, order], other, rtol=0, atol=1e-6 * scale))


def _choose(value: Any, entries: Mapping[str, catalog.Entry], place: str) -> Any:
    """The implementation of that name in the catalog; an object stays as it is."""
    return catalog.make(entries, value, place) if isinstance(value, str) else value


def _own(name: str, folder: Path, place: str, protocol: type) -> Any:
    """An object of the user's own; of a class, one made without arguments."""
    found = imported(name, folder, place)
    found = found() if isinstance(found, type) else found
    got = f"{name!r}, a {type(found).__name__}"
    remedy = f"see {protocol.__module__}.{protocol.__name__} for what it must have"
    require(fits(found, protocol), place, expected=f"a {protocol.__name__}", got=got, remedy=remedy)
    return found


def _faults(tables: Mapping[str, Any], twin: Twin, folder: Path, place: str) -> dict[str, Fault]:
    """Name to fault; actuators and outputs may be named as channels are.

    Raises InputError for a fault that the twin cannot have.
    """
    made: dict[str, Fault] = {}
    for name, value in tables.items():
        inside = key(place, name)
        if isinstance(value, str):
            made[name] = _own(value, folder, inside, Fault)
            continue
        for part, channels in (("actuator", twin.inputs), ("output", twin.outputs)):
            if isinstance(value.get(part), str):
                channel = one_of(key(inside, part), value[part], channels.names)
                value = {**value, part: channels.names.index(channel)}
        made[name] = fault = from_config(value, FAULTS, place=inside)
        with at(inside):
            shiftable = getattr(twin, "shiftable", ())
            check_faults([fault], len(twin.inputs), len(twin.outputs), shiftable)
    return made


def _sampler(
    value: Any, twin: Twin, records: Records | None, folder: Path, place: str
) -> CommandSampler:
    """The distribution of commands: like those of a `file`, of a kind, or of the user's own."""
    if isinstance(value, str):
        return _own(value, folder, place, CommandSampler)
    remedy = 'write file = "RECORD" for commands like recorded ones, or `kind` and its settings'
    require(value, place, expected="how commands are drawn", got="nothing", remedy=remedy)
    limits: Limits | None = getattr(twin, "limits", None)
    if set(value) == {"file"}:
        return sampler_from(
            _read_commands(value, twin, records, folder, place), twin.rate, limits=limits
        )
    settings = {"kind": RampSampler.__name__, "rate": twin.rate, **value}
    if settings["kind"] == RecordedSampler.__name__:
        options = {name: v for name, v in settings.items() if name not in ("kind", "file")}
        own_settings = checked(RecordedSampler, options, place=place, besides=("commands",))
        commands = _read_commands(settings, twin, records, folder, place)
        with at(place):
            return RecordedSampler(commands, **own_settings)
    if limits is not None:
        settings = {"low": limits.low, "high": limits.high, **settings}
    return from_config(settings, SAMPLERS, place=place)


def _read_commands(
    settings: Mapping[str, Any], twin: Twin, records: Records | None, folder: Path, place: str
) -> NDArray:
    """The commands (n, T, d_u) of trajectories in a `file`, or of a table's calibration records."""
    file = settings.get("file")
    require(
        isinstance(file, str),
        key(place, "file"),
        expected="the name of a file of trajectories",
        got=repr(file),
        remedy="write what `retwin data convert` wrote, *.npz or *.zarr",
    )
    with at(key(place, "file")):
        path = folder / str(file)
        folder_of_records = getattr(records, "in_folder", False) and path.is_dir()
        if records is not None and (path.suffix.lower() == ".csv" or folder_of_records):
            found, _ = records(path)
        else:
            found = load(path)
    names, remedy = ("inputs", "rate"), "take data of this system"
    agree(key(place, "file"), found, twin, "that of the twin", names=names, remedy=remedy)
    return found.commands


def _records(value: _Columns | str | None, twin: Twin, folder: Path, place: str) -> Records | None:
    """How one file is split: by columns, or by the user's own function of its path."""
    if value is None:
        return None
    if isinstance(value, str):
        function = imported(value, folder, place)
        return partial(_checked_split, function, twin, f"{place} ({value})")
    sets = {}
    for name, own in vars(value).items():  # a table of columns or of a record, or several
        tables = own if isinstance(own, tuple) else (own,)
        full = (isinstance(t, Mapping) and isinstance(t.get("columns"), Mapping) for t in tables)
        settings = [t if whole else {"columns": t} for t, whole in zip(tables, full, strict=True)]
        inside = key(place, name)
        sets[name] = [from_settings(Record, each, place=inside) for each in settings]
    with at(place):
        return ColumnRecords(twin, **sets)


def _checked_split(
    function: Any, twin: Twin, place: str, path: Path
) -> tuple[Trajectories, Trajectories]:
    """The records that a user's function gives, checked."""
    made = function(Path(path))
    fine = isinstance(made, tuple) and len(made) == 2
    fine = fine and all(isinstance(each, Trajectories) for each in made)
    expected = "a function that returns two Trajectories, for calibration and for tests"
    got = f"one that returned {made!r:.80}"
    require(fine, place, expected=expected, got=got, remedy="return (calibration, test)")
    for each in made:
        remedy = "give them the channels and the rate of the twin"
        agree(place, each, twin, "that of the twin", remedy=remedy)
    calibration, test = made
    return calibration, test
