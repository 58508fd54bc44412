"""The wire: golden frames, rejected frames, and what corruption may and may not do."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from linkpose.wire import frames, messages
from linkpose.wire.capture import decode_capture
from linkpose.wire.frames import OtherProtocol, StreamDecoder, encode
from linkpose.wire.messages import Hello, Ping, Pong, Sample

VECTORS = json.loads((Path(__file__).parents[2] / "protocol" / "vectors.json").read_text())
BY_NAME = {layout.cls.__name__.upper(): layout.cls for layout in messages.LAYOUTS}


def golden_message(row):
    cls = BY_NAME[row["message"].replace("_", "")]
    layout = next(layout for layout in messages.LAYOUTS if layout.cls is cls)
    values = dict(row["fields"])
    for group in layout.groups:
        repetitions = row["groups"][group.name]
        if group.name in cls._fields and group.cls:
            values[group.name] = tuple(group.cls(**each) for each in repetitions)
        elif group.name in cls._fields:
            values[group.name] = tuple(value for each in repetitions for value in each.values())
        else:  # a section: its fields are the message's
            values |= {name: value for each in repetitions for name, value in each.items()}
    return cls(**values)


@pytest.mark.parametrize("row", VECTORS["frames"], ids=lambda row: row["name"])
def test_golden_frames_both_ways(row):
    message = golden_message(row)
    assert encode(message).hex() == row["frame"]
    decoder = StreamDecoder(from_board=row["direction"] == "board_to_host")
    got = decoder.feed(bytes.fromhex(row["frame"]))
    if isinstance(message, Hello) and message.protocol_major != messages.PROTOCOL_MAJOR:
        assert got == [OtherProtocol(message.protocol_major, message.protocol_minor, message.schema_crc)]
    else:
        assert got == [message]
    assert decoder.corrupt.total == 0


@pytest.mark.parametrize("row", VECTORS["rejected"], ids=lambda row: row["name"])
def test_rejected_frames_are_counted_by_cause_and_the_next_is_read(row):
    from_board = not row["name"].startswith("PING")
    good = Pong(1, 2) if from_board else Ping(3)
    decoder = StreamDecoder(from_board)
    assert decoder.feed(bytes.fromhex(row["frame"]) + encode(good)) == [good]
    assert decoder.corrupt.as_dict() == {"cobs": 0, "length": 0, "crc": 0, "type": 0} | {row["cause"]: 1}


def test_the_other_sides_messages_are_of_unknown_type():
    decoder = StreamDecoder(from_board=True)
    assert decoder.feed(encode(Ping(1))) == []
    assert decoder.corrupt.type == 1


def test_hello_of_an_older_protocol_is_recognised_whatever_its_length():
    body = bytes([0x01, 0, 7]) + (123).to_bytes(4, "little") + b"unknown to us"
    decoder = StreamDecoder()
    assert decoder.feed(frame_of(body)) == [OtherProtocol(0, 7, 123)]


@pytest.mark.parametrize("mice", range(5))
def test_what_is_as_long_as_a_sample_and_is_none_is_counted_by_cause(mice):
    body = bytes(10) + bytes([0x03 | mice << 4]) + bytes(23 + 4 * mice)
    decoder = StreamDecoder()
    assert decoder.feed(frame_of(b"\x7d" + body) + frame_of(b"\x04" + body) + frame_of(b"\x02" + body + b"\0")) == []
    crossed = encode(sample(7, mice))[:-3] + b"\x11\x22\0"
    assert decoder.feed(crossed) == []
    assert decoder.corrupt.as_dict() == {"cobs": 0, "length": 2, "crc": 1, "type": 1}


def frame_of(payload: bytes) -> bytes:
    from binascii import crc_hqx

    from cobs import cobs

    return cobs.encode(payload + crc_hqx(payload, 0xFFFF).to_bytes(2, "little")) + b"\0"


def sample(seq: int, mice: int = 3) -> Sample:
    imu = (-seq % 1000, 0, 4096, 1, 0, -1, seq % 7)
    mag = (seq % 500, -200, 40, seq % 256) if seq % 3 == 0 else ()
    return frames.sample(
        seq % 65536,
        seq * 10000 % 2**32,
        0x1FF,
        imu,
        imu2=imu[::-1] if seq % 5 == 0 else (),
        baro=(27898, 23843, seq % 256) if seq % 2 else (),
        mag=mag,
        mice=(seq % 100 - 50, -(seq % 30)) * mice,
    )


@given(st.lists(st.integers(1, 70), max_size=60))
def test_pieces_of_any_size_give_the_same_messages(cuts):
    sent = [sample(i, i % 5) for i in range(20)]
    stream = b"".join(map(encode, sent))
    decoder, got, at = StreamDecoder(), [], 0
    for cut in [*cuts, len(stream)]:
        got += decoder.feed(stream[at : at + cut])
        at += cut
    got += decoder.feed(stream[at:])
    assert got == sent and decoder.corrupt.total == 0


@given(
    st.lists(st.one_of(st.binary(max_size=200), st.text("\x01\x40\xff", min_size=120, max_size=300).map(str.encode))),
    st.integers(1, 150),
)
def test_causes_are_the_same_in_pieces_as_a_whole_and_in_a_capture(garbage, size):
    """A frame that is too long is that, however much of it has arrived."""
    stream = b"".join(encode(sample(i)) + part for i, part in enumerate(garbage))
    whole, pieces = StreamDecoder(), StreamDecoder()
    messages = whole.feed(stream)
    assert [m for at in range(0, len(stream), size) for m in pieces.feed(stream[at : at + size])] == messages
    assert pieces.corrupt == whole.corrupt
    captured = decode_capture(stream)
    assert captured.corrupt == whole.corrupt
    assert len(captured.samples) + len(captured.others) == len(messages)


@given(st.binary(max_size=2000))
def test_noise_never_raises_and_memory_is_bounded(noise):
    decoder = StreamDecoder()
    decoder.feed(noise)
    assert len(decoder._rest) <= messages.MAX_FRAME
    assert decoder.feed(b"\0" + encode(Pong(5, 6)))[-1] == Pong(5, 6)


def test_a_line_that_never_sends_a_zero_counts_one_frame():
    decoder = StreamDecoder()
    for _ in range(100):
        decoder.feed(b"\x55" * 50)
    assert decoder.corrupt.as_dict() == {"cobs": 0, "length": 1, "crc": 0, "type": 0}


def corrupted_stream(rng: random.Random, frames: list[bytes]) -> bytes:
    """Frames with bit flips, cuts, inserts, doubled and swapped bytes in about a third of them."""
    out = bytearray()
    for frame in frames:
        damaged = bytearray(frame)
        at = rng.randrange(len(damaged))
        match rng.randrange(15):
            case 0:
                damaged[at] ^= 1 << rng.randrange(8)
            case 1:
                del damaged[at:]
            case 2:
                damaged[at:at] = rng.randbytes(rng.randrange(1, 9))
            case 3:
                damaged[at:at] = damaged[at : at + 1]
            case 4:
                damaged[at - 1], damaged[at] = damaged[at], damaged[at - 1]
        out += damaged
    return bytes(out)


def test_a_megabyte_of_damaged_frames():
    rng = random.Random(1)
    sent = [sample(i, i % 4) for i in range(25000)]
    stream = corrupted_stream(rng, [encode(message) for message in sent])
    decoder, got = StreamDecoder(), []
    for at in range(0, len(stream), 4096):
        got += decoder.feed(stream[at : at + 4096])
    known = set(sent)
    strangers = sum(message not in known for message in got)
    # CRC-16 lets one damaged frame in 65536 through; a third of 25000 are damaged.
    assert strangers <= 2
    assert len(got) > 0.6 * len(sent)
    assert decoder.corrupt.total > 0.2 * len(sent)
