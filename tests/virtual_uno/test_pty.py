"""The emulated board behind a pseudo-terminal, as a host program meets it."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest
import serial
from pty_server import PtyServer
from wire_link import WireLink

from linkpose.wire.frames import OtherProtocol, StreamDecoder, encode
from linkpose.wire.messages import (
    BAUD,
    Ack,
    Configure,
    DeviceState,
    GetInfo,
    Hello,
    Message,
    MouseLacks,
    ResetCause,
    Sample,
    SampleFlags,
    Start,
    Status,
)

MakeBoard = Callable[..., WireLink]
SERVE = Path(__file__).with_name("serve.py")
READS = 1000  # of 20 ms each in which a host reads nothing at all, before a test gives up
LOOKS = 20_000  # of 1 ms each, at a condition. A test that is suspended does not look in the meantime.


def wait_until(condition: Callable[[], bool]) -> None:
    """Looks at a condition until it holds. Fails the test after LOOKS."""
    for _ in range(LOOKS):
        if condition():
            return
        time.sleep(0.001)
    pytest.fail("waited too long")


@contextlib.contextmanager
def serving(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    """A command that serves a board, once it is ready. It does not outlive the test."""
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as served:
        try:
            assert served.stdout
            assert json.loads(served.stdout.readline())["event"] == "ready"
            yield served
        finally:
            served.send_signal(signal.SIGTERM)


class Host:
    """A host that has the port open."""

    def __init__(self, link: Path, baud: int = BAUD) -> None:
        self.port = serial.Serial(str(link), baud, timeout=0.02)
        self.decoder = StreamDecoder()
        self.messages: list[Message | OtherProtocol] = []

    def read_until(self, enough: Callable[[], bool]) -> None:
        """Raises OSError when the port is gone: pyserial's SerialException from `read`, another from `in_waiting`."""
        idle = 0
        while not enough():
            data = self.port.read(self.port.in_waiting or 1)
            idle = 0 if data else idle + 1
            assert idle < READS, f"came: {self.messages[-3:]}, {self.decoder.corrupt}"
            self.messages += self.decoder.feed(data)

    def expect(self, kind: type) -> Message | OtherProtocol:
        self.read_until(lambda: any(isinstance(message, kind) for message in self.messages))
        index = next(i for i, message in enumerate(self.messages) if isinstance(message, kind))
        message = self.messages[index]
        del self.messages[: index + 1]
        return message

    def start(self) -> None:
        self.expect(Hello)
        self.port.write(encode(Start()))
        self.expect(Ack)

    def read_samples(self, count: int) -> None:
        self.read_until(lambda: len(self.samples) >= count)

    @property
    def samples(self) -> list[Sample]:
        return [message for message in self.messages if isinstance(message, Sample)]


def whole(samples: list[Sample]) -> bool:
    return all(after.seq - before.seq == 1 for before, after in pairwise(samples))


def test_a_host_opens_the_port_and_reads_the_stream(board: MakeBoard, tmp_path: Path) -> None:
    """Flat out: 20 s of the board's time in a few seconds, complete."""
    with PtyServer(board().uno, tmp_path / "port", paced=False):
        host = Host(tmp_path / "port")
        host.start()
        host.read_samples(2000)
        assert whole(host.samples)
        assert host.decoder.corrupt.total == 0
        host.port.close()


class HeldClock:
    """A clock that goes on by one millisecond whenever it is read, however fast the machine is."""

    def __init__(self) -> None:
        self.time_s = 0.0

    def __call__(self) -> float:
        self.time_s += 0.001
        return self.time_s


def test_paced_bytes_never_come_before_their_time(board: MakeBoard, tmp_path: Path) -> None:
    clock, uno = HeldClock(), board().uno
    ahead_s: list[float] = []
    server = PtyServer(uno, tmp_path / "port", clock=clock, on_slice=lambda: ahead_s.append(uno.time_s - clock.time_s))
    with server:
        host = Host(tmp_path / "port")
        host.start()
        host.read_samples(100)
        host.port.close()
    assert server.stop().bytes_dropped == 0
    assert max(ahead_s) < 0.001
    assert whole(host.samples)


