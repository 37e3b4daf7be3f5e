"""A reference in the browser: scrub, play, contact points, a ghost to compare with, and plots under the timeline."""

from __future__ import annotations

import time
from typing import Any

import mujoco
import numpy as np
import trimesh

from hdmi.envs.rendering import RenderingError
from hdmi.motion.playback import Playback
from hdmi.workshop.view.curves import curves

_GHOST = (51, 115, 242)
_INTENDED, _NOT_INTENDED = (255, 209, 26), (140, 140, 148)
_NOW = "rgb(214, 39, 40)"
_COLORS = ("rgb(31, 119, 180)", "rgb(44, 160, 44)", "rgb(255, 127, 14)", "rgb(148, 103, 189)")
_POINT_RADIUS = 0.02  # m
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2")


class ReferenceViewer:
    """A viser server that shows a reference.

    Args:
        playback: the motion to show.
        ghost: another to compare with, shown translucent.
        host, port: that the server listens on.

    Raises:
        RenderingError: without viser.

    Examples:
        >>> from hdmi.motion import find_motion, load_motion, make_playback
        >>> viewer = ReferenceViewer(make_playback(load_motion(find_motion("walk"))), port=8090)
        ╭──... viser ...──╯
        >>> viewer.show(100)
        >>> viewer.address
        'http://127.0.0.1:...'
        >>> viewer.stop()
        (viser) Server stopped
    """

    def __init__(self, playback: Playback, ghost: Playback | None = None, host: str = "127.0.0.1", port: int = 8080):
        try:
            import viser
        except ImportError as error:
            raise RenderingError("the viewer needs viser: pip install 'hdmi[viewer]'") from error
        self.playback, self.ghost = playback, ghost
        self._poses = _poses(playback)
        self._ghost_poses = None if ghost is None else _poses(ghost)
        self._points = playback.contact_pos_w if playback.scene.effectors else None  # [T, E, 3]
        self._curves = curves(playback, ghost)
        self._time = np.arange(playback.num_frames) / playback.fps
        self.frame = 0
        self.server = viser.ViserServer(host=host, port=port, label=playback.reference.name, verbose=False)
        self._add_scene()
        self._add_controls()
        self.show(0)

    @property
    def address(self) -> str:
        """Where to point the browser."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def _add_scene(self) -> None:
        scene, model = self.server.scene, self.playback.scene.model
        scene.set_up_direction("+z")
        scene.add_grid("/floor", infinite_grid=True, cell_size=0.25, plane_color=(235, 237, 240), plane_opacity=1.0)
        self.bodies = _add_bodies(self.server, "/reference", model, None)
        self.ghost_bodies = {}
        if self.ghost is not None:
            self.ghost_bodies = _add_bodies(self.server, "/ghost", self.ghost.scene.model, _GHOST)
        self.points = [
            scene.add_icosphere(f"/contact/{e}", radius=_POINT_RADIUS, color=_NOT_INTENDED)
            for e in range(len(self.playback.scene.effectors))
        ]
        pelvis = self._poses[0][0, model.body("pelvis").id]
        self.server.initial_camera.look_at = (pelvis[0], pelvis[1], 0.75)
        self.server.initial_camera.position = (pelvis[0] + 2.2, pelvis[1] - 2.2, 1.6)

    def _add_controls(self) -> None:
        gui: Any = self.server.gui
        last = self.playback.num_frames - 1
        self.playing = gui.add_checkbox("play", initial_value=False)
        self.speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1")
        self.slider = gui.add_slider("frame", min=0, max=last, step=1, initial_value=0)
        self.status = gui.add_markdown("")
        self.slider.on_update(lambda _: self.show(int(self.slider.value)))
        self._plots = []
        for i, (name, values) in enumerate(self._curves.items()):
            color = _COLORS[i % len(_COLORS)]
            plot = gui.add_uplot(
                self._plotted(values),
                ({"label": "s"}, {"label": name, "stroke": color, "width": 1.5}, {"label": "now", "stroke": _NOW}),
                title=name,
                # given, since uPlot finds none where values are missing
                scales={"x": {"time": False}, "y": {"auto": False, "range": _span(values)}},
                legend={"show": False},
                aspect=2.6,
            )
            self._plots.append((plot, values))
        if self.ghost is not None:
            ghost = gui.add_checkbox("ghost", initial_value=True)

            @ghost.on_update
            def _(_: Any) -> None:
                for handle in self.ghost_bodies.values():
                    handle.visible = ghost.value

        points = gui.add_checkbox("contact points", initial_value=True)

        @points.on_update
        def _(_: Any) -> None:
            for handle in self.points:
                handle.visible = points.value

    def _plotted(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Time, the curve, and a line from its bottom to its top at the present frame."""
        now = np.full(len(values), np.nan)
        # a series has one value at a time: the line goes from this frame's to the next one's
        at = min(self.frame, len(values) - 2)
        now[at : at + 2] = _span(values)
        return self._time, values, now

    def show(self, frame: int) -> None:
        """Shows a frame of the reference."""
        self.frame = frame
        contact = self.playback.reference.contact[frame]
        with self.server.atomic():
            _place(self.bodies, self._poses, frame)
            if self._ghost_poses is not None:
                _place(self.ghost_bodies, self._ghost_poses, frame)
            for e, handle in enumerate(self.points):
                assert self._points is not None
                handle.position = self._points[frame, e]
                handle.color = _INTENDED if contact[e] else _NOT_INTENDED
        now = [f"{name} {values[frame]:.1f}" for name, values in self._curves.items() if np.isfinite(values[frame])]
        self.status.content = f"**{self._time[frame]:.2f} s**: " + ", ".join(now)

    def update_plots(self) -> None:
        """Moves the mark of the present frame in the plots."""
        for plot, values in self._plots:
            plot.data = self._plotted(values)

    def run(self) -> None:
        """Plays where asked to, until interrupted."""
        plotted, begin = -1, time.perf_counter()
        exact = 0.0
        while True:
            time.sleep(1 / self.playback.fps)
            elapsed, begin = time.perf_counter() - begin, time.perf_counter()
            if self.playing.value:
                if round(exact) != self.frame:  # scrubbed
                    exact = float(self.frame)
                exact = (exact + elapsed * float(self.speed.value) * self.playback.fps) % len(self._time)
                self.slider.value = min(round(exact), len(self._time) - 1)  # which shows it
            if abs(plotted - self.frame) >= (5 if self.playing.value else 1):
                plotted = self.frame
                self.update_plots()

    def stop(self) -> None:
        """Closes the server."""
        self.server.stop()


