"""What the board reports of itself, its sensors and its mice reaches the user; resets while the session resumes."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from pty_board import PtyBoard, link_run
from scripted_board import ScriptedBoard, install

from linkpose.board import Board
from linkpose.device import session as session_module
from linkpose.device.session import Session
from linkpose.sensors.conversion import GAP_BEFORE
from linkpose.sensors.devices import mouse_speed_limit
from linkpose.sensors.rig import Mouse, Rig
from linkpose.wire.messages import (
    Ack,
    Command,
    Configure,
    DeviceState,
    Hello,
    HelloMouse,
    Message,
    MouseLacks,
    Nak,
    NakReason,
    Pong,
    ResetCause,
    SelfTestResult,
    Start,
)

FAST = "sim://mice?speed=0"
OK, STARTING, ABSENT = DeviceState.OK, DeviceState.STARTING, DeviceState.ABSENT


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Iterator[ScriptedBoard]:
    yield install(monkeypatch)


def mouse(state: DeviceState, lacks: int = 0) -> HelloMouse:
    known = state == OK
    return HelloMouse(state, 0 if known else 0xFF, 0x60 * known, 8 * known, 200 * known, lacks)


def hellos(*states: tuple[DeviceState, ...]) -> Callable[[Hello], Hello]:
    """HELLOs whose mice have these states, one HELLO after the other; the last states stay."""
    left = list(states)
    return lambda hello: hello._replace(mice=tuple(map(mouse, left.pop(0) if len(left) > 1 else left[0])))


# ---- mice ----


@pytest.mark.parametrize(
    ("states", "wanted", "waits"),
    [
        ([(OK, OK, OK)], 3, False),
        ([(STARTING, OK, OK), (STARTING, OK, OK), (OK, OK, OK)], 0, True),
        ([(OK, ABSENT, ABSENT), (OK, OK, ABSENT)], 2, True),
    ],
    ids=["all there", "being set up", "found later"],
)
def test_mice_that_are_being_set_up_are_waited_for(
    board: ScriptedBoard, states: list[tuple[DeviceState, ...]], wanted: int, waits: bool
) -> None:
    board.hello = hellos(*states)
    messages: list[str] = []
    with Session(FAST, messages.append) as session:
        session.wait_for_mice(wanted)
        assert [m.state for m in session.hello.mice] == list(states[-1])
    assert messages == ["Waiting for the mice, which are being set up or have not been found yet"] * waits


def test_a_mouse_that_never_comes_does_not_hold_up_the_recording(
    board: ScriptedBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session_module, "MICE_TIMEOUT_S", 0.02)
    board.hello = hellos((STARTING, OK, ABSENT))
    with Board(
        FAST, notify=lambda _: None, rig=Rig(mouse=(Mouse(0.1, 0.0), Mouse(-0.1, 0.1), Mouse(-0.1, -0.1)))
    ) as connected:
        block = next(connected.stream(0.1))
    assert block.mice_counts.shape[1] == 3  # a column for each mouse of the rig


def test_what_a_mouse_refused_is_reported(board: ScriptedBoard, linkpose: Callable) -> None:
    mice = tuple(mouse(OK, int(lack)) for lack in MouseLacks)
    board.hello = lambda hello: hello._replace(mice=mice[1:])
    output = linkpose("info", "--port", FAST).err
    for port, words in enumerate(("ENABLE", "200 reports/s", "runs at 8 counts/mm", "its resolution is assumed"), 1):
        assert re.search(f"The mouse at port {port} .*{words}", output)
    board.hello = lambda hello: hello._replace(mice=mice[:1])
    assert "The mouse at port 1 refuses remote mode: it is read in stream mode" in linkpose("info", "--port", FAST).err


def test_the_speed_limit_of_mice_by_their_counts() -> None:
    assert mouse_speed_limit(8000, 100) == pytest.approx(3.19, abs=0.01)  # firmware/README.md: 3.2 m/s
    assert mouse_speed_limit(1000 / 0.0254, 100) == pytest.approx(0.65, abs=0.01)
    assert mouse_speed_limit(1000 / 0.0254, 100, poll_s=0.026) == pytest.approx(0.65 / 3, abs=0.01)
    assert mouse_speed_limit(8000, 200) == mouse_speed_limit(8000, 100)  # polled at every second tick


@pytest.mark.parametrize(("poll_us", "limit"), [(6000, "1.28"), (20_000, "0.64")])
def test_a_mouse_that_overflows_early_is_reported_from_its_calibration(
    board: ScriptedBoard, poll_us: int, limit: str
) -> None:
    board.status = lambda status: status._replace(mice=tuple(mouse._replace(poll_us=poll_us) for mouse in status.mice))
    messages: list[str] = []
    rig = Rig(mouse=(Mouse(0.1, 0.0), Mouse(-0.1, 0.0, counts_per_m=20_000.0)))
    with Board(FAST, notify=messages.append, rig=rig) as connected:
        for _ in connected.stream(2.5):
            pass
    warned = [line for line in messages if "overflow" in line]
    assert len(warned) == (poll_us > 7500)
    assert all(f"Mouse 2 counts 20000 per metre: above {limit} m/s" in line for line in warned)


# ---- the board ----


@pytest.mark.parametrize(("millivolts", "warned"), [(4300, True), (4500, False), (0, False)])
def test_a_low_supply_is_reported_once(board: ScriptedBoard, millivolts: int, warned: bool) -> None:
    board.status = lambda status: status._replace(vcc_mv=millivolts)
    messages: list[str] = []
    with Session(FAST, messages.append) as session:
        for _ in session.stream(3.5):
            pass
    assert session.status is not None and session.status.vcc_mv == millivolts
    assert [line for line in messages if "supply" in line] == [
        "The supply of the board is 4.3 V (±10 %), below 4.5 V: mice or sensors may fail. Use a shorter USB cable or "
        "another port, or supply the mice separately"
    ] * warned


def test_where_the_firmware_hung_is_reported(board: ScriptedBoard, linkpose: Callable) -> None:
    board.resets, board.cause, board.hung_at = [50], int(ResetCause.HUNG | ResetCause.WATCHDOG), 0x1234
    messages: list[str] = []
    with Session(FAST, messages.append) as session:
        for _ in session.stream(1.5):
            pass
    assert messages[0] == (
        "the board was reset (the firmware hung at program counter 0x1234); going on, the gap is marked"
    )
    assert "the firmware hung at program counter 0x1234" in linkpose("info", "--port", FAST).out


def test_another_firmware_after_a_reset_is_reported(board: ScriptedBoard) -> None:
    """As after an upload to another board of the same kind, which takes its place."""
    board.resets = [50]
    board.hello = lambda hello: hello._replace(source_revision=0x1234 if board.resets else 0xABCD)
    messages: list[str] = []
    with Session(FAST, messages.append) as session:
        for _ in session.stream(1.5):
            pass
    assert "the board's firmware is another one now: source revision 0000abcd instead of 00001234" in messages, messages


def test_a_mouse_that_is_connected_later_is_reported(board: ScriptedBoard) -> None:
    """The recording has columns for the two mice of the first HELLO."""
    board.hello = lambda hello: hello._replace(sections=hello.sections & ~0x70 | 2 << 4, mice=hello.mice[:2])
    messages: list[str] = []
    with Board(FAST, notify=messages.append, rig=Rig()) as connected:
        for _ in connected.stream(1.0):
            pass
    found = [line for line in messages if "a mouse was found at port 3, which had none at the start" in line]
    assert len(found) == 1, messages


@pytest.mark.parametrize(
    ("url", "prefixes"),
    [("sim://link?speed=0", [""]), ("sim://link?speed=0&imu2=1", ["", "imu2_"])],
    ids=["one", "two"],
)
def test_info_tests_every_inertial_sensor(linkpose: Callable, url: str, prefixes: list[str]) -> None:
    report = json.loads(linkpose("info", "--port", url, "--self-test", "--json").out)
    assert [name for name in report if name.endswith("self_test")] == [f"{prefix}self_test" for prefix in prefixes]
    for prefix in prefixes:
        assert report[f"{prefix}self_test"] == "passed"
        assert len(report[f"{prefix}self_test_deviation_percent"]) == 6


def test_a_board_without_inertial_sensor_has_no_self_test(board: ScriptedBoard, refused: Callable) -> None:
    gone = {"id": 0, "family": 0, "state": ABSENT}
    board.hello = lambda hello: hello._replace(devices=(hello.devices[0]._replace(**gone), *hello.devices[1:]))
    board._self_test = lambda device: [session_module.Nak(Command.SELF_TEST, 10)]
    assert "refused SELF_TEST: sensor absent" in refused("info", "--port", "sim://link", "--self-test")


@pytest.mark.parametrize(
    ("messages", "reported"),
    [
        ([Pong(7, 0), Pong(8, 0)], True),
        ([Ack(Command.STOP)], True),
        ([Nak(Command.CONFIGURE, NakReason.STREAMING)], True),
        ([Ack(Command.START), SelfTestResult(*[0] * 20)], False),
    ],
    ids=["PONG", "STOP", "CONFIGURE", "own"],
)
def test_another_program_at_the_same_socket_is_reported_once(
    board: ScriptedBoard, monkeypatch: pytest.MonkeyPatch, messages: list[Message], reported: bool
) -> None:
    """Nothing locks a socket:// port. Answers that this program has not asked for show the other one."""
    monkeypatch.setattr(session_module.random, "getrandbits", lambda bits: 1 << (bits - 1))
    board.inserted = [(50 + at, message) for at, message in enumerate(messages)]
    messages: list[str] = []
    with Session(FAST, messages.append) as session:
        assert sum(map(len, session.stream(1.0))) == 100
    assert not board.inserted
    assert (
        messages
        == [f"another program also sends commands to the board at {FAST}; close it, or the data will have gaps"]
        * reported
    )


