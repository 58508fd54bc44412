"""Firmware and host that do not belong together: found at any time, both versions named, and what to type."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pty_board import PtyBoard

from linkpose.device import session as session_module
from linkpose.device.session import Session
from linkpose.errors import BoardError
from linkpose.recorder import Recorder
from linkpose.recording.reader import load_recording
from linkpose.sensors.rig import Rig
from linkpose.simulation import board as simulated
from linkpose.wire.frames import encode
from linkpose.wire.messages import VERSION

LIVE = ["info", "record {out}", "estimate --live -o {out}"]
OURS = encode(simulated.hello(simulated.DEFAULTS))
RELEASE = dict(zip(("firmware_major", "firmware_minor", "firmware_patch"), map(int, VERSION.split(".")), strict=True))
OLDER = RELEASE | {"firmware_major": 0, "firmware_minor": 0, "firmware_patch": 1}
NEWER = RELEASE | {"firmware_major": 99}


class OtherFirmware:
    """Replaces the HELLO of a board by another, from the moment in which `begin` is called."""

    def __init__(self, **fields: int) -> None:
        self._hello = encode(simulated.hello(simulated.DEFAULTS)._replace(**fields))
        self._begun = threading.Event()

    def begin(self) -> None:
        self._begun.set()

    @property
    def begun(self) -> bool:
        return self._begun.is_set()

    def __call__(self, sent: bytes) -> bytes:
        return sent.replace(OURS, self._hello) if self._begun.is_set() else sent


def arguments(command: str, port: Path, out: Path) -> list[str]:
    return [*command.format(out=out).split(), "--port", str(port)]


@pytest.mark.parametrize("command", LIVE)
@pytest.mark.parametrize(
    ("release", "named", "cure"),
    [
        (OLDER, "firmware 0.0.1 and this linkpose", "linkpose flash"),
        (RELEASE, f"firmware {VERSION} and this linkpose {VERSION}", "linkpose flash"),
        (NEWER, f"this linkpose {VERSION} is older than the board's firmware 99.", "pip install --upgrade linkpose"),
    ],
    ids=["older", "same release", "newer"],
)
def test_another_schema_at_the_start(
    refused: Callable[..., str], tmp_path: Path, command: str, release: dict[str, int], named: str, cure: str
) -> None:
    firmware = OtherFirmware(schema_crc=1, **release)
    firmware.begin()
    with PtyBoard(tmp_path / "port", spoil=firmware):
        output = refused(*arguments(command, tmp_path / "port", tmp_path / "out.csv"))
    assert named in output
    assert f"type `{cure}`" in output
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize(("minor", "older"), [(4, "firmware"), (6, "linkpose")])
def test_another_minor_version_is_told_and_goes_on(
    linkpose: Callable[..., tuple[int, str, str]],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    minor: int,
    older: str,
) -> None:
    monkeypatch.setattr(session_module, "PROTOCOL_MINOR", 5)
    firmware = OtherFirmware(protocol_minor=minor, schema_crc=1)
    firmware.begin()
    with PtyBoard(tmp_path / "port", spoil=firmware):
        command = arguments("record {out} --duration 0.1", tmp_path / "port", tmp_path / "out.csv")
        status, _, output = linkpose(*command)
    assert status == 0
    assert f"the board uses protocol 2.{minor}, this linkpose 2.5" in output
    assert f"they are compatible, but the {older} should be updated" in output


def pull_and_plug(board: PtyBoard) -> None:
    board.pull()
    board.plug()


def reset_silently(board: PtyBoard) -> None:
    board.reset(says_hello=False)


@pytest.mark.parametrize("exchange", [pull_and_plug, reset_silently], ids=["at the cable", "under way"])
@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"schema_crc": 1, **OLDER}, f"firmware 0.0.1 and this linkpose {VERSION}"),
        ({"protocol_major": 0}, "it uses protocol 0."),
        ({"baro_words": (1,) * 12}, "another board answers"),
    ],
    ids=["schema", "protocol", "board"],
)
def test_another_firmware_in_the_middle_of_a_recording_ends_it(
    tmp_path: Path, exchange: Callable[[PtyBoard], None], fields: dict[str, Any], named: str
) -> None:
    """It is not waited for, and what was recorded until then is kept."""
    firmware = OtherFirmware(**fields)
    port, out = tmp_path / "port", tmp_path / "out.csv"
    with (
        PtyBoard(port, spoil=firmware) as board,
        Session(str(port), lambda _: None) as session,
        pytest.raises(BoardError, match=named),
        Recorder(session, out, Rig(), False) as recorder,
    ):
        for placements in session.stream(5.0):
            recorder.convert(placements)
            if session.timeline.samples >= 20 and not firmware.begun:
                firmware.begin()
                exchange(board)
    assert len(load_recording(out).measurements) >= 20
