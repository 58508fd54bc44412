"""The scenes of the page: a link on its joint, a robot with its path and surroundings, two links of a chain."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from linkpose.localization.surroundings import Surroundings, map_corners
from linkpose.page import geometry
from linkpose.page.changes import Changes
from linkpose.presentation import Row, best_filter
from linkpose.quantities import (
    ANGLE,
    BALL_ANGLES,
    CHAIN_ROTATION,
    HEADING,
    HEIGHT,
    HEIGHT1,
    HEIGHT2,
    PITCH,
    QW,
    ROLL,
    YAW,
    Quantity,
    X,
    Y,
)
from linkpose.rotations import product
from linkpose.sensors.measurements import Floats
from linkpose.sensors.rig import Rig

if TYPE_CHECKING:
    import viser

Colour = tuple[int, int, int]

_BLUE, _GREY, _BLACK, _ORANGE = (0, 114, 178), (120, 130, 140), (30, 30, 30), (230, 159, 0)
_UNKNOWN = (math.nan, math.nan)  # a value and its σ
_ELLIPSES = 12  # along a path
_UNKNOWN_R1_M, _UNKNOWN_R2_M = (0.0, 0.0, 0.25), (0.0, 0.0, -0.25)  # of a chain, as drawn
_BEYOND_SENSOR = 1.7  # length of a link, as drawn, over the distance of its sensor from the joint
_SHOWN = 0.55  # of a scene's size to each side of its centre: a robot there is in view yet
_WIDER = 1.5  # the view of a path that leaves it, over the path's size, so that it does not change all the time
_MOVED_M = 0.01  # a camera within this distance of where it was put has not been moved by the user
_ROBOT_SHARE = 10.0  # m: the size of a scene from which on the robot is drawn larger than it is
_SKY, _GROUND = (255, 255, 255), (200, 200, 205)
_SKY_INTENSITY = 3.5  # of light from everywhere, in viser's unit; colours look as they are stated
_FLOOR_M = 0.002  # of lines over the ground, at least, so that the ground does not hide parts of them


class Scene(Protocol):
    """What the page draws in 3-D."""

    charted: ClassVar[tuple[Quantity, ...]]  # that charts show, if a filter estimates them
    shown_by: ClassVar[tuple[Quantity, ...]]  # the first of these with a value selects the best filter
    combines_filters: ClassVar[bool]  # whether it draws values of several filters

    def draw(self, row: Row, name: str, reference: dict[Quantity, float]) -> None:
        """Draws the newest row as the filter `name` estimates it."""

    def draw_slow(self, row: Row, name: str, path: Floats | None) -> None:
        """Draws what changes slowly or is large, as the filter `name` estimates it: σ and the path.

        `path` (N, 8) is x, y, heading, σ of x and of y (m), the covariance of x and y (m²), x and y of the reference.
        """


class LinkScene:
    """A link: ground, joint, bar, sensor, the cone of ±2σ, and the reference as a thin black line.

    Without a known J2S only the attitude of the sensor is drawn, at the joint.
    """

    charted: ClassVar[tuple[Quantity, ...]] = (HEIGHT, ROLL, PITCH)
    shown_by: ClassVar[tuple[Quantity, ...]] = (HEIGHT, ROLL)
    combines_filters: ClassVar[bool] = False

    def __init__(self, server: viser.ViserServer, changes: Changes, j2s_m: Floats | None) -> None:
        """`j2s_m` (3,) is J2S, from the joint centre to the sensor, in the sensor's axes (m)."""
        scene, self._changes = server.scene, changes
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
        self._cone = Cone(scene, changes, "/link/cone")
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
        turn, length = geometry.turn_z_to(j2s_m), float(np.linalg.norm(j2s_m))
        for part in self._parts:
            part.position, part.wxyz, part.scale = 0.5 * j2s_m, turn, (1.0, 1.0, length)
        self._cone.point_along(j2s_m)
        self._sensor.position = self._axes.position = j2s_m

    def draw(self, row: Row, name: str, reference: dict[Quantity, float]) -> None:
        (roll, _), (pitch, _), (yaw, _) = (row[name].get(q, _UNKNOWN) for q in (ROLL, PITCH, YAW))
        is_known = math.isfinite(roll + pitch)
        self._changes.show(self._link, is_known)
        if is_known:
            self._changes.turn(self._link, geometry.attitude(roll, pitch, yaw))
        if not reference:
            return
        roll, pitch = (reference.get(q, math.nan) for q in (ROLL, PITCH))
        is_known = math.isfinite(roll + pitch)
        self._changes.show(self._reference, is_known)
        if is_known:
            # A yaw that starts at 0 with the estimate is comparable with the reference's only up to a constant.
            self._changes.turn(self._reference, geometry.attitude(roll, pitch, yaw))

    def draw_slow(self, row: Row, name: str, path: Floats | None) -> None:
        (_, roll_std), (_, pitch_std) = (row.get(name, {}).get(q, _UNKNOWN) for q in (ROLL, PITCH))
        self._cone.draw(max(roll_std, pitch_std))


