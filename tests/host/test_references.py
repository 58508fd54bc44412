"""Motion-capture takes in C3D and TRC as references, written by other programs' libraries."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest

from linkpose.convert import convert
from linkpose.errors import FileFormatError, LinkposeError, MissingLibrary
from linkpose.evaluation.references import read_any
from linkpose.evaluation.scores import evaluate
from linkpose.recording.csvfile import CsvFile
from linkpose.recording.table import read_table
from linkpose.simulation.link import LinkRun

RATE = 50.0
RUN = LinkRun(2, 1, 20.0)
TIMES = np.arange(0, 20, 1 / RATE)
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # east, north, up -> x, y, z of such a room


def markers() -> np.ndarray:
    """Three markers (N, 3, 3) on the sensor of a simulated link in m: east, north, up."""
    tilt = RUN.at(TIMES).tilt
    x = np.cross(np.cross(tilt, [1.0, 0, 0]), tilt)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    axes = np.stack([x, np.cross(tilt, x), tilt], axis=1)  # n's axes seen in s: turns s into n
    places = np.array(RUN.j2s_m) + np.array([[0, 0, 0], [0.1, 0, 0], [0.02, 0.08, 0]])
    return np.einsum("nij,kj->nki", axes, places) + np.array([0.3, -0.2, 0.7])


def expected() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    tilt = RUN.at(TIMES).tilt
    return (
        tilt @ np.array(RUN.j2s_m),
        np.degrees(np.arctan2(tilt[:, 1], tilt[:, 2])),
        np.degrees(np.arcsin(-tilt[:, 0])),
    )


def c3d(path, names, unit="mm", screen="", hidden=40):
    """As ezc3d writes it; the plate is hidden in one frame."""
    ezc3d = importlib.import_module("ezc3d")
    room = markers() @ (Y_UP.T if screen.endswith("Y") else np.eye(3))
    points = np.ones((4, len(names), len(TIMES)))
    points[:3] = np.nan
    for at, name in enumerate(names):
        if name[-1] in "OXY":
            points[:3, at] = (1000 if unit == "mm" else 1) * room[:, "OXY".index(name[-1])].T
    points[:3, :, hidden] = np.nan
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [RATE]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(names)
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    if screen:
        file.add_parameter("POINT", "Y_SCREEN", [screen])
    file["data"]["points"] = points
    file.write(str(path))
    return path


def trc(path, names, unit="mm", separator="."):
    """As OpenSim writes it: Y up; an empty field is a hidden marker."""
    room = (1000 if unit == "mm" else 1) * markers() @ Y_UP.T
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{RATE}\t{RATE}\t{len(TIMES)}\t{len(names)}\t{unit}\t{RATE}\t1\t{len(TIMES)}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{a}{i}" for i in range(1, len(names) + 1) for a in "XYZ"),
        "",
    ]
    for i, (t, frame) in enumerate(zip(TIMES, room, strict=True)):
        cells = [f"{value:.5f}" for name in names for value in frame["OXY".index(name[-1])]]
        lines.append("\t".join([str(i + 1), f"{t:.5f}", *(cells if i != 40 else [""] * len(cells))]))
    path.write_text("\r\n".join(lines).replace(".", separator) + "\r\n")
    return path


def check(table) -> None:
    height, roll, pitch = expected()
    seen = np.arange(len(TIMES)) != 40
    assert np.isnan(table.columns["height_m"][~seen]).all()
    for name, value, within in (("height_m", height, 2e-4), ("roll_deg", roll, 0.02), ("pitch_deg", pitch, 0.02)):
        assert np.allclose(table.columns[name][seen], value[seen], atol=within), name


@pytest.mark.parametrize(
    ("names", "unit", "screen", "up"),
    [
        (["a_O", "a_X", "a_Y"], "mm", "", None),
        (["M1 O", "M2 X", "M3 Y", "*4"], "m", "", "z"),
        (["head", "a_Y", "a_O", "a_X"], "mm", "+Y", None),
    ],
)
def test_c3d_as_reference(tmp_path, names, unit, screen, up):
    table = read_any(c3d(tmp_path / "take.c3d", names, unit, screen), up)
    check(table)
    assert np.allclose(np.diff(table.columns["time_s"]), 1 / RATE)


@pytest.mark.parametrize(
    ("names", "unit", "separator"), [(["1O", "2X", "3Y"], "mm", "."), (["a_Y", "a_O", "a_X"], "m", ",")]
)
def test_trc_as_reference(tmp_path, names, unit, separator):
    check(read_any(trc(tmp_path / "take.trc", names, unit, separator)))


def test_what_linkpose_converts_is_a_reference_of_itself(tmp_path):
    """A link's poses as markers, in each format, against the estimate that they come from."""
    tilt = RUN.at(TIMES).tilt
    place = markers()[:, 0] - [0.3, -0.2, 0.7]
    _, roll, pitch = expected()
    columns = {"time_s": TIMES, "joint_inertial_height_m": place[:, 2]}
    columns |= {"joint_inertial_roll_deg": roll, "joint_inertial_pitch_deg": pitch}
    columns |= {
        "joint_inertial_yaw_deg": 0 * roll,
        "joint_inertial_x_m": place[:, 0],
        "joint_inertial_y_m": place[:, 1],
    }
    source = tmp_path / "e.csv"
    with CsvFile(source, "estimate", {}, list(columns), False) as file:
        for row in zip(*columns.values(), strict=True):
            file.write(",".join(f"{value:.9f}" for value in row) + "\n")
        file.close({})
    assert len(tilt) == len(TIMES)
    for ending in ("c3d", "trc"):
        convert(source, tmp_path / f"e.{ending}")
        score = evaluate(read_table(source), read_any(tmp_path / f"e.{ending}")).scores[0].as_dict()
        assert score["height_rmse_cm"] < 0.05 and score["roll_rmse_deg"] < 0.01 and score["pitch_rmse_deg"] < 0.01


