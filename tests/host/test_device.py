"""The session: what can come at the other end of a cable, and what becomes of a recording then."""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import select
import socket
import subprocess
import sys
import threading
import time
import types
from pathlib import Path

import numpy as np
import pytest
from pty_board import PtyBoard, link_run
from scripted_board import install
from serial.tools import list_ports_common
from terminal import HOST

from linkpose.device import ports
from linkpose.device import session as session_module
from linkpose.device.connection import Connection
from linkpose.device.session import Session
from linkpose.errors import BoardError, CannotWrite
from linkpose.recorder import Recorder, raw_capture
from linkpose.recording.table import read_table
from linkpose.sensors.conversion import GAP_BEFORE
from linkpose.sensors.mpu6050 import self_test_deviation
from linkpose.sensors.rig import Rig
from linkpose.simulation.board import DEFAULTS, SimulatedBoard
from linkpose.wire.frames import StreamDecoder, encode
from linkpose.wire.messages import Ack, Command, Configure, Hello, Nak, NakReason, Ping, Sample


@pytest.fixture
def impatient(monkeypatch):
    """A handshake that gives up sooner."""
    monkeypatch.setattr(session_module, "HANDSHAKE_TIMEOUT_S", 0.7)
    monkeypatch.setattr(session_module, "ASK_INTERVAL_S", 0.1)


def stranger(path: Path, chatter: bytes) -> PtyBoard:
    """A port at which no board answers; `chatter` is sent again and again."""
    return PtyBoard(path, spoil=lambda data: b"", chatter=chatter)


OLD_HELLO = bytes.fromhex("01") + bytes([0, 9]) + b"\x11\x22\x33\x44" + b"whatever followed then"
NEW_HELLO = bytes.fromhex("01") + bytes([3, 0]) + b"\x11\x22\x33\x44" + bytes(60)


def framed(payload: bytes) -> bytes:
    from binascii import crc_hqx

    from cobs import cobs

    return cobs.encode(payload + crc_hqx(payload, 0xFFFF).to_bytes(2, "little")) + b"\0"


@pytest.mark.parametrize(
    ("chatter", "sentence"),
    [
        (b"", "the board is silent"),
        (b"Temperature: 23.4 C\r\n", "another firmware answers: 'Temperature: 23.4 C"),
        (random.Random(3).randbytes(60), "only noise was received"),
        (b"\xff\xfe\xff\xfc" * 10, "only noise was received"),
        (encode(Nak(Command.GET_INFO, NakReason.UNKNOWN_COMMAND)), "the board refuses every command"),
        (framed(b"\x01\x02" + bytes(100)), "a frame of type 0x01 with 101 bytes arrived intact"),
        (framed(OLD_HELLO), "the board's firmware is old: it uses protocol 0.9, this linkpose 2.0"),
        (framed(NEW_HELLO), "this linkpose is old: it uses protocol 2.0, the board's firmware 3.0"),
    ],
    ids=["silence", "text", "noise", "wrong baud", "refusals", "five mice", "older board", "newer board"],
)
@pytest.mark.parametrize("command", ["record", "info", "estimate --live"])
def test_what_answers_instead_of_a_board(impatient, refused, tmp_path, chatter, sentence, command):
    out = [tmp_path / "r.csv"] if command == "record" else []
    with stranger(tmp_path / "port", chatter):
        output = refused(*command.split(), "--port", tmp_path / "port", *out)
    assert sentence in output
    assert not (tmp_path / "r.csv").exists()


def test_a_raw_capture_of_another_protocol_is_named(refused, tmp_path):
    capture = tmp_path / "old.bin"
    capture.write_bytes(b"\0" + framed(bytes([1, 1, 4]) + OLD_HELLO[3:]) + framed(bytes([2]) + bytes(30)))
    output = refused("estimate", capture, "-o", tmp_path / "e.csv")
    assert "protocol 1.4" in output
    assert not (tmp_path / "e.csv").exists()


def test_an_edited_schema_of_the_same_version_is_refused(impatient, refused, tmp_path):
    from linkpose.simulation import board as simulated

    hello = simulated.hello(simulated.DEFAULTS)._replace(schema_crc=1)
    with stranger(tmp_path / "port", encode(hello)):
        assert "linkpose flash" in refused("info", "--port", tmp_path / "port")


