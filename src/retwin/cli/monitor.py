"""`retwin monitor`: calibrate a monitor of a twin, replay records, and watch running machines."""

from __future__ import annotations

import re
import secrets
import signal
import tempfile
import threading
import warnings
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from math import inf, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from retwin import catalog
from retwin.checks import at_least, existing, finite, positive, require
from retwin.cli import options
from retwin.cli.commands import Commands
from retwin.cli.options import argument, leave_out, option, rare
from retwin.cli.reading import (
    case_named,
    fitted_remarks,
    read,
    read_signals,
    saved,
    shown_records,
    stored_name,
)
from retwin.cli.terminal import BAD_INPUT, answer, bar, complain, example, note, table
from retwin.data.trajectories import HEALTHY, Trajectories
from retwin.serialisation.models import kind_of
from retwin.serialisation.places import check_place

if TYPE_CHECKING:  # printing help needs no torch, which takes seconds to import
    from retwin.cases.case import Case
    from retwin.cases.twin_data import TwinData
    from retwin.monitor import Alarm, Cause, Monitor, Watched
    from retwin.monitor.models.state import Visible
    from retwin.twins import ParametricTwin, StateTwin
    from retwin.update import CorrectedTwin, DynamicsTwin

EQUATIONS = (
    "With state equations (a StateTwin, docs/twins.md#states) the twin itself is watched, and "
    "causes are its parameters too."
)
"""What would watch the twin itself, where a black box takes its place."""
FEW = 6
"""Faults that are listed, at most."""
LARGE = 0.5
"""Share of what a fault changes from which on the size from which it is seen is large."""
ONLY_LARGE = f"Seen only from {LARGE:.0%} of the parameter, command or output range on"
"""How causes are introduced that are seen only from such a size on."""
EARLIER = "before, by fewer samples: "
"""What stands before a cause in whose place another one was named later."""
EXTRAPOLATED = "if it is a fault, and the twin holds there: "
"""What stands before the cause of a remark."""
CONFIG = Path("monitor.toml")
Reading = Callable[..., Trajectories]
"""`cli.reading.read` with the options of the command."""

app = Commands(
    help="Watch a machine with its corrected twin.",
    epilog=example("retwin monitor replay watch day1.npz"),
)


