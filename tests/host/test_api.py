"""The Python face: what a program imports, what it gets, and which errors it gets."""

from __future__ import annotations

import json
import os
import re
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import linkpose as lp
from linkpose import errors
from linkpose.filters.joint import JointFilter
from linkpose.sensors.rig import Mouse, Rig

HOST = Path(__file__).parents[2] / "host"
DOCS = HOST / "docs"
J2S = (-0.09, -0.04, 1.65)


@pytest.fixture(scope="module")
def swing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the simulated board, made through the Python face."""
    path = tmp_path_factory.mktemp("api") / "swing.csv"
    with lp.open("sim://link?seed=2", record=path) as board:
        assert sum(len(block) for block in board.stream(duration_s=0.5)) == 50
        assert (board.health.samples, board.health.lost) == (50, 0)
    return path


def test_estimates_are_reached_by_column_and_by_filter(swing: Path, tmp_path: Path) -> None:
    for source in (str(swing), swing, lp.load(str(swing)), lp.load(swing)):
        estimates = lp.estimate(source, filters=["tilt"], j2s_m=J2S)
        assert len(estimates) == 50 and estimates.filters == ("tilt",)
        assert estimates["tilt_height_m"] is not None
        assert np.array_equal(estimates["tilt_height_m"], estimates.tilt.height_m)
        assert estimates.tilt.height_m[0] == pytest.approx(1.64, abs=0.05)
        assert (estimates.tilt.height_std_m > 0).all()
    with pytest.raises(KeyError, match="no column heigth"):
        estimates["heigth"]
    with pytest.raises(AttributeError, match="no filter joint"):
        estimates.joint  # noqa: B018
    with pytest.raises(AttributeError, match="there are height_m"):
        estimates.tilt.heigth_m  # noqa: B018
    frame = estimates.to_pandas()
    assert tuple(frame.columns) == estimates.columns and len(frame) == 50
    np.testing.assert_array_equal(frame["tilt_height_m"].to_numpy(), estimates["tilt_height_m"])
    estimates.save(tmp_path / "heights.csv")
    with pytest.raises(errors.FileExists):
        estimates.save(tmp_path / "heights.csv")
    assert (tmp_path / "heights.csv").read_text().startswith("# linkpose estimate 1")


def test_measurements_of_ones_own_sensor_are_checked() -> None:
    time, vectors = np.arange(5) / 100, np.ones((5, 3))
    block = lp.Measurements.from_imu(time.tolist(), vectors, vectors)
    assert len(block) == 5
    for bad, named in (
        ((time, vectors[:4], vectors), "accel_m_s2 has the shape"),
        ((time, vectors, vectors[:, :2]), "gyro_rad_s has the shape"),
        ((time[::-1], vectors, vectors), "time_s is 0.03 at index 1; times must"),
        (([0, 1, np.nan, 3, 4], vectors, vectors), "time_s is nan at index 2"),
        ((time[:, None], vectors, vectors), "time_s has the shape"),
        ((time.astype("datetime64[s]"), vectors, vectors), "time_s has the type datetime64"),
        ((time, vectors + 0j, vectors), "accel_m_s2 is complex"),
        ((time, vectors, [["1", "2", "x"]] * 5), "gyro_rad_s is no array of numbers"),
        ((time, vectors, [[1.0], [2.0, 3.0]]), "gyro_rad_s is no array of numbers"),
    ):
        with pytest.raises(errors.InvalidValue, match=named) as raised:
            lp.Measurements.from_imu(*bad)
        assert isinstance(raised.value, ValueError) and raised.value.name in named


def test_a_masked_reading_is_missing() -> None:
    masked = np.ma.MaskedArray(np.ones((5, 3)), mask=np.arange(15).reshape(5, 3) == 4)
    block = lp.Measurements.from_imu(np.arange(5) / 100, masked, np.ones((5, 3)))
    assert np.argwhere(np.isnan(block.accel_m_s2)).tolist() == [[1, 1]]
    assert (block.flags != 0).tolist() == [True, False, True, True, True]


@pytest.mark.parametrize(
    ("factors", "remark"),
    [
        ((1, 1, 1), None),
        ((1, 1 / 9.80665, 1), "is it in g?"),
        ((1000, 1, 1), "is it in milliseconds?"),
        ((1, 1, 180 / np.pi), "is it in °/s?"),
    ],
)
def test_values_of_another_unit_are_remarked_on(swing: Path, factors: tuple[float, ...], remark: str | None) -> None:
    """The same for arrays as for a file, whose own remarks reach the estimates."""
    own = lp.load(swing).measurements
    gyro = own.gyro_rad_s + np.array([1.0, 0.0, 0.0])
    arrays = (own.time_s, own.accel_m_s2, gyro)
    measurements = lp.Measurements.from_imu(*(a * factor for a, factor in zip(arrays, factors, strict=True)))
    if remark is None:
        assert not lp.estimate(measurements, "tilt").remarks
        return
    with pytest.warns(UserWarning, match=re.escape(remark)):
        estimates = lp.estimate(measurements, "tilt")
    assert remark in "".join(estimates.remarks)


def test_remarks_of_a_file_reach_its_estimates(swing: Path, tmp_path: Path) -> None:
    *lines, _closing = swing.read_text().splitlines()
    cut = tmp_path / "cut.csv"
    cut.write_text("\n".join(lines) + "\n")
    with pytest.warns(UserWarning, match=re.escape("cut.csv")):
        estimates = lp.estimate(cut, "tilt")
    assert list(estimates.remarks) == lp.load(cut).remarks


@pytest.mark.parametrize(
    ("source", "more", "sentence"),
    [
        (None, {}, "source is of the type NoneType; it must be a path, a Recording or Measurements"),
        (np.ones((5, 7)), {}, "source is of the type ndarray"),
        (lp.Measurements.from_imu([], np.empty((0, 3)), np.empty((0, 3))), {}, "source holds no sample"),
        ("swing", {"j2s_m": (9, 4, 165)}, "longer than 10 m; it must be in metres"),
        ("swing", {"j2s_m": (0, 0, 0)}, 'the joint\'s centre; if J2S is unknown, give "auto"'),
        ("swing", {"j2s_m": (0, 0, "a")}, "it must be three finite numbers"),
    ],
)
def test_wrong_arguments_of_estimate_are_named(swing: Path, source: Any, more: dict[str, Any], sentence: str) -> None:
    with pytest.raises(errors.InvalidValue, match=sentence):
        lp.estimate(swing if isinstance(source, str) else source, "tilt", **more)


def test_errors_carry_their_facts(swing: Path, tmp_path: Path) -> None:
    still = lp.Measurements.from_imu(np.arange(20) / 100, np.tile([0, 0, 9.81], (20, 1)), np.zeros((20, 3)))
    with pytest.raises(errors.FilterCannotRun) as cannot:
        lp.estimate(still, filters=["joint"])
    assert isinstance(cannot.value.reason, errors.MissingJ2S) and cannot.value.filter == "joint"
    with pytest.raises(errors.FilterCannotRun) as uncertain:
        lp.estimate(still, filters=["joint"], j2s_m="auto")
    assert isinstance(uncertain.value.reason, errors.UncertainJ2S)
    with pytest.raises(errors.FilterCannotRun) as absent:
        lp.estimate(still, filters=["baro"])
    assert isinstance(absent.value.reason, errors.SensorMissing)
    with pytest.raises(errors.MissingJ2S) as direct:  # the class without the registry
        JointFilter(lp.Rig())
    assert direct.value.filter == "joint"
    with pytest.raises(errors.UnknownFilter, match="did you mean tilt") as unknown:
        lp.create_filter("tlit", lp.Rig())
    assert unknown.value.name == "tlit" and "tilt" in unknown.value.known
    with pytest.raises(errors.CannotRead) as missing:
        lp.load(tmp_path / "none.csv")
    assert missing.value.path == str(tmp_path / "none.csv")
    with pytest.raises(errors.FileExists), lp.open("sim://link", record=swing):
        pass
    with pytest.raises(errors.PortNotFound) as port:
        lp.open("/dev/ttyNONE")
    assert port.value.port == "/dev/ttyNONE"
    for bad in ((1, 2), (1, 2, np.nan), "otto"):
        with pytest.raises(errors.InvalidValue):
            lp.estimate(still, filters=["tilt"], j2s_m=bad)
    with pytest.raises(errors.InvalidValue):
        lp.estimate(still, filters=["tilt"], j2s_m=J2S, j2s_std_m=0.0)


def test_no_sentence_of_the_library_names_a_flag() -> None:
    """Flags are the command line's: cli/cures.py adds them."""
    flag = re.compile(r"""["' (`]--[a-z]""")
    found = [
        f"{path.relative_to(HOST)}:{number}"
        for path in (HOST / "linkpose").rglob("*.py")
        if "cli" not in path.parts
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if flag.search(line) and ("raise " in line or "Error(" in line)
    ]
    assert not found


