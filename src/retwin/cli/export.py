"""`retwin export`: updated twins for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from retwin.checks import require
from retwin.cli import options
from retwin.cli.commands import Commands
from retwin.cli.options import argument, leave_out, option, rare
from retwin.cli.reading import saved, system_of, updated_twin
from retwin.cli.terminal import answer, bar, example, note, table
from retwin.errors import InputError
from retwin.serialisation.places import check_place

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from retwin.deploy.actuator.export import ExportedActuator
    from retwin.deploy.actuator.torque_net import Joint


app = Commands(
    help="Take an updated twin to other tools.",
    epilog=example("retwin export fmu model --out twin.fmu"),
)


@app.command(epilog=example("retwin export fmu model --out twin.fmu --version 3.0"))
def fmu(
    model: Annotated[Path, argument("MODEL", "Folder of an updated twin, of retwin fit.")],
    out: Annotated[Path, option("FILE", "The FMU to write, *.fmu.")],
    version: Annotated[Literal["2.0", "3.0"], option("FMI", "Version of FMI: 2.0 or 3.0.")] = "2.0",
    source_only: Annotated[
        bool, rare("", "Write no binary for this machine.", "--source-only")
    ] = False,
    case: options.OtherCase = None,
    as_json: options.Json = False,
) -> None:
    """Write an updated twin as an FMU with C source code inside."""
    from retwin.deploy.fmu.export import export_fmu
    from retwin.update.residual import ResidualModel

    check_place(out)
    twin = updated_twin(model)
    commands = None
    if isinstance(getattr(twin, "residual", None), ResidualModel):
        commands = _sampled(twin, model, case, 0)
    with bar("export") as show:
        show("compile", 0.0)
        made = export_fmu(twin, out, version=version, compiled=not source_only, commands=commands)
    drawn = "Delays and offsets are drawn once for each simulation."
    omitted = f"Its outputs are those of the system: {', '.join(made.omitted)} is left out."
    delayed = (
        f"Its outputs are {made.delay:g} s behind, since the command at the end of a step is not "
        "known when the step begins."
    )
    answer(
        {
            "saved": str(out),
            "variables": list(made.variables),
            "delay": made.delay,
            "omitted": list(made.omitted),
        },
        *([delayed] if made.delay else []),
        *([drawn] if commands is not None else []),
        *([omitted] if made.omitted else []),
        as_json=as_json,
    )
    note(f"Saved {out}")


@app.command(epilog=example("retwin export onnx bundle --out portable"))
def onnx(
    folder: Annotated[Path, argument("BUNDLE", "Folder of a bundle, of retwin bundle save.")],
    out: Annotated[Path, option("FOLDER", "Where to put the ONNX graphs.")],
    as_json: options.Json = False,
) -> None:
    """Write a bundle as ONNX graphs, with which `diagnose predict` needs no torch."""
    from retwin.deploy.bundle.bundle import Bundle
    from retwin.deploy.onnx.export import export_onnx

    check_place(out, folder=True)
    with bar("export") as show:
        parity = export_onnx(Bundle.load(saved(folder)), out, progress=lambda s: show("", s))
    rows = [(name, f"{difference:.1e}") for name, difference in parity.items()]
    answer(
        {"saved": str(out), "differences": parity},
        table(("graph", "difference from torch"), rows, numbers=("difference from torch",)),
        as_json=as_json,
    )
    note(f"Wrote {out}")


@app.command(epilog=example("retwin export actuator model --out actuator --period 0.005"))
def actuator(
    model: Annotated[Path, argument("MODEL", "Folder of an updated twin, of retwin fit.")],
    out: Annotated[Path, option("DIR", "The folder to write; with --torque a network, *.pt.")],
    period: Annotated[
        float | None, option("S", "Seconds between two steps; else the sample period.")
    ] = None,
    draws: Annotated[int | None, rare("N", "Draws of the discrepancy; else 16384.")] = None,
    torchscript_only: Annotated[
        bool, rare("", "Write no ONNX graph.", "--torchscript-only")
    ] = False,
    torque: Annotated[
        list[str] | None,
        option(
            "NAMES",
            "Learn the torque instead: channels TARGET,POSITION,TORQUE[,VELOCITY]; "
            "repeat it for equal actuators.",
        ),
    ] = None,
    history: Annotated[str | None, rare("STEPS", "Of --torque, into the past; else 0,1,2.")] = None,
    case: options.OtherCase = None,
    seed: options.Seed = 0,
    as_json: options.Json = False,
) -> None:
    """Write what the actuators execute, for many simulated robots at once.

    With --torque, write the torque by position errors and velocities, where
    torque is an output of the twin.
    """
    if torque:
        others = {"--period": period, "--draws": draws, "--torchscript-only": torchscript_only}
        leave_out(others, "with --torque")
    else:
        leave_out({"--history": history}, "without --torque")
    joints = [_joint(each) for each in torque or ()]
    steps = _steps(history or "0,1,2")
    check_place(out, folder=not torque)
    twin = updated_twin(model)
    if torque:
        commands = _sampled(twin, model, case, seed)
        asked = {"joints": joints, "commands": commands, "seed": seed, "history": steps}
        _write_torque(twin, out, asked, as_json=as_json)
        return
    from retwin.deploy.actuator.draws import causal_part
    from retwin.deploy.actuator.export import export_actuator

    twin, _ = causal_part(twin)
    commands = _sampled(twin, model, case, seed)
    with bar("export") as show:
        show("compile", 0.0)
        settings: Any = {"period": period, "onnx": not torchscript_only}
        settings |= {} if draws is None else {"draws": draws}
        made = export_actuator(twin, out, commands=commands, seed=seed, **settings)
    _print_actuator(made, out, as_json=as_json)


def _write_torque(twin: Any, out: Path, asked: dict[str, Any], *, as_json: bool) -> None:
    """Write the network of torques, and print the settings with which simulators load it."""
    from retwin.deploy.actuator.torque_net import export_actuator_net

    with bar("export") as show:
        made = export_actuator_net(twin, out, **asked, progress=lambda share: show("train", share))
    names = ("network_file", "input_order", "input_idx", "pos_scale", "vel_scale", "torque_scale")
    file, places = str(made.network_file), list(made.input_idx)
    values = vars(made) | {"network_file": file, "input_idx": places}
    settings = {name: values[name] for name in names}
    answer(
        values,
        table(("of ActuatorNetMLPCfg", "value"), list(settings.items())),
        f"The simulation must call it every {made.period:g} s. Torques are in {made.unit}; their "
        f"error on held-out simulations of the twin, noise included, is {made.error:.2g} of their "
        "standard deviation.",
        as_json=as_json,
    )
    note(f"Saved {made.network_file}")


def _joint(text: str) -> Joint:
    """The channels in a value of --torque."""
    from retwin.deploy.actuator.torque_net import Joint

    names = options.channel_names(text)
    complete = len(names) in (3, 4) and len(names) == text.count(",") + 1
    expected = "TARGET,POSITION,TORQUE or TARGET,POSITION,TORQUE,VELOCITY"
    remedy = "name a command and two or three outputs of the twin; `retwin data info` of its "
    remedy += "calibration data lists them"
    require(complete, "--torque", expected=expected, got=repr(text), remedy=remedy)
    return Joint(*names)


def _steps(text: str) -> tuple[int, ...]:
    """The steps into the past in the value of --history."""
    try:
        return tuple(int(each) for each in text.split(","))
    except ValueError:
        expected = "whole numbers of steps, joined by commas"
        remedy = "give --history 0,1,2"
        raise InputError("--history", expected=expected, got=repr(text), remedy=remedy) from None


def _print_actuator(made: ExportedActuator, out: Path, *, as_json: bool) -> None:
    """The delays, and what a user of the files should know."""
    mean, greatest = made.delay
    shown = [f"Delays are {1000 * mean:.3g} ms on average and {1000 * greatest:.3g} ms at most."]
    if made.early:
        shown.append(f"{made.early:.1%} of the delays were before the command and are 0.")
    if made.emulated:
        shown.append("The twin was calibrated on an emulated system.")
    answer(
        {
            "saved": str(out),
            "files": list(made.files),
            "outputs": list(made.outputs.names),
            "period": made.period,
            "delay": {"mean": mean, "max": greatest},
            "early": made.early,
            "gain": list(made.gain),
            "emulated": made.emulated,
        },
        *shown,
        as_json=as_json,
    )
    note(f"Saved {out}")


def _sampled(twin: Any, model: Path, case: str | None, seed: int) -> NDArray:
    """Commands of the sampler of the case, at whose segments z is drawn."""
    import numpy as np

    sampler = system_of(twin, model, case).sampler
    # Trajectories of the case's sampler at whose segments z is drawn, or whose torques are learned.
    return sampler.sample(256, rng=np.random.default_rng(seed))