@app.command(epilog=example("retwin monitor fit model healthy.npz --out watch"))
def fit(
    files: Annotated[
        list[Path], argument("FILE...", "A model, unless there is no twin, and healthy records.")
    ],
    out: Annotated[Path, option("FOLDER", "Where to save the monitor.")],
    false_alarms: Annotated[
        str, option("RATE", 'At most: "1 per month", "2 per year", "1e-6 Hz".')
    ] = "1 per month",
    lasting: Annotated[
        float | None, option("S", "Time after which an event is a lasting change: 3600.")
    ] = None,
    case: options.OtherCase = None,
    mapping: options.LogMapping = None,
    max_bytes: options.MaxBytes = None,
    as_json: options.Json = False,
) -> None:
    """Calibrate a monitor on healthy records, best not those that MODEL was fitted to.

    Without MODEL, or with one that has no state equations, a black box of the
    records takes the place of a twin.
    """
    from retwin.monitor import fit_monitor, possible_causes, visible_sizes
    from retwin.update import DynamicsTwin, load_twin
    from retwin.update.agreement import check_with_twin
    from retwin.update.dynamics import estimate_noise

    reading = partial(read, max_bytes=max_bytes, mapping=mapping)
    model = files[0] if files[0].is_dir() and (files[0] / "model.json").is_file() else None
    healthy = files[1:] if model else files
    at_least("FILE", healthy, 1, "file", remedy="name healthy records after the model")
    trajectories = model is not None and kind_of(saved(model)) in catalog.DIAGNOSERS
    inner = "diagnoser" if trajectories else "twin"
    check_place(out, folder=True, holds=("model.json", "weights.safetensors", inner))
    if model and trajectories:
        leave_out({"--lasting": lasting}, "for a diagnoser, which watches whole trajectories")
        _fit_trajectories(model, healthy, out, false_alarms, case, reading, as_json)
        return
    updated = load_twin(model) if model else None
    equations = _equations_of(updated)
    system = case_named(case or (updated.case if updated else None) or None)
    tables = all(each.suffix.lower() == ".csv" for each in healthy)
    if updated is None and system is None and mapping is None and tables:
        records = [read_signals(healthy, max_bytes)]
    else:
        own = partial(reading, case=system or _named(updated), part="calibration")
        records = [_healthy(own(file), file) for file in healthy]
    with bar("calibrate") as show:
        show("monitor", 0.0)
        given = Trajectories.concatenate(records)
        known = equations if isinstance(equations, DynamicsTwin) else None
        if equations is not None and known is None:
            known = estimate_noise(equations, given)
        checked = check_with_twin(known, given)
        more = {} if lasting is None else {"lasting": lasting}
        made = fit_monitor(known, given, false_alarms, **more)
        show("faults that are seen", 0.5)
        causes = possible_causes(made.twin, system and system.alarm_causes)
        seen = partial(show, "faults that are seen")
        found = visible_sizes(made, given, causes, progress=lambda share: seen((1 + share) / 2))
        made = replace(made, visible=tuple(found))
    name = stored_name(case) if case else (updated.case if updated else "")
    made = replace(made, twin=replace(made.twin, case=name))  # by which records are read later too
    made.save(out)
    twin = made.twin
    hours = given.mask.any(axis=2).sum() / twin.rate / 3600
    box = f"No twin: a black box, calibrated on {hours:.3g} h of your data; causes are channels."
    if updated:
        box = f"{model} has no state equations, which alone are followed. {box} {EQUATIONS}"
    if known is not equations:
        box = (
            f"{model} corrects no state equations: those of the twin are followed as they are, "
            "with noise as in these records."
        )
    promises = {name: str(each) for name, each in made.promises.items()}
    tried = made.tried.text(twin.rate)
    about = {"arl": made.arl, "run_length": made.run_length, "warm_up": made.warm_up}
    answer(
        {"saved": str(out), **about, "promises": promises, "tried": vars(made.tried)}
        | {"records": checked.values, "visible": [vars(each) for each in made.visible]},
        *shown_records(checked),
        *([] if known and known is equations else [box]),
        *fitted_remarks(model if known else None, given, "the promise may not hold for new ones"),
        _describe_promise(made),
        f"Tried: {tried}",
        *(f"{name}: {text}" for name, text in promises.items()),
        *_describe_visible(made.visible),
        as_json=as_json,
    )
    changes = [each.hidden for each in made.visible if each.compared == "value" and each.value]
    if changes and all(changes):
        warnings.warn(BLIND, stacklevel=1)
    note(f"Saved {out}")


BLIND = (
    "this monitor sees a change of a parameter, or of the effect of a command, only where it is "
    "larger than that itself, if at all: its filter follows it as a disturbance. What replay says "
    "of free simulation may show it"
)
"""What is said of a monitor that detects faults of sensors at most."""


def _describe_visible(visible: Sequence[Visible]) -> list[str]:
    """A line for each fault that is seen from some size on, and one for all others."""
    from retwin.monitor.models.state import SHARE

    hidden = [each.fault for each in visible if each.share < SHARE]
    rest = "Not seen at any size in the ranges of parameters, commands and outputs: "
    rest += "; ".join(hidden)
    return [*(str(each) for each in visible if each.share >= SHARE), *([rest] if hidden else [])]


