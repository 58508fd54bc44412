"""The EKF and the UKF against their equations, against each other, and against what they claim of their own errors."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from linkpose.errors import LinkposeError
from linkpose.localization import models
from linkpose.localization.consistency import Consistency
from linkpose.localization.events import Event
from linkpose.localization.gate import chi_square_quantile
from linkpose.localization.grid import GridMap, no_map
from linkpose.localization.kalman import (
    CONSTANT_VELOCITY,
    HOLONOMIC,
    SUBMERSIBLE,
    SUBMERSIBLE_IN_CURRENT,
    UNICYCLE,
    KalmanFilter,
    Measurement,
)
from linkpose.localization.linalg import wrap_angle
from linkpose.localization.localizer import estimate_track
from linkpose.localization.noise import RangeNoise, check_correlation, equicorrelated
from linkpose.localization.odometry import with_mice_odometry
from linkpose.localization.settings import Settings
from linkpose.localization.ukf import Transform
from linkpose.simulation.indoor import office_map
from linkpose.simulation.underwater import BEACONS, UnderwaterErrors, simulate_underwater

CONTROL, HOLD = np.array([0.8, 0.2]), np.array([0.1, 0.1])
MOTIONS = {
    "constant_velocity": CONSTANT_VELOCITY,
    "unicycle": UNICYCLE,
    "holonomic": HOLONOMIC,
    "submersible": SUBMERSIBLE,
    "submersible_in_current": SUBMERSIBLE_IN_CURRENT,
}


def predicted(model, state, parameters, size, grid=None):
    grid = grid or no_map()
    out = np.empty(size)
    models.predict(model, state, parameters, grid, out)
    return out


def moved(motion, state, control, noise, interval):
    out, state, noise = np.empty(len(state)), np.ascontiguousarray(state), np.ascontiguousarray(noise)
    models.propagate(motion.model, state, control, noise, interval, out)
    return out


def thesis_ukf(state, covariance, root, interval, measurement, transform, grid):
    """Equations (1) to (12) word for word: 2 n_a + 1 points of the augmented state, each driven and looked from."""
    n, q, m = len(state), len(root), len(measurement.values)
    size = n + q + m
    augmented = np.zeros((size, size))
    augmented[:n, :n], augmented[n : n + q, n : n + q] = covariance, root @ root.T
    augmented[n + q :, n + q :] = measurement.covariance
    lam = transform.alpha**2 * (size + transform.kappa) - size
    columns = math.sqrt(size + lam) * np.linalg.cholesky(augmented)
    mean = np.concatenate((state, np.zeros(q + m)))
    points = [mean, *(mean + columns.T), *(mean - columns.T)]
    weight = np.full(2 * size + 1, 0.5 / (size + lam))
    weight[0] = lam / (size + lam)
    squares = weight.copy()
    squares[0] += 1 - transform.alpha**2 + transform.beta
    x = np.array([moved(UNICYCLE, p[:n], CONTROL, p[n : n + q], interval) for p in points])
    z = np.array(
        [
            predicted(measurement.model, xi, measurement.parameters, m, grid) + p[n + q :]
            for xi, p in zip(x, points, strict=True)
        ]
    )
    x_mean, z_mean = weight @ x, weight @ z
    dx, dz = x - x_mean, z - z_mean
    gain = (dx.T * squares) @ dz @ np.linalg.inv((dz.T * squares) @ dz)
    spread = (dx.T * squares) @ dx - gain @ ((dz.T * squares) @ dz) @ gain.T
    return x_mean + gain @ (measurement.values - z_mean), spread


def nineteen_beams(state):
    table = np.zeros((19, 5))
    table[:, 0], table[:, 4] = np.radians(np.arange(-90, 91, 10)), 80.0
    ranges = predicted(models.BEAMS, state, table, 19, office_map()) + np.linspace(-0.1, 0.1, 19)
    return Measurement(models.BEAMS, ranges, equicorrelated(np.full(19, 0.3), 0.3), table), office_map()


def four_ranges(state):
    table = np.array(
        [[0.0, 0, 0, -1, -1, -1, -1], [30, 0, 0, -1, -1, -1, -1], [30, 30, 2, -1, -1, -1, -1], [0, 30, 1, *[-1] * 4]]
    )
    ranges = predicted(models.BEACON_RANGE, state, table, 4) + np.array([0.2, -0.1, 0.05, 0.1])
    return Measurement(models.BEACON_RANGE, ranges, equicorrelated(np.full(4, 0.3), 0.4), table), no_map()


@pytest.mark.parametrize("transform", [Transform(), Transform(kappa=2.0), Transform(0.3, 2.0, 1.0)])
@pytest.mark.parametrize("sensor", [nineteen_beams, four_ranges])
def test_ukf_step_is_the_thesis_equations(sensor, transform):
    state, covariance = np.array([14.0, 12.0, 0.4]), np.array([[0.04, 0.01, 0], [0.01, 0.03, 0.002], [0, 0.002, 0.002]])
    root = np.linalg.cholesky(equicorrelated(np.array([0.1, 0.05]), 0.3))  # (16)
    measurement, grid = sensor(state)
    expected, spread = thesis_ukf(state, covariance, root, 0.1, measurement, transform, grid)
    ukf = KalmanFilter("ukf", UNICYCLE, state, covariance, root, None, transform, grid)
    ukf.step(0.1, CONTROL, HOLD, measurement)
    assert ukf.state == pytest.approx(expected, abs=1e-9)
    assert ukf.covariance == pytest.approx(spread, abs=1e-9)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_linear_measurement_gives_the_kalman_filter(name):
    """A pose fix is linear: both filters are then the textbook's (P⁻¹ + R⁻¹)⁻¹."""
    state, covariance = np.array([1.0, 2.0, 0.5]), np.diag([0.5, 0.3, 0.1])
    noise = np.diag([0.2, 0.2, 0.05])
    table = np.array([[0.0, 1], [1, 1], [2, 1]])
    fix = Measurement(models.DIRECT, np.array([1.3, 1.8, 0.6]), noise, table, 3, (False, False, True))
    run = KalmanFilter(name, UNICYCLE, state, covariance, np.eye(2))
    run.step(0.0, CONTROL, HOLD, fix)
    spread = np.linalg.inv(np.linalg.inv(covariance) + np.linalg.inv(noise))
    assert run.covariance == pytest.approx(spread)
    assert run.state == pytest.approx(
        spread @ (np.linalg.solve(covariance, state) + np.linalg.solve(noise, fix.values))
    )


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_motion_jacobians(name, turn):
    motion = MOTIONS[name].extended(("range_bias_m",))
    rng = np.random.default_rng(3)
    state = rng.normal(0.0, 0.5, len(motion.states))
    state[[i for i, s in enumerate(motion.states) if s == "wz_rad_s"]] = turn
    control = np.array([0.8, turn]) if name == "unicycle" else rng.normal(0.0, 0.3, motion.controls)
    by_state, by_noise = np.zeros((len(state), len(state))), np.zeros((len(state), motion.noises))
    models.motion_jacobians(motion.model, state, control, 0.3, by_state, by_noise)
    step = 1e-6
    still = np.zeros(motion.noises)
    for j, unit in enumerate(np.eye(len(state)) * step):
        slope = moved(motion, state + unit, control, still, 0.3) - moved(motion, state - unit, control, still, 0.3)
        assert by_state[:, j] == pytest.approx(slope / (2 * step), abs=1e-8)
    for j, unit in enumerate(np.eye(motion.noises) * step):
        slope = moved(motion, state, control, unit, 0.3) - moved(motion, state, control, -unit, 0.3)
        assert by_noise[:, j] == pytest.approx(slope / (2 * step), abs=1e-8)


