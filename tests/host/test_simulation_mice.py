"""The simulated robot: exact truth, counts that nothing is lost of, faults, and the same samples by every way."""

from __future__ import annotations

import itertools
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import linkpose
from linkpose.errors import LinkposeError
from linkpose.recording.reader import load_recording
from linkpose.simulation.drive import DrivenPath, Manoeuvres
from linkpose.simulation.mice import LEVELS, Fault, MiceRun, MouseErrors, ring
from linkpose.wire.messages import SampleFlags

STALE = int(SampleFlags.MICE_STALE)

NO_ERRORS = LEVELS["none"]


def test_truth_s_derivatives_are_its_velocities():
    run, h = MiceRun(3), 1e-3
    time_s = np.linspace(4.0, 50.0, 300)
    before, now, after = run.at(time_s - h), run.at(time_s), run.at(time_s + h)
    c, s = np.cos(now.heading_rad), np.sin(now.heading_rad)
    vx = (after.x_m - before.x_m) / (2 * h)
    vy = (after.y_m - before.y_m) / (2 * h)
    np.testing.assert_allclose(c * vx + s * vy, now.vx_m_s, atol=1e-5)
    np.testing.assert_allclose(c * vy - s * vx, now.vy_m_s, atol=1e-5)
    np.testing.assert_allclose((after.heading_rad - before.heading_rad) / (2 * h), now.wz_rad_s, atol=1e-4)


def test_a_circle_s_pose_is_exact():
    class Circle(Manoeuvres):
        def twist(self, time_s):
            return np.tile([0.5, 0.0, math.pi / 2], (len(time_s), 1))

        def way(self, time_s):
            return np.outer(time_s, [0.5, 0.0, math.pi / 2])

    radius = 0.5 / (math.pi / 2)
    pose = DrivenPath(Circle((0,))).pose(np.array([2.0, 4.0]))
    np.testing.assert_allclose(pose, [[0, 2 * radius, math.pi], [0, 0, 2 * math.pi]], atol=1e-9)


def test_the_robot_rests_at_the_start_moves_in_every_way_and_not_faster_than_a_metre_a_second():
    truth = MiceRun(0, 200.0).truth()
    speed = np.hypot(truth.vx_m_s, truth.vy_m_s)
    assert speed[:400].max() == 0 and 0.8 < speed.max() <= 1.0
    straight, turning = np.abs(truth.wz_rad_s) < 1e-9, np.abs(truth.wz_rad_s) > 0.5
    assert (straight & (speed > 0.3)).any() and (turning & (speed > 0.1)).any() and (turning & (speed < 1e-9)).any()


@pytest.mark.parametrize("rate_hz", [50, 100, 400])
def test_the_counts_add_up_to_the_way_whatever_the_sample_rate(rate_hz):
    run = MiceRun(1, 20.0, rate_hz, mouse_errors=NO_ERRORS)
    block = run.measurements()
    moved, last = block.mice_counts.sum(axis=0), block.time_s[block.flags & STALE == 0][-1]
    truth = run.at(np.arange(0.0, last + 1e-9, 5e-4))
    for i, mouse in enumerate(run.mice):
        vx, vy = truth.vx_m_s - truth.wz_rad_s * mouse.y_m, truth.vy_m_s + truth.wz_rad_s * mouse.x_m
        way = [0.5 * (v[1:] + v[:-1]).sum() * 5e-4 for v in (vx, vy)]
        np.testing.assert_allclose(moved[i], np.array(way) * mouse.counts_per_m, atol=1.0)


@pytest.mark.parametrize(("rate_hz", "ticks"), [(100, 1), (125, 1), (160, 2), (250, 2), (500, 4)])
def test_the_mice_are_read_as_often_as_the_firmware_can(rate_hz, ticks):
    block = MiceRun(1, 8.0, rate_hz).measurements()
    stale = block.flags & STALE != 0
    assert set(np.diff(np.flatnonzero(~stale))) == {ticks}
    assert not block.mice_counts[stale].any() and block.mice_counts[~stale].any()


def test_counts_are_a_function_of_time_and_samples_of_their_number():
    run, again = MiceRun(2, 20.0), MiceRun(2, 20.0)
    time_s = np.sort(np.random.default_rng(0).uniform(0, 20, 50))
    whole = run.counts(time_s)
    singly = [again.counts(time_s[i : i + 1]) for i in range(49, -1, -1)]
    np.testing.assert_array_equal(np.concatenate(singly)[::-1], whole)
    samples = list(run.samples())
    assert again.block(1200, 30) == samples[1200:1230]
    assert list(itertools.islice(MiceRun(2, None).samples(), 100)) == samples[:100]