@app.command(epilog=example("retwin monitor replay watch day1.npz day2.npz"))
def replay(
    monitor: Annotated[Path, argument("MONITOR", "Folder of a monitor, of retwin monitor fit.")],
    logs: Annotated[list[Path], argument("LOG...", "Records, in the order of time.")],
    case: options.OtherCase = None,
    mapping: options.LogMapping = None,
    max_bytes: options.MaxBytes = None,
    as_json: options.Json = False,
) -> None:
    """Watch recorded data as if they came now: alarms, their causes, and the promise."""
    from retwin.monitor import Monitor
    from retwin.update.forecast_errors import warn_unlike

    reading = partial(read, max_bytes=max_bytes, mapping=mapping)
    if kind_of(saved(monitor)) == "trajectory_monitor":
        _replay_trajectories(monitor, logs, case, reading, as_json)
        return
    made = Monitor.load(monitor)
    system = case_named(case or made.twin.case or None)
    found, rows = [], list[str]()
    for file in logs:
        record = reading(file, system or _named(made.twin))
        warn_unlike(made.twin, record)
        watched = made.watch(record)
        causes = _causes(made, record, watched.alarms, system)
        free = made.find_free_errors(record)
        found.append((file, record, watched, causes, free))
        rows += _describe_free(file.name, record, free)
        outputs = made.find_excursions(record).values()
        left = min((first for first, *_ in outputs), default=inf)
        for trajectory, begin, end, what, lines in _event_rows(watched, causes, record.rate, left):
            own = f"{file.name}, {trajectory}" if len(record) > 1 else file.name
            rows.append(_describe_event(own, begin, end, what, lines))
    answer(
        {
            "arl": made.arl,
            "promises": {name: str(each) for name, each in made.promises.items()},
            "records": [_json(*each) for each in found],
        },
        *rows,
        *(_summary(made, *each[:3], changed=bool(each[4])) for each in found),
        _rates(made, [(each[1], each[2]) for each in found]),
        as_json=as_json,
    )


def _fit_trajectories(
    model: Path,
    healthy: Sequence[Path],
    out: Path,
    false_alarms: str,
    case: str | None,
    reading: Reading,
    as_json: bool,
) -> None:
    """Calibrate a monitor of trajectories, by a diagnoser."""
    from retwin.diagnosis import load_diagnoser
    from retwin.monitor import fit_trajectory_monitor

    system = case_named(case)
    records = [_healthy(reading(file, system), file) for file in healthy]
    with bar("calibrate") as show:
        made = fit_trajectory_monitor(
            load_diagnoser(model),  # refused there if it is no inversion
            Trajectories.concatenate(records),
            false_alarms,
            causes=system.causes if system else None,
            progress=partial(show, "diagnose"),
        )
    made.save(out)
    about = {"saved": str(out), "arl": made.arl, "kappa": made.kappa, "promise": made.promise}
    answer(about, made.promise, as_json=as_json)
    note(f"Saved {out}")


def _replay_trajectories(
    monitor: Path, logs: Sequence[Path], case: str | None, reading: Reading, as_json: bool
) -> None:
    """Watch recorded trajectories of one machine, file after file."""
    from retwin.monitor import TrajectoryMonitor
    from retwin.monitor.live.notifications import REMEDY
    from retwin.monitor.models.trajectory.state import REMARKS

    made, system, state = TrajectoryMonitor.load(monitor), case_named(case), None
    rows, found, texts = [], [], []
    for file in logs:
        record = reading(file, system)
        with bar("diagnose") as show:
            state, watched = made.watch(record, state, progress=partial(show, file.name))
        rows += [
            (file.name, each.trajectory, str(each.number), each.name) for each in watched.alarms
        ]
        void = int(watched.void.sum())
        found.append(
            {
                "file": str(file),
                "alarms": [vars(each) for each in watched.alarms],
                "trajectories": len(record),
                "void": void,
                **{kind: int(getattr(watched, kind).sum()) for kind in REMARKS},
            }
        )
        texts.append(
            f"{file.name}: {len(watched.alarms)} alarms in {len(record)} trajectories"
            + (f"; the promise is VOID in {void}. {REMEDY}" if void else "")
            + "".join(f"; {each}" for each in watched.remarks)
            + "."
        )
    answer(
        {"arl": made.arl, "promise": made.promise, "records": found},
        *([table(("file", "trajectory", "number", "cause"), rows)] if rows else []),
        *texts,
        as_json=as_json,
    )


