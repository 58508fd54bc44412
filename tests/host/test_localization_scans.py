"""Whole laser scans against a map: distance field, fit, global search, recovery, and the particle filter."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from linkpose.errors import LinkposeError, MapMismatch, NothingApplied, UndecidedStart
from linkpose.localization.carmen import as_log
from linkpose.localization.distance_field import COUNT_M, FARTHEST_M, DistanceField, distance_at, seen_distance
from linkpose.localization.doubts import scan_doubts, with_doubtful_clock
from linkpose.localization.events import Event, Log, Scan
from linkpose.localization.grid import OCCUPIED, UNKNOWN, GridMap
from linkpose.localization.hypotheses import INCUMBENT, Contest, Hypothesis
from linkpose.localization.kalman import UNICYCLE, KalmanFilter
from linkpose.localization.localizer import estimate_track
from linkpose.localization.map_check import check_map
from linkpose.localization.paths import Paths, localize
from linkpose.localization.settings import Settings
from linkpose.localization.tables import score_track
from linkpose.localization.track import Track
from linkpose.simulation.indoor import IndoorErrors, office_map, simulate_indoor


def test_the_field_is_the_distance_to_the_nearest_wall():
    """Against brute force, on random walls; unknown cells are no walls."""
    rng = np.random.default_rng(4)
    blocked = np.where(rng.random((40, 55)) < 0.01, OCCUPIED, 0).astype(np.uint8)
    blocked[rng.random((40, 55)) < 0.2] = UNKNOWN
    field = DistanceField.of(GridMap(blocked, np.array([0.1, 0.0, 0.0, 0.0])))
    walls = np.argwhere(blocked == OCCUPIED)
    rows, columns = np.mgrid[:40, :55]
    squares = (rows[..., None] - walls[:, 0]) ** 2 + (columns[..., None] - walls[:, 1]) ** 2
    expected = np.minimum(0.1 * np.sqrt(squares.min(axis=-1)), FARTHEST_M)
    assert np.allclose(field.counts * COUNT_M, expected, atol=COUNT_M)


def test_the_field_of_a_moved_and_turned_map_is_moved_and_turned():
    blocked = np.zeros((60, 60), np.uint8)
    blocked[:, 40] = OCCUPIED  # one cell thick, so the zero is its centre: the centre of the wall is at 4.05 m
    yaw = 0.6
    field = DistanceField.of(GridMap(blocked, np.array([0.1, -3.0, 7.0, yaw])))
    c, s = math.cos(yaw), math.sin(yaw)
    at = np.empty(3)
    distance_at(field.counts, field.geometry, -3.0 + c * 2.5 - s * 3.0, 7.0 + s * 2.5 + c * 3.0, at)
    assert at == pytest.approx([1.55, -c, -s], abs=1e-3)
    distance_at(field.counts, field.geometry, 100.0, 100.0, at)
    assert at.tolist() == [FARTHEST_M, 0.0, 0.0]


def test_the_zero_of_a_drawn_wall_is_its_face():
    """A wall from 4.0 to 4.4 m: beams end at 4.0 m."""
    blocked = np.zeros((60, 60), np.uint8)
    blocked[:, 40:44] = OCCUPIED
    field = DistanceField.of(GridMap(blocked, np.array([0.1, 0.0, 0.0, 0.0])))
    at = np.empty(3)
    for x, expected in ((3.0, 1.0), (4.0, 0.0), (4.1, -0.1), (4.4, 0.0), (5.0, 0.6)):
        distance_at(field.counts, field.geometry, x, 3.0, at)
        assert at[0] == pytest.approx(expected, abs=1e-3)


def test_a_beam_that_ends_behind_a_drawn_wall_is_behind_the_face_that_it_sees():
    """The field's own zero there is the far face. Beams that pass a wall, or reach none, keep the field's value."""
    blocked = np.zeros((80, 80), np.uint8)
    blocked[:, 40:42] = OCCUPIED  # from 4.0 to 4.2 m
    field = DistanceField.of(GridMap(blocked, np.array([0.1, 0.0, 0.0, 0.0])))
    assert field.is_drawn
    at, cos, sin = np.empty(3), math.cos(0.5), math.sin(0.5)
    for x, expected in ((3.9, 0.1), (4.05, -0.05), (4.15, -0.15), (4.2, -0.2), (5.5, -1.5)):
        seen_distance(field.counts, field.clear, field.geometry, x, 4.0, cos, sin, FARTHEST_M, at)
        assert at == pytest.approx([expected, -1.0, 0.0], abs=2e-3)
    for x, ahead_x, reach in ((5.5, -1.0, FARTHEST_M), (5.5, 1.0, 0.0), (5.5, 0.0, FARTHEST_M)):
        seen_distance(
            field.counts, field.clear, field.geometry, x, 4.0, ahead_x, math.sqrt(1.0 - ahead_x**2), reach, at
        )
        assert at[0] == pytest.approx(1.3, abs=2e-3)


def only_faces(grid: GridMap) -> GridMap:
    """The map as scans make it: nothing is known inside of walls."""
    blocked = grid.blocked.copy()
    wall = grid.blocked == OCCUPIED
    inner = wall.copy()
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        inner &= np.roll(wall, step, axis)
    blocked[inner] = UNKNOWN
    return GridMap(blocked, grid.geometry)


def test_a_beam_that_ends_at_the_far_face_of_a_mapped_wall_is_behind_the_face_that_it_sees():
    """Unknown cells that no wall shuts off, on the right, are not behind a face: nothing there looks like a wall."""
    blocked = np.zeros((80, 80), np.uint8)
    blocked[:, 40:44] = OCCUPIED  # faces at 4.05 and 4.35 m
    grid = only_faces(GridMap(blocked, np.array([0.1, 0.0, 0.0, 0.0])))
    grid.blocked[:, 60:] = UNKNOWN
    field = DistanceField.of(grid)
    assert not field.is_drawn
    at, cos, sin = np.empty(3), math.cos(0.5), math.sin(0.5)
    for x, expected in ((3.9, 0.15), (4.1, -0.05), (4.25, -0.2), (4.3, -0.25), (4.39, -0.34)):
        for ahead in (1.0, -1.0):
            seen_distance(
                field.counts,
                field.clear,
                field.geometry,
                4.2 + ahead * (x - 4.2),
                4.0,
                ahead * cos,
                sin,
                field.reach_m,
                at,
            )
            assert at == pytest.approx([expected, -ahead, 0.0], abs=2e-3)
    seen_distance(field.counts, field.clear, field.geometry, 5.5, 4.0, cos, sin, field.reach_m, at)
    assert at[0] == pytest.approx(1.15, abs=2e-3)
    for x in np.arange(5.0, 7.8, 0.03):
        distance_at(field.counts, field.geometry, x, 4.0, at)
        assert at[0] == pytest.approx(min(x - 4.35, FARTHEST_M), abs=2e-3)


@pytest.mark.parametrize("drawn", [True, False])
def test_cells_that_are_clear_of_walls_are_passed_over_without_a_difference(drawn: bool) -> None:
    """Against beams that are followed back by every half cell."""
    rng = np.random.default_rng(7)
    blocked = np.zeros((90, 90), np.uint8)
    for row, column in rng.integers(5, 80, (14, 2)):
        blocked[row : row + 4, column : column + 6] = OCCUPIED
    grid = GridMap(blocked, np.array([0.1, -2.0, 1.0, 0.3]))
    field = DistanceField.of(grid if drawn else only_faces(grid))
    assert field.is_drawn == drawn
    assert (field.counts < 0).any() and 0 <= field.clear.min() < 2 < 10 < field.clear.max()
    stepwise, at, expected = np.zeros_like(field.clear), np.empty(3), np.empty(3)
    for x, y, angle in zip(rng.uniform(-5, 8, 3000), rng.uniform(0, 12, 3000), rng.uniform(-3, 3, 3000), strict=True):
        beam = (x, y, math.cos(angle), math.sin(angle), field.reach_m)
        seen_distance(field.counts, field.clear, field.geometry, *beam, at)
        seen_distance(field.counts, stepwise, field.geometry, *beam, expected)
        assert at.tolist() == expected.tolist()


def test_wheels_that_slip_do_not_move_the_robot_by_the_thickness_of_a_wall():
    """The scans ahead fitted the far faces of the walls, too, from where the odometry led: by 0.16 m, in silence."""
    blocked = np.zeros((120, 160), np.uint8)
    blocked[:3] = blocked[-3:] = blocked[:, :3] = blocked[:, -3:] = OCCUPIED
    blocked[:76, 60:63] = blocked[40:43, 60:120] = OCCUPIED
    grid = only_faces(GridMap(blocked, np.array([0.05, 0.0, 0.0, 0.0])))
    poses = [(1.0 + 0.3 * i, 5.0, 0.0) for i in range(17)]
    scans = [
        replace(scan, ranges_m=np.where(np.cos(scan.angles_rad) > 0.0, scan.ranges_m, np.nan))
        for scan in scans_from(grid, poses)
    ]
    log: Log = [*scans, *(Event(0.1 * i, "odometry", (0.45 if i > 30 else 0.3, 0.0)) for i in range(161))]
    track = estimate_track(sorted(log, key=lambda e: e.time_s), "scan-match", Settings(start=poses[0]), grid)
    at = np.searchsorted(track.time_s, np.arange(17.0), side="right") - 1
    errors = np.abs(track.position_m[at, 0] - np.array(poses)[:, 0])
    assert errors.max() < 0.06, errors
    assert (errors < 2.0 * track.std[at, 0]).all()


def test_what_is_filled_around_a_building_does_not_make_its_walls_uncertain():
    """A map of thin walls, with all filled outside of it: σ was 0.25 m, as if the walls were a metre thick."""
    blocked = np.full((200, 200), OCCUPIED, np.uint8)
    blocked[60:140, 60:140] = 0
    blocked[60:110, 100] = OCCUPIED
    fields = [
        DistanceField.of(GridMap(outside, np.array([0.05, 0.0, 0.0, 0.0]))) for outside in (blocked, hollow(blocked))
    ]
    assert fields[0].wall_std_m < 0.03 and fields[1].wall_std_m < 0.03
    smeared = hollow(blocked)
    smeared[60:110, 100:106] = OCCUPIED
    assert DistanceField.of(GridMap(smeared, np.array([0.05, 0.0, 0.0, 0.0]))).wall_std_m > 0.04


def hollow(blocked: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The same map with what is outside of the building unknown, but for a cell of wall."""
    inner = blocked.copy()
    inner[:59] = inner[141:] = inner[:, :59] = inner[:, 141:] = UNKNOWN
    return inner


