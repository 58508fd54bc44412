"""The live view: what fits on a screen, what is never cut, and filters that catch up."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.table import Table
from terminal import Terminal

import linkpose as lp
from linkpose import quantities
from linkpose.cli.characters import replacement
from linkpose.cli.curve import Canvas, curve, path_map, time_axis
from linkpose.cli.keys import Keys, Marker
from linkpose.cli.live import health_line, progress_line
from linkpose.cli.rendering import show_table, wrapped
from linkpose.cli.screen import Screen, final_table
from linkpose.estimation import Estimator
from linkpose.extremes import Extremes
from linkpose.live_estimation import LiveEstimator
from linkpose.presentation import Row, aligned_length, angle_with_std, length_with_std, same_digits
from linkpose.sensors.devices import Sensors
from linkpose.sensors.measurements import Floats
from linkpose.simulation.link import LinkRun

OK = {"imu": {"state": "ok"}, "baro": {"state": "ok"}}


def health(silent_s: float = 0.0, **sensors: dict[str, Any]) -> Any:
    return SimpleNamespace(rate_hz=100.0, lost=0, sensors=OK | sensors, duration_s=30.0, silent_s=silent_s)


def table(interval_s: float, rows: Sequence[Row]) -> tuple[list[str], Floats]:
    """Columns and values (N, columns) of rows of one shape, as a filter's estimates have them."""
    columns, values = ["time_s"], [interval_s * np.arange(len(rows))]
    for name, of in rows[0].items():
        for quantity in of:
            for at, column in enumerate((quantity.column, quantity.std_column)):
                columns.append(f"{name.replace('-', '_')}_{column}")
                values.append(np.array([row[name][quantity][at] for row in rows]))
    return columns, np.column_stack(values)


def screen_of(title: str, interval_s: float, rows: Sequence[Row]) -> Screen:
    columns, values = table(interval_s, rows)
    screen = Screen(title, columns)
    screen.add(values)
    return screen


def link_rows(rows: int = 500) -> list[Row]:
    filters = (("joint-inertial", 0.0, 4e-4), ("joint", 6e-4, 8e-3), ("tilt", -0.02, 0.02))
    attitude = {quantities.ROLL: (22.0, 0.1), quantities.PITCH: (13.1, 0.1)}
    heights = [1.5 + 0.15 * math.sin(0.045 * at) for at in range(rows)]
    return [{n: {quantities.HEIGHT: (h + off, std), **attitude} for n, off, std in filters} for h in heights]


def link_screen() -> Screen:
    return screen_of("sim://link  J2S 1.653 m", 0.05, link_rows())


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


@pytest.mark.parametrize("sizes", [[1] * 100, [60, 40], [100]])
def test_rows_may_arrive_in_blocks_of_any_size(sizes: list[int]) -> None:
    """A filter that catches up brings all rows so far at once, a live board one at a time."""
    pose = {quantities.X: (1.0, 0.01), quantities.Y: (0.0, 0.01), quantities.HEADING: (0.2, 0.01)}
    heights = [1.5 + 0.002 * at for at in range(100)]
    rows: list[Row] = [
        {
            "joint": {quantities.HEIGHT: (height, 0.01)},
            "mice": {**pose, quantities.X: (height, 0.01), quantities.EXCLUDED: (4.0 * (at > 12), math.nan)},
        }
        for at, height in enumerate(heights)
    ]
    columns, values = table(0.01, rows)
    screen, ends = Screen("sim://mice", columns), np.cumsum(sizes)
    for size, end in zip(sizes, ends.tolist(), strict=True):
        screen.add(values[end - size : end])
    shown = screen.render(health(), 80, 40).plain
    assert shown == screen_of("sim://mice", 0.01, rows).render(health(), 80, 40).plain
    assert "mouse 3 LEFT OUT since 0.1 s" in shown and "1.70┤" in shown


