"""A session with the board: handshake, settings, streaming, and coming back after a reset or a pulled cable."""

from __future__ import annotations

import contextlib
import itertools
import math
import random
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NamedTuple, TypeVar

from linkpose.device.answers import other_protocol, other_schema, refusal_reason, reset_causes, why_no_hello
from linkpose.device.clock import WRAP_US, DeviceClock
from linkpose.device.connection import Arrival, Connection, Disconnected
from linkpose.device.ports import find_again, is_network, usb_identity
from linkpose.errors import BoardError, LinkposeError, NoFirmware, PortNotFound, WrongFirmware
from linkpose.sensors.conversion import BoardSettings, Placed
from linkpose.sensors.devices import Sensors, check_hello, found, mouse_remarks
from linkpose.sensors.rig import Rig
from linkpose.sensors.timeline import Gap, Timeline
from linkpose.wire.frames import Corrupt, OtherProtocol
from linkpose.wire.messages import (
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
    SCHEMA_CRC,
    Ack,
    Command,
    Configure,
    DeviceState,
    GetInfo,
    Hello,
    Message,
    Nak,
    Ping,
    Pong,
    Sample,
    SelfTest,
    SelfTestResult,
    Start,
    Status,
    Stop,
)

HANDSHAKE_TIMEOUT_S = 4.0  # a bootloader waits for up to two seconds before it starts the firmware
ASK_INTERVAL_S = 0.4
ANSWER_TIMEOUT_S = 1.0
ATTEMPTS = 3  # at a command whose answer does not come
SELF_TEST_TIMEOUT_S = 3.0
MICE_TIMEOUT_S = 3.0  # self-test up to 1.5 s, set-up of a slow mouse 0.6 s
LOW_SUPPLY_MV = 4500  # below it an ATmega328P at 16 MHz is out of its specification, and 5 V mice are too
SENSORS_TIMEOUT_S = 1.0  # the slowest sensor is set up 0.3 s after the firmware starts
SETTLE_S = 0.15  # for the sensors to be set up again and their filters to settle
FIRST_PINGS = 5
PING_INTERVAL_S = 1.0
SILENCE_S = 1.5  # of a board that should be streaming
LATE_S = 0.5  # after the end of the duration, a sample may still be on its way
RECEIVE_TIMEOUT_S = 0.1
MOST_UNREAD_BYTES = 100  # a silent line may give a few when the board is reset
RETRY_INTERVAL_S = 0.25
WAIT_STEP_S = 0.05
OWN_TOKENS = 1000  # a PONG to one of this many latest PINGs is a late answer to this program

Answer = TypeVar("Answer", bound="Message")
Notify = Callable[[str], None]


class _TimeLimit:
    """A time to wait. The time for which the program is suspended counts as one step at most."""

    def __init__(self, seconds: float) -> None:
        self._left_s = seconds
        self._looked_s = time.perf_counter()

    def step(self) -> float:
        """How long to wait next (s); 0 when the time is over."""
        now = time.perf_counter()
        self._left_s -= min(now - self._looked_s, WAIT_STEP_S)
        self._looked_s = now
        return min(max(self._left_s, 0.0), WAIT_STEP_S)


class NotResumed(Disconnected):
    """A board that was reset and could not be started again at once."""


class AnotherBoard(BoardError):
    """A different board than at the start of the recording answers at the port."""


class Placement(NamedTuple):
    """A sample and its place in time."""

    sample: Sample
    place: Placed


@dataclass(slots=True)
class Health:
    """Health of the connection so far."""

    samples: int
    lost: int
    corrupt: Corrupt
    gaps: list[Gap]
    duration_s: float
    rate_hz: float
    drift_ppm: float | None
    drift_std_ppm: float | None
    status: Status | None  # the board's own counters, as it last sent them
    sensors: dict[str, dict[str, Any]] = field(default_factory=dict)  # state and counts, by sensor (sensors.health)
    silent_s: float = 0.0  # waited for a sample since the last one; a busy computer's own delays do not count


