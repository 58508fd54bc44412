"""evaluate: errors that are known beforehand, clocks that differ, gaps, and files that are not what they should be."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from linkpose.cli.cures import sentence
from linkpose.cli.evaluate import command
from linkpose.cli.plot import command as plot
from linkpose.errors import LinkposeError
from linkpose.evaluation.motive import read_motive
from linkpose.evaluation.references import read_any
from linkpose.simulation.link import LinkRun

T = np.arange(0, 30, 0.01)


def height(t):
    return 1.5 + 0.1 * np.sin(2 * np.pi * 0.6 * t) + 0.05 * np.sin(2 * np.pi * 0.23 * t + 1)


def write(path, columns, kind=None):
    head = f"# linkpose {kind} 1\n# {{}}\n" if kind else ""
    rows = np.column_stack(list(columns.values()))
    text = "\n".join(",".join("" if np.isnan(v) else f"{v:.9f}" for v in row) for row in rows)
    path.write_text(f"{head}{','.join(columns)}\n{text}\n")
    return str(path)


def scores(*paths):
    result = CliRunner().invoke(command, [*paths, "--json"], catch_exceptions=False)
    return {row["filter"]: row for row in map(json.loads, result.stdout.splitlines())}


def rmse(score):
    """A filter's row without the details of each quantity."""
    return {
        key: value for key, value in score.items()
        if not key.endswith(("_nees", "_within_2sigma", "known_rows", "empty_rows")) and key != "quantities"
    }  # fmt: skip


def complaints(*paths):
    """The messages on stderr."""
    return CliRunner().invoke(command, [*paths, "--json"], catch_exceptions=False).stderr


@pytest.fixture
def reference(tmp_path):
    return write(
        tmp_path / "truth.csv",
        {"time_s": T, "height_m": height(T), "roll_deg": 10 * np.sin(T), "pitch_deg": 5 * np.cos(T)},
        "truth",
    )


def estimate(tmp_path, **more):
    columns = {"time_s": T, "joint_height_m": height(T) + 0.02, "joint_roll_deg": 10 * np.sin(T) - 3}
    return write(tmp_path / "estimate.csv", columns | more, "estimate")


def test_known_errors(tmp_path, reference):
    noisy = height(T) + 0.05 * np.sqrt(2) * np.sin(2 * np.pi * T)
    path = estimate(tmp_path, imu_baro_height_m=noisy, imu_baro_height_std_m=np.ones(len(T)))
    found = scores(path, reference)
    assert list(found) == ["joint", "imu-baro"]
    assert rmse(found["joint"]) == {
        "filter": "joint", "rows": 3000, "height_rmse_cm": pytest.approx(2.0), "roll_rmse_deg": pytest.approx(3.0),
        "time_offset_s": 0.0,
    }  # fmt: skip
    assert found["imu-baro"]["height_rmse_cm"] == pytest.approx(5.0, rel=0.01)
    assert "roll_rmse_deg" not in found["imu-baro"]


@pytest.mark.parametrize("offset_s", [0.237, -3.1234, 0.0162, 12345.678])
def test_clocks_that_differ_are_aligned_to_a_fraction_of_a_sample(tmp_path, offset_s):
    reference = write(tmp_path / "truth.csv", {"time_s": T + offset_s, "height_m": height(T)})
    found = scores(estimate(tmp_path), reference)["joint"]
    assert found["time_offset_s"] == pytest.approx(offset_s, abs=5e-4)
    assert found["height_rmse_cm"] == pytest.approx(2.0, abs=0.01)


def test_another_rate_and_an_offset(tmp_path):
    t = np.arange(-4, 40, 1 / 120)
    reference = write(tmp_path / "truth.csv", {"time_s": t + 7.5, "height_m": height(t)})
    assert scores(estimate(tmp_path), reference)["joint"]["time_offset_s"] == pytest.approx(7.5, abs=5e-4)


def test_a_reference_that_comes_rarely_is_compared_at_its_own_instants(tmp_path):
    """Lines between its 5 readings a second would miss the motion by millimetres."""
    t = T[::20] + 0.003
    reference = write(tmp_path / "truth.csv", {"time_s": t, "height_m": height(t)})
    found = scores(estimate(tmp_path), reference)["joint"]
    assert found["time_offset_s"] == 0
    assert found["rows"] == len(t)
    assert found["height_rmse_cm"] == pytest.approx(2.0, abs=0.005)


