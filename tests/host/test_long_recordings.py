"""Recordings and tables that are read in blocks: the same digits as at once, in memory that does not grow with them."""

from __future__ import annotations

import io
import tracemalloc
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from test_tables import PROGRAMS, written

from linkpose import plotting
from linkpose.cli.convert import command as convert
from linkpose.cli.estimate import command as estimate
from linkpose.errors import FileFormatError
from linkpose.evaluation.references import read_for_picture
from linkpose.recording import chunks, numbers, reader, thinned
from linkpose.recording.fastnumbers import parse
from linkpose.recording.reader import RecordingFile, load_recording
from linkpose.recording.table import read_table
from linkpose.recording.thinned import read_thinned
from linkpose.recording.writer import write_recording
from linkpose.simulation import board
from linkpose.simulation.link import LinkRun
from linkpose.wire.capture import decode_capture, read_capture
from linkpose.wire.frames import encode

ROW = (1_000_000, 0, 9_800_000, 100, 0, 0, 100_000, 3)


@pytest.fixture
def in_small_blocks(monkeypatch):
    """Blocks of some ten rows, none of which is kept."""
    monkeypatch.setattr(chunks, "CHUNK_BYTES", 2_000)
    monkeypatch.setattr(reader, "KEPT_ROWS", 50)
    monkeypatch.setattr(reader, "UNIT_ROWS", 50)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("long") / "run.csv"
    run = LinkRun(duration_s=6.0)
    samples = [s for s in run.samples() if not 200 <= s.seq < 260]
    write_recording(path, board.hello(board.DEFAULTS), samples, "sim", run.rig, force=False)
    return path


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("long") / "run.bin"
    hello = encode(board.hello(board.DEFAULTS))
    frames = [encode(s._replace(t_us=(s.t_us + 2**32 - 3_000_000) % 2**32)) for s in LinkRun(duration_s=6.0).samples()]
    path.write_bytes(hello + b"".join([*frames[:300], b"\1\0\7", hello, *frames[310:]]))
    return path


def same(a, b) -> bool:
    arrays = [(getattr(a, field.name), getattr(b, field.name)) for field in fields(a)]
    return all(np.array_equal(x, y, equal_nan=x.dtype == np.float64) for x, y in arrays)


@pytest.mark.parametrize("kind", ["csv", "parquet", "bin"])
def test_blocks_hold_the_same_measurements(recording, capture, tmp_path, kind, monkeypatch, request):
    path = {"csv": recording, "bin": capture, "parquet": tmp_path / "run.parquet"}[kind]
    if kind == "parquet":
        assert CliRunner().invoke(convert, [str(recording), "-o", str(path), "-q"]).exit_code == 0
        monkeypatch.setattr("linkpose.recording.parquet._ROWS", 37)
    whole = load_recording(path)
    request.getfixturevalue("in_small_blocks")
    monkeypatch.setattr("linkpose.wire.capture._PIECE_BYTES", 1_000)
    file = RecordingFile(path)
    blocks = list(file.blocks())
    assert len(blocks) > 5 and len({len(block) for block in blocks}) > 1
    found = load_recording(path)
    assert same(found.measurements, whole.measurements)
    assert (found.health, found.rig, found.sample_rate_hz) == (whole.health, whole.rig, whole.sample_rate_hz)
    assert found.remarks == whole.remarks and found.metadata == whole.metadata
    lost = 60 if kind != "bin" else 10
    assert (file.survey.lost, file.survey.gap_count) == (lost, 1) and file.survey.rows == 600 - lost


def test_an_estimate_has_the_same_digits(recording, tmp_path, in_small_blocks, monkeypatch):
    arguments = [str(recording), "--filter", "tilt", "--filter", "joint", "-q", "-o"]
    assert CliRunner().invoke(estimate, [*arguments, str(tmp_path / "blocks.csv")]).exit_code == 0
    monkeypatch.undo()
    assert CliRunner().invoke(estimate, [*arguments, str(tmp_path / "whole.csv")]).exit_code == 0
    assert (tmp_path / "blocks.csv").read_text() == (tmp_path / "whole.csv").read_text()


