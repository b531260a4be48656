"""`retwin data`: describe, map and convert trajectories."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.table import Table

from retwin.catalog import DOWNLOADS
from retwin.checks import at_least, ends_in, given
from retwin.cli import options
from retwin.cli.commands import Commands
from retwin.cli.options import argument, leave_out, option, rare
from retwin.cli.reading import case_named, data_case, read, shown_records
from retwin.cli.terminal import answer, bar, example, note, table
from retwin.data import download
from retwin.data.io import DataCase, check_target, save
from retwin.data.logs.reading import is_log
from retwin.data.quality.check import check_records
from retwin.data.trajectories import Channels, Trajectories
from retwin.serialisation.files import sha256, write_atomically
from retwin.serialisation.places import check_place
from retwin.times import sample_rate
from retwin.twins import FILES

if TYPE_CHECKING:
    from retwin.data.logs.mapped import Parts
    from retwin.data.logs.proposal import Proposal

SHOWN = 40
"""Signals of a log that are listed."""

app = Commands(
    help="Describe, map and convert trajectories.",
    epilog=example("retwin data info real.mat --case armpi"),
)

ChannelsOf = Annotated[
    str | None,
    options.case_option(
        help="Case or twin with the channels: case.toml, plant.fmu, module:function, …"
    ),
]


@app.command(epilog=example("retwin data info real.mat sim.mat --case armpi"))
def info(
    files: Annotated[list[Path], argument("FILES", "Files or folders of trajectories.")],
    case: ChannelsOf = None,
    rate: options.Rate = None,
    mapping: options.LogMapping = None,
    inputs: options.Inputs = "",
    outputs: options.Outputs = "",
    max_bytes: options.MaxBytes = None,
    as_json: options.Json = False,
) -> None:
    """Describe files: classes, samples, channels, missing values, SHA-256."""
    rate_of = None
    if mapping is None and is_log(files[0]) and files[0].is_file():
        from retwin.cases import LogReader

        reader = LogReader(max_bytes=max_bytes)
        rate_of = partial(reader.rate, files[0]) if rate is None else (lambda _: rate)
    system = _channels_of(case, inputs, outputs, mapping, rate_of)
    facts, shown = [], []
    for file in files:
        found = read(file, system, rate, max_bytes=max_bytes, mapping=mapping)
        checked = check_records(found)
        facts.append(_facts(found, file) | {"records": checked.values})
        shown += [_table(facts[-1]), *_samplings(facts[-1]), *shown_records(checked)]
    answer(facts, *shown, as_json=as_json)


@app.command("map", epilog=example("retwin data map run.mcap --case armpi --out mapping.toml"))
def map_log(
    log: Annotated[Path, argument("LOG", "ROS bag, MCAP, Parquet, TDMS, MDF, CSV, …")],
    out: Annotated[Path, option("FILE", "New mapping.toml; its picture beside.")],
    case: ChannelsOf = None,
    time: Annotated[str, rare("COLUMN", "Column of the times, if not found.", "--time")] = "",
    rate: Annotated[
        float | None, rare("HZ", "Rows per second, if it has no times.", "--rate")
    ] = None,
    inputs: options.Inputs = "",
    outputs: options.Outputs = "",
    max_bytes: options.MaxBytes = None,
    as_json: options.Json = False,
) -> None:
    """Propose what a log's signals stand for, and draw it with the trajectories they make."""
    from retwin.data.logs.mapped import try_mapping
    from retwin.data.logs.mapping import TimeSettings
    from retwin.data.logs.proposal import propose_mapping
    from retwin.report.figures.log_picture import log_picture

    ends_in("--out", out, (".toml",), remedy="give another name, such as mapping.toml")
    picture = out.with_suffix(".png")
    for place in (out, picture):
        check_place(place)
    if rate is not None:
        rate = sample_rate("--rate", rate)
    system = _channels_of(case, inputs, outputs)
    with bar("map") as show:
        settings, report = TimeSettings(column=time, rate=rate), partial(show, log.name)
        made = propose_mapping(
            log, case=system, time=settings, progress=report, max_bytes=max_bytes
        )
        parts = try_mapping(made.log, made.mapping, case=system)
        drawn = log_picture(made.log, parts)
    for place, contents in ((out, made.text.encode()), (picture, drawn)):
        with write_atomically(place) as part:
            part.write_bytes(contents)
    remarks = _remarks(made, parts)
    answer(
        {
            "signals": [asdict(each) for each in made.facts],
            "channels": made.channels,
            "open": made.open_channels,
            "by_unit": made.by_unit,
            "notes": remarks,
        },
        _seen(made),
        as_json=as_json,
    )
    note(f"Wrote {out} and {picture}: check them, then give --mapping {out}")
    if made.open_channels:
        lacking = ", ".join(made.open_channels)
        note(f"No signal that changes was found for {lacking}: name it in {out}")
    if made.by_unit:
        note(f"Guessed by the unit alone, to be checked: {', '.join(made.by_unit)}")
    for each in remarks:
        note(each)
    if case is None:
        commands = ", ".join(made.mapping.commands if made.mapping else ()) or "none"
        note(
            f"Commands, by words in names: {commands}; all others are outputs. Move what is sent "
            f"to the machine to [commands] in {out}, or give --case TWIN"
        )