def test_noisy_beams_do_not_move_the_robot_along_a_corridor_with_drawn_walls():
    """Beams of 70 m with 1.4 m of noise: the far faces of the walls moved the path by 0.08 m, at σ of 0.025 m."""
    run = simulate_indoor(1, IndoorErrors(), 60.0)
    track = estimate_track(as_log(run.readings), "scan-match", Settings(start=tuple(run.pose[0])), office_map())
    result = score_track(track, run.truth)
    ahead = np.column_stack((np.cos(run.pose[:, 2]), np.sin(run.pose[:, 2])))
    errors = np.sum((track.position_m - run.pose[:, :2]) * ahead, axis=1)
    assert abs(float(errors.mean())) < 0.03
    assert result.position_rmse_m < 0.06
    assert result.within_2_sigma is not None and result.within_2_sigma > 0.93


@pytest.fixture(scope="module")
def drive():
    """Half a minute through the office floor, with its map and a laser scanner's constant noise."""
    return simulate_indoor(3, IndoorErrors(range_growth=0.0, outlier_fraction=0.0), 30.0), office_map()


def test_a_scan_match_is_accurate_and_honest(drive):
    run, grid = drive
    start = tuple(run.pose[0] + (0.3, -0.3, 0.08))
    track = estimate_track(as_log(run.readings), "scan-match", Settings(start=start), grid)
    result = score_track(track, run.truth)
    assert result.position_rmse_m < 0.06
    assert result.within_2_sigma is not None and result.within_2_sigma > 0.9
    assert track.known.all()
    assert track.range_scale == 1.0  # sound ranges stay as they are


