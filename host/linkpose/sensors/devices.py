"""The sensors on a board as HELLO describes them: which there are, what their ids mean, whether HELLO is possible."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from enum import IntFlag
from typing import NamedTuple

from linkpose.errors import LinkposeError
from linkpose.wire.messages import (
    DeviceFamily,
    DeviceKind,
    DeviceState,
    Hello,
    HelloDevice,
    HelloMouse,
    MouseLacks,
    SampleFlags,
)

LEGAL_RATES_HZ = tuple(rate for rate in range(50, 501) if 2_000_000 % rate == 0)  # a tick is a whole number of 0.5 µs


class Sensors(IntFlag):
    """Sensors that a board, a recording or a filter has or needs."""

    MPU6050 = 0x1  # any inertial sensor at 0x68
    BMP180 = 0x2  # any barometer
    IMU2 = 0x4  # an inertial sensor at 0x69
    MAG = 0x8


# Order of HELLO's and STATUS's devices.
DEVICES = (Sensors.MPU6050, Sensors.IMU2, Sensors.BMP180, Sensors.MAG)
DEVICE_NAMES = ("imu", "imu2", "baro", "mag")  # of the same devices, in reports of health
# The flag of each mouse port, port 1 first. Their number is the largest number of mice that the protocol carries.
MOUSE_VALID = tuple(int(flag) for flag in SampleFlags if re.fullmatch(r"MOUSE\d_VALID", flag.name or ""))
MAX_MICE = len(MOUSE_VALID)
# A sensor that failed answered once: its readings may be valid again at any moment.
_USABLE = (DeviceState.STARTING, DeviceState.OK, DeviceState.UNVERIFIED, DeviceState.FAILED)

# Identification registers of supported chips.
_IMUS = {
    0x68: "MPU-6050",
    0x70: "MPU-6500",
    0x71: "MPU-9250",
    0x73: "MPU-9255",
    0x74: "MPU-6515",
    0x75: "MPU-6500 (id 0x75)",
    0x78: "MPU-6880",
    0x11: "ICM-20600",
    0x12: "ICM-20602",
    0x19: "MPU-6886",
    0x98: "ICM-20689",
    0xA6: "ICM-20609",
    0xA9: "IAM-20680",
    0xAE: "ICM-20608-D",
    0xAF: "ICM-20608-G",
}
_BAROMETERS = {
    0x55: "BMP180 or BMP085",
    0x56: "BMP280 (sample)",
    0x57: "BMP280 (sample)",
    0x58: "BMP280",
    0x60: "BME280",
}
_MAGNETOMETERS = {
    DeviceFamily.HMC5883L: "HMC5883L",
    DeviceFamily.QMC5883L: "QMC5883L",
    DeviceFamily.QMC5883P: "QMC5883P",
}


def found(hello: Hello) -> Sensors:
    """The sensors that can be used or are being set up."""
    usable = Sensors(0)
    for sensor, device in zip(DEVICES, hello.devices, strict=True):
        if device.state in _USABLE:
            usable |= sensor
    return usable


def names(hello: Hello) -> list[str]:
    """Short names of the sensors found, as in a recording's metadata: "mpu6050", "imu2", "bmp180", "mag"."""
    return [sensor.name.lower() for sensor in Sensors if sensor & found(hello) and sensor.name]


def source_revision(hello: Hello) -> str | None:
    """The CRC-32 of the firmware's sources, as eight hexadecimal digits; None of a simulated board, which has none."""
    return f"{hello.source_revision:08x}" if hello.source_revision else None


class Description(NamedTuple):
    """One device in words."""

    chip: str  # what it is
    state: str  # "ok", "being set up", ...
    remark: str  # what the state means for the user; "" if no remark is needed


_STATES = {
    DeviceState.ABSENT: "absent",
    DeviceState.STARTING: "being set up",
    DeviceState.OK: "ok",
    DeviceState.UNVERIFIED: "unverified",
    DeviceState.FAILED: "failed",
    DeviceState.UNSUPPORTED: "unsupported",
}


def describe(device: HelloDevice) -> Description:
    """What a device of HELLO is and what its state means for the user."""
    chip, state = _chip(device), _STATES.get(DeviceState(device.state), "")
    remark = ""
    if device.state == DeviceState.FAILED:
        remark = "It stopped answering or its readings are invalid: check its wiring and supply."
    elif device.state == DeviceState.UNVERIFIED:
        remark = (
            f"Its id {device.id:#04x} is unknown. It accepted the settings and runs with the MPU-6050's scales, which "
            "are assumed; its temperature is not used. Check gravity at rest (9.8 m/s²) before you trust it."
        )
    elif device.state == DeviceState.UNSUPPORTED:
        remark = f"Its id {device.id:#04x} is unknown or its settings could not be read back, so it is not used."
    elif device.family in (DeviceFamily.MPU6500, DeviceFamily.ICM20600):
        remark = "Not an MPU-6050, but a compatible successor; it is used with its own filter setting and formulas."
    return Description(chip, state, remark)


