"""Each message in the tables of the documentation is produced here, and each sentence of these parts is in a table."""

from __future__ import annotations

import ast
import errno
import os
import re
import socket
import sys
from binascii import crc_hqx
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import click
import numpy as np
import pytest
import serial
from cobs import cobs
from further_producers import FURTHER
from message_producers import MORE
from pty_board import PtyBoard

from linkpose import errors, plotting
from linkpose.cli.cures import CURES, sentence
from linkpose.convert import convert
from linkpose.device import ports, session
from linkpose.device.ports import PortInfo
from linkpose.errors import LinkposeError
from linkpose.estimation import Estimator, estimate
from linkpose.evaluation.scores import evaluate
from linkpose.outputs import create, write_all
from linkpose.recording import chunks
from linkpose.recording.csvfile import CsvFile
from linkpose.recording.reader import load_recording
from linkpose.recording.table import read_table
from linkpose.sensors.devices import Sensors
from linkpose.sensors.rig import Rig
from linkpose.simulation import board
from linkpose.simulation.link import LinkRun
from linkpose.streams import open_output
from linkpose.wire.frames import encode
from linkpose.wire.messages import Hello

PACKAGE = Path(errors.__file__).parent
PAGE = PACKAGE.parent / "docs" / "messages.md"
T = np.arange(40) / 10
IMU = "time_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s"
ROW = "0,0,9.8,0,0,0"
UNO = PortInfo("/dev/ttyACM0", "Arduino Uno", 0x2341, 0x0043, "55", True, False)
Producer = Callable[[Path, pytest.MonkeyPatch], object]


def table(text: str, kind: str | None = None, name: str = "a.csv") -> Producer:
    return lambda folder, _: read_table(written(folder / name, text), kind)


def recording(text: str | bytes, name: str = "a.csv") -> Producer:
    return lambda folder, _: load_recording(written(folder / name, text))