def test_what_is_no_take_is_named(tmp_path, monkeypatch):
    good = c3d(tmp_path / "take.c3d", ["a_O", "a_X", "a_Y"])
    (tmp_path / "cut.c3d").write_bytes(good.read_bytes()[:700])
    with pytest.raises(FileFormatError, match="damaged or no C3D file"):
        read_any(tmp_path / "cut.c3d")
    with pytest.raises(LinkposeError, match="has 2 named markers; three are needed"):
        read_any(c3d(tmp_path / "two.c3d", ["a_O", "a_X"]))
    with pytest.raises(FileFormatError, match="unknown unit 'furlong'"):
        read_any(c3d(tmp_path / "unit.c3d", ["a_O", "a_X", "a_Y"], "furlong"))
    lines = trc(tmp_path / "take.trc", ["1O", "2X", "3Y"]).read_text().split("\n")
    for name, text, sentence in (
        ("head", lines[:3], "no marker names in line 4"),
        ("rows", lines[:6], "has no frame"),
        ("word", [*lines[:9], lines[9].replace("0.0", "here", 1)], "line 10: a field is not a number"),
    ):
        (tmp_path / f"{name}.trc").write_text("\n".join(text))
        with pytest.raises(FileFormatError, match=sentence):
            read_any(tmp_path / f"{name}.trc")
    monkeypatch.setitem(importlib.import_module("sys").modules, "ezc3d", None)
    with pytest.raises(MissingLibrary, match="ezc3d"):
        read_any(good)


@pytest.mark.parametrize(
    ("at", "damage", "reason"),
    [
        (8, b"\xff\xff", "more than it can hold"),  # the last frame in the header
        (0, b"\x1f", "ends before its parameters"),  # the block of the parameters
    ],
)
def test_a_c3d_file_that_states_more_than_it_holds_is_refused_before_memory_is_reserved(tmp_path, at, damage, reason):
    """ezc3d reserves memory by the sizes that a file states: 12 GB for a damaged file of 8 kB."""
    path = c3d(tmp_path / "take.c3d", ["S_O", "S_X", "S_Y"])
    data = bytearray(path.read_bytes()[:8000])
    data[at : at + len(damage)] = damage
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=reason):
        read_any(path, None)


def test_a_c3d_file_on_which_ezc3d_crashes_is_named(tmp_path):
    """A parameter that a flipped bit has made a group: the process that reads it ends by a segmentation fault."""
    path = c3d(tmp_path / "take.c3d", ["S_O", "S_X", "S_Y"])
    data = bytearray(path.read_bytes())
    at = data.index(b"\x0c\x02DESCRIPTIONS") + 1
    data[at] = 130
    path.write_bytes(bytes(data))
    with pytest.raises(FileFormatError, match=r"take.c3d is damaged or no C3D file: .*; export the take again"):
        read_any(path)


@pytest.mark.skipif(sys.platform != "linux", reason="the memory of a process is bounded on Linux only")
@pytest.mark.parametrize(("bound", "reason"), [("_MOST_BYTES", "needs more than"), ("_LONGEST_S", "does not finish")])
def test_the_time_and_the_memory_to_read_a_c3d_file_are_bounded(tmp_path, monkeypatch, bound, reason):
    """A damaged file of 8 kB took 11.5 GB, and more than a minute."""
    path = c3d(tmp_path / "take.c3d", ["S_O", "S_X", "S_Y"])
    monkeypatch.setattr("linkpose.evaluation.markers._MOST_BYTES_PER_BYTE", 0)
    monkeypatch.setattr(f"linkpose.evaluation.markers.{bound}", 0)
    with pytest.raises(FileFormatError, match=f"take.c3d is damaged or no C3D file: ezc3d {reason}"):
        read_any(path)
