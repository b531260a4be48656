"""`retwin next`: which trajectories to record next, and whether there are enough."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from retwin.cli.options import CaseArgument, Json, LogMapping, Model, Seed, option, rare
from retwin.cli.reading import case_named, read, updated_twin
from retwin.cli.terminal import answer, bar, note, table
from retwin.data.io import check_target

if TYPE_CHECKING:
    from retwin.evaluation.experiments.propose import Proposal


def propose(
    case: CaseArgument,
    model: Model,
    real: Annotated[Path, option("FILE", "The trajectories it was calibrated on.")],
    out: Annotated[Path, option("FILE", "The commands to send, *.npz.")],
    count: Annotated[int, option("N", "Trajectories to propose.")] = 3,
    candidates: Annotated[int, rare("N", "Commands to choose from.")] = 200,
    tolerance: Annotated[float, rare("X", "Share by which bands may be too wide.")] = 0.05,
    seed: Seed = 0,
    mapping: LogMapping = None,
    as_json: Json = False,
) -> None:
    """Propose what to record next, and whether there is enough."""
    import numpy as np

    import retwin as rt

    check_target(out)
    system = case_named(case)
    assert system is not None
    twin = updated_twin(model)
    calibration = read(real, system, part="calibration", mapping=mapping)
    with bar("next") as show:
        wanted: Any = {"count": count, "candidates": candidates, "tolerance": tolerance}
        drawn, report = system.sampler, partial(show, "")
        made = rt.next_experiments(twin, calibration, drawn, seed=seed, progress=report, **wanted)
    if isinstance(twin, rt.CorrectedTwin):
        nominal = twin.surrogate.predict(made.commands)
    else:
        nominal = twin.simulate(made.commands, seed=seed).nominal
    nothing = np.full_like(nominal, np.nan)
    commands = rt.Trajectories(
        made.commands, nominal, nothing, twin.rate, inputs=twin.inputs, outputs=twin.outputs
    )
    rt.save(commands, out)
    curve = [_curve(made)] if made.curve else []
    answer(_values(made, out), _ahead(made), *curve, _verdict(made), as_json=as_json)
    note(f"Saved {len(made.commands)} trajectories of commands to {out}")


def _ahead(made: Proposal) -> Any:
    """What is expected of further trajectories."""
    rows = [
        (
            chosen.trajectories,
            f"{chosen.excess[0]:+.1%}",
            f"{random.excess[0]:+.1%} ({random.excess[1]:.1%} to {random.excess[2]:.1%})",
            f"{chosen.recall[0]:.1%}",
            f"{random.recall[0]:.1%} ({random.recall[1]:.1%} to {random.recall[2]:.1%})",
        )
        for chosen, random in zip(made.ahead, made.ahead_random, strict=True)
    ]
    head = ("healthy", "band, chosen", "band, random", "recall, chosen", "recall, random")
    return table(head, rows)


def _curve(made: Proposal) -> Any:
    """What was measured so far."""
    rows = [
        (each.trajectories, f"{each.error[0]:.2f} ({each.error[1]:.2f} to {each.error[2]:.2f})")
        for each in made.curve
    ]
    return table(("healthy so far", "error of the mean on the others, in its deviations"), rows)


def _verdict(made: Proposal) -> str:
    """Whether to stop."""
    now = made.ahead[0].excess[0]
    if made.enough:
        return (
            f"Enough: bands are {now:.1%} wider than with any number of trajectories, within "
            f"{made.tolerance:.0%}."
        )
    parts = [
        f"{'more than 60' if each is None else each} {what}"
        for each, what in ((made.needed, "chosen"), (made.needed_random, "random"))
    ]
    return (
        f"Not enough: bands are {now:.1%} wider than with any number of trajectories. They "
        f"are expected to be within {made.tolerance:.0%} after {parts[0]} or {parts[1]} ones."
    )


def _values(made: Proposal, out: Path) -> dict[str, Any]:
    """The result as JSON."""

    def listed(points: Any) -> list[dict[str, Any]]:
        return [{**vars(point), "recall": point.recall} for point in points]

    return {
        "saved": str(out),
        "enough": made.enough,
        "tolerance": made.tolerance,
        "needed": {"chosen": made.needed, "random": made.needed_random},
        "gains": list(made.gains),
        "random_gain": made.random_gain,
        "chosen": listed(made.ahead),
        "random": listed(made.ahead_random),
        "curve": [vars(point) for point in made.curve],
    }