@pytest.mark.parametrize("width", [80, 50, 30])
def test_faults_and_exclusions_are_never_cut(width: int) -> None:
    pose = {quantities.X: (1.0, 0.001), quantities.Y: (0.0, 0.001), quantities.HEADING: (0.2, 0.01)}
    masks = [2.0 if 20 <= at < 30 or at >= 51 else 0.0 for at in range(100)]
    rows = [{"planar-ekf": pose, "mice": {**pose, quantities.EXCLUDED: (mask, math.nan)}} for mask in masks]
    screen = screen_of("sim://mice", 0.1, rows)
    shown = screen.render(health(imu={"state": "silent"}), width, 6).plain
    assert "IMU NOT ANSWERING" in shown
    assert "mouse 2 LEFT OUT since 5.1 s" in shown
    mice = {f"mouse{port}": {"state": "left out" if port == 2 else "ok"} for port in (1, 2, 3)}
    shown = screen.render(health(**mice), width, 20).plain
    assert all(state in shown for state in ("MOUSE1 ok", "MOUSE2 left out", "MOUSE3 ok")) and "MOUSE2 is" not in shown


def test_a_faulty_sensor_blanks_the_estimates_that_need_it_and_says_since_when() -> None:
    """Filters predict on for seconds; a frozen number beside a fault would pass for a measurement."""
    rows = [{"joint": {quantities.HEIGHT: (1.5, 0.1)}, "baro": {quantities.HEIGHT: (1.7, 0.3)}}] * 9
    screen = screen_of("sim://link", 0.1, rows)
    lines = screen.render(health(imu={"state": "silent", "since_s": 25.9}), 80, 24).plain.splitlines()
    assert (
        lines[1] == "IMU NOT ANSWERING (4.1 s): check VCC, SDA=A4, SCL=A5" and "IMU not answering BARO ok" in lines[0]
    )
    assert lines[2].split("   ")[1] == "1.700 m ±30.0 cm"
    assert [line.split()[:3] for line in lines[-2:]] == [["joint", "–", "–"], ["▸", "baro", "1.700"]]
    frozen = screen.render(health(imu={"state": "frozen", "since_s": 29.0}), 80, 24).plain
    assert "NOT ANSWERING" not in screen.render(health(imu={"state": "silent"}, silent_s=2.0), 80, 24).plain
    assert "IMU FROZEN (1.0 s): unplug the board and plug it in again" in frozen
    pulled = health()
    pulled.silent_s = 3.14
    lines = screen.render(pulled, 80, 24).plain.splitlines()
    assert lines[1] == "NO SAMPLES (3.1 s): check the cable of the board" and lines[2].endswith("not known")
    assert lines[0].endswith("IMU – BARO –")
    assert [line.split()[-2:] for line in lines[-2:]] == [["–", "–"]] * 2
    pulled.silent_s = 0.9
    assert screen.render(pulled, 80, 24).plain == screen.render(health(), 80, 24).plain


def test_a_difference_that_rounds_to_zero_has_no_sign() -> None:
    rows = [{"joint": {quantities.HEIGHT: (1.5, 0.01)}, "tilt": {quantities.HEIGHT: (1.5 - 2e-5, 0.01)}}] * 9
    assert screen_of("sim://link", 0.1, rows).render(health(), 80, 24).plain.endswith("1.0 cm    0.0 mm")


def test_a_curve_ends_where_a_sensor_failed() -> None:
    """Filters predict on until the fault is found, and for a second more: the curve fell by a metre."""
    heights = [1.5 + 0.03 * (at % 2) - 0.1 * max(at - 60, 0) for at in range(80)]
    screen = screen_of("sim://link", 0.05, [{"joint": {quantities.HEIGHT: (h, 0.01)}} for h in heights])
    for sensors in ({"imu": {"state": "silent", "since_s": 3.0}}, {}):  # the fault, and after it
        curve_lines = [line for line in screen.render(health(**sensors), 80, 24).plain.splitlines() if "┤" in line]
        assert float(curve_lines[-1].split("┤")[0]) > 1.4, curve_lines


