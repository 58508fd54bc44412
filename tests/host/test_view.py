"""The live view: what fits on a screen, what is never cut, and filters that catch up."""

from __future__ import annotations

import math
import os
import pty
import select
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import linkpose as lp
from linkpose import quantities
from linkpose.cli.curve import Canvas, curve, path_map
from linkpose.cli.view import Extremes, Screen
from linkpose.estimation import Estimator, LiveEstimator
from linkpose.presentation import with_std
from linkpose.sensors.devices import Sensors

HOST = Path(__file__).parents[2] / "host"
OK = {"imu": {"state": "ok"}, "baro": {"state": "ok"}}


def health(**sensors: dict[str, Any]) -> Any:
    return SimpleNamespace(rate_hz=100.0, lost=0, sensors=OK | sensors)


def link_screen(rows: int = 500) -> Screen:
    screen = Screen("sim://link  J2S 1.653 m", ["joint-inertial", "joint", "tilt"])
    for at in range(rows):
        height = 1.5 + 0.15 * math.sin(0.045 * at)
        screen.add(
            0.05 * at,
            {
                name: {
                    quantities.HEIGHT: (height + off, std),
                    quantities.ROLL: (22.0, 0.1),
                    quantities.PITCH: (13.1, 0.1),
                }
                for name, off, std in (("joint-inertial", 0.0, 4e-4), ("joint", 6e-4, 8e-3), ("tilt", -0.02, 0.02))
            },
        )
    return screen


@pytest.mark.parametrize(("width", "height"), [(80, 24), (50, 24), (80, 12), (40, 8)])
def test_a_screen_fits_and_starts_with_the_best_filter(width: int, height: int) -> None:
    lines = link_screen().render(health(), width, height).plain.splitlines()
    assert len(lines) < height and max(map(len, lines)) <= min(width, 78)
    assert any("±0.4 mm" in line for line in lines)
    if height >= 24:
        table = [line.split()[:2] for line in lines[-3:]]
        assert table == [["▸", "joint-inertial"], ["joint", "1.4330"], ["tilt", "1.4124"]] or table[0][1] == (
            "joint-inertial"
        )


@pytest.mark.parametrize("width", [80, 50, 30])
def test_faults_and_exclusions_are_never_cut(width: int) -> None:
    screen = Screen("sim://mice", ["planar-ekf", "mice"])
    pose = {quantities.X: (1.0, 0.001), quantities.Y: (0.0, 0.001), quantities.HEADING: (0.2, 0.01)}
    for at in range(100):
        mask = 2.0 if at >= 51 else 0.0
        screen.add(0.1 * at, {"planar-ekf": pose, "mice": {**pose, quantities.EXCLUDED: (mask, math.nan)}})
    shown = screen.render(health(imu={"state": "silent"}), width, 6).plain
    assert "IMU SILENT" in shown
    assert "mouse 2 LEFT OUT since 5.1 s" in shown


def test_an_unknown_height_is_said_to_be_unknown() -> None:
    screen = Screen("sim://link", ["joint-inertial"])
    screen.add(0.0, {"joint-inertial": {quantities.HEIGHT: (math.nan, math.nan)}})
    assert "not known yet" in screen.render(health(), 80, 24).plain


def test_the_curve_covers_its_values() -> None:
    times = [0.1 * at for at in range(200)]
    lines = curve(times, [math.sin(time) for time in times], 20.0, 78, 5, 0.02)
    assert len(lines) == 5 and {len(line) for line in lines} == {78}
    assert lines[0].strip().startswith("1.0") and lines[-1].strip().startswith("-1.0")
    assert all(any(char > "\u2800" for char in line.split("┤")[1]) for line in lines)
    assert curve([0.0], [math.nan], 20.0, 30, 3, 0.02) == [" " * 30] * 3


def test_dots_are_where_they_should_be() -> None:
    canvas = Canvas(2, 1)
    canvas.dot(0, 0)
    canvas.dot(3, 3)
    canvas.dot(99, 99)
    assert canvas.lines() == ["\u2801\u2880"]


def test_the_path_ends_at_the_robot() -> None:
    lines = path_map([0.0, 1.0, 1.0], [0.0, 0.0, 1.0], 20, 10)
    assert lines[0].rstrip("\u2800").endswith("o")


def test_standard_deviations_are_shown_in_fitting_units() -> None:
    assert with_std(1.5906, 0.0004, "m", 4) == "1.5906 m ±0.4 mm"
    assert with_std(1.5, 0.12, "m", 2) == "1.50 m ±12.0 cm"
    assert with_std(math.nan, 0.1, "m", 2) == "not known yet"


def measurements(rows: int) -> lp.Measurements:
    noise = np.random.default_rng(1).normal(size=(rows, 6))
    force = np.array([0.0, 0.0, 9.80665]) + 0.04 * noise[:, :3]
    return lp.Measurements.from_imu(0.01 * np.arange(rows), force, 1e-3 * noise[:, 3:])


def test_filters_that_become_ready_late_give_the_same_estimates() -> None:
    block = measurements(60)
    rig = lp.Rig().with_j2s((0.0, 0.0, 1.0))
    whole = Estimator(["tilt", "joint"], rig, Sensors.MPU6050)
    expected = whole.process(block)
    ready: set[str] = set()
    late = LiveEstimator(Estimator(["tilt", "joint"], rig, Sensors.MPU6050), ready.__contains__)
    rows = []
    for at in range(0, 60, 5):
        if at == 20:
            ready |= {"tilt"}
        if at == 40:
            ready |= {"joint", "text"}
        complete, newest = late.process(block[at : at + 5])
        rows.append(complete)
        tilt, joint = newest[1 : 1 + 4], newest[5:]
        assert np.isnan(tilt).all() == (at < 20) and np.isnan(joint).all() == (at < 40)
    rows.append(late.finish())
    assert [len(part) for part in rows[:8]] == [0] * 8
    assert np.array_equal(np.concatenate(rows), expected, equal_nan=True)
    extremes = Extremes(whole.columns)
    extremes.add(expected)
    assert extremes.summary()["tilt"][1] == expected[:, whole.columns.index("tilt_height_m")].max()


def test_rows_reach_a_redirected_stdout_while_the_view_is_on_the_terminal(tmp_path: Path) -> None:
    """rich takes over stdout if it is allowed to: then no row arrives."""
    command = ["estimate", "--live", "--port", "sim://link", "--duration", "0.5", "--filter", "tilt"]
    leader, follower = pty.openpty()
    with (tmp_path / "rows.csv").open("wb") as rows:
        environment = {**os.environ, "PYTHONPATH": str(HOST), "TERM": "xterm"}
        process = subprocess.Popen(
            [sys.executable, "-m", "linkpose", *command], stdout=rows, stderr=follower, env=environment
        )
        os.close(follower)
        seen = b""
        while True:
            if leader in select.select([leader], [], [], 1.0)[0]:
                try:
                    data = os.read(leader, 65536)
                except OSError:
                    break
                if not data:
                    break
                seen += data
    assert process.wait() == 0, seen.decode(errors="replace")
    os.close(leader)
    lines = [line for line in (tmp_path / "rows.csv").read_text().splitlines() if not line.startswith("#")]
    assert len(lines) == 1 + 50
    assert b"HEIGHT over joint" in seen