def written(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def rig(text: str) -> Producer:
    return lambda folder, _: Rig.load(written(folder / "rig.toml", text))


def scored(ours: str, theirs: str) -> Producer:
    def run(folder: Path, _: pytest.MonkeyPatch) -> object:
        return evaluate(
            *(read_table(written(folder / name, text)) for name, text in (("e.csv", ours), ("t.csv", theirs)))
        )

    return run


def rows(names: str, start: float = 0.0) -> str:
    width = names.count(",")
    body = [f"{t:.2f}" + f",{np.sin(3 * t):.4f}" * width for t in T + start]
    return names + "\n" + "\n".join(body) + "\n"


def parquet(columns: list[str]) -> Producer:
    def run(folder: Path, _: pytest.MonkeyPatch) -> object:
        import pyarrow as pa
        import pyarrow.parquet as pq

        values = ["a" if name == "word" else 0.0 for name in columns]
        pq.write_table(pa.Table.from_arrays([pa.array([v]) for v in values], columns), folder / "a.parquet")
        return read_table(folder / "a.parquet")

    return run


def to_full_disk(folder: Path, _: pytest.MonkeyPatch) -> object:
    return CsvFile(Path("/dev/full"), "recording", {}, ["time_s"], force=True)


def to_closed_pipe(folder: Path, _: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        write_all(writing, folder / "pipe", b"1\n")
    finally:
        os.close(writing)


def to_removed_file(folder: Path, _: pytest.MonkeyPatch) -> None:
    with CsvFile(folder / "a.csv", "recording", {}, ["time_s"], force=False) as file:
        (folder / "a.csv").unlink()
        file.write("1\n")


def to_changed_file(folder: Path, _: pytest.MonkeyPatch) -> None:
    with CsvFile(folder / "a.csv", "recording", {}, ["time_s"], force=False) as file:
        (folder / "a.csv").write_text("")
        file.write("1\n")


def with_long_line(folder: Path, patch: pytest.MonkeyPatch) -> object:
    patch.setattr(chunks, "CHUNK_BYTES", 100)
    return read_table(written(folder / "a.csv", "time_s,a\n0,1\n" + "9" * 500))


def without_library(folder: Path, patch: pytest.MonkeyPatch) -> object:
    patch.setitem(sys.modules, "pylsl", None)
    return open_output("lsl:a", ["time_s"])


def with_filter(name: str, rig: Rig, sensors: Sensors) -> Producer:
    return lambda *_: Estimator([name] if name else [], rig, sensors)


def unknown_filter(folder: Path, _: pytest.MonkeyPatch) -> object:
    return estimate(LinkRun(duration_s=1.0).measurements(), ["join"])


def choosing(*found: PortInfo) -> Producer:
    def run(_: Path, patch: pytest.MonkeyPatch) -> object:
        patch.delenv("LINKPOSE_PORT", raising=False)
        patch.setattr(ports, "find_ports", lambda: list(found))
        patch.setattr(ports, "devices_without_port", lambda: [])
        return ports.choose_port()

    return run


def opening(name: str, error: OSError) -> Producer:
    """The system's error where a port is opened."""

    def run(_: Path, patch: pytest.MonkeyPatch) -> object:
        def refuse(*_args: object, **_options: object) -> None:
            raise serial.SerialException(error.errno, str(error))

        patch.setattr(serial, "serial_for_url", refuse)
        return ports.open_port(name)

    return run


def answering(chatter: bytes) -> Producer:
    """A port at which nothing but this comes."""

    def run(folder: Path, patch: pytest.MonkeyPatch) -> object:
        patch.setattr(session, "HANDSHAKE_TIMEOUT_S", 0.4)
        patch.setattr(session, "ASK_INTERVAL_S", 0.1)
        with PtyBoard(folder / "port", spoil=lambda _: b"", chatter=chatter):
            return session.Session(str(folder / "port"), print)

    return run


def hello_of_protocol(major: int) -> bytes:
    payload = bytes([1, major, 0]) + bytes(40)
    return cobs.encode(payload + crc_hqx(payload, 0xFFFF).to_bytes(2, "little")) + b"\0"


def capture(hello: Hello | None, samples: int) -> bytes:
    frames = [encode(s) for s in LinkRun(duration_s=1.0).samples()][:samples]
    return (b"" if hello is None else encode(hello)) + b"".join(frames)


def converting(text: str, name: str, wanted: str | None = None) -> Producer:
    return lambda folder, _: convert(written(folder / "e.csv", text), folder / name, wanted)


def serving(folder: Path, _: pytest.MonkeyPatch) -> object:
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        return open_output(f"ws://127.0.0.1:{busy.getsockname()[1]}", ["time_s"])


HELLO = board.hello(board.DEFAULTS)
NO_J2S, GUESS = Rig(), Rig.from_dict({"joint": {"j2s_m": [0, 0, 1], "j2s_std_m": 2.0}}, "a")
ESTIMATE = "time_s,tilt_height_m,tilt_roll_deg,tilt_pitch_deg"
# In the order of the page.
PRODUCERS: list[Producer] = [
    lambda folder, _: create(written(folder / "a", ""), False),
    lambda folder, _: read_table(folder / "none.csv"),
    lambda folder, _: create(folder / "no" / "a.csv", False),
    to_removed_file,
    to_changed_file,
    to_full_disk,
    to_closed_pipe,
    lambda folder, _: plotting.check_output(folder / "a.xyz", False),
    without_library,
    # tables
    table("# a comment alone\n"),
    table("time_s,height_m\n"),
    lambda folder, _: _without_rows(folder),
    with_long_line,
    table("0,1\n2,3\n"),
    table("time_s;a;a\n0;1;2\n"),
    parquet(["a", "a"]),
    recording(b"PK\x03\x04\n1\n"),
    lambda folder, _: read_table(written(folder / "a.bin", capture(HELLO, 5))),
    table("[joint]\nj2s_m = [1, 2, 3]\n"),
    table("time_s;a\n0;1\n1;2;3\n"),
    table("time_s,a\n0,5,1,5\n"),
    table('time_s;a\n0;"1\n1;2\n'),
    table("time_s;a\n0;tall\n"),
    table("time_s;a\n0;01. Mai\n"),
    table("time_s;a\n0,5;1.5\n"),
    parquet(["word"]),
    lambda folder, _: read_table(written(folder / "a.csv", "a,b\n1,2\n")).require("time_s"),
    table("time_s,a\n,1\n"),
    table("time_s,a\n1,1\n0,1\n"),
    recording(f"{IMU}\n0,{ROW}\ninf,{ROW}\n"),
    recording(f"{IMU}\n1,{ROW}\n1,{ROW}\n"),
    table("time_s,a\n0,1e20\n"),
    table("# linkpose estimate 1\n# {}\ntime_s,a\n0,1\n", "recording"),
    table("# linkpose recording 9\n# {}\ntime_s,a\n0,1\n"),
    table("# linkpose recording 1\n# {\ntime_s,a\n0,1\n"),
    table("# linkpose recording 1\n# []\ntime_s,a\n0,1\n"),
    recording(f'# linkpose recording 1\n# {{"settings": 3}}\n{IMU}\n0,{ROW}\n'),
    lambda folder, _: (written(folder / "a.meta.json", "{}"), read_table(written(folder / "a.csv", "time_s\n0\n"))),
    recording(f"{IMU},pressure_hPa\n0,{ROW},1\n"),
    recording("time_s,accel_x_m_s2\n0,1\n"),
    recording(f"{IMU},baro_fresh\n0,{ROW},2\n"),
    recording(f"{IMU},flags\n0,{ROW},-1\n"),
    # raw captures
    recording(capture(None, 5), "a.bin"),
    recording(capture(HELLO, 0), "a.bin"),
    recording(capture(HELLO._replace(sample_rate_hz=0), 5), "a.bin"),
    recording(hello_of_protocol(0) * 2, "a.bin"),
    # evaluation
    scored(rows(ESTIMATE), rows("time_s,height_m,roll_deg,pitch_deg", 3.0)),
    scored("time_s,tilt_height_m\n0,1\n1,1\n", "time_s,height_m\n5,1\n6,1\n"),
    scored("time_s,joint_height_m\n0,\n1,\n", "time_s,height_m\n0,1\n1,1\n"),
    scored(f"# linkpose recording 1\n# {{}}\n{IMU}\n0,{ROW}\n", rows("time_s,height_m")),
    scored(rows("time_s,length_m"), rows("time_s,height_m")),
    scored(rows(ESTIMATE), rows("time_s,length_m")),
    scored(rows(ESTIMATE), rows("time_s,vx_m_s")),
    scored(rows("time_s,tilt_height_m,tilt_height_std_m"), rows("time_s,height_m")),
    # filters and rig
    unknown_filter,
    with_filter("joint", NO_J2S, Sensors.MPU6050),
    with_filter("joint", GUESS, Sensors.MPU6050),
    with_filter("imu-baro", NO_J2S, Sensors.MPU6050),
    with_filter("", NO_J2S, Sensors(0)),
    rig("[joint\n"),
    rig("[joint]\nj2s = [0, 0, 1]\n"),
    rig("joint = 1\n"),
    rig("[[mouse]]\nx_m = 1\ny_m = 0\n" * 5),
    rig("[mouse]\nx_m = 1\n"),
    rig("[baro]\npressure_noise_Pa = 0\n"),
    rig('[chain]\njoint = "knee"\n'),
    rig("[[mouse]]\nx_m = 1\n"),
    # ports and boards
    choosing(),
    choosing(PortInfo("/dev/ttyS0", "", None, None, None, False, None)),
    choosing(UNO, replace(UNO, port="/dev/ttyACM1")),
    opening("/dev/ttyX", OSError(errno.ENOENT, "none")),
    opening("/dev/ttyX", OSError(errno.ENOTTY, "no terminal")),
    opening("/dev/ttyX", OSError(errno.EBUSY, "busy")),
    opening("/dev/ttyX", OSError(errno.EACCES, "denied")),
    answering(b""),
    answering(hello_of_protocol(0)),
    answering(hello_of_protocol(99)),
    # live outputs and conversion
    lambda *_: open_output("http://a:1", []),
    lambda *_: open_output("udp://no host.invalid:1", []),
    serving,
    converting(rows(ESTIMATE), "a.xyz"),
    converting(rows("time_s,tilt_height_m"), "a.tum"),
    converting("time_s,tilt_roll_deg,tilt_pitch_deg\n0,1,1\n1,,\n", "a.tum"),
    converting("time_s,tilt_roll_deg,tilt_pitch_deg\n0,1,1\n0.01,1,1\n0.02,1,1\n99999,1,1\n", "a.trc"),
]


def _without_rows(folder: Path) -> object:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"time_s": pa.array([], pa.float64())}), folder / "a.parquet")
    return read_table(folder / "a.parquet")