def test_absent_busy_and_impossible_ports(refused, tmp_path):
    assert "there is no port /dev/ttyNONE" in refused("info", "--port", "/dev/ttyNONE")
    (tmp_path / "file").write_text("no port")
    assert "is not a serial port" in refused("info", "--port", tmp_path / "file")
    assert "is not a serial port" in refused("info", "--port", os.devnull)  # which another program has open, too
    assert "nonsense://x is not a port" in refused("info", "--port", "nonsense://x")
    assert "no simulated board 'nothing'" in refused("info", "--port", "sim://nothing")
    assert "no option tset" in refused("info", "--port", "sim://link?tset=1")
    with PtyBoard(tmp_path / "port"), Session(str(tmp_path / "port"), print):
        assert "is in use by another program" in refused("info", "--port", tmp_path / "port")


def test_settings_are_put_in_force_or_refused_with_the_reason():
    with Session("sim://link", print) as session:
        settings = Configure(200, 4, 500, 2, 0, 8, 400)
        hello = session.configure(settings)
        assert (hello.sample_rate_hz, hello.accel_range_g, hello.gyro_range_deg_s) == (200, 4, 500)
        with pytest.raises(session_module.LinkposeError, match="gyro range out of range"):
            session.configure(settings._replace(gyro_range_deg_s=123))
        deviations = self_test_deviation(session.self_test())
    assert len(deviations) == 6
    assert all(abs(deviation) < 0.001 for deviation in deviations.values())


def test_a_board_that_streams_already_is_taken_over(tmp_path):
    with PtyBoard(tmp_path / "port"):
        first = Session(str(tmp_path / "port"), print)
        next(iter(first.stream()))
        first._connection.close()  # as a killed program leaves it: no STOP
        with Session(str(tmp_path / "port"), print) as second:
            assert isinstance(second.hello, Hello)
            seqs = [p.place.seq for placements in second.stream(0.3) for p in placements]
    assert seqs == list(range(30))


def record_through(port: Path | str, out: Path, *happenings, after: int = 50) -> tuple[list[str], Session]:
    """Records until `after` samples have come behind a gap.

    Each happening (condition on the messages and the number of samples, what) is done in its turn. Nothing depends on
    how long anything takes.
    """
    from linkpose.sensors.rig import Rig

    messages: list[str] = []
    waiting = list(happenings)
    with Session(str(port), messages.append) as session, Recorder(session, out, Rig(), False) as recorder:
        behind = None
        for placements in session.stream():
            recorder.convert(placements)
            timeline = session.timeline
            if waiting and waiting[0][0](messages, timeline.samples):
                waiting.pop(0)[1]()
            if behind is None and timeline.gaps and not waiting:
                behind = timeline.samples
            if behind is not None and timeline.samples >= behind + after:
                break
        recorder.close("interrupted")
    assert not waiting
    return messages, session


def samples(count: int):
    """The condition that so many samples have come."""
    return lambda _said, number: number >= count


def said_that(words: str):
    """The condition that a message contains these words."""
    return lambda messages, _number: any(words in line for line in messages)


def check_one_gap(out: Path, cause: str) -> None:
    table = read_table(out, "recording")
    marked = np.flatnonzero(table.columns["flags"].astype(int) & GAP_BEFORE)
    assert len(marked) == 1
    assert table.closing is not None
    [gap] = table.closing["gaps"]
    assert gap["cause"] == cause
    time_s, seq = table.columns["time_s"], table.columns["seq"]
    # Time runs on through the gap as the host's clock does, and seq counts the ticks that were missed.
    assert gap["duration_s"] == pytest.approx(time_s[marked[0]] - time_s[marked[0] - 1], abs=1e-5)
    assert seq[-1] == pytest.approx(time_s[-1] * 100, abs=3)
    assert table.closing["lost"] == gap["lost"] == seq[-1] + 1 - len(table)
    steps = np.delete(np.diff(time_s), marked[0] - 1)
    assert steps.min() > 0.0099 and steps.max() < 0.0101


