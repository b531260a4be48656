"""`animate`: one trajectory as a film, the nominal motion as a ghost of the observed one."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from retwin.cases.animation.captions import captioned
from retwin.cases.animation.film import check_film, write_film
from retwin.cases.animation.scene import mujoco_pictures
from retwin.cases.animation.shots import Pictures, Shots
from retwin.cases.animation.sticks import stick_pictures
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.files import write_atomically

if TYPE_CHECKING:  # a case loads torch, which the worker that draws need not wait for
    from retwin.cases.case import Body, Case

__all__ = ["Renderer", "animate"]

Renderer = Literal["auto", "mujoco", "stick"]


def animate(
    trajectories: Trajectories,
    case: Case,
    path: str | os.PathLike[str],
    *,
    index: int | str = 0,
    fps: float = 25.0,
    size: tuple[int, int] = (640, 480),
    renderer: Renderer = "auto",
    progress: Progress | None = None,
) -> Path:
    """Film one trajectory to `path`, *.mp4 or *.gif, in real time and without a screen.

    The nominal motion is a translucent ghost, the observed one solid; lines trace their tips. Only
    outputs are measured: the observed pose is the nearest to the nominal one that explains them, an
    inference and not a measurement. MuJoCo draws in a worker process, so a script calls this under
    `if __name__ == "__main__":`.

    Parameters
    ----------
    trajectories: any set of the case; commands that it lacks are recovered.
    case: it must have a `body`.
    index: which trajectory, by place or by id.
    fps: pictures per second, 1 … 100.
    size: width and height in pixels, even numbers from 160 to 4096.
    renderer: "mujoco" draws the body's model, "stick" its skeleton with matplotlib; "auto" takes
        MuJoCo where it can, else sticks, with a warning that says what is missing.
    progress: called with the share done.

    Returns
    -------
    The film, written whole or not at all.

    Raises
    ------
    InputError: no such trajectory, a case without a body, another suffix, a size or rate out of
        range, MP4 without the extra `render`, or "mujoco" where it cannot draw.

    """
    _check(fps, size, renderer)
    suffix = check_film(path)
    body = _body_of(case)
    one = _chosen(trajectories, case, index)
    shots = _shots(case.complete(one), body, fps)
    target = Path(path)
    with (
        write_atomically(target) as part,
        _pictures(shots, body, size, renderer) as pictures,
    ):
        told = _told(pictures, len(shots), progress)
        write_film(captioned(told, shots), part, suffix, fps=fps, size=size)
    return target


def _check(fps: float, size: tuple[int, int], renderer: str) -> None:
    if not 1 <= fps <= 100:
        raise InputError(
            "fps",
            expected="1 to 100 pictures per second",
            got=repr(fps),
            remedy="25 is usual",
        )
    # Video codecs halve the resolution of colour.
    if any(not 160 <= side <= 4096 or side % 2 for side in size):
        raise InputError(
            "size",
            expected="an even width and height from 160 to 4096 pixels",
            got=f"{size[0]}x{size[1]}",
            remedy="640x480 is usual",
        )
    if renderer not in get_args(Renderer):
        raise InputError(
            "renderer",
            expected=" or ".join(get_args(Renderer)),
            got=repr(renderer),
            remedy="leave it out to have one chosen",
        )


def _body_of(case: Case) -> Body:
    if case.body is None:
        raise InputError(
            "case",
            expected="a case with a body, which says what can be drawn",
            got=f"{case.name}, which has none",
            remedy="give the Case a body",
        )
    return case.body


def _chosen(trajectories: Trajectories, case: Case, index: int | str) -> Trajectories:
    """The one trajectory at `index`."""
    if trajectories.outputs != case.outputs:
        raise InputError(
            "trajectories",
            expected=f"outputs {list(case.outputs.names)}, as the case {case.name} has",
            got=str(list(trajectories.outputs.names)),
            remedy="give the case that the data belong to",
        )
    ids = trajectories.ids.tolist()
    known = f"a place from 0 to {len(ids) - 1}" if ids else "a set that is not empty"
    if isinstance(index, str):
        if index in ids:
            return trajectories[[ids.index(index)]]
        known = f"one of {len(ids)} ids ({', '.join(ids[:3])}{', …' if len(ids) > 3 else ''})"
    elif 0 <= index < len(ids):
        return trajectories[[index]]
    raise InputError(
        "index",
        expected=known,
        got=repr(index),
        remedy="`retwin data info FILE` says how many there are",
    )


def _shots(one: Trajectories, body: Body, fps: float) -> Shots:
    """What every picture shows."""
    count = 1 + int((one.steps - 1) / one.rate * fps + 1e-9)
    seconds = np.arange(count) / fps
    at = np.minimum(np.round(seconds * one.rate).astype(int), one.steps - 1)
    nominal, observed = (joints[0, at] for joints in body.poses(one))
    return Shots(
        title=" · ".join(filter(None, (one.ids[0], one.labels[0].replace("_", " ")))),
        emulated=one.emulated,
        seconds=seconds,
        nominal=nominal,
        observed=observed,
        nominal_points=body.skeleton(nominal),
        observed_points=body.skeleton(observed),
    )


@contextmanager
def _pictures(shots: Shots, body: Body, size: tuple[int, int], renderer: str) -> Iterator[Pictures]:
    """The pictures, by the renderer that was asked for, or the best that can be had."""
    if renderer == "stick":
        yield stick_pictures(shots, size)
        return
    with ExitStack() as stack:
        try:
            found = stack.enter_context(mujoco_pictures(shots, body, size))
        except InputError as error:
            if renderer == "mujoco":
                raise
            warnings.warn(f"drawn as a stick figure: {error}", stacklevel=5)
            found = stick_pictures(shots, size)
        yield found


def _told(pictures: Pictures, count: int, progress: Progress | None) -> Iterator[NDArray]:
    for i, picture in enumerate(pictures):
        yield picture
        if progress is not None:
            progress((i + 1) / count)
