"""Converted files, read back by the libraries of their formats."""

from __future__ import annotations

import importlib
import json
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from linkpose.cli.convert import command
from linkpose.convert import convert
from linkpose.errors import FileExists, FileFormatError, InvalidValue, LinkposeError, MissingLibrary, UnknownFilter
from linkpose.recording import chunks
from linkpose.recording.csvfile import CsvFile
from linkpose.recording.table import read_table

RATE = 100.0
ROWS = 250


@pytest.fixture
def estimate(tmp_path):
    """Two filters; joint-inertial has no estimate in its first three rows, and samples 100 to 119 are lost."""
    t = np.delete(np.arange(ROWS) / RATE, slice(100, 120))
    roll, pitch, yaw = 20 * np.sin(t), 60 * np.cos(2 * t), 170 * np.sin(0.7 * t)
    columns = {"time_s": t, "tilt_height_m": 1 + 0.1 * t, "tilt_height_std_m": 0 * t + 0.01}
    columns |= {"tilt_roll_deg": roll, "tilt_pitch_deg": pitch}
    values = {"height_m": 1.5 + 0 * t, "roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw, "x_m": t, "y_m": -t}
    columns |= {f"joint_inertial_{name}": np.where(np.arange(len(t)) < 3, np.nan, v) for name, v in values.items()}
    path = tmp_path / "est.csv"
    with CsvFile(path, "estimate", {"filters": ["tilt", "joint-inertial"]}, list(columns), False) as file:
        for row in zip(*columns.values(), strict=True):
            file.write(",".join("" if v != v else f"{v:.9f}" for v in row) + "\n")
        file.close({"rows": len(t)})
    return path


@pytest.fixture
def truth(estimate):
    """Time, position and rotation of the rows that joint-inertial has estimated."""
    c = read_table(estimate).columns
    angles = np.column_stack([c[f"joint_inertial_{name}_deg"] for name in ("roll", "pitch", "yaw")])[3:]
    place = np.column_stack([c[f"joint_inertial_{name}_m"] for name in ("x", "y", "height")])[3:]
    return c["time_s"][3:], place, Rotation.from_euler("xyz", angles, degrees=True)


def test_a_filter_without_poses_is_passed_over(tmp_path):
    """Of a rest of one second, tilt-inertial has no attitude yet; the mice have poses."""
    names = ["time_s"] + [f"tilt_inertial_{name}" for name in ("height_m", "roll_deg", "pitch_deg")]
    names += [f"mice_{name}" for name in ("x_m", "y_m", "heading_rad")]
    path, empty = tmp_path / "est.csv", tmp_path / "empty.csv"
    for file_path, mice in ((path, ",1,2,0"), (empty, ",,,")):
        with CsvFile(file_path, "estimate", {}, names, False) as file:
            for at in range(9):
                file.write(f"{at / 100},,,{mice}\n")
            file.close({"rows": 9})
    remarks = convert(path, tmp_path / "m.tum")
    assert np.loadtxt(tmp_path / "m.tum")[:, :3] == pytest.approx(np.column_stack([np.arange(9) / 100, [[1, 2]] * 9]))
    assert any("the one of the filter mice" in remark for remark in remarks)
    with pytest.raises(LinkposeError, match="no two poses of tilt-inertial"):
        convert(path, tmp_path / "t.tum", "tilt-inertial")
    with pytest.raises(LinkposeError, match="no two poses of any filter"):
        convert(empty, tmp_path / "n.tum")


def test_opensim_reads_the_orientations(estimate, truth, tmp_path):
    opensim = importlib.import_module("opensim")
    out = tmp_path / "out.sto"
    remarks = convert(estimate, out, "joint-inertial", "tibia_r_imu")
    assert any("3 rows without an estimate" in remark for remark in remarks)
    table = opensim.TimeSeriesTableQuaternion(str(out))
    assert table.getTableMetaDataAsString("DataRate") == "100.000000"
    assert list(table.getColumnLabels()) == ["tibia_r_imu"]
    assert np.allclose(table.getIndependentColumn(), truth[0])
    flat = table.flatten()
    found = np.column_stack([flat.getDependentColumn(f"tibia_r_imu_{k}").to_numpy() for k in (2, 3, 4, 1)])
    assert (Rotation.from_quat(found).inv() * truth[2]).magnitude().max() < 1e-6
    angles = truth[2].as_matrix()[:, 2]  # the vertical in the sensor's axes is Z: roll and pitch are measured from it
    assert np.allclose(Rotation.from_quat(found).as_matrix()[:, 2], angles, atol=1e-7)


def test_opensim_reads_motion_and_markers(estimate, truth, tmp_path):
    opensim = importlib.import_module("opensim")
    convert(estimate, tmp_path / "out.mot")
    table = opensim.TimeSeriesTable(str(tmp_path / "out.mot"))
    own = read_table(estimate).columns
    assert list(table.getColumnLabels()) == [name for name in own if name != "time_s"]
    assert np.allclose(table.getDependentColumn("tilt_height_m").to_numpy(), own["tilt_height_m"])
    convert(estimate, tmp_path / "out.trc", "joint-inertial")
    markers = opensim.TimeSeriesTableVec3(str(tmp_path / "out.trc"))
    assert list(markers.getColumnLabels()) == ["sensor_imu_O", "sensor_imu_X", "sensor_imu_Y"]
    assert markers.getNumRows() == ROWS - 3
    first = markers.getRowAtIndex(0)
    x, y, height = 1000 * truth[1][0]
    assert [first[0].get(k) for k in range(3)] == pytest.approx([x, height, -y], abs=1e-3)


def test_ezc3d_reads_the_markers(estimate, truth, tmp_path):
    ezc3d = importlib.import_module("ezc3d")
    convert(estimate, tmp_path / "out.c3d", "joint-inertial")
    file = ezc3d.c3d(str(tmp_path / "out.c3d"))
    assert file["parameters"]["POINT"]["RATE"]["value"].tolist() == [RATE]
    assert file["parameters"]["POINT"]["UNITS"]["value"] == ["mm"]
    points = file["data"]["points"][:3].transpose(2, 1, 0) / 1000
    assert len(points) == ROWS - 3
    hidden = np.isnan(points).any(axis=(1, 2))
    assert np.flatnonzero(hidden).tolist() == list(range(97, 117))  # the samples that were lost
    assert np.allclose(points[~hidden, 0], truth[1], atol=1e-6)
    rotations = truth[2].as_matrix()
    assert np.allclose(points[~hidden, 1] - points[~hidden, 0], 0.1 * rotations[:, :, 0], atol=1e-6)
    assert np.allclose(points[~hidden, 2] - points[~hidden, 0], 0.1 * rotations[:, :, 1], atol=1e-6)


def test_evo_reads_the_trajectory(estimate, truth, tmp_path):
    file_interface = importlib.import_module("evo.tools.file_interface")
    convert(estimate, tmp_path / "out.tum", "joint-inertial")
    found = file_interface.read_tum_trajectory_file(str(tmp_path / "out.tum"))
    assert np.allclose(found.timestamps, truth[0]) and np.allclose(found.positions_xyz, truth[1])
    turned = Rotation.from_quat(found.orientations_quat_wxyz[:, [1, 2, 3, 0]])
    assert (turned.inv() * truth[2]).magnitude().max() < 1e-6


def test_mcap_holds_poses_and_values(estimate, truth, tmp_path):
    reader = importlib.import_module("mcap.reader")
    convert(estimate, tmp_path / "out.mcap", "joint-inertial")
    with (tmp_path / "out.mcap").open("rb") as file:
        messages = [(s.name, m.log_time, json.loads(m.data)) for s, _, m in reader.make_reader(file).iter_messages()]
    poses = [(time, data) for name, time, data in messages if name == "foxglove.PoseInFrame"]
    assert [time for time, _ in poses] == [round(t * 1e9) for t in truth[0].tolist()]
    place = [[data["pose"]["position"][axis] for axis in "xyz"] for _, data in poses]
    assert np.allclose(place, truth[1])
    values = [data for name, _, data in messages if name == "linkpose.Values"]
    assert len(values) == ROWS - 20 and "joint_inertial_height_m" not in values[0]
    assert values[5]["joint_inertial_height_m"] == 1.5


def test_parquet_is_the_same_table(estimate, tmp_path):
    pq = importlib.import_module("pyarrow.parquet")
    convert(estimate, tmp_path / "out.parquet")
    own, found = read_table(estimate), read_table(tmp_path / "out.parquet", "estimate")
    assert (found.kind, found.metadata, found.closing) == (own.kind, own.metadata, own.closing)
    assert list(found.columns) == list(own.columns)
    assert all(np.array_equal(found.columns[name], own.columns[name], equal_nan=True) for name in own.columns)
    assert (
        pq.read_table(tmp_path / "out.parquet").to_pandas()["tilt_height_m"].tolist()
        == own.columns["tilt_height_m"].tolist()
    )
    (tmp_path / "cut.parquet").write_bytes((tmp_path / "out.parquet").read_bytes()[:200])
    with pytest.raises(FileFormatError, match="no Parquet table"):
        read_table(tmp_path / "cut.parquet")


def test_a_file_is_converted_in_blocks(estimate, tmp_path, monkeypatch):
    """Blocks end before, in and after the lost samples, and after the last frame that a pose reaches."""
    endings = (".sto", ".mot", ".trc", ".tum")
    for ending in endings:
        convert(estimate, tmp_path / f"whole{ending}")
    convert(estimate, tmp_path / "whole.parquet")
    for size in (1_000, 1_700):
        monkeypatch.setattr(chunks, "CHUNK_BYTES", size)
        shares: list[float] = []
        for ending in endings:
            convert(estimate, tmp_path / f"whole_{ending}", force=True, progress=shares.append)
            whole = (tmp_path / f"whole{ending}").read_text().replace("whole", "whole_")
            assert (tmp_path / f"whole_{ending}").read_text() == whole
        assert len(shares) > 40 and max(shares) == 1
        convert(estimate, tmp_path / "parts.parquet", force=True)
        found, own = (read_table(tmp_path / f"{name}.parquet") for name in ("parts", "whole"))
        assert all(np.array_equal(found.columns[name], own.columns[name], equal_nan=True) for name in own.columns)


@pytest.mark.filterwarnings("error")
def test_a_signalling_nan_of_a_parquet_file_is_a_missing_value(tmp_path):
    """NumPy warns in sums and in `any` of such a value; one flipped bit of an infinity makes it."""
    pa, pq = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    height = np.array([0x7FF0000000000001, 0], dtype=np.uint64).view(np.float64)
    pq.write_table(pa.table({"time_s": [0.0, 0.01], "height_m": height}), tmp_path / "run.parquet")
    found = read_table(tmp_path / "run.parquet").columns["height_m"]
    assert np.isnan((found + 1.0)[0]) and found.any() and found[1] == 0.0


def test_a_damaged_parquet_file_is_named(tmp_path):
    pa, pq = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    path = tmp_path / "run.parquet"
    pq.write_table(pa.table({"time_s": [0.0, 0.01]}), path, use_dictionary=False, compression="none")
    data = path.read_bytes()
    assert data[4:6] == b"\x15\x00"  # the type of the first page: data
    for damaged, sentence in (
        (data[:5] + b"\x02" + data[6:], "has no row"),  # an index page, which readers skip
        (data.replace(b"time_s", b"\xe3ime_s"), "no Parquet table of numbers"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=sentence):
            read_table(path)


def test_what_cannot_be_converted_is_named(estimate, tmp_path, monkeypatch):
    with pytest.raises(UnknownFilter, match="did you mean joint-inertial"):
        convert(estimate, tmp_path / "a.tum", "joint-inertia")
    with pytest.raises(InvalidValue, match="the formats are"):
        convert(estimate, tmp_path / "a.xlsx")
    (tmp_path / "run.csv").write_text("time_s,accel_x_m_s2\n0,1\n1,1\n")
    with pytest.raises(LinkposeError, match="has no orientation"):
        convert(tmp_path / "run.csv", tmp_path / "a.sto")
    (tmp_path / "jump.csv").write_text("time_s,roll_deg,pitch_deg\n0,1,1\n0.01,1,1\n0.02,1,1\n1e9,1,1\n")
    with pytest.raises(LinkposeError, match="cut the file at its longest gap"):
        convert(tmp_path / "jump.csv", tmp_path / "a.trc")
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(MissingLibrary, match=r'pip install "linkpose\[files\]"'):
        convert(estimate, tmp_path / "a.c3d")
    assert not (tmp_path / "a.c3d").exists() and not (tmp_path / "a.trc").exists()


def test_the_command_keeps_an_existing_file(estimate, tmp_path):
    out = tmp_path / "out.tum"
    arguments = [str(estimate), "-o", str(out), "--filter", "tilt"]
    first = CliRunner().invoke(command, arguments)
    assert first.exit_code == 0 and "tilt does not estimate yaw" in first.stderr
    before = out.read_bytes()
    second = CliRunner().invoke(command, arguments)
    assert isinstance(second.exception, FileExists) and out.read_bytes() == before
    assert CliRunner().invoke(command, [*arguments, "--force", "-q"]).exit_code == 0
