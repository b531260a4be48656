"""`retwin twin`: list, describe and simulate twins, and film what they do."""

from __future__ import annotations

import re
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from retwin import twins
from retwin.catalog import CASES, TWINS
from retwin.catalog.modules import known
from retwin.checks import agree, given, require
from retwin.cli import options
from retwin.cli.commands import Commands
from retwin.cli.options import argument, complete_faults, complete_twins, leave_out, option, rare
from retwin.cli.plans import Scheduler, Workers, carry_out
from retwin.cli.reading import read, updated_twin
from retwin.cli.terminal import answer, bar, example, table
from retwin.data.io import check_target
from retwin.errors import InputError
from retwin.serialisation.files import recover
from retwin.serialisation.models import kind_of
from retwin.times import to_samples

if TYPE_CHECKING:
    from retwin.cases.case import Case
    from retwin.data.trajectories import Channels, Trajectories
    from retwin.twins.limits import Limits
    from retwin.twins.twin import Twin


def film_settings(
    film: Path | None, name: str | None, fps: float | None, size: str | None, renderer: str | None
) -> dict[str, Any]:
    """The settings of a film that were given, checked before the work."""
    if film is None:
        others = {"--id": name, "--fps": fps, "--size": size, "--renderer": renderer}
        leave_out(others, "without --film")
        return {}
    from retwin.cases.animation.film import check_film

    check_film(film)
    made = {"index": name, "fps": fps, "size": size and _size(size), "renderer": renderer}
    return {name: value for name, value in made.items() if value is not None}


def draw_film(
    film: Path,
    trajectories: Trajectories,
    twin: Twin,
    system: Case | None,
    settings: dict[str, Any],
) -> None:
    """Film a trajectory, with the bands of a corrected twin."""
    from retwin.cases.animation import animate
    from retwin.update import CorrectedTwin, DynamicsTwin

    expected, remedy = "the case of the trajectories, which draws them", "give --case NAME"
    case = given("--case", system, expected, remedy=remedy)
    updated = twin if isinstance(twin, CorrectedTwin | DynamicsTwin) else None
    with bar("film") as show:
        settings = {"updated": updated, "progress": lambda share: show("draw", share), **settings}
        path = animate(trajectories, case, film, **settings)
    answer(path, str(path))


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    expected, remedy = "WIDTHxHEIGHT in pixels", "give it like 640x480"
    found = given("--size", found, expected, got=repr(text), remedy=remedy)
    return int(found[1]), int(found[2])


app = Commands(help="List, describe and simulate twins.", epilog=example("retwin twin info armpi"))

Rate = Annotated[float | None, rare("HZ", "Samples per second.", min=1e-9)]

RAMPS = 5
"""Ramps in a trajectory whose commands no case draws: enough to reach levels far apart."""
NoMeshes = Annotated[bool, rare("", "Leave out the meshes of a model file.", "--no-meshes")]
Servos = Annotated[
    list[str] | None, rare("JOINT=K,D", "Servo of a URDF's joint; repeatable.", "--servo")
]

SHOWN = 100
"""Largest number of channels in a table: one of thousands takes minutes to lay out."""
OTHERS = {
    "FILE.fmu": "an FMU for co-simulation (FMI 2 or 3)",
    "FILE.xml, FILE.urdf": "a MuJoCo model",
    "case.toml": "the twin of a case of your own",
    "package.module:object": "a twin, or a function from commands to outputs",
    "FOLDER": "a corrected twin or a surrogate that was saved",
}


@app.command(epilog=example("retwin twin info armpi"))
def info(
    twin: Annotated[
        str | None, argument("TWIN", "Else all are listed.", autocompletion=complete_twins)
    ] = None,
    inputs: options.Inputs = "",
    outputs: options.Outputs = "",
    rate: Rate = None,
    servo: Servos = None,
    no_meshes: NoMeshes = False,
    as_json: options.Json = False,
) -> None:
    """Describe a twin: its inputs with their limits, its outputs, its rate.

    Without a name, the built-in twins and the forms of other names are listed. A
    module that is named by the twin or its case, and lies beside the case or in
    the current folder, is run with your rights.
    """
    if twin is None:
        _list(as_json)
        return
    found = _twin(twin, inputs, outputs, rate, servo, no_meshes)
    facts: dict[str, Any] = {
        "title": _title(twin, found),
        "rate": found.rate,
        "inputs": _channels(found.inputs, getattr(found, "limits", None)),
        "outputs": _channels(found.outputs, None),
        "runs": sorted(known().values()) if ":" in twin or _is_case(twin) else [],
    }
    every = [
        (kind.removesuffix("s"), each["name"], each["unit"], *_ends(each))
        for kind in ("inputs", "outputs")
        for each in facts[kind]
    ]
    rest = len(every) - SHOWN
    answer(
        facts,
        facts["title"],
        table(("", "name", "unit", "low", "high"), every[:SHOWN], numbers=("low", "high")),
        *([f"… and {rest} more channels, which --json lists"] if rest > 0 else []),
        f"{found.rate:g} samples per second",
        *[f"runs {file} with your rights" for file in facts["runs"]],
        as_json=as_json,
    )


