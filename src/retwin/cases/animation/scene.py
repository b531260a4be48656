"""`Scene`: the body's MJCF model drawn twice in one scene by MuJoCo, in this process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retwin.cases.animation.shots import GHOST, PAPER, RING, SOLID, UPDATED, rings
from retwin.errors import InputError

GHOST_OPACITY = 0.6
"""Opacity of the ghost, from 0 to 1."""
NOMINAL, OBSERVED = 1, 2
"""MuJoCo's groups of geometry, which can be shown separately."""
GHOST_PREFIX = "nominal/"
ZERO = np.zeros(3)


@dataclass(frozen=True)
class Stage:
    """Settings of a scene.

    Attributes
    ----------
    model : str
        Path of the MJCF file.
    joints : tuple of str
        Joints that move.
    root : tuple of float
        Base of the chain in m.
    reach : float
        Largest distance from root to tip in m.
    size : (int, int)
        Width and height of the pictures in pixels.

    """

    model: str
    joints: tuple[str, ...]
    root: tuple[float, ...]
    reach: float
    size: tuple[int, int]


class Scene:
    """The model twice, observed and nominal, and its renderer.

    Parameters
    ----------
    stage : Stage
        Settings of the scene.

    Raises
    ------
    InputError
        The model lacks a joint.

    """

    def __init__(self, stage: Stage) -> None:
        import mujoco

        self._mujoco = mujoco
        self._stage = stage
        try:
            self._model = _compiled(stage)
            self._addresses = [
                [self._model.joint(f"{prefix}{name}").qposadr[0] for name in stage.joints]
                for prefix in (GHOST_PREFIX, "")
            ]
        except (ValueError, KeyError) as error:
            raise InputError(
                "model",
                expected=f"an MJCF file with the joints {', '.join(stage.joints)}",
                got=f"{stage.model} ({first_line(error)})",
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
        self._background = self._rendered()

    def picture(self, joints: NDArray, tips: NDArray, trails: NDArray) -> NDArray:
        """Draw one frame.

        Parameters
        ----------
        joints : ndarray, shape (2, joints)
            Nominal and observed joint positions in rad or m.
        tips : ndarray, shape (2, points, 3)
            Traces of the nominal and the observed tip in m.
        trails : ndarray, shape (draws, points, 3)
            Traces of the tip that an updated twin draws, in m; each ends in a ball.

        Returns
        -------
        ndarray of uint8, shape (height, width, 3)
            The picture.

        """
        for addresses, values in zip(self._addresses, joints, strict=True):
            self._data.qpos[addresses] = values
        self._mujoco.mj_kinematics(self._model, self._data)
        solid = self._rendered(OBSERVED, tuple(tips), trails)
        # The ghost is behind the solid body: two surfaces in one place would flicker.
        ghost = self._rendered(NOMINAL)
        ghost_only = (ghost != self._background).any(axis=2) & (solid == self._background).all(
            axis=2
        )
        background = self._background[ghost_only]
        solid[ghost_only] = (1 - GHOST_OPACITY) * background + GHOST_OPACITY * ghost[ghost_only]
        return solid

    def _rendered(
        self,
        group: int | None = None,
        tips: Sequence[NDArray] = (),
        trails: Sequence[NDArray] | NDArray = (),
    ) -> NDArray:
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
        for trail in trails:
            self._line(trail, UPDATED, 1.0)
            self._ball(trail[-1], UPDATED, 0.010)
        return self._renderer.render()

    def _line(self, points: NDArray, colour: Sequence[float], width: float) -> None:
        """Draw a line through the points; `width` in pixels of a picture 480 high."""
        scene, kind = self._renderer.scene, self._mujoco.mjtGeom.mjGEOM_LINE
        # A scene holds few objects: of long traces only every second or third point is drawn.
        kept = points[:: 1 + len(points) // (scene.maxgeom // 4)]
        for begin, end in pairwise(kept):
            geom = self._added(kind, colour)
            self._mujoco.mjv_connector(geom, kind, width * min(self._stage.size) / 480, begin, end)

    def _ball(self, point: NDArray, colour: Sequence[float], radius: float = 0.018) -> None:
        """Draw a ball at a point (3,) in m; its radius is a share of the reach."""
        size = np.full(3, radius * self._stage.reach)
        self._added(self._mujoco.mjtGeom.mjGEOM_SPHERE, colour, size, point)

    def _added(
        self, kind: Any, colour: Sequence[float], size: NDArray = ZERO, place: NDArray = ZERO
    ) -> Any:
        """A new object in the scene."""
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
            # By convention groups above 2 are not shown: shapes for contact, for instance.
            geom.group = group if geom.group <= 2 else 5
            if geom.parent == spec.worldbody:
                geom.group = 0 if spec is world else 5
            if spec is ghost:
                geom.material = ""
                geom.rgba = [*GHOST, geom.rgba[3]]
    world.attach(ghost, prefix=GHOST_PREFIX, frame=world.worldbody.add_frame())
    visual = world.visual
    visual.global_.offwidth, visual.global_.offheight = stage.size
    visual.headlight.ambient, visual.headlight.diffuse = [0.5] * 3, [0.4] * 3
    visual.headlight.specular = [0.1] * 3
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


def first_line(error: Exception) -> str:
    """The first line of an error's message."""
    first, *_ = str(error).splitlines() or [type(error).__name__]
    return first.rstrip(".")