def test_importing_linkpose_imports_neither_numpy_nor_numba() -> None:
    code = "import sys, linkpose; print([m for m in ('numpy', 'numba', 'serial', 'click') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=HOST, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert set(lp.__all__) <= set(dir(lp))
    with pytest.raises(AttributeError):
        lp.nothing_of_this_name  # noqa: B018


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def write_drive(folder: Path) -> None:
    """log.csv, beacons.csv and truth.csv of a robot that drives 1 m/s along x among four beacons."""
    beacons = {"1": (0, 5), "2": (0, -5), "3": (20, 5), "4": (20, -5)}
    rows = ["0,pose,0,0,0"]
    for i in range(20):
        rows.append(f"{i},odometry,1,0,")
        rows += [f"{i},range,{name},{np.hypot(x - i, y):.3f}," for name, (x, y) in beacons.items()]
    (folder / "log.csv").write_text("\n".join(["time_s,kind,a,b,c", *rows]) + "\n")
    places = [f"{name},{x},{y}" for name, (x, y) in beacons.items()]
    (folder / "beacons.csv").write_text("\n".join(["id,x_m,y_m", *places]) + "\n")
    (folder / "truth.csv").write_text("\n".join(["time_s,x_m,y_m", *(f"{i},{i},0" for i in range(20))]) + "\n")


