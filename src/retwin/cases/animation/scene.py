"""Solid bodies: the body's MJCF model drawn twice in one scene by MuJoCo, off screen.

OpenGL is tied to one way of drawing for the life of a process and may end it, so the scene lives in
a worker process. The caller's environment and its MuJoCo stay as they are.
"""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pebble import ProcessExpired, ProcessPool

from retwin.cases.animation.shots import GHOST, PAPER, RING, SOLID, Pictures, Shots, rings
from retwin.errors import InputError
from retwin.processes import worker_pool

if TYPE_CHECKING:
    from retwin.cases.case import Body

__all__ = ["mujoco_pictures", "offscreen_backend"]

BACKENDS = ("egl", "osmesa")
"""What draws without a screen, tried in this order unless MUJOCO_GL names one."""
CHUNK = 10
"""Pictures per task: enough to hide the transfer, few enough to show progress."""
PATIENCE = 120.0
"""Seconds after which a task hangs."""
BROKEN = (RuntimeError, ProcessExpired, TimeoutError)
"""How a worker ends that cannot draw."""
GHOSTLY = 0.6
"""Opacity of the ghost."""
NOMINAL, OBSERVED = 1, 2
"""MuJoCo's groups of geometry, which can be shown apart."""
GHOST_PREFIX = "nominal/"
ZERO = np.zeros(3)


@dataclass(frozen=True)
class Stage:
    """What a scene is made from: the model, its joints, where it stands, and the picture's size."""

    model: str
    joints: tuple[str, ...]
    root: tuple[float, ...]
    reach: float
    size: tuple[int, int]


def offscreen_backend() -> str:
    """What draws here without a screen: a name that `MUJOCO_GL` knows.

    Raises InputError when a package is missing, or nothing can.
    """
    _check_opengl()
    reasons = []
    for backend in _backends():
        with worker_pool(1, _draw_with, (backend,)) as pool:
            try:
                pool.schedule(_open, timeout=PATIENCE).result()
            except BROKEN as error:
                reasons.append(f"{backend}: {_brief(error)}")
            else:
                return backend
    raise _nothing_draws(reasons)


@contextmanager
def mujoco_pictures(shots: Shots, body: Body, size: tuple[int, int]) -> Iterator[Pictures]:
    """Pictures (height, width, 3), drawn in a worker process that lives as long as the block.

    Raises InputError when the body has no model, a package is missing, or nothing here can draw
    without a screen.
    """
    stage = Stage(_model(body), body.joints, tuple(shots.root.tolist()), shots.reach, size)
    reasons = []
    for backend in _backends():
        with ExitStack() as stack:
            pool = stack.enter_context(worker_pool(1, _draw_with, (backend,)))
            first = _ask(pool, stage, shots, 0)
            try:
                first.result()
            except BROKEN as error:
                reasons.append(f"{backend}: {_brief(error)}")
                continue
            with stack.pop_all():
                yield _collect(pool, stage, shots, first)
                return
    raise _nothing_draws(reasons)


def _backends() -> tuple[str, ...]:
    name = os.environ.get("MUJOCO_GL", "").lower()
    return (name,) if name else BACKENDS


def _nothing_draws(reasons: Sequence[str]) -> InputError:
    return InputError(
        "renderer",
        expected="OpenGL that draws without a screen",
        got=f"none that works ({'; '.join(reasons)})",
        remedy="install EGL or OSMesa (Debian: apt install libegl1 libgl1-mesa-dri, or libosmesa6)",
    )


def _model(body: Body) -> str:
    """The body's model, if there is all that drawing it needs."""
    if body.model is None:
        raise InputError(
            "renderer",
            expected="a body with a model",
            got="a body that is a chain of points only",
            remedy="draw it as a stick figure",
        )
    _check_opengl()
    return str(body.model)


def _check_opengl() -> None:
    if importlib.util.find_spec("OpenGL") is None:
        raise InputError(
            "renderer",
            expected="the package pyopengl, which draws solid bodies",
            got="an installation without it",
            remedy='install it: pip install "retwin[render]"',
        )


