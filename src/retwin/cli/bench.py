"""`retwin bench`: times on this machine, beside those of the paper."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from retwin.cli.options import Json
from retwin.cli.terminal import answer, bar, note, table
from retwin.serialisation.files import write_json
from retwin.serialisation.places import check_place

if TYPE_CHECKING:
    from retwin.cli.benchmark import Benchmark


def bench(
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="JSON file for the figures, too.")
    ] = None,
    n: Annotated[
        int, typer.Option("--n", metavar="N", help="Trajectories that times are given for.", min=9)
    ] = 3600,
    repeats: Annotated[
        int, typer.Option(metavar="N", help="Times that generation is timed.", min=1)
    ] = 3,
    as_json: Json = False,
) -> None:
    """Time twins of the arm and what learns from them, beside the paper."""
    from retwin.cli.benchmark import run_bench

    if out is not None:
        check_place(out)
    with bar("bench") as show:
        found = run_bench(count=n, repeats=repeats, report=show)
    figures = found.about()
    if out is not None:
        write_json(out, figures)
    made = [
        (
            way.what,
            f"{way.seconds:.3g}",
            f"{found.count / way.seconds:.0f}",
            f"{found.ratio(name):.3g}",
            "" if way.paper is None else f"{way.paper:.0f}",
        )
        for name, way in found.generation.items()
    ]
    learned = [(each.what, f"{each.seconds:.3g}") for each in found.learning.values()]
    numbers = ("s", "per s", "ratio", "paper, s")
    answer(
        figures,
        table((f"{n} trajectories of 10 s, labelled", *numbers), made, numbers=numbers),
        "",
        table(("learned", "s"), learned, numbers=("s",)),
        "",
        *_sentences(found),
        as_json=as_json,
    )
    if out is not None:
        note(f"Wrote {out}")


def _sentences(found: Benchmark) -> Iterator[str]:
    """The main results in sentences."""
    yield (
        f"The twin takes {found.ratio('twin'):.0f} times as long as the corrected twin; the "
        f"paper's, {found.paper_ratio:.0f} times."
    )
    closed = found.ratio("closed_form")
    faster = "which needs no surrogate for speed" if closed < 1 else "which is no faster here"
    yield f"This arm has a closed form, {faster}: {closed:.2g} times the corrected twin."
    yield (
        f"Learning included, the corrected twin is faster from {found.pays_from:.0f} trajectories."
        if found.pays_from < float("inf")
        else "The corrected twin is not faster than the twin here."
    )
    yield "These are times alone: `retwin study` measures the accuracy of diagnosis."