def test_files_of_different_runs_are_scored_and_doubted(tmp_path, reference):
    rng = np.random.default_rng(3)
    other = np.convolve(rng.standard_normal(len(T) + 60), np.ones(61) / 61, "valid")
    path = write(tmp_path / "other.csv", {"time_s": T, "joint_height_m": 1.5 + other})
    assert scores(path, reference)["joint"]["height_rmse_cm"] > 5
    assert "are they of the same run?" in complaints(path, reference)
    assert complaints(estimate(tmp_path), reference) == ""


def test_a_lag_of_the_filter_is_its_own_fault(tmp_path, reference):
    """Half a sample is not taken for a clock's offset."""
    path = write(tmp_path / "late.csv", {"time_s": T, "joint_height_m": height(T - 0.004)})
    found = scores(path, reference)["joint"]
    assert found["time_offset_s"] == 0
    assert found["height_rmse_cm"] == pytest.approx(100 * np.std(height(T - 0.004) - height(T)), rel=0.01)


def test_bad_first_rows_are_not_pushed_out_of_the_comparison(tmp_path, reference):
    """A filter that starts 2 m too low is scored with those rows: no offset is found between identical clocks."""
    late = height(T) + 0.01 * np.cos(2 * np.pi * T)
    late[:2] -= 2.0
    found = scores(write(tmp_path / "estimate.csv", {"time_s": T, "joint_height_m": late}), reference)["joint"]
    assert found["time_offset_s"] == 0
    assert found["rows"] == len(T)
    assert found["height_rmse_cm"] == pytest.approx(100 * np.sqrt(np.mean((late - height(T)) ** 2)))


def test_gaps_and_missing_values_are_left_out(tmp_path):
    h = height(T)
    h[1000:1100] = np.nan
    kept = np.ones(len(T), bool)
    kept[2000:2200] = False
    reference = write(tmp_path / "truth.csv", {"time_s": T[kept], "height_m": h[kept]})
    ours = height(T) + 0.02
    ours[:50] = np.nan
    path = write(tmp_path / "estimate.csv", {"time_s": T, "tilt_height_m": ours})
    found = scores(path, reference)["tilt"]
    assert found["rows"] == 3000 - 50 - 100 - 200
    assert found["height_rmse_cm"] == pytest.approx(2.0)


def test_a_quantity_that_was_never_estimated_is_left_out(tmp_path, reference):
    path = estimate(tmp_path, joint_height_m=np.full(len(T), np.nan), joint_roll_deg=0 * T)
    assert "height_rmse_cm" not in scores(path, reference)["joint"]


def test_angles_are_compared_on_the_circle(tmp_path):
    turning = (np.degrees(T) + 180) % 360 - 180
    ahead = (np.degrees(T) + 182) % 360 - 180
    reference = write(tmp_path / "truth.csv", {"time_s": T, "roll_deg": turning})
    path = write(tmp_path / "estimate.csv", {"time_s": T, "tilt_roll_deg": ahead})
    assert scores(path, reference)["tilt"]["roll_rmse_deg"] == pytest.approx(2.0, abs=1e-3)


def planar_truth():
    columns = {"x_m": np.sin(T), "y_m": T, "heading_rad": T, "vx_m_s": np.cos(T), "vy_m_s": np.sin(T)}
    return columns | {"wz_rad_s": np.cos(0.3 * T)}


def test_planar_filters_have_their_own_keys(tmp_path):
    reference = write(tmp_path / "truth.csv", {"time_s": T} | planar_truth())
    off = {f"ekf_{name}": value + 0.3 for name, value in planar_truth().items()}
    path = write(tmp_path / "estimate.csv", {"time_s": T} | off)
    found = scores(path, reference)["ekf"]
    assert rmse(found) == {
        "filter": "ekf", "rows": 3000, "velocity_rmse_m_s": pytest.approx(0.3 * 2**0.5),
        "rate_rmse_rad_s": pytest.approx(0.3), "position_rmse_m": pytest.approx(0.3 * 2**0.5),
        "heading_rmse_rad": pytest.approx(0.3),
    }  # fmt: skip