def test_a_pulled_cable_is_waited_for_and_the_gap_is_marked(tmp_path):
    with PtyBoard(tmp_path / "port") as board:
        messages, session = record_through(
            tmp_path / "port", tmp_path / "r.csv", (samples(50), board.pull), (said_that("disappeared"), board.plug)
        )
    assert "disappeared" in messages[0] and "is back" in messages[1]
    assert len(session.health().gaps) == 1
    check_one_gap(tmp_path / "r.csv", "cable")


class UsbPorts:
    """The system's list of ports: the boards that are plugged in, with their serial numbers."""

    def __init__(self, monkeypatch) -> None:
        self.boards: list[tuple[PtyBoard, str | None]] = []
        monkeypatch.setattr(ports.list_ports, "comports", self.comports)

    def comports(self) -> list[list_ports_common.ListPortInfo]:
        found = []
        for board, number in self.boards:
            if board.path.exists():
                port = list_ports_common.ListPortInfo(str(board.path))
                port.vid, port.pid, port.serial_number = 0x2341, 0x0043, number
                found.append(port)
        return found


@pytest.mark.parametrize("number", ["75735", None], ids=["by its serial number", "as the only one of its kind"])
def test_a_board_that_returns_under_another_name_is_found(tmp_path, monkeypatch, number):
    usb = UsbPorts(monkeypatch)
    with PtyBoard(tmp_path / "ttyACM0") as board:
        usb.boards.append((board, number))
        messages, session = record_through(
            tmp_path / "ttyACM0",
            tmp_path / "r.csv",
            (samples(20), board.pull),
            (said_that("disappeared"), lambda: board.plug(tmp_path / "ttyACM1")),
            after=20,
        )
    assert f"the board is back at {tmp_path / 'ttyACM1'}" in messages[1]
    assert session.port == str(tmp_path / "ttyACM1")
    check_one_gap(tmp_path / "r.csv", "cable")


def test_another_board_at_the_old_name_is_not_opened(tmp_path, monkeypatch):
    usb = UsbPorts(monkeypatch)
    with PtyBoard(tmp_path / "ttyACM0") as board, PtyBoard(tmp_path / "other") as other:
        usb.boards += [(board, "1"), (other, "2")]

        def swap() -> None:
            other.pull()
            other.plug(tmp_path / "ttyACM0")
            board.plug(tmp_path / "ttyACM1")

        messages, session = record_through(
            tmp_path / "ttyACM0",
            tmp_path / "r.csv",
            (samples(20), board.pull),
            (said_that("disappeared"), swap),
            after=20,
        )
        assert not other.received.is_set()
    assert session.port == str(tmp_path / "ttyACM1"), messages


def test_an_obstacle_at_the_port_is_reported_once(tmp_path, monkeypatch):
    attempts = []

    def busy(name: str) -> str | None:
        attempts.append(name)
        return "modem-manager (process 7)" if 1 < len(attempts) < 6 else None  # the first time is the session's own

    monkeypatch.setattr(ports, "holder", busy)
    with PtyBoard(tmp_path / "port") as board:
        messages, _ = record_through(
            tmp_path / "port",
            tmp_path / "r.csv",
            (samples(20), board.pull),
            (said_that("disappeared"), board.plug),
            after=20,
        )
    assert len(attempts) == 6
    assert sum("is in use by modem-manager (process 7). Close it" in line for line in messages) == 1


def wait_for_rows(path):
    """Until a recording has a few samples: those that the board has sent may not have arrived yet."""
    while not path.exists() or path.read_bytes().count(b"\n") < 10:
        time.sleep(0.005)


def test_a_board_that_does_not_return_ends_with_the_duration_and_what_is_missing_counts(tmp_path, linkpose):
    with PtyBoard(tmp_path / "port") as board:
        pull = threading.Thread(target=lambda: (wait_for_rows(tmp_path / "r.csv"), board.pull()))
        pull.start()
        result = linkpose("record", tmp_path / "r.csv", "--port", tmp_path / "port", "--duration", 2, "--json")
        pull.join()
    table = read_table(tmp_path / "r.csv", "recording")
    summary = json.loads(result.out.splitlines()[-1])
    assert result.status == 0
    assert summary["lost"] + summary["samples"] == 200
    assert summary["duration_s"] == 2.0
    assert summary["gaps"] == table.closing["gap_count"] == 1
    assert table.closing["gaps"][0]["cause"] == "cable"
    assert f"{summary['lost']} samples are counted as lost" in result.err