@app.command(epilog=example("retwin monitor run --config monitor.toml"))
def run(
    config: Annotated[Path, option("FILE", "Machines, twins and sources.")] = CONFIG,
    demo: Annotated[
        bool, option("", "Watch emulated incubators, of which some become faulty.", "--demo")
    ] = False,
    port: Annotated[
        int | None, option("N", "Of the demo's page; else 8710; 0: any.", min=0, max=65535)
    ] = None,
    open_page: Annotated[bool, option("", "Open the demo's page in a browser.", "--open")] = False,
    seconds: Annotated[float | None, option("S", "End the demo after this time.")] = None,
) -> None:
    """Watch running machines, until Ctrl-C or SIGTERM.

    The incubators of --demo run 60 times as fast as real ones; nothing of them is
    kept.
    """
    if seconds is not None:
        finite("seconds", positive("seconds", seconds, unit="s"), at_most=threading.TIMEOUT_MAX)
    if demo:
        leave_out({"--config": None if config == CONFIG else config}, "with --demo")
        _demonstrate(8710 if port is None else port, open_page, seconds)
        return
    others = {"--port": port, "--open": open_page, "--seconds": seconds}
    leave_out(others, "without --demo")
    from retwin.monitor.program import run as watch
    from retwin.monitor.settings import read_settings

    settings, stop = read_settings(config), threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        watch(settings, lambda line: answer(None, line), stop)
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
    note("Stopped; everything that was acknowledged is stored.")


def _demonstrate(port: int, open_page: bool, seconds: float | None) -> None:
    """Show the live monitor with emulated machines, for so long or until Ctrl-C."""
    from retwin.monitor.demo import announced, demonstration
    from retwin.monitor.server import create_app, listening, serving

    token = secrets.token_urlsafe()
    for line in announced():
        note(line)
    with (
        listening("127.0.0.1", port) as bound,
        tempfile.TemporaryDirectory(prefix="retwin-") as folder,
        ExitStack() as running,
    ):
        with bar("demo") as show:
            show("fit the twin", 0.0)
            live, gate, explanations = running.enter_context(demonstration(Path(folder)))
        app = create_app(live, gate, token=token, explanations=explanations, emulated=True)
        running.enter_context(serving(app, bound))
        address = f"http://127.0.0.1:{bound.getsockname()[1]}/"
        answer(None, f"Page: {address}", f"Token, for changes on the page: {token}")
        note(f"It ends {'' if seconds is None else f'after {seconds:g} s, or '}with Ctrl-C.")
        if open_page:
            webbrowser.open(address)
        with suppress(KeyboardInterrupt):
            threading.Event().wait(seconds)
    note("The demonstration has ended; nothing of it is kept.")


@app.command(epilog=example("retwin monitor audit store"))
def audit(
    store: Annotated[Path, argument("STORE", "Folder of the store, or an exported log.")],
    head: Annotated[str | None, rare("HASH", "A former head that was kept elsewhere.")] = None,
    url: Annotated[str, rare("URL", "The PostgreSQL database, if one.")] = "",
    as_json: options.Json = False,
) -> None:
    """Verify the log of a store, and the files of its versions."""
    from retwin.monitor import Store, read_log, verify
    from retwin.monitor.versions.registry import damaged

    hexadecimal = head is None or re.fullmatch("[0-9a-f]{64}", head)
    expected = "64 hexadecimal digits"
    remedy = "give the head that this command printed"
    require(hexadecimal, "--head", expected=expected, got=repr(head)[:80], remedy=remedy)
    if store.is_file():
        found, reason = verify(read_log(store), head), ""
    else:
        with Store(saved(store), url, read_only=True) as opened:
            found = verify(opened.log(), head)
            reason = "" if found.reason else damaged(opened)
    reason = found.reason or reason
    answer(
        {"ok": not reason, "entries": found.intact, "head": found.head, "reason": reason},
        f"{found.intact} entries are intact.",
        f"Head: {found.head}",
        as_json=as_json,
    )
    if reason:
        complain(reason)
        raise typer.Exit(BAD_INPUT)


