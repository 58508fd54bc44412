"""The main job as a user does it: the firmware's own .hex behind a port, `linkpose` in front of it.

The board goes by a clock that waits for a busy or suspended machine, and `linkpose` by the board's. The test of the
board's drift goes by the wall clock; those in which nothing may be lost want the machine for themselves.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from measuring import MICE, PATIENCE_S, lateness
from pty_server import PatientClock, PtyServer
from rig_signals import RigFeed
from wire_link import WireLink

from linkpose.device.session import LATE_S
from linkpose.recording.columns import ACCEL, GYRO, MAG, mouse_columns
from linkpose.recording.table import read_table
from linkpose.sensors.conversion import GAP_BEFORE
from linkpose.simulation.chain import ChainRun
from linkpose.simulation.link import PAPER_J2S_M, LinkRun
from virtual_uno import VirtualUno

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2] / "host")}
LINK_FILTERS = [word for name in ("joint", "tilt", "imu-baro", "baro") for word in ("--filter", name)]
J2S = ["--j2s", ",".join(map(str, PAPER_J2S_M))]


def linkpose(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "linkpose", *map(str, arguments)]
    return subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=PATIENCE_S)


@pytest.fixture
def served(board: Callable[..., WireLink], tmp_path: Path) -> Iterator[PtyServer]:
    """A board at `tmp_path / "port"` with the rig's signals from its reset on."""
    uno = board().uno
    with serve(uno, RigFeed(uno, LinkRun(test=1, seed=0, duration_s=None)), tmp_path) as server:
        yield server


def serve(uno: VirtualUno, feed: RigFeed, folder: Path) -> PtyServer:
    server = PtyServer(uno, folder / "port", on_slice=feed.supply, on_open=feed.restart, clock=PatientClock())
    server.waits_for_host = True
    return server


