"""`retwin bundle`: make and verify bundles; `generate` and `diagnose predict` use them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from retwin.checks import require
from retwin.cli.commands import Commands
from retwin.cli.options import Json, LogMapping, MaxBytes, Model, OtherCase, Seed, argument, option
from retwin.cli.reading import read, saved, updated_twin
from retwin.cli.terminal import answer, bar, command_given, example, note, table
from retwin.serialisation.places import check_place

app = Commands(
    help="Everything that was fitted, in one sealed folder.",
    epilog=example("retwin bundle verify bundle"),
)


@app.command(epilog=example("retwin bundle save model real.mat --diagnoser cnn --out bundle"))
def save(
    model: Model,
    real: Annotated[Path, argument("REAL", "The trajectories it was calibrated on.")],
    out: Annotated[Path, option("FOLDER", "Where to save the bundle.")],
    diagnoser: Annotated[Path | None, option("FOLDER", "Folder of a diagnoser.")] = None,
    case: OtherCase = None,
    seed: Seed = 0,
    mapping: LogMapping = None,
    max_bytes: MaxBytes = None,
) -> None:
    """Fit a guard and put it, the twin and the diagnoser into one sealed folder."""
    import retwin as rt
    from retwin.deploy.bundle.bundle import Bundle
    from retwin.deploy.bundle.guard import fit_guard
    from retwin.deploy.bundle.seal import SUMS

    check_place(out, folder=True, holds=("model.json", SUMS, "twin", "guard", "diagnoser"))
    twin = updated_twin(model)
    expected = "a corrected surrogate, of `retwin fit`"
    got = f"corrected dynamics, {model}"
    remedy = "fit without --dynamics, or make an FMU of it: retwin export fmu"
    require(isinstance(twin, rt.CorrectedTwin), "MODEL", expected=expected, got=got, remedy=remedy)
    system = rt.cases.get(case or twin.case)
    classifier = None if diagnoser is None else rt.load_diagnoser(diagnoser)
    calibration = read(real, system, part="calibration", max_bytes=max_bytes, mapping=mapping)
    with bar("bundle") as show:
        guard = fit_guard(twin, system, calibration, seed=seed, progress=lambda s: show("guard", s))
    notes = {"seed": seed, "command": command_given()}
    Bundle.of(system, twin, guard, classifier, data=[calibration], notes=notes).save(out)
    note(f"Saved {out}")


@app.command(epilog=example("retwin bundle verify bundle"))
def verify(
    folder: Annotated[Path, argument("BUNDLE", "Folder of a bundle, or of its ONNX export.")],
    as_json: Json = False,
) -> None:
    """Compare every file with its SHA-256, and describe the bundle; nothing is loaded."""
    from retwin.deploy.bundle.seal import read_sealed

    about = read_sealed(saved(folder), "bundle", "portable")
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    properties = ("case", "schema", "steps", "movements", "sensor_rate")
    values = {name: about.get(name) for name in properties}
    provenance = about.get("provenance")
    notes = provenance if isinstance(provenance, dict) else {}
    kind, shown = about["kind"], table(("property", "value"), [*values.items(), *notes.items()])
    facts = {"folder": str(folder), "kind": kind, "bytes": size, **values, "provenance": notes}
    whole = f"{folder} is whole"
    answer(facts, f"{kind}, {size / 1e6:.2f} MB", shown, "", whole, as_json=as_json)