def _ask(pool: ProcessPool, stage: Stage, shots: Shots, first: int) -> Future[NDArray]:
    """Have the pictures from `first` drawn, with the traces that lead to them."""
    end = min(first + CHUNK, len(shots))
    joints = np.stack([shots.nominal[first:end], shots.observed[first:end]])
    tips = np.stack([shots.nominal_points[:end, -1], shots.observed_points[:end, -1]])
    asked: Future[NDArray] = pool.schedule(_draw, (stage, joints, tips), timeout=PATIENCE)
    return asked


def _collect(pool: ProcessPool, stage: Stage, shots: Shots, asked: Future[NDArray]) -> Pictures:
    """All pictures; one task is ahead while those of the one before are used."""
    for first in range(CHUNK, len(shots) + CHUNK, CHUNK):
        ahead = _ask(pool, stage, shots, first) if first < len(shots) else asked
        yield from asked.result()
        asked = ahead


def _brief(error: Exception) -> str:
    if isinstance(error, TimeoutError):
        return "it hangs"
    first, *_ = str(error).splitlines() or [type(error).__name__]
    return first.rstrip(".")


def _draw_with(backend: str) -> None:
    """Called in the worker before MuJoCo is there: it looks at these when it is imported."""
    # What cannot draw ends in an error that says why; a library's own lines would only repeat it.
    warnings.simplefilter("ignore")
    os.environ["MUJOCO_GL"] = backend
    os.environ.pop("PYOPENGL_PLATFORM", None)


def _draw(stage: Stage, joints: NDArray, tips: NDArray) -> NDArray:
    """Pictures (frames, height, width, 3) for joints (2, frames, joints), nominal and observed.

    `tips` (2, all frames so far, 3) in m. In the worker; what fails there is a RuntimeError,
    because the errors of OpenGL cannot cross to another process.
    """
    try:
        scene = _scene(stage)
        before = tips.shape[1] - joints.shape[1]
        return np.stack(
            [scene.picture(joints[:, i], tips[:, : before + i + 1]) for i in range(joints.shape[1])]
        )
    except InputError:
        raise
    except Exception as error:
        raise RuntimeError(f"{type(error).__name__}: {error}") from None


def _open() -> None:
    """In the worker: what MuJoCo draws on."""
    try:
        import mujoco

        mujoco.GLContext(64, 64).make_current()
    except Exception as error:
        raise RuntimeError(f"{type(error).__name__}: {error}") from None


# Kept between the tasks of one worker.
@lru_cache(maxsize=1)
def _scene(stage: Stage) -> Scene:
    return Scene(stage)


