"""The indoor simulator: its floor, its odometry and its beams have the errors that were asked for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from linkpose.localization.carmen import as_log
from linkpose.localization.events import Event, Scan
from linkpose.localization.grid import cast_ray
from linkpose.simulation.indoor import IndoorErrors, office_floor, office_map, simulate_indoor

EXACT = IndoorErrors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_floor_is_100_by_40_metres_and_closed():
    floor = office_floor()
    assert floor.shape == (400, 1000)
    assert floor[0].all() and floor[-1].all() and floor[:, 0].all() and floor[:, -1].all()
    assert office_map().size_m == (100.0, 40.0)


def test_the_robot_stays_off_the_walls_and_closes_its_round():
    run = simulate_indoor(0, IndoorErrors(), None)
    cells = (run.pose[:, :2] / 0.1).astype(int)
    assert not office_floor()[cells[:, 1], cells[:, 0]].any()
    assert math.dist(run.pose[-1, :2], run.pose[0, :2]) < 1.0
    assert np.hypot(*np.diff(run.pose[:, :2], axis=0).T).sum() > 180.0


def test_without_errors_odometry_and_beams_are_the_truth():
    run = simulate_indoor(0, EXACT, 20.0)
    odometry = np.array([reading.odometry for reading in run.readings])
    assert np.allclose(odometry, run.pose, atol=1e-9)
    grid = office_map()
    scan = next(event for event in as_log(run.readings) if isinstance(event, Scan) and event.time_s == 10.0)
    x, y, heading = run.pose[100]
    expected = [cast_ray(grid.blocked, grid.geometry, x, y, heading + angle, 80.0) for angle in scan.angles_rad]
    assert np.allclose(scan.ranges_m, expected)


def test_errors_are_those_asked_for():
    errors = replace(EXACT, odometry_speed_m_s=0.05, odometry_turn_rad_s=0.04, range_m=0.05, range_growth=0.02)
    run, exact = simulate_indoor(1, errors, 100.0), simulate_indoor(1, EXACT, 100.0)
    driven = np.array([event.values for event in as_log(run.readings) if isinstance(event, Event)])[:-1]
    wrong = driven - run.twist[:-1]
    assert np.allclose(wrong.std(axis=0), [0.05, 0.04], rtol=0.1)
    pairs = [
        (a.ranges_m, b.ranges_m) for a, b in zip(run.readings, exact.readings, strict=True) if a.ranges_m is not None
    ]
    measured, true = (np.concatenate(part) for part in zip(*pairs, strict=True))
    for near, far in ((1.0, 3.0), (15.0, 25.0)):
        rows = (true > near) & (true < far)
        asked = np.sqrt(0.05**2 + (0.02 * true[rows]) ** 2)
        assert abs(np.std((measured[rows] - true[rows]) / asked) - 1.0) < 0.05


def test_outliers_shorten_the_share_of_beams_asked_for():
    run, exact = simulate_indoor(2, replace(EXACT, outlier_fraction=0.1), 60.0), simulate_indoor(2, EXACT, 60.0)
    pairs = [
        (a.ranges_m, b.ranges_m) for a, b in zip(run.readings, exact.readings, strict=True) if a.ranges_m is not None
    ]
    measured, true = (np.concatenate(part) for part in zip(*pairs, strict=True))
    shorter = measured < 0.95 * true
    assert abs(shorter.mean() - 0.1) < 0.005
    assert (measured <= true + 1e-9).all()