def test_an_empty_curve_gives_way_to_one_with_values() -> None:
    angle = {quantities.ANGLE: (math.nan, math.nan)}
    rows = [{"chain": angle, "joint": {quantities.HEIGHT: (1.5 + 0.001 * at, 0.1)}} for at in range(100)]
    assert "┤" in screen_of("sim://chain", 0.05, rows).render(health(), 80, 12).plain


def test_an_unplugged_mouse_does_not_disagree() -> None:
    pose = {quantities.X: (1.0, 0.001), quantities.Y: (0.0, 0.001), quantities.HEADING: (0.2, 0.01)}
    screen = screen_of("sim://mice", 0.1, [{"mice": {**pose, quantities.EXCLUDED: (2.0, math.nan)}}] * 9)
    shown = screen.render(health(mouse2={"state": "silent", "since_s": 28.0}), 80, 24).plain
    assert "MOUSE2 NOT ANSWERING (2.0 s): check its cable and pull-ups" in shown and "LEFT OUT" not in shown
    assert "x 1.0000 m" in shown


def test_an_unknown_height_is_said_to_be_unknown() -> None:
    screen = screen_of("sim://link", 0.1, [{"joint-inertial": {quantities.HEIGHT: (math.nan, math.nan)}}])
    assert "not known" in screen.render(health(), 80, 24).plain


def test_the_curve_covers_its_values() -> None:
    times = [0.1 * at for at in range(200)]
    lines = curve(times, [math.sin(time) for time in times], 20.0, 78, 5, 0.02)
    assert len(lines) == 5 and {len(line) for line in lines} == {78}
    assert [line.split("┤")[0].strip() for line in lines] == ["1.0", "0.5", "0.0", "−0.5", "−1.0"]
    assert all(any(char > "\u2800" for char in line.split("┤")[1]) for line in lines)
    far = curve([0.0, 1.0], [-1234.5, -1234.5 + 1e-9], 20.0, 30, 5, 0.02)
    assert [line.split("┤")[0] for line in far] == ["−1234.490", "−1234.495", "−1234.500", "−1234.505", "−1234.510"]
    assert time_axis(20.0, 4, 24) == "    └ 20 s ago ──── now"
    assert curve([0.0], [math.nan], 20.0, 30, 3, 0.02) == [" " * 30] * 3


def test_a_code_page_keeps_signs_columns_and_the_curve() -> None:
    assert replacement("▸ joint  1.59 m ±0.4 mm  −3.2°") == "> joint  1.59 m +/-0.4 mm  -3.2 deg"
    canvas = Canvas(8, 1)
    canvas.line((0, 0), (15, 3))
    assert replacement(canvas.lines()[0]) == "''----.." and replacement("\u2800\u28ff") == " :"


def test_dots_are_where_they_should_be() -> None:
    canvas = Canvas(2, 1)
    canvas.dot(0, 0)
    canvas.dot(3, 3)
    canvas.dot(99, 99)
    assert canvas.lines() == ["\u2801\u2880"]


def test_the_path_ends_at_the_robot() -> None:
    lines, scale = path_map([0.0, 1.0, 1.0], [0.0, 0.0, 1.0], 20, 10)
    # 1 m is 39 dots of 40 high; a character is two dots wide, and 0.2 m are four of them.
    assert scale == "├──┤ 0.2 m" and path_map([math.nan], [0.0], 20, 10) == ([" " * 20] * 10, "")
    assert lines[0].rstrip("\u2800").endswith("o")


def test_standard_deviations_are_shown_in_fitting_units() -> None:
    assert length_with_std(1.5906, 0.0004) == "1.5906 m ±0.4 mm"
    assert length_with_std(math.nan, 0.1) == "not known"
    assert length_with_std(1.5906, math.nan) == "1.591 m"