def messages() -> list[str]:
    """The messages of the page's tables, in order."""
    text = PAGE.read_text(encoding="utf-8").split("## Messages and cures")[1]
    return re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE)


def pattern(message: str) -> str:
    return ".*".join(re.escape(part) for part in message.split("…"))


def test_each_message_of_the_page_is_produced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    more = {message: produce for section in (*MORE.values(), *FURTHER.values()) for message, produce in section.items()}
    shown = messages()
    assert len(set(shown)) == len(shown), "a message has two rows"
    first = len(shown) - len(more)
    assert shown[first:] == list(more)
    assert first == len(PRODUCERS)
    producers = [*PRODUCERS, *(alone(produce) for produce in more.values())]
    found, kinds = [], set()
    for number, (message, produce) in enumerate(zip(shown, producers, strict=True)):
        if isinstance(produce, str):
            check_asserted(message, produce)
            found.append(message)
            continue
        (folder := tmp_path / str(number)).mkdir()
        with monkeypatch.context() as patch, pytest.raises((LinkposeError, click.ClickException)) as raised:
            produce(folder, patch)
            pytest.fail(f"nothing was raised for {message!r}")
        error = raised.value
        text = error.message if isinstance(error, click.ClickException) else sentence(error)
        assert re.fullmatch(pattern(message), text.replace("`", "")), f"{text!r} is not {message!r}"
        found.append(text.replace("`", ""))
        kinds |= {type(error), type(getattr(error, "reason", None))}
    text = "\n".join(found)  # which `.` does not cross
    missing = {of: where for of, where in sentences() if not re.search(pattern(of), text)}
    assert not missing, f"host/docs/messages.md has no row for {missing}"
    assert {kind.__name__ for kind in CURES} <= {kind.__name__ for kind in kinds}


