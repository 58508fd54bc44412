"""A board written from protocol/README.md alone, without linkpose's own code: an MPU-6050, a BMP180 and one mouse.

What it needed and the page did not state is in the page now.
"""

from __future__ import annotations

import binascii
import math
import random
import struct

HELLO, SAMPLE, STATUS, PONG, ACK, NAK, SELF_TEST_RESULT = range(1, 8)
GET_INFO, CONFIGURE, START, STOP, PING, RESET_MICE, SELF_TEST = range(0x81, 0x88)
LENGTHS = {GET_INFO: 0, CONFIGURE: 10, START: 0, STOP: 0, PING: 4, RESET_MICE: 1, SELF_TEST: 1}
SCHEMA_CRC = 0x51379541
RATES = (50, 64, 80, 100, 125, 128, 160, 200, 250, 320, 400, 500)
CALIBRATION = (408, -72, -14383, 32741, 32757, 23153, 6190, 4, -32768, -8711, 2868, 0)
SECTIONS = 0x13  # inertial sensor, barometer, one mouse
SAMPLE_BODY = 11 + 14 + 7 + 4


def stuff(data: bytes) -> bytes:
    return b"".join(bytes([len(part) + 1]) + part for part in data.split(b"\0"))


def unstuff(data: bytes) -> bytes:
    parts = []
    while data:
        length = data[0]
        if length > len(data):
            raise ValueError("the code points past the end")
        parts.append(data[1:length])
        data = data[length:]
    return b"\0".join(parts)


def frame(kind: int, body: bytes) -> bytes:
    payload = bytes([kind]) + body
    return stuff(payload + struct.pack("<H", binascii.crc_hqx(payload, 0xFFFF))) + b"\0"


class PageBoard:
    """The state between power-on and power-off."""

    def __init__(self) -> None:
        self._now_us = 0  # since power-on
        self._settings = (100, 8, 1000, 3, 1, 8, 400)
        self._streams = False
        self._seq = self._ticks = self._corrupt = self._next_us = self._status_us = 0
        self._received, self._unsent = b"", b"\0" + self.hello()
        self._noise = random.Random(1)

    def hello(self) -> bytes:
        counts_per_mm = self._settings[5]
        body = struct.pack("<BBIBBBIBHBB", 2, 0, SCHEMA_CRC, 9, 9, 9, 7, 1, 0xFFFF, self._streams, SECTIONS)
        body += struct.pack("<HBHBBBH", *self._settings)
        devices = ((1, 0x68, 0x68, 1, 2), (1, 0x69, 0, 0, 0), (2, 0x77, 0x55, 0x10, 2), (3, 0, 0, 0, 0))
        body += b"".join(map(bytes, devices)) + struct.pack("<12h", *CALIBRATION)
        return frame(HELLO, body + bytes((2, 0, 0x60, counts_per_mm, 200, 0)))

    def advance(self, now_us: int) -> bytes:
        """What is due up to `now_us`."""
        self._now_us = now_us
        out, self._unsent = self._unsent, b""
        while self._streams and now_us >= self._next_us:
            out += self._sample(self._next_us)
            self._next_us += 1_000_000 // self._settings[0]
        if self._streams and now_us >= self._status_us:
            self._status_us += 1_000_000
            body = struct.pack("<IIIIHHIHHHHH", now_us, self._ticks, 0, 0, self._corrupt, 0, 0, 0, 9, 9, 3, 5000)
            out += frame(STATUS, body + bytes(40) + struct.pack("<4H", 0, 0, 0, 900))
        return out

    def _sample(self, at_us: int) -> bytes:
        """A link that swings by 0.4 rad about the sensor's y axis."""
        _, range_g, range_deg_s, *_ = self._settings
        angle, rate = 0.4 * math.sin(1.5e-6 * at_us), 0.6 * math.cos(1.5e-6 * at_us)
        accel = [32768 / range_g * part for part in (-math.sin(angle), 0.0, math.cos(angle))]
        gyro = [32768 / range_deg_s * part for part in (0.0, math.degrees(rate), 0.0)]
        counts = [round(value + self._noise.gauss(0, 5)) for value in (*accel, (25 - 36.53) * 340, *gyro)]
        body = struct.pack("<HIIB", self._seq & 0xFFFF, at_us & 0xFFFFFFFF, 0x0001 | 0x0008 | 0x0010, SECTIONS)
        body += struct.pack("<7h", *counts)
        body += struct.pack("<HIB", 27898, (23843 << 1) + self._noise.randrange(9), self._seq & 0xFF)
        self._seq += 1
        self._ticks += 1
        return frame(SAMPLE, body + struct.pack("<2h", 3, 1))

    def receive(self, data: bytes, now_us: int) -> bytes:
        """Answers to what arrived at `now_us`."""
        self._now_us = now_us
        *frames, self._received = (self._received + data).split(b"\0")
        return b"".join(self._answer(each) for each in frames if each)

    def _answer(self, received: bytes) -> bytes:
        try:
            payload = unstuff(received)
        except ValueError:
            payload = b""
        if len(payload) < 3 or struct.pack("<H", binascii.crc_hqx(payload[:-2], 0xFFFF)) != payload[-2:]:
            self._corrupt += 1
            return b""
        kind, body = payload[0], payload[1:-2]
        if kind not in LENGTHS:
            return frame(NAK, bytes((kind, 1)))
        if len(body) != LENGTHS[kind]:
            return frame(NAK, bytes((kind, 2)))
        if kind == GET_INFO:
            return self.hello()
        if kind == PING:
            return frame(PONG, body + struct.pack("<I", self._now_us))
        if reason := self._refuses(kind, body):
            return frame(NAK, bytes((kind, reason)))
        return frame(ACK, bytes((kind,))) + self._do(kind, body)

    def _refuses(self, kind: int, body: bytes) -> int:
        """The reason for a NAK, or 0."""
        if kind in (CONFIGURE, SELF_TEST) and self._streams:
            return 9
        if kind == SELF_TEST:
            return 10 if body[0] else 0
        if kind == RESET_MICE:
            return 11 if body[0] & ~1 else 0
        if kind != CONFIGURE:
            return 0
        rate, accel, gyro, dlpf, oversampling, counts_per_mm, i2c_khz = struct.unpack("<HBHBBBH", body)
        checks = (
            (rate in RATES, 3), (accel in (2, 4, 8, 16), 4), (gyro in (250, 500, 1000, 2000), 5), (dlpf <= 6, 6),
            (oversampling <= 3, 7), (counts_per_mm in (1, 2, 4, 8), 8),
            (i2c_khz == 400 or (i2c_khz == 100 and rate <= 125), 13), (rate * (SAMPLE_BODY + 5) <= 23_750, 12),
        )  # fmt: skip
        return next((reason for is_right, reason in checks if not is_right), 0)

    def _do(self, kind: int, body: bytes) -> bytes:
        if kind == CONFIGURE:
            self._settings = struct.unpack("<HBHBBBH", body)
        elif kind == START and not self._streams:
            self._streams, self._seq = True, 0
            self._next_us = self._status_us = self._now_us + 1000
            self._status_us += 1_000_000
        elif kind == STOP:
            self._streams = False
        elif kind == SELF_TEST:
            return frame(SELF_TEST_RESULT, bytes((0, 1)) + bytes(30))
        return b""