@pytest.mark.parametrize("std", [0.0, 4e-5, 0.00009499, 0.000095, 0.0004, 0.0099, 0.00996, 0.12, 0.994, 0.996, 12.0])
def test_a_value_and_its_deviation_end_at_the_same_digit(std: float) -> None:
    value, unit, bound, bound_unit = length_with_std(12.345678, std).replace("±", "").split()
    size = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
    assert unit == "m" and float(bound) > 0
    last_digits = [10.0 ** -len(text.partition(".")[2]) * size[of] for text, of in ((value, unit), (bound, bound_unit))]
    assert last_digits[0] == pytest.approx(last_digits[1])
    assert aligned_length(12.345678, std).index(".") == 2
    angle, bound = angle_with_std(-12.345678, 10 * std).replace("°", "").split(" ±")
    assert len(angle.partition(".")[2]) == len(bound.partition(".")[2]) and float(bound) > 0


def test_errors_in_a_row_end_at_the_same_digit() -> None:
    assert same_digits(0.0486, 0.0172, 1.3, -5.07e-6) == ["0.0486", "0.0172", "1.3000", "0.0000"]
    assert same_digits(123.4, 5.0) == ["123", "5"] and same_digits(0.0, 0.0) == ["0", "0"]


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
        complete, newest, caught_up = late.process(block[at : at + 5])
        rows.append(complete)
        tilt, joint = newest[1 : 1 + 4], newest[5:]
        assert np.isnan(tilt).all() == (at < 20) and np.isnan(joint).all() == (at < 40)
        # A filter that catches up gives all rows so far once more: the view's curve does not begin at this moment.
        assert len(caught_up) == (at + 5 if at in (20, 40) else 0)
        if at == 20:
            assert np.array_equal(caught_up[:, 1:5], expected[:25, 1:5], equal_nan=True)
            assert np.isnan(caught_up[:, 5:]).all()
    rows.append(late.finish())
    assert [len(part) for part in rows[:8]] == [0] * 8
    assert np.array_equal(np.concatenate(rows), expected, equal_nan=True)
    extremes = Extremes(whole.columns)
    extremes.add(expected)
    assert extremes.summary()["tilt", quantities.HEIGHT][1] == expected[:, whole.columns.index("tilt_height_m")].max()