MEASUREMENTS = {
    "beacon_range": (models.BEACON_RANGE, [[4.0, 1, 2, 5, 7, 8, 6], [0, 9, -1, -1, -1, 8, -1]], 2),
    "landmark": (models.LANDMARK, [[4.0, 1, 7, 8], [-3, 2, -1, 8]], 4),
    "direct": (models.DIRECT, [[2.0, -1], [0, 1]], 2),
}


@pytest.mark.parametrize("name", MEASUREMENTS)
def test_a_table_of_another_width_is_refused(name):
    """The compiled models read and write without bounds: one column too few once ended in a crash elsewhere."""
    model, table, size = MEASUREMENTS[name]
    with pytest.raises(ValueError, match="parameters a row"):
        Measurement(model, np.zeros(size), np.eye(size), np.array(table)[:, :-1])


@pytest.mark.parametrize("name", MEASUREMENTS)
def test_measurement_jacobians(name):
    model, table, size = MEASUREMENTS[name]
    state, table, grid = np.linspace(0.3, 1.2, 9), np.array(table), no_map()
    slopes = np.zeros((size, 9))
    models.jacobian(model, state, table, grid, slopes)
    for j, unit in enumerate(np.eye(9) * 1e-6):
        slope = predicted(model, state + unit, table, size) - predicted(model, state - unit, table, size)
        assert slopes[:, j] == pytest.approx(slope / 2e-6, abs=1e-7)


