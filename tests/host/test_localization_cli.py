"""`simulate`, `localize` and `reproduce` of robots as a user types them."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import numpy as np
import pytest

import linkpose as lp
from linkpose.cli.localize import command
from linkpose.errors import InvalidValue
from linkpose.localization.ekf import ekf_step
from linkpose.localization.events import Event
from linkpose.localization.localizer import estimate_track, warm_up
from linkpose.localization.logs import read_log
from linkpose.localization.maps import load_map
from linkpose.localization.settings import Settings
from linkpose.localization.ukf import ukf_step
from linkpose.recording.table import read_table


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("robots")


@pytest.fixture
def indoor(folder, linkpose):
    """A log of 20 s, its map and its truth."""
    log, truth = folder / "indoor.log", folder / "indoor_truth.csv"
    if not log.exists():
        assert linkpose("simulate", "indoor", "-o", log, "--truth", truth, "--duration", 20, "--seed", 3).status == 0
    return log, folder / "indoor.yaml", truth


@pytest.fixture
def dive(folder, linkpose):
    """A log of 20 s, its beacons and its truth."""
    log, truth = folder / "dive.csv", folder / "dive_truth.csv"
    if not log.exists():
        result = linkpose("simulate", "underwater", "-o", log, "--truth", truth, "--duration", 20, "--json")
        checks = [json.loads(line) for line in result.out.splitlines()]
        assert all(set(row) == {"check", "asked", "measured"} for row in checks)
    return log, folder / "dive_beacons.csv", truth


def test_the_help_shows_ranges_without_an_open_end(linkpose):
    text = linkpose("localize", "--help").out
    assert "None" not in text
    assert ">0]" in text and ">=0]" in text


def test_the_help_has_each_option_once_and_the_ordinary_case_first(linkpose):
    text = linkpose("localize", "--help").out
    flags = [line.split()[0] for line in text.splitlines() if line.startswith("  -")]
    assert len(flags) == len(set(flags)) == len(command.params)  # less the argument, and with --help
    firsts = [text.index(flag) for flag in ("--map", "--output", "--help", "--filter", "--range-std", "--noise")]
    assert firsts == sorted(firsts)


def test_indoor_from_log_to_path(indoor, linkpose, tmp_path):
    log, grid, truth = indoor
    out = tmp_path / "path.csv"
    arguments = ["localize", log, "--map", grid, "--truth", truth, "--filter", "ekf", "--filter", "ukf", "--json"]
    result = linkpose(*arguments, "-o", out)
    rows = [json.loads(line) for line in result.out.splitlines()]
    assert [row["filter"] for row in rows] == ["ekf", "ukf"]
    for row in rows:
        assert {"updates", "rejected", "position_rmse_m", "position_max_m", "heading_rmse_rad"} <= set(row)
        assert row["position_rmse_m"] < 0.15
        assert row["rejected"] < 0.1 * row["updates"]
    table = read_table(out, "estimate")
    table.require("time_s", "ekf_x_m", "ekf_heading_rad", "ukf_y_m", "ukf_x_std_m", "ukf_heading_std_rad")
    assert len(table) == 201
    assert table.closing is not None
    assert linkpose(*arguments, "-o", out).status == 1  # never overwritten
    assert linkpose(*arguments, "-o", out, "--force").status == 0


def test_a_filter_that_is_compiled_is_not_compiled_again(indoor):
    """After the reported compilation nothing is left to compile."""
    log, grid, _ = indoor
    warm_up(["ekf", "ukf", "mcl", "scan-match"])
    read = read_log(log)
    events, start = read.events, read.start
    for name, step in (("ekf", ekf_step), ("ukf", ukf_step)):
        estimate_track(events[:50], name, Settings(start=start), load_map(grid))
        assert len(step.signatures) == 1


KNOWN = ("--range-std", 0.25, "--drift-std", 0)  # the noises of the simulated ranges: a search for them takes time


@pytest.mark.parametrize("noise", ["fixed", "adaptive", "affine"])
def test_underwater_with_every_noise(dive, linkpose, noise):
    log, beacons, truth = dive
    result = linkpose("localize", log, "--beacons", beacons, "--truth", truth, *KNOWN, "--noise", noise, "--json")
    (row,) = [json.loads(line) for line in result.out.splitlines()]
    assert row["filter"] == "ekf"
    assert row["position_rmse_m"] < 0.3


def test_gate_counts_and_can_be_switched_off(dive, linkpose):
    log, beacons, _ = dive
    gated, open_ = (
        json.loads(linkpose("localize", log, "--beacons", beacons, *KNOWN, "--gate", gate, "--json").out)
        for gate in ("0.997", "off")
    )
    assert gated["rejected"] >= 50
    assert open_["rejected"] == 0
    assert gated["updates"] + gated["rejected"] == open_["updates"]


def test_words_without_json(dive, linkpose):
    log, beacons, truth = dive
    result = linkpose("localize", log, "--beacons", beacons, "--truth", truth)
    assert "measurements applied" in result.out
    assert "position error" in result.out


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ([], "add --map MAP.yaml or --beacons BEACONS.csv"),
        (["--beacons", "BEACONS", "--correlation", "1.0"], "not positive definite"),
        (["--beacons", "BEACONS", "--correlation", "nan"], "'nan' is not finite"),
        (["--beacons", "BEACONS", "--motion-correlation", "-0.9"], "not positive definite"),
        (["--beacons", "BEACONS", "--gate", "1.5"], "'1.5' is neither `off` nor a probability"),
        (["--beacons", "BEACONS", "--range-std", "0"], "0"),
        (["--beacons", "BEACONS", "--range-std", "nan"], "'nan' is not finite"),
        (["--beacons", "BEACONS", "--turn-std", "inf"], "'inf' is not finite"),
        (["--beacons", "BEACONS", "--range-std", "1e300"], "'1e300' is beyond 1e+09"),
        (["--beacons", "BEACONS", "--turn-std", "1e-320"], "'1e-320' is nearer to 0 than 1e-09"),
        (["--beacons", "BEACONS", "--start", "1,2"], "X,Y,HEADING"),
        (["--beacons", "BEACONS", "--start", "1e300,0,0"], "1e300,0,0"),
        (["--beacons", "BEACONS", "--start-std", "1e-300,1"], "both must be above 0"),
        (["--beacons", "BEACONS", "--start-std", "0,-1"], "both must be above 0"),
        (["--beacons", "BEACONS", "--map", "gone.yaml"], "gone.yaml"),
        (["--beacons", "gone.csv"], "gone.csv"),
        (["--beacons", "BEACONS", "--truth", "gone.csv"], "gone.csv"),
        (["--beacons", "BEACONS", "--estimate", "luck"], "luck"),
    ],
)
def test_options_that_cannot_be_are_refused(dive, refused, options, reason):
    log, beacons, _ = dive
    assert reason in refused("localize", log, *[beacons if word == "BEACONS" else word for word in options])


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ("", "holds no measurements"),
        ("0,pose,0,0,0\n1,range,9,5,\n", "line 3: range to beacon 9, whose place is not known (known are 1, 2, 3, 4)"),
        ("0,odometry,1,0,\n1,range,1,5,\n", "add --start X,Y,HEADING"),
        ("0,pose,0,0,0\n0,odometry,1,0,\n1,depth,5,,\n", "mixes a robot's odometry with a vehicle's depth"),
        ("0,pose,0,0,0\n1,range,1,nan,\n", "line 3: 'nan' is not a number"),
    ],
)
def test_logs_that_cannot_be_are_refused(dive, refused, tmp_path, rows, reason):
    log = tmp_path / "log.csv"
    log.write_text(f"time_s,kind,a,b,c\n{rows}")
    sentence = refused("localize", log, "--beacons", dive[1])
    assert reason in sentence
    if "start" not in reason:
        assert "log.csv" in sentence


def test_a_velocity_beyond_all_numbers_is_refused(dive, refused, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("time_s,kind,a,b,c\n0,pose,0,0,0\n0,velocity,1e308,1e308,0\n9,depth,1,,\n")
    for name in ("ekf", "ukf"):
        assert "left all numbers at 9 s" in refused("localize", log, "--beacons", dive[1], "--filter", name)


def test_what_a_log_needs_is_named(indoor, dive, refused):
    assert "add --map MAP.yaml" in refused("localize", indoor[0], "--beacons", dive[1])
    assert "add --beacons BEACONS.csv" in refused("localize", dive[0], "--map", indoor[1])
    assert "leave out --estimate" in refused("localize", indoor[0], "--map", indoor[1], "--estimate", "bias")


@pytest.mark.parametrize("rig", ["indoor", "underwater"])
def test_the_same_seed_gives_the_same_files(linkpose, tmp_path, rig):
    texts = []
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        out = tmp_path / f"{name}.csv"
        linkpose("simulate", rig, "-o", out, "--truth", tmp_path / f"{name}_truth.csv", "--duration", 5, "--seed", seed)
        texts.append(out.read_text())
    assert texts[0] == texts[1] != texts[2]


def test_mice_as_odometry(indoor, linkpose, refused, tmp_path):
    """The truth's velocities as an estimate of mice: the log's own odometry is not needed."""
    log, grid, truth = indoor
    table = read_table(truth)
    mice = tmp_path / "mice.csv"
    columns = zip(table.columns["time_s"], table.columns["vx_m_s"], table.columns["wz_rad_s"], strict=True)
    rows = "".join(f"{t},{v},0,{w}\n" for t, v, w in columns)
    mice.write_text(f"time_s,mice_vx_m_s,mice_vy_m_s,mice_wz_rad_s\n{rows}")
    result = linkpose("localize", log, "--map", grid, "--odometry", mice, "--truth", truth, "--json")
    assert json.loads(result.out)["position_rmse_m"] < 0.1
    assert "no column mice_vx_m_s" in refused("localize", log, "--map", grid, "--odometry", truth)


@pytest.fixture
def places(tmp_path):
    path = tmp_path / "places.csv"
    path.write_text("id,x_m,y_m\nA1,0,0\nB2,10,0\nC3,0,10\n")
    return path


@pytest.fixture
def streamed(linkpose, places, monkeypatch):
    """Runs `localize -` on lines of text."""

    def run(lines, *options):
        monkeypatch.setattr("sys.stdin", lines)
        return linkpose("localize", "-", "--beacons", places, *options)

    return run


START = ["time_s,kind,a,b,c\n", "0,pose,3,4,0\n", "0,odometry,0,0,\n"]


def test_rows_from_standard_input_become_poses_at_once(streamed):
    """A negative range and a late row are left out, with counts."""
    rows = [*START, *(f"{0.5 * i},range,A1,{-1 if i == 3 else 5},\n" for i in range(1, 8)), "2,range,A1,5,\n"]
    result = streamed(rows)
    lines = result.out.splitlines()
    assert lines[0].startswith(
        "time_s,ekf_x_m,ekf_y_m,ekf_heading_rad,ekf_range_scale_error,ekf_range_bias_m,ekf_x_std"
    )
    assert [float(line.split(",")[0]) for line in lines[1:]] == [0.0, 0.0, 0.5, 1.0, 2.0, 2.5, 3.0, 3.5]
    assert float(lines[-1].split(",")[1]) == pytest.approx(3.0, abs=0.05)
    assert "1 negative range left out" in result.err and "1 row older than the one before left out" in result.err
    assert "6 measurements applied" in result.err


def test_a_stream_estimates_its_noises(streamed):
    """Ranges with an error of 0.3 m: after 150 of them, the default of 0.1 m is replaced."""
    rng = np.random.default_rng(1)
    rows = [*START, *(f"{0.5 * i},range,{'ABC'[i % 3]}{i % 3 + 1},{far},\n" for i, far in far_ranges(rng, 200))]
    result = streamed(rows, "--range-growth", 0)
    (line,) = [line for line in result.err.splitlines() if line.startswith("noises estimated from the rows until 75 s")]
    assert 0.2 < float(line.split("range ")[1].split(" m")[0]) < 0.45
    assert streamed(rows, "--range-std", 0.3, "--range-growth", 0).err.count("range 0.3 m + 0.00%") == 1


def far_ranges(rng, count):
    """Numbers and ranges of a robot at (3, 4)."""
    truth = [math.hypot(3, 4), math.hypot(7, 4), math.hypot(3, 6)]
    return [(i, truth[i % 3] + rng.normal(0, 0.3)) for i in range(1, count)]


@pytest.mark.parametrize(
    ("last", "count", "remark"), [("2,range,A1,5", 2, ""), ("2,ran", 1, "the last row is cut short")]
)
def test_a_stream_without_a_final_line_end(streamed, last, count, remark):
    result = streamed([*START, "1,range,A1,5,\n", last])
    assert result.status == 0
    assert f"ekf: {count} measurement{'s' * (count > 1)} applied, 0 rejected" in result.err
    assert remark in result.err


def test_an_interrupted_stream_ends_well(streamed):
    def rows():
        yield from [*START, "1,range,A1,5,\n", "2,range,A1,5,\n"]
        raise KeyboardInterrupt

    result = streamed(rows())
    assert result.status == 0
    assert len(result.out.splitlines()) == 5
    assert "ekf: 2 measurements applied" in result.err


@pytest.mark.parametrize(
    ("rows", "options", "reason"),
    [
        ([], [], "standard input holds no measurements"),
        (["x\n"], [], "standard input line 1: the header is 'x'"),
        ([*START, "1,range,Z9,5,\n"], [], "line 4: beacon Z9 is not in the beacon file"),
        ([*START, "1,range,A1,five,\n"], [], "'five' is not a number"),
        ([*START[:1], "0,odometry,0,0,\n", "1,range,A1,5,\n"], [], "add --start"),
        ([*START, *(f"{i},range,A1,{5000 + i},\n" for i in range(1, 30))], [], "look like millimetres"),
        (
            [*START, *(f"{i},range,A1,90,\n" for i in range(1, 3))],
            ["--estimate", "none"],
            "applied none of the measure",
        ),
        (
            [*START, *(f"{i % 15},range,A1,5,\n" for i in range(30))],
            [],
            "line 28: the clock jumps back from 14 to 9 s; restart the stream",
        ),
        (START, ["--plot", "a.png", "--json"], "does not use --plot, --json"),
        (START, ["--smooth"], "no --smooth"),
    ],
)
def test_streams_that_cannot_be_are_refused(streamed, rows, options, reason):
    result = streamed(rows, *options)
    assert result.status in (1, 2)
    assert reason in " ".join(result.err.split())


def test_a_pose_comes_before_the_next_row_is_sent_and_the_reader_may_go(places):
    """Through real pipes, in lockstep; then the output is closed."""
    command = [sys.executable, "-m", "linkpose", "localize", "-", "--beacons", str(places)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        run.stdin.write("".join([*START, "1,range,A1,5,\n"]).encode())
        run.stdin.flush()
        assert [run.stdout.readline().split(b",")[0] for _ in range(4)] == [
            b"time_s",
            b"0.000000",
            b"0.000000",
            b"1.000000",
        ]
        for i in range(2, 5):
            run.stdin.write(f"{i},range,B2,8,\n".encode())
            run.stdin.flush()
            assert run.stdout.readline().startswith(f"{i}.000000,".encode())
        run.stdout.close()
        run.stdin.write(b"".join(f"{i},range,B2,8,\n".encode() for i in range(5, 7)))
        run.stdin.close()
        assert run.wait() == 1
        assert run.stderr.read().decode().strip().endswith("linkpose: the reader of the output has gone; stopped")


def test_turn_rates_of_a_carmen_log_are_not_degrees(indoor, linkpose, tmp_path):
    """Lines a millisecond apart, as in public logs: the odometry's steps give hundreds of rad/s."""
    log, grid, _ = indoor
    lines = [line for line in log.read_text().splitlines() if line.startswith("ODOM")][:40]
    moved = tmp_path / "fast.log"
    texts = []
    for i, line in enumerate(lines):
        words = line.split()
        words[3], words[7] = f"{0.02 * i:.3f}", f"{100 + 0.0001 * i:.4f}"
        texts.append(" ".join(words))
    scan = next(line for line in log.read_text().splitlines() if line.startswith("FLASER")).split()
    scan[-3] = "101.0"
    moved.write_text("\n".join([*texts, " ".join(scan)]) + "\n")
    result = linkpose("localize", moved, "--map", grid, "--start", "12,12,0")
    assert "degrees" not in result.err
    assert result.status == 0


