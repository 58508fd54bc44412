"""Options that change the board's settings; linkpose restores them after a reset of the board."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import click


class RateType(click.ParamType):  # type: ignore[type-arg]  # generic only in newer releases of click
    """A sample rate that the board's timer can produce."""

    name = "HZ"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        from linkpose.sensors.devices import LEGAL_RATES_HZ

        if str(value) not in map(str, LEGAL_RATES_HZ):
            self.fail(
                f"{value!r} is not a rate of the board; choose from {', '.join(map(str, LEGAL_RATES_HZ))}", param, ctx
            )
        return int(value)


# Option -> what it sets in CONFIGURE, its values, and what it is.
_OPTIONS = {
    "--rate": ("sample_rate_hz", RateType(), "Sample rate (Hz), a divisor of 2 MHz. Default: 100."),
    "--accel-range": ("accel_range_g", ("2", "4", "8", "16"), "Full scale of the accelerometer (g). Default: 8."),
    "--gyro-range": (
        "gyro_range_deg_s",
        ("250", "500", "1000", "2000"),
        "Full scale of the gyro (deg/s). Default: 1000.",
    ),
    "--dlpf": ("dlpf", click.IntRange(0, 6), "The MPU-6050's low-pass filter, 0 (widest) to 6. Default: 3."),
    "--baro-oversampling": ("baro_oversampling", click.IntRange(0, 3), "The BMP180's oversampling. Default: 1."),
    "--i2c": (
        "i2c_khz",
        ("100", "400"),
        "Clock of the I2C bus (kHz); 100 for long wires, up to 125 Hz. Default: 400.",
    ),
    "--mouse-resolution": ("mouse_counts_per_mm", ("1", "2", "4", "8"), "Counts per mm of the mice. Default: 8."),
}


def board_settings(function: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options; the function gets those that were typed as `board`, field of CONFIGURE -> value."""

    @functools.wraps(function)
    def collected(**arguments: Any) -> Any:
        typed = {field: arguments.pop(field) for field, _, _ in _OPTIONS.values()}
        board = {field: int(value) for field, value in typed.items() if value is not None}
        return function(board=board, **arguments)

    decorated: Callable[..., Any] = collected
    for option, (field, values, text) in reversed(_OPTIONS.items()):
        kind = click.Choice(values) if isinstance(values, tuple) else values
        decorated = click.option(option, field, type=kind, metavar="N", help=text)(decorated)
    return decorated