class Scene:
    """The model twice, observed and nominal, and what draws them."""

    def __init__(self, stage: Stage) -> None:
        import mujoco

        self._mujoco = mujoco
        self._stage = stage
        try:
            self._model = _compiled(stage)
            self._places = [
                [self._model.joint(f"{who}{name}").qposadr[0] for name in stage.joints]
                for who in (GHOST_PREFIX, "")
            ]
        except (ValueError, KeyError) as error:
            raise InputError(
                "model",
                expected=f"an MJCF file with the joints {', '.join(stage.joints)}",
                got=f"{stage.model} ({_brief(error)})",
                remedy="make the body's model and its joints agree",
            ) from None
        self._data = mujoco.MjData(self._model)
        width, height = stage.size
        self._renderer = mujoco.Renderer(self._model, height, width)
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.lookat = np.add(stage.root, (0, 0, 0.38 * stage.reach))
        self._camera.distance = 2.75 * stage.reach * max(1.0, 4 / 3 * height / width)
        self._camera.azimuth, self._camera.elevation = 130, -18
        mujoco.mj_forward(self._model, self._data)
        self._empty = self._seen()

    def picture(self, joints: NDArray, tips: NDArray) -> NDArray:
        """The picture (height, width, 3) for joints (2, joints) and traces (2, points, 3)."""
        for places, values in zip(self._places, joints, strict=True):
            self._data.qpos[places] = values
        self._mujoco.mj_kinematics(self._model, self._data)
        solid = self._seen(OBSERVED, tuple(tips))
        # Behind the solid one: where both poses agree, two surfaces in one place would flicker.
        ghost = self._seen(NOMINAL)
        only = (ghost != self._empty).any(axis=2) & (solid == self._empty).all(axis=2)
        solid[only] = (1 - GHOSTLY) * self._empty[only] + GHOSTLY * ghost[only]
        return solid

    def _seen(self, group: int | None = None, tips: Sequence[NDArray] = ()) -> NDArray:
        """The picture of the floor, the bodies of one group, and traces."""
        for each in (NOMINAL, OBSERVED):
            self._option.geomgroup[each] = each == group
        self._renderer.update_scene(self._data, self._camera, self._option)
        self._renderer.scene.flags[self._mujoco.mjtRndFlag.mjRND_SHADOW] = False
        for ring in rings(np.array(self._stage.root), self._stage.reach):
            self._line(ring, RING, 1.5)
        for trace, colour in zip(tips, (GHOST, SOLID), strict=False):
            self._line(trace, colour, 3.0)
            self._ball(trace[-1], colour)
        picture: NDArray = self._renderer.render()
        return picture

    def _line(self, points: NDArray, colour: Sequence[float], width: float) -> None:
        """A line through the points; `width` in pixels of a picture 480 high."""
        scene, kind = self._renderer.scene, self._mujoco.mjtGeom.mjGEOM_LINE
        # A long film would fill the scene: then every second point, or third, …
        kept = points[:: 1 + len(points) // (scene.maxgeom // 4)]
        for begin, end in pairwise(kept):
            geom = self._added(kind, colour)
            self._mujoco.mjv_connector(geom, kind, width * min(self._stage.size) / 480, begin, end)

    def _ball(self, point: NDArray, colour: Sequence[float]) -> None:
        size = np.full(3, 0.018 * self._stage.reach)
        self._added(self._mujoco.mjtGeom.mjGEOM_SPHERE, colour, size, point)

    def _added(
        self, kind: Any, colour: Sequence[float], size: NDArray = ZERO, place: NDArray = ZERO
    ) -> Any:
        scene = self._renderer.scene
        geom = scene.geoms[scene.ngeom]
        paint = np.array([*colour, 1], np.float32)
        self._mujoco.mjv_initGeom(geom, kind, size, place, np.eye(3).ravel(), paint)
        scene.ngeom += 1
        return geom


def _compiled(stage: Stage) -> Any:
    """The model with a second one in it, all of whose names begin with `GHOST_PREFIX`."""
    import mujoco

    world = mujoco.MjSpec.from_file(stage.model)
    ghost = mujoco.MjSpec.from_file(stage.model)
    for spec, group in ((world, OBSERVED), (ghost, NOMINAL)):
        for geom in spec.geoms:
            # Groups above 2 are by custom not for showing: shapes for contact, and the like.
            geom.group = group if geom.group <= 2 else 5
            if geom.parent == spec.worldbody:
                geom.group = 0 if spec is world else 5
            if spec is ghost:
                geom.material = ""
                geom.rgba = [*GHOST, geom.rgba[3]]
    world.attach(ghost, prefix=GHOST_PREFIX, frame=world.worldbody.add_frame())
    look = world.visual
    look.global_.offwidth, look.global_.offheight = stage.size
    look.headlight.ambient, look.headlight.diffuse = [0.5] * 3, [0.4] * 3
    look.headlight.specular = [0.1] * 3
    world.worldbody.add_light(pos=[0.4, -0.6, 1.5], dir=[-0.25, 0.35, -1], diffuse=[0.35] * 3)
    for texture in world.textures:
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            world.delete(texture)
    world.add_texture(
        name="retwin_paper",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=PAPER,
        rgb2=PAPER,
        width=8,
        height=48,
    )
    return world.compile()