def alone(produce: Callable[[Path], object] | str) -> Producer | str:
    return produce if isinstance(produce, str) else lambda folder, _: produce(folder)


def check_asserted(message: str, test: str, shortest: int = 10) -> None:
    """Fails unless that test exists, and its file holds a part of the message with which it compares.

    `shortest`: characters of a part.
    """
    file, function = test.split("::")
    source = (Path(__file__).parent / file).read_text(encoding="utf-8")
    assert f"def {function}(" in source, f"there is no test {test}"
    source = re.sub(r"[\\`]", "", source)
    words = [part for piece in message.split("…") for part in re.findall(rf"[^;:]{{{shortest},}}", piece)]
    assert any(words_of[at : at + 12] in source for words_of in words for at in range(max(1, len(words_of) - 12))), (
        f"{test} does not compare with {message!r}"
    )


# The promises of the page, and the tests that prove each. A computer that loses its power has none.
PROMISES = {
    "the program is killed (`kill -9`, a crash)": [
        "test_recording.py::test_kill_9_at_any_moment_leaves_a_readable_file"
    ],
    "the computer loses its power": [],
    "Ctrl-C, `SIGTERM`, a closed terminal (`SIGHUP`)": [
        "test_recording.py::test_ctrl_c_ends_a_recording_well",
        "test_streams.py::test_sighup_ends_a_recording_with_its_closing_line_unless_it_is_ignored",
    ],
    "the cable is unplugged": [
        "test_device.py::test_a_pulled_cable_is_waited_for_and_the_gap_is_marked",
        "test_device.py::test_a_board_that_returns_under_another_name_is_found",
        "test_device.py::test_a_board_that_does_not_return_ends_with_the_duration_and_what_is_missing_counts",
    ],
    "the board resets or is replaced": [
        "test_device.py::test_a_reset_board_goes_on_with_the_settings_of_before",
        "test_device.py::test_a_reset_between_configure_and_start_is_noticed",
        "test_device.py::test_another_board_behind_the_same_port_ends_the_recording",
    ],
    "the board's clock jumps, stands still or runs at a wrong rate": [
        "test_time.py::test_a_board_clock_that_jumps_is_replaced_by_its_ticks",
        "test_time.py::test_live_and_replay_place_samples_alike_where_the_board_clock_jumps",
    ],
    "a sensor disappears, freezes or returns": [
        "test_health.py::test_a_faulty_imu_is_left_out_counted_and_reported",
        "test_health.py::test_a_sensor_that_freezes_while_recording_is_reported_and_stored",
    ],
    "the disk is full or fails, or a network folder goes away": [
        "test_recording.py::test_a_full_disk_leaves_whole_rows_and_says_so",
        "test_outputs.py::test_a_check_that_fails_does_not_end_the_recording",
        "test_outputs.py::test_a_folder_that_is_removed_meanwhile_is_one_sentence",
    ],
    "the computer's date and time are set": ["test_time.py::test_the_date_that_is_set_meanwhile_changes_no_time"],
    "the recording is removed, replaced, emptied or written by another program": [
        "test_device.py::test_a_recording_that_another_program_takes_away_goes_on_in_a_new_file",
        "test_outputs.py::test_a_file_whose_folder_is_removed_goes_on_among_the_temporary_files",
        "test_device.py::test_a_raw_capture_that_another_program_takes_away_ends_with_a_sentence",
    ],
    "the terminal or a pipe behind standard error goes away": [
        "test_streams.py::test_a_message_that_cannot_be_shown_does_not_end_the_recording"
    ],
    "the computer sleeps or the program is suspended": [
        "test_device.py::test_a_suspended_program_does_not_report_a_silent_board"
    ],
    "two programs use one port or one file": [
        "test_device.py::test_absent_busy_and_impossible_ports",
        "test_recording.py::test_an_existing_file_is_kept_unless_forced",
        "test_board_reports.py::test_another_program_at_the_same_socket_is_reported_once",
    ],
    "an output file exists": ["test_recording.py::test_an_existing_file_is_kept_unless_forced"],
    "an input is a pipe or a device": [
        "test_inputs.py::test_a_pipe_is_read_like_a_file",
        "test_inputs.py::test_what_is_no_file_is_refused_in_time",
    ],
}


