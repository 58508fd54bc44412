"""planar-ekf with a faulty part: its pose beside ten lines of gyro and mice, its σ, and what it reports."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import numpy as np
import pytest
from robot_counts import DEG, LEGS, TRIANGLE, Robot, counts, gyro, measurements, rig, robot

from linkpose.experiments.planar import PlanarRun, baseline, pose_error
from linkpose.filters.planar import PlanarEkf
from linkpose.rotations import wrapped
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig


def estimated(run: Robot, rig_: Rig, block: Measurements) -> tuple[PlanarEkf, np.ndarray, float]:
    """The filter, its estimates, and its position error relative to the baseline's."""
    filter_ = PlanarEkf(rig_)
    out = filter_.process(block)
    theirs = pose_error(baseline(PlanarRun(rig_, block, run.pose)), run.pose).position_m
    return filter_, out, pose_error(out[:, :3], run.pose).position_m / theirs


def heading_errors(run: Robot, out: np.ndarray) -> np.ndarray:
    """(N,) rad, without sign."""
    return np.abs(wrapped(out[:, 2] - run.pose[:, 2]))


def share_within(run: Robot, out: np.ndarray, sigmas: float = 2.0) -> tuple[float, float]:
    """Share of the errors of position and heading within so many of the stated σ."""
    off = np.hypot(*(out[:, :2] - run.pose[:, :2]).T)
    turned = heading_errors(run, out)
    return float(np.mean(off < sigmas * np.hypot(out[:, 6], out[:, 7]) + 1e-3)), float(
        np.mean(turned < sigmas * out[:, 8] + 1e-3)
    )


def jumped(run: Robot, degrees_per_s: float, after_s: float) -> np.ndarray:
    return gyro(run) + degrees_per_s * DEG * (run.time_s >= after_s)


# ---- the gyro ----


@pytest.mark.parametrize("after_s", [11.0, 13.5, 24.3])
@pytest.mark.parametrize("degrees_per_s", [1.0, -4.0, 10.0])
def test_a_jump_of_the_gyro_s_bias_under_way_is_found_and_undone(degrees_per_s, after_s):
    run = robot()
    filter_, out, ratio = estimated(run, rig(), measurements(run, counts(run), jumped(run, degrees_per_s, after_s)))
    assert ratio < 0.6
    assert math.degrees(filter_.gyro_jumps.last_rad_s) == pytest.approx(degrees_per_s, abs=0.5)
    assert after_s < filter_.gyro_jumps.last_time_s < after_s + 12.0
    assert min(share_within(run, out)) > 0.75 and min(share_within(run, out, 4.0)) > 0.9
    assert math.degrees(heading_errors(run, out)[-1]) < 2.0


def slips(share: float, start_s: float, end_s: float) -> Callable[[Robot], np.ndarray]:
    def seen(run: Robot) -> np.ndarray:
        time_s = np.arange(len(run.speed)) / 1000
        return np.where((time_s >= start_s) & (time_s < end_s), share, 1.0)[:, np.newaxis].repeat(3, axis=1)

    return seen


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("start_s", [7.0, 19.5, 25.0])
def test_mice_that_slip_together_are_no_jump_of_the_gyro(share, start_s):
    run = robot(1)
    filter_, out, _ = estimated(
        run, rig(), measurements(run, counts(run, seen=slips(share, start_s, start_s + 2.5)(run)), gyro(run))
    )
    assert filter_.gyro_jumps.times == 0
    assert math.degrees(heading_errors(run, out).max()) < 1.3


# ---- mice ----


def test_a_mouse_that_counts_steadily_is_left_out_from_the_start_or_later():
    run = robot(2)
    for first_s in (0.0, 12.0):
        block = measurements(run, counts(run), gyro(run))
        block.mice_counts[run.time_s >= first_s, 1] = (5.0, 3.0)
        filter_, out, ratio = estimated(run, rig(), block)
        assert ratio < 0.2 and filter_.distrusted == 2
        assert share_within(run, out)[0] > 0.9


def test_counters_that_run_over_without_a_flag_widen_the_position():
    """At 20 000 counts/m and 8 bits, the counters run over at 0.64 m/s: the mice show a lower bound of the speed."""
    fast = tuple((seconds, 2.2 * speed, turn) for seconds, speed, turn in LEGS)
    run = robot(3, fast)
    filter_, out, ratio = estimated(
        run, rig(counts_per_m=20000.0), measurements(run, counts(run, counts_per_m=20000.0, limit=127), gyro(run))
    )
    assert ratio < 1.02 and share_within(run, out)[0] > 0.9
    assert filter_.gyro_jumps.times == 0


# ---- what is reported ----


def test_estimate_reports_the_gyro_s_jump_and_the_mouse_that_is_left_out(linkpose, tmp_path):
    recording, estimates = tmp_path / "r.csv", tmp_path / "e.csv"
    fault = ("--fault", "lift:2:12-18")
    linkpose("simulate", "mice", "--duration", 40, "--seed", 3, *fault, "-o", recording, "--truth", tmp_path / "t.csv")
    lines = recording.read_text().split("\n")
    head = next(k for k, line in enumerate(lines) if line.startswith("time_s"))
    at = lines[head].split(",").index("gyro_z_rad_s")
    for k in range(head + 2501, len(lines)):
        cells = lines[k].split(",")
        if len(cells) > at and not lines[k].startswith("#"):
            cells[at] = f"{float(cells[at]) + 0.06:.6f}"
            lines[k] = ",".join(cells)
    recording.write_text("\n".join(lines))
    done = linkpose("estimate", recording, "-o", estimates, "--filter", "planar-ekf", "--filter", "mice")
    assert "mouse 2 was left out for 6." in done.err and "first at 12.0 s" in done.err
    assert "the gyro's bias has jumped by +3." in done.err
    closing = json.loads(estimates.read_text().strip().split("\n")[-1].removeprefix("# "))
    assert closing["gyro_jumps"]["last_rad_s"] == pytest.approx(0.06, abs=0.005)
    assert closing["excluded_mice_since_s"]["mouse2"] == pytest.approx(12.0, abs=0.2)


def test_a_mouse_elsewhere_than_the_rig_file_states_is_found_by_the_turns():
    run = robot(4)
    places = (*TRIANGLE[:1], (-0.08, 0.16), *TRIANGLE[2:])
    filter_, out, _ = estimated(run, rig(), measurements(run, counts(run, places), gyro(run)))
    assert pose_error(out[:, :3], run.pose).position_m < 0.05 and share_within(run, out, 3.0)[0] > 0.7
    assert np.hypot(out[-1, 6], out[-1, 7]) < 0.15
    (moved,) = filter_.moved_mice
    assert (
        moved.mouse == 2 and moved.x_m == pytest.approx(-0.08, abs=0.01) and moved.y_m == pytest.approx(0.16, abs=0.01)
    )
    assert PlanarEkf(rig()).moved_mice == ()