def test_beam_slopes_of_a_plain_wall():
    """10 m before a wall across, turned by 0.3: r = 10 / cos(θ), so ∂r/∂x = -1/cos θ, ∂r/∂θ = r tan θ."""
    blocked = np.zeros((400, 400), np.uint8)
    blocked[:, 300:] = 1
    grid = GridMap(blocked, np.array([0.1, 0.0, 0.0, 0.0]))
    slopes = np.zeros((1, 3))
    table = np.array([[0.0, 0, 0, 0, 80]])
    models.jacobian(models.BEAMS, np.array([20.0, 10.0, 0.3]), table, grid, slopes)
    assert slopes[0] == pytest.approx([-1 / math.cos(0.3), 0.0, 10 * math.tan(0.3) / math.cos(0.3)], rel=1e-3, abs=1e-9)


def test_model_numbers_differ():
    motions = [models.UNICYCLE, models.HOLONOMIC, models.SUBMERSIBLE, models.CONSTANT_VELOCITY]
    motions.append(models.SUBMERSIBLE_IN_CURRENT)
    sensors = [models.BEAMS, models.BEACON_RANGE, models.LANDMARK, models.DIRECT]
    assert sorted(motions) == [0, 1, 2, 3, 4]
    assert sorted(sensors) == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_angles_cross_the_half_turn(name):
    """Sigma points, state and residual on both sides of ±π: the answer is that of the same scene turned by π."""
    results = []
    for heading in (0.0, math.pi):
        c, s = math.cos(heading), math.sin(heading)
        landmark = np.array(
            [[-4.0 * c - 0.5 * s, -4.0 * s + 0.5 * c, -1, -1]]
        )  # behind the robot: the bearing is near π, too
        bearing = wrap_angle(math.atan2(0.5, -4.0) + 0.1)
        measured = np.array([4.1, bearing])
        sight = Measurement(models.LANDMARK, measured, np.diag([0.04, 0.01]), landmark, 2, (False, True))
        run = KalmanFilter(
            name, UNICYCLE, np.array([0, 0, heading]), np.diag([0.01, 0.01, 0.09]), np.diag([0.1, 0.2]), 0.997
        )
        passed = run.step(0.1, np.array([0.5, 0.3]), HOLD, sight)
        assert passed.all()
        assert -math.pi <= run.state[2] < math.pi
        x, y = run.state[:2]
        results.append([c * x + s * y, c * y - s * x, wrap_angle(run.state[2] - heading), run.covariance[2, 2]])
    assert results[1] == pytest.approx(results[0], abs=1e-9)
    assert abs(results[0][2]) < 0.2


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_covariance_stays_positive_definite(name):
    """A start known to kilometres against ranges good to a micrometre, two thousand times."""
    table = np.array([[0.0, 0, 0, -1, -1, -1, -1]])
    run = KalmanFilter(name, UNICYCLE, np.array([5.0, 5.0, 0.1]), np.diag([1e6, 1e6, 1.0]), np.diag([1e-6, 1e-6]))
    for _ in range(2000):
        distance = predicted(models.BEACON_RANGE, run.state, table, 1)
        run.step(0.01, CONTROL, HOLD, Measurement(models.BEACON_RANGE, distance, np.array([[1e-12]]), table))
        assert (run.covariance == run.covariance.T).all()
        np.linalg.cholesky(run.covariance)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_parts_of_an_interval_share_one_draw_of_the_odometry_noise(name):
    """A straight second at 10 Hz is as uncertain whether or not other sensors cut its intervals."""
    whole, cut = (
        KalmanFilter(name, UNICYCLE, np.zeros(3), np.diag([1e-9, 1e-9, 1e-9]), np.diag([0.3, 1e-6])) for _ in range(2)
    )
    straight = np.array([1.0, 0.0])
    for _ in range(10):
        whole.step(0.1, straight, HOLD)
        for part in (0.03, 0.05, 0.02):
            cut.step(part, straight, HOLD)
    assert whole.covariance[0, 0] == pytest.approx(10 * (0.3 * 0.1) ** 2, rel=1e-3)
    assert cut.covariance[0, 0] == pytest.approx(whole.covariance[0, 0], rel=1e-3)