def test_a_reset_board_goes_on_with_the_settings_of_before(tmp_path):
    with PtyBoard(tmp_path / "port") as board:
        messages, _ = record_through(tmp_path / "port", tmp_path / "r.csv", (samples(40), board.reset))
    assert "was reset (power on)" in messages[0]
    check_one_gap(tmp_path / "r.csv", "reset")


def test_a_reset_whose_hello_is_lost_is_noticed(tmp_path):
    with PtyBoard(tmp_path / "port") as board:
        reset = (samples(30), lambda: board.reset(says_hello=False))
        messages, _ = record_through(tmp_path / "port", tmp_path / "r.csv", reset)
    assert "no sample for 1.5 s" in messages[0] and "was reset" in messages[1]
    check_one_gap(tmp_path / "r.csv", "reset")


def test_a_suspended_program_does_not_report_a_silent_board(tmp_path):
    """After SIGSTOP the clock has run on, but nothing was waited for."""
    messages: list[str] = []
    ahead_s = 0.0
    clock = types.SimpleNamespace(perf_counter=lambda: time.perf_counter() + ahead_s, sleep=time.sleep)
    port = tmp_path / "port"
    with PtyBoard(port), Session(str(port), messages.append) as session, pytest.MonkeyPatch.context() as patch:
        patch.setattr(session_module, "time", clock)
        for _ in session.stream():
            ahead_s += 10.0
            if session.timeline.samples > 40:
                break
    assert not messages


def test_a_port_that_goes_during_the_handshake_is_a_sentence(refused, tmp_path):
    with stranger(tmp_path / "port", b"") as board:
        pull = threading.Thread(target=lambda: (board.received.wait(), board.pull()))
        pull.start()
        output = refused("info", "--port", tmp_path / "port")
        pull.join()
    assert "is gone" in output and "check the cable" in output


@contextlib.contextmanager
def serial_server(serves):
    """The port of a server on this computer; `serves` gets each connection in turn, and the one before or None."""
    stop = threading.Event()

    def serve() -> None:
        before = None
        while not stop.is_set():
            if select.select([listener], [], [], 0.05)[0]:
                before = serves(listener.accept()[0], before)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[1]
        stop.set()
        thread.join()


def test_a_serial_server_that_serves_another_program_is_a_sentence(refused):
    def refuse(connection: socket.socket, _before: None) -> None:
        connection.close()

    with serial_server(refuse) as port:
        output = refused("info", "--port", f"socket://127.0.0.1:{port}")
    assert "is gone" in output and "close other programs that use it, and check the network and try again" in output