def test_noise_is_in_proportion_to_the_speed_and_the_paper_s_is_uniform():
    still = MiceRun(0, 4.0, mouse_errors=MouseErrors(0.05, 0.05, 0.0, 0.0, 0.0))
    assert not still.measurements().mice_counts.any()
    paper = MiceRun(0, 20.0, mice=ring(1, counts_per_m=1e6), path="paper", mouse_errors=MouseErrors(0, 0, 0.0025, 0, 0))
    velocity = paper.measurements().mice_counts[1:, 0] / 1e6 * 100 - 0.01
    assert np.abs(velocity).max() < 0.0027 and velocity.std() == pytest.approx(0.0025 / math.sqrt(3), rel=0.03)


def test_faults_hide_movement_only_while_they_last():
    kinds = {"slip": 0.3, "lift": 0.0, "unplug": None}
    for kind, share in kinds.items():
        sound = MiceRun(1, 24.0, mouse_errors=NO_ERRORS)
        faulty = MiceRun(1, 24.0, mouse_errors=NO_ERRORS, faults=(Fault(kind, 2, 8.0, 16.0),))
        ours, theirs = faulty.measurements().mice_counts, sound.measurements().mice_counts
        np.testing.assert_array_equal(ours[:, [0, 2]], theirs[:, [0, 2]])
        if share is None:
            assert np.isnan(ours[800:1600, 1]).all() and np.isfinite(ours[1600:, 1]).all()
        else:
            np.testing.assert_allclose(ours[801:1601, 1].sum(axis=0), share * theirs[801:1601, 1].sum(axis=0), atol=2)
        np.testing.assert_allclose(ours[1602:, 1].sum(axis=0), theirs[1602:, 1].sum(axis=0), atol=2)


def test_the_gyro_sees_the_turn():
    run = MiceRun(4, 40.0)
    block, truth = run.measurements(), run.truth()
    off = block.gyro_rad_s[:, 2] - truth.wz_rad_s
    assert np.abs(off.mean()) < 0.01 and 0.0005 < off.std() < 0.003
    assert np.median(block.accel_m_s2[:, 2]) == pytest.approx(9.8, abs=0.15)
    assert (block.flags & int(SampleFlags.BARO_VALID) == 0).all()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"seed": -1}, "the seed is -1"),
        ({"mice": ring(5)}, "5 mice cannot be"),
        ({"path": "zigzag"}, "no path called 'zigzag'"),
        ({"path": "line", "duration_s": 3.0}, "a duration of 3.0 s"),
        ({"path": "turn", "duration_s": None}, "the path .turn. needs a duration"),
        ({"errors": "some"}, "no errors called 'some'"),
        ({"faults": (Fault("lift", 4, 1.0, 2.0),)}, "no mouse 4"),
    ],
)
def test_what_cannot_be_simulated_is_refused(arguments, reason):
    with pytest.raises(LinkposeError, match=reason):
        MiceRun(**arguments)


@pytest.mark.parametrize("text", ["lift", "lift:1", "lift:1:5", "fly:1:5-8", "lift:1:8-5", "lift:x:5-8"])
def test_a_fault_that_is_none_is_named(text):
    with pytest.raises(LinkposeError, match="is no fault"):
        Fault.parse(text)


# ---- from end to end ----


def planar_scores(linkpose, estimate, truth) -> dict[str, dict[str, float]]:
    rows = [json.loads(line) for line in linkpose("evaluate", estimate, truth, "--json").out.splitlines()]
    return {row["filter"]: row for row in rows}


