"""Localization among beacons: noises from the log, robots that are carried, slow fixes, constants of the ranges."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from linkpose.cli.localize import command
from linkpose.errors import AmbiguousStart, MissingStart
from linkpose.localization.events import Event, Log, format_event, write_lines
from linkpose.localization.likelihood import run_filter
from linkpose.localization.localizer import Method, estimate_track
from linkpose.localization.noise import RangeNoise
from linkpose.localization.options import LocalizationOptions
from linkpose.localization.paths import localize
from linkpose.localization.settings import Settings
from linkpose.localization.stream import Stream
from linkpose.localization.tables import Truth, score_track
from linkpose.localization.tuning import LEAST_TURN_RAD_S, TUNABLE, correlation_time, described, tune, warm_up

BEACONS = {"1": (0.0, 0.0, 0.0), "2": (20.0, 0.0, 0.0), "3": (20.0, 20.0, 0.0), "4": (0.0, 20.0, 0.0)}
STEP_S = 0.1


def circle(time_s: float) -> tuple[float, float, float]:
    """The true pose: 1 m/s on a circle of 6 m around (10, 10) m."""
    angle = time_s / 6.0
    return 10.0 + 6.0 * math.cos(angle), 10.0 + 6.0 * math.sin(angle), angle + math.pi / 2


def drive(
    seed: int,
    duration_s: float = 200.0,
    range_std: float = 0.1,
    carried: tuple[float, float] | None = None,
    bearings: bool = False,
    persists_s: float = 0.0,
    offsets: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
    is_common: bool = False,
) -> tuple[Log, Truth]:
    """Odometry at 10 Hz (0.02 m/s, 0.02 rad/s) and ranges at 2 Hz, beacon after beacon.

    From `carried` = (time, so much s) on, the robot goes on from where it would be that much later. `persists_s` is the
    time constant of the ranges' error, one of each beacon or, with `is_common`, one of all with white noise of a third.
    """
    rng = np.random.default_rng(seed)
    log: Log = [Event(0.0, "pose", circle(0.0))]
    errors = dict.fromkeys(BEACONS, 0.0)
    rows = []
    for k in range(int(duration_s / STEP_S)):
        time = k * STEP_S
        pose = circle(time + (carried[1] if carried and time >= carried[0] else 0.0))
        rows.append((time, *pose))
        log.append(Event(time, "odometry", (1.0 + rng.normal(0, 0.02), 1.0 / 6.0 + rng.normal(0, 0.02))))
        if k % 5 == 2:
            for name in list(BEACONS) if persists_s else [str(1 + (k // 5) % 4)]:
                x, y, _ = BEACONS[name]
                keep = math.exp(-0.5 / persists_s) if persists_s else 0.0
                if not is_common or name == "1":
                    errors[name] = keep * errors[name] + math.sqrt(1 - keep**2) * rng.normal(0, range_std)
                error = errors["1"] + rng.normal(0, range_std / 3) if is_common else errors[name]
                distance = math.hypot(x - pose[0], y - pose[1]) + error + offsets[int(name) - 1]
                bearing = math.remainder(math.atan2(y - pose[1], x - pose[0]) - pose[2] + rng.normal(0, 0.02), math.tau)
                if bearings:
                    log.append(Event(time, "bearing_range", (distance, bearing), name))
                else:
                    log.append(Event(time, "range", (distance,), name))
    table = np.array(rows)
    return log, Truth(table[:, 0], table[:, 1:3], np.unwrap(table[:, 3]))


def changed(log: Log, kind: str, change: Callable[[Event], Event]) -> Log:
    return [change(event) if isinstance(event, Event) and event.kind == kind else event for event in log]


def scaled(*factors: float) -> Callable[[Event], Event]:
    return lambda event: replace(event, values=tuple(np.multiply(event.values, factors).tolist()))


def exchanged(event: Event) -> Event:
    return replace(event, beacon={"1": "2", "2": "1"}.get(event.beacon, event.beacon))


ODOMETRY = "of the odometry is"
DOUBTED = {
    "nothing": ("odometry", scaled(1.0, 1.0), ""),
    "turned the other way": ("odometry", scaled(1.0, -1.0), ODOMETRY),
    "backwards": ("odometry", scaled(-1.0, 1.0), ODOMETRY),
    "radians of radians": ("odometry", scaled(1.0, math.pi / 180), ODOMETRY),
    "no turn rate": ("odometry", scaled(1.0, 0.0), ODOMETRY),
    "exchanged columns": ("odometry", lambda event: replace(event, values=event.values[::-1]), ODOMETRY),
    "feet": ("range", scaled(1 / 0.3048), "times too long"),
    "exchanged beacons": ("range", exchanged, "check"),
}


@pytest.mark.parametrize("fault", DOUBTED)
@pytest.mark.parametrize("seed", [3, 4])
def test_noises_and_constants_that_no_sensor_has_are_doubted(seed: int, fault: str) -> None:
    """Estimated from the log, they explained wrong signs, units and columns, and the path was wrong in silence."""
    kind, change, sentence = DOUBTED[fault]
    log, _ = drive(seed)
    remarks = localize(changed(log, kind, change), beacons=BEACONS).remarks
    doubted = [remark for remark in remarks if "check" in remark.lower()]
    assert any(sentence in remark for remark in doubted) if sentence else not doubted


def settings(**others: object) -> Settings:
    return replace(Settings(ranges=RangeNoise("affine", 0.1)), **others)  # type: ignore[arg-type]


def test_noises_are_estimated_from_the_log_and_make_the_filter_consistent() -> None:
    """Ranges five times as noisy as assumed and odometry five times better: found within a third."""
    log, truth = drive(1, range_std=0.5)
    warm_up()
    tuned = tune(log, settings(), BEACONS, TUNABLE)
    assert math.hypot(tuned.ranges.std_m, 14.0 * tuned.ranges.growth) == pytest.approx(0.5, rel=0.35)
    assert len(run_filter.signatures) == 1  # nothing is left to compile after the message of compiling
    assert tuned.turn_std_rad_s < 0.05
    assert tuned.error_time_s == tuned.drift_std_m == 0.0
    assert tuned.turn_std_rad_s >= LEAST_TURN_RAD_S
    assumed, found = (score_track(estimate_track(log, "ekf", s, None, BEACONS), truth) for s in (settings(), tuned))
    assert found.position_rmse_m < 0.8 * assumed.position_rmse_m
    assert found.within_2_sigma is not None and found.within_2_sigma > 0.88


def test_errors_that_persist_become_states_or_count_less() -> None:
    """Four beacons twice a second whose errors persist for 5 s: without that, σ is several times too small.

    A stream, to whose filter no states can be added, has their correlation time.
    """
    log, truth = drive(2, range_std=0.3, persists_s=5.0)
    drifting = tune(log, settings(), BEACONS, TUNABLE)
    assert (drifting.drift_std_m, drifting.drift_time_s) == pytest.approx((0.3, 5.0), rel=0.4)
    stream = tune(log, settings(), BEACONS, tuple(name for name in TUNABLE if name != "drift"))
    assert stream.error_time_s is not None and 3.0 < stream.error_time_s < 20.0
    white = replace(stream, error_time_s=0.0)
    for smooth in (False, True):
        tracks = [
            estimate_track(log, "ekf", replace(each, smooth=smooth), None, BEACONS)
            for each in (drifting, stream, white)
        ]
        assert tracks[0].names == ("x_m", "y_m", "heading_rad")
        shares = [score_track(track, truth).within_2_sigma or 0.0 for track in tracks]
        assert shares[0] > 0.93
        assert min(shares[:2]) > shares[2] + 0.15


def test_an_error_that_all_beacons_share_is_one_state() -> None:
    """As in Table 2.8 of the thesis. It hardly moves the path, and σ of the path shows that."""
    log, truth = drive(3, 100.0, range_std=0.3, persists_s=2.0, is_common=True)
    found = tune(log, settings(), BEACONS, TUNABLE)
    assert found.drift_is_shared and "in common" in described(found, log)
    assert (found.drift_std_m, found.drift_time_s) == pytest.approx((0.3, 2.0), rel=0.4)
    score = score_track(estimate_track(log, "ekf", found, None, BEACONS), truth)
    assert score.position_rmse_m < 0.1
    assert score.within_2_sigma is not None and score.within_2_sigma > 0.9


def test_the_correlation_time_of_white_errors_is_zero_and_of_a_gauss_markov_process_twice_its_time_constant() -> None:
    rng = np.random.default_rng(3)
    white = rng.normal(size=4000)
    markov = np.zeros(4000)
    keep = math.exp(-0.1 / 2.0)
    for k in range(1, 4000):
        markov[k] = keep * markov[k - 1] + math.sqrt(1 - keep**2) * white[k]
    events = [Event(0.1 * k, "range", (1.0,), "1") for k in range(4000)]
    assert correlation_time(events, np.column_stack((white, white))) == 0.0
    assert correlation_time(events, np.column_stack((markov, white))) == pytest.approx(4.0, rel=0.4)


def test_too_few_measurements_leave_the_noises_as_they_are() -> None:
    log, _ = drive(4, duration_s=30.0)
    assert tune(log, given := settings(), BEACONS, TUNABLE) is given


@pytest.mark.parametrize("bearings", [False, True])
@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_a_robot_that_was_carried_among_beacons_is_found_again(name: str, bearings: bool) -> None:
    """Carried to the other side of the circle: found within 5 s of the third range that contradicts (two a second)."""
    log, truth = drive(5, duration_s=80.0, carried=(40.0, 19.0), bearings=bearings)
    track = estimate_track(log, name, settings(turn_std_rad_s=0.03, speed_std_m_s=0.03), None, BEACONS)  # type: ignore[arg-type]
    error = np.linalg.norm(track.position_m - truth.position_at(track.time_s), axis=1)
    assert track.relocated >= 1
    assert np.max(error[track.time_s < 39.9]) < 0.5
    assert np.max(error[track.time_s > 40.0 + 1.5 + 5.0]) < 1.0


def test_one_beacon_with_a_fault_does_not_relocate_the_robot() -> None:
    """Beacon 2 reads 3 m long from 40 s on, the others are sound."""
    log, truth = drive(6, duration_s=80.0)
    faulty = [
        replace(event, values=(event.values[0] + 3.0,))
        if isinstance(event, Event) and event.beacon == "2" and event.time_s > 40.0
        else event
        for event in log
    ]
    track = estimate_track(faulty, "ekf", settings(turn_std_rad_s=0.03, speed_std_m_s=0.03), None, BEACONS)
    assert track.relocated == 0
    assert score_track(track, truth).position_max_m < 0.5


def test_the_unscented_filter_survives_what_the_extended_one_survives() -> None:
    """Fixes every 7 s under water, and 90 s without any: headings of sigma points spread around the circle."""
    rng = np.random.default_rng(7)
    log: Log = [Event(0.0, "pose", (60.0, 0.0, math.pi / 2))]
    truth = []
    beacons = {"1": (0.0, 0.0, 0.0), "2": (200.0, 0.0, 0.0), "3": (0.0, 200.0, 0.0)}
    for time in [7.0 * k for k in range(60) if not 20 <= k < 33]:
        angle = 0.5 * time / 60.0
        x, y, heading = 60.0 * math.cos(angle), 60.0 * math.sin(angle), angle + math.pi / 2
        truth.append((time, x, y, heading))
        log.append(Event(time, "attitude", (0.0, 0.0, heading + rng.normal(0, 0.01))))
        log.append(Event(time, "depth", (0.0,)))
        for name, (bx, by, _) in beacons.items():
            log.append(Event(time, "range", (math.hypot(x - bx, y - by) + rng.normal(0, 1.0),), name))
        log.append(Event(time, "velocity", (0.5, 0.0, 0.0)))
    table = np.array(truth)
    path = Truth(table[:, 0], table[:, 1:3], None)
    rms = {}
    for name in ("ekf", "ukf"):
        track = estimate_track(log, name, settings(ranges=RangeNoise("fixed", 1.0)), None, beacons)  # type: ignore[arg-type]
        error = np.linalg.norm(track.position_m[:, :2] - path.position_at(track.time_s), axis=1)
        rms[name] = float(np.sqrt(np.mean(error[(track.time_s < 130.0) | (track.time_s > 260.0)] ** 2)))
    assert rms["ukf"] < 1.1 * rms["ekf"] < 4.0


@pytest.mark.parametrize("bearings", [False, True])
def test_the_bias_of_each_beacon_is_estimated_with_an_honest_deviation(bearings: bool) -> None:
    offsets = (0.5, -0.3, 0.0, 0.8)
    log, truth = drive(8, offsets=offsets, bearings=bearings)
    tuned = tune(log, settings(estimate=("bias:each",)), BEACONS, TUNABLE)
    track = estimate_track(log, "ekf", tuned, None, BEACONS)
    for name, offset in zip(BEACONS, offsets, strict=True):
        at = track.names.index(f"range_bias_{name}_m")
        assert abs(track.state[-1, at] - offset) < max(3.0 * track.std[-1, at], 0.1)
        assert track.std[-1, at] < 0.15
    one = estimate_track(log, "ekf", replace(tuned, estimate=("bias",)), None, BEACONS)
    assert score_track(track, truth).position_rmse_m < 0.6 * score_track(one, truth).position_rmse_m


def test_scale_and_bias_of_landmark_ranges_are_estimated() -> None:
    log, _ = drive(9, bearings=True)
    longer = [
        replace(event, values=(1.05 * event.values[0] + 0.2, event.values[1]))
        if isinstance(event, Event) and event.kind == "bearing_range"
        else event
        for event in log
    ]
    track = estimate_track(longer, "ekf", settings(estimate=("scale", "bias"), turn_std_rad_s=0.05), None, BEACONS)
    values = dict(zip(track.names, zip(track.state[-1], track.std[-1], strict=True), strict=True))
    for name, true in (("range_scale_error", 0.05), ("range_bias_m", 0.2)):
        value, std = values[name]
        assert abs(value - true) < 3.0 * std
    assert values["range_scale_error"][1] < 0.02


def test_the_command_reports_the_noises_it_found_and_draws_the_path(tmp_path) -> None:
    log, _ = drive(1, duration_s=80.0, range_std=0.5)
    rows = [format_event(event) for event in log if isinstance(event, Event)]
    write_lines(tmp_path / "log.csv", ["time_s,kind,a,b,c", *rows], force=False)
    places = [f"{name},{x},{y}" for name, (x, y, _) in BEACONS.items()]
    write_lines(tmp_path / "beacons.csv", ["id,x_m,y_m", *places], force=False)
    picture = tmp_path / "path.png"
    done = CliRunner().invoke(
        command, [str(tmp_path / "log.csv"), "--beacons", str(tmp_path / "beacons.csv"), "--plot", str(picture)]
    )
    assert done.exit_code == 0, done.output
    assert "noises estimated from the log: range " in done.output
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = CliRunner().invoke(
        command, [str(tmp_path / "log.csv"), "--beacons", str(tmp_path / "beacons.csv"), "--plot", str(picture)]
    )
    assert "exists" in str(again.exception or again.output)


def test_a_stream_estimates_errors_that_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    """From 300 ranges on, their drifts are states: σ of the rows is as large as the errors, unlike without them."""
    monkeypatch.setattr("linkpose.localization.stream.TUNED_AFTER", (200,))
    log, truth = drive(2, duration_s=70.0, range_std=0.3, persists_s=5.0)
    lines = ["time_s,kind,a,b,c\n", *(format_event(event) + "\n" for event in log if isinstance(event, Event))]
    known = LocalizationOptions(speed_std_m_s=0.02, turn_std_rad_s=0.02, range_growth=0.0, estimate=())
    shares = []
    for options in (known, replace(known, drift_std_m=0.0, error_time_s=0.0)):
        reports: list[str] = []
        stream = Stream("ekf", options, BEACONS, reports.append)
        rows = list(stream.rows(lines))
        assert stream.run is not None and len(rows[-1].state) == len(stream.run.states) == 3
        track = stream.run.track([row for row in rows if row.time_s > 40.0])
        shares.append(score_track(track, truth).within_2_sigma or 0.0)
    assert shares[0] > 0.9 > shares[1] + 0.2


@pytest.mark.parametrize("depth_m", [0.5, 0.0])
def test_a_tag_beside_anchors_near_one_line_is_not_mirrored_in_silence(depth_m: float) -> None:
    """The first ranges fit both sides. The rest of the log decides where the anchors are 0.5 m off their line."""
    rng = np.random.default_rng(4)
    anchors = {"A": (0.0, 0.0), "B": (4.0, depth_m), "C": (8.0, 0.0), "D": (12.0, depth_m)}
    log: Log = []
    for i in range(1200):
        time_s, (name, (x, y)) = i / 20.0, list(anchors.items())[i % 4]
        distance = math.hypot(6.0 + 4.0 * math.sin(0.1 * time_s) - x, 5.0 + 2.0 * math.cos(0.17 * time_s) - y)
        outlier = rng.exponential(0.7) if rng.random() < 0.1 else 0.0
        log.append(Event(time_s, "range", (distance + rng.normal(0.0, 0.08) + outlier,), name))
    if depth_m == 0.0:
        with pytest.raises(AmbiguousStart, match="near one line"):
            localize(log, beacons=anchors)
        return
    paths = localize(log, beacons=anchors, drift_std_m=0.0)
    assert any("fits the log better than its mirror image" in remark for remark in paths.remarks)
    assert paths.ekf.position_m[-1, 1] == pytest.approx(5.0 + 2.0 * math.cos(0.17 * 59.95), abs=0.4)


def walk(seed: int, fixes: int, every_s: float, at_once: bool = True) -> tuple[Log, Truth]:
    """A tag that walks at 1 m/s from one place among BEACONS to the next, without odometry: a range to each beacon, at
    one instant or in turn, every so many seconds (σ 0.1 m).
    """
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, fixes * every_s + 0.1, 0.1)
    path, place, goal = [], np.array([5.0, 8.0]), np.array([5.0, 8.0])
    for _ in times:
        path.append(place)
        left = goal - place
        if np.linalg.norm(left) < 0.15:
            goal = rng.uniform(2.0, 18.0, 2)
        else:
            place = place + 0.1 * left / np.linalg.norm(left)
    log: Log = []
    for i in range(fixes * (1 if at_once else 4)):
        time = 0.03 + i * every_s / (1.0 if at_once else 4.0)
        at = np.array([np.interp(time, times, column) for column in np.array(path).T])
        for name in list(BEACONS) if at_once else [str(1 + i % 4)]:
            distance = float(np.linalg.norm(at - BEACONS[name][:2])) + rng.normal(0.0, 0.1)
            log.append(Event(time, "range", (distance,), name))
    return log, Truth(times, np.array(path), None)


@pytest.mark.parametrize(("name", "smooth"), [("ekf", False), ("ekf", True), ("ukf", False), ("ukf", True)])
def test_a_tag_is_placed_by_a_fix_every_ten_seconds(name: Method, smooth: bool) -> None:
    """The tag may be anywhere in the area by then, where one extended filter was 2 to 7 m off and stated 0.5 m, and one
    unscented filter ended hundreds of metres away.
    """
    errors, shares = [], []
    for seed in range(4):
        log, truth = walk(seed, 60, 10.0)
        track = estimate_track(log, name, settings(estimate=("scale", "bias"), smooth=smooth), None, BEACONS)
        score = score_track(track, truth)
        errors.append(score.position_rmse_m)
        shares.append(score.within_2_sigma or 0.0)
    assert max(errors) < 0.3  # a fit of each fix alone, of ranges without errors that persist: 0.11 m
    assert np.mean(shares) > 0.9


def test_a_tag_that_ranges_to_one_beacon_every_three_seconds_needs_no_start() -> None:
    """No fix places it: the first ranges are circles, and the stated σ says so."""
    for seed in range(3):
        log, truth = walk(seed, 40, 12.0, at_once=False)
        noises = settings(acceleration_std_m_s2=0.3)
        track = estimate_track(log, "ekf", noises, None, BEACONS)
        assert track.std[0, :2].min() > 3.0
        score = score_track(track, truth)
        late = np.linalg.norm(track.position_m[80:] - truth.position_at(track.time_s[80:]), axis=1)
        assert float(np.sqrt(np.mean(late**2))) < 3.5  # the middle of the area: 6 m
        assert score.within_2_sigma is not None and score.within_2_sigma > 0.9
    near_line = {name: (x, 0.01 * y, 0.0) for name, (x, y, _) in BEACONS.items()}
    with pytest.raises(MissingStart):
        estimate_track(log, "ekf", noises, None, near_line)


def test_a_stream_of_a_tag_that_ranges_to_one_beacon_every_three_seconds_needs_no_start() -> None:
    """Its first pose comes with the range to the third beacon: until then, the whole plane fits."""
    log, truth = walk(1, 25, 12.0, at_once=False)
    lines = ["time_s,kind,a,b,c\n", *(format_event(event) + "\n" for event in log if isinstance(event, Event))]
    options = LocalizationOptions(range_std_m=0.1, range_growth=0.0, acceleration_std_m_s2=0.3, drift_std_m=0.0)
    stream = Stream("ekf", options, BEACONS, lambda line: None)
    rows = list(stream.rows(lines))
    assert stream.run is not None and len(rows) == len(log)
    score = score_track(stream.run.track(rows), truth)
    assert score.within_2_sigma is not None and score.within_2_sigma > 0.9
    with pytest.raises(MissingStart):
        list(Stream("ekf", options, BEACONS, lambda line: None).rows(lines[:3]))


def test_a_range_of_metres_too_much_counts_as_an_outlier_between_slow_fixes() -> None:
    log, truth = walk(9, 40, 10.0)
    wrong = [replace(e, values=(e.values[0] + 4.0,)) if i % 9 == 4 else e for i, e in enumerate(log)]  # type: ignore[type-var]
    score = score_track(estimate_track(wrong, "ekf", settings(), None, BEACONS), truth)
    assert score.position_rmse_m < 0.5
    assert score.within_2_sigma is not None and score.within_2_sigma > 0.85


def test_a_current_and_a_wrong_speed_of_sound_are_constants_of_a_dive() -> None:
    """A Doppler log that measures the velocity through the water, ranges 1.5 % long with echoes, and a gap of 80 s."""
    rng = np.random.default_rng(5)
    places = ((-400.0, -300.0, -60.0), (450.0, -350.0, -55.0), (400.0, 420.0, -70.0), (-380.0, 380.0, -65.0))
    beacons = dict(zip("1234", places, strict=True))
    place, heading, truth = np.array([-50.0, -50.0, -10.0]), 0.0, []
    log: Log = [Event(0.0, "pose", (place[0], place[1], heading))]
    for i in range(1800):
        time_s, heading = 0.5 * i, (i // 240) * math.pi / 2
        truth.append((time_s, *place[:2]))
        log.append(Event(time_s, "attitude", (0.0, 0.0, math.remainder(heading, math.tau) + rng.normal(0.0, 0.01))))
        log.append(Event(time_s, "velocity", (1.4 + rng.normal(0.0, 0.05), rng.normal(0.0, 0.05), 0.0)))
        log.append(Event(time_s, "depth", (10.0 + rng.normal(0.0, 0.05),)))
        if i % 6 == 3 and not 300.0 < time_s < 380.0:
            name = str(i // 6 % 4 + 1)
            echo = rng.uniform(5.0, 60.0) if rng.random() < 0.1 else 0.0
            distance = 1.015 * math.dist(place, beacons[name]) + rng.normal(0.0, 0.5) + echo
            log.append(Event(time_s, "range", (distance,), name))
        place = place + 0.5 * np.array([1.4 * math.cos(heading) + 0.12, 1.4 * math.sin(heading) - 0.08, 0.0])
    paths = localize(log, beacons=beacons)
    assert "a constant current, the speed of sound" in paths.remarks[-1]
    assert paths["ekf_x_current_m_s"][-1] == pytest.approx(0.12, abs=0.03)
    assert paths["ekf_y_current_m_s"][-1] == pytest.approx(-0.08, abs=0.03)
    assert paths["ekf_range_scale_error"][-1] == pytest.approx(0.015, abs=0.004)
    path = np.array(truth)
    score = paths.score(Truth(path[:, 0], path[:, 1:], None))["ekf"]
    assert score.position_rmse_m < 4.0
    assert score.within_2_sigma is not None and score.within_2_sigma > 0.9
