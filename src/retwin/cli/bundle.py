"""`retwin bundle`: what was fitted as one folder, and its use on any machine."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from retwin.cli.terminal import bar
from retwin.storage import check_target, write_atomically

if TYPE_CHECKING:
    from retwin.bundle.bundle import Bundle
    from retwin.bundle.portable import Portable

__all__ = ["app"]

app = typer.Typer(help="Everything that was fitted in one sealed folder.", no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(help="Folder of a bundle.")]
Seed = Annotated[int, typer.Option(help="Same seed, same result.", min=0)]


@app.command(
    "save", epilog="Example: `retwin bundle save model real.mat --diagnoser cnn --out bundle`"
)
def save(
    model: Annotated[Path, typer.Argument(help="Folder of a corrected twin.")],
    real: Annotated[Path, typer.Argument(help="The trajectories it was calibrated on.")],
    out: Annotated[Path, typer.Option(help="Folder for the bundle.")],
    diagnoser: Annotated[Path | None, typer.Option(help="Folder of a diagnoser.")] = None,
    case: Annotated[
        str | None, typer.Option(help="Case, if another than the twin was fitted for.")
    ] = None,
    seed: Seed = 0,
) -> None:
    """Fit a guard and put it, the twin and the diagnoser into one sealed folder."""
    import retwin as rt
    from retwin.bundle.bundle import Bundle
    from retwin.bundle.guard import fit_guard

    twin = rt.CorrectedTwin.load(model)
    system = rt.cases.get(case or twin.case)
    judge = None if diagnoser is None else rt.load_diagnoser(diagnoser)
    with bar("bundle") as tell:
        calibration = rt.load(real, case=system, progress=lambda s: tell("read", s))
        guard = fit_guard(twin, system, calibration, seed=seed, progress=lambda s: tell("guard", s))
    notes = {"seed": seed, "command": " ".join(["retwin", *sys.argv[1:]])}
    Bundle.of(system, twin, guard, judge, data=[calibration], notes=notes).save(out)
    Console().print(f"Saved {out}", soft_wrap=True)


@app.command("verify", epilog="Example: `retwin bundle verify bundle`")
def verify(folder: Folder) -> None:
    """Hold every file against its SHA-256, and show what the bundle is; nothing is loaded."""
    from retwin.bundle.seal import read_sealed

    about = read_sealed(folder, "bundle", "portable")
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    table = Table("property", "value", title=f"{about['kind']}, {size / 1e6:.2f} MB")
    for name in ("case", "schema", "steps", "movements", "sensor_rate"):
        table.add_row(name, str(about.get(name)))
    provenance = about.get("provenance")
    for name, value in (provenance if isinstance(provenance, dict) else {}).items():
        table.add_row(name, str(value))
    console = Console()
    console.print(table)
    console.print(f"{folder} is whole", soft_wrap=True)


@app.command("predict", epilog="Example: `retwin bundle predict bundle real.mat --case armpi`")
def predict(
    folder: Annotated[Path, typer.Argument(help="Folder of a bundle, or of its ONNX export.")],
    file: Annotated[Path, typer.Argument(help="Trajectories; labels are not needed.")],
    case: Annotated[
        str | None, typer.Option(help="Case, for files whose commands it recovers.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file for all probabilities.")] = None,
) -> None:
    """Diagnose trajectories, and say which of them the bundle was not made for."""
    import retwin as rt

    bundle = _opened(folder)
    system = None if case is None else rt.cases.get(case)
    with bar("read") as tell:
        trajectories = rt.load(file, case=system, progress=lambda s: tell(file.name, s))
    found = bundle.predict(trajectories)
    rows = list(
        zip(
            trajectories.ids.tolist(),
            found.diagnosis.tolist(),
            found.probabilities.max(axis=1).tolist(),
            found.verdicts.verdict.tolist(),
            found.verdicts.reason.tolist(),
            strict=True,
        )
    )
    table = Table("trajectory", "diagnosis", "probability", "guard", "because of")
    for name, best, probability, verdict, reason in rows:
        table.add_row(name, best, f"{probability:.2f}", verdict, reason)
    console = Console()
    console.print(table)
    if trajectories.emulated:
        console.print("These trajectories are EMULATED: no real measurements.")
    if out is not None:
        with write_atomically(out) as part, part.open("w", newline="", encoding="utf-8") as sheet:
            writer = csv.writer(sheet)
            writer.writerow(["trajectory", "guard", "because_of", *found.classes])
            for row, shares in zip(rows, found.probabilities.tolist(), strict=True):
                writer.writerow([row[0], row[3], row[4], *shares])
        console.print(f"Wrote {out}", soft_wrap=True)


@app.command("generate", epilog="Example: `retwin bundle generate bundle --out made.npz`")
def generate(
    folder: Folder,
    out: Annotated[Path, typer.Option(help="File to write, .npz or .zarr.")],
    per_class: Annotated[int, typer.Option(help="Trajectories per class.")] = 400,
    case: Annotated[
        str | None, typer.Option(help="Case, where its own code draws commands.")
    ] = None,
    seed: Seed = 0,
) -> None:
    """Generate a balanced labelled set."""
    import retwin as rt
    from retwin.bundle.bundle import Bundle

    check_target(out)
    bundle = Bundle.load(folder)
    system = None if case is None else rt.cases.get(case)
    # A built-in name only: code that a file names is not run, a case of one's own is given by hand.
    if system is None and bundle.facts.sampler is None and bundle.facts.case.isidentifier():
        system = rt.cases.get(bundle.facts.case)
    with bar("generate") as tell:
        made = bundle.generate(
            system, per_class=per_class, seed=seed, progress=lambda s: tell("", s)
        )
    rt.save(made, out)
    Console().print(f"Wrote {len(made)} trajectories to {out}", soft_wrap=True)


@app.command("export", epilog="Example: `retwin bundle export bundle --onnx portable`")
def export(
    folder: Folder,
    onnx: Annotated[Path, typer.Option(help="Folder for the ONNX graphs.")],
) -> None:
    """Write ONNX graphs, with which `bundle predict` needs no torch."""
    from retwin.bundle.bundle import Bundle
    from retwin.bundle.export import export_onnx

    with bar("export") as tell:
        parity = export_onnx(Bundle.load(folder), onnx, progress=lambda s: tell("", s))
    table = Table("graph", "difference from torch")
    for name, difference in parity.items():
        table.add_row(name, f"{difference:.1e}")
    console = Console()
    console.print(table)
    console.print(f"Wrote {onnx}", soft_wrap=True)


def _opened(folder: Path) -> Bundle | Portable:
    """A bundle, or its export, for which torch is not loaded."""
    from retwin.bundle.seal import read_sealed

    if read_sealed(folder, "bundle", "portable")["kind"] == "portable":
        from retwin.bundle.portable import Portable

        return Portable.load(folder)
    from retwin.bundle.bundle import Bundle

    return Bundle.load(folder)
