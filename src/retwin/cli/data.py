"""`retwin data`: look at, convert, split and fetch trajectories."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from retwin import download
from retwin.errors import InputError
from retwin.storage import DataCase, check_target, load, save, sha256
from retwin.trajectories import Channels, Trajectories

__all__ = ["app"]

app = typer.Typer(
    help="Look at, convert, split and fetch trajectories.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)

CaseName = Annotated[
    str | None,
    typer.Option("--case", help="Case the data belong to: a built-in name or module:object."),
]
Rate = Annotated[
    float | None, typer.Option("--rate", help="Samples per second, when the file does not say.")
]


@app.command(epilog="Example: `retwin data info real.mat sim.mat --case armpi`")
def info(
    files: Annotated[list[Path], typer.Argument(help="Files or folders of trajectories.")],
    case: CaseName = None,
    rate: Rate = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Say what files hold: classes, samples, channels, missing values, SHA-256."""
    told = []
    for file in files:
        trajectories = _load(file, case, rate)
        told.append(_describe(trajectories, file))
    if as_json:
        typer.echo(json.dumps(told, indent=2, ensure_ascii=False))
        return
    console = Console()
    for facts in told:
        console.print(_table(facts))


@app.command(epilog="Example: `retwin data convert sim.mat sim.npz --case armpi`")
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="File or folder to read.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="New *.npz or *.zarr.")],
    case: CaseName = None,
    rate: Rate = None,
) -> None:
    """Write trajectories in retwin's own format, with channels, rate and provenance."""
    check_target(target)
    trajectories = _load(source, case, rate)
    save(trajectories, target)
    Console().print(f"{target}: {trajectories}", markup=False, highlight=False, soft_wrap=True)


@app.command(
    epilog="Example: `retwin data split real.mat --case armpi --fraction 0.6 --seed 0 "
    "--out-first calibration.npz --out-second test.npz`"
)
def split(
    file: Annotated[Path, typer.Argument(help="File or folder of trajectories.")],
    first: Annotated[Path, typer.Option("--out-first", help="First part, *.npz or *.zarr.")],
    second: Annotated[Path, typer.Option("--out-second", help="The rest, *.npz or *.zarr.")],
    fraction: Annotated[float, typer.Option(help="Share of the first part.")] = 0.6,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same parts.")] = 0,
    case: CaseName = None,
    rate: Rate = None,
) -> None:
    """Split trajectories in two, at random, with the same shares of every class."""
    for target in (first, second):
        check_target(target)
    if first.resolve() == second.resolve():
        raise InputError(
            "--out-second",
            expected="another name than --out-first",
            got=str(second),
            remedy="give each part its own file",
        )
    parts = _load(file, case, rate).split(fraction, seed=seed)
    for part, target in zip(parts, (first, second), strict=True):
        save(part, target)
        Console().print(f"{target}: {part}", markup=False, highlight=False, soft_wrap=True)


@app.command(epilog="Example: `retwin data fetch armpi --folder data`")
def fetch(
    name: Annotated[str, typer.Argument(help="Name of a public data file, such as armpi.")],
    folder: Annotated[
        Path | None,
        typer.Option(help="Where to keep it; else RETWIN_CACHE, else the user's cache."),
    ] = None,
) -> None:
    """Download a public data file, check its SHA-256 and print where it lies."""
    with _progress(f"fetch {name}") as progress:
        path = download.fetch(name, folder=folder, progress=progress)
    typer.echo(path)


def _load(file: Path, case: str | None, rate: float | None) -> Trajectories:
    with _progress(f"read {file.name}") as progress:
        return load(file, case=_case(case), rate=rate, progress=progress)


def _case(name: str | None) -> DataCase | None:
    if name is None:
        return None
    from retwin import cases

    found: DataCase = cases.get(name)
    return found


def _describe(trajectories: Trajectories, file: Path) -> dict[str, Any]:
    """The facts about one file, as JSON values."""
    counts = Counter(trajectories.labels.tolist())
    mask = trajectories.mask
    return {
        "file": str(file),
        "sha256": sha256(file),
        "trajectories": len(trajectories),
        "per_class": {label: counts[label] for label in sorted(counts)},
        "samples": trajectories.steps,
        "rate": trajectories.rate,
        "inputs": _pairs(trajectories.inputs),
        "outputs": _pairs(trajectories.outputs),
        "missing": float(1 - mask.mean()) if mask.size else 0.0,
        "emulated": trajectories.emulated,
        "dtype": str(trajectories.observed.dtype),
        "provenance": [{"name": s.name, "sha256": s.sha256} for s in trajectories.provenance],
    }


def _pairs(channels: Channels) -> list[dict[str, str]]:
    return [{"name": n, "unit": u} for n, u in zip(channels.names, channels.units, strict=True)]


def _table(facts: dict[str, Any]) -> Table:
    # Text from files goes in as plain text: a class named [red] must not colour the table.
    def channels(name: str) -> str:
        return ", ".join(f"{c['name']} [{c['unit']}]" for c in facts[name]) or "none"

    table = Table(title=None, show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    rows = [
        ("file", facts["file"]),
        ("SHA-256", facts["sha256"]),
        ("trajectories", f"{facts['trajectories']}{' (emulated)' if facts['emulated'] else ''}"),
        *((f"  {label or 'unlabelled'}", str(n)) for label, n in facts["per_class"].items()),
        ("samples", f"{facts['samples']} ({facts['samples'] / facts['rate']:g} s)"),
        ("rate", f"{facts['rate']:g} Hz"),
        ("commands", channels("inputs")),
        ("outputs", channels("outputs")),
        ("missing", f"{facts['missing']:.2%}"),
        ("made from", "\n".join(f"{s['name']} {s['sha256']}" for s in facts["provenance"])),
    ]
    for name, value in rows:
        table.add_row(escape(name), escape(value))
    return table


@contextmanager
def _progress(what: str) -> Iterator[Callable[[float], None]]:
    """A bar on stderr that is gone when the work is done."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    # Without a terminal rich would print one line per bar.
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bars:
        task = bars.add_task(what, total=1.0)
        yield lambda share: bars.update(task, completed=share)
