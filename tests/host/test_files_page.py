"""The page on file formats names every column, rig key and entry that the program writes."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path

import pytest
from click.testing import CliRunner

from linkpose import convert, streams
from linkpose.cli import group
from linkpose.filters import REGISTRY, create
from linkpose.filters.magnetic_heading import MagneticHeading, has_yaw
from linkpose.quantities import split
from linkpose.recording import columns
from linkpose.recording.writer import closing, metadata
from linkpose.sensors.conversion import BoardSettings
from linkpose.sensors.rig import Chain, Joint, Mag, Mouse, Rig
from linkpose.sensors.timeline import Timeline
from linkpose.simulation import board
from linkpose.wire.frames import Corrupt

PAGE = (Path(__file__).parents[2] / "host" / "docs" / "files.md").read_text(encoding="utf-8")
NAMED = set(re.findall(r"`([^`\n]+)`", PAGE))
X = (1.0, 0.0, 0.0)
MICE = Mouse(0.1, 0.0), Mouse(-0.1, 0.1), Mouse(-0.1, -0.1)


def unnamed(found: list[str]) -> list[str]:
    """Columns that the page does not name; those of an estimate by the ending after the filter's name."""
    missing = []
    for name in found:
        part = split(name)
        ending = f"…_{name.removeprefix(part.prefix + '_')}" if part and part.prefix else name
        special = next((f"…{name[name.index(word) :]}" for word in ("_cov_", "_mag_") if word in name), name)
        if not {name, ending, special} & NAMED:
            missing.append(name)
    return missing


def test_the_columns_of_recordings() -> None:
    found = columns.names(columns.ColumnLayout(1, imu2=True, mag=True))
    assert "mag_fresh" in found and not unnamed(found)
    assert unnamed(["gyro_z_rad", "tilt_height_km"]) == ["gyro_z_rad", "tilt_height_km"]


@pytest.mark.parametrize("name", REGISTRY)
def test_the_columns_of_every_filter(name: str) -> None:
    for chain in (Chain(), Chain("ball", X, 0.01, X), Chain("hinge", X, 0.01, X, 0.01, X, 3.0, X)):
        rig = Rig(joint=Joint(X), chain=chain, mouse=MICE)
        made = create(name, rig)
        made = MagneticHeading(made, Mag(X)) if has_yaw(made) else made
        assert not unnamed(list(made.columns))


def header(path: Path) -> list[str]:
    """The names of the columns in a file of linkpose."""
    return next(line for line in path.read_text().splitlines() if not line.startswith("#")).split(",")


def test_the_columns_and_metadata_of_written_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for line in (
        "simulate link -o link.csv --truth link_truth.csv --duration 2",
        "simulate chain -o chain.csv --truth chain_truth.csv --duration 2",
        "simulate mice -o mice.csv --truth mice_truth.csv --duration 2",
        "simulate indoor -o indoor.log --truth indoor_truth.csv --map map.yaml --duration 5",
        "simulate underwater -o sea.csv --truth sea_truth.csv --beacons beacons.csv --duration 5",
        "localize sea.csv --beacons beacons.csv -o sea_path.csv",
        "localize indoor.log --map map.yaml -o indoor_path.csv --filter ekf",
        "estimate link.csv -o link_estimate.csv --filter tilt",
    ):
        done = CliRunner().invoke(group, line.split())
        assert done.exit_code == 0, done.output
    for path in tmp_path.glob("*_*.csv"):
        assert not unnamed(header(path)), path.name
    lines = (tmp_path / "link_estimate.csv").read_text().splitlines()
    for line in (lines[1], lines[-1], (tmp_path / "sea_path.csv").read_text().splitlines()[1]):
        assert set(json.loads(line[1:])) <= NAMED


def test_the_entries_of_a_recording_s_metadata() -> None:
    hello = board.hello(board.DEFAULTS)
    head = metadata(hello, BoardSettings.of(hello), "sim", Rig(), {})
    assert set(head) <= NAMED
    assert set(closing(Timeline(100.0), Corrupt(), None)) | {"board", "sensors", "ended", "marks"} <= NAMED


def test_the_keys_of_a_rig() -> None:
    for table in fields(Rig):
        assert f"[{table.name}]" in NAMED or f"[[{table.name}]]" in NAMED
        default = MICE[0] if table.name == "mouse" else getattr(Rig(), table.name)
        assert {key.name for key in fields(default)} <= NAMED, table.name


def test_the_formats_and_live_outputs() -> None:
    assert set(convert.ENDINGS) <= NAMED
    assert set(re.findall(r"\w+:[\w/:]+", streams.FORMS)) == {
        "udp://HOST:PORT",
        "osc://HOST:PORT",
        "ws://HOST:PORT",
        "lsl:NAME",
    }
    assert set(re.findall(r"\w+:[\w/:]+", streams.FORMS)) <= NAMED