def test_chi_square_quantiles():
    """The tables' figures, and a probability far out."""
    known = {
        (0.95, 1): 3.8415,
        (0.95, 2): 5.9915,
        (0.95, 3): 7.8147,
        (0.997, 1): 8.8075,
        (0.99, 19): 36.1909,
        (0.05, 4): 0.7107,
    }
    for (probability, degrees), value in known.items():
        assert chi_square_quantile(probability, degrees) == pytest.approx(value, abs=1e-4)
    assert chi_square_quantile(0.9, 2) == pytest.approx(-2 * math.log(0.1))
    with pytest.raises(ValueError):
        chi_square_quantile(1.0, 1)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_gate_refuses_by_d2_and_its_own_degrees_of_freedom(name):
    """A pose fix has 3 degrees: d² of 10 passes at 0.99 (11.34), where one coordinate of d² 10 would not (6.63)."""
    table = np.array([[0.0, 1], [1, 1], [2, 1]])
    start = KalmanFilter(name, UNICYCLE, np.zeros(3), np.eye(3), np.eye(2), 0.99)
    off = np.sqrt(np.array([10.0, 0, 0]) * 2)  # S = P + R = 2 I
    fix = Measurement(models.DIRECT, off, np.eye(3), table, 3, (False, False, True))
    assert start.step(0.0, CONTROL, HOLD, fix).tolist() == [True]
    alone = KalmanFilter(name, UNICYCLE, np.zeros(3), np.eye(3), np.eye(2), 0.99)
    three = replace(fix, block=1, angles=())
    assert alone.step(0.0, CONTROL, HOLD, three).tolist() == [False, True, True]
    assert alone.state[0] == 0.0  # refused, while the others have been applied
    assert alone.covariance[1, 1] == pytest.approx(0.5)


def test_range_noise_models():
    ranges = np.array([2.0, 4.0, 12.0])
    assert RangeNoise("fixed", 0.2).variances(ranges, 6.0) == pytest.approx([0.04] * 3)
    assert RangeNoise("adaptive", 0.2, eta=1.5).variances(ranges, 6.0) == pytest.approx(
        0.06 * ranges / 6.0
    )  # (13)-(15)
    assert RangeNoise("affine", 0.2, growth=0.01).variances(ranges, 6.0) == pytest.approx(0.04 + (0.01 * ranges) ** 2)
    full = RangeNoise("adaptive", 0.2, correlation=0.3).covariance(ranges, 6.0)  # (17)
    std = np.sqrt(np.diag(full))
    assert full[0, 2] == pytest.approx(0.3 * std[0] * std[2])
    assert np.linalg.eigvalsh(RangeNoise("adaptive", 0.2).covariance(np.array([0.0, 5.0]), 2.5)).min() > 0