@app.command(epilog=example("retwin data convert sim.mat sim.npz --case armpi"))
def convert(
    files: Annotated[
        list[Path], argument("IN… OUT", "Files or folders to read, and a new *.npz or *.zarr.")
    ],
    public: Annotated[
        str | None,
        option("NAME", "Read a public data file, such as armpi.", names=sorted(DOWNLOADS)),
    ] = None,
    split: Annotated[
        float | None, option("SHARE", "Of each class to OUT; the rest goes to OUT-rest.")
    ] = None,
    seed: options.Seed = 0,
    case: options.CaseOption = None,
    rate: options.Rate = None,
    mapping: options.LogMapping = None,
    max_bytes: options.MaxBytes = None,
) -> None:
    """Write trajectories in retwin's own format, with channels, rate and provenance.

    A public file is downloaded to RETWIN_CACHE, else the user's cache, and its
    SHA-256 is checked.
    """
    *sources, target = files
    targets = [target] if split is None else [target, target.with_stem(f"{target.stem}-rest")]
    for each in targets:
        check_target(each)
    if public is not None:
        with bar("fetch") as show:
            limit, report = max_bytes or download.MAX_BYTES, partial(show, public)
            sources.append(download.fetch(public, progress=report, max_bytes=limit))
    at_least("IN", sources, 1, "file", remedy="name it before OUT, or give --public NAME")
    found = read(sources, case or public, rate, max_bytes=max_bytes, mapping=mapping)
    parts = [found] if split is None else found.split(split, seed=seed)
    for part, place in zip(parts, targets, strict=True):
        save(part, place)
        note(f"Wrote {place}: {part}")


def _channels_of(
    name: str | None,
    inputs: str,
    outputs: str,
    mapping: Path | None = None,
    rate_of: Callable[[Sequence[str]], float | None] | None = None,
) -> DataCase | None:
    """What files need of the case or the twin of that name, if one is given.

    `rate_of` gives the sample rate of channels in a log, for a twin that has none of its own.
    """
    if name is None:
        channels = {"--inputs": inputs or None, "--outputs": outputs or None}
        leave_out(channels, "without --case, the twin to which they belong")
        return None
    names = (options.channel_names(inputs), options.channel_names(outputs))
    if Path(name).suffix.lower() not in FILES and ":" not in name and not any(names):
        return data_case(name) if rate_of is None else case_named(name)
    from retwin.cases.twin_data import log_case

    made = log_case(name, *names, mapping=mapping)
    if rate_of is None or made.rate:
        return made
    found = rate_of((*made.inputs.names, *made.outputs.names))
    rate = given("--rate", found, "a column with the times of the rows", remedy="give --rate HZ")
    return log_case(name, *names, rate=rate)


