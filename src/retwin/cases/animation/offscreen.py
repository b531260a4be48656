"""Pictures that MuJoCo draws off screen.

OpenGL is bound to one backend for the life of a process and may end the process, so the scene is
drawn in a worker process. The caller's environment and its MuJoCo stay unchanged.
"""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pebble import ProcessExpired, ProcessPool

from retwin.cases.animation.scene import Scene, Stage, first_line
from retwin.cases.animation.shots import Pictures, Shots
from retwin.checks import require
from retwin.errors import InputError
from retwin.processes import worker_pool

if TYPE_CHECKING:
    from retwin.cases.case import Body

BACKENDS = ("egl", "osmesa")
"""Backends that draw without a screen, tried in this order unless MUJOCO_GL names one."""
FRAMES_PER_TASK = 10
"""Number of frames per task: enough to hide the transfer, few enough to show progress."""
TIMEOUT = 120.0
"""Duration in s after which a task is ended as hung; software rendering is slow."""
BROKEN = (RuntimeError, ProcessExpired, TimeoutError)
"""Errors of a worker that cannot draw."""


def offscreen_backend() -> str:
    """Find the backend that draws without a screen on this machine.

    Returns
    -------
    str
        A value of the environment variable `MUJOCO_GL`.

    Raises
    ------
    InputError
        A package is missing, or no backend works.

    """
    _check_opengl()
    reasons = []
    for backend in _backends():
        with worker_pool(1, _draw_with, (backend,)) as pool:
            try:
                pool.schedule(_open, timeout=TIMEOUT).result()
            except BROKEN as error:
                reasons.append(f"{backend}: {_why(error)}")
            else:
                return backend
    raise _nothing_draws(reasons)


@contextmanager
def mujoco_pictures(shots: Shots, body: Body, size: tuple[int, int]) -> Iterator[Pictures]:
    """Draw pictures in a worker process that lives as long as the block.

    Parameters
    ----------
    shots : Shots
        The frames.
    body : Body
        A body with a model.
    size : (int, int)
        Width and height in pixels.

    Yields
    ------
    iterable of ndarray of uint8, shape (height, width, 3)
        One picture per frame.

    Raises
    ------
    InputError
        The body has no model, a package is missing, or no backend works.

    """
    stage = Stage(_model(body), body.joints, tuple(shots.root.tolist()), shots.reach, size)
    reasons = []
    for backend in _backends():
        with ExitStack() as stack:
            pool = stack.enter_context(worker_pool(1, _draw_with, (backend,)))
            first = _schedule(pool, stage, shots, 0)
            try:
                first.result()
            except BROKEN as error:
                reasons.append(f"{backend}: {_why(error)}")
                continue
            with stack.pop_all():
                yield _collect(pool, stage, shots, first)
                return
    raise _nothing_draws(reasons)


def _backends() -> tuple[str, ...]:
    """The backends to try."""
    name = os.environ.get("MUJOCO_GL", "").lower()
    return (name,) if name else BACKENDS


def _nothing_draws(reasons: Sequence[str]) -> InputError:
    """The error for a machine on which no backend works."""
    return InputError(
        "renderer",
        expected="OpenGL that draws without a screen",
        got=f"none that works ({'; '.join(reasons)})",
        remedy="install EGL or OSMesa (Debian: apt install libegl1 libgl1-mesa-dri, or libosmesa6)",
    )


def _model(body: Body) -> str:
    """Path of the body's model, if it can be drawn."""
    require(
        body.model is not None,
        "renderer",
        expected="a body with a model",
        got="a body that is a chain of points only",
        remedy="draw it as a stick figure",
    )
    _check_opengl()
    return str(body.model)


def _check_opengl() -> None:
    """Refuse to draw without the package that draws."""
    require(
        importlib.util.find_spec("OpenGL") is not None,
        "renderer",
        expected="the package pyopengl, which draws solid bodies",
        got="an installation without it",
        remedy='install it: pip install "retwin[render]"',
    )


def _schedule(pool: ProcessPool, stage: Stage, shots: Shots, first: int) -> Future[NDArray]:
    """Schedule the frames from `first` on, with the traces that lead to them."""
    end = min(first + FRAMES_PER_TASK, len(shots))
    joints = np.stack([shots.nominal[first:end], shots.observed[first:end]])
    tips = np.stack([shots.nominal_points[:end, -1], shots.observed_points[:end, -1]])
    trails = [shots.trails(frame) for frame in range(first, end)]
    return pool.schedule(_draw, (stage, joints, tips, trails), timeout=TIMEOUT)


def _collect(pool: ProcessPool, stage: Stage, shots: Shots, task: Future[NDArray]) -> Pictures:
    """All pictures; the next task runs while the pictures of one task are used."""
    for first in range(FRAMES_PER_TASK, len(shots) + FRAMES_PER_TASK, FRAMES_PER_TASK):
        following = _schedule(pool, stage, shots, first) if first < len(shots) else task
        yield from task.result()
        task = following


def _why(error: Exception) -> str:
    """Why a worker did not draw, on one line."""
    hung = isinstance(error, TimeoutError)
    return f"it hung for more than {TIMEOUT:g} s" if hung else first_line(error)


def _draw_with(backend: str) -> None:
    """Set the backend in the worker, before the import of MuJoCo, which reads it."""
    # A backend that does not work raises an error; a library's own warnings would repeat it.
    warnings.simplefilter("ignore")
    os.environ["MUJOCO_GL"] = backend
    os.environ.pop("PYOPENGL_PLATFORM", None)


def _draw(stage: Stage, joints: NDArray, tips: NDArray, trails: Sequence[NDArray]) -> NDArray:
    """Pictures (frames, height, width, 3) for joints (2, frames, joints), nominal and observed.

    Runs in the worker. `tips` (2, all frames so far, 3) and the `trails` (draws, points, 3) of each
    frame are in m. Failures are raised as RuntimeError, because OpenGL's errors cannot be sent to
    another process.
    """
    try:
        scene = _scene(stage)
        before = tips.shape[1] - joints.shape[1]
        return np.stack(
            [
                scene.picture(joints[:, i], tips[:, : before + i + 1], trails[i])
                for i in range(joints.shape[1])
            ]
        )
    except InputError:
        raise
    except Exception as error:
        raise RuntimeError(f"{type(error).__name__}: {error}") from None


def _open() -> None:
    """Open an OpenGL context in the worker."""
    try:
        import mujoco

        mujoco.GLContext(64, 64).make_current()
    except Exception as error:
        raise RuntimeError(f"{type(error).__name__}: {error}") from None


@lru_cache(maxsize=1)
def _scene(stage: Stage) -> Scene:
    """The scene, which a worker keeps between its tasks."""
    return Scene(stage)