# ---- silence, and streams of others ----


def test_a_stream_that_another_program_starts_is_never_scaled_by_the_settings_of_before(board: ScriptedBoard) -> None:
    """The board streams at ±16 g and 50 Hz as asked; after a reset it is started at its defaults, and no HELLO comes.

    Gravity read 19.6 m/s² and time ran at half its rate, without a word.
    """
    board.foreign_starts = [20]
    messages, connected, blocks = stream_through(board)
    check_resumed(connected, blocks)
    (line,) = messages
    assert "does not go on from its last sample: the board was started again, or is another one" in line


def test_another_board_that_streams_ends_the_recording(board: ScriptedBoard) -> None:
    board.foreign_starts = [20]
    other_id = {"id": 0x70}

    def hello(message: Hello) -> Hello:
        if board.foreign_starts:
            return message
        return message._replace(devices=(message.devices[0]._replace(**other_id), *message.devices[1:]))

    board.hello = hello
    with Session("sim://link?speed=0", print) as session, pytest.raises(session_module.AnotherBoard, match="0x70"):
        list(session.stream(2.0))


def test_a_hello_with_other_settings_during_the_stream_is_not_ignored(board: ScriptedBoard) -> None:
    """Another program asks for HELLO after it has changed the settings."""
    messages: list[str] = []
    with Session("sim://link?speed=0", messages.append) as session:
        board.inserted = [(50, session.hello._replace(streaming=1, accel_range_g=2))]
        assert sum(map(len, session.stream(2.0))) + session.timeline.lost == 200
        assert [gap.cause for gap in session.timeline.gaps] == ["reset"]
    assert ["does not go on from its last sample" in line for line in messages] == [True]