def test_the_python_face_gives_what_the_command_writes(dive, linkpose, tmp_path):
    log, beacons, truth = dive
    assert linkpose("localize", log, "--beacons", beacons, *KNOWN, "--smooth", "-o", tmp_path / "path.csv").status == 0
    written = read_table(tmp_path / "path.csv", "estimate")
    paths = lp.localize(str(log), beacons=beacons, range_std_m=0.25, drift_std_m=0.0, smooth=True)
    assert paths.filters == ("ekf",) and len(paths) == len(written)
    assert list(paths) == list(written.columns)
    np.testing.assert_allclose(paths["ekf_x_m"], written.columns["ekf_x_m"], atol=1e-6)
    np.testing.assert_array_equal(paths.ekf.position_m[:, 0], paths["ekf_x_m"])
    assert paths.score(truth)["ekf"].position_rmse_m < 0.3
    assert tuple(paths.to_pandas().columns) == paths.columns
    paths.save(tmp_path / "saved.csv")
    assert (tmp_path / "saved.csv").read_bytes() == (tmp_path / "path.csv").read_bytes()
    with pytest.raises(AttributeError, match="no filter ukf; there are ekf"):
        paths.ukf  # noqa: B018
    with pytest.raises(KeyError, match="no column x"):
        paths["x"]


