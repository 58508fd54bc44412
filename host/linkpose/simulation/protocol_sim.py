"""`sim://...`: simulated boards as pyserial ports, for any code that opens a port.

    sim://link?test=1&seed=0&errors=calibrated&j2s=-0.09,-0.04,1.65&motion=swing&imu2=0&mag=0&mag_disturbance=desk
    sim://chain?joint=hinge&first_joint=fixed&seed=0&errors=calibrated
    sim://mice?seed=0&mice=3&path=drive&errors=calibrated&fault=lift:2:5-8

Each of them has two more options, such as drift_ppm=0&speed=1: `speed` is how much faster than real time the board
lives; 0 is as fast as it is read. `drift_ppm` is how much its clock runs fast.
"""

from __future__ import annotations

import difflib
import math
import threading
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import serial

from linkpose.errors import LinkposeError
from linkpose.sensors.rig import Rig
from linkpose.simulation.board import Run, SimulatedBoard
from linkpose.simulation.link import PAPER_J2S_M, LinkRun
from linkpose.wire.messages import Configure

_IDLE_S = 0.005  # a step of a board that is read as fast as it can and sends nothing


class Serial(serial.SerialBase):
    """A port with a simulated board behind it. `clock` returns the host's time (s) as this board experiences it."""

    rig: Rig

    def open(self) -> None:
        """Switches the board on. Raises SerialException for an address that names no simulated board."""
        try:
            make_run, options = _parse(self.portstr or "")
        except LinkposeError as error:
            raise serial.SerialException(str(error)) from error
        self._speed, self._drift = options["speed"], 1 + 1e-6 * options["drift_ppm"]
        self._board = SimulatedBoard(make_run)
        self.rig = self._board.rig
        self._changed = threading.Condition()
        self._buffer = bytearray()
        self._began = time.perf_counter()
        self._simulated_s = 0.0
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def clock(self) -> float:
        """Seconds since the board was switched on."""
        return (time.perf_counter() - self._began) * self._speed if self._speed else self._simulated_s

    def _board_us(self) -> int:
        return int(self.clock() * self._drift * 1e6)

    @property
    def in_waiting(self) -> int:
        with self._changed:
            return len(self._buffer)

    def read(self, size: int = 1) -> bytes:
        """Up to `size` bytes, waiting no longer than the time-out."""
        self._check_open()
        deadline = None if self.timeout is None else time.perf_counter() + self.timeout
        while self.is_open:
            with self._changed:
                self._buffer += self._board.advance(self._board_us())
                if self._buffer or size == 0:
                    data = bytes(self._buffer[:size])
                    del self._buffer[:size]
                    return data
                wait = self._until_next_tick()
                if deadline is not None:
                    wait = min(wait, deadline - time.perf_counter())
                if wait < 0:
                    break
                self._changed.wait(wait)  # until the next tick, or until the host sends something
        return b""

    def _until_next_tick(self) -> float:
        """Seconds to sleep until the board has something to send; a board read at full speed goes on at once."""
        due = self._board.next_tick_us
        if self._speed:
            left = 0.02 if due is None else (due - self._board_us()) * 1e-6 / self._drift / self._speed
            return min(max(left, 1e-4), 0.02)
        if due is None:
            self._simulated_s += _IDLE_S
            return _IDLE_S
        self._simulated_s = (due + 1) * 1e-6 / self._drift
        return 0.0

    def write(self, data: Any, /) -> int:
        """Hands bytes to the board, which answers at once."""
        self._check_open()
        with self._changed:
            now = self._board_us()
            self._buffer += self._board.advance(now)  # what was due comes before the answer
            self._buffer += self._board.receive(bytes(data), now)
            self._changed.notify()
        return len(data)

    def reset_input_buffer(self) -> None:
        with self._changed:
            self._buffer.clear()

    def reset_output_buffer(self) -> None:
        """Nothing is ever held back on the way to the board."""

    def cancel_read(self) -> None:
        """A read never waits longer than its time-out, and ends when the port is closed."""

    def _check_open(self) -> None:
        if not self.is_open:
            raise serial.PortNotOpenError()

    def _reconfigure_port(self) -> None:
        """A simulated line has no baud rate."""


