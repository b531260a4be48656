"""Films of a trajectory, of `retwin twin simulate --film`: their settings, and the drawing."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from retwin.checks import given
from retwin.cli.options import leave_out
from retwin.cli.terminal import answer, bar

if TYPE_CHECKING:
    from retwin.cases.case import Case
    from retwin.data.trajectories import Trajectories
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
