"""Logs, beacons and true paths: what is read, and what is refused with file, line and cure."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from linkpose.errors import LinkposeError
from linkpose.localization.carmen import Reading, as_log, flaser_angles, format_reading
from linkpose.localization.events import Event, Scan, format_event
from linkpose.localization.logs import read_log
from linkpose.localization.maps import load_map
from linkpose.localization.measuring import thesis_beams
from linkpose.localization.plausibility import check_units
from linkpose.localization.tables import Truth, read_beacons, read_truth, score

HEADER = "time_s,kind,a,b,c\n"


def written(tmp_path, text, name="log.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_every_kind_is_read_and_written_alike(tmp_path):
    events = [
        Event(0.0, "pose", (1.0, -2.0, 0.5)),
        Event(0.0, "odometry", (0.5, -0.1)),
        Event(0.1, "range", (12.25,), "7"),
        Event(0.1, "bearing_range", (3.5, -1.25), "12"),
        Event(0.2, "depth", (4.0,)),
        Event(0.2, "velocity", (0.5, 0.0, -0.25)),
        Event(0.3, "attitude", (0.0, 0.125, 3.0)),
    ]
    text = "# a comment\n" + HEADER + "".join(f"{format_event(event)}\n" for event in events)
    read = read_log(written(tmp_path, text)).events
    assert [(e.time_s, e.kind, e.values, e.beacon) for e in read] == [
        (e.time_s, e.kind, e.values, e.beacon) for e in events
    ]
    assert read[2].line == 5


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "holds no measurements"),
        (HEADER, "holds no measurements"),
        ("time,what,a\n0,depth,1\n", "line 1: the header"),
        (HEADER + "0,depth,1,,\n0.1,dep", "line 3: unknown kind 'dep'"),
        (HEADER + "0,depth,1,,\n0.1", "line 3: the row is cut short"),
        (HEADER + "0,pose,1,2\n", "line 2: pose needs x m, y m, heading rad"),
        (HEADER + "0,range,1,,\n", "line 2: range needs beacon, range m"),
        (HEADER + "0,depth,nan,,\n", "line 2: 'nan' is not a number"),
        (HEADER + "0,depth,inf,,\n", "line 2: 'inf' is not a number"),
        (HEADER + "x,depth,1,,\n", "line 2: 'x' is not a number"),
    ],
)
def test_a_bad_row_is_named_with_its_line(tmp_path, text, reason):
    with pytest.raises(LinkposeError, match=reason) as failure:
        read_log(written(tmp_path, text))
    assert "log.csv" in str(failure.value)


def test_what_is_no_text_is_refused(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(b"\xff\xfe\x00\x81" * 40)
    with pytest.raises(LinkposeError, match="it must be time_s,kind,a,b,c"):
        read_log(path)
    with pytest.raises(LinkposeError, match="No such file"):
        read_log(tmp_path / "gone.csv")


RANGES = " ".join(f"{1 + 0.01 * i:.2f}" for i in range(181))
ODOM = "ODOM 1.0 2.0 0.0 0.5 0.1 0 100.0 host 0.0"
FLASER = f"FLASER 181 {RANGES} 1.3 2.0 0.0 1.1 2.0 0.0 100.2 host 0.2"
WIDE = " ".join(f"{5 + 0.01 * i:.2f}" for i in range(271))
ROBOTLASER = (
    f"ROBOTLASER1 0 -2.356194 4.712389 0.0174533 30.0 0.01 0 271 {WIDE} 2 0.1 0.2 "
    "1.4 2.1 0.1 1.2 2.0 0.1 0.5 0.1 0.5 0.5 0 100.4 host 0.4"
)


def test_carmen_lines(tmp_path):
    path = written(tmp_path, f"# comment\nPARAM robot_length 40\n{ODOM}\n{FLASER}\n{ROBOTLASER}\n", "run.log")
    read = read_log(path)
    assert read.is_carmen
    log, start = read.events, read.start
    assert start == (1.0, 2.0, 0.0)
    first, second, scan, third, wide = log
    assert (first.kind, first.time_s, first.values) == ("odometry", 100.0, pytest.approx((0.5, 0.0)))
    assert second.time_s == pytest.approx(100.2)
    assert second.values[1] == pytest.approx(0.5)  # 0.1 rad in 0.2 s
    assert third.values == (0.0, 0.0)
    assert isinstance(scan, Scan) and len(scan.ranges_m) == 181
    chosen = thesis_beams(scan)
    assert np.degrees(scan.angles_rad[chosen]) == pytest.approx(np.arange(-90, 91, 10))
    assert scan.ranges_m[chosen] == pytest.approx(1 + 0.1 * np.arange(19))
    assert scan.mount == pytest.approx((0.2, 0.0, 0.0))
    chosen = thesis_beams(wide)
    assert np.degrees(wide.angles_rad[chosen]) == pytest.approx(np.arange(-90, 91, 10), abs=0.5)
    assert wide.max_range_m == 30.0
    assert wide.mount == pytest.approx(
        (0.2 * math.cos(0.1) + 0.1 * math.sin(0.1), 0.1 * math.cos(0.1) - 0.2 * math.sin(0.1), 0)
    )


def test_beams_of_180_readings_and_beams_without_echo():
    ranges = np.full(180, 4.0)
    ranges[90], ranges[10] = 80.0, 0.0
    (_, scan) = as_log([Reading(0.0, (0.0, 0.0, 0.0), ranges, flaser_angles(180))])
    chosen = thesis_beams(scan)
    assert np.degrees(scan.angles_rad[chosen][[0, 9, 18]]) == pytest.approx([-90, 0, 89])
    assert np.isnan(scan.ranges_m[chosen][[1, 9]]).all()
    assert np.isfinite(scan.ranges_m[chosen]).sum() == 17


def test_scans_of_which_every_nth_beam_was_kept_and_beams_written_as_infinity(tmp_path):
    """180 readings of 1 degree, every third kept, have steps of 3 degrees; 181 readings, too."""
    for count, step, last in (
        (60, 3.0, 87.0),
        (61, 3.0, 90.0),
        (90, 2.0, 88.0),
        (720, 0.25, 89.75),
        (271, 2 / 3, 90.0),
    ):
        angles = np.degrees(flaser_angles(count))
        assert (angles[0], angles[1] - angles[0], angles[-1]) == pytest.approx((-90.0, step, last))
    text = FLASER.replace("FLASER 181 1.00 1.01", "FLASER 181 inf nan")
    scan = read_log(written(tmp_path, f"{ODOM}\n{text}\n", "run.log")).events[-1]
    assert np.flatnonzero(np.isnan(scan.ranges_m)).tolist() == [0, 1]


def test_odometry_between_two_poses_is_the_arc_that_joins_them():
    """A quarter of a circle of 2 m radius in 4 s, over the half turn."""
    start = (0.0, 0.0, math.radians(170))
    end = (
        2 * (math.sin(math.radians(260)) - math.sin(start[2])),
        -2 * (math.cos(math.radians(260)) - math.cos(start[2])),
    )
    log = as_log([Reading(10.0, start), Reading(14.0, (*end, math.radians(-100)))])
    assert log[0].values == pytest.approx((2 * math.pi / 2 / 4, math.pi / 2 / 4))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "holds no"),
        (f"{ODOM}\n{FLASER[:200]}\n", "line 2: FLASER is cut short"),
        (f"{ODOM}\nODOM 1 2\n", "line 2: ODOM is cut short"),
        (f"{ODOM}\n{ROBOTLASER[:300]}\n", "line 2: ROBOTLASER1 is cut short"),
        (f"{ODOM.replace('2.0', 'nan')}\n", "line 1: 'nan' is not a number"),
        (f"{FLASER.replace('1.00', '1.0O')}\n{ODOM}\n", "line 1: '1.0O' is not a number"),
        (f"{FLASER.replace('181', '18.5')}\n", "line 1: '18.5' is no number of readings"),
    ],
)
def test_a_damaged_carmen_line_is_named(tmp_path, text, reason):
    with pytest.raises(LinkposeError, match=reason):
        read_log(written(tmp_path, text, "run.log"))


def test_formatted_readings_read_back(tmp_path):
    readings = [
        Reading(5.0, (1.0, 2.0, 0.25)),
        Reading(5.5, (1.5, 2.0, 0.25), np.linspace(1, 9, 181), flaser_angles(181), (1.5, 2.0, 0.25)),
    ]
    read = read_log(written(tmp_path, "\n".join(map(format_reading, readings)) + "\n", "run.log"))
    log, start = read.events, read.start
    assert start == (1.0, 2.0, 0.25)
    assert [event.time_s for event in log] == [5.0, 5.5, 5.5]
    assert log[2].ranges_m == pytest.approx(as_log(readings)[2].ranges_m, abs=1e-3)


def test_beacons(tmp_path):
    assert read_beacons(written(tmp_path, "id,x_m,y_m\n1,2,3\n07,4.5,-1")) == {"1": (2, 3, 0), "7": (4.5, -1, 0)}
    assert read_beacons(written(tmp_path, "# north hall\nid,x_m,y_m,z_m\n1,2,3,4\n")) == {"1": (2, 3, 4)}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "ends before its first row"),
        ("id,x,y\n1,2,3\n", "header 'id,x,y'"),
        ("id,x_m,y_m\n", "has a header but no row"),
        ("id,x_m,y_m\n1,2\n", "line 2: 2 fields where the header has 3"),
        ("id,x_m,y_m\n1,2,nan\n", "line 2: 'nan' is not a number"),
        ("id,x_m,y_m\n1,2,3\n1.0,5,6\n", "line 3: beacon 1 is listed twice"),
    ],
)
def test_bad_beacons_are_named(tmp_path, text, reason):
    with pytest.raises(LinkposeError, match=reason):
        read_beacons(written(tmp_path, text, "beacons.csv"))


def test_score_interpolates_wraps_and_skips_gaps(tmp_path):
    text = "time_s,x_m,y_m,heading_rad\n0,0,0,3.1\n1,1,0,-3.1\n10,10,0,-3.1\n11,11,0,-3.1\n"
    truth = read_truth(written(tmp_path, text, "truth.csv"))
    times = np.array([0.5, 5.0, 10.5, 20.0])  # the second falls into a gap of 9 s, the last after the end
    result = score(
        times, np.array([[0.5, 0.3], [99, 99], [10.5, -0.4], [99, 99]]), np.array([math.pi, 0, 3.1832, 0]), truth
    )
    assert result.position_rmse_m == pytest.approx(math.sqrt((0.09 + 0.16) / 2))
    assert result.position_max_m == pytest.approx(0.4)
    assert result.heading_rmse_rad == pytest.approx(0.0, abs=1e-3)


def test_truth_that_does_not_meet_the_log_is_refused(tmp_path):
    truth = Truth(np.array([0.0, 1.0]), np.zeros((2, 2)), None)
    with pytest.raises(LinkposeError, match="has no pose at the log's times"):
        score(np.array([5.0]), np.zeros((1, 2)), np.zeros(1), truth)
    with pytest.raises(LinkposeError, match="line 2: x_m is no finite number"):
        read_truth(written(tmp_path, "time_s,x_m,y_m\n0,,0\n1,1,1\n"))
    with pytest.raises(LinkposeError, match="no column y_m"):
        read_truth(written(tmp_path, "time_s,x_m\n0,0\n"))


WORDS = st.sampled_from(
    [
        *"0123456789-.,# \n\x00é",
        *("time_s,kind,a,b,c\n", "id,x_m,y_m\n", "range,", "pose,", "nan", "1e999"),
        *("ODOM ", "FLASER ", "ROBOTLASER1 ", "image: map.pgm\n", "resolution: ", "origin: [", "]\n"),
    ]
)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(words=st.lists(WORDS, max_size=60))
def test_whatever_a_file_holds_it_is_read_or_refused(tmp_path, words):
    """No other exception than the one that the user reads."""
    path = written(tmp_path, "".join(words))
    for read in (read_log, read_beacons, read_truth, load_map):
        try:
            read(path)
        except LinkposeError as failure:
            assert str(path) in str(failure)


def test_disorder_and_lines_without_a_time(tmp_path):
    """As in public logs: lines out of order, lines with time 0, parameters in Latin-1."""
    lines = [f"ODOM {i}.0 0 0 0 0 0 {1000.0 + i} h 0" for i in range(6)]
    lines[2], lines[3] = lines[3], lines[2]
    lines.insert(4, "ODOM 9 9 9 0 0 0 0.0 h 0")
    path = tmp_path / "run.log"
    path.write_bytes(b"PARAM robot_name caf\xe9\n" + "\n".join(lines).encode() + b"\nODOM 7.0 0")
    read = read_log(path)
    assert read.is_carmen
    assert [event.time_s for event in read.events] == [1000.0 + i for i in range(6)]
    assert all(event.values == pytest.approx((1.0, 0.0)) for event in read.events[:-1])
    assert "1 line moved" in " ".join(read.remarks)
    assert "1 line without a time" in " ".join(read.remarks)
    assert "cut short and left out" in " ".join(read.remarks)


def test_what_was_changed_in_a_log_is_said_before_the_map_is_refused(tmp_path, linkpose):
    """A map without a wall hid that the log had been sorted."""
    lines = [f"FLASER 2 1.0 1.0 0 0 0 0 0 0 {1000.0 + i} h 0" for i in (0, 2, 1, 3)]
    log, grid = tmp_path / "run.log", tmp_path / "map.yaml"
    log.write_text("\n".join(lines) + "\n")
    (tmp_path / "map.pgm").write_bytes(b"P5 2 2 255\n" + b"\xfe" * 4)
    grid.write_text("image: map.pgm\nresolution: 0.1\norigin: [0, 0, 0]\n")
    result = linkpose("localize", log, "--map", grid)
    assert result.status == 1
    moved, refusal = result.err.splitlines()
    assert moved == f"{log}: 1 line moved into the order of time"
    assert "no cell of the map is a wall" in refusal


def test_motion_between_lines_of_one_instant_is_kept():
    """Ten lines of 0.1 m, two at each instant: 0.9 m in all, not half of it."""
    readings = [Reading(float(i // 2), (0.1 * i, 0.0, 0.0)) for i in range(10)]
    log = as_log(readings)
    assert sum(event.values[0] for event in log) == pytest.approx(0.8)  # from the second line of the first instant


def test_rows_are_sorted_and_negative_ranges_left_out(tmp_path):
    text = HEADER + "1,depth,1,,\n0.5,depth,2,,\n1.5,range,7,-0.02,\n"
    read = read_log(written(tmp_path, text))
    assert [event.time_s for event in read.events] == [0.5, 1.0]
    assert [remark.split(": ")[1] for remark in read.remarks] == [
        "1 negative range left out",
        "1 row moved into the order of time",
    ]


def test_beacon_names_are_strings(tmp_path):
    """Only 5, 05 and 5.0 are one beacon."""
    names = ["0xDD05", "5E10", "D6AB", "A1", "00:1B:44:11:3A:B7", "4294967295", "4294967296", "5"]
    path = written(tmp_path, "id,x_m,y_m\n" + "".join(f"{name},{i},0\n" for i, name in enumerate(names)), "b.csv")
    assert list(read_beacons(path)) == names
    log = written(tmp_path, HEADER + "".join(f"0,range,{name},1,\n" for name in [*names, "05", "5.0"]))
    assert [event.beacon for event in read_log(log).events] == [*names, "5", "5"]


@pytest.mark.parametrize(
    ("events", "reason"),
    [
        ([Event(0.1 * i, "range", (4000.0 + i,), "1") for i in range(9)], "millimetres"),
        ([Event(0.1 * i, "range", (400.0 + i,), "1") for i in range(9)], "centimetres"),
        ([Event(100.0 * i, "range", (4.0,), "1") for i in range(30)], "milliseconds"),
        ([Event(99.5 * i, "odometry", (0.5, 0.1)) for i in range(30)], "milliseconds"),
        ([Event(0.0, "bearing_range", (4.0, 45.0), "1")], "degrees"),
        ([Event(0.1 * i, "odometry", (1.0, 40.0)) for i in range(30)], "degrees per second"),
        ([Event(0.0, "attitude", (0.0, 12.0, 0.0))], "degrees"),
    ],
)
def test_wrong_units_are_named(events, reason):
    with pytest.raises(LinkposeError, match=reason):
        check_units(events, {"1": (0.0, 0.0, 0.0), "2": (5.0, 5.0, 0.0)}, "log.csv")


def test_fixes_every_ten_seconds_are_no_milliseconds():
    """A walker, a robot of 0.2 m/s and a tag at rest; the same numbers as a sensor of 100 Hz are refused."""
    noise = np.random.default_rng(1).normal(0.0, 0.1, 200)
    beacons = {"1": (0.0, 0.0, 0.0), "2": (5.0, 5.0, 0.0)}
    for speed in (1.0, 0.2, 0.0, 0.001):
        ranges = 2.0 + np.abs((speed * 10.0 * np.arange(200) + 4.0) % 8.0 - 4.0) + noise
        log = [Event(10.0 * i, "range", (each,), "1") for i, each in enumerate(ranges)]
        if speed == 0.001:
            with pytest.raises(LinkposeError, match="milliseconds"):
                check_units(log, beacons, "log.csv")
        else:
            check_units(log, beacons, "log.csv")


def test_sparse_truth_is_compared_at_its_own_times():
    """True poses 6 s apart: each is compared, and a path that is off is not called right."""
    truth = Truth(np.arange(0.0, 60.0, 6.0), np.column_stack((np.arange(0.0, 60.0, 6.0), np.zeros(10))), None)
    times = np.arange(0.0, 54.1, 0.5)
    result = score(times, np.column_stack((times, np.full(len(times), 300.0))), None, truth)
    assert result.position_rmse_m == pytest.approx(300.0)
    assert result.rows == result.possible == 10


SPREADSHEET = "# drive 1\ntime_s,kind,a,b,c\n0.0,pose,1.5,2,0.25\n0.5,odometry,0.5,0.1,\n0.5,range,A1,3.25,\n"


@pytest.mark.parametrize(
    ("separator", "comma", "encoding", "first"),
    [
        (";", ",", "utf-8", ""),
        (";", ",", "cp1252", "sep=;\n"),
        (";", ".", "utf-8-sig", ""),
        ("\t", ",", "utf-16", ""),  # Excel's "Unicode text"
        ("\t", ".", "utf-16-le", ""),
        (",", ".", "utf-16-be", ""),
    ],
)
def test_logs_as_spreadsheets_save_them_are_read(tmp_path, separator, comma, encoding, first):
    """Log and beacons."""
    places = "id,x_m,y_m\nA1,1.5,2.25\n"

    def saved(text, name):
        text = first + text.replace(",", separator).replace(".", comma).replace("\n", "\r\n")
        path = tmp_path / name
        path.write_bytes(text.encode(encoding))
        return path

    plain = read_log(written(tmp_path, SPREADSHEET)).events
    shift = len(first.splitlines())
    assert [replace(e, line=e.line - shift) for e in read_log(saved(SPREADSHEET, "a.csv")).events] == plain
    assert read_beacons(saved(places, "b.csv")) == {"A1": (1.5, 2.25, 0.0)}


@pytest.mark.parametrize("row", ["1.234,5", "1,5\n1;range;A1;2.5"])
def test_numbers_that_can_be_read_in_two_ways_are_refused(tmp_path, row):
    text = f"time_s;kind;a;b;c\n0;range;A1;{row};\n"
    with pytest.raises(LinkposeError, match="can be read in two ways") as failure:
        read_log(written(tmp_path, text))
    assert "\n" not in str(failure.value)


def drive_rows(first, last):
    """Rows of odometry and of a range at each tenth of a second."""
    times = np.arange(first, last, 0.1)
    return [row for t in times for row in (f"{t:.1f},odometry,1,0,\n", f"{t:.1f},range,7,5,\n")]


@pytest.mark.parametrize(
    "rows",
    [
        drive_rows(0, 5)[::-1],  # written backwards
        drive_rows(5, 9) + drive_rows(0, 5),  # parts in another order
        sorted(drive_rows(0, 5), key=lambda row: "odometry" in row),  # sensor after sensor
        [*drive_rows(0, 5), "0.2,range,7,5,\n", "0.3,range,7,5,\n"],  # late rows
    ],
)
def test_rows_of_one_clock_are_sorted(tmp_path, rows):
    read = read_log(written(tmp_path, HEADER + "".join(rows)))
    assert len(read.events) == len(rows)
    assert np.all(np.diff([event.time_s for event in read.events]) >= 0)


def test_a_clock_that_was_set_back_is_named_with_its_line(tmp_path):
    rows = drive_rows(0, 5) + drive_rows(0, 4)
    with pytest.raises(LinkposeError, match=r"line 102: the clock jumps back from 4.9 to 0 s; split the log"):
        read_log(written(tmp_path, HEADER + "".join(rows)))
    readings = [Reading(1.0 + 0.1 * i, (0.1 * i, 0.0, 0.0)) for i in range(30)]
    lines = "\n".join(map(format_reading, [*readings, *readings]))
    with pytest.raises(LinkposeError, match=r"line 31: the clock jumps back from 3.9 to 1 s"):
        read_log(written(tmp_path, lines + "\n", "a.log"))


def winding_log(change, unit=1.0, angles="-1.5708 3.1416 0.0349066"):
    """A minute along an S at 0.3 m/s, with 91 beams: `change` is of the odometry's pose, `unit` of the ranges."""
    lines, x, y = [], 0.0, 0.0
    for i in range(120):
        heading = math.sin(0.1 * i)
        x, y = x + 0.15 * math.cos(heading), y + 0.15 * math.sin(heading)
        pose = " ".join(f"{value:.4f}" for value in change(x, y, heading))
        ranges = " ".join(f"{unit * (1.0 + 0.02 * j):.3f}" for j in range(91))
        lines.append(f"ODOM {pose} 0 0 0 {0.5 * i + 1} a 1")
        lines.append(f"ROBOTLASER1 0 {angles} 80 0 0 91 {ranges} 0 {pose} {pose} 0 0 0 0 0 {0.5 * i + 1} a 1")
        lines.append(f"FLASER 91 {ranges} {pose} {pose} {0.5 * i + 1.2} a 1")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("change", "options", "reason"),
    [
        (lambda x, y, h: (x, y, h), {}, None),
        (lambda x, y, h: (-x, -y, h), {}, None),  # drives backwards
        (lambda x, y, h: (x, y, h + 40 * math.pi), {}, None),
        (lambda x, y, h: (x, y, h), {"unit": 15.0}, None),
        (lambda x, y, h: (x, y, h), {"unit": 1000.0}, "cannot be metres"),
        (lambda x, y, h: (x, y, h), {"unit": 100.0}, "cannot be metres"),
        (lambda x, y, h: (x, y, h), {"angles": "-90 180 2"}, "as if in degrees"),
        (lambda x, y, h: (x, y, h), {"angles": "-1.5708 3.1416 2"}, "as if in degrees"),
        (lambda x, y, h: (x, y, math.degrees(h)), {}, "is in degrees"),
        (lambda x, y, h: (x, y, -h), {}, "has the other sign"),
        (lambda x, y, h: (x, -y, h), {}, "has the other sign"),
        (lambda x, y, h: (y, x, h), {}, "exchange"),
    ],
)
def test_carmen_logs_in_other_units_and_axes_are_named(tmp_path, change, options, reason):
    """They were searched for in the map scan by scan, for minutes, and failed with a sentence on the map."""
    path = written(tmp_path, winding_log(change, **options), "a.log")
    if reason is None:
        assert len(read_log(path).events) == 480
        return
    with pytest.raises(LinkposeError, match=reason):
        read_log(path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda h: h, None),
        (lambda h: h + math.pi, None),  # drives backwards
        (lambda h: -h, "has the other sign"),
        (lambda h: math.degrees(h) % 360, "is in degrees: multiply"),
        (lambda h: -math.degrees(h), "is in degrees and has the other sign"),
        (lambda h: 0.5 * math.pi - h, "clockwise from y"),
        (lambda h: 90.0 - math.degrees(h), "of a compass, in degrees clockwise from y"),
    ],
)
def test_headings_of_poses_and_of_a_true_path_in_other_units_and_axes_are_named(tmp_path, change, reason):
    """They passed: the path turned the other way, or the heading of a right one was called wrong."""
    truth, rows, x, y = "time_s,x_m,y_m,heading_rad\n", HEADER, 0.0, 0.0
    for i in range(120):
        heading = 0.6 + math.sin(0.1 * i)
        x, y = x + 0.15 * math.cos(heading), y + 0.15 * math.sin(heading)
        pose = f"{x:.4f},{y:.4f},{change(heading):.4f}"
        truth += f"{0.5 * i},{pose}\n"
        rows += f"{0.5 * i},pose,{pose}\n{0.5 * i},odometry,0.3,0,\n"
    true_path, log = written(tmp_path, truth, "truth.csv"), written(tmp_path, rows)
    for read, whose in (
        (lambda: read_truth(true_path), "true path"),
        (lambda: check_units(read_log(log).events, {}, "a.csv"), "poses"),
    ):
        if reason is None:
            read()
        else:
            with pytest.raises(LinkposeError, match=f"the heading of the {whose} .*{reason}"):
                read()