def test_a_robot_is_followed_in_an_old_map_with_smeared_walls(drive):
    """The faces of the walls are ragged by decimetres, and a third of the beams end at people."""
    _, grid = drive
    run = simulate_indoor(3, IndoorErrors(range_growth=0.0, outlier_fraction=0.3), 30.0, grid)
    rng = np.random.default_rng(1)
    blocked = np.where(grid.blocked == OCCUPIED, OCCUPIED, 0).astype(np.uint8)
    for _ in range(2):
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            grown = np.roll(blocked, step, axis) & (rng.random(blocked.shape) < 0.4)
            blocked |= grown.astype(np.uint8)
    track = estimate_track(
        as_log(run.readings), "scan-match", Settings(start=tuple(run.pose[0])), GridMap(blocked, grid.geometry)
    )
    result = score_track(track, run.truth)
    assert result.position_rmse_m < 0.3
    assert result.within_2_sigma is not None and result.within_2_sigma > 0.9
    assert track.known.all() and track.relocated == 0


def among_people(log: Log, count: int) -> Log:
    """People of 0.5 m who walk with the robot, 1 to 2.5 m from it, hide what is behind them."""
    seen: Log = []
    for event in log:
        if isinstance(event, Scan):
            ranges = event.ranges_m.copy()
            for k in range(count):
                away = 1.75 + 0.75 * math.sin(0.3 * event.time_s + 2.0 * k)
                bearing = 0.4 * math.sin(0.2 * event.time_s + k) + math.pi * ((k + 0.5) / count - 0.5)
                hidden = np.abs(event.angles_rad - bearing) < math.asin(0.25 / away)
                ranges[hidden] = np.fmin(ranges[hidden], away)
            event = replace(event, ranges_m=ranges)
        seen.append(event)
    return seen


