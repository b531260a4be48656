"""`retwin bundle`: make, verify, use and export bundles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from retwin.checks import require
from retwin.cli.commands import Commands
from retwin.cli.diagnose import EMULATED, diagnoses, write_probabilities
from retwin.cli.options import (
    CaseOption,
    Json,
    LogMapping,
    MaxBytes,
    Measured,
    Model,
    OtherCase,
    PerClass,
    Probabilities,
    Real,
    Seed,
    argument,
    option,
)
from retwin.cli.reading import case_named, data_case, read, saved, updated_twin
from retwin.cli.terminal import answer, bar, command_given, example, note, table
from retwin.data.io import check_target
from retwin.serialisation.places import check_place

if TYPE_CHECKING:
    from retwin.deploy.bundle.bundle import Bundle
    from retwin.deploy.onnx.portable import Portable

app = Commands(
    help="Everything that was fitted, in one sealed folder.",
    epilog=example("retwin bundle predict bundle real.mat --case armpi"),
)

Folder = Annotated[Path, argument("BUNDLE", "Folder of a bundle.")]


@app.command(epilog=example("retwin bundle save model real.mat --diagnoser cnn --out bundle"))
def save(
    model: Model,
    real: Real,
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
    require(
        isinstance(twin, rt.CorrectedTwin),
        "MODEL",
        expected="a corrected surrogate, of `retwin fit`",
        got=f"corrected dynamics, {model}",
        remedy="fit without --dynamics, or make an FMU of it: retwin export fmu",
    )
    system = rt.cases.get(case or twin.case)
    classifier = None if diagnoser is None else rt.load_diagnoser(diagnoser)
    calibration = read(real, system, max_bytes=max_bytes, mapping=mapping)
    with bar("bundle") as show:
        guard = fit_guard(twin, system, calibration, seed=seed, progress=lambda s: show("guard", s))
    notes = {"seed": seed, "command": command_given()}
    Bundle.of(system, twin, guard, classifier, data=[calibration], notes=notes).save(out)
    note(f"Saved {out}")


@app.command(epilog=example("retwin bundle verify bundle"))
def verify(folder: Folder, as_json: Json = False) -> None:
    """Compare every file with its SHA-256, and describe the bundle; nothing is loaded."""
    from retwin.deploy.bundle.seal import read_sealed

    about = read_sealed(saved(folder), "bundle", "portable")
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    properties = ("case", "schema", "steps", "movements", "sensor_rate")
    values = {name: about.get(name) for name in properties}
    provenance = about.get("provenance")
    notes = provenance if isinstance(provenance, dict) else {}
    answer(
        {
            "folder": str(folder),
            "kind": about["kind"],
            "bytes": size,
            **values,
            "provenance": notes,
        },
        f"{about['kind']}, {size / 1e6:.2f} MB",
        table(("property", "value"), [*values.items(), *notes.items()]),
        "",
        f"{folder} is whole",
        as_json=as_json,
    )


@app.command(epilog=example("retwin bundle predict bundle real.mat --case armpi"))
def predict(
    folder: Annotated[Path, argument("BUNDLE", "Folder of a bundle, or of its ONNX export.")],
    file: Measured,
    case: CaseOption = None,
    out: Probabilities = None,
    mapping: LogMapping = None,
    max_bytes: MaxBytes = None,
    as_json: Json = False,
) -> None:
    """Diagnose trajectories, and flag those that the bundle was not made for.

    A trajectory that is outside has no diagnosis and no probabilities.
    """
    if out is not None:
        check_place(out)
    bundle = _opened(folder)
    trajectories = read(file, data_case(case), max_bytes=max_bytes, mapping=mapping)
    found = bundle.predict(trajectories)
    diagnosed = diagnoses(trajectories, found.classes, found.probabilities, found.diagnosis)
    verdicts = zip(found.verdicts.verdict.tolist(), found.verdicts.reason.tolist(), strict=True)
    for each, (verdict, reason) in zip(diagnosed, verdicts, strict=True):
        each |= {"guard": verdict, "because_of": reason}
    rows = [
        (
            e["id"],
            e["diagnosis"],
            "" if e["probability"] is None else f"{e['probability']:.2f}",
            e["guard"],
            e["because_of"],
        )
        for e in diagnosed
    ]
    answer(
        {"emulated": trajectories.emulated, "trajectories": diagnosed},
        table(("trajectory", "diagnosis", "probability", "guard", "because of"), rows),
        *([EMULATED] if trajectories.emulated else []),
        as_json=as_json,
    )
    if out is not None:
        write_probabilities(out, found.classes, diagnosed, ("diagnosis", "guard", "because_of"))


@app.command(epilog=example("retwin bundle generate bundle --out made.npz"))
def generate(
    folder: Folder,
    out: Annotated[Path, option("FILE", "New *.npz or *.zarr.")],
    per_class: PerClass = 400,
    case: OtherCase = None,
    seed: Seed = 0,
) -> None:
    """Generate a balanced labelled set."""
    import retwin as rt
    from retwin.deploy.bundle.bundle import Bundle

    check_target(out)
    bundle = Bundle.load(saved(folder))
    system = case_named(case)
    # Only built-in names: code that a file names is not run, so other cases are given by --case.
    if system is None and bundle.facts.sampler is None and bundle.facts.case.isidentifier():
        system = rt.cases.get(bundle.facts.case)
    with bar("generate") as show:
        made = bundle.generate(
            system, per_class=per_class, seed=seed, progress=lambda s: show("", s)
        )
    rt.save(made, out)
    note(f"Wrote {len(made)} trajectories to {out}")


@app.command(epilog=example("retwin bundle export bundle --onnx portable"))
def export(
    folder: Folder,
    onnx: Annotated[Path, option("FOLDER", "Where to put the ONNX graphs.")],
    as_json: Json = False,
) -> None:
    """Write ONNX graphs, with which `bundle predict` needs no torch."""
    from retwin.deploy.bundle.bundle import Bundle
    from retwin.deploy.onnx.export import export_onnx

    check_place(onnx, folder=True)
    with bar("export") as show:
        parity = export_onnx(Bundle.load(saved(folder)), onnx, progress=lambda s: show("", s))
    rows = [(name, f"{difference:.1e}") for name, difference in parity.items()]
    answer(
        {"saved": str(onnx), "differences": parity},
        table(("graph", "difference from torch"), rows, numbers=("difference from torch",)),
        as_json=as_json,
    )
    note(f"Wrote {onnx}")


def _opened(folder: Path) -> Bundle | Portable:
    """The bundle, or its export, for which torch is not imported."""
    from retwin.deploy.bundle.seal import read_sealed

    if read_sealed(saved(folder), "bundle", "portable")["kind"] == "portable":
        from retwin.deploy.onnx.portable import Portable

        return Portable.load(folder)
    from retwin.deploy.bundle.bundle import Bundle

    return Bundle.load(saved(folder))
