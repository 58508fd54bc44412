"""Dense reference of the inertial core in plain NumPy: textbook F, H, P. Run by test_inertial_reference.py.

The kernels run here as Python (NUMBA_DISABLE_JIT=1), the same source that the compiler reads. Each check draws random
states and compares a kernel with the reference to 1e-9.
"""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
from scipy.linalg import expm

from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, ImuCalibration
from linkpose.filters._records import record_of
from linkpose.filters.inertial import (
    free_velocity,
    gravity,
    hypotheses,
    joint_velocity,
    process,
    propagate,
    report,
    rest,
    update,
)
from linkpose.filters.inertial.hypotheses import DATA_SHEET
from linkpose.filters.inertial.state import BA, BG, ESTIMATE, MA, MG, PSI, SIZE, D, V, Z, fresh_state
from linkpose.filters.joint_inertial import InertialParameters
from linkpose.sensors.rig import Imu

RUNS = 3
IMU = ImuCalibration.of(Imu(gyro_noise_rad_s=0.01))
Q = record_of(InertialParameters())[0]


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def by_matrix(reading):
    """(3, 9): derivative of M reading by the rows of M."""
    return np.kron(np.eye(3), reading)


def random_state(rng):
    """A state with random values, an orthonormal attitude and a random positive definite covariance."""
    states = fresh_state(DATA_SHEET, (0.1, -0.2, 1.0), 0.3)
    s = states[0]
    s.nominal[:PSI] = 0.1 * rng.standard_normal(PSI)
    s.nominal[D:PSI] += [0.2, 0.1, 1.0]
    axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    s.tilt[:], s.north[:] = axes[0], axes[1]
    root = 0.1 * rng.standard_normal((SIZE, SIZE))
    s.covariance[:] = root @ root.T
    return states, s


def check_propagation_of_the_covariance(rng):
    _, s = random_state(rng)
    s.span, s.turned[:] = 0.04, 0.05 * rng.standard_normal(3)
    s.rotation_variance, s.velocity_variance = 1e-5, 2e-4
    force, rate, h = rng.standard_normal(3) * 5, s.turned / 0.04, 0.04
    z, v, p = s.tilt.copy(), s.velocity.copy(), s.covariance.copy()
    turn = expm(-skew(s.turned))
    omega = np.zeros((3, SIZE))  # δω
    omega[:, BG:BA], omega[:, MG:D] = -np.eye(3), -by_matrix(rate)
    accel = np.zeros((3, SIZE))  # δf
    accel[:, BA:MA], accel[:, MA:MG] = -np.eye(3), -by_matrix(force)
    f = np.eye(SIZE)
    f[Z:V, Z:V] = turn
    f[V:BG, V:BG], f[V:BG, Z:V] = turn, -GRAVITY * h * turn
    f[Z:V] += h * skew(z) @ omega
    f[V:BG] += h * (skew(v) @ omega + accel)
    f[PSI] += h * z @ omega
    g = np.zeros((SIZE, 3))  # of a wrong rotation
    g[Z:V], g[V:BG], g[PSI] = skew(z), skew(v), z
    expected = f @ p @ f.T + 2e-5 * g @ g.T
    expected[V:BG, V:BG] += 5e-4 * np.eye(3)
    expected[BG:BA, BG:BA] += 1e-7 * np.eye(3)
    propagate.propagate_covariance(s, tuple(force), 1e-5, 3e-4, 1e-7)
    np.testing.assert_allclose(s.covariance, expected, rtol=0, atol=1e-9)