def data_rows(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


def test_keys_a_resize_and_a_redirected_stdout_on_a_terminal(tmp_path: Path) -> None:
    """rich captures stdout if it is allowed to: then no row arrives."""
    rows, recording = tmp_path / "rows.csv", tmp_path / "rec.csv"
    command = ["estimate", "--live", "--port", "sim://link", "--filter", "joint", "--filter", "tilt"]
    with rows.open("wb") as stdout, Terminal(*command, "--record", recording, stdout=stdout) as terminal:
        shown = ("HEIGHT over joint", "▸ joint", "m mark   f next filter   q stop")
        terminal.until(lambda text: all(part in text for part in shown))
        terminal.press("m")
        terminal.until(lambda text: "mark at " in text)
        terminal.press("f")
        terminal.until(lambda text: "▸ tilt" in text)
        terminal.resize(52, 20)
        wide = "difference"
        text = terminal.until(lambda text: "HEIGHT" in text and "▸ tilt" in text and wide not in text)
        assert text.count("HEIGHT") == text.count(" lost") == text.count("mark at ") == 1, text
        assert text.startswith("Running: joint, tilt"), text
        terminal.press("q")
        assert terminal.wait() == 0, terminal.text
        assert "HEIGHT" not in terminal.text and terminal.text.count("lowest") == 1
        assert terminal.reads_lines
    assert len(data_rows(rows)) == len(data_rows(recording)) > 20
    closing = json.loads(recording.read_text().splitlines()[-1].removeprefix("# "))
    assert len(closing["marks"]) == 1 and closing["ended"] == "interrupted"


def test_a_terminal_that_cannot_move_its_cursor_shows_a_line() -> None:
    command = ["estimate", "--live", "--port", "sim://link?speed=0", "--filter", "tilt", "--duration", 2]
    with Terminal(*command, kind="dumb") as terminal:
        assert terminal.wait() == 0, terminal.text
    assert "200 samples" in terminal.text and "lowest" in terminal.text
    line = link_screen().line(health(imu={"state": "silent", "since_s": 25.9}), 100)
    assert line.startswith("25.0 s   IMU NOT ANSWERING (4.1 s): check VCC") and "HEIGHT" in line and len(line) <= 78
    for width in (78, 60, 50):  # no part without its value
        assert re.fullmatch(
            r"25\.0 s   HEIGHT .* m ±0\.4 mm(   (roll|pitch) \+[0-9.]+°)*", link_screen().line(health(), width)
        )


@pytest.mark.parametrize("output", ["--json", "-o-"])
def test_rows_on_the_terminal_itself_are_whole(output: str) -> None:
    """A view or a progress line on the same terminal would overwrite them."""
    command = ["estimate", "--live", "--port", "sim://link", "--filter", "tilt", "--duration", 2, output]
    with Terminal(*command, columns=300, rows=250) as terminal:
        assert terminal.wait() == 0, terminal.text
    lines = [line for line in terminal.text.splitlines() if line]
    assert lines[0] == "Running: tilt"
    rows = [line for line in lines if re.match(r'\{"time_s"|\d+\.\d{6},', line)]
    # On a loaded machine the fitted rate of the board's clock may make two seconds one sample longer or shorter.
    counted = int(re.search(r", (\d+) samples, ", terminal.text)[1])  # type: ignore[index]
    assert len(rows) == counted == pytest.approx(200, abs=2)
    assert all(line.endswith("}") if "{" in line else line.count(",") == 4 for line in rows)
    assert lines.index(rows[-1]) - lines.index(rows[0]) == counted - 1 and "HEIGHT" not in terminal.text


def test_the_lines_after_the_view_break_between_words() -> None:
    command = ["estimate", "--live", "--port", "sim://link?speed=0", "--filter", "tilt", "--duration", 1]
    with Terminal(*command, columns=30) as terminal:
        assert terminal.wait() == 0, terminal.text
    assert "1.0 s, 100 samples, 100.0 Hz,\n0 lost, 0 corrupt" in terminal.text


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("info a-recording-of-another-day-that-nobody-kept.csv", "linkpose: "),
        ("estimate --rate 100", "Error: name a RECORDING, or add --live to estimate\nfrom the board"),
    ],
)
def test_failures_break_between_words(command: str, sentence: str) -> None:
    with Terminal(*command.split(), columns=52) as terminal:
        assert terminal.wait() in (1, 2)
    assert sentence in terminal.text
    assert all(word in terminal.text for word in command.split()[1:] if word.endswith(".csv"))


def test_a_mark_before_the_first_sample_is_set_at_it() -> None:
    marks: list[float] = []
    marker, block = Marker(marks.append), LinkRun(1, 0, 1.0).measurements()
    marker()
    marker.advance(block[:0])
    assert marks == []
    marker.advance(block[:3])
    marker.advance(block[3:5])
    marker()
    assert marks == pytest.approx([0.02, 0.04])


def test_a_recording_is_marked_and_ended_by_ctrl_c(tmp_path: Path) -> None:
    recording = tmp_path / "rec.csv"
    with Terminal("record", recording, "--port", "sim://link") as terminal:
        terminal.until(lambda text: "m marks an instant" in text and " samples" in text)
        terminal.press("m")
        terminal.until(lambda text: "mark at " in text)
        terminal.press("\x03")
        assert terminal.wait() == 0, terminal.text
        assert "next: linkpose estimate" in terminal.text and terminal.reads_lines
    assert len(json.loads(recording.read_text().splitlines()[-1].removeprefix("# "))["marks"]) == 1