@pytest.mark.parametrize(
    ("correlation", "size"), [(1.0, 19), (-0.06, 19), (-1.0, 2), (1.5, 2), (math.nan, 4), (1.2, 1)]
)
def test_correlation_without_a_cholesky_factor_is_refused(correlation, size):
    with pytest.raises(LinkposeError, match="not positive definite"):
        check_correlation(correlation, size, "the correlation")
    check_correlation(-0.05, 19, "the correlation")


@pytest.mark.parametrize(
    "transform", [Transform(kappa=-1.0), Transform(alpha=0.0), Transform(alpha=1.5), Transform(beta=-1.0)]
)
def test_transform_that_cannot_work_is_refused(transform):
    with pytest.raises(LinkposeError):
        KalmanFilter("ukf", UNICYCLE, np.zeros(3), np.eye(3), np.eye(2), transform=transform)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_consistency_and_outliers_underwater(name):
    """Every outlier is found, few good ranges are refused, and the errors are as large as the filter's σ states."""
    nees, found, injected, refused, good = [], 0, 0, 0, 0
    for seed in range(3):
        errors = UnderwaterErrors(correlation_m=0.0, outliers=20)
        run = simulate_underwater(seed, errors, 20.0, synchronous=True)
        settings = Settings(
            RangeNoise("fixed", errors.range_m),
            depth_std_m=errors.depth_m,
            attitude_std_rad=errors.attitude_rad,
            velocity_std_m_s=0.06,
            start_std=(0.3, 0.05),
        )
        track = estimate_track(run.log, name, settings, None, BEACONS)
        rows = track.time_s > 2.0
        error = track.position_m[rows] - run.motion.truth.position_at(track.time_s[rows])
        nees.append(np.mean(np.einsum("ij,ijk,ik->i", error, np.linalg.inv(track.covariance[rows][:, :3, :3]), error)))
        hits = len(track.rejected_sightings & run.outliers)
        found, injected = found + hits, injected + len(run.outliers)
        refused, good = refused + len(track.rejected_sightings) - hits, good + sum(map(len, run.ranges_m.values()))
        assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.15
    assert found == injected == 60
    assert refused / good < 0.01
    assert 0.5 < np.mean(nees) / 3 < 2.0


def drive_among_beacons(scale=1.0, bias=0.0, silent=(0.0, 0.0), seed=1):
    """A circle of 60 s with exact odometry and ranges of 0.1 m, at their own times."""
    rng = np.random.default_rng(seed)
    beacons = {"1": (0.0, 0.0, 0.0), "2": (20.0, 0.0, 0.0), "3": (20.0, 20.0, 0.0), "4": (0.0, 20.0, 0.0)}
    speed, rate = 1.0, 0.2
    log = [Event(0.0, "pose", (10.0, 5.0, 0.0))]
    log += [Event(0.1 * i, "odometry", tuple(np.array([speed, rate]) + rng.normal(0, 0.02, 2))) for i in range(600)]
    for i in range(240):
        time = 0.037 + 0.25 * i
        if silent[0] <= time < silent[1]:
            continue
        place = np.array([10 + speed / rate * math.sin(rate * time), 10 - speed / rate * math.cos(rate * time)])
        name = str(1 + i % 4)
        distance = math.dist(place, beacons[name][:2])
        log.append(Event(time, "range", (scale * distance + bias + rng.normal(0, 0.1),), name))
    log.sort(key=lambda event: event.time_s)
    return log, beacons, lambda t: np.column_stack([10 + 5 * np.sin(0.2 * t), 10 - 5 * np.cos(0.2 * t)])


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_scale_and_bias_of_the_range_sensor_are_found(name):
    settings = Settings(RangeNoise("fixed", 0.1), speed_std_m_s=0.02, turn_std_rad_s=0.02)
    for word, options, value in (("scale", {"scale": 1.07}, 0.07), ("bias", {"bias": 0.4}, 0.4)):
        log, beacons, truth = drive_among_beacons(**options)
        track = estimate_track(log, name, replace(settings, estimate=(word,)), None, beacons)
        estimate, std = track.state[-1, -1], track.std[-1, -1]
        assert abs(estimate - value) < 4 * std < 0.1
        assert np.linalg.norm(track.position_m[-100:] - truth(track.time_s[-100:]), axis=1).max() < 0.2


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_rides_out_a_silence_of_the_beacons(name):
    log, beacons, truth = drive_among_beacons(silent=(15.0, 45.0))
    track = estimate_track(
        log, name, Settings(RangeNoise("fixed", 0.1), speed_std_m_s=0.02, turn_std_rad_s=0.02), None, beacons
    )
    spread = np.hypot(track.std[:, 0], track.std[:, 1])
    during, after = np.searchsorted(track.time_s, [44.9, 50.0])
    assert spread[during] > 2 * spread[after]
    error = np.linalg.norm(track.position_m - truth(track.time_s), axis=1)
    assert error[during] < 4 * spread[during]
    assert error[after:].max() < 0.3