def test_odometry_counts_from_where_the_reference_stood_at_its_start(tmp_path):
    """Moved and turned as a whole, it is right; stretched by a hundredth, it is wrong by a hundredth of the way."""
    truth = planar_truth()
    reference = write(tmp_path / "truth.csv", {"time_s": T} | truth)
    turned = np.exp(2.5j) * (truth["x_m"] + 1j * truth["y_m"]) + (3 - 4j)
    heading = np.angle(np.exp(1j * (truth["heading_rad"] + 2.5)))
    for stretch, error in ((1.0, 0.0), (1.01, 0.01 * np.sqrt(np.mean(np.sin(T) ** 2 + T**2)))):
        estimate = {"time_s": T, "mice_x_m": stretch * turned.real, "mice_y_m": stretch * turned.imag}
        path = write(tmp_path / f"{stretch}.csv", estimate | {"mice_heading_rad": heading, "mice_excluded": 0 * T})
        assert complaints(path, reference) == ""
        found = scores(path, reference)["mice"]
        assert found["position_rmse_m"] == pytest.approx(error, rel=0.01, abs=1e-6)
        assert found["heading_rmse_rad"] == pytest.approx(0, abs=1e-6)


def test_the_table_for_people(tmp_path, reference):
    shown = CliRunner().invoke(command, [estimate(tmp_path), reference]).output
    assert "joint" in shown and "height (cm)" in shown and "pitch" not in shown


@pytest.mark.parametrize(
    ("ours", "theirs", "sentence"),
    [
        ("time_s,joint_height_m\n0,1\n1,2\n", "time_s,temperature\n0,1\n", "is no reference"),
        ("time_s,joint_height_m\n0,1\n1,2\n", "time_s,roll_deg\n0,1\n1,2\n", "no filter in"),
        ("time_s,height_m\n0,1\n1,2\n", "time_s,height_m\n0,1\n1,2\n", "holds no estimates"),
        ("joint_height_m\n0\n", "time_s,height_m\n0,1\n", "no column time_s"),
        ("time_s,joint_height_m\n0,1\n1,x\n", "time_s,height_m\n0,1\n", "line 3: 'x' is not a number"),
        ("time_s,joint_height_m\n0,1\n1,2\n", "time_s,height_m\n1,1\n0,2\n", "line 3: time_s runs backwards"),
        ("time_s,joint_height_m\n0,1\n1,2,3\n", "time_s,height_m\n0,1\n", "3 fields where the header has 2"),
        ("time_s,joint_height_m\n0,1\n1,2\n", "time_s,height_m\n50,1\n51,2\n", "no instant in common"),
        ("# linkpose recording 1\n# {}\ntime_s,seq\n0,1\n1,2\n", "time_s,height_m\n0,1\n", "linkpose estimate"),
    ],
)
def test_files_that_do_not_fit_are_refused_by_name(tmp_path, ours, theirs, sentence):
    (tmp_path / "ours.csv").write_text(ours)
    (tmp_path / "theirs.csv").write_text(theirs)
    with pytest.raises(LinkposeError, match=sentence) as error:
        scores(str(tmp_path / "ours.csv"), str(tmp_path / "theirs.csv"))
    assert str(tmp_path) in str(error.value)


def test_a_filter_without_an_estimate_is_named(tmp_path):
    """J2S of a link that turns about one axis: the filter has no height, and its columns are empty."""
    ours, theirs = tmp_path / "ours.csv", tmp_path / "theirs.csv"
    heights = [(0.1 * at, 1 + 0.1 * np.sin(0.3 * at)) for at in range(60)]
    theirs.write_text("time_s,height_m\n" + "".join(f"{t:.1f},{height:.4f}\n" for t, height in heights))
    ours.write_text("time_s,joint_height_m,tilt_height_m\n" + "".join(f"{t:.1f},,\n" for t, _ in heights))
    shown = CliRunner().invoke(command, [str(ours), str(theirs)])
    assert "joint estimated no height" in str(shown.exception) and "--j2s auto" in sentence(shown.exception)
    rows = "".join(f"{t:.1f},,{height:.4f}\n" for t, height in heights)
    ours.write_text("time_s,joint_height_m,tilt_height_m\n" + rows)
    shown = CliRunner().invoke(command, [str(ours), str(theirs)])
    assert shown.exit_code == 0 and "joint estimated no height" in shown.stderr and "tilt" in shown.stdout


# ---- OptiTrack Motive ----