@pytest.mark.parametrize("scheme", ["socket", "Socket"])  # a port is asked what it is, not its name
def test_what_a_serial_server_has_sent_arrives_at_once(scheme):
    """Two bytes a turn took a quarter of a core at 500 Hz, and on a loaded machine the stream came 12 s late."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        connection = Connection(f"{scheme}://127.0.0.1:{server.getsockname()[1]}")
        with contextlib.closing(connection), server.accept()[0] as board:
            board.sendall(bytes(4000))
            sizes = []
            while sum(sizes) < 4000:
                arrival = connection.receive(10.0)
                assert arrival is not None
                sizes.append(len(arrival.data))
    assert len(sizes) < 40


def test_another_program_that_takes_the_connection_to_a_serial_server_is_suspected(tmp_path):
    def serve_the_newest(connection: socket.socket, before: socket.socket | None) -> socket.socket:
        if before is not None:
            with contextlib.suppress(OSError):  # it has ended
                before.shutdown(socket.SHUT_RDWR)
        threading.Thread(target=board, args=(connection,), daemon=True).start()
        return connection

    def board(connection: socket.socket) -> None:
        simulated, began = SimulatedBoard(link_run), time.perf_counter()
        with connection, contextlib.suppress(OSError):
            while True:
                arrived = connection.recv(4096) if select.select([connection], [], [], 0.004)[0] else None
                if arrived == b"":
                    return
                now_us = int((time.perf_counter() - began) * 1e6)
                connection.sendall(simulated.advance(now_us) + simulated.receive(arrived or b"", now_us))

    with serial_server(serve_the_newest) as port:
        name = f"socket://127.0.0.1:{port}"
        take = lambda: socket.create_connection(("127.0.0.1", port)).close()  # noqa: E731
        messages, _ = record_through(name, tmp_path / "r.csv", (samples(50), take))
    assert messages[0].startswith(f"{name} disappeared")
    assert messages[0].endswith("; if another program uses it, close that one; waiting for the board, Ctrl-C ends")
    assert "is back" in messages[1]
    check_one_gap(tmp_path / "r.csv", "cable")


def test_a_board_that_returns_silent_is_waited_for_to_the_end(impatient, monkeypatch, tmp_path, linkpose):
    silent = threading.Event()
    with PtyBoard(tmp_path / "port", spoil=lambda data: b"" if silent.is_set() else data) as board:

        def come_back_silent() -> None:
            wait_for_rows(tmp_path / "r.csv")
            board.pull()
            silent.set()
            board.plug()

        back = threading.Thread(target=come_back_silent)
        back.start()
        result = linkpose("record", tmp_path / "r.csv", "--port", tmp_path / "port", "--duration", 3)
        back.join()
    assert result.status == 0
    assert result.err.count("the board is silent") == 1 and "; still waiting" in result.err
    assert read_table(tmp_path / "r.csv", "recording").closing["gaps"][0]["cause"] == "cable"


def test_an_ack_of_start_that_is_lost_costs_no_sample(tmp_path):
    start_ack = encode(Ack(Command.START))
    port = tmp_path / "port"
    with PtyBoard(port, spoil=lambda data: data.replace(start_ack, b"")), Session(str(port), print) as session:
        seqs = [p.place.seq for placements in session.stream(0.3) for p in placements]
    assert seqs == list(range(30))


def test_corrupt_bytes_are_counted_and_lost_samples_too(tmp_path, linkpose):
    """One bit of every tenth sample, anywhere in front of the frame's end: CRC-16 finds each."""
    rng = random.Random(5)

    def flip(message: Sample, count: int) -> bytes:
        frame = bytearray(encode(message))
        if count % 10 == 0:
            frame[rng.randrange(len(frame) - 1)] ^= 1 << rng.randrange(8)
        return bytes(frame)

    with PtyBoard(tmp_path / "port", spoil=SpoiledSamples(0, flip)):
        result = linkpose("record", tmp_path / "r.csv", "--port", tmp_path / "port", "--duration", 1.05, "--json")
    summary = json.loads(result.out.splitlines()[-1])
    table = read_table(tmp_path / "r.csv", "recording")
    assert result.status == 0
    assert (summary["samples"], summary["lost"], len(table)) == (95, 10, 95)
    assert summary["corrupt"] >= 10  # a bit that makes a zero divides a frame
    assert set(range(105)) - set(table.columns["seq"]) == set(range(9, 105, 10))


def test_a_full_pipe_of_arrivals_loses_nothing_while_the_program_is_busy(tmp_path):
    with PtyBoard(tmp_path / "port"), Session(str(tmp_path / "port"), print) as session:
        seqs = []
        for placements in session.stream(1.5):
            if not seqs:
                time.sleep(1.0)  # a slow disk
            seqs += [p.place.seq for p in placements]
    assert seqs == list(range(150))


class Forgetful(SimulatedBoard):
    """A board that is reset, and whose HELLO gets lost, each time that it has answered a PING after a CONFIGURE."""

    def __init__(self, resets: int) -> None:
        super().__init__(link_run)
        self.resets = resets
        self._configured = False

    def _answer(self, message, now_us):
        answers = super()._answer(message, now_us)
        self._configured |= isinstance(message, Configure)
        if self.resets and self._configured and isinstance(message, Ping):
            self.resets -= 1
            self._configured = False
            self._settings = DEFAULTS
            self._run = link_run(DEFAULTS)
        return answers


@pytest.mark.parametrize("resets", [1, 2])
def test_a_reset_between_configure_and_start_is_noticed(tmp_path, monkeypatch, resets):
    """The values are never scaled by settings that the board does not have: 200 Hz and 16 g are streamed in the end."""
    board = Forgetful(resets)
    monkeypatch.setattr("pty_board.SimulatedBoard", lambda _: board)
    with PtyBoard(tmp_path / "port"), Session(str(tmp_path / "port"), print) as session:
        session.configure(session.settings._replace(sample_rate_hz=200, accel_range_g=16))
        samples = [p.sample for placements in session.stream(0.2) for p in placements]
    assert len(samples) == 40
    assert np.mean([sample.accel_z for sample in samples]) == pytest.approx(2048, rel=0.1)  # 1 g at 16 g


