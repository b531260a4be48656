"""`retwin identify`: a user's own twin, its parameters identified from his logs."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

from retwin import catalog
from retwin.checks import existing, one_of, require
from retwin.cli import options
from retwin.cli.options import argument, complete_twins, option, rare
from retwin.cli.reading import log_reader, shown_records
from retwin.cli.terminal import answer, bar, command_given, note, table
from retwin.serialisation.places import check_place

if TYPE_CHECKING:
    from collections.abc import Sequence

    from retwin.cases.logs import Columns, LogReader, Logs
    from retwin.cases.opened_twin import OpenedTwin
    from retwin.data.quality.check import Checked
    from retwin.data.trajectories import Trajectories
    from retwin.evaluation.identification.validation import Identification

UNRATED = (".fmu", ".xml", ".urdf")
"""Suffixes of twins that take any sample rate."""


TwinName = Annotated[
    str, argument("TWIN", "*.fmu, *.xml, module:object, or a case.", autocompletion=complete_twins)
]
LogFiles = Annotated[list[Path], argument("LOG…", "Tables *.csv, or what rt.load reads.")]
Out = Annotated[Path, option("FOLDER", "Where the results go.")]
Free = Annotated[list[str] | None, option("NAME=LOW:HIGH", "A free parameter; or with :START.")]
MethodName = Annotated[
    str,
    option(
        "NAME", "least_squares, evolution, bayes or npe.", "--method", names=catalog.IDENTIFICATIONS
    ),
]
HoldOut = Annotated[float | None, option("X", "Share held out; else 0.25.")]
Loss = Annotated[str | None, rare("NAME", "soft_l1 (default), linear or cauchy.")]
Starts = Annotated[int | None, rare("N", "Starts of the search; else 4.", min=1, max=1000)]
SensorRate = Annotated[float | None, rare("HZ", "True rate of the sensor, if lower.")]
Horizon = Annotated[str, rare("SECONDS", "Windows to predict, or free.")]
Processes = Annotated[int, rare("N", "Worker processes.", min=1, max=256)]
Column = Annotated[list[str] | None, rare("CHANNEL=NAME", "Column of a channel named otherwise.")]
Time = Annotated[str | None, rare("NAME", "Column of the times; NAME=ms, us, ns, iso.")]
Transient = Annotated[float, rare("SECONDS", "Begin of each log that is not used.")]
Rate = Annotated[float | None, option("HZ", "Samples per second; else the log's.")]


def identify(
    twin: TwinName,
    logs: LogFiles,
    out: Out,
    free: Free = None,
    inputs: options.Inputs = "",
    outputs: options.Outputs = "",
    rate: Rate = None,
    mapping: options.LogMapping = None,
    method: MethodName = "least_squares",
    hold_out: HoldOut = None,
    seed: options.Seed = 0,
    as_json: options.Json = False,
    column: Column = None,
    time: Time = None,
    transient: Transient = 0.0,
    horizon: Horizon = "",
    loss: Loss = None,
    starts: Starts = None,
    sensor_rate: SensorRate = None,
    processes: Processes = 1,
    max_bytes: options.MaxBytes = None,
) -> None:
    """Identify the parameters of your twin from logs.

    Writes report.html, identification.json, the measurements as logs.npz, and a
    case, updated.toml. A module that is named by the twin or its case is run
    with your rights.
    """
    from retwin.cases import Columns, LogReader
    from retwin.deploy.identified import HOLDS, save_identification
    from retwin.evaluation.identification import validation as room
    from retwin.twins import keep_workers
    from retwin.update.agreement import check_with_twin
    from retwin.update.identification import identify as run

    check_place(out, folder=True, holds=HOLDS)
    settings = _method(method, loss, starts)
    # Free is an infinite horizon, and none is one that is chosen.
    ahead = {"horizon": options.seconds_of("--horizon", horizon) or inf} if horizon else {}
    columns = replace(_columns(column, time, transient), mapping=mapping)
    names = [options.channel_names(each) for each in (inputs, outputs)]
    for log in logs:
        joined = "check the name; several names after an option are joined by commas: a,b"
        existing("LOG", log, log.exists(), remedy=joined)
    reader = LogReader(columns, max_bytes)
    opened, left_out = _opened(twin, logs, reader, free or (), names, rate)
    if columns == Columns() and opened.case is not None:
        reader = log_reader(logs[0], opened.case, opened.twin, max_bytes)
    with keep_workers(), bar("identify") as show:
        read = reader.trajectories(
            logs,
            opened.twin,
            case=opened.case,
            rows_at_rate=rate is not None or Path(twin).suffix.lower() not in UNRATED,
            progress=lambda share: show("read, 1 of 3", share),
        )
        if left_out:
            text = f"Outputs that no log holds are left out: {', '.join(left_out)}."
            read = replace(read, notes=(*read.notes, text))
        used, held_out = _separated(read, hold_out, seed)
        note(_plan(opened, used, held_out, method))
        found = run(
            opened.twin,
            used,
            settings,
            seed=seed,
            rate=sensor_rate,
            processes=processes,
            **ahead,
            progress=lambda share: show("search, 2 of 3", share),
        )
        show("validate, 3 of 3", 0.0)
        judged = room.validate_identification(found, opened.twin, used, held_out, seed=seed)
        checked = check_with_twin(opened.twin, read.trajectories)
        values = save_identification(
            judged, opened, read, out, checked=checked, command=command_given()
        )
    _print(judged, values, checked, as_json=as_json)


def _separated(
    read: Logs, share: float | None, seed: int
) -> tuple[Trajectories, Trajectories | None]:
    """What is used and what is held out: the test of the case, unless a share is given."""
    from retwin.evaluation.identification.hold_out import SHARE, hold_out

    if read.test is not None and share is None:
        return read.trajectories, read.test
    return hold_out(read.trajectories, SHARE if share is None else share, seed=seed)


def _opened(
    twin: str,
    logs: list[Path],
    reader: LogReader,
    free: Sequence[str],
    names: list[tuple[str, ...]],
    rate: float | None,
) -> tuple[OpenedTwin, list[str]]:
    """The twin, at the rate of the log if it takes any, and outputs that it lacks.

    Those are, of an FMU and by default, the ones that no log holds.
    """
    from retwin.cases import open_parametric

    inputs, outputs = names
    if rate is None and ":" in twin and inputs and outputs:  # a function has no rate of its own
        rate = reader.rate(logs[0], (*inputs, *outputs))
    opened = open_parametric(twin, free, inputs=inputs, outputs=outputs, rate=rate)
    suffix = Path(twin).suffix.lower()
    if rate is None and suffix in UNRATED:
        rate = reader.rate(logs[0], (*opened.twin.inputs.names, *opened.twin.outputs.names))
    held = opened.twin.outputs.names
    if not outputs and opened.case is None and suffix == ".fmu":
        held = reader.measured_outputs(logs, opened.twin) or held
    others = [name for name in opened.twin.outputs.names if name not in held]
    if others:
        outputs = held
    if others or (rate is not None and rate != opened.twin.rate):
        opened = open_parametric(twin, free, inputs=inputs, outputs=outputs, rate=rate)
    return opened, others


def _method(name: str, loss: str | None, starts: int | None) -> Any:
    """The settings of the method of that name."""
    from retwin.update.identification.search import Loss as Losses

    one_of("--method", name, catalog.IDENTIFICATIONS)
    settings: dict[str, Any] = {}
    if loss is not None:
        settings["loss"] = one_of("--loss", loss, get_args(Losses))
    if starts is not None:
        settings["starts"] = starts
    taken = {"least_squares": ("loss", "starts"), "evolution": ("loss",), "bayes": ("starts",)}
    for given in settings:
        methods = [each for each, names in taken.items() if given in names]
        expected = f"none with --method {name}"
        remedy = f"leave it out; {' and '.join(methods)} take it"
        require(
            name in methods, f"--{given}", expected=expected, got=settings[given], remedy=remedy
        )
    return catalog.resolve(catalog.IDENTIFICATIONS[name].target)(**settings)


def _columns(column: list[str] | None, time: str | None, transient: float) -> Columns:
    """Which columns of a log are the channels of the twin."""
    from retwin.cases import Columns
    from retwin.cases.named_signals import time_column

    names = {}
    for text in column or ():
        channel, _, name = text.partition("=")
        paired = channel and name and channel not in names
        expected = "CHANNEL=COLUMN, each channel once"
        remedy = "write for instance --column speed=omega_measured"
        require(paired, "--column", expected=expected, got=repr(text), remedy=remedy)
        names[channel] = name
    return Columns(names, time_column(time or "", "--time"), transient)


def _plan(
    opened: OpenedTwin, used: Trajectories, held_out: Trajectories | None, method: str
) -> str:
    """What will be done, in a line."""
    from retwin.report.labels import counted

    what = f"{counted(len(used), 'trajectory')} of {used.steps / used.rate:g} s"
    if held_out is not None:
        what += f", and {len(held_out)} held out,"
    return f"{what} at {used.rate:g} Hz; {method} for {', '.join(opened.twin.names)}"


def _print(
    found: Identification, values: dict[str, Any], checked: Checked, *, as_json: bool
) -> None:
    """Parameters, errors before and after, and where the files are."""
    from retwin.report.identification.texts import findings, interval, interval_remark, state
    from retwin.report.labels import significant

    parameters = []
    for p in found.parameters:
        after = significant(p.value, p.error)
        unit = "" if p.unit == "1" else p.unit
        before = "–" if p.own else f"{p.start:.4g}"
        parameters.append((p.name, unit, before, after, interval(p), state(p)))
    held = found.compared == "validation"
    errors = []
    for each in found.outputs:
        pair = [each.identification, each.validation] if held else [each.identification]
        if any(error is not None and error.samples for error in pair):
            shown = [f"{x:.3g}" for e in pair if e is not None for x in (e.before, e.after)]
            unit = "" if each.unit == "1" else each.unit
            errors.append((each.name, unit, *shown, f"{each.mean:.3g}"))
    heads = ["RMS error", "unit", "used: before", "after"]
    heads += ["held out: before", "after "] if held else []
    heads += ["mean alone"]
    remark, said = interval_remark(found), findings(found, values["notes"])
    answer(
        values,
        table(("parameter", "unit", "before", "after", "95 % interval", ""), parameters),
        *[remark] * bool(remark),
        "",
        table(heads, errors, numbers=heads[2:]),
        "",
        *said,
        *(each for each in values["notes"] if each not in said),
        *shown_records(checked),
        as_json=as_json,
    )
    if values["updated_case"]:
        note(f"No updated.toml: {values['updated_case']}")
    for path in values["files"].values():
        note(f"Saved {path}")