@pytest.mark.parametrize("program", PROGRAMS)
def test_files_of_other_programs_in_small_pieces(program, tmp_path, monkeypatch):
    path = tmp_path / "run.csv"
    rows = [(i * ROW[0] // 7, *ROW[1:6], ROW[6] if i % 5 else None, i if i % 3 else None) for i in range(200)]
    path.write_bytes(PROGRAMS[program](written(rows)))
    whole = read_table(path)
    monkeypatch.setattr(chunks, "CHUNK_BYTES", 2_500)
    found = read_table(path)
    assert found.columns.keys() == whole.columns.keys()
    assert all(np.array_equal(found.columns[name], whole.columns[name], equal_nan=True) for name in whole.columns)
    assert (found.kind, found.metadata, found.closing) == (whole.kind, whole.metadata, whole.closing)
    assert (found.first_line, found.remarks) == (whole.first_line, whole.remarks)


def test_a_bad_row_behind_the_first_block_is_named_with_its_line(tmp_path, in_small_blocks):
    lines = written([ROW] * 200).splitlines()
    for at, old, new, sentence in (
        (150, "9.800000", "tall", "line 151: 'tall' is not a number"),
        (150, "1.000000,", "", "line 151: 14 fields where the header has 15"),
        (150, "1.470000,", "0.470000,", "line 151: time_s runs backwards (0.470000 s)"),
        (150, "9.800000", "9;8", "line 151: "),
    ):
        assert old in lines[at]
        text = [*lines[:at], lines[at].replace(old, new, 1), *lines[at + 1 :]]
        (tmp_path / "run.csv").write_text("\n".join(text) + "\n")
        with pytest.raises(FileFormatError) as raised:
            RecordingFile(tmp_path / "run.csv")
        assert sentence in str(raised.value)
    decimal = [line.replace(".", ",").replace(",", ";") for line in lines]
    (tmp_path / "run.csv").write_text("\n".join([*decimal[:100], "0,5;1.5"]) + "\n")
    with pytest.raises(FileFormatError):
        RecordingFile(tmp_path / "run.csv")
    (tmp_path / "run.csv").write_bytes(b"time_s,a\n0,1\n" * 1 + b"x" * 10_000)
    with pytest.raises(FileFormatError, match="longer than 2000 bytes"):
        read_table(tmp_path / "run.csv")


def peak_bytes(action) -> int:
    tracemalloc.start()
    try:
        action()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_the_recording(tmp_path, in_small_blocks, monkeypatch):
    """Five times the rows: the survey, the blocks, and the thinned table of a picture take the same memory."""
    monkeypatch.setattr(chunks, "CHUNK_BYTES", 20_000)
    monkeypatch.setattr(thinned, "MOST_ROWS", 200)
    monkeypatch.setattr(thinned, "_REGULAR_ROWS", 200)
    monkeypatch.setattr(thinned, "_EXTREME_ROWS", 1_000)
    peaks = []
    for rows in (1_500, 1_500, 7_500):  # the first run fills caches
        path = tmp_path / f"{rows}.csv"
        path.write_text(written([ROW] * rows))
        peaks.append(peak_bytes(lambda path=path: [len(block) for block in RecordingFile(path).blocks()]))
        peaks.append(peak_bytes(lambda path=path: read_thinned(path)))
    assert peaks[4] < 1.5 * peaks[2] and peaks[5] < 1.5 * peaks[3]


def test_memory_does_not_grow_with_a_capture_of_noise():
    """Two bytes a frame are the worst case: 10 MB of them took 1.2 GB."""
    noise = b"\1\0" * 1_500_000
    decode_capture(b"\1\0")
    peak = peak_bytes(lambda: decode_capture(noise))
    assert peak < 150e6
    parts = list(read_capture(io.BytesIO(noise)))
    assert len(parts) > 2 and parts[-1].corrupt.length == 1_500_000 and not parts[-1].others


def test_a_picture_of_a_long_table_keeps_spikes_and_gaps(tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "CHUNK_BYTES", 20_000)
    monkeypatch.setattr(thinned, "MOST_ROWS", 1_000)
    monkeypatch.setattr(thinned, "_REGULAR_ROWS", 800)
    monkeypatch.setattr(thinned, "_EXTREME_ROWS", 200)
    t = np.delete(np.arange(20_000) / 100, slice(9_000, 9_500))
    height, sigma = 1 + 0.1 * np.sin(t), np.full(len(t), 0.01)
    height[[1234, 15_000]] = 7, -7
    height[5_000:5_002] = np.nan
    rows = [f"{a:.6f},{b:.6f},{c:.6f}\n" for a, b, c in zip(t, height, sigma, strict=True)]
    path = tmp_path / "e.csv"
    path.write_text(
        "# linkpose estimate 1\n# {}\ntime_s,tilt_height_m,tilt_height_std_m\n" + "".join(rows).replace("nan", "")
    )
    table = read_for_picture(path)
    assert table.whole is not None and table.whole.rows == 19_500 and len(table) < 2_000
    assert (table.whole.gaps, table.whole.lost) == (1, 500) and table.whole.interval_s == pytest.approx(0.01)
    kept = table.columns["tilt_height_m"]
    assert np.nanmax(kept) == 7 and np.nanmin(kept) == -7 and np.isnan(kept).any()
    assert {89.99, 95.0} <= set(np.round(table.columns["time_s"], 6).tolist())
    figure, remarks = plotting.plot_tables([table])
    title = figure.get_suptitle()
    assert "100 Hz" in title and "500 samples lost in 1 gap" in title
    assert any("has 19500 rows: the picture shows the extremes" in remark for remark in remarks)
    truth = replace(table, kind="truth", columns={"time_s": table.columns["time_s"], "height_m": kept})
    remarks = plotting.plot_tables([table, truth])[1]
    assert any("no errors are drawn of files of this length: type linkpose" in remark for remark in remarks)


number = st.floats(-1e6, 1e6).map(lambda value: f"{value:.6f}") | st.from_regex(
    r"-?[0-9]{1,9}(\.[0-9]{0,6})?", fullmatch=True
)


@settings(max_examples=100)
@given(
    rows=st.lists(st.tuples(number, number | st.just("")), min_size=1, max_size=5), end=st.sampled_from(["\n", "\r\n"])
)
def test_the_compiled_parser_gives_pythons_numbers(rows, end):
    body = "".join(f"{a},{b}{end}" for a, b in rows).encode()
    expected = np.array([[float(a), float(b) if b else np.nan] for a, b in rows]).T
    for found in (parse(body, 2), numbers.parse_rows(body, 2)):
        assert found is not None and np.array_equal(found, expected, equal_nan=True)


@settings(max_examples=100)
@given(st.text("0123456789.,-+e\n\r nai", max_size=40))
def test_the_compiled_parser_reads_what_numpy_reads_or_declines(text):
    body = text.encode()
    fast = parse(body, 2)
    if fast is not None and fast.size:
        slow = numbers.parse_rows(body, 2)
        assert slow is not None and np.array_equal(fast, slow, equal_nan=True)
