"""`retwin twin animate`: a film of one trajectory."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from retwin.checks import given
from retwin.cli.options import CaseOption, Seed, argument, option
from retwin.cli.reading import read, updated_twin
from retwin.cli.terminal import answer, bar


def animate(
    file: Annotated[Path, argument("FILE", "File or folder of trajectories.")],
    out: Annotated[Path, option("FILE", "The film, *.mp4 or *.gif.")],
    case: CaseOption = "armpi",
    name: Annotated[str | None, option("ID", "Which trajectory, by its id.", "--id")] = None,
    index: Annotated[int, option("N", "Which trajectory, by its place.", min=0)] = 0,
    fps: Annotated[float, option("HZ", "Pictures per second.")] = 25.0,
    size: Annotated[str, option("WxH", "Width and height in pixels.")] = "640x480",
    renderer: Annotated[
        Literal["auto", "mujoco", "stick"], option("", "What draws; auto: the best here.")
    ] = "auto",
    model: Annotated[
        Path | None, option("FOLDER", "A corrected twin, whose band is shown as well.")
    ] = None,
    seed: Seed = 0,
) -> None:
    """Film a trajectory: the nominal motion as a ghost, the observed one solid."""
    from retwin import cases
    from retwin.cases.animation import animate as film
    from retwin.cases.animation.film import check_film

    check_film(out)
    shape = _size(size)
    found = cases.get(case or "armpi")
    updated = None if model is None else updated_twin(model)
    trajectories = read(file, found)
    with bar("animate") as show:
        path = film(
            trajectories,
            found,
            out,
            index=index if name is None else name,
            fps=fps,
            size=shape,
            renderer=renderer,
            updated=updated,
            seed=seed,
            progress=lambda share: show("draw", share),
        )
    answer(path, str(path))


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    expected, remedy = "WIDTHxHEIGHT in pixels", "give it like 640x480"
    found = given("--size", found, expected, got=repr(text), remedy=remedy)
    return int(found[1]), int(found[2])
