"""Recordings: what is written is what is read, whatever happens to the file."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from linkpose.cli import live
from linkpose.errors import LinkposeError
from linkpose.recording import columns
from linkpose.recording.fixedpoint import format_rows
from linkpose.recording.reader import load_recording
from linkpose.recording.table import read_table
from linkpose.recording.writer import write_recording
from linkpose.sensors import bmp180, mpu6050
from linkpose.sensors.conversion import BoardSettings, Converter, Placed, RawSamples
from linkpose.sensors.health import HealthMonitor
from linkpose.sensors.measurements import Block, Measurements
from linkpose.sensors.rig import Joint, Rig
from linkpose.simulation import board
from linkpose.simulation.baro import DATASHEET_WORDS
from linkpose.simulation.link import LinkRun
from linkpose.wire.capture import decode_capture
from linkpose.wire.frames import StreamDecoder, encode, sample
from linkpose.wire.messages import Configure, DeviceState, Hello, HelloMouse, Sample

CLI = [sys.executable, "-m", "linkpose"]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2] / "host")}


def test_the_data_sheets_example():
    assert bmp180.compensate(27898, 23843, DATASHEET_WORDS, 0) == (150, 69964)
    temperature, pressure = bmp180.compensate(np.array([27898] * 2), np.array([23843] * 2), DATASHEET_WORDS, 0)
    assert temperature.tolist() == [150, 150] and pressure.tolist() == [69964, 69964]


@pytest.mark.parametrize("range_g", [2, 4, 8, 16])
@pytest.mark.parametrize("range_deg_s", [250, 500, 1000, 2000])
def test_every_raw_count_comes_back_from_the_decimals_kept(range_g, range_deg_s):
    counts = np.arange(-32768, 32768)
    converter = Converter(BoardSettings.of(hello_with(accel_range_g=range_g, gyro_range_deg_s=range_deg_s)))
    samples = [sample(0, 0, 1, (c,) * 7) for c in counts.tolist()]
    size = len(samples)
    block = converter.convert(RawSamples.of(samples, 0), np.zeros(size), np.ones(size, np.int64))
    for values, scale, decimals in (
        (block.accel_m_s2, mpu6050.accel_scale(range_g), mpu6050.ACCEL_DECIMALS),
        (block.gyro_rad_s, mpu6050.gyro_scale(range_deg_s), mpu6050.GYRO_DECIMALS),
    ):
        one_by_one = values[:, 0].tolist()
        assert one_by_one == [round(c * scale * 10**decimals) / 10**decimals for c in counts.tolist()]
        assert np.array_equal(np.rint(np.array(one_by_one) / scale), counts)
        assert [float(f"{value:.{decimals}f}") for value in one_by_one] == one_by_one


def hello_with(mice: int = 0, **settings: int) -> Hello:
    hello = board.hello(board.DEFAULTS._replace(**settings))
    return hello._replace(mice=tuple(HelloMouse(DeviceState.OK, 0, 0x60, 8, 200, 0) for _ in range(mice)))


raw_samples = st.lists(
    st.builds(
        sample,
        seq=st.just(0),
        t_us=st.just(0),
        flags=st.integers(0, 0x1FFF),
        imu=st.tuples(*[st.integers(-32768, 32767)] * 7),
        baro=st.tuples(st.integers(0, 65535), st.integers(0, 2**19 - 1), st.integers(0, 3)),
        mice=st.integers(0, 3).flatmap(lambda mice: st.tuples(*[st.integers(-32768, 32767)] * 2 * mice)),
    ),
    min_size=1,
    max_size=30,
)


def joined(blocks: list[Block]) -> Measurements:
    parts = [block.measurements for block in blocks]
    return Measurements(*(np.concatenate([getattr(p, field) for p in parts]) for field in Measurements.__slots__))


def equal(a: Measurements, b: Measurements) -> bool:
    pairs = [(getattr(a, field), getattr(b, field)) for field in a.__slots__]
    return all(np.array_equal(x, y, equal_nan=x.dtype == np.float64) for x, y in pairs)


@settings(max_examples=60)
@given(raw_samples, st.sampled_from([2, 8]), st.integers(0, 3))
def test_live_csv_and_capture_give_the_same_measurements(tmp_path_factory, raw, range_g, oversampling):
    """One by one as they arrive, read back from the CSV, and decoded at once from the raw bytes: all the same bits."""
    folder = tmp_path_factory.mktemp("same")
    hello = hello_with(mice=3, accel_range_g=range_g, baro_oversampling=oversampling)
    raw = [s._replace(seq=i, t_us=10_000 * i) for i, s in enumerate(raw)]
    write_recording(folder / "r.csv", hello, raw, "test", Rig(joint=Joint((1.0, 2.0, 3.0))), force=False)
    (folder / "r.bin").write_bytes(encode(hello) + b"".join(map(encode, raw)))
    converter = Converter(BoardSettings.of(hello))
    live = joined([converter.convert_placed([s], [Placed(0.01 * i, i, s.flags)]) for i, s in enumerate(raw)])
    live, _ = HealthMonitor(100.0, {"imu": "ok", "baro": "ok"}).check(live)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ResourceWarning)
        from_csv = load_recording(folder / "r.csv")
    assert not caught, "a file stays open"
    from_capture = load_recording(folder / "r.bin").measurements
    assert equal(live, from_csv.measurements)
    assert from_csv.rig == Rig(joint=Joint((1.0, 2.0, 3.0)))
    mice = from_capture.mice_counts.shape[1]
    assert np.array_equal(from_capture.mice_counts, live.mice_counts[:, :mice], equal_nan=True)
    assert np.isnan(live.mice_counts[:, mice:]).all()
    for field in ("time_s", "accel_m_s2", "gyro_rad_s", "imu_temp_degC", "pressure_Pa", "baro_temp_degC"):
        assert np.array_equal(getattr(from_capture, field), getattr(live, field), equal_nan=True), field
    assert np.array_equal(from_capture.baro_fresh, live.baro_fresh)
    assert np.array_equal(from_capture.flags, live.flags)


@given(st.binary(max_size=600), st.integers(0, 5))
def test_a_capture_decodes_as_the_stream_does(noise, at):
    frames = [encode(s) for s in LinkRun(duration_s=1.0).block(0, 8).samples()]
    data = b"".join(frames[:at]) + noise + b"\0" + b"".join(frames[at:]) + encode(hello_with())
    decoder = StreamDecoder()
    stream = decoder.feed(data)
    capture = decode_capture(data)
    assert len(capture.samples) == sum(isinstance(m, Sample) for m in stream)
    assert [m for _, m in capture.others] == [m for m in stream if not isinstance(m, Sample)]
    assert capture.corrupt == decoder.corrupt


def test_wraps_and_losses_in_a_capture(tmp_path):
    run = list(LinkRun(duration_s=4.0).samples())
    shifted = [s._replace(t_us=(s.t_us + 2**32 - 1_000_000) % 2**32, seq=s.seq) for s in run]
    kept = shifted[:100] + shifted[105:]
    (tmp_path / "r.bin").write_bytes(encode(hello_with()) + b"".join(map(encode, kept)))
    recording = load_recording(tmp_path / "r.bin")
    expected = np.delete(np.arange(400) * 0.01, range(100, 105))
    assert np.allclose(recording.measurements.time_s, expected, atol=1e-9)
    assert any("5 samples lost in 1 gaps" in remark for remark in recording.remarks)


@given(st.lists(st.floats(-1e9, 1e9) | st.just(float("nan")), min_size=1, max_size=8), st.integers(0, 7))
def test_numbers_as_text(values, decimals):
    text = format_rows(np.array([values]), np.full(len(values), decimals)).decode()
    for word, value in zip(text.rstrip("\n").split(","), values, strict=True):
        if value != value:
            assert word == ""
        else:
            assert float(word) == pytest.approx(value, abs=0.51 * 10.0**-decimals, rel=4e-15)
            assert len(word.partition(".")[2]) == decimals
            assert not word.startswith("-0.0") or float(word) != 0


@pytest.fixture
def recording(tmp_path) -> Path:
    run = LinkRun(duration_s=3.0)
    path = tmp_path / "run.csv"
    write_recording(path, board.hello(board.DEFAULTS), run.samples(), "sim", run.rig, force=False)
    return path


def test_other_tools_read_it(recording):
    table = np.loadtxt(recording, delimiter=",", skiprows=3)
    assert table.shape == (300, 13)
    lines = recording.read_text().splitlines()
    assert lines[0] == "# linkpose recording 1"
    assert json.loads(lines[1][1:])["settings"]["sample_rate_hz"] == 100
    assert lines[2].split(",") == columns.names(columns.ColumnLayout(0))
    assert json.loads(lines[-1][1:])["samples"] == 300


def edited(path: Path, change) -> Path:
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(change(lines)))
    return path


def swap(lines, at, old, new):
    lines[at] = lines[at].replace(old, new)
    return lines


BAD_FILES = {
    "a foreign file": (lambda _: ["x,y\n", "1,2\n"], "has no column time_s; it has x, y"),
    "an empty file": (lambda _: [], "ends before its first row"),
    "only a head": (lambda lines: lines[:3], "has a header but no row"),
    "cut in its head": (lambda lines: [*lines[:2], "time_s,se"], "ends before its first row"),
    "a later version": (
        lambda lines: ["# linkpose recording 2\n", *lines[1:]],
        "is a linkpose recording of version 2, and this program reads version 1",
    ),
    "nothing but blank lines": (lambda lines: [*lines[:3], "\n", "\n"], "has a header but no row"),
    "metadata that is no JSON": (lambda lines: [lines[0], "# {oops\n", *lines[2:]], "line 2: the metadata is not JSON"),
    "settings that are none": (
        lambda lines: [lines[0], '# {"settings": 5}\n', *lines[2:]],
        "line 2: settings is 5; it must be a JSON object, or be left out",
    ),
    "a rig that is none": (
        lambda lines: [lines[0], '# {"rig": null}\n', *lines[2:]],
        "line 2: rig is null; it must be a JSON object, or be left out",
    ),
    "an unknown column": (
        lambda lines: swap(lines, 2, "gyro_x_rad_s", "gyro_x_rad"),
        "unknown column gyro_x_rad; did you mean gyro_x_rad_s, with values in its unit?",
    ),
    "an axis as another program names it": (
        lambda lines: swap(lines, 2, "gyro_x_rad_s", "gx"),
        "unknown column gx; did you mean gyro_x_rad_s, with values in its unit?",
    ),
    "an accelerometer as another program names it": (
        lambda lines: swap(lines, 2, "accel_z_m_s2", "Acc_Z"),
        "unknown column Acc_Z; did you mean accel_z_m_s2, with values in its unit?",
    ),
    "a column twice": (lambda lines: swap(lines, 2, "gyro_x_rad_s", "gyro_y_rad_s"), "gyro_y_rad_s stands twice"),
    "no inertial sensor": (
        lambda lines: [*lines[:2], "time_s,pressure_Pa\n", "0,1e5\n", "0.1,1e5\n"],
        "nothing to estimate from",
    ),
    "a cut row": (lambda lines: [*lines[:9], "0.06,6,0.1\n", *lines[10:]], "line 10: 3 fields where the header has 13"),
    "a word": (lambda lines: swap(lines, 11, ",0.", ",zero."), "line 12: 'zero."),
    "time that runs backwards": (
        lambda lines: [*lines[:8], lines[20], *lines[8:]],
        "line 10: time_s runs backwards (0.050000 s)",
    ),
    "time that is missing": (
        lambda lines: [*lines[:8], "," + lines[8].partition(",")[2], *lines[9:]],
        "line 9: time_s is missing",
    ),
    "flags out of range": (
        lambda lines: [*lines[:5], lines[5].rpartition(",")[0] + ",-1\n", *lines[6:]],
        "line 6: flags must be a whole number from 0 to 4294967295",
    ),
    "an unknown rig key": (
        lambda lines: swap(lines, 1, '"j2s_m"', '"j2s_mm"'),
        "unknown key joint.j2s_mm; did you mean j2s_m",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_are_named_with_line_and_cure(name, recording, refused):
    change, sentence = BAD_FILES[name]
    output = refused("estimate", edited(recording, change))
    assert sentence in output
    assert str(recording) in output


def test_absent_and_unreadable_files(refused, tmp_path):
    assert "cannot read" in refused("estimate", tmp_path / "none.csv")
    assert "cannot read" in refused("estimate", tmp_path)
    (tmp_path / "x.bin").write_bytes(b"\0\1\2\3")
    assert "holds no HELLO" in refused("estimate", tmp_path / "x.bin")
    (tmp_path / "x.bin").write_bytes(encode(hello_with()))
    assert "holds no sample" in refused("estimate", tmp_path / "x.bin")


@given(cut=st.integers(0, 20_000))
@settings(max_examples=50)
def test_a_recording_cut_anywhere_gives_its_whole_rows(tmp_path_factory, cut):
    folder = tmp_path_factory.mktemp("cut")
    run = LinkRun(duration_s=1.0)
    path = folder / "run.csv"
    write_recording(path, board.hello(board.DEFAULTS), run.samples(), "sim", run.rig, force=False)
    whole = load_recording(path).measurements
    path.write_bytes(path.read_bytes()[: -1 - cut])
    try:
        part = load_recording(path)
    except LinkposeError:
        return  # cut in the head
    assert equal(part.measurements, whole[: len(part.measurements)])
    assert len(part.measurements) >= 99 - cut // 80
    assert "has no closing line" in part.remarks[0]


@pytest.mark.parametrize(
    ("first", "last", "factor", "sentence"),
    [
        ("accel_x_m_s2", "accel_z_m_s2", 1 / 9.80665, "is it in g? multiply it by 9.80665"),
        ("accel_x_m_s2", "accel_z_m_s2", 1000 / 9.80665, "thousandths of g? multiply it by 0.00980665"),
        ("gyro_x_rad_s", "gyro_z_rad_s", 180 / np.pi, "is it in °/s? multiply it by 0.0174533"),
        ("time_s", "time_s", 1e3, "in steps of 10 s (median): is it in milliseconds? divide it by 1000"),
        ("time_s", "time_s", 1e6, "is it in microseconds? divide it by 1000000"),
        ("pressure_Pa", "pressure_Pa", 0.01, "is it in hPa? multiply it by 100"),
        ("pressure_Pa", "pressure_Pa", 0.001, "is it in kPa? multiply it by 1000"),
    ],
)
def test_values_in_another_unit_are_noticed(recording, first, last, factor, sentence):
    def scaled(lines):
        names = lines[2].strip().split(",")
        scale = np.ones(len(names))
        scale[names.index(first) : names.index(last) + 1] = factor
        rows = np.loadtxt(lines[3:-1], delimiter=",") * scale
        return [*lines[:3], *(",".join(f"{value:.9f}" for value in row) + "\n" for row in rows), lines[-1]]

    assert load_recording(recording).remarks == []
    (remark,) = load_recording(edited(recording, scaled)).remarks
    assert sentence in remark and str(recording) in remark


@pytest.mark.parametrize(
    "save",
    [
        lambda data: b"\xef\xbb\xbf" + data,
        lambda data: data + b"\n\n",
        lambda data: b"\xef\xbb\xbf" + data.replace(b"\n", b"\r\n") + b"\r\n  \r\n",
    ],
    ids=["byte order mark", "blank lines at the end", "both, and other line ends"],
)
def test_what_editors_add_to_a_recording_does_no_harm(recording, save):
    before = load_recording(recording)
    recording.write_bytes(save(recording.read_bytes()))
    after = load_recording(recording)
    assert equal(after.measurements, before.measurements)
    assert after.remarks == [] and after.metadata == before.metadata


def test_a_plain_file_needs_no_newline_at_its_end(tmp_path):
    (tmp_path / "truth.csv").write_text("time_s,x_m\n0,1\n1,2")
    assert read_table(tmp_path / "truth.csv").columns["x_m"].tolist() == [1.0, 2.0]


def test_an_existing_file_is_kept_unless_forced(linkpose, refused, tmp_path):
    (tmp_path / "r.csv").write_text("precious")
    assert "exists already" in refused("record", tmp_path / "r.csv", "--port", "sim://link", "--duration", 0.1)
    assert (tmp_path / "r.csv").read_text() == "precious"
    assert linkpose("record", tmp_path / "r.csv", "--port", "sim://link", "--duration", 0.1, "--force").status == 0
    assert len(read_table(tmp_path / "r.csv", "recording")) == 10


def test_a_folder_that_may_not_be_written_and_a_folder_in_place_of_a_file(refused, tmp_path):
    assert "cannot write" in refused("record", "/proc/r.csv", "--port", "sim://link")
    assert "cannot write" in refused("record", tmp_path, "--port", "sim://link")
    assert "named for two outputs" in refused("record", tmp_path / "a", "--raw", tmp_path / "a", "--port", "sim://link")


def test_a_full_disk_leaves_whole_rows_and_says_so(tmp_path):
    """A limit on file sizes stands in for the disk: the same error at the same call."""
    done = subprocess.run(
        [*CLI, "record", "r.csv", "--port", "sim://link?speed=0", "--duration", "60"],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=lambda: (
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN),
        ),
    )
    assert done.returncode == 1
    assert "cannot write to r.csv any more: File too large" in done.stderr
    assert "Traceback" not in done.stderr
    data = (tmp_path / "r.csv").read_bytes()
    assert data.endswith(b"\n") and len(data) > 15_000
    assert len(read_table(tmp_path / "r.csv", "recording")) > 100


def test_a_reader_that_goes_away_is_no_traceback(recording):
    reader, writer = os.pipe()
    os.close(reader)
    command = [*CLI, "estimate", recording]
    done = subprocess.run(command, env=ENVIRONMENT, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1] == "linkpose: the reader of the output has gone; stopped"


def test_a_recording_ends_well_when_the_reader_of_its_estimates_goes_away(tmp_path):
    path = tmp_path / "r.csv"
    command = [*CLI, "estimate", "--live", "--port", "sim://link", "--record", path, "-q"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, env=ENVIRONMENT, text=True, **pipes) as process:
        assert process.stdout is not None and process.stderr is not None
        for _ in range(50):
            process.stdout.readline()
        process.stdout.close()
        assert "has gone" in process.stderr.read()
    assert process.returncode == 1
    closing = read_table(path, "recording").closing
    assert closing is not None and closing["ended"] == "failure"


def test_kill_9_at_any_moment_leaves_a_readable_file(tmp_path):
    """What the file held before the signal is still there, and at most one unfinished row behind it is left out."""
    rng = np.random.default_rng(4)
    for attempt, lines in enumerate(rng.integers(4, 60, 6).tolist()):
        path = tmp_path / f"{attempt}.csv"
        process = subprocess.Popen([*CLI, "record", path, "--port", "sim://link", "-q"], env=ENVIRONMENT)
        while not (path.exists() and path.read_bytes().count(b"\n") >= lines):
            assert process.poll() is None
            time.sleep(0.002)
        process.kill()
        process.wait()
        table = read_table(path, "recording")
        assert len(table) >= lines - 3  # three lines of head
        assert len(table) >= path.read_bytes().count(b"\n") - 3
        assert table.closing is None


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_a_recording_well(tmp_path, stop):
    path = tmp_path / "r.csv"
    command = [*CLI, "record", path, "--port", "sim://link", "--json"]
    process = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 20
    while not (path.exists() and path.read_bytes().count(b"\n") > 20):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(stop)
    out, err = process.communicate(timeout=10)
    table = read_table(path, "recording")
    assert process.returncode == 0
    assert "Traceback" not in err
    assert json.loads(out.splitlines()[-1])["samples"] == len(table)
    assert table.closing is not None and table.closing["ended"] == "interrupted"


@pytest.mark.parametrize(("signals", "handled"), [(1, [0, 1, 2]), (2, [0, 1])])
def test_ctrl_c_takes_effect_between_two_blocks_and_pressed_twice_at_once(signals, handled):
    """In the middle of a block it would part the count of a sample from its row."""
    done = []

    def handle(block):
        for _ in range(signals if block == 2 else 0):
            signal.raise_signal(signal.SIGINT)
        done.append(block)

    assert live.run((block for block in range(5)), handle) == "interrupted"
    assert done == handled


def test_the_converter_forgets_a_barometer_that_went_away():
    hello = board.hello(Configure(100, 8, 1000, 3, 0, 8, 400))
    converter = Converter(BoardSettings.of(hello))
    base = sample(0, 0, 8, baro=(27898, 23843, 7))
    places = [Placed(0.01 * i, i, flags) for i, flags in enumerate((8, 8, 0, 8))]
    for blocks in ([4], [1, 1, 1, 1], [2, 2], [3, 1]):
        converter = Converter(BoardSettings.of(hello))
        ends = np.cumsum(blocks).tolist()
        parts = [
            converter.convert_placed([base] * n, places[end - n : end]) for n, end in zip(blocks, ends, strict=True)
        ]
        expected = [69964.0, 69964.0, np.nan, 69964.0]
        assert np.array_equal(joined(parts).pressure_Pa, expected, equal_nan=True)
        assert joined(parts).baro_fresh.tolist() == [True, False, False, True]


@pytest.mark.parametrize("size", [1, 2, 5])
def test_an_impossible_barometer_reading_is_missing_and_spoils_no_other(size):
    """UT for which x1 + MD is 0, or B4 is 0: no BMP180 gives it."""
    words = DATASHEET_WORDS
    bad_ut = next(ut for ut in range(65536) if ((ut - words.ac6) * words.ac5 >> 15) + words.md == 0)
    converter = Converter(BoardSettings.of(board.hello(Configure(100, 8, 1000, 3, 0, 8, 400))))
    samples = [sample(0, 0, 8, baro=(27898, 23843, 7 + i)) for i in range(5)]
    samples[2] = samples[2]._replace(baro_ut=bad_ut)
    places = [Placed(0.01 * i, i, 8) for i in range(5)]
    parts = [converter.convert_placed(samples[i : i + size], places[i : i + size]) for i in range(0, 5, size)]
    block = joined(parts)
    assert block.baro_fresh.tolist() == [True, True, False, True, True]
    assert np.isnan(block.pressure_Pa).tolist() == [False, False, True, False, False]