def motive(path, run, time_s, unit="Millimeters", markers=3, noise_m=0.0):
    """The export of three markers on the sensor of a simulated link: in millimetres, Y up, with a hidden marker."""
    tilt = run.at(time_s).tilt
    x = np.cross(np.cross(tilt, [1.0, 0, 0]), tilt)  # heading does not matter to the tilt
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    axes = np.stack([x, np.cross(tilt, x), tilt], axis=1)  # n's axes seen in s
    place = [np.array(run.j2s_m) + offset for offset in ([0, 0, 0], [0.1, 0, 0], [0.02, 0.08, 0])]
    rows, rng = [], np.random.default_rng(1)
    for t, rotation in zip(time_s, axes, strict=True):
        cells = [f"{len(rows)}", f"{t:.6f}"]
        for d in place[:markers]:
            east, north, up = rotation @ d + [0.3, -0.2, 0.7] + noise_m * rng.standard_normal(3)
            cells += [f"{1000 * value:.4f}" for value in (east, up, -north)]
        rows.append(cells)
    rows[40][5] = ""
    head = [
        ["Format Version", "1.23", "Take Name", "link", "Length Units", unit, "Coordinate Space", "Global"],
        [],
        ["", "Type", *["Marker"] * 3 * markers],
        ["", "Name", *[f"Plate:{i}" for i in range(markers) for _ in "xyz"]],
        ["", "", *["Position"] * 3 * markers],
        ["Frame", "Time (Seconds)", *["X", "Y", "Z"] * markers],
    ]
    path.write_text("\n".join(",".join(row) for row in head + rows) + "\n")
    return str(path)


def test_motive_export_as_reference(tmp_path):
    """Another clock, another rate, another origin, millimetres, Y up."""
    run = LinkRun(2, 1, 30.0)
    truth = run.truth()
    path = write(
        tmp_path / "estimate.csv",
        {"time_s": truth.time_s, "joint_height_m": truth.height_m + 0.01, "joint_roll_deg": truth.roll_deg,
         "joint_pitch_deg": truth.pitch_deg + 0.5},
    )  # fmt: skip
    found = scores(path, motive(tmp_path / "take.csv", run, np.arange(0, 30, 1 / 120)))["joint"]
    assert found["height_rmse_cm"] == pytest.approx(1.0, abs=0.02)
    assert found["roll_rmse_deg"] == pytest.approx(0, abs=0.02)
    assert found["pitch_rmse_deg"] == pytest.approx(0.5, abs=0.01)


def rigid_body(path, run, time_s, up="y", separator=",", decimal="."):
    """The export of a rigid body alone, created upright, in centimetres; not tracked in its first frames."""
    tilt = run.at(time_s).tilt
    x = np.cross(np.cross(tilt, [1.0, 0, 0]), tilt)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    axes = np.stack([x, np.cross(tilt, x), tilt], axis=1)  # n's axes seen in s: turns s into n
    room = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) if up == "y" else np.eye(3)  # east, north, up -> room
    head = ["Format Version", "1.24", "Rotation Type", "Quaternion", "Length Units", "Centimeters"]
    titles = ["Frame", "Time (Seconds)", "X", "Y", "Z", "W", "X", "Y", "Z", ""]
    parts = ["", "", *["Rotation"] * 4, *["Position"] * 3, "Mean Marker Error"]
    rows = [head, [], ["", "Type", *["Rigid Body"] * 8], ["", "Name", *["plate"] * 8], parts, titles]
    for i, (t, rotation) in enumerate(zip(time_s, axes, strict=True)):
        quaternion = Rotation.from_matrix(room @ rotation @ room.T).as_quat()
        position = 100 * (room @ (rotation @ np.array(run.j2s_m) + [0.3, -0.2, 0.7]))
        cells = [f"{value:.6f}".replace(".", decimal) for value in (t, *quaternion, *position)]
        rows.append([str(i), *cells, ""] if i > 5 else [str(i), cells[0], *[""] * 8])
    path.write_text("\r\n".join(separator.join(row) for row in rows) + "\r\n", encoding="utf-8-sig")
    return path


