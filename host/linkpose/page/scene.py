"""The scene of the page: a link on its joint with the uncertainty of its attitude, or a robot with its path."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

import numpy as np

from linkpose.page import geometry
from linkpose.presentation import Row
from linkpose.quantities import HEADING, PITCH, ROLL, YAW, Quantity, X, Y
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    import viser

Colour = tuple[int, int, int]

_BLUE, _GREY, _BLACK, _ORANGE = (0, 114, 178), (120, 130, 140), (30, 30, 30), (230, 159, 0)
_ELLIPSES = 12  # along a path
_PATH_INTERVAL = 10  # redraws of the scene between two of the path, which is larger
_FLOOR_M = 0.002  # of lines over the ground, so that the ground does not hide parts of them


class Scene(Protocol):
    """What the page draws in 3-D."""

    def draw(self, row: Row, name: str, reference: dict[Quantity, float], path: Floats | None) -> None:
        """Draws the newest row as the filter `name` sees it; `path` (N, 5) is x, y, heading and σ of x and of y (m)."""

    @property
    def is_path_due(self) -> bool:
        """Whether the next `draw` draws a path, if it gets one."""


class LinkScene:
    """A link: ground, joint, bar, sensor, the cone of ±2σ, and the reference as a thin black line.

    Without a known J2S only the attitude of the sensor is drawn, at the joint.
    """

    is_path_due = False

    def __init__(self, server: viser.ViserServer, j2s_m: Floats | None) -> None:
        """`j2s_m` (3,) is J2S, from the joint centre to the sensor, in the sensor's axes (m)."""
        scene = server.scene
        length = 1.0 if j2s_m is None else float(np.linalg.norm(j2s_m))
        _ground(scene, 2.4 * length)
        scene.add_icosphere("/joint", 0.035 * length, _BLACK)
        self._link = scene.add_frame("/link", show_axes=False)
        self._reference = scene.add_frame("/reference", show_axes=False, visible=False)
        self._parts = [
            scene.add_cylinder("/link/bar", 0.016 * length, 1.0, _BLUE),
            scene.add_cylinder("/reference/bar", 0.006 * length, 1.0, _BLACK),
        ]
        size = 0.07 * length
        self._sensor = scene.add_box("/link/sensor", _ORANGE, (size, 0.75 * size, 0.3 * size))
        self._axes = scene.add_frame("/link/axes", axes_length=2.5 * size, axes_radius=0.07 * size)
        vertices, faces = geometry.cone()
        self._cone = scene.add_mesh_simple(
            "/link/cone", vertices, faces, color=_BLUE, opacity=0.25, side="double", cast_shadow=False, visible=False
        )
        self._length_m = 0.0
        self._drawn_j2s: Floats | None = None
        self.set_j2s(j2s_m)
        server.initial_camera.position = (1.15 * length, -1.75 * length, 1.0 * length)
        server.initial_camera.look_at = (0.0, 0.0, 0.48 * length)

    def set_j2s(self, j2s_m: Floats | None) -> None:
        """Draws the link with another J2S (3,), such as the one estimated so far."""
        is_known = j2s_m is not None and float(np.linalg.norm(j2s_m)) > 1e-3
        for part in self._parts:
            part.visible = is_known
        if j2s_m is None or not is_known:
            return
        if self._drawn_j2s is not None and np.linalg.norm(j2s_m - self._drawn_j2s) < 1e-3:
            return
        self._drawn_j2s = j2s_m
        self._length_m = float(np.linalg.norm(j2s_m))
        turn = geometry.turn_z_to(j2s_m)
        for part in self._parts:
            part.position, part.wxyz, part.scale = 0.5 * j2s_m, turn, (1.0, 1.0, self._length_m)
        self._cone.wxyz = turn
        self._sensor.position = self._axes.position = j2s_m

    def draw(self, row: Row, name: str, reference: dict[Quantity, float], path: Floats | None) -> None:
        values = row.get(name, {})
        nothing = (math.nan, math.nan)
        (roll, roll_std), (pitch, pitch_std), (yaw, _) = (values.get(q, nothing) for q in (ROLL, PITCH, YAW))
        self._link.visible = is_known = math.isfinite(roll + pitch)
        if is_known:
            self._link.wxyz = geometry.attitude(roll, pitch, yaw)
        radius = geometry.cone_radius(self._length_m, max(roll_std, pitch_std)) if is_known else 0.0
        self._cone.visible = radius > 0.0
        if radius > 0.0:
            self._cone.scale = (radius, radius, self._length_m)
        roll, pitch = (reference.get(q, math.nan) for q in (ROLL, PITCH))
        self._reference.visible = is_known = math.isfinite(roll + pitch)
        if is_known:
            # A yaw that starts at 0 with the estimate is comparable with the reference's only up to a constant.
            self._reference.wxyz = geometry.attitude(roll, pitch, yaw)


class RobotScene:
    """A robot in the plane: ground, pose, path, and ±2σ ellipses along it."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._scene = server.scene
        _ground(self._scene, 20.0)
        self._robot = self._scene.add_frame("/robot", axes_length=0.25, axes_radius=0.008, visible=False)
        self._scene.add_box("/robot/body", _ORANGE, (0.24, 0.18, 0.06), position=(0.0, 0.0, 0.03))
        self._scene.add_box("/robot/front", _BLACK, (0.03, 0.18, 0.062), position=(0.105, 0.0, 0.031))
        self._draws = 0
        server.initial_camera.position = (1.0, -3.5, 4.0)
        server.initial_camera.look_at = (1.0, 0.0, 0.0)

    @property
    def is_path_due(self) -> bool:
        return self._draws % _PATH_INTERVAL == 0

    def draw(self, row: Row, name: str, reference: dict[Quantity, float], path: Floats | None) -> None:
        self._draws += 1
        values = row.get(name, {})
        x, y, heading = (values.get(q, (math.nan, math.nan))[0] for q in (X, Y, HEADING))
        self._robot.visible = is_known = math.isfinite(x + y + heading)
        if is_known:
            self._robot.position = np.array([x, y, 0.0])
            self._robot.wxyz = geometry.attitude(0.0, 0.0, math.degrees(heading))
        if path is not None:
            self._draw_path(path)

    def _draw_path(self, path: Floats) -> None:
        known = path[np.isfinite(path[:, :2]).all(axis=1)]
        if len(known) < 2:
            return
        points = np.column_stack([known[:, :2], np.full(len(known), _FLOOR_M)])
        self._lines("/path", geometry.polyline(points), _BLUE, 3.0)
        at = np.linspace(0, len(known) - 1, _ELLIPSES).astype(int)
        places = [p for p in known[at] if np.isfinite(p[3:]).all()]
        if places:
            rings = [geometry.ellipse(p[0], p[1], p[3], p[4], 2 * _FLOOR_M) for p in places]
            self._lines("/ellipses", np.concatenate(rings), _GREY, 1.5)

    def _lines(self, name: str, segments: Floats, colour: Colour, width: float) -> None:
        if len(segments):
            points = segments.astype(np.float32)
            self._scene.add_line_segments(name, points, colour, thickness=width, thickness_units="screen")


def _ground(scene: viser.SceneApi, size_m: float) -> None:
    cell = 10.0 ** math.floor(math.log10(size_m / 8))
    scene.add_grid(
        "/ground", size_m, size_m, cell_size=cell, section_size=5 * cell, cell_color=(232, 235, 238),
        section_color=(205, 210, 215), plane_color=(246, 247, 249), plane_opacity=1.0,
    )  # fmt: skip