def with_short_echoes(log: Log) -> Log:
    """A third of the beams end on their way."""
    rng = np.random.default_rng(6)
    return [
        replace(e, ranges_m=e.ranges_m * np.where(rng.random(len(e.ranges_m)) < 0.33, rng.random(len(e.ranges_m)), 1.0))
        if isinstance(e, Scan)
        else e
        for e in log
    ]


@pytest.mark.parametrize(
    ("disturbed", "limit_m"), [(lambda log: among_people(log, 5), 0.03), (with_short_echoes, 0.017)]
)
def test_beams_that_end_in_free_space_do_not_pull_the_robot(
    drive, disturbed: Callable[[Log], Log], limit_m: float
) -> None:
    """The errors were 0.046 and 0.020 m (rms), with people up to 0.15 m."""
    run, grid = drive
    track = estimate_track(disturbed(as_log(run.readings)), "scan-match", Settings(start=tuple(run.pose[0])), grid)
    result = score_track(track, run.truth)
    assert result.position_rmse_m < limit_m
    assert result.within_2_sigma is not None and result.within_2_sigma > 0.95
    assert track.known.all() and track.relocated == 0


def test_ranges_that_are_too_long_are_corrected_and_named(drive):
    """They moved the path by 0.17 m, with 68 % within 2σ, in silence."""
    run, grid = drive
    log = [replace(e, ranges_m=1.025 * e.ranges_m) if isinstance(e, Scan) else e for e in as_log(run.readings)]
    paths = localize(log, map=grid, start=tuple(run.pose[0]))
    assert paths.scan_match.range_scale == pytest.approx(1.0 / 1.025, abs=0.003)
    assert re.search(r"the laser's ranges are 2\.[345]% longer than the distances in the map", paths.remarks[-1])
    result = paths.score(run.truth)["scan-match"]
    assert result.position_rmse_m < 0.03
    assert result.within_2_sigma is not None and result.within_2_sigma > 0.95


def test_without_a_start_the_pose_is_unknown_and_then_right(drive):
    run, grid = drive
    track = estimate_track(as_log(run.readings), "scan-match", Settings(), grid)
    assert not track.known[0]
    assert np.isnan(track.state[0]).all()
    assert track.known.mean() > 0.6
    assert score_track(track, run.truth).position_max_m < 0.3