class RobotScene:
    """A robot in the plane: ground, map, beacons, pose, path, ±2σ ellipses along it, and the reference's path."""

    charted: ClassVar[tuple[Quantity, ...]] = (X, Y, HEADING)
    shown_by: ClassVar[tuple[Quantity, ...]] = (HEADING,)
    combines_filters: ClassVar[bool] = False

    def __init__(self, server: viser.ViserServer, changes: Changes, surroundings: Surroundings, places: Floats) -> None:
        self._server, self._scene, self._changes = server, server.scene, changes
        self._corners_m = surroundings.corners_m()
        centre, size = _extent(np.vstack([self._corners_m, places]))
        self._floor_m = max(_FLOOR_M, 0.001 * size)
        self._look_at(centre, size)
        self._draw_surroundings(surroundings, size)
        scale = max(1.0, size / _ROBOT_SHARE)  # a robot of 24 cm would be a dot on a floor of 100 m
        self._robot = self._scene.add_frame(
            "/robot", axes_length=0.25 * scale, axes_radius=0.008 * scale, visible=False
        )  # fmt: skip
        for name, colour, dimensions, at in (
            ("body", _ORANGE, (0.24, 0.18, 0.06), (0.0, 0.0, 0.03)),
            ("front", _BLACK, (0.03, 0.18, 0.062), (0.105, 0.0, 0.031)),
        ):
            self._scene.add_box(
                f"/robot/{name}", colour, tuple(scale * np.array(dimensions)), position=scale * np.array(at)
            )

    def _look_at(self, centre_m: Floats, size_m: float) -> None:
        """Points new browsers' cameras at an area, and lays the ground under it."""
        half = _SHOWN * size_m
        (x, y), self._area_m = centre_m.tolist(), np.array([centre_m - half, centre_m + half])
        self._eye_m, self._target_m = (x, y - 0.5 * size_m, 0.75 * size_m), (x, y, 0.0)
        _ground(self._scene, 1.5 * size_m, (x, y, -2 * self._floor_m))
        camera = self._server.initial_camera
        camera.position, camera.look_at = self._eye_m, self._target_m

    def _keep_in_view(self, places_m: Floats) -> None:
        """Widens the view if the path (N, 2) has left the area. A camera that the user has moved stays where it is."""
        low, high = self._area_m
        if not len(places_m) or ((places_m[-1] >= low) & (places_m[-1] <= high)).all():
            return
        following = [
            client.camera
            for client in self._server.get_clients().values()
            if np.allclose(client.camera.position, self._eye_m, atol=_MOVED_M)
            and np.allclose(client.camera.look_at, self._target_m, atol=_MOVED_M)
        ]
        centre, size = _extent(np.vstack([self._corners_m, places_m]))
        self._look_at(centre, _WIDER * size)
        for camera in following:
            camera.position = self._eye_m
            camera.look_at = self._target_m

    def draw(self, row: Row, name: str, reference: dict[Quantity, float]) -> None:
        values = row.get(name, {})
        x, y, heading = (values.get(q, _UNKNOWN)[0] for q in (X, Y, HEADING))
        is_known = math.isfinite(x + y + heading)
        self._changes.show(self._robot, is_known)
        if is_known:
            self._changes.move(self._robot, (x, y, 0.0))
            self._changes.turn(self._robot, geometry.attitude(0.0, 0.0, math.degrees(heading)))

    def draw_slow(self, row: Row, name: str, path: Floats | None) -> None:
        if path is not None:
            self._draw_path(path)
            self._keep_in_view(path[np.isfinite(path[:, :2]).all(axis=1), :2])

    def _draw_surroundings(self, around: Surroundings, size: float) -> None:
        """Draws beacons, in proportion to the size (m) of the scene, and the map."""
        for name, place in around.beacons.items():
            height = place[2] if len(place) > 2 else 0.0
            position = (place[0], place[1], max(height, 0.0))  # the ground would hide what lies below the path
            self._scene.add_icosphere(f"/beacon/{name}", max(0.03, 0.012 * size), _ORANGE, position=position)
            self._scene.add_label(f"/beacon/{name}/label", name)
        if around.grid is None:
            return
        turn = float(around.grid.geometry[3])
        middle = np.mean(map_corners(around.grid), axis=0)
        image = np.where(around.grid.blocked[:, :, np.newaxis] == 1, 60, 235).astype(np.uint8)
        # viser puts the first row of an image at its lowest y, as the map has it.
        self._scene.add_image(
            "/map",
            np.repeat(image, 3, axis=2),
            *around.grid.size_m,
            wxyz=(math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)),
            position=(middle[0], middle[1], -self._floor_m),
        )

    def _draw_path(self, path: Floats) -> None:
        for name, columns, colour, width in (("/path", [0, 1], _BLUE, 3.0), ("/reference", [6, 7], _BLACK, 1.5)):
            points = np.column_stack([path[:, columns], np.full(len(path), self._floor_m)])
            self._lines(name, geometry.polyline(points), colour, width)
        known = path[np.isfinite(path[:, [0, 1, 3, 4]]).all(axis=1)]
        if len(known):
            at = np.linspace(0, len(known) - 1, min(_ELLIPSES, len(known))).astype(int)
            self._lines(
                "/ellipses",
                np.concatenate([geometry.ellipse(known[i], 2 * self._floor_m) for i in at]),
                _GREY,
                1.5,
            )

    def _lines(self, name: str, segments: Floats, colour: Colour, width: float) -> None:
        if len(segments):
            points = segments.astype(np.float32)
            self._scene.add_line_segments(name, points, colour, thickness=width, thickness_units="screen")