def test_the_boards_clock_may_be_off(board: MakeBoard, tmp_path: Path) -> None:
    """20 % fast, which no UNO is, so that one second shows it."""
    with PtyServer(board().uno, tmp_path / "port", clock_ppm=200_000, clock=HeldClock()) as server:
        host = Host(tmp_path / "port")
        host.start()
        host.read_samples(100)
        host.port.close()
    statistics = server.stop()
    assert statistics.board_s / statistics.wall_s == pytest.approx(1.2, abs=0.01)


def test_opening_the_port_resets_the_board(board: MakeBoard, tmp_path: Path) -> None:
    with PtyServer(board().uno, tmp_path / "port", paced=False) as server:
        for _ in range(3):
            host = Host(tmp_path / "port")
            host.start()
            host.read_samples(10)
            assert host.samples[0].seq == 0
            host.port.close()
            wait_until(lambda: not server.host_present)
    assert server.stop().opens == 3


def test_a_pulled_cable_takes_the_port_away_and_gives_it_back(board: MakeBoard, tmp_path: Path) -> None:
    link = tmp_path / "port"
    with PtyServer(board().uno, link, paced=False, reset_on_open=False) as server:
        host = Host(link)
        host.start()
        host.read_samples(10)
        server.call(server.pull_cable)
        with pytest.raises(OSError):
            host.read_until(lambda: False)
        host.port.close()
        assert not link.is_symlink()
        server.call(server.put_cable_back)
        wait_until(link.exists)
        again = Host(link)
        again.read_samples(10)
        assert again.samples[0].seq > host.samples[-1].seq  # it went on with its own supply
        assert whole(again.samples)
        again.port.close()


def test_a_host_at_another_rate_reads_garbage(board: MakeBoard, tmp_path: Path) -> None:
    with PtyServer(board().uno, tmp_path / "port", paced=False):
        host = Host(tmp_path / "port", baud=115200)
        garbage = b""
        while len(garbage) < 10:
            garbage += host.port.read(10 - len(garbage))
        assert len(garbage) == 10
        assert host.decoder.feed(garbage + b"\0") == []
        assert host.decoder.corrupt.total > 0
        host.port.close()


def test_a_host_that_stalls_is_in_step_again(board: MakeBoard, tmp_path: Path) -> None:
    """Ten seconds at 500 Hz without reading: more than the system keeps. What it kept and what comes later is sound."""
    with PtyServer(board().uno, tmp_path / "port", paced=False) as server:
        host = Host(tmp_path / "port")
        host.expect(Hello)
        host.port.write(encode(Configure(500, 8, 1000, 3, 1, 8, 400)))
        host.expect(Ack)
        host.port.write(encode(Start()))
        host.expect(Ack)
        server.waits_for_host = False
        begin = server.statistics.board_s
        wait_until(lambda: server.statistics.board_s >= begin + 10)
        server.waits_for_host = True
        kept = 0

        def resumed() -> bool:
            nonlocal kept
            gaps = [i for i, (before, after) in enumerate(pairwise(host.samples)) if after.seq != before.seq + 1]
            kept = gaps[-1] + 1 if gaps else 0
            return kept > 0 and len(host.samples) > kept + 100

        host.read_until(resumed)
        host.port.close()
    assert server.stop().bytes_dropped > 0
    assert host.decoder.corrupt.total <= kept // 100 + 2
    assert whole(host.samples[kept:])