def test_scans_without_odometry_are_followed_from_a_given_start(drive):
    run, grid = drive
    scans = [reading for reading in run.readings[:150] if reading.ranges_m is not None]
    still = [replace(reading, odometry=(0.0, 0.0, 0.0), laser=(0.0, 0.0, 0.0)) for reading in scans]
    paths = localize(as_log(still), map=grid, start=tuple(run.pose[0]))
    assert "the odometry of the log is always at rest" in paths.remarks[0]
    result = paths.score(run.truth)["scan-match"]
    assert result.position_rmse_m < 0.1
    assert result.within_2_sigma is not None and result.within_2_sigma > 0.9


def test_a_robot_that_was_carried_is_found_again(drive):
    """Its odometry sees nothing of 60 m."""
    run, grid = drive
    other = simulate_indoor(5, IndoorErrors(), 110.0, grid)
    shift = run.time_s[-1] + 0.2 - other.time_s[900]
    log = as_log(run.readings)
    for event in as_log([replace(reading, time_s=reading.time_s + shift) for reading in other.readings[900:]]):
        log.append(event)
    track = estimate_track(log, "scan-match", Settings(start=tuple(run.pose[0])), grid)
    assert track.relocated >= 1
    true = np.interp(track.time_s[-1] - shift, other.time_s, other.pose[:, 0])
    assert track.known[-1] and abs(track.state[-1, 0] - true) < 0.2


def test_a_robot_that_was_carried_into_a_room_where_only_one_wall_is_as_before_is_missed() -> None:
    """All other beams ended in free space of the hall, as at people: it was followed there for good, in silence."""
    blocked = np.full((80, 120), UNKNOWN, np.uint8)
    blocked[0:80, 0:62] = blocked[9:45, 79:107] = OCCUPIED
    blocked[1:79, 1:61] = blocked[10:44, 80:106] = 0
    blocked[10:16, 80:88] = blocked[36:44, 100:106] = OCCUPIED
    grid = GridMap(blocked, np.array([0.1, 0.0, 0.0, 0.0]))
    hall = [(1.2 + 0.05 * i, 4.0, 0.3 * i) for i in range(5)]
    room = [(9.2, 2.7, 1.5 + 0.3 * i) for i in range(14)]
    log: Log = [*scans_from(grid, [*hall, *room]), *(Event(0.1 * i, "odometry", (0.0, 0.3)) for i in range(190))]
    track = estimate_track(sorted(log, key=lambda e: e.time_s), "scan-match", Settings(start=hall[0]), grid)
    assert track.relocated == 1
    late = track.time_s > 5.0 + 9.0
    assert np.hypot(*(track.position_m[late, :2] - room[0][:2]).T).max() < 0.1


def test_people_around_a_carried_robot_do_not_delay_the_decision_in_a_map_that_is_right() -> None:
    """Three of ten beams end at people. In an old map, where the rest fits no better, a wrong place could win."""
    at = KalmanFilter("ekf", UNICYCLE, np.zeros(3), np.eye(3), np.eye(2))

    def scans_until_decided(is_right: bool, of_seen: float) -> int:
        poses = [np.array((5.0 * i, 0.0, 0.0)) for i in range(3)]
        filters = [replace(at, state=pose) for pose in poses]
        tracked = Hypothesis(filters[2], poses[2], INCUMBENT, True)
        contest = Contest([*map(Hypothesis, filters[:2], poses[:2]), tracked], is_right)
        for count in range(1, 40):
            each = [{0: -4.0, 5: -6.0, 10: -14.0}[round(one.first[0])] for one in contest.hypotheses]
            if contest.judge(each, [of_seen] * len(each)):
                assert contest.hypotheses[0].first[0] == 0.0
                return count
            contest.moved(0.3, 0.0)
        return 40

    assert scans_until_decided(True, -0.1) == 7
    assert scans_until_decided(False, -0.1) == scans_until_decided(True, -4.0) == 40