@pytest.mark.parametrize("width", [100, 60, 49, 39, 29])
def test_the_line_of_a_recording_never_loses_losses_and_faults(width: int) -> None:
    """It was cut at its end, where gaps and faults are."""
    ok = SimpleNamespace(
        duration_s=8.9, samples=628, rate_hz=70.6, lost=261, corrupt=SimpleNamespace(total=0), gaps=[1], status=None,
        silent_s=0.0, sensors={"imu": {"state": "silent", "invalid": {"silent": 30}}, "baro": {"state": "ok"}},
    )  # fmt: skip
    line = progress_line(ok, width)
    assert "261 lost" in line and line.endswith("IMU not answering") and len(line) <= width
    ok.silent_s, ok.sensors = 2.34, {"imu": {"state": "ok"}}
    assert "NO SAMPLES (2.3 s)" in progress_line(ok, width) and "NO SAMPLES" not in health_line(ok)


def test_without_a_terminal_there_are_no_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    with Keys(True) as keys:
        assert not keys.are_read and keys.pressed() == ""


def test_a_narrow_screen_drops_the_slow_columns_first() -> None:
    wide, narrow = (link_screen().render(health(), width, 24).plain for width in (80, 34))
    assert "sim://link" in wide and "difference from best" in wide
    assert "sim://link" not in narrow and "difference" not in narrow
    assert "IMU ok BARO ok" in narrow and "0 lost" in narrow and "±0.4 mm" in narrow


def test_a_curve_is_of_one_filter_and_a_robot_has_no_height_without_j2s() -> None:
    """A barometer starts at once, a better filter later: its curve does not begin with the barometer's noise."""
    heights = [1.5 + 0.001 * at if at >= 50 else math.nan for at in range(100)]
    rows = [{"joint": {quantities.HEIGHT: (h, 0.01)}, "baro": {quantities.HEIGHT: (9.0, 0.3)}} for h in heights]
    screen = screen_of("sim://link", 0.05, rows)
    curve_lines = [line for line in screen.render(health(), 80, 24).plain.splitlines() if "┤" in line]
    assert [float(line.split("┤")[0]) for line in (curve_lines[0], curve_lines[-1])] == pytest.approx(
        [1.6, 1.55], abs=0.01
    )
    pose = {quantities.X: (1.0, 0.01), quantities.Y: (2.0, 0.01), quantities.HEADING: (0.1, 0.01)}
    robot = screen_of("sim://mice", 0.1, [{"tilt": {quantities.HEIGHT: (math.nan, math.nan)}, "mice": pose}])
    shown = robot.render(health(), 80, 24).plain
    assert "HEIGHT" not in shown and "x 1.000 m ±1.0 cm   y 2.000 m ±1.0 cm   heading +5.7° ±0.6°" in shown
    assert all(len(line) <= 40 for line in robot.render(health(), 40, 24).plain.splitlines())
    assert "heading +5.7° ±0.6°" in robot.render(health(), 40, 24).plain


def test_the_final_table_fits() -> None:
    height = quantities.HEIGHT
    summary = {("joint-inertial", height): (1.2, 1.65, 0.001), ("baro", height): (0.9, 2.0, 0.3)}
    assert [max(map(len, final_table(summary, width))) for width in (40, 80)] == [36, 46]
    assert final_table({}, 80) == []
    robot = {("planar-ekf", quantities.X): (-1e-6, 1.0, 1e-4), ("planar-ekf", quantities.HEADING): (-3.0, 1.0, 1e-3)}
    lines = final_table(robot, 40)
    assert max(map(len, lines)) <= 40 and lines[1].split()[2] == "0.0000"