def rows_of(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


@pytest.mark.realtime
def test_live_estimates_from_the_real_firmware(served: PtyServer, tmp_path: Path) -> None:
    """Nothing lost, heights near the truth, and the replay gives the same digits.

    The rig is in motion when the stream starts, and how fast the host is decides at which place.
    """
    live, recording, raw, replay = (tmp_path / name for name in ("live.csv", "rec.csv", "raw.bin", "replay.csv"))
    source = ["--live", "--port", served.link, "--duration", 8, "--record", recording, "--raw", raw]
    done = linkpose("estimate", *source, "-o", live, *J2S, *LINK_FILTERS, "--json")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert summary["samples"] == pytest.approx(800, abs=8)
    assert (summary["lost"], summary["corrupt"], summary["gaps"]) == (0, 0, 0), lateness(served, LATE_S)
    assert linkpose("estimate", recording, "-o", replay, *J2S, *LINK_FILTERS).returncode == 0
    assert rows_of(replay) == rows_of(live)
    estimate = read_table(live, "estimate")
    start_s, error = height_error(estimate.columns["time_s"], estimate.columns["joint_height_m"])
    assert rms(error) < 0.011, f"the stream began {start_s:.1f} s after the reset; the budget is {START_BUDGET_S} s"
    assert linkpose("estimate", raw, *J2S, *LINK_FILTERS).stdout.count("\n") > 790


START_BUDGET_S = 2.5  # a later start meets the rig in faster motion, which the filter needs seconds to get over
LONGEST_START_S = 20.0  # from the board's reset to the stream, with a slow host


def height_error(time_s: np.ndarray, height_m: np.ndarray) -> tuple[float, np.ndarray]:
    """Start of the stream after the rig's (s), as it fits the truth best, and the errors (m) there.

    The rig moves since the board's reset.
    """
    run = LinkRun(test=1, seed=0, duration_s=None)
    shifts = np.arange(0.0, LONGEST_START_S, 0.002)
    errors = [height_m[::10] - run.at(time_s[::10] + shift).height_m for shift in shifts]
    best = shifts[int(np.argmin([rms(error) for error in errors]))]
    return float(best), np.asarray(height_m - run.at(time_s + best).height_m)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_info_tells_what_the_board_is(served: PtyServer) -> None:
    done = linkpose("info", "--port", served.link, "--json", "--self-test")
    assert done.returncode == 0, done.stderr
    info = json.loads(done.stdout)
    assert info["sensors"] == ["mpu6050", "bmp180"]
    assert (info["protocol"], info["sample_rate_hz"], info["mice"]) == ("2.0", 100, [])
    assert (info["samples_lost"], info["frames_corrupt"], info["self_test"]) == (0, 0, "passed")
    assert info["board"]["stack_free_bytes"] >= 400


BUDGET_S = 0.05  # the drift is that of the board as long as the machine runs it in time


@pytest.mark.realtime
def test_info_tells_how_fast_the_boards_clock_is(board: Callable[..., WireLink], tmp_path: Path) -> None:
    """An emulated board goes as the wall clock does."""
    with PtyServer(board().uno, tmp_path / "port") as server:
        done = linkpose("info", "--port", server.link, "--json")
    assert done.returncode == 0, done.stderr
    info = json.loads(done.stdout)
    assert abs(info["clock_drift_ppm"]) < 5 * info["clock_drift_std_ppm"] + 100, lateness(server, BUDGET_S)


@pytest.mark.realtime
def test_a_board_that_is_reset_while_it_is_recorded_goes_on(served: PtyServer, tmp_path: Path) -> None:
    """The real HELLO after a real reset: the stream is started again and the gap is marked."""
    path = tmp_path / "r.csv"
    command = [sys.executable, "-m", "linkpose", "record", path, "--port", served.link, "--duration", "4"]
    with subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "recording to" in process.stderr.readline()
        while not (path.exists() and path.read_bytes().count(b"\n") > 100):
            assert process.poll() is None
        served.call(served.uno.reset)
        output = process.communicate(timeout=PATIENCE_S)[1]
    assert process.returncode == 0
    assert "was reset (external)" in output
    table = read_table(path, "recording")
    assert table.closing is not None
    assert [gap["cause"] for gap in table.closing["gaps"]] == ["reset"]
    assert np.count_nonzero(table.columns["flags"].astype(int) & GAP_BEFORE) == 1
    assert table.columns["time_s"][-1] == pytest.approx(3.99, abs=0.02)


# The simulated link's J2S and field, as `calibrate mag` writes it.
MAG_RIG = """
[joint]
j2s_m = [-0.09, -0.04, 1.65]
[mag]
hard_iron_uT = [0.0, 0.0, 0.0]
field_uT = 51.6
residual_uT = 0.5
dip_deg = 54.5
"""


@pytest.mark.realtime
def test_everything_that_a_board_can_carry(board: Callable[..., WireLink], tmp_path: Path) -> None:
    """Two inertial sensors, a barometer, a magnetometer, mice at 100 Hz: nothing lost; the field holds the yaw."""
    uno = board(imu2={}, magnetometer="qmc5883l", mice=MICE[:3]).uno
    run = LinkRun(test=1, seed=0, duration_s=None, imu2=True, mag=True)
    feed = RigFeed(uno, run)
    path, estimate, rig = tmp_path / "r.csv", tmp_path / "e.csv", tmp_path / "rig.toml"
    with serve(uno, feed, tmp_path) as server:
        done = linkpose("record", path, "--port", server.link, "--duration", 6, "--json")
        rig.write_text(MAG_RIG, encoding="utf-8")
        options = ("--rig", rig, "--filter", "joint-inertial", "--mag", "--duration", 5, "-o", estimate)
        live = linkpose("estimate", "--live", "--port", server.link, *options)
    assert done.returncode == 0, done.stderr
    assert live.returncode == 0, live.stderr
    held = read_table(estimate, "estimate")
    assert held.closing["mag"]["used_s"] > 2.0 > held.closing["mag"]["rejected_s"]
    assert np.isfinite(held.columns["joint_inertial_yaw_deg"][-100:]).all()
    summary = json.loads(done.stdout.splitlines()[-1])
    assert (summary["lost"], summary["corrupt"], summary["gaps"]) == (0, 0, 0), lateness(server, LATE_S)
    table = read_table(path, "recording")
    wanted = [f"imu2_{name}" for name in ACCEL + GYRO] + ["imu2_temp_degC", *MAG, "mag_fresh"]
    wanted += [name for port in (1, 2, 3) for name in mouse_columns(port)]
    assert set(wanted) <= set(table.columns)
    settled = slice(50, None)
    for name in wanted[:-6]:
        assert np.isfinite(table.columns[name][settled]).all(), name
    field = np.linalg.norm([table.columns[name][settled] for name in MAG], axis=0)
    assert np.median(field) == pytest.approx(np.hypot(30.0, 42.0), abs=2.0)
    assert table.columns["mag_fresh"][settled].mean() > 0.95


@pytest.mark.realtime
def test_the_angle_of_a_chain_from_two_sensors_on_one_board(board: Callable[..., WireLink], tmp_path: Path) -> None:
    """Two MPU-6050 on a thigh and a shank: recorded by the firmware, estimated with unknown mounting."""
    uno = board(imu2={}).uno
    run = ChainRun("hinge", seed=0, duration_s=None)
    feed = RigFeed(uno, run)
    path, estimate = tmp_path / "r.csv", tmp_path / "e.csv"
    with serve(uno, feed, tmp_path) as server:
        done = linkpose("record", path, "--port", server.link, "--duration", 11, "--json")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert (summary["lost"], summary["corrupt"], summary["gaps"]) == (0, 0, 0), lateness(server, LATE_S)
    done = linkpose("estimate", path, "-o", estimate, "--filter", "chain", "--joint", "hinge")
    assert done.returncode == 0, done.stderr
    found = read_table(estimate, "estimate").columns
    late = found["time_s"] > 7
    time_s, angle, std = (found[name][late] for name in ("time_s", "chain_angle_deg", "chain_angle_std_deg"))
    shifts = np.arange(0.0, LONGEST_START_S, 0.01)  # the rig moved since the board's reset
    errors = [angle - run.truth_columns(time_s + shift)["angle_deg"] for shift in shifts]
    error = min((e - e.mean() for e in errors), key=rms)  # counted from the first sample, which may be in motion
    assert rms(error) < 1.0 < 5.0 < np.ptp(angle) and (std < 5.0).all()
