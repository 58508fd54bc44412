"""What a drive shows of the laser's mount and of the odometry's scales: found, corrected and named, or in σ."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from linkpose.localization.carmen import as_log
from linkpose.localization.doubts import robot_doubts, with_doubtful_robot
from linkpose.localization.events import Log, Scan
from linkpose.localization.paths import localize
from linkpose.localization.self_calibration import RobotErrors, SelfCalibration, applicable, corrected
from linkpose.localization.track import Track
from linkpose.simulation.indoor import IndoorErrors, office_map, simulate_indoor

SOUND = np.zeros(5)


def winding_drive(errors: np.ndarray, seed: int, rows: int = 150) -> SelfCalibration:
    """A path that winds, by scans that err by 0.01 m and 0.3 degrees and wheels that err by 3 %, with such errors of
    the laser's direction (rad) and place (m, m) and of way and turn. Each tenth scan is 0.3 m off.
    """
    rng = np.random.default_rng(seed)
    calibration = SelfCalibration()
    pose = np.zeros(3)
    for i in range(rows):
        heading = pose[2] + errors[0]
        c, s = math.cos(heading), math.sin(heading)
        seen = pose + np.array((c * errors[1] - s * errors[2], s * errors[1] + c * errors[2], errors[0]))
        noise = rng.normal(0.0, (0.01, 0.01, 0.005)) + ((0.3, -0.2, 0.1) if i % 10 == 9 else 0.0)
        calibration.learn(seen + noise, np.diag((1e-4, 1e-4, 2.5e-5)))
        for _ in range(4):
            way, turn = 0.1, 0.25 * math.sin(0.11 * i) * math.sin(0.037 * i)
            middle = pose[2] + 0.5 * turn
            pose = pose + np.array((way * math.cos(middle), way * math.sin(middle), turn))
            slip = 1.0 + rng.normal(0.0, 0.03, 2)
            calibration.move(0.1, 10.0 * way * slip[0] / (1.0 + errors[3]), 10.0 * turn * slip[1] / (1.0 + errors[4]))
    return calibration


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("errors", [(0.05, 0.1, -0.08, -0.25, 0.2), (0, 0, 0, 0, 0), (-0.03, 0, 0, 0, 0)])
def test_a_drive_with_turns_shows_the_errors_of_the_robot_s_constants(errors: tuple[float, ...], seed: int) -> None:
    true = np.array(errors)
    found = winding_drive(true, seed).found()
    assert found is not None
    assert (np.abs(found.values - true) < 4.0 * found.std + 0.02 * np.abs(true)).all(), (found.values, found.std)
    assert (found.std < (0.005, 0.02, 0.02, 0.02, 0.02)).all()
    assert ((found.certain != 0.0) == (true != 0.0)).all()


def test_a_short_drive_and_a_robot_that_was_carried_show_nothing() -> None:
    assert winding_drive(np.array((0.1, 0.0, 0.0, 0.0, 0.0)), 0, 25).found() is None
    calibration = SelfCalibration()
    for i in range(60):
        calibration.learn(np.array((0.4 * i, 0.0, 0.0)), np.eye(3) * 1e-4)
        calibration.move(1.0, 0.4, 0.0)
        calibration.lose()
    assert calibration.found() is None


@pytest.fixture(scope="module")
def drive():
    """Forty seconds through the office floor, around a corner of it."""
    run = simulate_indoor(3, IndoorErrors(range_growth=0.0, outlier_fraction=0.0), 40.0)
    return run, as_log(run.readings), office_map()


def test_a_laser_that_was_put_on_askew_is_corrected_and_named(drive) -> None:
    """The heading was 3 degrees off, with none of it within 2σ, in silence."""
    run, log, grid = drive
    askew = corrected(log, np.array((math.radians(3.0), 0.0, 0.0, 0.0, 0.0)))
    paths = localize(askew, map=grid, start=tuple(run.pose[0]))
    assert re.search(r"the laser points (2\.[89]|3\.[01]) degrees farther to the right than the log", paths.remarks[0])
    result = paths.score(run.truth)["scan-match"]
    assert result.position_rmse_m < 0.04
    assert result.heading_rmse_rad is not None and result.heading_rmse_rad < 0.008


def test_an_odometry_that_is_a_third_too_long_is_corrected_and_named(drive) -> None:
    """In a corridor, it moved the path by decimetres, at σ of centimetres."""
    run, log, grid = drive
    paths = localize(corrected(log, np.array((0.0, 0.0, 0.0, 1.0 / 3.0, 0.0))), map=grid, start=tuple(run.pose[0]))
    assert re.search(r"the odometry drives 1\.3\d\d times as far as the scans, and was corr", paths.remarks[0])
    result = paths.score(run.truth)["scan-match"]
    assert result.position_rmse_m < 0.05
    assert result.within_2_sigma is not None and result.within_2_sigma > 0.93


def test_a_sound_robot_is_left_as_it_is(drive) -> None:
    run, log, grid = drive
    paths = localize(log, map=grid, start=tuple(run.pose[0]))
    assert paths.remarks == ()
    errors = paths.scan_match.robot_errors
    assert errors is not None and not errors.certain.any()


def test_the_place_of_a_laser_is_corrected_where_the_log_states_one_and_else_named_and_in_the_deviations() -> None:
    """In a log without one, the path of the laser may be meant: then it is right, and a corrected one is not."""
    errors = RobotErrors(np.array((0.0, 0.1, -0.06, 0.0, -0.2)), np.full(5, 0.01))
    scans: list[Log] = [[Scan(0.0, np.ones(9), np.linspace(-1.0, 1.0, 9), (x, 0.0, 0.0), 80.0)] for x in (0.2, 0.0)]
    assert applicable(scans[0], errors).tolist() == [0.0, 0.1, -0.06, 0.0, -0.2]
    assert applicable(scans[1], errors).tolist() == [0.0, 0.0, 0.0, 0.0, -0.2]
    assert applicable(scans[1], None).tolist() == SOUND.tolist()
    first, second = robot_doubts(errors, applicable(scans[0], errors))
    assert (
        "the laser is 0.10 m farther ahead and 0.06 m farther right on the robot than the log states, and was" in first
    )
    assert "the odometry turns 1.250 times as far as the scans, and was corrected by as much" in second
    unstated = robot_doubts(errors, applicable(scans[1], errors))[0]
    assert "the laser is 0.10 m farther ahead and 0.06 m farther right than the point that the robot turns" in unstated
    state = np.array([(1.0, 2.0, 0.5 * math.pi)])
    names = ("x_m", "y_m", "heading_rad")
    track = Track(names, np.zeros(1), state, np.eye(3)[np.newaxis] * 1e-4, 1, 0, frozenset(), 0, robot_errors=errors)
    assert (with_doubtful_robot(track).std[0] * 2.0 > (0.06, 0.1, 0.0)).all()
    small = replace(track, robot_errors=errors._replace(std=np.full(5, 0.2)))
    assert (with_doubtful_robot(small).covariance == track.covariance).all()