@app.command(epilog=example("retwin monitor recalibrate store --asset press"))
def recalibrate(
    store: Annotated[Path, argument("STORE", "Folder of the store.")],
    asset: Annotated[str, option("NAME", "The machine.")],
    hours: Annotated[float, option("H", "Newest hours of which quiet ones are used.")] = 24.0,
    new_normal: Annotated[
        str, option("NAME", "You, if a change that lasts is no fault but the new normal.")
    ] = "",
    url: Annotated[str, rare("URL", "The PostgreSQL database, if one.")] = "",
    as_json: options.Json = False,
) -> None:
    """Propose a monitor of the last quiet hours, in the shadow of the active one."""
    from retwin.monitor import Store
    from retwin.monitor import recalibrate as propose
    from retwin.monitor.store.store import FILE

    kept = bool(url) or (saved(store) / FILE).is_file()
    existing("STORE", store, kept, f"the folder of a store, with {FILE}, or its --url")
    with Store(saved(store), url) as opened, bar("calibrate") as show:
        show("monitor", 0.0)
        version = propose(opened, asset, hours=hours, new_normal=new_normal)
    text = f"Version {version.number}, of {version.reason}, is in the shadow of the active one."
    answer(vars(version), text, as_json=as_json)


def _equations_of(
    model: CorrectedTwin | DynamicsTwin | None,
) -> DynamicsTwin | StateTwin | ParametricTwin | None:
    """What follows a machine sample by sample: corrected state equations, or those of the twin.

    A residual of outputs after them is no part of it. None where there are no state equations.
    """
    from retwin.update import DynamicsTwin
    from retwin.update.dynamics import state_names

    inner: Any = getattr(getattr(model, "surrogate", None), "twin", model)
    return inner if isinstance(inner, DynamicsTwin) or state_names(inner) else None


def _named(twin: CorrectedTwin | DynamicsTwin | None) -> TwinData | None:
    """What `read` takes for a case: the twin by whose channels the columns of a table are named."""
    from retwin.cases.twin_data import TwinData

    return twin and TwinData(twin.inputs, twin.outputs, twin.rate, twin=twin)


def _healthy(record: Trajectories, file: Path) -> Trajectories:
    """The healthy trajectories of a file."""
    chosen = record[record.maybe_healthy]
    expected = "healthy trajectories"
    remedy = "a monitor is calibrated on the healthy machine"
    require(len(chosen) > 0, str(file), expected=expected, got="faulty ones alone", remedy=remedy)
    return chosen


def _causes(
    monitor: Monitor, record: Trajectories, alarms: Sequence[Alarm], system: Case | None
) -> list[Cause]:
    """The causes of alarms, among those of the case if it has any."""
    from retwin.monitor import find_causes, possible_causes

    if not alarms:
        return []
    faults = possible_causes(monitor.twin, system and system.alarm_causes)
    with bar("explain") as show:
        return find_causes(monitor.twin, record, alarms, faults, progress=partial(show, "alarms"))