def test_simulate_estimate_and_evaluate(linkpose, tmp_path):
    recording, truth, out = (tmp_path / name for name in ("r.csv", "t.csv", "e.csv"))
    arguments = ("--seed", 1, "--duration", 20, "--fault", "lift:2:10-14")
    assert linkpose("simulate", "mice", "-o", recording, "--truth", truth, *arguments).status == 0
    header = next(line for line in truth.read_text().splitlines() if not line.startswith("#"))
    assert header == "time_s,x_m,y_m,heading_rad,vx_m_s,vy_m_s,wz_rad_s"
    done = linkpose("estimate", recording, "-o", out, "-v")
    assert done.status == 0 and "not running: imu-baro" in done.err
    scores = planar_scores(linkpose, out, truth)
    assert {"mice", "planar-ekf", "planar-ukf"} <= set(scores)
    for name in ("mice", "planar-ekf", "planar-ukf"):
        assert scores[name]["velocity_rmse_m_s"] < 0.01 and scores[name]["rate_rmse_rad_s"] < 0.05
        assert scores[name]["position_rmse_m"] < 0.3 and scores[name]["heading_rmse_rad"] < 0.1


def test_without_an_imu_the_mice_still_do(linkpose, tmp_path):
    recording, truth, out, bare = (tmp_path / name for name in ("r.csv", "t.csv", "e.csv", "bare.csv"))
    linkpose("simulate", "mice", "-o", recording, "--truth", truth, "--duration", 12)
    lines = recording.read_text().splitlines()
    names = lines[2].split(",")
    keep = [i for i, name in enumerate(names) if name in ("time_s", "seq", "flags") or name.startswith("mouse")]
    rows = [",".join(line.split(",")[i] for i in keep) for line in lines[2:] if not line.startswith("#")]
    bare.write_text("\n".join([*lines[:2], *rows]) + "\n")
    assert linkpose("estimate", bare, "-o", out).status == 0
    assert set(planar_scores(linkpose, out, truth)) == {"mice", "planar-ekf", "planar-ukf"}


@pytest.mark.parametrize("rate_hz", [100, 250])
def test_a_live_board_with_mice_is_estimated_as_its_recording_is(linkpose, tmp_path, rate_hz):
    live, record, replay = (tmp_path / name for name in ("live.csv", "rec.csv", "replay.csv"))
    port, rate = "sim://mice?seed=1&mice=3&fault=lift:2:3-6&speed=0", ("--rate", rate_hz, "--duration", 8)
    done = linkpose("estimate", "--live", "--port", port, *rate, "-o", live, "--record", record)
    assert done.status == 0, done.err
    assert linkpose("estimate", record, "-o", replay).status == 0
    rows = [[line for line in path.read_text().splitlines() if line[:1].isdigit()] for path in (live, replay)]
    assert rows[0] == rows[1] and len(rows[0]) == 8 * rate_hz
    recording = load_recording(record)
    assert [mouse["id"] for mouse in recording.metadata["mice"]] == [0, 0, 0]
    assert recording.rig == MiceRun().rig
    same = MiceRun(1, rate_hz=rate_hz, faults=(Fault("lift", 2, 3.0, 6.0),)).measurements()[: 8 * rate_hz]
    np.testing.assert_array_equal(recording.measurements.mice_counts, same.mice_counts)
    np.testing.assert_array_equal(recording.measurements.flags, same.flags)


@pytest.mark.parametrize(
    ("port", "reason"),
    [
        ("sim://mice?test=1", "has no option test; it has seed, mice, path, errors, fault, drift_ppm and speed"),
        ("sim://mice?mice=0", "0 mice cannot be"),
        ("sim://rat", "type sim://link, sim://chain, sim://mice"),
    ],
)
def test_a_wrong_address_is_refused(refused, port, reason):
    assert reason in refused("info", "--port", port)


def test_a_link_recording_has_no_use_for_mice(linkpose, tmp_path):
    recording, truth, out = (tmp_path / name for name in ("r.csv", "t.csv", "e.csv"))
    linkpose("simulate", "link", "-o", recording, "--truth", truth, "--duration", 3)
    done = linkpose("estimate", recording, "-o", out, "-v")
    assert "not running: planar-ekf, planar-ukf, mice: no mouse gives counts" in done.err
    assert "mice" not in out.read_text().splitlines()[2]


def test_estimating_a_link_loads_nothing_of_the_robot_s():
    """In a process of its own, because this one has loaded it all."""
    script = (
        "import sys\n"
        "from linkpose.estimation import Estimator, mice_of, sensors_of\n"
        "from linkpose.simulation.link import LinkRun\n"
        "run = LinkRun(duration_s=1.0)\n"
        "block = run.measurements()\n"
        "Estimator([], run.rig, sensors_of(block), mice_of(block))\n"
        "print([m for m in sys.modules if 'localization' in m or m.endswith(('filters.mice', 'filters.planar'))])\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(linkpose.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.strip() == "[]"