def test_the_page_on_python_runs(swing: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "swing.csv").write_bytes(swing.read_bytes())
    write_drive(tmp_path)
    namespace: dict[str, object] = {}
    blocks = python_blocks(DOCS / "python.md")
    assert len(blocks) >= 5
    for block in blocks:
        exec(block, namespace)


@pytest.mark.parametrize("name", [path.name for path in sorted((DOCS / "notebooks").glob("*.ipynb"))])
def test_a_notebook_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((DOCS / "notebooks" / name).read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    namespace: dict[str, object] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec("".join(cell["source"]), namespace)


def test_a_rig_is_saved_whole_and_read_back_equal(tmp_path: Path) -> None:
    rig = Rig(mouse=(Mouse(0.1, -0.2, 90.0, 7999.5),)).with_j2s((1e-17, 0.1 + 0.2, -1.65))
    path = tmp_path / "rig.toml"
    rig.save(path)
    assert lp.Rig.load(path) == rig == lp.Rig.load(str(path))
    path.chmod(0o640)
    link = tmp_path / "link.toml"
    link.symlink_to(path)
    Rig().save(link)
    assert link.is_symlink() and lp.Rig.load(path) == Rig()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.toml", "rig.toml"]
    for target in (tmp_path, Path(os.devnull)):
        with pytest.raises(errors.CannotWrite):
            rig.save(target)


@pytest.mark.parametrize("value", ["1" + "0" * 400, "1e200", "nan", "true", '"x"', "[" * 50 + "]" * 50])
def test_an_impossible_number_in_a_rig_is_one_short_sentence(tmp_path: Path, value: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(f"[imu]\ngyro_noise_rad_s = {value}\n")
    with pytest.raises(errors.FileFormatError) as refused:
        lp.Rig.load(path)
    assert "gyro_noise_rad_s" in str(refused.value) and len(str(refused.value)) < 300