def test_a_hopeless_log_ends_without_failure():
    """Ranges that fit nowhere: the pose is opened again and again, but never beyond what a filter can hold."""
    log, beacons, _ = drive_among_beacons(scale=7.0, bias=30.0)
    for name in ("ekf", "ukf"):
        track = estimate_track(log, name, Settings(RangeNoise("fixed", 0.01)), None, beacons)
        assert track.widened > 5
        assert np.isfinite(track.state).all()


def test_mice_drive_a_robot_that_slides(tmp_path):
    """A robot that faces along its circle's radius: all of its speed is aside, and only mice see that."""
    log, beacons, truth = drive_among_beacons()
    rows = "".join(f"{0.1 * i},{0 if i % 50 else ''},-1.0,0.2\n" for i in range(600))
    path = tmp_path / "mice.csv"
    path.write_text(f"time_s,mice_vx_m_s,mice_vy_m_s,mice_wz_rad_s\n{rows}")
    slid = with_mice_odometry(log, path)
    assert sum(isinstance(event, Event) and event.kind == "twist" for event in slid) == 588
    for name in ("ekf", "ukf"):
        settings = Settings(
            RangeNoise("fixed", 0.1), start=(10.0, 5.0, math.pi / 2), speed_std_m_s=0.02, turn_std_rad_s=0.02
        )
        track = estimate_track(slid, name, settings, None, beacons)
        assert np.linalg.norm(track.position_m - truth(track.time_s), axis=1).max() < 0.2
        assert wrap_angle(track.heading_rad[-1] - 0.2 * track.time_s[-1] - math.pi / 2) == pytest.approx(0.0, abs=0.05)
    path.write_text("time_s,mice_vx_m_s,mice_vy_m_s,mice_wz_rad_s\n1000,0,0,0\n")
    with pytest.raises(LinkposeError, match="no velocity between 0 and 59"):
        with_mice_odometry(log, path)


def test_a_wrong_start_is_opened_again():
    """Everything is refused from 6 m off; after ten refusals the pose is widened until it fits."""
    log, beacons, truth = drive_among_beacons()
    settings = Settings(RangeNoise("fixed", 0.1), start=(14.0, 9.5, 0.0), start_std=(0.1, 0.1))
    track = estimate_track(log, "ukf", settings, None, beacons)
    assert track.widened > 0
    assert np.linalg.norm(track.position_m[-100:] - truth(track.time_s[-100:]), axis=1).max() < 0.5


def tag_among_beacons(bias=0.2):
    """A tag at 1.5 m height that walks a circle of 2 m among four beacons at that height; nothing but ranges."""
    rng = np.random.default_rng(6)
    beacons = {"A1": (-4.0, -4.0, 1.5), "0xDD05": (4.0, -4.0, 1.5), "c": (4.0, 4.0, 1.5), "d": (-4.0, 4.0, 1.5)}
    log = []
    for i in range(300):
        time = 0.1 * i
        place = np.array([2.0 * math.cos(0.4 * time), 2.0 * math.sin(0.4 * time)])
        for name, (x, y, _) in beacons.items():
            distance = math.dist(place, (x, y)) + bias + rng.normal(0.0, 0.05)
            log.append(Event(time, "range", (distance,), name))
    return log, beacons