def test_monte_carlo_localization_is_seeded(drive):
    run, grid = drive
    log = as_log(run.readings)
    settings = Settings(start=tuple(run.pose[0]), start_std=(0.2, 0.05), particles=300, seed=2)
    tracks = [estimate_track(log, "mcl", chosen, grid) for chosen in (settings, settings, replace(settings, seed=3))]
    assert (tracks[0].state == tracks[1].state).all()
    assert (tracks[0].state != tracks[2].state).any()
    assert score_track(tracks[0], run.truth).position_rmse_m < 0.3
    with pytest.raises(LinkposeError, match="does not state where the robot starts"):
        estimate_track(log, "mcl", Settings(), grid)


def test_monte_carlo_localization_does_not_take_what_is_behind_a_wall_for_the_wall():
    """Distances are negative behind the walls of a map of scans: beams that ended there fitted, 13 m off."""
    blocked = np.full((200, 200), OCCUPIED, np.uint8)
    blocked[60:140, 60:140] = 0
    blocked[60:110, 100] = OCCUPIED
    grid = GridMap(hollow(blocked), np.array([0.05, 0.0, 0.0, 0.0]))
    poses = [(3.6 + 0.25 * i, 6.2, 0.0) for i in range(9)]
    log: Log = [*scans_from(grid, poses), *(Event(0.1 * i, "odometry", (0.25, 0.0)) for i in range(81))]
    settings = Settings(start=poses[0], start_std=(1.5, 2.0), particles=2000, seed=0)
    track = estimate_track(sorted(log, key=lambda e: e.time_s), "mcl", settings, grid)
    assert np.hypot(*(track.position_m[-1, :2] - poses[-1][:2])) < 0.05


def test_scans_without_echo_change_nothing():
    grid = office_map()
    silent = Scan(1.0, np.full(181, np.nan), np.linspace(-1.5, 1.5, 181), (0.0, 0.0, 0.0), 80.0)
    log = [Event(0.0, "pose", (12.0, 12.0, 0.0)), Event(0.0, "odometry", (0.0, 0.0)), silent]
    track = estimate_track(log, "scan-match", Settings(), grid)
    assert track.applied == 0
    assert track.state[-1] == pytest.approx([12.0, 12.0, 0.0])


def flat_with_rooms() -> GridMap:
    """A flat of 8 x 6 m whose walls no mirror image has, with cells of 0.1 m."""
    blocked = np.zeros((60, 80), np.uint8)
    blocked[[0, -1], :] = blocked[:, [0, -1]] = OCCUPIED
    blocked[:38, 30] = blocked[20, 30:60] = blocked[40:47, 55:62] = blocked[52:, 12] = OCCUPIED
    return GridMap(blocked, np.array([0.1, 0.0, 0.0, 0.0]))


def scans_in(grid: GridMap) -> list[Scan]:
    """Scans of 90 beams all around from four places, by steps of a quarter of a cell along each beam."""
    return scans_from(grid, [(1.5, 1.5, 0.3), (1.0, 4.5, 2.0), (5.0, 4.5, -1.0), (6.5, 1.0, 1.2)])


def scans_from(grid: GridMap, poses: list[tuple[float, float, float]]) -> list[Scan]:
    """Such scans from poses (m, m, rad), one each second."""
    cell, angles, steps = grid.geometry[0], np.radians(np.arange(0, 360, 4.0)), np.arange(0.0, 12.0, 0.025)
    rows, columns = grid.blocked.shape
    scans = []
    for time, (x, y, heading) in enumerate(poses):
        across = ((x + np.outer(np.cos(angles + heading), steps)) / cell).astype(int).clip(0, columns - 1)
        along = ((y + np.outer(np.sin(angles + heading), steps)) / cell).astype(int).clip(0, rows - 1)
        ranges = steps[np.argmax(grid.blocked[along, across] == OCCUPIED, axis=1)]
        scans.append(Scan(float(time), ranges, angles, (0.0, 0.0, 0.0), 80.0))
    return scans