@pytest.mark.parametrize(("up", "separator", "decimal"), [("y", ",", "."), ("z", ";", ","), ("y", "\t", ",")])
def test_a_rigid_body_alone_is_a_reference(tmp_path, up, separator, decimal):
    run, time_s = LinkRun(2, 1, 30.0), np.arange(0, 30, 1 / 50)
    found = read_any(rigid_body(tmp_path / "take.csv", run, time_s, up, separator, decimal), up)
    truth = run.at(time_s)
    height = truth.tilt @ np.array(run.j2s_m)
    assert np.isnan(found.columns["height_m"][:6]).all()
    assert np.allclose(found.columns["height_m"][6:], height[6:], atol=1e-4)
    roll = np.degrees(np.arctan2(truth.tilt[:, 1], truth.tilt[:, 2]))
    assert np.allclose(found.columns["roll_deg"][6:], roll[6:], atol=1e-3)
    pitch = np.degrees(np.arcsin(-truth.tilt[:, 0]))
    assert np.allclose(found.columns["pitch_deg"][6:], pitch[6:], atol=1e-3)
    assert any("rigid body plate is the reference" in remark for remark in found.remarks)


def test_a_rigid_body_that_is_never_tracked_is_named(tmp_path):
    path = rigid_body(tmp_path / "take.csv", LinkRun(2, 1, 30.0), np.arange(5) / 50)
    with pytest.raises(LinkposeError, match="no frame with the rigid body"):
        read_motive(path)


def test_motive_exports_in_another_frame_are_doubted(tmp_path):
    """Y for Z upwards, and two markers in each other's place: scored, but not without a word."""
    run = LinkRun(2, 1, 30.0)
    truth = run.truth()
    path = write(
        tmp_path / "estimate.csv",
        {"time_s": truth.time_s, "joint_height_m": truth.height_m, "joint_roll_deg": truth.roll_deg,
         "joint_pitch_deg": truth.pitch_deg},
    )  # fmt: skip
    take = motive(tmp_path / "take.csv", run, np.arange(0, 30, 1 / 50))
    assert complaints(path, take) == ""
    result = CliRunner().invoke(command, [path, take, "--up", "z"], catch_exceptions=False)
    assert "try the other axis with --up" in result.stderr
    output = complaints(path, edited(take, with_markers_swapped))
    assert "widest angle is at marker 2" in output and "check the order of the markers" in output


def swinging(angle_x, angle_y):
    """A link of 0.3 m whose z axis leans by these angles (N,) (rad), as `motive` takes runs."""
    z = np.column_stack([np.sin(angle_y), np.cos(angle_y) * np.sin(angle_x), np.cos(angle_y) * np.cos(angle_x)])
    return SimpleNamespace(j2s_m=(0.0, 0.0, 0.3), at=lambda _: SimpleNamespace(tilt=z))


def test_noise_of_the_markers_does_not_pull_the_joint(tmp_path):
    """A cap of the sphere, 1 mm of noise: a fit of |p|², linear in the centre, puts the joint 5 mm too high."""
    t = np.arange(0, 30, 1 / 100)
    run = swinging(0.35 * np.sin(3 * t), 0.35 * np.sin(2.3 * t + 1))
    found = read_motive(Path(motive(tmp_path / "take.csv", run, t, noise_m=0.001))).columns["height_m"]
    assert np.nanmean(found - 0.3 * run.at(t).tilt[:, 2]) == pytest.approx(0, abs=0.0015)


T60 = np.arange(0, 60, 1 / 50)


@pytest.mark.parametrize(
    "run",
    [
        swinging(0 * T60, 0 * T60),
        swinging(0.02 * np.sin(3 * T60), 0.02 * np.sin(2.3 * T60)),
        swinging(np.arctan(0.5 * np.sin(T60)), np.arctan2(np.cos(T60), np.hypot(2, np.sin(T60)))),
    ],
    ids=["at rest", "hardly tilted", "turned about the vertical"],
)
@pytest.mark.parametrize("noise_m", [0.0, 0.0003, 0.003])
def test_motion_that_tells_no_joint_is_refused(tmp_path, run, noise_m):
    with pytest.raises(LinkposeError, match=r"marker 1 hardly moves|tilt the link further"):
        read_motive(Path(motive(tmp_path / "take.csv", run, T60, noise_m=noise_m)))


def test_a_link_that_swings_in_one_plane_tells_the_height_of_its_joint(tmp_path):
    run = swinging(0.4 * np.sin(3 * T60), 0 * T60)
    found = read_motive(Path(motive(tmp_path / "take.csv", run, T60))).columns["height_m"]
    assert np.nanmax(np.abs(found - 0.3 * run.at(T60).tilt[:, 2])) < 0.001