def test_a_tag_without_odometry_moves_and_finds_its_start():
    log, beacons = tag_among_beacons()
    settings = Settings(RangeNoise("fixed", 0.05), estimate=("bias",))
    for smooth in (False, True):
        track = estimate_track(log, "ekf", replace(settings, smooth=smooth), None, beacons)
        true = np.column_stack((2.0 * np.cos(0.4 * track.time_s), 2.0 * np.sin(0.4 * track.time_s)))
        error = np.linalg.norm(track.position_m - true, axis=1)
        assert np.sqrt(np.mean(error[50:] ** 2)) < (0.05 if smooth else 0.1)
        assert track.state[-1, track.names.index("range_bias_m")] == pytest.approx(0.2, abs=0.05)
        assert track.heading_rad is None
        (verdict,) = track.consistency.verdicts()
        assert 0.7 < verdict.noise_factor < 1.3


def test_a_bias_for_each_beacon_and_the_verdict_on_its_noise():
    log, beacons = tag_among_beacons(0.0)
    log = [replace(e, values=(e.values[0] + 0.3,)) if e.beacon == "0xDD05" else e for e in log]
    settings = Settings(RangeNoise("fixed", 0.05), estimate=("bias:each",))
    track = estimate_track(log, "ekf", settings, None, beacons)
    biases = [track.state[-1, track.names.index(f"range_bias_{name}_m")] for name in beacons]
    assert np.array(biases) - biases[0] == pytest.approx([0.0, 0.3, 0.0, 0.0], abs=0.08)
    small = estimate_track(log, "ekf", replace(settings, ranges=RangeNoise("fixed", 0.01), gate=None), None, beacons)
    assert "times too small" in small.consistency.verdicts()[0].sentence()
    assert {verdict.sensor for verdict in small.consistency.verdicts(each=True)} == {f"range:{b}" for b in beacons}


def test_the_figures_of_a_verdict_are_those_it_is_decided_by():
    """A few outliers raise the mean NIS, not the median: the noise of the other ranges fits."""
    found = Consistency()
    for value in np.append(np.random.default_rng(0).chisquare(1, 1000), np.full(20, 150.0)):
        found.add("range", 1, value)
    (verdict,) = found.verdicts()
    assert verdict.sentence() == "range noise fits"
    assert re.fullmatch(r"median NIS [01]\.\d\d, 1 is consistent; outliers raise the mean to 3\.\d+", verdict.figures())
    (clean,) = Consistency({"range": found.nis["range"][:1000]}, {"range": 1}).verdicts()
    assert re.fullmatch(r"median NIS [01]\.\d\d, 1 is consistent", clean.figures())
    (few,) = Consistency({"pose": [0.0]}, {"pose": 3}).verdicts()
    assert (few.sentence(), few.figures()) == ("pose noise: only 1 measurement, no verdict", "")


def test_smoothing_lowers_the_error_in_a_silence_of_the_beacons():
    log, beacons, truth = drive_among_beacons(silent=(15.0, 45.0))
    settings = Settings(RangeNoise("fixed", 0.1), speed_std_m_s=0.02, turn_std_rad_s=0.02)
    errors = []
    for smooth in (False, True):
        track = estimate_track(log, "ekf", replace(settings, smooth=smooth), None, beacons)
        rows = (track.time_s > 30.0) & (track.time_s < 45.0)
        error = track.position_m[rows] - truth(track.time_s[rows])
        errors.append(np.sqrt(np.mean(np.sum(error**2, axis=1))))
        assert np.mean(np.abs(error) < 2 * track.std[rows, :2]) > 0.9
    assert errors[1] < 0.85 * errors[0]


@pytest.mark.parametrize("probability", [1e-300, 5e-324])
@pytest.mark.parametrize("degrees", [1, 2, 5])
def test_the_quantile_of_a_vanishing_probability_is_a_vanishing_number(probability: float, degrees: int) -> None:
    """`--gate 1e-300` ended with "math domain error"."""
    assert 0.0 < chi_square_quantile(probability, degrees) < 1e-100
