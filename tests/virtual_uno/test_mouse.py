"""The emulated PS/2 mouse, bit by bit, against a host that follows the PS/2 papers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from virtual_uno import CLOCK_HZ, Mouse, VirtualUno

MakeBoard = Callable[..., VirtualUno]
ACK, RESEND, ERROR = 0xFA, 0xFE, 0xFC


class Desk:
    """A mouse, and a host that talks to it."""

    def __init__(self, uno: VirtualUno) -> None:
        self.uno = uno
        self.mouse: Mouse = uno.mice[0]
        self.mouse.host()

    def received(self) -> list[int]:
        """Bytes since the last call; all of them sound."""
        received = self.mouse.host()
        assert all(each["sound"] for each in received), received
        return [each["byte"] for each in received]

    def send(self, *commands: int, wait_ms: float = 8.0) -> list[int]:
        received = []
        for command in commands:
            self.mouse.host(send=command)
            self.uno.run_ms(wait_ms)
            received += self.received()
        return received

    def boot(self) -> Desk:
        self.uno.run_ms(450)
        assert self.received() == [0xAA, 0x00]
        return self

    def move(self, x_mm: float, y_mm: float, duration_s: float) -> None:
        now = self.uno.time_s
        self.mouse.feed([now, now + duration_s], np.array([[0, 0], [x_mm, y_mm]]))


@pytest.fixture
def desk(asleep: MakeBoard) -> Desk:
    return Desk(asleep(mice=[{}]))


def packets(received: list[int]) -> list[tuple[int, int, int]]:
    """Flags, dx and dy of movement packets, with the ninth bits put in."""
    rows = np.array(received).reshape(-1, 3)
    return [(f, x - (256 if f & 0x10 else 0), y - (256 if f & 0x20 else 0)) for f, x, y in rows.tolist()]


def test_says_aa_00_after_power_and_reset(desk: Desk) -> None:
    desk.uno.run_ms(390)
    assert desk.received() == []
    desk.uno.run_ms(50)
    assert desk.received() == [0xAA, 0x00]
    assert desk.send(0xFF) == [ACK]
    desk.uno.run_ms(450)
    assert desk.received() == [0xAA, 0x00]


@pytest.mark.parametrize("clock_hz", [10_000, 12_500, 16_700])
def test_clocks_at_its_own_rate(asleep: MakeBoard, clock_hz: int) -> None:
    uno = asleep(mice=[{"clockHz": clock_hz}])
    uno.watch(["pin_d"])
    uno.run_ms(450)
    events = uno.events()
    clock = events["value"] & 0x04
    falls = events["cycle"][1:][(clock[1:] == 0) & (clock[:-1] != 0)]
    assert len(falls) == 22
    assert np.diff(falls[:11]) * clock_hz / CLOCK_HZ == pytest.approx(np.ones(10), rel=0.01)


def test_answers_every_command(desk: Desk) -> None:
    desk.boot()
    assert desk.send(0xF2) == [ACK, 0x00]
    assert desk.send(0xE9) == [ACK, 0x00, 0x02, 100]  # defaults: disabled, 4 counts/mm, 100 reports a second
    assert desk.send(0xE8, 3, 0xF3, 200, 0xE7, 0xF4) == [ACK] * 6
    assert desk.send(0xE9) == [ACK, 0x30, 0x03, 200]
    assert desk.send(0xE6, 0xF5, 0xF0) == [ACK] * 3
    assert desk.send(0xE9) == [ACK, 0x40, 0x03, 200]
    assert desk.send(0xEE) == [ACK]
    assert desk.send(0x12, 0xF4) == [0x12, 0xF4]  # wrap: it echoes
    assert desk.send(0xEC) == [ACK]
    assert desk.send(0xEA, 0xF6) == [ACK] * 2
    assert desk.send(0xE9) == [ACK, 0x00, 0x02, 100]


def test_refuses_what_it_does_not_know(desk: Desk) -> None:
    desk.boot()
    assert desk.send(0x55) == [RESEND]
    assert desk.send(0x55) == [ERROR]
    assert desk.send(0xF3, 33) == [ACK, RESEND]
    assert desk.send(50) == [ERROR]
    assert desk.send(0xE8, 4) == [ACK, RESEND]
    assert desk.send(1) == [ACK]


def test_streams_movement_at_its_rate_and_only_then(desk: Desk) -> None:
    desk.boot()
    assert desk.send(0xE8, 3, 0xF4) == [ACK] * 3
    desk.uno.run_ms(200)
    assert desk.received() == []
    desk.move(100.0, -50.0, 1.0)
    desk.uno.run_ms(1100)
    got = packets(desk.received())
    assert 99 <= len(got) <= 101
    assert [sum(each[axis] for each in got) for axis in (1, 2)] == [800, -400]
    assert all(each[0] == 0x28 for each in got)


def test_a_count_that_does_not_fit_sets_the_overflow_bit(desk: Desk) -> None:
    desk.boot()
    desk.send(0xF0)
    desk.move(100.0, -100.0, 0.01)
    desk.uno.run_ms(20)
    assert packets(desk.send(0xEB)[1:]) == [(0x08 | 0x40 | 0x80 | 0x20, 255, -256)]
    state = desk.mouse.state()
    assert state["discarded"] == [400 - 255, -400 + 256]


def test_movement_while_inhibited_is_kept(desk: Desk) -> None:
    desk.boot()
    desk.send(0xF4)
    desk.move(10.0, 20.0, 0.2)
    desk.mouse.host(inhibit_us=300_000)
    desk.uno.run_ms(299)
    assert desk.received() == []
    desk.uno.run_ms(30)
    assert packets(desk.received()) == [(0x08, 40, 80)]


def test_an_inhibit_inside_a_packet_has_the_packet_sent_again(desk: Desk) -> None:
    desk.boot()
    desk.send(0xF4)
    desk.uno.watch(["mouse_byte", "mouse_abort"])
    desk.move(10.0, 0.0, 0.001)
    assert desk.uno.run_until(lambda: len(desk.uno.events()) == 1, 30, 0.1)
    desk.uno.run_ms(0.4)
    assert [each["byte"] for each in desk.mouse.host(inhibit_us=200)] == [0x08]  # in the second byte
    desk.uno.run_ms(20)
    assert desk.uno.events()["kind"].tolist() == ["mouse_abort"] + ["mouse_byte"] * 3
    assert desk.received() == [0x08, 40, 0]
    assert desk.mouse.state()["reported"] == [40, 0]


@pytest.mark.parametrize(("whole", "again"), [(True, [0x08, 40, 0]), (False, [0])])
def test_resend_repeats_the_last_packet(asleep: MakeBoard, whole: bool, again: list[int]) -> None:
    desk = Desk(asleep(mice=[{"repeatsWholePacket": whole}])).boot()
    desk.send(0xF4)
    desk.move(10.0, 0.0, 0.001)
    desk.uno.run_ms(20)
    assert desk.received() == [0x08, 40, 0]
    assert desk.send(0xFE) == again
    assert desk.mouse.state()["packets"] == 1


def test_double_scaling_of_the_stream(desk: Desk) -> None:
    desk.boot()
    desk.send(0xE7, 0xF4)
    for mm, expected in ((0.25, 1), (0.5, 1), (0.75, 3), (1.0, 6), (1.25, 9), (2.5, 20)):
        desk.move(mm, -mm, 0.001)
        desk.uno.run_ms(20)
        assert packets(desk.received()) == [(0x28, expected, -expected)]


def test_faults_show_on_the_wire(desk: Desk) -> None:
    desk.boot()
    desk.mouse.spoil_parity(1)
    desk.mouse.host(send=0xF2)
    desk.uno.run_ms(8)
    assert [(each["byte"], each["sound"]) for each in desk.mouse.host()] == [(ACK, False), (0x00, True)]
    desk.mouse.lose_clocks(1)
    assert desk.send(0xF5) == []  # ten clocks are no byte
    desk.mouse.set(ignores=[0xF5], refuses=[0xE9])
    assert desk.send(0xF5) == []
    assert desk.send(0xE9) == [RESEND]


def test_parity_errors_at_intervals(desk: Desk) -> None:
    desk.boot()
    desk.send(0xF4)
    desk.mouse.spoil_parity_every(0.5)
    desk.move(400.0, 0.0, 4.2)
    desk.uno.run_ms(4200)
    assert [each["sound"] for each in desk.mouse.host()].count(False) == 8


@pytest.mark.parametrize("unplugged_ms", [400.3, 400.71, 401.2, 401.9])
def test_unplugged_in_the_middle_of_a_byte(desk: Desk, unplugged_ms: float) -> None:
    desk.uno.run_ms(unplugged_ms)
    desk.mouse.unplug()
    desk.uno.run_ms(10)
    desk.mouse.host(inhibit_us=10)
    desk.mouse.plug()
    desk.uno.run_ms(10)
    desk.mouse.host()
    desk.uno.run_ms(440)
    assert desk.received() == [0xAA, 0x00]