def along_a_symmetric_room() -> tuple[Log, GridMap]:
    """A drive of 0.5 m each second in a room of 8 x 6 m that looks the same from the opposite side."""
    blocked = np.zeros((60, 80), np.uint8)
    blocked[[0, -1], :] = blocked[:, [0, -1]] = OCCUPIED
    room = GridMap(blocked, np.array([0.1, 0.0, 0.0, 0.0]))
    poses = [(1.5 + 0.5 * i, 2.0, 0.0) for i in range(8)]
    log: Log = [*scans_from(room, poses), *(Event(0.1 * i, "odometry", (0.5, 0.0)) for i in range(80))]
    return sorted(log, key=lambda event: event.time_s), room


def localize_in(log: Log, grid: GridMap) -> Paths:
    return localize(log, map=grid)


def elsewhere() -> tuple[Log, GridMap]:
    """Two seconds of `along_a_symmetric_room`, with ranges of another, wider place."""
    log, room = along_a_symmetric_room()
    log = [event for event in log if event.time_s < 1.5]
    return [replace(e, ranges_m=e.ranges_m + 1.2) if isinstance(e, Scan) else e for e in log], room


def in_one_place() -> tuple[Log, GridMap]:
    """Two scans in a flat, and next to no motion."""
    grid = flat_with_rooms()
    log: Log = [replace(scans_in(grid)[0], time_s=0.1 * i) for i in range(2)]
    return [*log, Event(0.5, "odometry", (0.0, 0.0)), Event(0.6, "odometry", (0.1, 0.0))], grid


def test_a_search_that_never_decides_names_the_places_that_fit_alike() -> None:
    """The closing sentence blamed the units and the map."""
    log, room = along_a_symmetric_room()
    with pytest.raises(UndecidedStart, match="the scans fit 2 places of the map alike") as raised:
        localize_in(log, room)
    places = np.array(sorted(raised.value.starts))[:, :2]
    assert places == pytest.approx(np.array([(1.5, 2.0), (6.5, 4.0)]), abs=0.2)
    (_, _, one), (_, _, other) = raised.value.starts
    assert abs(math.cos(one - other) + 1.0) < 0.01
    assert localize(log, map=room, start=(1.5, 2.0, 0.0))["scan_match_x_m"][-1] == pytest.approx(5.45, abs=0.1)


def test_a_robot_that_hardly_moves_and_a_map_of_another_place_are_named_at_the_end_of_a_search() -> None:
    with pytest.raises(UndecidedStart, match=r"moves too little .* the scans fit .1.5, 1.5, 0.3"):
        localize_in(*in_one_place())
    with pytest.raises(NothingApplied, match=r"no pose that explains the scans: only .* of this place"):
        localize_in(*elsewhere())


def of_half_the_size(grid: GridMap) -> GridMap:
    """The map with half of its resolution."""
    return GridMap(grid.blocked, grid.geometry * (0.5, 1, 1, 1))


def test_a_map_that_the_scans_fit_only_mirrored_or_at_another_scale_is_named():
    grid = flat_with_rooms()
    scans = scans_in(grid)
    mirrored: Log = [replace(scan, ranges_m=scan.ranges_m[::-1]) for scan in scans[1:3]]
    for log, wrong, words in (
        (mirrored, grid, "mirrored"),
        ([replace(scan, ranges_m=scan.ranges_m / 0.3048) for scan in scans[1:3]], grid, "3.28 times as large, unless"),
        (list[Event | Scan](scans[:1]), of_half_the_size(grid), "twice as large"),
    ):
        with pytest.raises(MapMismatch, match=f"if the map is {words}") as raised:
            check_map(log, wrong, 0.2, "a.log")
        assert raised.value.changed_share > 0.95 > raised.value.share


def test_a_map_of_another_place_and_an_odometry_that_contradicts_the_scans_are_named():
    grid = flat_with_rooms()
    log: Log = list(scans_in(grid)[:2])
    assert check_map(log, grid, 0.9, "a.log") == ""
    assert "check the odometry" in check_map(log, grid, 0.3, "a.log")
    rng = np.random.default_rng(5)
    elsewhere: Log = [
        Scan(float(i), rng.uniform(0.5, 6.0, 90), np.radians(np.arange(0, 360, 4.0)), (0.0, 0.0, 0.0), 80.0)
        for i in range(2)
    ]
    assert "check whether the map is of this place" in check_map(elsewhere, grid, 0.2, "a.log")