def _list(as_json: bool) -> None:
    """The built-in twins, and the forms of other names."""
    built_in = {name: entry.title for name, entry in TWINS.items()}
    answer(
        {
            "built_in": [{"name": name, "title": title} for name, title in built_in.items()],
            "forms": [{"form": form, "title": title} for form, title in OTHERS.items()],
        },
        table(("TWIN", "is"), built_in.items()),
        "",
        table(("or", "is"), OTHERS.items()),
        as_json=as_json,
    )


def _channels(channels: Channels, limits: Limits | None) -> list[dict[str, Any]]:
    ends: list[tuple[float | None, float | None]] = [(None, None)] * len(channels)
    if limits is not None:
        ends = list(zip(limits.low, limits.high, strict=True))
    return [
        {"name": name, "unit": unit, "low": low, "high": high}
        for name, unit, (low, high) in zip(channels.names, channels.units, ends, strict=True)
    ]


def _ends(channel: dict[str, Any]) -> tuple[str, str]:
    low, high = (channel[end] for end in ("low", "high"))
    return ("" if low is None else f"{low:g}", "" if high is None else f"{high:g}")


@app.command(epilog=example("retwin twin simulate armpi --n 20000 --fault all --out made.zarr"))
def simulate(
    twin: Annotated[
        str,
        argument(
            "TWIN",
            "See `retwin twin info`; or a saved model's folder.",
            autocompletion=complete_twins,
        ),
    ],
    out: Annotated[Path | None, option("FILE", "New *.npz, or *.zarr of any size.")] = None,
    n: Annotated[int | None, option("N", "Else one per command or class.", "--n")] = None,
    case: Annotated[
        str | None, option("CASE", "Draws commands and faults; else its own.", names=CASES)
    ] = None,
    commands: Annotated[Path | None, option("FILE", "Trajectories with the commands.")] = None,
    fault: Annotated[
        str, option("NAME", "A class, all (in turn), or none.", autocompletion=complete_faults)
    ] = "none",
    seed: options.Seed = 0,
    film: Annotated[
        Path | None, option("FILE", "Film of --out, else of --commands: *.mp4 or *.gif.")
    ] = None,
    name: Annotated[
        str | None, rare("ID", "The filmed trajectory; else the first.", "--id")
    ] = None,
    fps: Annotated[float | None, rare("HZ", "Pictures of the film per second; else 25.")] = None,
    size: Annotated[str | None, rare("WxH", "Of the film; else 640x480.")] = None,
    renderer: Annotated[
        Literal["mujoco", "stick"] | None, rare("", "What draws; else the best here.")
    ] = None,
    duration: Annotated[
        float | None, rare("SECONDS", "Of commands that no case draws.", min=1e-9)
    ] = None,
    inputs: options.Inputs = "",
    outputs: options.Outputs = "",
    rate: Rate = None,
    servo: Servos = None,
    no_meshes: NoMeshes = False,
    clip: Annotated[bool, rare("", "Clip commands to the limits.", "--clip")] = False,
    workers: Workers = None,
    scheduler: Scheduler = None,
    chunk: Annotated[int, rare("N", "Trajectories per chunk.", min=1)] = 256,
    max_bytes: options.MaxBytes = None,
) -> None:
    """Simulate trajectories to a file, or film one.

    An interrupted *.zarr is resumed. A film shows the nominal motion as a ghost,
    the observed one solid, and the bands of TWIN if it is a corrected one.
    """
    from retwin.deploy.simulations import SimulationPlan

    filmed = commands if out is None else out
    expected, remedy = "a file to write, or trajectories to film", "give --out FILE"
    require(out or (film and filmed), "--out", expected=expected, got="none", remedy=remedy)
    settings = film_settings(film, name, fps, size, renderer)
    if out is not None:
        check_target(out)
    else:
        others = {"--n": n, "--duration": duration, "--clip": clip, "--workers": workers}
        leave_out({**others, "--scheduler": scheduler}, "without --out")
    found = _twin(twin, inputs, outputs, rate, servo, no_meshes)
    system = _case(case, twin, found)
    if out is not None:
        faults = _faults(system, fault)
        if commands is not None:
            leave_out({"--duration": duration}, "with commands of a file")
            drawn = read(commands, system, max_bytes=max_bytes)
        else:
            drawn, n = _sampler(system, found, duration), len(faults) if n is None else n
        plan = SimulationPlan(found, drawn, seed, n, faults, clip=clip, chunk=chunk)
        carry_out(plan, out, "simulate", workers=workers, scheduler=scheduler)
    if film is not None and filmed is not None:
        trajectories = read(filmed, system, max_bytes=max_bytes)
        draw_film(film, trajectories, found, system, {"seed": seed, **settings})