def test_each_promise_of_the_page_has_its_tests() -> None:
    text = PAGE.read_text(encoding="utf-8").split("\n## ")[1]
    assert re.findall(r"^\| ([^|]+?) \|", text, re.MULTILINE)[1:] == list(PROMISES)
    for name in (name for tests in PROMISES.values() for name in tests):
        file, function = name.split("::")
        source = (Path(__file__).parent / file).read_text(encoding="utf-8")
        assert f"def {function}(" in source, f"there is no test {name}"


# The tests that assert each report of the page, in its order.
REPORTS = [
    "test_flash_mismatch.py::test_another_minor_version_is_told_and_goes_on",
    "test_board_reports.py::test_mice_that_are_being_set_up_are_waited_for",
    "test_board_reports.py::test_another_program_at_the_same_socket_is_reported_once",
    "test_board_reports.py::test_acks_that_get_lost_while_resuming_do_not_end_the_recording",
    "test_device.py::test_a_board_that_returns_silent_is_waited_for_to_the_end",
    "test_device.py::test_a_board_that_returns_under_another_name_is_found",
    "test_board_reports.py::test_where_the_firmware_hung_is_reported",
    "test_board_reports.py::test_another_firmware_after_a_reset_is_reported",
    "test_board_reports.py::test_a_stream_that_another_program_starts_is_never_scaled_by_the_settings_of_before",
    "test_device.py::test_a_stream_that_turns_to_noise_is_reported",
    "test_device.py::test_a_board_that_does_not_return_ends_with_the_duration_and_what_is_missing_counts",
    "test_device.py::test_a_board_clock_that_stands_still_or_jumps_is_reported_once",
    "test_device.py::test_a_board_that_repeats_the_number_of_a_sample_is_reported_once",
    "test_board_reports.py::test_a_low_supply_is_reported_once",
    "test_board_reports.py::test_a_mouse_that_is_connected_later_is_reported",
    "test_device.py::test_a_recording_that_another_program_takes_away_goes_on_in_a_new_file",
]


