"""`retwin data`: describe, convert, split and fetch trajectories."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from retwin.checks import require
from retwin.cli.completion import complete_files
from retwin.cli.options import CaseOption, Json, MaxBytes, Rate, Seed
from retwin.cli.reading import data_case, read
from retwin.cli.terminal import answer, bar, example, note, table
from retwin.data import download
from retwin.data.io import check_target, save
from retwin.data.trajectories import Channels, Trajectories
from retwin.serialisation.files import sha256

__all__ = ["app"]

app = typer.Typer(
    help="Describe, convert, split and fetch trajectories.",
    epilog=example("retwin data info real.mat --case armpi"),
    no_args_is_help=True,
)

File = Annotated[
    Path, typer.Argument(metavar="FILE", help="File or folder of trajectories.", show_default=False)
]


@app.command(epilog=example("retwin data info real.mat sim.mat --case armpi"))
def info(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILES", help="Files or folders of trajectories.")
    ],
    case: CaseOption = None,
    rate: Rate = None,
    max_bytes: MaxBytes = None,
    as_json: Json = False,
) -> None:
    """Describe files: classes, samples, channels, missing values, SHA-256."""
    system = data_case(case)
    facts = [_facts(read(file, system, rate, max_bytes=max_bytes), file) for file in files]
    answer(facts, *map(_table, facts), as_json=as_json)


@app.command(epilog=example("retwin data convert sim.mat sim.npz --case armpi"))
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="File or folder to read.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="New *.npz or *.zarr.")],
    case: CaseOption = None,
    rate: Rate = None,
    max_bytes: MaxBytes = None,
) -> None:
    """Write trajectories in retwin's own format, with channels, rate and provenance."""
    check_target(target)
    trajectories = read(source, data_case(case), rate, max_bytes=max_bytes)
    save(trajectories, target)
    note(f"Wrote {target}: {trajectories}")


@app.command(epilog=example("retwin data split real.npz --out-first fit.npz --out-second test.npz"))
def split(
    file: File,
    first: Annotated[
        Path, typer.Option("--out-first", metavar="FILE", help="First part, *.npz or *.zarr.")
    ],
    second: Annotated[
        Path, typer.Option("--out-second", metavar="FILE", help="The rest, *.npz or *.zarr.")
    ],
    fraction: Annotated[float, typer.Option(metavar="X", help="Share of the first part.")] = 0.6,
    seed: Seed = 0,
    case: CaseOption = None,
    rate: Rate = None,
    max_bytes: MaxBytes = None,
) -> None:
    """Split trajectories in two, at random, with the same shares of every class."""
    for target in (first, second):
        check_target(target)
    require(
        first.resolve() != second.resolve(),
        "--out-second",
        expected="another name than --out-first",
        got=second,
        remedy="give each part its own file",
    )
    whole = read(file, data_case(case), rate, max_bytes=max_bytes)
    parts = whole.split(fraction, seed=seed)
    for part, target in zip(parts, (first, second), strict=True):
        save(part, target)
        note(f"Wrote {target}: {part}")


@app.command(epilog=example("retwin data fetch armpi --folder data"))
def fetch(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="Name of a public data file, such as armpi.",
            autocompletion=complete_files,
        ),
    ],
    folder: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Else RETWIN_CACHE, else the user's cache.",
        ),
    ] = None,
    max_bytes: Annotated[
        int, typer.Option(metavar="N", help="Most that the file may hold.", min=1)
    ] = download.MAX_BYTES,
) -> None:
    """Download a public data file, check its SHA-256 and print its path."""
    with bar("fetch") as show:
        path = download.fetch(
            name, folder=folder, progress=lambda share: show(name, share), max_bytes=max_bytes
        )
    answer(path, str(path))


def _facts(trajectories: Trajectories, file: Path) -> dict[str, Any]:
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
    ]
    return table(("file", facts["file"]), rows)