def test_a_log_and_beacons_in_memory():
    """A tag that stands still among three beacons, with a row out of order."""
    log = [Event(0.1 * i, "range", (math.hypot(x - 3.0, y - 4.0),), name) for i in range(30) for name, x, y in TRIANGLE]
    paths = lp.localize([*log[1:], log[0]], beacons={name: (x, y) for name, x, y in TRIANGLE}, estimate=())
    assert paths.remarks[0] == "1 event moved into the order of time"
    assert paths["ekf_x_m"][-1] == pytest.approx(3.0, abs=0.05)


TRIANGLE = (("1", 0.0, 0.0), ("2", 10.0, 0.0), ("3", 0.0, 10.0))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"start_std": (0.0, 1.0)}, "start_std is (0.0, 1.0); both must be above 0"),
        ({"start": (1.0, 2.0)}, "start is (1.0, 2.0); it must be x, y, heading"),
        ({"start": "here"}, 'or "auto"'),
        ({"gate": 1.5}, "gate is 1.5; it must be a probability"),
        ({"noise": "loud"}, "noise is 'loud'; it must be one of fixed"),
        ({"range_std_m": 0.0}, "range_std_m is 0.0; it must be above 0"),
        ({"speed_std_m_s": math.nan}, "speed_std_m_s is nan; it must be finite"),
        ({"drift_std_m": -1.0}, "drift_std_m is -1.0; it must not be below 0"),
        ({"estimate": ("luck",)}, "estimate has 'luck', which is none of scale"),
        ({"estimate": ("bias", "bias:each")}, "which exclude each other"),
        ({"filters": ["kalman"]}, "filters has 'kalman', which is none of scan-match"),
        ({"beacons": {"1": (0.0,)}}, "beacons has 1 coordinates for 1; give x, y"),
    ],
)
def test_arguments_that_cannot_be_are_named(options, reason):
    log = [Event(0.0, "pose", (0.0, 0.0, 0.0)), Event(1.0, "range", (5.0,), "1")]
    with pytest.raises(InvalidValue) as raised:
        lp.localize(log, **({"beacons": {"1": (5.0, 0.0)}} | options))
    assert reason in str(raised.value)


@pytest.mark.parametrize(
    ("option", "reason"),
    [("range_std", "localize has no option range_std; write range_std_m"), ("luck", "the options are range_std_m, ")],
)
def test_an_option_that_does_not_exist_is_named(option, reason):
    with pytest.raises(TypeError, match=reason):
        lp.localize([], **{option: 1.0})