def test_a_board_that_is_reset_again_and_again_is_named(tmp_path, monkeypatch):
    board = Forgetful(1000)
    monkeypatch.setattr("pty_board.SimulatedBoard", lambda _: board)
    with PtyBoard(tmp_path / "port"), Session(str(tmp_path / "port"), print) as session:
        session.configure(session.settings._replace(sample_rate_hz=200))
        with pytest.raises(session_module.LinkposeError, match="reset again and again"):
            next(iter(session.stream(0.2)))


class SpoiledSamples:
    """Changes samples on their way to the host, from the n-th on."""

    def __init__(self, first: int, change) -> None:
        self._first, self._change, self._count = first, change, 0
        self._decoder = StreamDecoder()

    def __call__(self, data: bytes) -> bytes:
        return b"".join(self._pass_on(message) for message in self._decoder.feed(data))

    def _pass_on(self, message) -> bytes:
        if isinstance(message, Sample):
            self._count += 1
            if self._count > self._first:
                return self._change(message, self._count)
        return encode(message)


def lines_of(port: Path, words: str, most: int = 400) -> list[str]:
    """Messages of a session up to the first with these words."""
    messages: list[str] = []
    with Session(str(port), messages.append) as session:
        for _ in session.stream():
            if any(words in line for line in messages) or session.timeline.samples > most:
                break
    return messages


def test_a_stream_that_turns_to_noise_is_reported(tmp_path):
    noise = random.Random(1).randbytes(30)
    with PtyBoard(tmp_path / "port", spoil=SpoiledSamples(20, lambda message, count: noise)):
        messages = lines_of(tmp_path / "port", "noise")
    assert re.fullmatch(r"no sample for 1.5 s, only \d+ bytes of noise; asking the board", messages[0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda message, count: encode(message._replace(t_us=5_000_000)), "stands still"),
        (lambda message, count: encode(message._replace(t_us=message.t_us + 3_000_000)), "jumped by 3.00 s"),
    ],
    ids=["frozen", "jumping"],
)
def test_a_board_clock_that_stands_still_or_jumps_is_reported_once(tmp_path, change, words):
    with PtyBoard(tmp_path / "port", spoil=SpoiledSamples(20, change)):
        messages = lines_of(tmp_path / "port", words)
    (line,) = [line for line in messages if words in line]
    assert "; its count of ticks gives the times from here on. Replace the board if it happens again" in line


def test_a_board_that_repeats_the_number_of_a_sample_is_reported_once(tmp_path, monkeypatch):
    monkeypatch.setattr(session_module, "SILENCE_S", 0.2)
    frozen = SpoiledSamples(20, lambda sample, count: encode(sample._replace(seq=20)))
    messages = []
    with PtyBoard(tmp_path / "port", spoil=frozen), Session(str(tmp_path / "port"), messages.append) as session:
        samples = sum(map(len, session.stream(1.0)))
        assert samples + session.health().lost == 100
    assert sum("20 samples came with numbers that came before, and are left out" in line for line in messages) == 1


def test_another_board_behind_the_same_port_ends_the_recording(tmp_path):
    from linkpose.simulation import board as simulated

    ours = simulated.hello(simulated.DEFAULTS)
    other = ours._replace(devices=(ours.devices[0]._replace(id=0x70), *ours.devices[1:]))
    changed = threading.Event()

    def spoil(data: bytes) -> bytes:
        return data.replace(encode(ours), encode(other)) if changed.is_set() else data

    port = tmp_path / "port"
    refusal = pytest.raises(session_module.AnotherBoard, match="0x70 instead of 0x68")
    with PtyBoard(port, spoil=spoil) as board, Session(str(port), print) as session, refusal:
        for _ in session.stream():
            if session.timeline.samples > 10 and not changed.is_set():
                changed.set()
                board.reset(says_hello=False)