def test_the_command_serves_breaks_and_reports(firmware_hex: Path, tmp_path: Path) -> None:
    """A sensor is pulled by a line on its standard input, the cable at a time of the board."""
    link = tmp_path / "port"
    command = [sys.executable, str(SERVE), "--hex", str(firmware_hex), "--link", str(link)]
    options = ["--flat-out", "--duration", "41", "--test", "2", "--fault", "40:cable-pull"]
    with serving([*command, *options]) as served:
        assert served.stdin
        assert served.stdout
        host = Host(link)
        host.start()
        host.read_samples(500)
        assert len({sample.accel_x for sample in host.samples}) > 200  # the link moves
        for fault, flag in (("imu-unplug", 0), ("imu-plug", SampleFlags.IMU_VALID)):
            served.stdin.write(fault + "\n")
            served.stdin.flush()
            host.read_until(lambda flag=flag: host.samples[-1].flags & SampleFlags.IMU_VALID == flag)
        with pytest.raises(OSError):
            host.read_until(lambda: False)
        host.port.close()
        served.send_signal(signal.SIGTERM)
        report = json.loads(served.stdout.readline())
    assert served.returncode == 0
    assert report["event"] == "end"
    assert report["board_s"] == pytest.approx(40, abs=0.1)
    assert report["opens"] == 1
    assert whole(host.samples)


def test_the_command_serves_parts_that_deviate(firmware_hex: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(SERVE), "--hex", str(firmware_hex), "--link", str(tmp_path / "port"), "--flat-out"]
    command += ["--imu", "whoAmI=0x72", "--imu2", "whoAmI=0x70,fault=frozen", "--bmp280", "--mag", "hmc5883l"]
    command += ["--mice", "2", "--mouse", "1:refuses=0xE6+0xE8,darkUntilEnable=true", "--mouse", "2:plugged=false"]
    command += ["--supply", "4.2", "--bootloader-image", "ATmegaBOOT"]
    with serving(command) as served:
        assert served.stdin and served.stdout
        host = Host(tmp_path / "port")
        host.start()
        host.expect(Status)
        assert host.expect(Status).vcc_mv == pytest.approx(4200, abs=50)
        host.port.write(encode(GetInfo()))
        hello = host.expect(Hello)
        assert [device.id for device in hello.devices] == [0x72, 0x70, 0x58, 0x48]
        states = [DeviceState.UNVERIFIED, DeviceState.FAILED, DeviceState.OK, DeviceState.OK]
        assert [device.state for device in hello.devices] == states
        assert [mouse.state for mouse in hello.mice[:2]] == [DeviceState.OK, DeviceState.ABSENT]
        assert hello.mice[0].lacks == MouseLacks.RESOLUTION
        for line in ("supply=5", "imu2-fault=none", "mouse1-set=refuses=0xEB"):
            served.stdin.write(line + "\n")
            served.stdin.flush()
        host.read_until(lambda: bool(host.samples) and host.samples[-1].flags & SampleFlags.IMU2_VALID != 0)
        served.stdin.write("hang=interrupts\n")
        served.stdin.flush()
        assert host.expect(Hello).reset_cause & ResetCause.HUNG
        host.port.close()


def test_the_command_ends_well_on_a_signal(firmware_hex: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(SERVE), "--hex", str(firmware_hex), "--link", str(tmp_path / "port")]
    with serving(command) as served:
        assert served.stdout
        served.send_signal(signal.SIGINT)
        assert json.loads(served.stdout.readline())["event"] == "end"
        assert served.wait() == 0
    assert not (tmp_path / "port").is_symlink()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--hex", "no.hex"], "no.hex"),
        (["--hex", __file__], "line 1 of the program is not Intel HEX"),
        (["--fault", "0:fire"], "there is no fault 'fire'"),
        (["--test", "9"], "there is no Test 9"),
        (["--imu", "fire=1"], "there is no option 'fire=1'"),
        (["--mice", "1", "--mouse", "2:clockHz=10000"], "names no mouse: the board has 1"),
    ],
)
def test_the_command_says_what_is_wrong(
    firmware_hex: Path, tmp_path: Path, arguments: list[str], sentence: str
) -> None:
    command = [sys.executable, str(SERVE), "--hex", str(firmware_hex), "--link", str(tmp_path / "port")]
    done = subprocess.run([*command, "--duration", "1", *arguments], capture_output=True, text=True)
    assert done.returncode == 1
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