def _chip(device: HelloDevice) -> str:
    if device.state == DeviceState.ABSENT:
        return "none"
    if device.kind == DeviceKind.IMU:
        return _IMUS.get(device.id, "unknown inertial sensor")
    if device.kind == DeviceKind.BAROMETER:
        return _BAROMETERS.get(device.id, "unknown barometer")
    return next((name for family, name in _MAGNETOMETERS.items() if family == device.family), "unknown magnetometer")


_LACKS = {
    MouseLacks.REMOTE_MODE: "refuses remote mode: it is read in stream mode, and its movement is up to 5 ms late",
    MouseLacks.ENABLE: "does not confirm ENABLE: its sensor may stay dark. Move it and check that it counts",
    MouseLacks.SAMPLE_RATE: "does not take 200 reports/s: its counts may beat with the sample rate",
    MouseLacks.RESOLUTION: "does not take the requested resolution: it runs at {counts_per_mm} counts/mm",
    MouseLacks.STATUS: "does not report its settings: its resolution is assumed",
}


def mouse_state(mouse: HelloMouse) -> str:
    """What the state of a mouse port means, in the words of `Description.state`."""
    return _STATES[DeviceState(mouse.state)]


def refused_settings(mouse: HelloMouse) -> list[str]:
    """Names of the settings that a mouse refused during its set-up, such as "remote mode"."""
    return [lack.name.lower().replace("_", " ") for lack in MouseLacks if mouse.lacks & lack and lack.name]


def mouse_remarks(hello: Hello) -> Iterator[str]:
    """One sentence for each thing that a mouse refused during its set-up."""
    for port, mouse in enumerate(hello.mice, 1):
        for lack, text in _LACKS.items():
            if mouse.lacks & lack:
                yield f"The mouse at port {port} {text.format(counts_per_mm=mouse.counts_per_mm)}"


MOUSE_COUNTS = 255  # that a packet of a PS/2 mouse holds: 9 bits, two's complement
USUAL_POLL_S = 0.0075  # a poll of usual mice with its margin: firmware/README.md, "Mice"
# Above it a mouse's counts are no limit in practice: most office sensors lose the surface at 0.3 to 0.5 m/s, good ones
# at 1 m/s. Doubling it warns of mice that are fast enough.
ENOUGH_SPEED_M_S = 1.0


def mouse_speed_limit(counts_per_m: float, sample_rate_hz: float, poll_s: float = 0.0) -> float:
    """Speed (m/s) above which the counts of a mouse overflow between two polls.

    A round of polls takes whole ticks; `poll_s` is the longest poll measured, 0 if unknown.
    """
    ticks = math.ceil(max(poll_s, USUAL_POLL_S) * sample_rate_hz - 1e-9)
    return MOUSE_COUNTS * sample_rate_hz / (ticks * counts_per_m)


def slow_mouse_remarks(counts_per_m: Sequence[float], sample_rate_hz: float, poll_s: float = 0.0) -> Iterator[str]:
    """One sentence for each mouse, port 1 first, whose counts overflow below ENOUGH_SPEED_M_S."""
    for port, counts in enumerate(counts_per_m, 1):
        limit = mouse_speed_limit(counts, sample_rate_hz, poll_s)
        if limit < ENOUGH_SPEED_M_S:
            yield (
                f"Mouse {port} counts {counts:.0f} per metre: above {limit:.2f} m/s its counts overflow and movement "
                "is lost. Drive slower, or use a mouse with fewer counts per metre"
            )


def check_hello(hello: Hello) -> None:
    """Raises LinkposeError that names a value which no board has: nothing may be scaled by it."""
    if wrong := impossible(hello):
        raise LinkposeError(
            f"the board's HELLO contains {wrong}, which is impossible; its firmware is damaged or not linkpose's: "
            "type `linkpose flash`"
        )


def impossible(hello: Hello) -> str | None:
    """The first value of a HELLO that no board has, such as "dlpf = 7"; None if all are possible."""
    return next(_impossible(hello), None)


def _impossible(hello: Hello) -> Iterator[str]:
    allowed = {
        "streaming": (0, 1),
        "sample_rate_hz": LEGAL_RATES_HZ,
        "accel_range_g": (2, 4, 8, 16),
        "gyro_range_deg_s": (250, 500, 1000, 2000),
        "dlpf": range(7),
        "baro_oversampling": range(4),
        "mouse_counts_per_mm": (1, 2, 4, 8),
        "i2c_khz": (100, 400),
    }
    for name, values in allowed.items():
        value = getattr(hello, name)
        if value not in values:
            yield f"{name} = {value}"
    if (mice := (hello.sections >> 4) & 7) > MAX_MICE:
        yield f"{mice} mice"
    for at, device in enumerate(hello.devices):
        if device.kind not in list(DeviceKind):
            yield f"kind {device.kind} for device {at}"
        if device.state not in list(DeviceState):
            yield f"state {device.state} for device {at}"
        if device.family not in list(DeviceFamily):
            yield f"family {device.family} for device {at}"
    for port, mouse in enumerate(hello.mice, 1):
        if mouse.state not in list(DeviceState):
            yield f"state {mouse.state} for mouse port {port}"
