"""A simulated board: speaks the wire protocol as the firmware does, fed by a simulated rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

from linkpose.sensors.devices import DEVICES, Sensors
from linkpose.sensors.rig import Rig
from linkpose.simulation.baro import DATASHEET_WORDS
from linkpose.wire.frames import OtherProtocol, StreamDecoder, encode
from linkpose.wire.messages import (
    PROTOCOL_MAJOR,
    PROTOCOL_MINOR,
    SCHEMA_CRC,
    VERSION,
    Ack,
    Command,
    Configure,
    DeviceFamily,
    DeviceKind,
    DeviceState,
    GetInfo,
    Hello,
    HelloDevice,
    HelloMouse,
    Message,
    Nak,
    NakReason,
    Ping,
    Pong,
    ResetCause,
    ResetMice,
    Sample,
    Sections,
    SelfTest,
    SelfTestResult,
    Start,
    Status,
    StatusDevice,
    StatusMouse,
    Stop,
)

DEFAULTS = Configure(
    sample_rate_hz=100,
    accel_range_g=8,
    gyro_range_deg_s=1000,
    dlpf=3,
    baro_oversampling=1,
    mouse_counts_per_mm=8,
    i2c_khz=400,
)

_ALLOWED = (
    (NakReason.ACCEL_RANGE_OUT_OF_RANGE, "accel_range_g", (2, 4, 8, 16)),
    (NakReason.GYRO_RANGE_OUT_OF_RANGE, "gyro_range_deg_s", (250, 500, 1000, 2000)),
    (NakReason.DLPF_OUT_OF_RANGE, "dlpf", range(7)),
    (NakReason.BARO_OVERSAMPLING_OUT_OF_RANGE, "baro_oversampling", range(4)),
    (NakReason.MOUSE_RESOLUTION_OUT_OF_RANGE, "mouse_counts_per_mm", (1, 2, 4, 8)),
    (NakReason.I2C_CLOCK_OUT_OF_RANGE, "i2c_khz", (100, 400)),
)
_TIMER_HZ = 2_000_000  # the firmware's tick is a whole number of timer counts


class Run(Protocol):
    """What the board measures: a simulated rig that is set in motion by START."""

    @property
    def rig(self) -> Rig: ...
    @property
    def hello_sensors(self) -> Sensors: ...
    @property
    def hello_mice(self) -> tuple[HelloMouse, ...]: ...
    def samples(self) -> Iterator[Sample]: ...


class SimulatedBoard:
    """The firmware's behaviour at the wire. Times are microseconds of the board's own clock since power-on."""

    def __init__(self, make_run: Callable[[Configure], Run]) -> None:
        """`make_run` returns the rig as sensors with these settings measure it."""
        self._make_run = make_run
        self._decoder = StreamDecoder(from_board=False)
        self._settings = DEFAULTS
        self._run = make_run(DEFAULTS)
        self._samples: Iterator[Sample] | None = None
        self._start_us = 0
        self._tick = 0
        self._status_us = 0

    @property
    def rig(self) -> Rig:
        """The rig file that belongs to what is simulated."""
        return self._run.rig

    @property
    def next_tick_us(self) -> int | None:
        """When the next SAMPLE is due; None while none is sent."""
        if self._samples is None:
            return None
        return self._start_us + self._tick * 1_000_000 // self._settings.sample_rate_hz

    def advance(self, now_us: int) -> bytes:
        """Frames of all ticks up to `now_us`."""
        frames = []
        while self._samples is not None and (due := self.next_tick_us) is not None and due <= now_us:
            sample = next(self._samples, None)
            if sample is None:  # the run has an end: the board falls silent
                self._samples = None
                break
            frames.append(encode(sample._replace(seq=self._tick & 0xFFFF, t_us=due & 0xFFFFFFFF)))
            self._tick += 1
            if due - self._status_us >= 1_000_000:
                self._status_us = due
                frames.append(encode(self._status(due)))
        return b"".join(frames)

    def receive(self, data: bytes, now_us: int) -> bytes:
        """The answers to bytes from the host that arrive at `now_us`."""
        answers = [self._answer(message, now_us) for message in self._decoder.feed(data)]
        return b"".join(encode(answer) for group in answers for answer in group)

    def _answer(self, message: Message | OtherProtocol, now_us: int) -> list[Message]:
        match message:
            case GetInfo():
                return [self._hello()]
            case Ping(token):
                return [Pong(token, now_us & 0xFFFFFFFF)]
            case Start():
                if self._samples is None:
                    self._samples, self._tick = self._run.samples(), 0
                    self._start_us = self._status_us = now_us + 1_000_000 // self._settings.sample_rate_hz
                return [Ack(Command.START)]
            case Stop():
                self._samples = None
                return [Ack(Command.STOP)]
            case Configure():
                return [self._configure(message)]
            case SelfTest(device):
                return self._self_test(device)
            case ResetMice(ports):
                no_such_port = Nak(Command.RESET_MICE, NakReason.MOUSE_PORT_OUT_OF_RANGE)
                return [no_such_port if ports >> len(self._run.hello_mice) else Ack(Command.RESET_MICE)]
        return []

    def _hello(self) -> Hello:
        return hello(self._settings, self._samples is not None, self._run.hello_sensors, self._run.hello_mice)

    def _configure(self, settings: Configure) -> Message:
        if self._samples is not None:
            return Nak(Command.CONFIGURE, NakReason.STREAMING)
        if not 50 <= settings.sample_rate_hz <= 500 or _TIMER_HZ % settings.sample_rate_hz:
            return Nak(Command.CONFIGURE, NakReason.SAMPLE_RATE_OUT_OF_RANGE)
        for reason, name, allowed in _ALLOWED:
            if getattr(settings, name) not in allowed:
                return Nak(Command.CONFIGURE, reason)
        self._settings = settings
        self._run = self._make_run(settings)
        return Ack(Command.CONFIGURE)

    def _status(self, now_us: int) -> Status:
        """A board whose every counter is 0: a simulated one has no bus, no stack and no load."""
        zero = dict.fromkeys(Status._fields, 0)
        mice = tuple(StatusMouse(0, 0, 0, 0) for _ in self._run.hello_mice)
        devices = tuple(StatusDevice(0, 0, 0, 0, 0) for _ in DEVICES)
        known = {"t_us": now_us & 0xFFFFFFFF, "ticks": self._tick, "devices": devices, "mice": mice}
        return Status(**(zero | known))  # type: ignore[arg-type]

    def _self_test(self, device: int) -> list[Message]:
        """A sound sensor at rest: each axis answers the self-test with just its factory trim (register map, 4.1)."""
        if self._samples is not None:
            return [Nak(Command.SELF_TEST, NakReason.STREAMING)]
        if device > 1 or not self._run.hello_sensors & DEVICES[device]:
            return [Nak(Command.SELF_TEST, NakReason.SENSOR_ABSENT)]
        code = 16
        gyro, accel = round(25 * 131 * 1.046 ** (code - 1)), round(4096 * 0.34 * (0.92 / 0.34) ** ((code - 1) / 30))
        packed = code | (code >> 2 & 7) << 5  # low bits of the gyro's code, high bits of the accelerometer's
        trims = (packed, packed, packed, (code & 3) * 0b010101, 0, 0)
        plain = (0, 0, 4096, 0, 0, 0)
        excited = (accel, accel, 4096 + accel, gyro, -gyro, gyro)
        return [Ack(Command.SELF_TEST), SelfTestResult(device, DeviceFamily.MPU6050, *trims, *plain, *excited)]


def hello(
    settings: Configure,
    streaming: bool = False,
    sensors: Sensors = Sensors.MPU6050 | Sensors.BMP180,
    mice: tuple[HelloMouse, ...] = (),
) -> Hello:
    """The HELLO of a simulated board with these settings."""
    major, minor, patch = map(int, VERSION.split("."))
    return Hello(
        protocol_major=PROTOCOL_MAJOR,
        protocol_minor=PROTOCOL_MINOR,
        schema_crc=SCHEMA_CRC,
        firmware_major=major,
        firmware_minor=minor,
        firmware_patch=patch,
        source_revision=0,
        reset_cause=int(ResetCause.POWER_ON),
        hung_at=0xFFFF,
        streaming=int(streaming),
        sections=_sections(sensors, len(mice)),
        **settings._asdict(),
        devices=tuple(device if sensors & bit else device._replace(**_ABSENT) for bit, device in _DEVICES),
        baro_words=DATASHEET_WORDS.words() if sensors & Sensors.BMP180 else (0,) * 12,
        mice=mice,
    )


_ABSENT = {"id": 0, "family": DeviceFamily.NONE, "state": DeviceState.ABSENT}
_DEVICES = (
    (Sensors.MPU6050, HelloDevice(DeviceKind.IMU, 0x68, 0x68, DeviceFamily.MPU6050, DeviceState.OK)),
    (Sensors.IMU2, HelloDevice(DeviceKind.IMU, 0x69, 0x68, DeviceFamily.MPU6050, DeviceState.OK)),
    (Sensors.BMP180, HelloDevice(DeviceKind.BAROMETER, 0x77, 0x55, DeviceFamily.BMP180, DeviceState.OK)),
    (Sensors.MAG, HelloDevice(DeviceKind.MAGNETOMETER, 0x0D, 0xFF, DeviceFamily.QMC5883L, DeviceState.OK)),
)


def _sections(sensors: Sensors, mice: int) -> int:
    """HELLO's field `sections`."""
    bits = zip(DEVICES, (Sections.IMU, Sections.IMU2, Sections.BARO, Sections.MAG), strict=True)
    return sum(section for sensor, section in bits if sensors & sensor) | mice << 4