class ChainScene:
    """Two links at their joint, each with its sensor, and the cone of ±2σ of the joint's rotation about link 2.

    Link 1 has the attitude that the best filter of its sensor estimates; without one it stands upright. Bars and
    sensors lie as the rig states; a part of it that is unknown is drawn as if both sensors' z axes lay along straight
    links. With a known J2S, the fixed joint stays in its place, otherwise the joint between the links does.
    """

    charted: ClassVar[tuple[Quantity, ...]] = (ANGLE, *BALL_ANGLES, HEIGHT1, HEIGHT2)
    shown_by: ClassVar[tuple[Quantity, ...]] = (QW,)
    combines_filters: ClassVar[bool] = True

    def __init__(self, server: viser.ViserServer, changes: Changes, rig: Rig) -> None:
        scene, chain, self._changes = server.scene, rig.chain, changes
        r1, r2 = np.array(chain.r1_m or _UNKNOWN_R1_M), np.array(chain.r2_m or _UNKNOWN_R2_M)
        j2s = None if rig.joint.known_j2s_m is None or chain.r1_m is None else np.array(rig.joint.known_j2s_m)
        end = _BEYOND_SENSOR * r1 if j2s is None else r1 - j2s  # of link 1, from the joint between the links
        size = float(np.linalg.norm(end)) + _BEYOND_SENSOR * float(np.linalg.norm(r2))
        self._fixed_m = None if j2s is None else end
        self._base_m = np.array([0.0, 0.0, 1.1 * size])
        _ground(scene, 2.4 * size)
        self._joint = scene.add_frame("/joint", show_axes=False, position=self._base_m)
        scene.add_icosphere("/joint/ball", 0.04 * size, _BLACK)
        self._links = [
            scene.add_frame(f"/joint/link{number}", show_axes=False, visible=number == 1) for number in (1, 2)
        ]
        for number, place, reach, colour in ((1, r1, end, _GREY), (2, r2, _BEYOND_SENSOR * r2, _BLUE)):
            name, length = f"/joint/link{number}", float(np.linalg.norm(reach))
            turn = geometry.turn_z_to(reach)
            scene.add_cylinder(f"{name}/bar", 0.02 * size, length, colour, position=0.5 * reach, wxyz=turn)
            scene.add_box(f"{name}/sensor", _ORANGE, (0.09 * size, 0.07 * size, 0.03 * size), position=place)
            scene.add_frame(f"{name}/axes", axes_length=0.15 * size, axes_radius=0.005 * size, position=place)
        if j2s is not None:
            scene.add_icosphere("/joint/link1/fixed", 0.05 * size, _BLACK, position=end)
        self._cone = Cone(scene, changes, "/joint/link2/cone")
        self._cone.point_along(_BEYOND_SENSOR * r2)
        server.initial_camera.position = (0.9 * size, -1.5 * size, 1.0 * size)
        server.initial_camera.look_at = (0.0, 0.0, 0.7 * size)

    def draw(self, row: Row, name: str, reference: dict[Quantity, float]) -> None:
        first = best_filter(row, row, ROLL)
        angles = [row[first].get(q, _UNKNOWN)[0] if first is not None else math.nan for q in (ROLL, PITCH, YAW)]
        attitude = np.array(geometry.attitude(*angles))
        if not np.isfinite(attitude).all():
            attitude = np.array([1.0, 0.0, 0.0, 0.0])
        chain = best_filter(row, row, QW)
        values = row[chain] if chain is not None else {}
        rotation = np.array([values.get(q, _UNKNOWN)[0] for q in CHAIN_ROTATION])
        self._changes.turn(self._links[0], attitude.tolist())
        if self._fixed_m is not None:
            place = self._base_m - geometry.turned(attitude, self._fixed_m)
            self._changes.move(self._joint, place.tolist())
        is_known = bool(np.isfinite(rotation).all())
        self._changes.show(self._links[1], is_known)
        if is_known:
            self._changes.turn(self._links[1], product(attitude, rotation / np.linalg.norm(rotation)).tolist())

    def draw_slow(self, row: Row, name: str, path: Floats | None) -> None:
        chain = best_filter(row, row, QW)
        self._cone.draw(row[chain][QW][1] if chain is not None else math.nan)