def _event_rows(
    watched: Watched, causes: Sequence[Cause], rate: float, left: float = inf
) -> list[tuple[str, str, str, str, list[str]]]:
    """Record, begin, end and change of each event, and lines with its causes, the newest first.

    From `left` s on outputs are outside of the range of the calibration.

    Events of a record that follow one with the same cause are in the row of that: a fault that
    lasts may not show for a while.
    """
    from retwin.monitor.models.cause import cause_text
    from retwin.report.labels import significant

    def text(cause: Cause) -> str:
        onset, low, high = cause.onset
        if isnan(onset):
            return cause_text(vars(cause), "")
        known = f"{significant(onset, high - low)} s"
        if high - low > 2 / rate:
            known += f" ({significant(low, high - low)} to {significant(high, high - low)})"
        return cause_text(vars(cause), known)

    ends = {(each.trajectory, each.event): each for each in watched.endings}
    rows = list[tuple[str, str, str, str, list[str]]]()
    before, further, shown = ("", ""), 0, list[str]()
    for first in watched.events:
        named: list[Cause] = []
        for cause in causes:
            if (cause.alarm.trajectory, cause.alarm.event) != (first.trajectory, first.event):
                continue
            if not cause.same:
                named.append(cause)
            elif cause.name == named[-1].name and cause.onset[0] <= first.time:
                named[-1] = cause  # the same from more samples
            newest = cause
        if named and newest.name not in [HEALTHY, *(each.name for each in named)]:
            named += [newest] * newest.likely
        end = ends.get((first.trajectory, first.event))
        until = "lasts" if end is None else f"{end.sample / rate:.6g}"
        what = ("" if first.promised else "remark: ") + f"{first.output} {first.change}"
        begin, texts = f"{first.time:.6g}", list(map(text, reversed(named)))
        if named and before in [(first.trajectory, each.name) for each in named]:
            further += 1
            times = f"{further} time{'s' * (further > 1)}"
            again = f"again, or still, {times} until {begin} s, then {texts[0]}"
            rows[-1] = (*rows[-1][:2], until, rows[-1][3], [*shown, again])
        else:
            holds = "if the twin holds there: " if first.time >= left else ""
            further, prefix = 0, holds if first.promised else EXTRAPOLATED
            shown = [(EARLIER if i else prefix) + each for i, each in enumerate(texts)]
            rows.append((first.trajectory, begin, until, what, shown))
        before = (first.trajectory, named[-1].name) if named else ("", "")
    return rows


def _describe_event(record: str, begin: str, end: str, what: str, causes: Sequence[str]) -> str:
    """An event as lines: when and what, and its causes."""
    until = ", which lasts" if end == "lasts" else f", no longer seen from {end} s"
    return "\n    ".join([f"{record}, from {begin} s{until}: {what}", *causes])


def _summary(
    monitor: Monitor, file: Path, record: Trajectories, watched: Watched, *, changed: bool
) -> str:
    """What was watched, and whether the promise applied; `changed` in free simulation."""
    from retwin.report.labels import counted

    seconds = record.mask.any(axis=2).sum() / record.rate
    void = [float(each.argmax()) / record.rate for each in watched.void if each[-1]]
    events = sum(each.promised for each in watched.events)
    text = f"{file.name}: {counted(events, 'event')} in {seconds / 3600:.3g} measured hours"
    text += ", but free simulation shows a change, see above" * (changed and not events)
    remarks = len(watched.events) - events
    if remarks:
        text += f", and {counted(remarks, 'remark')} where nothing is promised"
    if void:
        text += (
            f"; in {len(void)} of {len(record)} records the promise is VOID, since {min(void):.6g} "
            "s: the machine is not the one of the calibration, and is watched as it has become. A "
            "fault that stays raises no further alarm. "
            + (
                "Look for the causes of the events first: a calibration with this record would "
                "take the fault for healthy"
                if watched.events
                else "If it is healthy, calibrate with this record too"
            )
        )
    if watched.outside.any():
        which = _ranges(monitor.find_commands_outside(record))
        text += (
            f"; in {int(watched.outside.sum())} of {len(record)} records commands leave the range "
            f"of the calibration{which and f' ({which})'}, where the twin extrapolates and nothing "
            "is promised"
        )
    begin = monitor.find_begin(record)
    if begin:
        text += (
            f"; until {begin:.6g} s outputs are outside of the range of the calibration, in states "
            "of which nothing is promised"
        )
    outputs = _ranges(monitor.find_excursions(record))
    return text + (f". Outputs leave the range of the calibration: {outputs}." if outputs else ".")