def test_a_barometer_with_other_words_is_another_board(monkeypatch):
    board = install(monkeypatch)
    board.resets = [20]

    def other(hello: Hello) -> Hello:
        return hello if board.resets else hello._replace(baro_words=(1, *hello.baro_words[1:]))

    board.hello = other
    refusal = pytest.raises(
        session_module.AnotherBoard, match=r"another board answers at .* now; record it into a file"
    )
    with Session("sim://link?speed=0", print) as session, refusal:
        list(session.stream(2.0))


def test_a_board_that_starts_and_sends_no_sample_is_a_failure(tmp_path):
    board = PtyBoard(tmp_path / "port", spoil=SpoiledSamples(0, lambda message, count: b""))
    refusal = pytest.raises(BoardError, match="accepted START, but no sample arrived")
    with board, Session(str(tmp_path / "port"), print) as session, refusal:
        assert not any(session.stream(0.1))


def _replace(path: Path) -> None:
    """As a second program with --force does."""
    path.unlink()
    path.write_text("another program's\n")


def _append(path: Path) -> None:
    with path.open("a") as file:
        file.write("a line\n")


@pytest.mark.parametrize(
    ("change", "reason", "keeps", "plain"),
    [
        (Path.unlink, "it was removed", True, True),
        (_replace, "it was removed", True, False),
        (lambda path: path.write_text(""), "another program changed it", False, False),
        (_append, "another program changed it", False, True),
    ],
    ids=["removed", "replaced", "emptied", "written"],
)
def test_a_recording_that_another_program_takes_away_goes_on_in_a_new_file(tmp_path, change, reason, keeps, plain):
    """With the rows so far, where another program has not changed them."""
    out, said, before = tmp_path / "r.csv", [], 0
    (tmp_path / "r-2.csv").write_text("taken\n")
    with Session("sim://link?speed=0", said.append) as session, Recorder(session, out, Rig(), plain=plain) as recorder:
        for placements in session.stream(2):
            for at, placement in enumerate(placements):  # a list may hold all of them
                if not before and session.timeline.samples - len(placements) + at > 10:
                    before = session.timeline.samples - len(placements) + at
                    change(out)
                recorder.convert([placement])
        recorder.close("duration")
    assert said == [
        f"cannot write {out}: {reason} while it was being written; the recording goes on in {recorder.path}"
    ]
    assert recorder.path == tmp_path / "r-3.csv"
    table = read_table(recorder.path, "recording")
    assert len(table) == (200 if keeps else 200 - before) and table.closing["ended"] == "duration"


def test_a_raw_capture_that_another_program_takes_away_ends_with_a_sentence(tmp_path):
    raw = tmp_path / "r.bin"
    refusal = pytest.raises(CannotWrite, match="it was removed while it was being written")
    with refusal, raw_capture(raw) as file, Session("sim://link?speed=0", print, file) as session:
        for _ in session.stream(2):
            raw.unlink(missing_ok=True)


def test_a_raw_capture_that_is_taken_away_after_its_last_bytes_ends_with_a_sentence(tmp_path):
    raw = tmp_path / "r.bin"
    with pytest.raises(CannotWrite, match="it was removed while it was being written"), raw_capture(raw) as file:
        file.write(b"\0")
        raw.unlink()


def test_a_raw_capture_on_a_full_disk_ends_with_a_sentence():
    refusal = pytest.raises(session_module.LinkposeError, match="cannot write the raw capture any more: No space left")
    with raw_capture(Path("/dev/full")) as file, refusal, Session("sim://link?speed=0", print, file):
        pass


def test_a_raw_capture_is_added_to_what_the_standard_output_has(tmp_path):
    record = ("record", "r.csv", "--raw", "-", "--port", "sim://link?speed=0", "--duration", "1", "-q")
    with (tmp_path / "all.bin").open("ab") as behind:
        behind.write(b"before")
        behind.flush()
        environment = {**os.environ, "PYTHONPATH": str(HOST)}
        command = [sys.executable, "-m", "linkpose", *record]
        done = subprocess.run(command, stdout=behind, cwd=tmp_path, env=environment, check=False)
    assert done.returncode == 0 and len((tmp_path / "all.bin").read_bytes()) > 3000


def test_a_recording_is_not_called_a_raw_capture(refused, tmp_path):
    assert "is not a name for a recording" in refused("record", tmp_path / "x.bin", "--port", "sim://link")
    assert not (tmp_path / "x.bin").exists()