def test_one_sample_sent_for_ever_ends_with_the_duration(board: ScriptedBoard, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of them passed for a sample that had come, so that the run never ended."""
    monkeypatch.setattr(session_module, "SILENCE_S", 0.2)
    board.repeats_from = 50
    messages: list[str] = []
    with Session("sim://link?speed=0", messages.append) as session:
        assert sum(map(len, session.stream(2.0))) == 50
        assert (session.timeline.lost, session.timeline.gaps[-1].cause) == (150, "link")
    assert ["numbers that came before" in line for line in messages] == [True, False]
    assert "150 samples are counted as lost" in messages[1]


def test_what_is_missing_when_the_user_ends_the_run_counts(
    board: ScriptedBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording that Ctrl-C ended in a silence of hours had "0 lost" and no gap."""
    monkeypatch.setattr(session_module, "LATE_S", 0.05)
    messages: list[str] = []
    with Session("sim://link?speed=0", messages.append) as session:
        board.pauses_at = 50
        stream = session.stream()
        while session.health().silent_s < 1.0:
            next(stream)
        stream.close()
        check_missing_at_the_end(session, messages, "link")
        assert session.timeline.lost >= 90


def test_what_is_missing_when_the_user_ends_the_wait_for_the_board_counts(tmp_path: Path) -> None:
    messages: list[str] = []
    with PtyBoard(tmp_path / "port") as board, Session(str(tmp_path / "port"), messages.append) as session:
        stream = session.stream()
        while session.timeline.samples < 20:
            next(stream)
        board.pull()
        while session.health().silent_s < 0.3:
            next(stream)
        stream.close()
        check_missing_at_the_end(session, messages, "cable")
        assert session.timeline.lost >= 25


def test_a_program_that_is_late_itself_does_not_call_the_board_silent() -> None:
    """On a loaded computer the live view asked to check the cable of a healthy board."""
    with Session("sim://link?speed=5", print) as session:
        stream = session.stream()
        next(stream)
        time.sleep(0.4)  # without a turn: two seconds of the board's time are unread
        assert session.health().silent_s < 0.1
        stream.close()


def check_missing_at_the_end(session: Session, messages: list[str], cause: str) -> None:
    timeline = session.timeline
    assert timeline.lost == timeline.missing_at_end
    assert [gap.cause for gap in timeline.gaps] == [cause]
    assert timeline.duration_s == pytest.approx(0.01 * (timeline.samples + timeline.lost), abs=0.02)
    assert f"{timeline.lost} samples are counted as lost" in messages[-1]


# ---- resets while the session resumes ----


WANTED = {"sample_rate_hz": 50, "accel_range_g": 16}


def stream_through(board: ScriptedBoard, duration_s: float = 6.0) -> tuple[list[str], Board, list]:
    messages: list[str] = []
    with Board("sim://link?speed=0", settings=WANTED, notify=messages.append) as connected:
        blocks = list(connected.stream(duration_s))
    return messages, connected, blocks


def check_resumed(connected: Board, blocks: list) -> None:
    """One gap, and values scaled by the settings in force: gravity stays gravity."""
    gaps = connected.health.gaps
    assert [gap.cause for gap in gaps] == ["reset"]
    assert connected.settings.sample_rate_hz == 50
    accel = np.concatenate([block.accel_m_s2 for block in blocks])
    flags = np.concatenate([block.flags for block in blocks])
    assert np.count_nonzero(flags & GAP_BEFORE) == 1
    assert len(accel) + connected.health.lost == 300
    assert np.linalg.norm(accel, axis=1).mean() == pytest.approx(9.8, abs=1.0)


class FirstAfterResets:
    """Selects the first `left` messages of a kind once the board has no reset before it."""

    def __init__(self, board: ScriptedBoard, kind: type[object], left: int) -> None:
        self._board, self._kind, self.left = board, kind, left

    def __call__(self, message: object) -> bool:
        is_one = not self._board.resets and self.left > 0 and isinstance(message, self._kind)
        self.left -= is_one
        return is_one


def test_a_second_reset_while_resuming_is_waited_for(board: ScriptedBoard, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reset after 20 samples; each of the next resets comes between CONFIGURE and START, more often than is tried."""
    monkeypatch.setattr(session_module, "ANSWER_TIMEOUT_S", 0.2)
    board.resets = [20]
    board.resets_at = again = FirstAfterResets(board, Start, 5)
    messages, connected, blocks = stream_through(board)
    check_resumed(connected, blocks)
    assert again.left == 0
    assert any("was reset" in line for line in messages)


def test_acks_that_get_lost_while_resuming_do_not_end_the_recording(
    board: ScriptedBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ACK of CONFIGURE is lost five times, and three are tried: the board is waited for as after a cut cable."""
    monkeypatch.setattr(session_module, "ANSWER_TIMEOUT_S", 0.2)
    board.resets = [20]
    board.lost = lost = FirstAfterResets(board, Configure, 5)
    messages, connected, blocks = stream_through(board)
    check_resumed(connected, blocks)
    assert lost.left == 0
    assert any("waiting for the board, Ctrl-C ends" in line for line in messages)
    assert board.opened == 2


def test_a_board_whose_samples_come_late_is_heard_to_the_end(
    board: ScriptedBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An emulated board on a loaded machine lags by 30 % and pauses near the end: it has not ended before its last."""
    monkeypatch.setattr(session_module, "LATE_S", 0.05)
    board.rate, board.pauses_at = 0.7, 250
    samples = idle = 0
    with Board("sim://link?speed=0", settings=WANTED, notify=print) as connected:
        for block in connected.stream(6.0, yield_idle=True):
            samples, idle = samples + len(block), 0 if len(block) else idle + 1
            if idle == 3:
                board.pauses_at = -1
    assert board.pauses_at == -1
    assert (samples, connected.health.lost) == (300, 0)


def test_info_reports_the_load_of_the_processor_as_a_share_and_the_mice_in_words(
    board: ScriptedBoard, linkpose: Callable, tmp_path: Path
) -> None:
    """STATUS carries the load in thousandths, and HELLO the state and the refusals of a mouse as numbers."""
    board.hello = lambda hello: hello._replace(mice=(mouse(OK, MouseLacks.REMOTE_MODE), mouse(ABSENT)))
    board.status = lambda status: status._replace(cpu_load=350, stack_free=512, loop_worst_us=900, vcc_mv=0)
    with PtyBoard(tmp_path / "port", make=lambda: board.switch_on(link_run)):
        counters = json.loads(linkpose("info", "--port", tmp_path / "port", "--json").out)["board"]
        printed = linkpose("info", "--port", tmp_path / "port").out
    assert counters["cpu_load_percent"] == 35.0 and counters["stack_free_bytes"] == 512
    assert counters["loop_worst_us"] == 900 and counters["vcc_mv"] is None
    shown = [" ".join(line.split()) for line in printed.splitlines()]
    assert {"cpu load 35.0 %", "stack free 512 bytes", "loop worst 900 µs", "vcc not measured"} <= set(shown)
    assert "mice port 1 (id 0x00): ok, 8 counts/mm, 200 reports/s, refused remote mode" in shown