def edited(path, change):
    """The export again, its lines changed."""
    lines = Path(path).read_text().splitlines()
    Path(path).write_text("\n".join(change(lines)) + "\n")
    return path


def with_time_code(lines):
    """As format 1.24 writes it: a column of time codes behind the seconds."""
    cells = [line.split(",") for line in lines]
    for i, row in enumerate(cells[2:], 2):
        row.insert(2, "" if i < 5 else "TimeCode" if i == 5 else "15:26:46:12.02")
    return [",".join(row) for row in cells]


def with_a_word(word, lines):
    cells = lines[11].split(",")
    return [*lines[:11], ",".join([*cells[:4], word, *cells[5:]]), *lines[12:]]


def with_an_old_header(lines):
    return [line.replace("Time (Seconds)", "Time") for line in lines]


def with_an_unlabeled_marker_first(lines):
    cells = [line.split(",") for line in lines]
    for i, row in enumerate(cells[2:], 2):
        cell = ["Marker", "Unlabeled 2034", "Position", *"XYZ"] if i < 6 else ["1.0", "0.3", "-2.0"]
        row[2:2] = cell[3:] if i == 5 else [cell[i - 2]] * 3 if i < 5 else cell
    return [",".join(row) for row in cells]


def with_markers_swapped(lines):
    cells = [line.split(",") for line in lines]
    swapped = [[*row[:2], *row[5:8], *row[2:5], *row[8:]] for row in cells[6:]]
    return lines[:6] + [",".join(row) for row in swapped]


@pytest.mark.parametrize("change", [with_time_code, with_an_old_header, with_an_unlabeled_marker_first])
def test_motive_exports_of_other_versions(tmp_path, change):
    run = LinkRun(2, 1, 30.0)
    t = np.arange(0, 30, 1 / 50)
    path = motive(tmp_path / "take.csv", run, t)
    usual = read_motive(Path(path)).columns
    other = read_motive(Path(edited(path, change))).columns
    for name, column in usual.items():
        assert np.array_equal(other[name], column, equal_nan=True)


def test_motive_exports_are_drawn(tmp_path):
    path = motive(tmp_path / "take.csv", LinkRun(2, 1, 30.0), np.arange(0, 30, 1 / 50))
    assert CliRunner().invoke(plot, [path], catch_exceptions=False).exit_code == 0
    assert (tmp_path / "take.png").read_bytes().startswith(b"\x89PNG")


def test_an_unlabeled_marker_is_left_out_and_said(tmp_path):
    path = motive(tmp_path / "take.csv", LinkRun(2, 1, 30.0), np.arange(0, 30, 1 / 50))
    assert "markers left out as unlabeled: 1" in complaints(
        estimate(tmp_path), edited(path, with_an_unlabeled_marker_first)
    )


def test_motive_exports_that_do_not_do(tmp_path):
    run, path = LinkRun(2, 1, 30.0), estimate(tmp_path)
    t = np.arange(0, 20, 0.05)
    with pytest.raises(LinkposeError, match="2 labeled markers"):
        scores(path, motive(tmp_path / "two.csv", run, t, markers=2))
    with pytest.raises(LinkposeError, match="has a header but no frame"):
        scores(path, edited(motive(tmp_path / "none.csv", run, t), lambda lines: lines[:6]))
    with pytest.raises(LinkposeError, match="is damaged"):
        scores(path, edited(motive(tmp_path / "damaged.csv", run, t), lambda lines: [*lines, "3,0.1\r5"]))
    for word in ("x.y", "inf", "1e300"):
        with pytest.raises(LinkposeError, match=f"line 12: '{word}' is not a number"):
            scores(path, edited(motive(tmp_path / "word.csv", run, t), partial(with_a_word, word)))
    hidden = edited(
        motive(tmp_path / "hidden.csv", run, t),
        lambda lines: lines[:6] + [",".join([*line.split(",")[:8], "", "", ""]) for line in lines[6:]],
    )
    with pytest.raises(LinkposeError, match="no frame with all three markers"):
        scores(path, hidden)
    with pytest.raises(LinkposeError, match="furlongs"):
        scores(path, motive(tmp_path / "unit.csv", run, t, unit="Furlongs"))
