"""Pictures of worlds without a display."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context

from hdmi.assets import Robot

_HELP = (
    "no OpenGL for rendering ({error}). Headless Linux: install EGL (Debian: apt-get install libegl1 libgl1-mesa-dri) "
    "and leave MUJOCO_GL unset or set it to egl; with a display: MUJOCO_GL=glfw"
)

_LARGEST = 8192  # pixels, either way: not every OpenGL implementation gives more


class RenderingError(RuntimeError):
    """Nothing can be drawn here; the message says what to install or set.

    Examples:
        >>> try:
        ...     raise RenderingError("window=true needs a display")  # as `render_checkpoint` does without OpenGL
        ... except RuntimeError as error:
        ...     print(error)
        window=true needs a display
    """


def _choose_gl() -> None:
    """Falls back to EGL where there is no display and the user has not chosen."""
    headless = sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if headless and "MUJOCO_GL" not in os.environ:
        # an accelerator that we do not use is missing, says PyOpenGL
        logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)
        from mujoco.egl import GLContext

        gl_context.GLContext = GLContext  # where Renderer looks it up


def _make_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    if not (1 <= height <= _LARGEST and 1 <= width <= _LARGEST):
        raise RenderingError(f"pictures of {width} x {height} pixels: expected 1 to {_LARGEST} each way")
    buffer = model.vis.global_
    buffer.offwidth, buffer.offheight = max(width, buffer.offwidth), max(height, buffer.offheight)
    try:
        _choose_gl()
        return mujoco.Renderer(model, height, width)
    except Exception as error:
        raise RenderingError(_HELP.format(error=error)) from error


def look_at(data: mujoco.MjData, robot: Robot) -> np.ndarray:
    """Where a camera looks that follows a robot: steadily at standing height, higher where the robot climbs. [3]"""
    x, y, z = data.body(robot.root).xpos
    return np.array([x, y, max(robot.root_height - 0.01, z - 0.1)])


class WorldRenderer:
    """Renders worlds of one model with a camera that follows the robot's root.

    Raises:
        RenderingError: if no rendering back end works; says what to install. For pictures of no size, or too large.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: Robot,
        height: int = 480,
        width: int = 640,
        distance: float = 2.8,
        azimuth: float = 130.0,
    ):
        self._robot = robot
        self._renderer = _make_renderer(model, height, width)
        self._size = (height, width)
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.azimuth, self._camera.elevation = distance, azimuth, -14.0
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [1, 1, 1, 0, 0, 0]
        self._option.sitegroup[:] = 0

    def __call__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        height: int,
        width: int,
        draw: Callable[[mujoco.MjvScene], None] | None = None,
    ) -> np.ndarray:
        """One picture; `draw` may add geoms to the scene. uint8 [height, width, 3]"""
        if (height, width) != self._size:
            self._renderer.close()
            self._renderer = _make_renderer(model, height, width)
            self._size = (height, width)
        self._update(model, data)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        if draw is not None:
            draw(self._renderer.scene)
        return self._renderer.render().copy()

    def turn(self, azimuth: float) -> None:
        """Looks along another direction from now on, degrees from the world's x axis."""
        self._camera.azimuth = azimuth

    def visible(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """Pixels that each geom has in the picture. int64 [ngeom]"""
        self._update(model, data)
        self._renderer.enable_segmentation_rendering()
        try:
            ids, kinds = np.moveaxis(self._renderer.render(), -1, 0)
        finally:
            self._renderer.disable_segmentation_rendering()
        return np.bincount(ids[kinds == mujoco.mjtObj.mjOBJ_GEOM], minlength=model.ngeom)

    def _update(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._camera.lookat[:] = look_at(data, self._robot)
        # of the model that is given, not the one that the renderer was made with: worlds differ in size
        catmask = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, catmask, self._renderer.scene)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._renderer.close()
