"""`animate`: a film of one trajectory, the nominal motion as a translucent ghost."""

from __future__ import annotations

import os
import warnings
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from retwin.cases.animation.film import check_film, write_film
from retwin.cases.animation.page import Chart, film_pages, picture_size
from retwin.cases.animation.shots import Pictures, Shots
from retwin.cases.animation.solid import mujoco_pictures
from retwin.checks import agree, finite, given, one_of, require
from retwin.data.trajectories import Trajectories
from retwin.errors import InputError
from retwin.progress import Progress, tracked
from retwin.serialisation.files import write_atomically

if TYPE_CHECKING:  # a case loads torch, which the worker that draws does not need
    from retwin.cases.case import Body, Case
    from retwin.twins.twin import Twin

__all__ = ["Renderer", "animate"]

Renderer = Literal["auto", "mujoco", "stick"]
DRAWS, SHOWN = 200, 16
"""Draws of an updated twin for its band, and how many of them the picture shows."""
SMALL, WITH_CHART = (160, 160), (320, 240)
"""The smallest width and height in pixels, without and with a chart."""


def animate(
    trajectories: Trajectories,
    case: Case,
    path: str | os.PathLike[str],
    *,
    index: int | str = 0,
    fps: float = 25.0,
    size: tuple[int, int] = (640, 480),
    renderer: Renderer = "auto",
    updated: Twin | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Path:
    """Film one trajectory in real time, without a screen.

    The nominal motion is a translucent ghost, the observed motion is solid; lines trace the paths
    of their tips. Only outputs are measured: the observed pose is an inference, the pose nearest to
    the nominal one that explains the outputs. Of an updated twin, draws of the tip are shown,
    without a fault, and a chart of its bands for the output that deviates most. MuJoCo draws in a
    worker process, so a script calls this under `if __name__ == "__main__":`.

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
        Width and height in pixels, even numbers from 160 to 4096; with an updated twin from 320
        and 240.
    renderer : {"auto", "mujoco", "stick"}
        "mujoco" draws the body's model, "stick" its skeleton with matplotlib. "auto" takes MuJoCo
        where it is available, else the skeleton, with a warning that names what is missing.
    updated : Twin, optional
        A corrected twin of the same system, which draws outputs for the trajectory's commands. It
        shows what it can predict only if it was not calibrated on this trajectory.
    seed : int, default 0
        Seed of these draws, at least 0.
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
        range, MP4 without the extra `render`, "mujoco" where it cannot draw, or an updated twin
        of another system.

    """
    _check(fps, size, renderer, at_least=SMALL if updated is None else WITH_CHART)
    suffix = check_film(path)
    remedy, got = "give the Case a body", f"{case.name}, which has none"
    body = given(
        "case", case.body, "a case with a body, which can be drawn", got=got, remedy=remedy
    )
    one = _choose(trajectories, case, index)
    one = case.complete(one)
    shots, chart = _shots(one, body, fps), None
    if updated is not None:
        drawn = _draws(updated, one, seed)
        _, poses = body.poses(drawn[:SHOWN])
        shots = replace(shots, drawn=body.skeleton(poses[:, _samples(one, fps)])[..., -1, :])
        chart = _chart(one, drawn.observed)
    target, inner = Path(path), picture_size(size, chart=chart is not None)
    with write_atomically(target) as part, ExitStack() as stack:
        pictures: Pictures | None = None
        try:
            if renderer != "stick":
                pictures = stack.enter_context(mujoco_pictures(shots, body, inner))
        except InputError as error:
            if renderer == "mujoco":
                raise
            warnings.warn(f"drawn as a stick figure: {error}", stacklevel=2)
        pages = tracked(film_pages(shots, size, pictures, chart), len(shots), progress)
        write_film(pages, part, suffix, fps=fps, size=size)
    return target


def _draws(updated: Twin, one: Trajectories, seed: int) -> Trajectories:
    """Draws of the updated twin for the commands of a trajectory."""
    remedy = "give the corrected twin that was fitted for these data"
    agree("updated", updated, one, "that of the trajectory", remedy=remedy)
    made = updated.simulate(np.repeat(one.commands, DRAWS, axis=0), seed=seed)
    fits = bool(np.isfinite(made.observed).all())
    expected = "finite outputs for these commands"
    got = "outputs that are not"
    require(fits, "updated", expected=expected, got=got, remedy="fit it on commands like these")
    return made


def _chart(one: Trajectories, drawn: NDArray) -> Chart:
    """The chart of the output that deviates most from the nominal one."""
    observed = one.measured[0] - one.nominal[0]
    seen = one.mask[0].sum(axis=0)
    error = np.where(seen > 0, np.nansum(np.square(observed), axis=0) / np.maximum(seen, 1), -1.0)
    column = int(np.argmax(error))
    unit = one.outputs.units[column]
    factor, shown = (1000.0, "mm") if unit == "m" else (1.0, unit)
    return Chart(
        title=f"{one.outputs.names[column]} minus nominal" + (f", {shown}" if shown else ""),
        time=np.arange(one.steps) / one.rate,
        observed=factor * observed[:, column],
        drawn=factor * (drawn[..., column] - one.nominal[0, :, column]),
    )


def _check(fps: float, size: tuple[int, int], renderer: str, *, at_least: tuple[int, int]) -> None:
    """Refuse settings out of range."""
    finite("fps", fps, at_least=1, at_most=100, unit="frames per second", remedy="25 is common")
    # Video codecs halve the resolution of colour.
    fits = all(a <= side <= 4096 and side % 2 == 0 for a, side in zip(at_least, size, strict=True))
    expected = f"an even width and height from {at_least[0]}x{at_least[1]} to 4096x4096 pixels"
    require(fits, "size", expected=expected, got=f"{size[0]}x{size[1]}", remedy="640x480 is common")
    one_of("renderer", renderer, get_args(Renderer), remedy="leave it out to have one chosen")


def _choose(trajectories: Trajectories, case: Case, index: int | str) -> Trajectories:
    """The one trajectory at `index`."""
    remedy = "give the case that the data belong to"
    agree(
        "trajectories", trajectories, case, "those of the case", names=("outputs",), remedy=remedy
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
        "index", expected=expected, got=repr(index), remedy="`retwin data info FILE` lists them"
    )


def _shots(one: Trajectories, body: Body, fps: float) -> Shots:
    """Poses and skeletons at the times of the frames."""
    at = _samples(one, fps)
    poses = np.stack([joints[0, at] for joints in body.poses(one)])
    title = " · ".join(filter(None, (one.ids[0], one.labels[0].replace("_", " "))))
    return Shots(title, one.emulated, np.arange(len(at)) / fps, poses, body.skeleton(poses))


def _samples(one: Trajectories, fps: float) -> NDArray:
    """The sample at the time of each frame."""
    count = 1 + int((one.steps - 1) / one.rate * fps + 1e-9)
    samples: NDArray = np.round(np.arange(count) / fps * one.rate).astype(int)
    return np.minimum(samples, one.steps - 1)
