"""`animate`: a film of one trajectory, the nominal motion as a translucent ghost."""

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
from retwin.checks import finite, one_of, require
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.progress import Progress
from retwin.serialisation.files import write_atomically

if TYPE_CHECKING:  # a case loads torch, which the worker that draws does not need
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
    """Film one trajectory in real time, without a screen.

    The nominal motion is a translucent ghost, the observed motion is solid; lines trace the paths
    of their tips. Only outputs are measured: the observed pose is an inference, the pose nearest to
    the nominal one that explains the outputs. MuJoCo draws in a worker process, so a script calls
    this under `if __name__ == "__main__":`.

    Parameters
    ----------
    trajectories : Trajectories
        A set of the case; missing commands are recovered.
    case : Case
        A case with a `body`.
    path : str or path-like
        The film, *.mp4 or *.gif.
    index : int or str, default 0
        The trajectory, by position or by id.
    fps : float, default 25.0
        Frames per second, from 1 to 100.
    size : (int, int), default (640, 480)
        Width and height in pixels, even numbers from 160 to 4096.
    renderer : {"auto", "mujoco", "stick"}
        "mujoco" draws the body's model, "stick" its skeleton with matplotlib. "auto" takes MuJoCo
        where it is available, else the skeleton, with a warning that names what is missing.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    Path
        The film, which is written completely or not at all.

    Raises
    ------
    InputError
        No such trajectory, a case without a body, another suffix, a size or frame rate out of
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
        reported = _reported(pictures, len(shots), progress)
        write_film(captioned(reported, shots), part, suffix, fps=fps, size=size)
    return target


def _check(fps: float, size: tuple[int, int], renderer: str) -> None:
    """Refuse settings out of range."""
    finite("fps", fps, least=1, most=100, unit="frames per second", remedy="25 is common")
    # Video codecs halve the resolution of colour.
    require(
        all(160 <= side <= 4096 and side % 2 == 0 for side in size),
        "size",
        expected="an even width and height from 160 to 4096 pixels",
        got=f"{size[0]}x{size[1]}",
        remedy="640x480 is common",
    )
    one_of("renderer", renderer, get_args(Renderer), remedy="leave it out to have one chosen")


def _body_of(case: Case) -> Body:
    """The body of the case, or an InputError."""
    if case.body is None:
        raise InputError(
            "case",
            expected="a case with a body, which can be drawn",
            got=f"{case.name}, which has none",
            remedy="give the Case a body",
        )
    return case.body


def _chosen(trajectories: Trajectories, case: Case, index: int | str) -> Trajectories:
    """The one trajectory at `index`."""
    require(
        trajectories.outputs == case.outputs,
        "trajectories",
        expected=f"outputs {list(case.outputs.names)}, as the case {case.name} has",
        got=list(trajectories.outputs.names),
        remedy="give the case that the data belong to",
    )
    ids = trajectories.ids.tolist()
    expected = f"a position from 0 to {len(ids) - 1}" if ids else "a set that is not empty"
    if isinstance(index, str):
        if index in ids:
            return trajectories[[ids.index(index)]]
        expected = f"one of {len(ids)} ids ({', '.join(ids[:3])}{', …' if len(ids) > 3 else ''})"
    elif 0 <= index < len(ids):
        return trajectories[[index]]
    raise InputError(
        "index",
        expected=expected,
        got=repr(index),
        remedy="`retwin data info FILE` lists them",
    )


def _shots(one: Trajectories, body: Body, fps: float) -> Shots:
    """Poses and skeletons at the times of the frames."""
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
    """The pictures of the chosen renderer, or of the best one that is available."""
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


def _reported(pictures: Pictures, count: int, progress: Progress | None) -> Iterator[NDArray]:
    """The same pictures; reports progress after each of them."""
    for i, picture in enumerate(pictures):
        yield picture
        if progress is not None:
            progress((i + 1) / count)
