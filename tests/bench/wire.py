"""Speed of the wire's decoders beside pymavlink's, in one run on one machine.

    python tests/bench/wire.py [--json]

`stream` feeds SAMPLEs in pieces of 64 bytes, as a serial port gives them; `capture` decodes some minutes at once. The
peer parses RAW_IMU messages (MAVLink 2), the nearest it has in size and kind, in the same pieces. The rows `-3-mice` do
so with three mice in each SAMPLE, beside the peer's HIGHRES_IMU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from _report import Row, best_of, report
from pymavlink.dialects.v20 import common

from linkpose.simulation.link import LinkRun
from linkpose.wire.capture import decode_capture
from linkpose.wire.frames import StreamDecoder, encode

PIECE = 64
FRAMES = 1500  # a few milliseconds: the shortest of many short runs depends little on what else the machine does
CAPTURE_FRAMES = 20_000
TIMES = 50


def our_stream(count: int, mice: int) -> bytes:
    moved = tuple(value for port in range(mice) for value in (3 * port, -port))
    return b"".join(
        encode(sample._replace(mice=moved, sections=sample.sections | mice << 4))
        for sample in LinkRun(duration_s=count / 100).samples()
    )


def peer_stream(count: int, mice: int) -> bytes:
    link = common.MAVLink(None)

    def message(i: int) -> common.MAVLink_message:
        if mice:
            return link.highres_imu_encode(10_000 * i, *[0.1 * i + k for k in range(13)], 0x1FFF)
        return link.raw_imu_encode(10_000 * i, *[i % 1000 + k for k in range(9)], 0, i % 1000)

    return b"".join(message(i).pack(link) for i in range(count))


def in_pieces(feed: Callable[[bytes], object], stream: bytes) -> Callable[[], None]:
    def run() -> None:
        for at in range(0, len(stream), PIECE):
            feed(stream[at : at + PIECE])

    return run


def rows(mice: int, suffix: str) -> Iterator[Row]:
    theirs, ours = peer_stream(FRAMES, mice), our_stream(FRAMES, mice)
    peer_us = best_of(lambda: in_pieces(common.MAVLink(None).parse_buffer, theirs)(), TIMES) / FRAMES
    stream_us = best_of(lambda: in_pieces(StreamDecoder().feed, ours)(), TIMES) / FRAMES
    yield Row(f"stream{suffix}", stream_us, "pymavlink", peer_us)
    capture = our_stream(CAPTURE_FRAMES, mice)
    decode_capture(capture)
    capture_us = best_of(lambda: decode_capture(capture), TIMES) / CAPTURE_FRAMES
    yield Row(f"capture{suffix}", capture_us, "pymavlink", peer_us)


def main() -> None:
    report([*rows(0, ""), *rows(3, "-3-mice")])


if __name__ == "__main__":
    main()