def test_the_final_table_lists_joint_angles_and_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("linkpose.extremes.ROWS", 1)  # rows that are looked at together
    columns = ["time_s", "chain_angle_deg", "chain_angle_std_deg", "mice_x_m", "mice_y_m"]
    extremes = Extremes([*columns, "mice_heading_rad", "mice_heading_std_rad", "tilt_x_m"])
    std = math.radians(0.5)
    for heading in ([0.0, 3.0], [math.nan, -2.0], [1.0]):  # a full turn, and a rad more
        extremes.add(np.array([[0.0, -0.04, 1.0, 1.0, 2.0, rad, std, 5.0] for rad in heading]))
    extremes.add(np.array([[1.0, 30.0, 1.0, 3.0, 4.0, math.nan, math.nan, 6.0]]))
    lines = [line.split() for line in final_table(extremes.summary(), 80)]
    assert lines[1] == ["chain", "angle", "0.0°", "+30.0°", "1.0°"]
    assert [line[:2] for line in lines[2:]] == [["mice", name] for name in ("x", "y", "heading")]
    assert lines[2][-1] == "–" and lines[4][2:] == ["0.0°", f"+{math.degrees(1 + 2 * math.pi):.1f}°", "0.5°"]


def test_the_final_table_names_quantities_in_words() -> None:
    assert "chain height 1" in final_table({("chain", quantities.HEIGHT1): (-0.25, -0.16, 0.002)}, 80)[1]


def test_the_final_table_has_the_median_deviation() -> None:
    """A filter begins with a large σ; its root mean square would be that of the first second."""
    extremes = Extremes(["time_s", "tilt_height_m", "tilt_height_std_m", "mice_heading_rad", "mice_heading_std_rad"])
    extremes.add(np.array([[0.0, 1.0, 0.5, 0.0, 0.5]] * 20 + [[0.0, 1.0, 4e-4, 0.0, 1e-5]] * 80))
    (_, _, height), (_, _, heading) = extremes.summary().values()
    assert height == pytest.approx(4e-4, rel=0.03) and heading == pytest.approx(1e-5, rel=0.03)
    assert [line.split()[-1] for line in final_table(extremes.summary(), 80)[1:]] == ["mm", "0.001°"]


EVIL = "\x1b]0title\x07\x1b[31m"


def hostile_texts(tmp_path: Path, linkpose: Callable[..., Any]) -> list[list[object]]:
    """Commands whose input holds escape sequences, in what they print."""
    recording, truth, estimate = tmp_path / f"r{EVIL}.csv", tmp_path / "t.csv", tmp_path / "e.csv"
    linkpose("simulate", "link", "--duration", 3, "-o", recording, "--truth", truth)
    linkpose("estimate", recording, "--filter", "tilt", "-o", estimate)
    estimate.write_text(estimate.read_text().replace("tilt_height", f"{EVIL}_height"))
    device = tmp_path / "d.csv"
    device.write_text(recording.read_text().replace("sim://link", json.dumps(EVIL)[1:-1]))
    written = tmp_path / f"w{EVIL}.csv"
    return [
        ["info", recording],
        ["info", device],
        ["evaluate", estimate, truth],
        ["estimate", recording, "--filter", "tilt", "-o", written],
        ["record", written, "--force", "--port", "sim://link?speed=0", "--duration", 1],
        ["plot", estimate, "-o", tmp_path / "p.png"],
    ]


def test_escape_sequences_from_files_never_reach_a_terminal(tmp_path: Path, linkpose: Callable[..., Any]) -> None:
    """click removes them from what goes to a file or a pipe, so that only a terminal shows that they are escaped."""
    for command in hostile_texts(tmp_path, linkpose):
        with Terminal(*command, columns=200) as terminal:
            assert terminal.wait() == 0, terminal.text
            for sequence in (b"\x1b]", b"\x07", b"\x1b[31m"):
                assert sequence not in terminal.received, command[0]
            assert "Warning" not in terminal.text