def check_the_transition_is_the_derivative_of_the_motion(rng):
    """F against finite differences of the mean's propagation, to first order in the step."""
    h, reading, force = 1e-3, rng.standard_normal(3), 5 * rng.standard_normal(3)
    states, s = random_state(rng)
    s.nominal[MA:D] = 0.0
    start = states.copy()

    def moved(change):
        trial = start.copy().view(np.recarray)[0]
        trial.nominal[:] += change
        turn = propagate.angular_rate(trial, tuple(reading))
        f = propagate.specific_force(trial, tuple(force))
        tilt, velocity, turned = trial.tilt.copy(), trial.velocity.copy(), expm(-h * skew(turn))
        return np.concatenate([turned @ tilt, turned @ velocity + h * (np.array(f) - GRAVITY * tilt)])

    small = 1e-6
    numeric = np.array([(moved(small * e) - moved(-small * e)) / (2 * small) for e in np.eye(SIZE)]).T
    rate = reading - s.nominal[BG:BA]
    s.span, s.turned[:] = h, h * np.array(propagate.angular_rate(s, tuple(reading)))
    propagate.fill_transition(s)
    readings = np.zeros((6, SIZE))  # of the errors of ω and f by those of the state
    readings[:3, BG:BA], readings[:3, MG:D] = -np.eye(3), -by_matrix(rate)
    readings[3:, BA:MA], readings[3:, MA:MG] = -np.eye(3), -by_matrix(force)
    whole = s.transition[:6, 6:12] @ readings
    whole[:, :6] += s.transition[:6, :6]
    np.testing.assert_allclose(whole[:, :PSI], numeric[:, :PSI], rtol=0, atol=1e-4)


def dense_update(p, h, noise, innovation):
    s = h @ p @ h.T + noise
    gain = p @ h.T @ np.linalg.inv(s)
    joseph = np.eye(SIZE) - gain @ h
    return gain @ innovation, joseph @ p @ joseph.T + gain @ noise @ gain.T


def corrected(nominal, change):
    """The nominal state after an update: ‖Z‖ = 1, ψ moved into X."""
    out = nominal + change
    out[Z:V] /= np.linalg.norm(out[Z:V])
    out[PSI] = 0.0
    return out


def unconstrained(s):
    """Scale the covariance so that the constraint ‖Z‖ = 1, which a dense update ignores, does not apply."""
    s.covariance[:] += np.diag(np.repeat([1.0, 0.0], [3, SIZE - 3]))


def check_the_vector_update(rng):
    _, s = random_state(rng)
    unconstrained(s)
    h, innovation = np.zeros((3, SIZE)), rng.standard_normal(3)
    h[:, V : MG + 2] = rng.standard_normal((3, MG + 2 - V))
    root = rng.standard_normal((3, 3))
    noise, nominal, p = root @ root.T + np.eye(3), s.nominal.copy(), s.covariance.copy()
    change, covariance = dense_update(p, h, noise, innovation)
    s.jacobian[:] = h
    update.project(s)
    upper = np.linalg.inv(h @ p @ h.T + noise)[np.triu_indices(3)]
    update.update_vector(s, tuple(innovation), tuple(upper))
    np.testing.assert_allclose(s.covariance, covariance, rtol=0, atol=1e-9)
    np.testing.assert_allclose(s.nominal, corrected(nominal, change), rtol=0, atol=1e-9)


def check_the_scalar_update(rng):
    _, s = random_state(rng)
    nominal, p, k = s.nominal.copy(), s.covariance.copy(), int(BG) + 1
    h = np.eye(SIZE)[[k]]
    change, covariance = dense_update(p, h, np.array([[0.3]]), np.array([0.7]))
    update.update_scalar(s, k, 0.7, 0.3)
    np.testing.assert_allclose(s.covariance, covariance, rtol=0, atol=1e-9)
    np.testing.assert_allclose(s.nominal, nominal + change, rtol=0, atol=1e-9)