def _remarks(made: Proposal, tried: Parts | str) -> list[str]:
    """What the proposed mapping makes of a log, a sentence each."""
    from retwin.report.labels import counted

    if isinstance(tried, str):
        return [f"The mapping makes no trajectories yet: {tried}"]
    what = f"{counted(len(tried.blocks), 'trajectory')} at {tried.rate:g} Hz"
    return [f"{what}: {'; '.join(tried.notes(made.log))}", *tried.changes()]


def _seen(made: Proposal) -> Table:
    """The signals of a log, those that are mapped first."""
    channels = made.channels
    facts = sorted(made.facts, key=lambda each: each.name not in channels)
    rows = [
        (
            each.name,
            each.unit,
            str(each.count),
            f"{each.rate:.4g}",
            f"{each.longest:.3g}",
            "constant" if each.constant else f"{each.low:.4g} to {each.high:.4g}",
            channels.get(each.name, ""),
        )
        for each in facts[:SHOWN]
    ]
    if len(facts) > SHOWN:
        rows.append((f"and {len(facts) - SHOWN} more", "", "", "", "", "", ""))
    head = ("signal", "unit", "values", "Hz", "longest s", "range", "channel")
    return table(head, rows, numbers=head[2:5])


SAMPLING = {
    "channel": "{channel}",
    "signal": "{signal}",
    "Hz": "{rate:.4g}",
    "resampled": "{method}",
    "missing": "{missing:.2%}",
    "bridged s": "{bridged:.3g}",
    "longest s": "{longest:.3g}",
    "note": "{note}",
}
"""Heads of the table of samplings, and what stands below them."""


def _samplings(facts: dict[str, Any]) -> list[Table]:
    """For each log, how its channels came to their samples."""
    sources = (source["sampling"] for source in facts["provenance"] if "sampling" in source)
    rows = (
        [[cell.format(**own) for cell in SAMPLING.values()] for own in each] for each in sources
    )
    return [
        table(tuple(SAMPLING), each, numbers=("Hz", "missing", "bridged s", "longest s"))
        for each in rows
    ]


def _facts(trajectories: Trajectories, file: Path) -> dict[str, Any]:
    """The facts about one file, as JSON values."""
    counts = Counter(trajectories.labels.tolist())
    mask = trajectories.mask
    count = int(trajectories.lengths.sum()) * mask.shape[2]  # padding is not missing
    return {
        "file": str(file),
        "sha256": sha256(file),
        "trajectories": len(trajectories),
        "per_class": {label: counts[label] for label in sorted(counts)},
        "samples": trajectories.steps,
        "rate": trajectories.rate,
        "inputs": _pairs(trajectories.inputs),
        "outputs": _pairs(trajectories.outputs),
        "missing": max(0.0, 1 - int(mask.sum()) / count) if count else 0.0,
        "emulated": trajectories.emulated,
        "dtype": str(trajectories.observed.dtype),
        "provenance": [source.plain() for source in trajectories.provenance],
    }


def _pairs(channels: Channels) -> list[dict[str, str]]:
    return [{"name": n, "unit": u} for n, u in zip(channels.names, channels.units, strict=True)]


def _table(facts: dict[str, Any]) -> Table:
    def channels(name: str) -> str:
        return ", ".join(f"{c['name']} [{c['unit']}]" for c in facts[name]) or "none"

    rows = [
        ("SHA-256", facts["sha256"]),
        ("trajectories", f"{facts['trajectories']}{' (emulated)' if facts['emulated'] else ''}"),
        *((f"  {label or 'unlabelled'}", str(n)) for label, n in facts["per_class"].items()),
        ("samples", f"{facts['samples']} ({facts['samples'] / facts['rate']:g} s)"),
        ("rate", f"{facts['rate']:g} Hz"),
        ("commands", channels("inputs")),
        ("outputs", channels("outputs")),
        ("missing", f"{facts['missing']:.2%}"),
        ("made from", "\n".join(f"{s['name']} {s['sha256']}" for s in facts["provenance"])),
        *(("", each) for source in facts["provenance"] for each in source.get("notes", ())),
    ]
    return table(("file", facts["file"]), rows)