class Cone:
    """A cone of ±2σ about an axis that starts at its parent's origin, hidden while σ is unknown."""

    def __init__(self, scene: viser.SceneApi, changes: Changes, name: str) -> None:
        self._changes = changes
        vertices, faces = geometry.cone()
        self._mesh = scene.add_mesh_simple(
            name, vertices, faces, color=_BLUE, opacity=0.25, side="double", cast_shadow=False, visible=False
        )
        self._length_m = 0.0

    def point_along(self, axis_m: Floats) -> None:
        """Gives the cone an axis (3,)."""
        self._mesh.wxyz, self._length_m = geometry.turn_z_to(axis_m), float(np.linalg.norm(axis_m))

    def draw(self, std_deg: float) -> None:
        """Opens the cone to ±2σ; NaN hides it."""
        radius = geometry.cone_radius(self._length_m, std_deg)
        self._changes.show(self._mesh, radius > 0.0)
        if radius > 0.0:
            self._changes.scale(self._mesh, (radius, radius, self._length_m))


def scene_of(
    server: viser.ViserServer,
    changes: Changes,
    filters: Iterable[Mapping[Quantity, str]],
    rig: Rig,
    surroundings: Surroundings,
    places: Floats,
) -> Scene:
    """The scene for the quantities that the filters estimate; what moves in it goes into `changes`.

    The camera of a robot's scene also shows `places` (N, 2), m.
    """
    _light(server.scene)
    estimated = {quantity for of in filters for quantity in of}
    if QW in estimated:
        return ChainScene(server, changes, rig)
    j2s = rig.joint.known_j2s_m
    if HEADING in estimated and (j2s is None or HEIGHT not in estimated):  # without J2S no height has a value
        return RobotScene(server, changes, surroundings, places)
    return LinkScene(server, changes, None if j2s is None else np.array(j2s))


def _light(scene: viser.SceneApi) -> None:
    """Plain light instead of viser's shadows and environment map.

    Without a graphics card those take two thirds of the time of each frame, and some seconds before the first one.
    """
    scene.configure_default_lights(cast_shadow=False)
    scene.configure_environment_map(None)
    scene.add_light_hemisphere("/sky", sky_color=_SKY, ground_color=_GROUND, intensity=_SKY_INTENSITY)


def _extent(points: Floats) -> tuple[Floats, float]:
    """Centre (2,) and larger side (m) of what points (N, 2) cover; a robot starts at the origin and heads along x."""
    if not len(points):
        return np.array([1.0, 0.0]), 4.0
    low, high = points.min(axis=0), points.max(axis=0)
    return 0.5 * (low + high), max(float((high - low).max()), 1.0)


def _ground(scene: viser.SceneApi, size_m: float, centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
    cell = 10.0 ** math.floor(math.log10(size_m / 8))
    scene.add_grid(
        "/ground", size_m, size_m, cell_size=cell, section_size=5 * cell, cell_color=(232, 235, 238),
        section_color=(205, 210, 215), plane_color=(246, 247, 249), plane_opacity=1.0, position=centre_m,
    )  # fmt: skip