def check_the_joint_constraint(rng):
    """All components clear of the noise: the extended Kalman update, with the excited rotation in front of δd."""
    _, s = random_state(rng)
    unconstrained(s)
    reading = s.gyro_bias + np.array([2.0, -1.5, 1.0])
    s.spread[:] = 1e3 * np.eye(3)
    s.residual_square[:], s.reach_square, s.assumed = (0.01, 0.02, 0.03), 1.0, 0.0
    nominal, p, d, m = s.nominal.copy(), s.covariance.copy(), s.j2s.copy(), s.nominal[MG:D].reshape(3, 3)
    rate = (np.eye(3) - m) @ (reading - s.gyro_bias)
    h = np.zeros((3, SIZE))
    h[:, V:BG] = np.eye(3)
    h[:, BG:BA], h[:, MG:D] = -skew(d), -skew(d) @ by_matrix(reading - s.gyro_bias)
    interval, spread = 0.04, s.spread.copy()
    joint_velocity.follow_spread(spread, tuple(rate), interval)
    excited = np.array(joint_velocity.excited_part(spread, tuple(rate), IMU.gyro_variance))
    h[:, D:PSI] = -skew(excited)
    product = 0.5 * np.trace(p[BG:BA, BG:BA]) * np.trace(p[D:PSI, D:PSI])
    floor, reach = Q.velocity_floor_m_s**2, (rate @ rate) * (d @ d)
    lasting = 2.0 * Q.residual_correlation_s / interval - 1.0
    excess = reach * (s.residual_square + lasting * (s.residual_square - Q.least_residual**2))
    noise = (product + floor) * np.eye(3) + np.diag(excess) + IMU.gyro_variance * skew(d) @ skew(d).T
    noise += skew(rate - excited) @ p[D:PSI, D:PSI] @ skew(rate - excited).T
    q = Q.copy()
    q.residual_time_s = 1e15  # nothing is measured
    change, covariance = dense_update(p, h, noise, np.cross(rate, d) - s.velocity)
    assert joint_velocity.update_joint_velocity(s, False, (0.0, 0.0, 0.0), tuple(reading), interval, IMU, q)
    np.testing.assert_allclose(s.covariance, covariance, rtol=0, atol=1e-9)
    np.testing.assert_allclose(s.nominal, corrected(nominal, change), rtol=0, atol=1e-9)


def check_the_excited_part(rng):
    """G = S² (S² + τ² I)⁻¹ by an eigendecomposition."""
    root = rng.standard_normal((3, 3))
    spread, rate = root @ root.T * [1.0, 1.0, 1.0], rng.standard_normal(3)
    threshold = joint_velocity.CLEAR * 1e-4 + 0.0025 * np.trace(spread)
    values, vectors = np.linalg.eigh(spread)
    expected = vectors @ np.diag(values**2 / (values**2 + threshold**2)) @ vectors.T @ rate
    np.testing.assert_allclose(joint_velocity.excited_part(spread, tuple(rate), 1e-4), expected, rtol=0, atol=1e-9)


def check_the_free_velocity(rng):
    _, s = random_state(rng)
    unconstrained(s)
    s.speed_square, nominal, p = 0.04, s.nominal.copy(), s.covariance.copy()
    q = record_of(InertialParameters(has_joint=0.0, suspect=1e9))[0]
    h = np.zeros((3, SIZE))
    h[:, V:BG] = np.eye(3)
    change, covariance = dense_update(p, h, 0.04 * 2 * q.least_correlation_s / 0.04 * np.eye(3), -s.velocity)
    free_velocity.update_free_velocity(s, 0.04, q)
    np.testing.assert_allclose(s.covariance, covariance, rtol=0, atol=1e-9)
    np.testing.assert_allclose(s.nominal, corrected(nominal, change), rtol=0, atol=1e-9)


def check_the_gyro_bias_at_rest(rng):
    """Three scalar updates by independent axes are the vector update of all."""
    _, s = random_state(rng)
    s.nominal[BG:BA] = 0.01
    s.rest_s, s.rest_rate_sum[:] = 2.0, 2.0 * 0.01 + 0.001 * rng.standard_normal(3)
    nominal, p, h = s.nominal.copy(), s.covariance.copy(), np.eye(SIZE)[BG:BA]
    innovation = s.rest_rate_sum / 2.0 - nominal[BG:BA]
    change, _ = dense_update(p, h, (0.04 * IMU.gyro_variance / 2.0 + (5e-4 / 2.0) ** 2) * np.eye(3), innovation)
    rest.update_bias_from_rest(s, 0.04, IMU)
    np.testing.assert_allclose(s.nominal[V:PSI], (nominal + change)[V:PSI], rtol=0, atol=1e-9)