class Session:
    """A session with one board. As a context manager it stops the stream and closes the port on exit.

    `notify` receives a line for the user for each event that is not a failure (cable unplugged, board back).
    """

    def __init__(self, port: str, notify: Notify, capture: BinaryIO | None = None) -> None:
        self.port = port
        self.notify = notify
        self._capture = capture
        self._connection = Connection(port, capture)
        self._usb = usb_identity(port)
        self._clock = DeviceClock()
        self.timeline = Timeline(1.0)
        self._pings: dict[int, float] = {}
        self._token = random.getrandbits(32)  # another program's differ
        self._other_program_reported = self._foreign_start_reported = False
        self.status: Status | None = None  # the board's own counters, as it last sent them
        self._supply_reported = False
        self._unhandled: Arrival | None = None  # what came together with an answer and has not been handled
        self._pinged_at = 0.0  # s, perf_counter
        self._unread_bytes = 0  # since the last sample, that belong to no message
        self._arrived_s = math.nan  # s, the connection's clock: of the last sample, or of the stream's begin
        self._repeats = 0  # samples since the last one with a new number
        self._clock_faults: set[str] = set()  # reported
        self._silent_s = 0.0  # waited for a sample since the last one, or since the stream was started (again)
        self._asked_s = 0.0  # of that, up to the last GET_INFO
        self._silent_before_s = 0.0  # waited since the last sample before the stream was started again
        self._corrupt_before = Corrupt()
        try:
            self.hello = self._first_hello = self._handshake()
            self._wanted = _configured(self.hello)  # the settings that values are scaled by, after a reset too
        except BaseException:
            self._connection.close()
            raise

    @property
    def rig(self) -> Rig | None:
        """The rig that a simulated board brings along; None of a real one."""
        return self._connection.rig

    @property
    def settings(self) -> Configure:
        """The settings in force."""
        return _configured(self.hello)

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(Disconnected):
            self._connection.send(Stop())
        self._connection.close()

    # ---- handshake ----

    def _handshake(self) -> Hello:
        """Sends GET_INFO until HELLO arrives; a board that is still streaming for a killed host is stopped first."""
        connection = self._connection
        received, refused = bytearray(), 0
        limit, ask_at = _TimeLimit(HANDSHAKE_TIMEOUT_S), 0.0
        while step_s := limit.step():
            if time.perf_counter() >= ask_at:
                connection.send(Stop())
                connection.send(GetInfo())
                ask_at = time.perf_counter() + ASK_INTERVAL_S
            arrival = connection.receive(step_s)
            if arrival is None:
                continue
            received += arrival.data[: 512 - len(received)]
            for message in arrival.messages:
                if isinstance(message, OtherProtocol):
                    raise other_protocol(message)
                refused += isinstance(message, Nak)
                if isinstance(message, Hello) and message.streaming != 1:
                    self._check_versions(message)
                    message = self._wait_for_sensors(message)
                    connection.decoder.corrupt = Corrupt()  # earlier bytes are not part of the session
                    return message
        reason = why_no_hello(bytes(received), connection.decoder)
        if refused:
            reason = "the board refuses every command, also the request for its version; its firmware is damaged"
        raise NoFirmware(self.port, bytes(received), reason)

    def _wait_for_sensors(self, hello: Hello) -> Hello:
        """Waits for sensors that are being set up and returns the latest HELLO."""
        for _ in range(math.ceil(SENSORS_TIMEOUT_S / SETTLE_S)):  # not by the clock: a suspended program has not asked
            if all(device.state != DeviceState.STARTING for device in hello.devices):
                break
            time.sleep(SETTLE_S)
            hello = self._ask_hello()
        return hello

    def _check_versions(self, hello: Hello) -> None:
        """Raises WrongFirmware when the two sides are incompatible, and notifies of a harmless difference."""
        if hello.schema_crc != SCHEMA_CRC and hello.protocol_minor == PROTOCOL_MINOR:
            raise other_schema(hello)
        if hello.protocol_minor != PROTOCOL_MINOR:
            older = "firmware" if hello.protocol_minor < PROTOCOL_MINOR else "linkpose"
            self.notify(
                f"the board uses protocol {hello.protocol_major}.{hello.protocol_minor}, this linkpose "
                f"{PROTOCOL_MAJOR}.{PROTOCOL_MINOR}; they are compatible, but the {older} should be updated"
            )
        check_hello(hello)

    # ---- commands ----

    def configure(self, settings: Configure) -> Hello:
        """Puts settings in force and returns the HELLO that shows them.

        Raises LinkposeError if the board refuses them, or does not keep them because it is reset again and again.
        """
        for _ in range(ATTEMPTS):
            self._command(settings, Command.CONFIGURE)
            time.sleep(SETTLE_S)
            self.hello = self._ask_hello()
            if _configured(self.hello) == settings:
                self._wanted = settings
                return self.hello
        raise LinkposeError("the board loses its settings: it is reset again and again; check its supply and its cable")

    def wait_for_mice(self, count: int) -> None:
        """Wait until no mouse is being set up and `count` ports have mice, for at most MICE_TIMEOUT_S.

        Notifies of the wait, and of each command that a mouse refused during its set-up.
        """
        for attempt in range(math.ceil(MICE_TIMEOUT_S / ASK_INTERVAL_S)):  # as for the sensors
            if not self._mice_missing(count):
                break
            if attempt == 0:
                self.notify("Waiting for the mice, which are being set up or have not been found yet")
            time.sleep(ASK_INTERVAL_S)
            self.hello = self._ask_hello()
        for remark in mouse_remarks(self.hello):
            self.notify(remark)

    def _mice_missing(self, count: int) -> bool:
        starting = any(mouse.state == DeviceState.STARTING for mouse in self.hello.mice)
        return starting or BoardSettings.of(self.hello).mouse_ports < count

    def self_test(self, device: int = 0) -> SelfTestResult:
        """Runs the self-test of inertial sensor 0 (0x68) or 1 (0x69). Raises LinkposeError if the board refuses."""
        with_ack = self._command(SelfTest(device), Command.SELF_TEST)
        result = _first(SelfTestResult, itertools.chain(with_ack.messages, self._messages(SELF_TEST_TIMEOUT_S)))
        if result is None:
            raise _no_answer("SELF_TEST")
        return result

    def _command(self, message: Message, command: Command) -> Arrival:
        """Sends a command, and repeats it if the answer is lost. Returns what arrived after the ACK.

        A SAMPLE also confirms START. Raises LinkposeError on a NAK, and if no answer arrives.
        """
        for _ in range(ATTEMPTS):
            self._connection.send(message)
            for arrival in self._arrivals(ANSWER_TIMEOUT_S):
                for at, answer in enumerate(arrival.messages):
                    if isinstance(answer, Nak) and answer.command == command:
                        raise LinkposeError(f"the board refused {command.name}: {refusal_reason(answer.reason)}")
                    if isinstance(answer, Ack) and answer.command == command:
                        return Arrival(arrival.time_s, arrival.messages[at + 1 :], b"")
                    if isinstance(answer, Sample) and command == Command.START:
                        return Arrival(arrival.time_s, arrival.messages[at:], b"")
        raise _no_answer(command.name)

    def _ask_hello(self) -> Hello:
        """The HELLO that answers GET_INFO, which is sent again where the answer is lost."""
        for _ in range(ATTEMPTS):
            self._connection.send(GetInfo())
            hello = _first(Hello, self._messages(ANSWER_TIMEOUT_S))
            if hello is not None:
                return hello
        raise _no_answer("GET_INFO")

    def _messages(self, timeout_s: float) -> Iterator[Message | OtherProtocol]:
        """The messages that arrive within a time."""
        return itertools.chain.from_iterable(arrival.messages for arrival in self._arrivals(timeout_s))

    def _arrivals(self, timeout_s: float) -> Iterator[Arrival]:
        """What arrives within a time."""
        limit = _TimeLimit(timeout_s)
        while step_s := limit.step():
            arrival = self._connection.receive(step_s)
            if arrival is not None:
                yield arrival

    # ---- the clock ----

    def _ping(self) -> None:
        self._token = (self._token + 1) % (1 << 32)
        self._pings = {self._token: self._connection.send(Ping(self._token))}

    def _handle_pong(self, pong: Pong, time_s: float) -> None:
        sent = self._pings.pop(pong.token, None)
        if sent is not None:
            t_us = (pong.t_us + self.timeline.stamps.shift_us) % WRAP_US
            if self.timeline.stamps.is_trusted:
                self._clock.pong(t_us, sent, time_s)
        elif (self._token - pong.token) % (1 << 32) >= OWN_TOKENS:
            self._report_other_program()

    def _report_other_program(self) -> None:
        """Reports an answer to another program's command: a port such as socket:// serves several programs."""
        if not self._other_program_reported:
            self._other_program_reported = True
            self.notify(
                f"another program also sends commands to the board at {self.port}; close it, or the data will have gaps"
            )

    def _synchronise_clocks(self) -> None:
        """A few round trips before the first sample."""
        for _ in range(FIRST_PINGS):
            self._ping()
            for arrival in self._arrivals(ANSWER_TIMEOUT_S):
                for message in arrival.messages:
                    if isinstance(message, Pong):
                        self._handle_pong(message, arrival.time_s)
                if not self._pings:
                    break
        if not self._clock.ready:
            raise LinkposeError(f"{self.port}: the board does not answer PING; unplug it, plug it in and try again")

    # ---- streaming ----

    def stream(self, duration_s: float | None = None) -> Generator[list[Placement], None, None]:
        """Samples as they arrive, in lists of those that arrived together, for `duration_s` of the board's time.

        A list may be empty: the caller gets its turn several times a second even when nothing arrives. After a reset or
        an unplugged cable the stream waits for the board and continues in the same timeline, with the gap marked. It
        ends with the duration in any case.
        """
        timeline = self.timeline = Timeline(self.hello.sample_rate_hz, duration_s or math.inf)
        self._begin()
        self._arrived_s = self._connection.now()
        try:
            yield from self._samples(timeline)
        finally:
            self._end(timeline)
        if not timeline.samples:
            raise BoardError("the board accepted START, but no sample arrived; check the cable, and reset the board")

    def _samples(self, timeline: Timeline) -> Iterator[list[Placement]]:
        """The samples up to the timeline's end, over resets and pulled cables."""
        while not timeline.is_over:
            try:
                placements = self._next(timeline)
            except Disconnected as error:
                reset = isinstance(error, NotResumed)
                event = f"{error.reason}" if reset else f"{self.port} disappeared ({error.reason})"
                shared = "; if another program uses it, close that one" if is_network(self.port) else ""
                self.notify(f"{event}{shared}; waiting for the board, Ctrl-C ends")
                timeline.interrupted("reset" if reset else "cable")
                yield []
                yield from self._reconnect(timeline)
                continue
            yield placements
            if self._silent_s > LATE_S:
                self._end_when_due(timeline)

    def _end(self, timeline: Timeline) -> None:
        """Count what is missing at the end of the run, also where the user or a failure ended it in a silence."""
        if self._silent_s > LATE_S or timeline.is_interrupted:
            timeline.end_at(timeline.duration_s + self._connection.now() - self._arrived_s)
        if timeline.samples and timeline.missing_at_end:
            self.notify(
                f"no sample came in the last {timeline.end_gap_s:.2f} s of the run: {timeline.missing_at_end} samples "
                "are counted as lost"
            )

    def _end_when_due(self, timeline: Timeline) -> None:
        """End the timeline when the duration has passed without a sample that would have ended it.

        What has passed is counted from the last sample's arrival: a board whose samples come late goes on to the end.
        """
        timeline.end_if_past(timeline.duration_s + self._connection.now() - self._arrived_s - LATE_S)

    def _begin(self) -> None:
        """Synchronises the clocks again and starts the stream."""
        wanted = self._wanted
        for _ in range(ATTEMPTS):
            self._clock = DeviceClock()
            self._synchronise_clocks()
            self._unhandled = self._start(wanted)
            if self._unhandled is not None:
                break
            self._connection.send(Stop())
            self.configure(wanted)
        else:
            raise LinkposeError("the board is reset again and again before it streams; check its supply and its cable")
        self._pinged_at = time.perf_counter()
        self._silent_before_s += self._silent_s
        self._silent_s = self._asked_s = 0.0
        self._unread_bytes = 0

    def _start(self, wanted: Configure) -> Arrival | None:
        """Starts the stream and checks that the board streams with the settings that its values are scaled by.

        Returns what arrived behind the ACK; None if the board was reset on the way and has lost its settings.
        """
        started = self._command(Start(), Command.START)
        self._connection.send(GetInfo())
        messages, arrived_s = list(started.messages), started.time_s
        for arrival in itertools.chain([started], self._arrivals(ANSWER_TIMEOUT_S)):
            if arrival is not started:
                messages += arrival.messages
                arrived_s = arrival.time_s
            hellos = [message for message in arrival.messages if isinstance(message, Hello)]
            for hello in hellos:
                self._check_identity(hello)
            if hellos:
                sound = all(hello.streaming and _configured(hello) == wanted for hello in hellos)
                rest: list[Message | OtherProtocol] = [
                    message for message in messages if not isinstance(message, Hello)
                ]
                return Arrival(arrived_s, rest, b"") if sound else None
        return None

    def _next(self, timeline: Timeline) -> list[Placement]:
        looked_s = time.perf_counter()
        arrival, self._unhandled = self._unhandled or self._connection.receive(RECEIVE_TIMEOUT_S), None
        now = time.perf_counter()
        if now - self._pinged_at >= PING_INTERVAL_S:
            self._pinged_at = now
            self._ping()
        self._silent_s += min(now - looked_s, RECEIVE_TIMEOUT_S)  # no more: a suspended program has not waited
        if arrival is not None and not arrival.messages:
            self._unread_bytes += len(arrival.data)
        placements: list[Placement] = []
        for at, message in enumerate(arrival.messages if arrival else ()):
            assert arrival is not None
            is_event = not timeline.follows(message) if isinstance(message, Sample) else _may_end(message)
            if placements and is_event:  # it may end the connection, and the samples before it must not be lost then
                self._unhandled = Arrival(arrival.time_s, arrival.messages[at:], b"")
                break
            if isinstance(message, Sample) and not is_event:
                placements += self._place(message, arrival.time_s, timeline)
            elif self._handle(message, arrival, timeline):
                break
        if not placements:
            self._ask_when_silent()
        return placements

    def _place(self, sample: Sample, arrived_s: float, timeline: Timeline) -> list[Placement]:
        """The sample and its place; nothing if it came before, or comes after the end."""
        place = timeline.place(sample, self._clock, arrived_s)
        self._report_clock_fault(timeline)
        self._repeats = 0 if place else self._repeats + 1
        self._report_repeats(timeline)
        if place is None:
            return []
        self._silent_s = self._asked_s = self._silent_before_s = 0.0
        self._unread_bytes = 0
        self._arrived_s = arrived_s
        return [Placement(sample, place)]

    def _check_supply(self, status: Status) -> None:
        if not 0 < status.vcc_mv < LOW_SUPPLY_MV or self._supply_reported:
            return
        self._supply_reported = True
        self.notify(
            f"The supply of the board is {status.vcc_mv / 1000:.1f} V (±10 %), below 4.5 V: mice or sensors may fail. "
            "Use a shorter USB cable or another port, or supply the mice separately"
        )

    def _report_clock_fault(self, timeline: Timeline) -> None:
        """Report a board clock that jumps, stands still or runs at a wrong rate against its own ticks, once each."""
        fault = timeline.stamps.fault
        if fault and fault.split()[0] not in self._clock_faults:
            self._clock_faults.add(fault.split()[0])
            self.notify(
                f"{timeline.duration_s:.2f} s: the board's clock {fault}; its count of ticks gives the times from here "
                "on. Replace the board if it happens again"
            )

    def _report_repeats(self, timeline: Timeline) -> None:
        """Report a board that sends the number of one sample again and again: only the first is part of the stream."""
        if self._repeats == round(SILENCE_S * self.hello.sample_rate_hz) and not timeline.is_over:
            self.notify(
                f"{timeline.duration_s:.2f} s: {self._repeats} samples came with numbers that came before, and are "
                "left out; reset the board, and replace it if it happens again"
            )

    def _ask_when_silent(self) -> None:
        """Send GET_INFO to a silent board: it may have been reset and its HELLO lost."""
        if self._silent_s - self._asked_s > SILENCE_S:
            if self._asked_s == 0.0 and not self._repeats:
                noise = f", only {self._unread_bytes} bytes of noise" if self._unread_bytes > MOST_UNREAD_BYTES else ""
                self.notify(f"no sample for {SILENCE_S:g} s{noise}; asking the board")
            self._asked_s = self._silent_s
            self._connection.send(GetInfo())

    def _handle(self, message: Message | OtherProtocol, arrival: Arrival, timeline: Timeline) -> bool:
        """Act on a message other than a sample. True if the board was reset and has been started again: what arrived
        together with its HELLO is older than that."""
        if isinstance(message, Pong):
            self._handle_pong(message, arrival.time_s)
        elif isinstance(message, Ack | Nak) and message.command in (Command.STOP, Command.CONFIGURE):
            self._report_other_program()  # the board answers in order: START was the last command of this program
        elif isinstance(message, Status):
            self.status = message
            self._check_supply(message)
        elif isinstance(message, OtherProtocol):
            raise other_protocol(message)
        elif isinstance(message, Hello) and not message.streaming:
            self._check_versions(message)
            self.notify(f"the board was reset ({reset_causes(message)}); going on, the gap is marked")
            self._go_on(timeline, lambda: self._resume(message))
            return True
        elif isinstance(message, Sample) or (isinstance(message, Hello) and _configured(message) != self._wanted):
            self._report_foreign_start()
            self._go_on(timeline, self._begin)
            return True
        return False

    def _report_foreign_start(self) -> None:
        """Report a stream that this program has not started, once: its settings may be others."""
        if not self._foreign_start_reported:
            self._foreign_start_reported = True
            self.notify(
                f"the stream at {self.port} does not go on from its last sample: the board was started again, or is "
                "another one; its settings are checked, the gap is marked"
            )

    def _go_on(self, timeline: Timeline, resume: Callable[[], None]) -> None:
        """Mark the gap and continue. Raises NotResumed where that fails: the board is then waited for."""
        timeline.interrupted("reset")
        try:
            resume()
        except (WrongFirmware, AnotherBoard, Disconnected):
            raise
        except LinkposeError as error:  # reset again, or answers were lost: wait for it as after a pulled cable
            raise NotResumed(self.port, error) from error

    def _resume(self, hello: Hello) -> None:
        """Restores the settings and continues streaming."""
        self._check_identity(hello)
        self.hello = hello
        if self._first_hello.source_revision != hello.source_revision:
            self.notify(
                f"the board's firmware is another one now: source revision {hello.source_revision:08x} instead of "
                f"{self._first_hello.source_revision:08x}"
            )
        if _configured(hello) != self._wanted:
            self.configure(self._wanted)
        self._begin()

    def _check_identity(self, hello: Hello) -> None:
        """Raises AnotherBoard if this HELLO is not of the board that the session began with."""
        before = self._first_hello
        if before.baro_words != hello.baro_words and found(before) & found(hello) & Sensors.BMP180:
            raise AnotherBoard(f"another board answers at {self.port} now; record it into a file of its own")
        for old, new in zip(before.devices, hello.devices, strict=True):
            if old.id and new.id and (old.address, old.id) != (new.address, new.id):
                raise AnotherBoard(
                    f"another board answers at {self.port} now (a sensor has the id {new.id:#04x} instead of "
                    f"{old.id:#04x}); record it into a file of its own"
                )

    def _reconnect(self, timeline: Timeline) -> Iterator[list[Placement]]:
        """Wait until the board can be opened again and streams, or the duration is over; yields while it waits.

        Raises WrongFirmware or AnotherBoard for a board with which the recording cannot continue.
        """
        self._connection.close()
        for part, count in self._connection.decoder.corrupt.as_dict().items():
            setattr(self._corrupt_before, part, getattr(self._corrupt_before, part) + count)
        obstacles: set[str] = set()
        while not timeline.is_over:
            looked_s = time.perf_counter()
            time.sleep(RETRY_INTERVAL_S)
            yield []
            self._end_when_due(timeline)
            obstacle = self._open_again()
            self._silent_before_s += time.perf_counter() - looked_s
            if obstacle is None:
                return
            if obstacle and obstacle not in obstacles:
                obstacles.add(obstacle)
                self.notify(f"{obstacle}; still waiting")

    def _open_again(self) -> str | None:
        """Continue with the board that has returned. None: done; otherwise the obstacle, "" while it is absent."""
        port = find_again(self.port, self._usb)
        if port is None:
            return ""
        try:
            self._connection = Connection(port, self._capture)
        except PortNotFound:
            return ""
        except LinkposeError as error:
            return str(error)
        self.port = port
        try:
            self._resume(self._handshake())
        except (WrongFirmware, AnotherBoard):
            raise
        except Disconnected:
            self._connection.close()
            return ""
        except LinkposeError as error:
            self._connection.close()
            return str(error)
        self._usb = usb_identity(port)
        self.notify(f"the board is back at {port}; continuing, the gap is marked")
        return None

    # ---- health ----

    def health(self) -> Health:
        """Counts so far."""
        timeline = self.timeline
        now, before = self._connection.decoder.corrupt.as_dict(), self._corrupt_before.as_dict()
        duration = timeline.duration_s
        return Health(
            samples=timeline.samples,
            lost=timeline.lost,
            corrupt=Corrupt(**{cause: now[cause] + before[cause] for cause in now}),
            gaps=timeline.gaps,
            duration_s=duration,
            rate_hz=timeline.samples / duration if duration else 0.0,
            drift_ppm=self._clock.drift_ppm if self._clock.ready else None,
            drift_std_ppm=self._clock.drift_std_ppm if self._clock.ready else None,
            status=self.status,
            silent_s=self._silent_before_s + self._silent_s,
        )


def summary(health: Health) -> dict[str, Any]:
    """The closing summary of a session, as `record --json` prints it."""
    return {
        "event": "summary",
        "samples": health.samples,
        "lost": health.lost,
        "corrupt": health.corrupt.total,
        "gaps": len(health.gaps),
        "duration_s": round(health.duration_s, 6),
        "rate_hz": round(health.rate_hz, 3),
        "sensors": health.sensors,
    }


def _configured(hello: Hello) -> Configure:
    """The CONFIGURE that puts the settings of a HELLO in force."""
    return Configure(*(getattr(hello, name) for name in Configure._fields))


def _first(kind: type[Answer], messages: Iterable[Message | OtherProtocol]) -> Answer | None:
    """The first message of a kind."""
    return next((message for message in messages if isinstance(message, kind)), None)


def _may_end(message: Message | OtherProtocol) -> bool:
    """Whether a message may end the connection or restart the stream."""
    return isinstance(message, Hello | OtherProtocol)


def _no_answer(command: str) -> LinkposeError:
    return LinkposeError(f"the board did not answer {command}; unplug it, plug it in and try again")
