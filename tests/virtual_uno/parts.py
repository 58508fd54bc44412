"""Parts of the emulated board as real ones deviate: the options that serve.py accepts as text."""

from __future__ import annotations

import json
from typing import Any

from virtual_uno import VirtualUnoError

# Option -> meaning. The options are those of the emulator's modules (emulator/mpu6050.js, bmp180.js, ps2mouse.js ...).
IMU = {
    "whoAmI": "id: 0x68 MPU-6050, 0x70 0x71 0x73 MPU-6500 family, 0x12 0x19 0x98 ICM-20600 family; else unknown",
    "family": "mpu6050, mpu6500 or icm20600 in place of the one that whoAmI has",
    "readOnly": "true: settings are not kept",
    "fault": "zeros, frozen, full, stuck, hot, or none",
    "selfTestError": "relative error of the self-test's response",
}
BMP180 = {
    "id": "0x55",
    "speed": "maximum or typical duration of the conversions",
    "lateMs": "a clone that converts so much longer than the data sheet's maximum, with its Sco bit set",
}
BMP280 = {"id": "0x58 BMP280, 0x60 BME280"}
MOUSE = {
    "clockHz": "10000 to 16700",
    "responseUs": "from a command to its answer: 400, at most 20000",
    "requestUs": "from a request to send to the first clock: 150, at most 15000",
    "selfTestMs": "400",
    "darkUntilEnable": "true: the sensor does not run before ENABLE",
    "pullUps": "false: no resistors on the lines",
    "plugged": "false: absent at power-on",
    "noRemoteMode": "true: acknowledges remote mode and stays in stream mode",
    "sensorAtReportRate": "true: the sensor is read by the mouse's own clock",
    "reportRateError": "relative error of that clock",
    "ignores": "commands without any answer, such as 0xF2+0xF3",
    "refuses": "commands that get RESEND (0xFE) each time",
    "refusesOnce": "commands that get RESEND the next time",
    "errors": "commands that get ERROR (0xFC) each time",
}
_LISTS = ("ignores", "refuses", "refusesOnce", "errors")
MAGNETOMETERS = ("hmc5883l", "qmc5883l", "qmc5883p")


def parse(text: str, allowed: dict[str, str]) -> dict[str, Any]:
    """The options in KEY=VALUE,KEY=VALUE. Raises VirtualUnoError for one that is not `allowed`."""
    options = {}
    for pair in filter(None, text.split(",")):
        key, _, value = pair.partition("=")
        if key not in allowed or not value:
            raise VirtualUnoError(f"there is no option {pair!r}; the options are {', '.join(allowed)}")
        options[key] = [_value(part) for part in value.split("+")] if key in _LISTS else _value(value)
    return options


def _value(text: str) -> Any:
    """A number (also hexadecimal), true, false, none, or a word."""
    if text.startswith("0x"):
        return int(text, 16)
    if text == "none":
        return None
    try:
        return json.loads(text)
    except ValueError:
        return text


def help_text() -> str:
    """Every option with its meaning."""
    kinds = {"--imu, --imu2": IMU, "--bmp180": BMP180, "--bmp280": BMP280, "--mouse": MOUSE}
    lines = ["parts that deviate, as KEY=VALUE,KEY=VALUE:"]
    for name, options in kinds.items():
        lines.append(f"  {name}")
        lines += [f"    {key:20}{meaning}" for key, meaning in options.items()]
    return "\n".join(lines) + "\n"