def check_the_tilt_at_rest(rng):
    """f̂ − g Ẑ = g δZ + δb_a + δM_a s_A + e."""
    _, s = random_state(rng)
    unconstrained(s)
    s.nominal[MA:MG] = 0.0
    force, nominal, p = (
        GRAVITY * s.tilt + s.accel_bias + 0.01 * rng.standard_normal(3),
        s.nominal.copy(),
        s.covariance.copy(),
    )
    s.rest_s, s.rest_force_sum[:] = 2.0, 2.0 * force
    h = np.zeros((3, SIZE))
    h[:, Z:V], h[:, BA:MA], h[:, MA:MG] = GRAVITY * np.eye(3), np.eye(3), by_matrix(force)
    noise = (IMU.accel_variance * 0.04 / 2.0 + (0.05 / 2.0) ** 2) * np.eye(3) + 0.25 * np.outer(s.tilt, s.tilt)
    change, covariance = dense_update(p, h, noise, force - nominal[BA:MA] - GRAVITY * nominal[Z:V])
    rest.update_tilt_from_rest(s, 0.04, IMU)
    np.testing.assert_allclose(s.covariance, covariance, rtol=0, atol=1e-9)
    np.testing.assert_allclose(s.nominal, corrected(nominal, change), rtol=0, atol=1e-9)


def check_the_heading(rng):
    """ψ = h Zᵀδω, applied to X, gives the X of a sensor whose rate was known to be off by δω along Z."""
    _, s = random_state(rng)
    off = 1e-6 * s.tilt
    _, true = random_state(rng)
    true.tilt[:], true.north[:] = s.tilt, s.north
    propagate.rotate_attitude(true, vec.turn_of(tuple(off)))
    s.nominal[PSI] = s.tilt @ off
    update.constrain_attitude(s)
    np.testing.assert_allclose(s.north, true.north, rtol=0, atol=1e-9)


def check_the_relation_of_heading_and_tilt(rng):
    """ψ between the heading axis of a Z that is a little off and X as an update of Z turns it."""
    _, s = random_state(rng)
    s.north[:] = gravity.heading_axis(tuple(s.tilt))
    s.covariance[PSI] = s.covariance[:, PSI] = 0.0
    p = s.covariance.copy()
    gravity.relate_heading(s)
    slope, small = np.zeros(3), 1e-6
    for k in range(3):
        tilt = s.tilt + small * np.eye(3)[k]
        tilt /= np.linalg.norm(tilt)
        updated = s.north - (s.north @ tilt) * tilt
        slope[k] = -np.cross(tilt, updated) @ np.array(gravity.heading_axis(tuple(tilt))) / small
    np.testing.assert_allclose(s.covariance[PSI, :PSI], slope @ p[Z:V, :PSI], rtol=0, atol=1e-4)
    np.testing.assert_allclose(s.covariance[PSI, PSI], slope @ p[Z:V, Z:V] @ slope, rtol=0, atol=1e-4)


