"""Solid bodies: the MJCF model of a body drawn twice by MuJoCo, in a worker process.

OpenGL is bound to one backend for the life of a process and may end the process. The caller's
environment and its MuJoCo stay unchanged.
"""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pebble import ProcessExpired, ProcessPool

from retwin.cases.animation.shots import GHOST, PAPER, Camera, Pictures, Shots
from retwin.checks import given, install_command, require
from retwin.errors import InputError, brief
from retwin.workers.pools import worker_pool

if TYPE_CHECKING:
    from retwin.cases.case import Body

BACKENDS = ("egl", "osmesa")
"""Backends that draw without a screen, tried in this order unless MUJOCO_GL names one."""
TIMEOUT = 120.0
"""Duration in s after which a task is ended as hung; software rendering is slow."""
BROKEN = (RuntimeError, ProcessExpired, TimeoutError)
"""Errors of a worker that cannot draw."""


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
    iterable of ndarray of uint8, shape (height, width, 4)
        One picture per frame.

    Raises
    ------
    InputError
        The body has no model, the model lacks a joint, a package is missing, or no backend works.

    """
    got, remedy = "a body that is a chain of points only", "draw it as a stick figure"
    model = given("renderer", body.model, "a body with a model", got=got, remedy=remedy)
    require(
        importlib.util.find_spec("OpenGL") is not None,
        "renderer",
        expected="the package pyopengl, which draws solid bodies",
        got="an installation without it",
        remedy=f"install it: {install_command('render')}",
    )
    stage = _Stage(str(model), body.joints, Camera.of(shots, size))
    named = os.environ.get("MUJOCO_GL", "").lower()
    reasons = []
    for backend in (named,) if named else BACKENDS:
        with ExitStack() as stack:
            pool = stack.enter_context(worker_pool(1, _draw_with, (backend,)))
            pictures = _pictures(pool, stage, shots)
            try:
                first = next(pictures)
            except BROKEN as error:
                hung = isinstance(error, TimeoutError)
                why = f"it hung for more than {TIMEOUT:g} s" if hung else brief(error)
                reasons.append(f"{backend}: {why}")
                continue
            with stack.pop_all():
                yield chain((first,), pictures)
                return
    raise InputError(
        "renderer",
        expected="OpenGL that draws without a screen",
        got=f"none that works ({'; '.join(reasons)})",
        remedy="install EGL or OSMesa (Debian: apt install libegl1 libgl1-mesa-dri, or libosmesa6)",
    )


@dataclass(frozen=True)
class _Stage:
    """Settings of a scene: the MJCF file, the joints, and the camera."""

    model: str
    joints: tuple[str, ...]
    camera: Camera


def _pictures(
    pool: ProcessPool, stage: _Stage, shots: Shots, *, frames_per_task: int = 10
) -> Iterator[NDArray]:
    """The pictures, some frames at a time.

    Parameters
    ----------
    frames_per_task : int, default 10
        Number of frames per task: enough to hide the transfer, few enough to show progress.

    """
    poses = shots.poses.swapaxes(0, 1)
    for first in range(0, len(shots), frames_per_task):
        some = poses[first : first + frames_per_task]
        yield from pool.schedule(_draw, (stage, some), timeout=TIMEOUT).result()


def _draw_with(backend: str) -> None:
    """Set the backend in the worker, before the import of MuJoCo, which reads it."""
    # A backend that does not work raises an error; a library's own warnings would repeat it.
    warnings.simplefilter("ignore")
    os.environ["MUJOCO_GL"] = backend
    os.environ.pop("PYOPENGL_PLATFORM", None)


def _draw(stage: _Stage, poses: NDArray) -> NDArray:
    """Pictures (frames, height, width, 4) of poses (frames, 2, joints), nominal and observed.

    Runs in the worker. Failures are raised as RuntimeError, because OpenGL's errors cannot be sent
    to another process.
    """
    try:
        return np.stack([_Scene(stage).picture(*pose) for pose in poses])
    except InputError:
        raise
    except Exception as error:
        raise RuntimeError(f"{type(error).__name__}: {error}") from None


@lru_cache(maxsize=1)  # a worker keeps it between its tasks
class _Scene:
    """The model and its renderer; InputError if it lacks a joint."""

    def __init__(self, stage: _Stage) -> None:
        import mujoco

        self._mujoco = mujoco
        try:
            self._model = _compile(stage)
            self._addresses = [self._model.joint(name).qposadr[0] for name in stage.joints]
        except (ValueError, KeyError) as error:
            expected = f"an MJCF file with the joints {', '.join(stage.joints)}"
            got = f"{stage.model} ({brief(error)})"
            remedy = "make the body's model and its joints agree"
            raise InputError("model", expected=expected, got=got, remedy=remedy) from None
        self._data = mujoco.MjData(self._model)
        camera = stage.camera
        self._renderer = mujoco.Renderer(self._model, camera.size[1], camera.size[0])
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.lookat, self._camera.distance = camera.lookat, camera.distance
        self._camera.azimuth, self._camera.elevation = camera.azimuth, camera.elevation
        own = self._model.geom_bodyid != 0
        self._solid = self._model.geom_rgba.copy(), self._model.geom_matid.copy()
        self._ghost = self._solid[0].copy(), np.where(own, -1, self._solid[1])
        self._ghost[0][own, :3] = GHOST
        mujoco.mj_forward(self._model, self._data)  # places the lights

    def picture(self, nominal: NDArray, observed: NDArray) -> NDArray:
        """The picture (height, width, 4) of nominal and observed joints in rad or m."""
        # The ghost is behind the solid body: two surfaces in one place would flicker.
        ghost, solid = self._render(nominal, self._ghost), self._render(observed, self._solid)
        paper = np.round(255 * np.array(PAPER))
        behind, there = (np.abs(each - paper).max(axis=2) > 2 for each in (ghost, solid))
        # Opacity of the ghost, from 0 to 1.
        opacity = np.where(there, 1, 0.6 * behind)
        colour = np.where(there[..., None], solid, ghost)
        return np.concatenate([colour, 255 * opacity[..., None]], axis=2).astype(np.uint8)

    def _render(self, joints: NDArray, look: tuple[NDArray, NDArray]) -> NDArray:
        """The picture (height, width, 3) of the body in a pose."""
        self._data.qpos[self._addresses] = joints
        self._model.geom_rgba[:], self._model.geom_matid[:] = look
        self._mujoco.mj_kinematics(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera, self._option)
        self._renderer.scene.flags[self._mujoco.mjtRndFlag.mjRND_SHADOW] = False
        return self._renderer.render()


def _compile(stage: _Stage) -> Any:
    """The model on light paper."""
    import mujoco

    spec = mujoco.MjSpec.from_file(stage.model)
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = stage.camera.size
    visual.global_.fovy = stage.camera.field
    visual.headlight.ambient, visual.headlight.diffuse = [0.5] * 3, [0.4] * 3
    visual.headlight.specular = [0.1] * 3
    spec.worldbody.add_light(pos=[0.4, -0.6, 1.5], dir=[-0.25, 0.35, -1], diffuse=[0.35] * 3)
    for texture in spec.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            spec.delete(texture)
    flat = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_FLAT}
    spec.add_texture(name="retwin_paper", **flat, rgb1=PAPER, rgb2=PAPER, width=8, height=48)
    return spec.compile()