def test_each_report_of_a_run_is_on_the_page_and_asserted() -> None:
    """Whatever the program notifies its user of while a board runs."""
    text = PAGE.read_text(encoding="utf-8").split("\n## Reports during a run")[1].split("\n## ")[0]
    shown = re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE)
    for report, test in zip(shown, REPORTS, strict=True):
        check_asserted(report, test, shortest=5)
    missing = {of: where for of, where in notices() if not any(re.fullmatch(pattern(row), of) for row in shown)}
    assert not missing, f"host/docs/messages.md has no row for {missing}"


def notices() -> Iterator[tuple[str, str]]:
    """The sentences that the library gives to `notify`, as `sentences` does, and where they are."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and name_of(node.func) == "notify" and node.args:
                text = text_of(node.args[0])
                if " " in text:
                    yield text, f"{path.relative_to(PACKAGE)}:{node.lineno}"


SHORTEST = 16  # characters of a sentence; shorter texts are the names of arguments
WRONG_USAGE = {"UsageError", "BadParameter", "fail"}


@cache
def sentences() -> list[tuple[str, str]]:
    """The sentences of all errors in the program, `…` for what is put in, and where they are."""
    sources = {path: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}
    nodes = {path: list(ast.walk(ast.parse(source))) for path, source in sources.items()}
    kinds = error_classes(nodes.values())
    found = []
    for path, of_file in nodes.items():
        for node in of_file:
            if isinstance(node, ast.ClassDef) and node.name in kinds:
                calls = [each for each in ast.walk(node) if isinstance(each, ast.Call) and is_of_base(each)]
            elif isinstance(node, ast.Call) and name_of(node.func) in kinds | WRONG_USAGE:
                calls = [node]
            else:
                continue
            for text in (text_of(argument) for call in calls for argument in call.args):
                if len(text) >= SHORTEST and " " in text:
                    found.append((text.replace("`", ""), f"{path.relative_to(PACKAGE)}:{node.lineno}"))
    return found


def error_classes(nodes: Iterable[list[ast.AST]]) -> set[str]:
    """The names of LinkposeError and of all classes below it, among all nodes of files."""
    bases = {
        node.name: {name_of(base) for base in node.bases}
        for of_file in nodes
        for node in of_file
        if isinstance(node, ast.ClassDef)
    }
    found = {"LinkposeError"}
    while more := {name for name, above in bases.items() if above & found} - found:
        found |= more
    return found


def name_of(node: ast.expr) -> str:
    return getattr(node, "id", "") or getattr(node, "attr", "")


def is_of_base(call: ast.Call) -> bool:
    """Whether it is `super().__init__(…)`."""
    return (
        isinstance(call.func, ast.Attribute)
        and call.func.attr == "__init__"
        and isinstance(call.func.value, ast.Call)
        and name_of(call.func.value.func) == "super"
    )


def text_of(node: ast.expr) -> str:
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) for part in node.values)
    return "…"


def test_every_form_of_a_sentence_is_found() -> None:
    """A sentence in an error of any class, in the class itself, and in an error of click."""
    tree = ast.parse(
        "class Own(LinkposeError):\n def __init__(self): super().__init__(f'{self} is of its own')\n"
        "class Further(Own): pass\n"
    )
    assert error_classes([list(ast.walk(tree))]) == {"LinkposeError", "Own", "Further"}
    (call,) = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and is_of_base(node)]
    assert [text_of(argument) for argument in call.args] == ["… is of its own"]
    assert len({where.split(":")[0] for _, where in sentences()}) > 50