def check_the_alignment_to_gravity(rng):
    """δZ = (I − ZZᵀ)(δf + a)/g, with δf from the accelerometer's errors."""
    _, s = random_state(rng)
    reading, p = 9.81 * s.tilt + 0.1 * rng.standard_normal(3), s.covariance.copy()
    gravity.align_to_gravity(s, tuple(reading), 0.02, (0.1, 0.2, 0.3), 0.5)
    z = s.tilt
    across = np.eye(3) - np.outer(z, z)
    errors = np.zeros((3, SIZE))
    errors[:, BA:MA], errors[:, MA:MG] = -np.eye(3), -by_matrix(reading)
    lean = across @ errors / GRAVITY
    expected = lean @ p @ lean.T + 0.02 / GRAVITY**2 * across
    np.testing.assert_allclose(s.covariance[Z:V, Z:V], expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(s.covariance[Z:V, BG:], lean @ p[:, BG:], rtol=0, atol=1e-9)
    np.testing.assert_allclose(s.covariance[V:BG, V:BG], 0.5 * np.eye(3), rtol=0, atol=1e-9)


def check_the_levels_of_the_sensor_errors(rng):
    """Errors drawn as their prior says have a level of 1 in the mean, whatever share of them the motion resolves."""
    _, s = random_state(rng)
    prior, share = s.prior[BA:D], rng.uniform(0.3, 1.0, D - BA)
    s.covariance[range(BA, D), range(BA, D)] = (1 - share) * prior
    levels = []
    for _ in range(400):
        s.nominal[BA:D] = np.sqrt(share * prior) * rng.standard_normal(D - BA)
        process._judge_parameters(s)
        levels.append((s.tilt_level, s.heading_level))
    assert np.abs(np.mean(levels, axis=0) - 1).max() < 0.1
    known = process._LEVEL_PRIOR
    s.nominal[BA:MG], s.nominal[MG:D] = 0.0, 3.0 * np.sqrt(s.prior[MG:D])
    process._judge_parameters(s)
    np.testing.assert_allclose(s.tilt_level, known / (known + share[: MG - BA].sum()), rtol=1e-9)
    np.testing.assert_allclose(s.heading_level, (known + 81.0) / (known + share[MG - BA :].sum()), rtol=1e-9)
    np.testing.assert_allclose(s.distance, 0.5 * 81.0, rtol=1e-9)


def check_which_sensor_decides_the_level_of_a_value(rng):
    row = empty_row()
    row.tilt_level, row.heading_level = rng.uniform(0.3, 3.0, 2)
    of_height, of_x, of_y, of_roll, of_pitch, of_yaw = (hypotheses._level(row, k, 0.0) for k in range(6))
    assert of_height == of_roll == of_pitch == row.tilt_level and of_yaw == row.heading_level
    assert of_x == of_y == 0.5 * (row.tilt_level + row.heading_level)
    assert hypotheses._level(row, 0, 5.0) == hypotheses._MOST_LEVEL


def empty_row():
    """A row of ESTIMATE; a record of NumPy has a method `std`."""
    return SimpleNamespace(**{name: np.zeros(ESTIMATE[name].shape) for name in ESTIMATE.names})


def check_the_reported_stds(rng):
    """σ of each reported value, by finite differences of the value, and at a later attitude: those of that attitude."""
    states, s = random_state(rng)
    across = np.eye(SIZE)
    across[Z:V, Z:V] -= np.outer(s.tilt, s.tilt)
    s.covariance[:] = 1e-4 * across @ s.covariance @ across
    s.time = s.turned_at = 1.0
    later, begin = 0.3 * rng.standard_normal(3), states.copy()

    def reported(change, rotation):
        trial, row = begin.copy().view(np.recarray)[0], empty_row()
        trial.nominal[:] += change
        update.constrain_attitude(trial)
        propagate.rotate_attitude(trial, vec.turn_of(tuple(rotation)))
        report.report(trial, 1.0, IMU, row)
        return row.value

    small = 1e-6
    for rotation in (np.zeros(3), later):
        gradient = np.array(
            [(reported(small * e, rotation) - reported(-small * e, rotation)) / (2 * small) for e in np.eye(SIZE)]
        ).T
        propagate.rotate_attitude(s, vec.turn_of(tuple(rotation)))
        row = empty_row()
        report.report(s, 1.0, IMU, row)
        turn = np.zeros((SIZE, 3))  # by a rotation about each axis, as in `add_noise`
        turn[Z:V], turn[PSI] = skew(begin[0].nominal[Z:V]), begin[0].nominal[Z:V]
        gained = s.rotation_variance + s.span**2 * np.trace(begin[0].covariance[BG:BA, BG:BA]) / 3
        whole = begin[0].covariance + gained * turn @ turn.T
        np.testing.assert_allclose(row.std, np.sqrt(np.diag(gradient @ whole @ gradient.T)), rtol=1e-6)
        s.span, s.rotation_variance = 0.01, 1e-5  # from here on the covariance is that of an earlier sample


if __name__ == "__main__":
    for name, check in list(globals().items()):
        if name.startswith("check_"):
            for seed in range(RUNS):
                check(np.random.default_rng(seed))
            sys.stdout.write(f"{name}\n")