def winding(late_s: float, speed: float, turn: float, beside_deg: float = 0.0) -> tuple[Log, Track]:
    """Half a minute of a path that winds, and 5 scans/s that err by 0.01 m and 0.3 degrees. They are stamped so much
    later than the odometry, at 20 Hz, whose columns are multiplied by `speed` and `turn`, and lead beside the heading.
    """
    rng = np.random.default_rng(8)
    fine = np.arange(0.0, 30.0, 0.01)
    rates = 0.8 * np.sin(0.9 * fine) * np.sin(0.23 * fine)
    heading = np.cumsum(0.01 * rates)
    x, y = np.cumsum(0.005 * np.cos(heading)), np.cumsum(0.005 * np.sin(heading))
    log: Log = [
        Event(t, "odometry", (speed * 0.5, turn * rate))
        for t, rate in zip(fine[::5], rates.reshape(-1, 5).mean(axis=1), strict=True)
    ]
    times = np.arange(1.0, 29.0, 0.2)
    log += [Scan(float(t), np.ones(9), np.linspace(-1.0, 1.0, 9), (0.0, 0.0, 0.0), 80.0) for t in times]
    poses = np.column_stack([np.interp(times - late_s, fine, column) for column in (x, y, heading)])
    poses[:, 2] -= math.radians(beside_deg)
    state = poses + rng.normal(0.0, (0.01, 0.01, 0.005), poses.shape)
    covariance = np.tile(np.diag((1e-4, 1e-4, 2e-5)), (len(times), 1, 1))
    track = Track(("x_m", "y_m", "heading_rad"), times, state, covariance, 1, 0, frozenset(), 0)
    return sorted(log, key=lambda event: event.time_s), track


@pytest.mark.parametrize(
    ("late_s", "speed", "turn", "sentence"),
    [
        (0.0, 1.0, 1.0, ""),
        (0.0, 1.15, 0.85, ""),
        (0.2, 1.0, 1.0, "the scans are stamped about 0.(19|20|21) s later"),
        (-0.1, 1.0, 1.0, "the odometry is stamped about 0.(09|10|11) s later"),
        (0.0, -1.0, 1.0, "drives the other way"),
        (0.0, 1.0, -1.0, "turns the other way"),
        (0.0, 1 / 0.3048, 1.0, "drives 3.[23]. times as far"),
        (0.0, 1.0, 180.0 / math.pi, "turns 5[5-9].* times as far"),
    ],
)
def test_a_clock_a_sign_and_a_unit_of_the_odometry_that_the_scans_contradict_are_named(
    late_s: float, speed: float, turn: float, sentence: str
) -> None:
    """The filter follows the scans, so that all of them passed in silence; a late scan moves the path."""
    found = scan_doubts(*winding(late_s, speed, turn))
    assert len(found) == (1 if sentence else 0), found
    assert all(re.search(sentence, remark) for remark in found)


@pytest.mark.parametrize("late_s", [0.0, 0.2, -0.2])
def test_the_stated_deviations_hold_whichever_clock_is_right(late_s: float) -> None:
    """In the odometry's time, the path is off by 0.1 m and 5 degrees (rms), at σ of 0.01 m and 0.3 degrees."""
    log, track = winding(late_s, 1.0, 1.0)
    widened = with_doubtful_clock(log, track)
    true = winding(0.0, 1.0, 1.0)[1].state
    errors = np.abs(widened.state - true)
    assert (errors < 2.0 * widened.std + 0.02).mean(axis=0).min() > 0.95
    assert (widened.covariance == track.covariance).all() == (late_s == 0.0)


@pytest.mark.parametrize(
    ("beside_deg", "sentence"), [(3.0, ""), (10.0, "10 degrees to the left"), (-90.0, "90 .* right")]
)
def test_a_laser_whose_direction_is_not_the_stated_one_is_named(beside_deg: float, sentence: str) -> None:
    """Its path fitted the map with a wrong heading, in silence."""
    found = scan_doubts(*winding(0.0, 1.0, 1.0, beside_deg))
    assert len(found) == (1 if sentence else 0), found
    assert all(re.search(sentence, remark) for remark in found)
