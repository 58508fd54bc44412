"""A simulated board in this process whose answers a test changes. It needs no clock, no thread and no terminal."""

from __future__ import annotations

from collections.abc import Callable
from functools import partialmethod
from typing import Any

import pytest

from linkpose.device import session as session_module
from linkpose.simulation import protocol_sim
from linkpose.simulation.board import Run, SimulatedBoard
from linkpose.wire.frames import OtherProtocol, encode
from linkpose.wire.messages import Configure, GetInfo, Hello, Message, ResetCause, Start, Status


class ScriptedBoard(SimulatedBoard):
    """The board behind every `sim://` port that the test opens.

    `hello` and `status` change what the board reports; `lost` decides which answers get lost, by the command. A reset
    happens so many ticks after the host has checked the stream's settings (`resets`), and at each command for which
    `resets_at` is true; after one of `foreign_starts`, another program starts the board. From `repeats_from` on, it
    sends one sample again and again.
    """

    def __init__(self) -> None:
        self.hello: Callable[[Hello], Hello] = lambda hello: hello
        self.status: Callable[[Status], Status] = lambda status: status
        self.lost: Callable[[Message | OtherProtocol], bool] = lambda message: False
        self.resets: list[int] = []
        self.foreign_starts: list[int] = []
        self.repeats_from = -1
        self._frame = b""
        self.resets_at: Callable[[Message | OtherProtocol], bool] = lambda message: False
        self.cause = int(ResetCause.POWER_ON)
        self.hung_at = 0xFFFF
        self.inserted: list[tuple[int, Message]] = []  # messages that come with a tick
        self.pauses_at = -1  # the tick at which it sends nothing until the test changes this
        self.rate = 1.0  # of the board's clock against the host's
        self.opened = 0
        self._checked_at: int | None = None  # tick of the first GET_INFO since START

    def switch_on(self, make_run: Callable[[Configure], Run]) -> ScriptedBoard:
        """A host opens the port, which resets the board."""
        super().__init__(make_run)
        self.opened += 1
        return self

    def reset(self) -> bytes:
        """The board starts with its defaults; its HELLO."""
        super().__init__(self._make_run)
        self._checked_at = None
        return encode(self._hello())

    @property
    def _pauses(self) -> bool:
        """Also until the host has checked the stream's settings: time at full speed would run away from a slow host."""
        return self._samples is not None and (self._checked_at is None or self._tick == self.pauses_at)

    @property
    def next_tick_us(self) -> int | None:
        return None if self._pauses else super().next_tick_us

    def advance(self, now_us: int) -> bytes:
        if self._pauses:
            return b""
        before = self._tick
        data = super().advance(now_us)
        if self._tick <= self.repeats_from:
            self._frame = data[: data.find(b"\0") + 1] or self._frame
        elif self.repeats_from >= 0:
            data = self._frame * (self._tick - before)
        while self.inserted and self._samples is not None and self._tick >= self.inserted[0][0]:
            message = self.inserted.pop(0)[1]
            data += encode(message)
            if isinstance(message, Hello):  # the host looks at the settings
                self._checked_at = None
        if self._has_passed(self.resets):
            data += self.reset()
        if self._has_passed(self.foreign_starts):
            self.reset()
            super()._answer(Start(), now_us)
            self._checked_at = 0
            data += super().advance(self._start_us)
            self._checked_at = None
        return data

    def _has_passed(self, ticks: list[int]) -> bool:
        """Whether so many ticks as the first of these have passed since the host checked, which is then removed."""
        if not ticks or self._checked_at is None or self._tick < self._checked_at + ticks[0]:
            return False
        del ticks[0]
        return True

    def _answer(self, message: Message | OtherProtocol, now_us: int) -> list[Message]:
        if self.resets_at(message):
            self.reset()
            return [self._hello()]
        answers = super()._answer(message, now_us)
        if isinstance(message, GetInfo) and self._samples is not None and self._checked_at is None:
            self._checked_at = self._tick
        return [] if self.lost(message) else answers

    def _hello(self) -> Hello:
        hello = super()._hello()._replace(reset_cause=self.cause, hung_at=self.hung_at)
        return self.hello(hello)

    def _status(self, now_us: int) -> Status:
        return self.status(super()._status(now_us))


def _open(
    port: protocol_sim.Serial,
    really_open: Callable[[protocol_sim.Serial], None],
    last: list[Any],
    board: ScriptedBoard,
) -> None:
    """The host's clock runs on when the port is opened again."""
    really_open(port)
    if last:
        port._began, port._simulated_s = last[-1]._began, last[-1]._simulated_s
    last.append(port)
    port._drift = board.rate


def install(monkeypatch: pytest.MonkeyPatch) -> ScriptedBoard:
    """Puts a scripted board behind `sim://` and shortens each wait of the session."""
    board = ScriptedBoard()
    monkeypatch.setattr(protocol_sim, "SimulatedBoard", board.switch_on)
    monkeypatch.setattr(protocol_sim.Serial, "open", partialmethod(_open, protocol_sim.Serial.open, [], board))
    for name in ("ASK_INTERVAL_S", "SETTLE_S", "RETRY_INTERVAL_S"):
        monkeypatch.setattr(session_module, name, 0.001)
    return board