def _span(values: np.ndarray) -> tuple[float, float]:
    """What a plot shows of a curve: all of it, and a margin."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def _add_bodies(server: Any, root: str, model: mujoco.MjModel, color: tuple[int, int, int] | None) -> dict[int, Any]:
    """A frame for each body with something to see; returns them by the body's number."""
    frames: dict[int, Any] = {}
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if model.geom_group[geom] > 2 or model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        if body not in frames:
            frames[body] = server.scene.add_frame(f"{root}/{model.body(body).name}", show_axes=False)
        mesh = _mesh(model, geom)
        server.scene.add_mesh_simple(
            f"{root}/{model.body(body).name}/{geom}",
            vertices=np.asarray(mesh.vertices, np.float32),
            faces=np.asarray(mesh.faces, np.uint32),
            color=color or tuple(int(255 * c) for c in model.geom_rgba[geom, :3]),
            opacity=None if color is None else 0.25,
            flat_shading=bool(model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX),
            position=model.geom_pos[geom],
            wxyz=model.geom_quat[geom],
        )
    return frames


def _mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=[16, 16])
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=24)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        m = model.geom_dataid[geom]
        v, f = model.mesh_vertadr[m], model.mesh_faceadr[m]
        vertices, faces = model.mesh_vert[v : v + model.mesh_vertnum[m]], model.mesh_face[f : f + model.mesh_facenum[m]]
        return trimesh.Trimesh(vertices, faces, process=False)
    raise RenderingError(f"geom {geom} of {model.body(model.geom_bodyid[geom]).name!r}: a shape that cannot be shown")


def _poses(playback: Playback) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T, B, 3] and orientations [T, B, 4] of all bodies of the scene."""
    found = [(data.xpos.copy(), data.xquat.copy()) for data in playback.frames()]
    pos, quat = (np.stack(values) for values in zip(*found, strict=True))
    return pos, quat


def _place(frames: dict[int, Any], poses: tuple[np.ndarray, np.ndarray], frame: int) -> None:
    pos, quat = poses
    frame = min(frame, len(pos) - 1)
    for body, handle in frames.items():
        handle.position, handle.wxyz = pos[frame, body], quat[frame, body]
