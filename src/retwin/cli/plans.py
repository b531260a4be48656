"""Simulation plans of commands: `retwin twin simulate` and `retwin generate`."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from retwin.cli.options import rare
from retwin.cli.terminal import FAILED, bar, complain, note, resumable

if TYPE_CHECKING:
    from retwin.deploy.simulations import SimulationPlan

Workers = Annotated[int | None, rare("N", "Processes for *.zarr; else all cores.", min=1)]
Scheduler = Annotated[str | None, rare("ADDRESS", "Dask scheduler instead of processes.")]


def carry_out(
    plan: SimulationPlan,
    out: Path,
    what: str,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Write the trajectories of a plan; list those that fail, and exit with code 1 if any did."""
    from retwin.deploy.simulations import simulate_to

    with resumable() if out.suffix.lower() == ".zarr" else nullcontext(), bar(what) as show:
        done = simulate_to(
            out,
            plan,
            workers=workers,
            scheduler=scheduler,
            progress=lambda share: show(f"{share * plan.count:.0f} of {plan.count}", share),
        )
    note(f"Wrote {done.count - len(done.failed)} trajectories to {out}")
    if done.failed:
        named = "; ".join(f"trajectory {i}: {why}" for i, why in list(done.failed.items())[:5])
        more = "; …" if len(done.failed) > 5 else ""
        complain(f"{len(done.failed)} of {done.count} simulations failed: {named}{more}")
        raise typer.Exit(FAILED)
