"""Logs, beacons and true paths: what is read, and what is refused with file, line and cure."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from linkpose.errors import LinkposeError
from linkpose.localization.carmen import Reading, as_log, flaser_angles, format_reading, is_carmen, read_carmen
from linkpose.localization.events import Event, Scan, format_event, read_events
from linkpose.localization.grid import load_map
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
    read = read_events(written(tmp_path, text))
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
        (HEADER + "0,range,north,3,\n", "line 2: 'north' is not a number"),
        (HEADER + "0,range,1,-3,\n", "line 2: the range is -3 m"),
        (HEADER + "1,depth,1,,\n0.5,depth,1,,\n", "line 3: time runs backwards, from 1 to 0.5 s"),
    ],
)
def test_a_bad_row_is_named_with_its_line(tmp_path, text, reason):
    with pytest.raises(LinkposeError, match=reason) as failure:
        read_events(written(tmp_path, text))
    assert "log.csv" in str(failure.value)


def test_what_is_no_text_is_refused(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(b"\xff\xfe\x00\x81" * 40)
    assert not is_carmen(path)
    with pytest.raises(LinkposeError, match="not a CSV file"):
        read_events(path)
    with pytest.raises(LinkposeError, match="No such file"):
        read_events(tmp_path / "gone.csv")


RANGES = " ".join(f"{1 + 0.01 * i:.2f}" for i in range(181))
ODOM = "ODOM 1.0 2.0 0.0 0.5 0.1 0 100.0 host 0.0"
FLASER = f"FLASER 181 {RANGES} 1.3 2.0 0.0 1.1 2.0 0.0 100.2 host 0.2"
WIDE = " ".join(["5.0"] * 271)
ROBOTLASER = (
    f"ROBOTLASER1 0 -2.356194 4.712389 0.0174533 30.0 0.01 0 271 {WIDE} 2 0.1 0.2 "
    "1.4 2.1 0.1 1.2 2.0 0.1 0.5 0.1 0.5 0.5 0 100.4 host 0.4"
)


def test_carmen_lines(tmp_path):
    path = written(tmp_path, f"# comment\nPARAM robot_length 40\n{ODOM}\n{FLASER}\n{ROBOTLASER}\n", "run.log")
    assert is_carmen(path)
    log, start = read_carmen(path)
    assert start == (1.0, 2.0, 0.0)
    first, second, scan, third, wide = log
    assert (first.kind, first.time_s, first.values) == ("odometry", 100.0, pytest.approx((0.5, 0.0)))
    assert second.time_s == pytest.approx(100.2)
    assert second.values[1] == pytest.approx(0.5)  # 0.1 rad in 0.2 s
    assert third.values == (0.0, 0.0)
    assert isinstance(scan, Scan) and len(scan.ranges_m) == 19
    assert np.degrees(scan.angles_rad) == pytest.approx(np.arange(-90, 91, 10))
    assert scan.ranges_m == pytest.approx(1 + 0.1 * np.arange(19))
    assert scan.mount == pytest.approx((0.2, 0.0, 0.0))
    assert np.degrees(wide.angles_rad) == pytest.approx(np.arange(-90, 91, 10), abs=0.5)
    assert wide.max_range_m == 30.0
    assert wide.mount == pytest.approx(
        (0.2 * math.cos(0.1) + 0.1 * math.sin(0.1), 0.1 * math.cos(0.1) - 0.2 * math.sin(0.1), 0)
    )


def test_beams_of_180_readings_and_beams_without_echo():
    ranges = np.full(180, 4.0)
    ranges[90], ranges[10] = 80.0, 0.0
    (_, scan) = as_log([Reading(0.0, (0.0, 0.0, 0.0), ranges, flaser_angles(180))])
    assert np.degrees(scan.angles_rad[[0, 9, 18]]) == pytest.approx([-90, 0, 89])
    assert np.isnan(scan.ranges_m[[1, 9]]).all()
    assert np.isfinite(scan.ranges_m).sum() == 17


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
        (f"{FLASER.replace('181', '18.5')}\n", "line 1: '18.5' is no number of readings"),
        (f"{FLASER}\n{ODOM}\n", "line 2: time runs backwards"),
    ],
)
def test_a_damaged_carmen_line_is_named(tmp_path, text, reason):
    with pytest.raises(LinkposeError, match=reason):
        read_carmen(written(tmp_path, text, "run.log"))


def test_formatted_readings_read_back(tmp_path):
    readings = [
        Reading(5.0, (1.0, 2.0, 0.25)),
        Reading(5.5, (1.5, 2.0, 0.25), np.linspace(1, 9, 181), flaser_angles(181), (1.5, 2.0, 0.25)),
    ]
    log, start = read_carmen(written(tmp_path, "\n".join(map(format_reading, readings)) + "\n", "run.log"))
    assert start == (1.0, 2.0, 0.25)
    assert [event.time_s for event in log] == [5.0, 5.5, 5.5]
    assert log[2].ranges_m == pytest.approx(as_log(readings)[2].ranges_m, abs=1e-3)


def test_beacons(tmp_path):
    assert read_beacons(written(tmp_path, "id,x_m,y_m\n1,2,3\n07,4.5,-1")) == {"1": (2, 3, 0), "7": (4.5, -1, 0)}
    assert read_beacons(written(tmp_path, "# north hall\nid,x_m,y_m,z_m\n1,2,3,4\n")) == {"1": (2, 3, 4)}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "header"),
        ("id,x,y\n1,2,3\n", "header 'id,x,y'"),
        ("id,x_m,y_m\n", "names no beacons"),
        ("id,x_m,y_m\n1,2\n", "line 2: 2 of 3 columns"),
        ("id,x_m,y_m\n1,2,nan\n", "line 2: 'nan' is not a number"),
        ("id,x_m,y_m\n1,2,3\n1.0,5,6\n", "line 3: beacon 1 stands there twice"),
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
    for read in (read_events, read_carmen, read_beacons, read_truth, load_map):
        try:
            read(path)
        except LinkposeError as failure:
            assert str(path) in str(failure)
