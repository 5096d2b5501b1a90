"""Pictures of the scene without a screen: arm, box and ball as simulated, the thrower as measured points."""

from __future__ import annotations

import os
import sys
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.ball_catching.geometry import BOX_DEPTH, BOX_WIDTH, Array
from experiments.ball_catching.scene.model import load_mujoco

Picture = NDArray[np.uint8]
_SKIN, _CLOTH, _EXPECTED = (0.85, 0.65, 0.50, 1.0), (0.25, 0.40, 0.65, 1.0), (0.10, 0.65, 0.25, 0.30)


class NoGraphicsError(RuntimeError):
    """There is no OpenGL to render with; the message says what to install."""


class Person(NamedTuple):
    """The thrower's points [3] each, m: what motion capture and the head's unit measure, and the pelvis."""

    right_hand: Array
    left_hand: Array
    head: Array
    left_foot: Array
    right_foot: Array
    pelvis: Array


class Camera:
    """Renders a model; use it as a context manager.

    Args:
        model: from `model.build`.
        width, height: of the pictures, pixels.

    Raises:
        NoGraphicsError: this machine cannot render.
    """

    def __init__(self, model: Any, width: int = 480, height: int = 320) -> None:
        mujoco = self._mujoco = load_mujoco()
        self.model, self._data = model, mujoco.MjData(model)
        self._gl: Any = None
        try:
            self._gl = _context(mujoco)(width, height)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # a missing library, display or driver: each raises its own
            self._close()
            raise NoGraphicsError(
                f"no OpenGL to render with ({type(error).__name__}: {error}); "
                "on Debian: apt install libegl1 libgl1-mesa-dri"
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._option = mujoco.MjvOption()
        self._frame = mujoco.MjrRect(0, 0, width, height)
        self._view = self._mujoco.MjvCamera()
        self._view.lookat[:] = (1.95, 0.0, 0.95)
        self._view.distance, self._view.azimuth, self._view.elevation = 4.3, 105.0, -12.0

    def __enter__(self) -> Camera:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def _close(self) -> None:
        if self._gl is not None:
            self._gl.free()
            self._gl = None

    def picture(self, positions: Array, person: Person, expected: tuple[Array, Array] | None = None) -> Picture:
        """One picture, uint8 [height, width, 3].

        Args:
            positions: of all joints, `data.qpos`.
            person: the thrower.
            expected: centre [3] and axes [3, 3] of the box where the catch is expected: drawn transparent.
        """
        self._data.qpos[:] = positions
        mujoco = self._mujoco
        mujoco.mj_forward(self.model, self._data)
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, self._data, self._option, None, self._view, every, self._scene)
        self._draw_person(person)
        if expected is not None:
            half = np.array([BOX_WIDTH / 2, BOX_WIDTH / 2, BOX_DEPTH / 2])
            self._add(mujoco.mjtGeom.mjGEOM_BOX, half, expected[0], expected[1], _EXPECTED)
        picture: Picture = np.empty((self._frame.height, self._frame.width, 3), dtype=np.uint8)
        self._gl.make_current()
        mujoco.mjr_render(self._frame, self._scene, self._context)
        mujoco.mjr_readPixels(picture, None, self._frame, self._context)
        return np.flipud(picture)  # OpenGL counts rows from below

    def _draw_person(self, person: Person) -> None:
        neck = person.head + 0.25 * (person.pelvis - person.head)
        for start, end, radius in (
            (person.pelvis, neck, 0.11),
            (neck, person.right_hand, 0.035),
            (neck, person.left_hand, 0.035),
            (person.pelvis, person.right_foot, 0.05),
            (person.pelvis, person.left_foot, 0.05),
        ):
            self._connect(start, end, radius)
        for point, radius in ((person.head, 0.10), (person.right_hand, 0.04), (person.left_hand, 0.04)):
            self._add(self._mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, radius), point, np.eye(3), _SKIN)

    def _add(self, kind: Any, size: Array, position: Array, axes: Array, colour: tuple[float, ...]) -> Any:
        scene = self._scene
        geom = scene.geoms[scene.ngeom]
        self._mujoco.mjv_initGeom(geom, kind, size, position, axes.flatten(), np.array(colour, dtype=np.float32))
        scene.ngeom += 1
        return geom

    def _connect(self, start: Array, end: Array, radius: float) -> None:
        kind = self._mujoco.mjtGeom.mjGEOM_CAPSULE
        geom = self._add(kind, np.zeros(3), np.zeros(3), np.eye(3), _CLOTH)
        self._mujoco.mjv_connector(geom, kind, radius, start, end)


def _context(mujoco: Any) -> Any:
    """The class of OpenGL contexts: EGL on Linux, which needs no screen, unless MUJOCO_GL says otherwise."""
    if sys.platform == "linux" and os.environ.get("MUJOCO_GL", "egl") == "egl":
        from mujoco.egl import GLContext

        return GLContext
    return mujoco.gl_context.GLContext