def test_a_recording_ends_in_a_table_on_a_terminal(tmp_path: Path, linkpose: Callable[..., Any]) -> None:
    recording, rows = tmp_path / "r.csv", tmp_path / "rows.csv"
    linkpose("simulate", "link", "--duration", 3, "-o", recording, "--truth", tmp_path / "t.csv")
    with Terminal("estimate", recording, "--filter", "tilt", columns=200) as terminal:
        assert terminal.wait() == 0
        lines = terminal.text.split("\n")
    at = next(i for i, line in enumerate(lines) if line.split()[:1] == ["filter"])
    assert lines[at + 1].split()[0] == "tilt" and lines[at + 2] == "300 rows of tilt"
    assert lines[at + 3] == f"next: linkpose estimate {recording} --filter tilt -o estimate.csv"
    assert "100%" not in terminal.text
    with Terminal("estimate", recording, "--filter", "chain", columns=200) as terminal:
        assert terminal.wait() == 1
        assert terminal.text.startswith("linkpose: the filter chain cannot run")
    with rows.open("wb") as stdout, Terminal("estimate", recording, "--filter", "tilt", stdout=stdout) as terminal:
        assert terminal.wait() == 0 and "next:" not in terminal.text
    assert len(data_rows(rows)) == 301


class _Tty(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("width", "most"), [(120, 80), (78, 78), (72, 72)])
def test_a_table_is_as_wide_as_the_terminal(width: int, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table of a robot was 2 characters wider than a terminal of 80: each of its lines broke."""
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr("sys.stdout", shown := _Tty())
    table = Table(*(f"column {at}" for at in range(7)))
    table.add_row(*"1234567")
    show_table(table)
    assert max(map(len, re.sub(r"\x1b\[[0-9;]*m", "", shown.getvalue()).splitlines())) <= most


def test_sentences_break_between_words_on_a_terminal_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    text = "tilt:\n  height: many well-known errors"
    assert wrapped(text, io.StringIO()) == text
    assert wrapped(text, _Tty()) == "tilt:\n  height: many\n  well-known errors"


def test_the_next_filter_is_shown_with_its_own_curve() -> None:
    screen = link_screen()
    before = screen.render(health(), 80, 24).plain
    for _ in range(2):
        screen.next_filter()
    chosen = screen.render(health(), 80, 24).plain
    assert "▸ joint-inertial" in before and "▸ tilt" in chosen
    height_m = float(before.split("joint   ")[1].split()[0])
    assert f"{height_m - 0.02:.3f}" in chosen.splitlines()[1]
    screen.next_filter()
    assert screen.render(health(), 80, 24).plain == before


def test_a_chain_shows_its_joint_angle_with_its_deviation_and_curve() -> None:
    link = {quantities.HEIGHT: (0.2, 0.001)}
    angles = [{quantities.ANGLE: (30 * math.sin(0.1 * at), 0.4), quantities.HEIGHT1: (0.25, 0.01)} for at in range(200)]
    screen = screen_of("sim://chain", 0.1, [{"joint-inertial": link, "chain": values} for values in angles])
    shown = screen.render(health(), 80, 24).plain
    assert "joint angle +26.0° ±0.4°   height 1 0.250 m ±1.0 cm" in shown and "HEIGHT over joint" in shown
    assert shown.splitlines()[2].strip().startswith("30┤")
    assert "height 1" not in screen.render(health(), 40, 24).plain


def test_a_ball_joint_shows_its_three_angles() -> None:
    angles = zip(quantities.BALL_ANGLES, ((42.0, 0.9), (-3.0, 0.8), (math.nan, math.nan)), strict=True)
    screen = screen_of("sim://chain", 0.1, [{"chain": dict(angles) | {quantities.HEIGHT1: (0.2, 0.001)}}])
    line = "flexion +42.0° ±0.9°   abduction −3.0° ±0.8°   axial rotation not known"
    assert line in screen.render(health(), 80, 24).plain.splitlines()
    assert "flexion +42.0° ±0.9°   abduction −3.0° ±0.8°" in screen.render(health(), 60, 24).plain.splitlines()