def _ranges(found: Mapping[str, tuple[float, float, float, float]]) -> str:
    """Channels that leave their range: how far, and from when on."""
    return "; ".join(
        f"{name} reaches {value:.4g}, {low:.4g} to {high:.4g} there, outside from {first:.6g} s"
        for name, (first, value, low, high) in found.items()
    )


def _describe_free(
    file: str, record: Trajectories, off: Mapping[str, tuple[float, float, float]]
) -> list[str]:
    """A line on what free simulation shows of changes that the filter follows, if anything."""
    units = dict(zip(record.outputs.names, record.outputs.units, strict=True))
    found = [
        f"{name} is off by up to {largest:.3g} {units[name]}, at most {usual:.3g} in calibration"
        for name, (_, largest, usual) in off.items()
    ]
    if not found:
        return []
    since = min(first for first, _, _ in off.values())
    return [
        f"{file}, from {since:.6g} s: in free simulation {'; '.join(found)}: a fault, which the "
        "filter may follow without an alarm, or a state in which the twin does not hold. Nothing "
        "is promised of this."
    ]


def _rates(monitor: Monitor, found: Sequence[tuple[Trajectories, Watched]]) -> str:
    """What a replay shows of the rate of false events, with its exact bound, and the promise."""
    from scipy.stats import poisson

    from retwin.monitor.detect.promise import duration, shortest
    from retwin.monitor.models.state import SHARE
    from retwin.report.labels import counted

    rate = monitor.twin.rate
    samples = sum(int(record.mask.any(axis=2).sum()) for record, _ in found)
    events = sum(each.promised for _, watched in found for each in watched.events)
    bound = duration(shortest(events, samples) / rate)
    text = f"This replay of {duration(samples / rate)} shows {counted(events, 'event')}"
    if not events:
        text += f", which alone bounds their rate at one in {bound} (exact 95 %), if it was healthy"
    text += f". {_describe_promise(monitor)}"
    if not events:
        seen = [each for each in monitor.visible if each.share >= SHARE]
        unseen = [each.fault for each in monitor.visible if each.share < SHARE]
        large = [f"{e.fault} ({e.relative:.0%})" for e in seen if e.relative >= LARGE]
        for kind, names in (("Not seen", unseen), (ONLY_LARGE, large)):
            others = " and others" * (len(names) > FEW)
            text += f" {kind}: {', '.join(names[:FEW])}{others}." if names else ""
    if events and poisson.sf(events - 1, samples / monitor.run_length) < monitor.alpha:
        text += (
            " These are more events than it allows: faults; or, if you know that the machine was "
            "healthy, the promise does not hold for it. Calibrate with these records too; if it "
            "then sees less (the table of monitor fit), the twin lacks what happens in them."
        )
    return text


def _describe_promise(monitor: Monitor) -> str:
    """The rate that is promised, and what it follows from."""
    from retwin.monitor.detect.promise import duration

    known = monitor.tried.kept(monitor.arl)
    source = "the model of the noise" if known else "the events of records that were left out"
    wanted = duration(monitor.run_length / monitor.twin.rate)
    alone = duration(monitor.tried.run_length / monitor.twin.rate)
    return (
        f"The promise of at most one false event in {wanted} follows from {source}; the records "
        f"of the calibration alone bound them at one in {alone}."
    )


def _json(
    file: Path,
    record: Trajectories,
    watched: Watched,
    causes: list[Cause],
    free: Mapping[str, tuple[float, float, float]],
) -> dict:
    alarms = [vars(each) | {} for each in watched.alarms]
    for alarm, cause in zip(alarms, causes, strict=False):
        alarm["cause"] = {name: value for name, value in vars(cause).items() if name != "alarm"}
    return {
        "file": str(file),
        "alarms": alarms,
        "events": [vars(each) for each in watched.events],
        "endings": [vars(each) for each in watched.endings],
        "void": [record.ids[i] for i, each in enumerate(watched.void) if each[-1]],
        "outside": [record.ids[i] for i, each in enumerate(watched.outside) if each],
        "free_simulation": free,
        "measured_samples": int(record.mask.any(axis=2).sum()),
    }
