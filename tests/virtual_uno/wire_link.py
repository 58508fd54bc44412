"""The host's side of the wire for tests: messages to and from an emulated board, in its own time."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from linkpose.wire.frames import StreamDecoder, encode
from linkpose.wire.messages import Ack, Command, Hello, Message, Nak, Sample, Start, Status
from virtual_uno import CLOCK_HZ, VirtualUno

M = TypeVar("M")

WATCHED_BUS = ("i2c_start", "i2c_address", "i2c_write", "i2c_stop")


class WireLink:
    """A board and the messages that came from it, each kept once with the time at which its frame was complete."""

    def __init__(self, uno: VirtualUno) -> None:
        self.uno = uno
        self.decoder = StreamDecoder()
        self.messages: list[Any] = []

    def run_ms(self, milliseconds: float) -> None:
        self.uno.run_ms(milliseconds)
        self.messages += self.decoder.feed(self.uno.take_received())

    def of(self, kind: type[M]) -> list[M]:
        return [message for message in self.messages if isinstance(message, kind)]

    def forget(self) -> None:
        self.messages.clear()

    def send(self, message: Message) -> None:
        self.uno.send(encode(message))

    def expect(self, kind: type[M], limit_ms: float) -> M:
        """The next message of a kind, with those before it dropped. Fails the test when none comes in time."""
        waited = 0.0
        while True:
            for index, message in enumerate(self.messages):
                if isinstance(message, kind):
                    del self.messages[: index + 1]
                    return message
            assert waited < limit_ms, f"no {kind.__name__} within {limit_ms} ms; came: {self.messages[-5:]}"
            self.run_ms(1.0)
            waited += 1.0

    def command(self, message: Message, limit_ms: float = 50.0) -> Ack | Nak:
        """Sends a command and gives its answer."""
        self.send(message)
        return self.expect((Ack, Nak), limit_ms)  # type: ignore[arg-type]

    def carry_out(self, message: Message) -> None:
        answer = self.command(message)
        expected = Ack(Command[_upper_case(type(message).__name__)])
        assert answer == expected, f"{message} got {answer}"

    def boot(self) -> Hello:
        return self.expect(Hello, 1500)

    def start(self, settle_ms: float = 300.0) -> Hello:
        """Boots, lets the sensors come up, and starts the stream with nothing kept."""
        hello = self.boot()
        self.run_ms(settle_ms)
        self.carry_out(Start())
        self.forget()
        return hello

    @property
    def samples(self) -> list[Sample]:
        return self.of(Sample)

    @property
    def status(self) -> Status:
        return self.of(Status)[-1]


def _upper_case(name: str) -> str:
    return "".join("_" + letter if letter.isupper() else letter for letter in name).strip("_").upper()


def burst_starts(events: NDArray[Any], address: int = 0x68) -> NDArray[np.float64]:
    """Cycles of the START conditions that begin an inertial sensor's burst, from events of WATCHED_BUS."""
    acknowledged = 0x100
    kinds, values = events["kind"], events["value"]
    begins = (kinds[:-2] == "i2c_start") & (kinds[1:-1] == "i2c_address") & (kinds[2:] == "i2c_write")
    begins &= (values[1:-1] == acknowledged | address << 1) & (values[2:] == acknowledged | 0x3B)
    return np.asarray(events["cycle"][:-2][begins], dtype=np.float64)


def us(cycles: Any) -> Any:
    return np.asarray(cycles) * 1e6 / CLOCK_HZ