def _twin(
    name: str,
    inputs: str,
    outputs: str,
    rate: float | None,
    servos: list[str] | None,
    no_meshes: bool,
) -> Twin:
    """The twin of that name, or the model in that folder."""
    settings: dict[str, Any] = {"meshes": False} if no_meshes else {}
    if servos:
        settings["servos"] = list(map(_servo, servos))
    own = not (inputs or outputs or rate or settings)
    if own and (recover(name) / "model.json").is_file():
        return _model(Path(name))
    if _is_case(name) and own:
        from retwin import cases

        return cases.get(name).twin
    return twins.get(
        name,
        inputs=options.channel_names(inputs),
        outputs=options.channel_names(outputs),
        rate=rate,
        **settings,
    )


def _servo(text: str) -> tuple[str, Any]:
    """A joint and its servo, from "JOINT=STIFFNESS,DAMPING"."""
    from retwin.twins.mujoco.twin import Servo

    joint, _, gains = text.rpartition("=")
    try:
        stiffness, damping = map(float, gains.split(","))
    except ValueError:
        expected = "JOINT=STIFFNESS,DAMPING in N m/rad and N m s/rad"
        remedy = "write for instance --servo hip=500,40"
        raise InputError("--servo", expected=expected, got=repr(text), remedy=remedy) from None
    return joint, Servo(stiffness, damping)


def _is_case(name: str) -> bool:
    return Path(name).suffix.lower() == ".toml"


def _model(folder: Path) -> Twin:
    if kind_of(folder) == "surrogate":
        from retwin.update.surrogate import Surrogate

        return Surrogate.load(folder)
    return updated_twin(folder)


def _title(name: str, found: Twin) -> str:
    if name in TWINS:
        return f"{name}: {TWINS[name].title}"
    if _is_case(name):
        from retwin import cases

        return f"{name}: {cases.get(name).title}"
    summary = (type(found).__doc__ or "").strip().partition("\n")[0]
    return f"{Path(name).name} ({type(found).__name__}): {summary}"


def _case(named: str | None, name: str, found: Twin) -> Case | None:
    """The given case, that of the twin's name, or that a corrected twin was fitted for."""
    from retwin import cases

    own = getattr(found, "case", "")
    if _is_case(name):
        own = name
    elif name in TWINS:
        own = name.partition("-")[0]
    if not (named or own):
        return None
    system = cases.get(named or own)
    names, remedy = ("inputs", "rate"), "name the case that this twin belongs to"
    agree("--case", system, found, "that of the twin", names=names, remedy=remedy)
    return system


def _faults(system: Case | None, fault: str) -> dict[str, Any]:
    from retwin.data.trajectories import HEALTHY

    classes = {} if system is None else dict(system.faults)
    choices: dict[str, dict[str, Any]] = {"none": {HEALTHY: None}}
    if classes:
        choices |= {"all": classes, **{name: {name: each} for name, each in classes.items()}}
    remedy = "check the spelling" if classes else "give --case, which defines faults"
    require(fault in choices, "--fault", expected=", ".join(choices), got=fault, remedy=remedy)
    return choices[fault]


def _sampler(system: Case | None, found: Twin, duration: float | None) -> Any:
    """The sampler of the case, or ramps within the limits of the twin."""
    if system is not None:
        leave_out({"--duration": duration}, "with commands of a case")
        return system.sampler
    limits = getattr(found, "limits", None)
    bounded = limits is not None and all(map(isfinite, limits.low + limits.high))
    expected = "commands, since not all inputs have limits within which to draw them"
    remedy = "give --commands FILE, or --case NAME"
    require(
        bounded or not len(found.inputs), "--commands", expected=expected, got="none", remedy=remedy
    )
    expected = "the duration of a trajectory in seconds, since no case draws commands"
    remedy = "give --duration SECONDS, --commands FILE, or --case NAME"
    duration = given("--duration", duration, expected, remedy=remedy)
    import numpy as np

    from retwin.twins.commands.samplers import RampSampler

    if not len(found.inputs):  # nothing to draw
        return np.zeros((1, max(2, to_samples(duration, found.rate)), 0))
    assert limits is not None
    return RampSampler(limits.low, limits.high, found.rate, duration, RAMPS)