def _parse(url: str) -> tuple[Callable[[Configure], Run], dict[str, float]]:
    """The rig and the options of a `sim://` address."""
    parts = urlsplit(url)
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    speed = _number(options, "speed", 1.0)
    drift = _number(options, "drift_ppm", 0.0)
    if speed < 0 or abs(drift) > 10_000:
        raise LinkposeError("speed must be 0 or more, and drift_ppm within 10000")
    if parts.netloc not in _RIGS:
        near = difflib.get_close_matches(parts.netloc, _RIGS, 1)
        names = f"did you mean {_address(near[0])}?" if near else f"type {', '.join(map(_address, _RIGS))}"
        raise LinkposeError(f"there is no simulated board {parts.netloc!r}; {names}")
    rig, known = _RIGS[parts.netloc]
    make_run = rig(options)
    if options:
        known = f"{known}, drift_ppm and speed"
        raise LinkposeError(f"{_address(parts.netloc)} has no option {', '.join(options)}; it has {known}")
    return make_run, {"speed": speed, "drift_ppm": drift}


def _address(rig: str) -> str:
    return f"sim://{rig}"


def _link(options: dict[str, str]) -> Callable[[Configure], Run]:
    test, seed = int(_number(options, "test", 1)), int(_number(options, "seed", 0))
    errors = options.pop("errors", "calibrated")
    words = options.pop("j2s", ",".join(map(str, PAPER_J2S_M))).split(",")
    if len(words) != 3:
        raise LinkposeError("j2s must be three numbers: j2s=X,Y,Z in metres")
    x, y, z = (_number({"j2s": word}, "j2s", 0) for word in words)
    motion, disturbance = options.pop("motion", "swing"), options.pop("mag_disturbance", None)
    imu2, mag = (_number(options, name, 0) != 0 for name in ("imu2", "mag"))

    def make_run(settings: Configure) -> LinkRun:
        return LinkRun(
            test,
            seed,
            None,
            settings.sample_rate_hz,
            errors,
            (x, y, z),
            accel_range_g=settings.accel_range_g,
            gyro_range_deg_s=settings.gyro_range_deg_s,
            oversampling=settings.baro_oversampling,
            motion=motion,
            imu2=imu2,
            mag=mag or disturbance is not None,
            mag_disturbance=disturbance,
        )

    return make_run


def _chain(options: dict[str, str]) -> Callable[[Configure], Run]:
    from linkpose.simulation.chain import ChainRun

    joint, first_joint = options.pop("joint", "hinge"), options.pop("first_joint", "fixed")
    seed = int(_number(options, "seed", 0))
    errors = options.pop("errors", "calibrated")

    def make_run(settings: Configure) -> ChainRun:
        return ChainRun(
            joint,
            seed,
            None,
            settings.sample_rate_hz,
            errors,
            accel_range_g=settings.accel_range_g,
            gyro_range_deg_s=settings.gyro_range_deg_s,
            oversampling=settings.baro_oversampling,
            first_joint=first_joint,
        )

    return make_run


def _mice(options: dict[str, str]) -> Callable[[Configure], Run]:
    from linkpose.simulation.mice import Fault, MiceRun, ring

    seed, mice = int(_number(options, "seed", 0)), int(_number(options, "mice", 3))
    path, errors = options.pop("path", "drive"), options.pop("errors", "calibrated")
    faults = tuple(Fault.parse(text) for text in options.pop("fault", "").split(",") if text)

    def make_run(settings: Configure) -> MiceRun:
        return MiceRun(
            seed,
            None,
            settings.sample_rate_hz,
            ring(mice, counts_per_m=1000.0 * settings.mouse_counts_per_mm),
            path,
            errors,
            faults=faults,
            accel_range_g=settings.accel_range_g,
            gyro_range_deg_s=settings.gyro_range_deg_s,
        )

    return make_run


# Simulated board -> what makes it from its options, and their names.
_RIGS: dict[str, tuple[Callable[[dict[str, str]], Callable[[Configure], Run]], str]] = {
    "link": (_link, "test, seed, errors, j2s, imu2, mag, mag_disturbance"),
    "chain": (_chain, "joint, first_joint, seed, errors"),
    "mice": (_mice, "seed, mice, path, errors, fault"),
}


def _number(options: dict[str, str], name: str, default: float) -> float:
    """Takes a number out of the options. Raises LinkposeError for what is none."""
    text = options.pop(name, None)
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise LinkposeError(f"{name}={text} is not a number")
    return value
