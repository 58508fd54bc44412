"""plot draws what it is given; reproduce link measures what it prints."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from linkpose import plotting
from linkpose.cli import plot
from linkpose.errors import LinkposeError
from linkpose.evaluation.scores import evaluate
from linkpose.experiments import indoor, underwater
from linkpose.experiments.mice import PaperRun, paper_run
from linkpose.experiments.variants import Variant
from linkpose.localization.grid import GridMap
from linkpose.localization.surroundings import Surroundings
from linkpose.localization.tables import PathScore
from linkpose.plotting import lines
from linkpose.plotting.canvas import COLOURS, WIDTH_INCHES, label_time, legend_above, wrapped
from linkpose.plotting.panels import error_limit
from linkpose.recording.table import read_table

PNG = b"\x89PNG"


def write(path, columns, kind="estimate"):
    head = f"# linkpose {kind} 1\n# {{}}\n" + ",".join(columns)
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=head, comments="")
    return str(path)


@pytest.fixture
def estimate(tmp_path):
    t = np.arange(50) / 100
    columns = {"time_s": t, "joint_height_m": np.sin(t), "joint_height_std_m": t, "mice_x_m": t, "mice_y_m": t**2}
    return write(tmp_path / "estimate.csv", columns)


def drawn(axes):
    """Labels of an axes' legend, in order."""
    legend = axes.get_legend()
    return [text.get_text() for text in legend.get_texts()] if legend else []


def shown(axes):
    """Labels of what the axes show, named by a legend or not."""
    return list(dict.fromkeys(sorted(axes.get_legend_handles_labels()[1], key=lambda label: "±" in label)))


def y_labels(figure):
    """Labels of the y axes, each in one line."""
    return [" ".join(axes.get_ylabel().split()) for axes in figure.axes]


def link_files(tmp_path, n=600, **more):
    """An estimate of three filters that err by known amounts, and its truth."""
    t = np.arange(n) / 100
    height = 1.5 + 0.1 * np.sin(3 * t)
    columns = {"time_s": t}
    for name, error in (("joint_inertial", 0.001), ("joint", 0.01), ("imu_baro", 0.3)):
        columns |= {f"{name}_height_m": height + error * np.cos(9 * t), f"{name}_height_std_m": np.full(n, error)}
        columns |= {f"{name}_roll_deg": 10 * np.sin(t)}
    truth = {"time_s": t, "height_m": height, "roll_deg": 10 * np.sin(t), "yaw_deg": 0 * t}
    paths = (write(tmp_path / "e.csv", columns | more), write(tmp_path / "t.csv", truth, "truth"))
    return [read_table(Path(path)) for path in paths]


def test_a_link_with_its_truth_shows_height_error_and_tilt(tmp_path):
    figure, remarks = plotting.plot_tables(link_files(tmp_path))
    assert y_labels(figure) == [
        "height over the joint (m)", "height error (cm) best filter", "height error (cm) all filters", "roll (°)"
    ]  # no filter estimates the yaw  # fmt: skip
    height, best, error, _ = figure.axes
    assert [label.split()[0] for label in drawn(best)] == ["joint-inertial", "±2σ"]  # 0.1 cm beside 1 cm were a line
    assert best.get_ylim()[1] == pytest.approx(0.24) and error.get_ylim()[1] > 1.0
    assert drawn(height) == ["truth", "joint-inertial", "joint", "±2σ joint-inertial"]
    words = [label.split() for label in drawn(error)]
    assert [word[0] for word in words] == ["joint-inertial", "joint", "±2σ"] and words[0][2:] == ["cm", "rms"]
    assert [float(word[1]) for word in words[:2]] == pytest.approx([0.0707, 0.707], rel=0.02)
    assert height.get_position().height > error.get_position().height
    assert all(axes.get_shared_x_axes().joined(height, axes) for axes in figure.axes)
    assert any("imu-baro (add --filter imu-baro)" in remark for remark in remarks)
    assert "e.csv" in figure.get_suptitle() and "100 Hz" in figure.get_suptitle()
    assert "no samples lost" in figure.get_suptitle()


def test_colours_widths_and_bands_are_those_of_the_filters(tmp_path):
    figure, _ = plotting.plot_tables(link_files(tmp_path))
    height, error = figure.axes[:2]
    lines = {line.get_label(): line for line in height.lines}
    assert lines["joint-inertial"].get_color() == COLOURS["joint-inertial"]
    assert lines["joint-inertial"].get_linewidth() > lines["joint"].get_linewidth()
    assert (lines["truth"].get_color(), lines["truth"].get_linestyle()) == ("black", "--")
    band = next(c for c in error.collections if c.get_label() == "±2σ joint-inertial")
    assert np.nanmax(band.get_paths()[0].vertices[:, 1]) == pytest.approx(0.2)  # 2 × 0.1 cm
    assert (
        len({COLOURS[name] for name in ("joint-inertial", "tilt-inertial", "joint", "tilt", "imu-baro", "baro")}) == 6
    )


def test_a_filter_without_a_height_is_named_where_it_is_first_drawn(tmp_path):
    roll = 10 * np.sin(np.arange(600) / 100)
    more = {"tilt_roll_deg": roll + 1, "tilt_pitch_deg": roll, "joint_inertial_pitch_deg": roll}
    figure, _ = plotting.plot_tables(link_files(tmp_path, **more))
    roll_panel, pitch_panel = figure.axes[-2:]
    assert drawn(roll_panel) == ["truth", "joint-inertial", "joint", "tilt"]
    assert drawn(pitch_panel) == []


def test_barometric_filters_are_drawn_when_asked_for(tmp_path):
    figure, remarks = plotting.plot_tables(link_files(tmp_path), ["imu-baro"])
    assert drawn(figure.axes[0])[:2] == ["truth", "imu-baro"]
    assert not any("joint-inertial" in remark for remark in remarks)  # nobody asked for it
    with pytest.raises(LinkposeError, match="no file has the filter mice; there are joint-inertial, joint, imu-baro"):
        plotting.plot_tables(link_files(tmp_path), ["mice"])


def test_without_a_truth_the_difference_from_the_best_is_drawn(tmp_path):
    figure, _ = plotting.plot_tables(link_files(tmp_path)[:1])
    # The best filter's ±2σ has a panel of its own, where the others differ so much that it would look like a line.
    assert y_labels(figure) == ["height over the joint (m)", "±2σ (cm)", "from best (cm)", "roll (°)"]
    assert shown(figure.axes[1]) == ["joint-inertial", "±2σ joint-inertial"] and not drawn(figure.axes[1])
    assert drawn(figure.axes[2])[:2] == ["joint-inertial (best)", "joint 0.639 cm rms from it"]


def test_a_single_filter_without_a_truth_shows_its_deviation(tmp_path):
    t = np.arange(300) / 100
    path = write(tmp_path / "e.csv", {"time_s": t, "joint_height_m": np.sin(t), "joint_height_std_m": 0.01 + 0 * t})
    figure, _ = plotting.plot_tables([read_table(Path(path))])
    assert y_labels(figure) == ["height over the joint (m)", "±2σ (cm)"]
    assert shown(figure.axes[1]) == ["joint", "±2σ joint"] and not drawn(figure.axes[1])


def test_a_legend_names_what_none_above_has_named(tmp_path):
    """Stretches without a height were shaded in no panel, or in one without a legend."""
    estimate, truth = link_files(tmp_path)
    for name in estimate.columns:
        if "height" in name:
            estimate.columns[name][:60] = np.nan
    for tables in ([estimate], [estimate, truth]):
        named: set[str] = set()
        for axes in plotting.plot_tables(tables)[0].axes:
            assert ("no valid value" in shown(axes)) == (axes.get_ylabel() != "roll (°)")
            named |= set(drawn(axes))
            assert set(shown(axes)) <= named, axes.get_ylabel()


def test_errors_of_a_filter_that_reports_itself_lost_do_not_set_the_scale():
    """A start of a second flattened the errors of a minute."""
    error, std = np.full(1000, 0.1), np.full(1000, 0.1)
    error[:20], std[:20] = 100.0, 50.0
    assert error_limit([error], [std]) == pytest.approx(0.24)
    std[:20] = 0.1  # an error that σ does not announce is in view
    assert error_limit([error], [std]) > 100.0


def test_the_truth_is_in_view_where_no_filter_has_a_value(tmp_path):
    estimate, truth = link_files(tmp_path)
    for name, values in estimate.columns.items():
        if name != "time_s":
            values[np.abs(truth.columns["height_m"] - 1.5) > 0.05] = np.nan
    axes = plotting.plot_tables([estimate, truth])[0].axes[0]
    assert axes.get_ylim()[0] < truth.columns["height_m"].min() and axes.get_ylim()[1] > 1.6 - 1e-3


@pytest.mark.parametrize(
    ("length_s", "unit", "last"), [(65.0, "s", "60"), (3600.0, "min", "60"), (86400.0, "h", "20"), (700.0, "min", "10")]
)
def test_the_time_of_long_runs_is_in_minutes_or_hours(length_s, unit, last):
    figure = plotting.new_figure(3.0)
    axes = figure.add_subplot()
    axes.plot([0.0, length_s], [0.0, 1.0])
    axes.margins(x=0.0)
    label_time(axes)
    figure.draw_without_rendering()
    assert axes.get_xlabel() == f"time ({unit})"
    shown = [label.get_text() for label in axes.get_xticklabels() if 0 <= label.get_position()[0] <= length_s]
    assert shown[0] == "0" and shown[-1] == last


def test_gaps_and_unknown_values_are_shaded(tmp_path):
    estimate, _ = link_files(tmp_path)
    keep = np.r_[0:200, 300:600]
    cut = {name: column[keep] for name, column in estimate.columns.items()}
    for name in cut:
        if name != "time_s":
            cut[name][100:150] = np.nan
    np.savetxt(
        tmp_path / "cut.csv", np.column_stack(list(cut.values())), delimiter=",", header=",".join(cut), comments=""
    )
    figure, _ = plotting.plot_tables([read_table(tmp_path / "cut.csv")])
    spans = {c.get_label(): c.get_paths() for c in figure.axes[0].collections}
    (gap,), (unknown,) = spans["gap"], spans["no valid value"]
    assert gap.vertices[:, 0].min() == pytest.approx(1.99) and gap.vertices[:, 0].max() == pytest.approx(3.0)
    assert unknown.vertices[:, 0].min() == pytest.approx(1.0) and unknown.vertices[:, 0].max() == pytest.approx(1.5)
    assert "100 samples lost in 1 gap" in figure.get_suptitle()


def test_a_log_that_is_written_as_the_robot_moves_has_no_lost_samples(tmp_path):
    """Its rows have no rate: 936 gaps in the public log of the Intel laboratory, drawn over each other."""
    steps = np.random.default_rng(1).choice([0.01, 0.2, 0.5, 1.2], 400, p=[0.25, 0.4, 0.25, 0.1])
    steps[200] = 8.0
    t = np.cumsum(steps)
    file = write(tmp_path / "e.csv", {"time_s": t, "ekf_x_m": t, "ekf_y_m": t, "ekf_heading_rad": np.sin(t)})
    figure, _ = plotting.plot_tables([read_table(Path(file))])
    _, heading = figure.axes
    (gap,) = next(c for c in heading.collections if c.get_label() == "gap").get_paths()
    assert gap.vertices[:, 0].min() == pytest.approx(t[199]) and gap.vertices[:, 0].max() == pytest.approx(t[200])
    assert figure.get_suptitle().endswith("400 rows") and "lost" not in figure.get_suptitle()


def test_a_robot_shows_its_path_first_and_square(tmp_path):
    t = np.arange(400) / 100
    pose = {"x_m": np.sin(t), "y_m": 1 - np.cos(t), "heading_rad": (t + np.pi) % (2 * np.pi) - np.pi}
    motion = {"vx_m_s": np.ones(400), "vy_m_s": np.zeros(400)}
    columns = {"time_s": t, **{f"planar_ekf_{k}": v for k, v in (pose | motion).items()}}
    columns |= {"planar_ekf_x_std_m": np.full(400, 0.01), "planar_ekf_y_std_m": np.full(400, 0.02)}
    columns |= {"mice_excluded": np.where((t > 1) & (t < 2), 2.0, 0.0)}
    columns |= {"tilt_roll_deg": 0 * t, "tilt_height_m": np.full(400, np.nan)}  # J2S is unknown
    paths = (write(tmp_path / "e.csv", columns), write(tmp_path / "t.csv", {"time_s": t} | pose | motion, "truth"))
    tables = [read_table(Path(path)) for path in paths]
    tables[0].metadata["rig"] = {"mouse": [{}, {}, {}]}
    figure, remarks = plotting.plot_tables(tables)
    path, error, speed, heading, mice = figure.axes
    assert remarks == ["not drawn beside a path: tilt (add --filter tilt)"]
    assert plotting.plot_tables([read_table(Path(paths[0]))], ["tilt"])[1] == []  # the user chose
    assert (error.get_ylabel(), drawn(error)) == ("position error (m)", ["planar-ekf 0 m rms", "2σ planar-ekf"])
    band = error.collections[0].get_paths()[0].vertices[:, 1]
    assert band.max() == pytest.approx(2 * np.hypot(0.01, 0.02)) and error.get_ylim()[0] == 0.0
    assert (path.get_xlabel(), path.get_ylabel(), path.get_aspect()) == ("x (m)", "y (m)", 1.0)
    assert drawn(path) == ["truth", "planar-ekf", "±2σ planar-ekf"]
    assert {(e.width, e.height) for e in path.patches if hasattr(e, "width")} == {(0.04, 0.08)}
    assert (speed.get_ylabel(), heading.get_ylabel()) == ("speed (m/s)", "heading (°)")
    assert np.nanmax(heading.lines[0].get_ydata()) == pytest.approx(np.degrees(t[-1]))
    (bar,) = mice.collections[1].get_paths()  # of mouse 2
    assert bar.vertices[:, 0].min() == pytest.approx(1.01) and bar.vertices[:, 1].mean() == pytest.approx(2.0, abs=0.2)
    assert [label.get_text() for label in mice.get_yticklabels()] == ["mouse 1", "mouse 2", "mouse 3"]
    assert mice.yaxis_inverted()  # mouse 1 is at the top


def test_a_long_straight_path_takes_the_whole_width(tmp_path):
    t = np.arange(400) / 100
    columns = {"time_s": t, "mice_x_m": 2 * t, "mice_y_m": np.sin(t), "mice_vx_m_s": 2 + 0 * t, "mice_vy_m_s": 0 * t}
    figure, _ = plotting.plot_tables([read_table(Path(write(tmp_path / "e.csv", columns)))])
    path, speed = figure.axes
    figure.draw_without_rendering()
    assert path.get_position().width == pytest.approx(speed.get_position().width, rel=0.01)
    assert path.get_position().y0 > speed.get_position().y1


def test_a_map_and_beacons_lie_under_the_path(tmp_path):
    """A map whose own axes are turned by 90°: its corners are where map_server puts them."""
    t = np.arange(50) / 100
    file = write(tmp_path / "e.csv", {"time_s": t, "ekf_x_m": t, "ekf_y_m": t})
    grid = GridMap(np.eye(4, 8, dtype=np.uint8), np.array([0.5, 1.0, 2.0, np.pi / 2]))
    scene = Surroundings(grid, {"A1": (3.0, 4.0, 9.0)})
    figure, _ = plotting.plot_tables([read_table(Path(file))], scene=scene)
    (path,) = figure.axes
    (image,) = path.images
    corner = (image.get_transform() - path.transData).transform([(4.0, 2.0)])  # 8 × 4 cells of 0.5 m
    assert np.allclose(corner, [(-1.0, 6.0)])
    beacon = next(line for line in path.lines if line.get_label() == "beacons")
    assert (beacon.get_xdata()[0], beacon.get_ydata()[0]) == (3.0, 4.0)
    assert [text.get_text() for text in path.texts] == ["A1"]
    assert path.get_ylim()[1] >= 6.0
    assert path.dataLim.extents == pytest.approx([-1.0, 0.0, 3.0, 6.0])  # nothing of the map before it is placed
    free, wall, unknown = image.to_rgba(np.array([0, 1, 2]))[:, 0]
    assert wall < unknown < free


@pytest.mark.parametrize("way_m", [40.0, 12.0, 0.0])
def test_heading_ticks_do_not_hide_a_short_path(tmp_path, way_m):
    """A drive of 12 m in a hall of 60 m was a row of arrows on top of each other."""
    t = np.linspace(0.0, 1.0, 200)
    file = write(
        tmp_path / "e.csv", {"time_s": 10 * t, "ekf_x_m": way_m * t, "ekf_y_m": 0 * t, "ekf_heading_rad": 0 * t}
    )
    scene = Surroundings(None, {"1": (0.0, 0.0, 0.0), "2": (60.0, 60.0, 0.0)})
    figure, _ = plotting.plot_tables([read_table(Path(file))], scene=scene)
    figure.draw_without_rendering()
    (ticks,) = (each for each in figure.axes[0].collections if type(each).__name__ == "Quiver")
    places = figure.axes[0].transData.transform(np.asarray(ticks.get_offsets())) / figure.dpi  # inches
    apart = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert (len(places) > 1) == (way_m > 0)
    assert (apart > 1.2 / ticks.scale).all()


def test_a_chain_shows_its_joint_angle_and_its_error(tmp_path):
    t = np.arange(300) / 100
    angle = 30 * np.sin(t)
    estimate = {"time_s": t, "chain_angle_deg": angle + 1, "chain_angle_std_deg": np.ones(300)}
    estimate |= {f"chain_q{axis}": np.full(300, float(axis == "w")) for axis in "wxyz"} | {"tilt_height_m": t}
    truth = {"time_s": t, "chain_angle_deg": angle}
    paths = (write(tmp_path / "e.csv", estimate), write(tmp_path / "t.csv", truth, "truth"))
    figure, remarks = plotting.plot_tables([read_table(Path(path)) for path in paths])
    assert [axes.get_ylabel() for axes in figure.axes] == ["joint angle (°)", "angle error (°)"]
    assert drawn(figure.axes[1])[0] == "chain 1° rms"
    assert remarks == ["not drawn beside a chain: tilt (add --filter tilt)"]


def test_a_ball_joint_has_a_panel_for_each_angle_with_its_truth(tmp_path):
    t = np.arange(300) / 100
    names = ("flexion", "abduction", "axial_rotation")
    truth = {"time_s": t, **{f"{name}_deg": 20 * np.sin(t + k) for k, name in enumerate(names)}}
    estimate = {"time_s": t}
    for name in names:
        estimate |= {f"chain_{name}_deg": truth[f"{name}_deg"] + 1, f"chain_{name}_std_deg": np.ones(300)}
    paths = (write(tmp_path / "e.csv", estimate), write(tmp_path / "t.csv", truth, "truth"))
    figure, _ = plotting.plot_tables([read_table(Path(path)) for path in paths])
    assert [axes.get_ylabel() for axes in figure.axes] == ["flexion (°)", "abduction (°)", "axial rotation (°)"]
    for axes, name in zip(figure.axes, names, strict=True):
        assert np.allclose(axes.lines[1].get_ydata(), truth[f"{name}_deg"])
    assert all(len(axes.collections) == 1 for axes in figure.axes)  # ±2σ


def test_rotations_without_angles_are_drawn_as_rotation_vectors(tmp_path):
    t = np.arange(300) / 100
    half = np.radians(20 * np.sin(t)) / 2
    columns = {"time_s": t, "chain_qw": -np.cos(half), "chain_qx": 0 * t, "chain_qy": 0 * t, "chain_qz": -np.sin(half)}
    figure, _ = plotting.plot_tables([read_table(Path(write(tmp_path / "e.csv", columns)))])
    (axes,) = figure.axes
    z = next(line for line in axes.lines if line.get_label() == "chain z")
    assert np.allclose(z.get_ydata(), 20 * np.sin(t))


def test_a_recording_has_a_panel_for_each_kind_of_reading(tmp_path):
    t = np.arange(200) / 100
    columns = {"time_s": t, "seq": t, "flags": t, "baro_fresh": t}
    columns |= {f"{prefix}gyro_{axis}_rad_s": np.ones(200) for prefix in ("", "imu2_") for axis in "xyz"}
    columns |= {"pressure_Pa": np.full(200, 101325.0), "mouse1_dx_counts": t, "mouse1_dy_counts": t}
    figure, _ = plotting.plot_tables([read_table(Path(write(tmp_path / "r.csv", columns)))])
    assert y_labels(figure) == [
        "angular rate (°/s)", "angular rate of sensor 2 (°/s)", "pressure (hPa)", "mouse counts (counts)"
    ]  # fmt: skip
    assert np.allclose(figure.axes[0].lines[0].get_ydata(), np.degrees(1))


def test_long_lines_keep_their_extremes_and_few_points(tmp_path):
    t = np.arange(200_000) / 100
    value = np.sin(t)
    value[123_456] = 9.0
    found = lines.decimated(t, value)
    assert len(found[0]) <= lines.MOST_POINTS and 9.0 in found[1] and t[123_456] in found[0]


def test_an_evaluation_shows_errors_their_distribution_and_the_table(tmp_path):
    found = evaluate(*link_files(tmp_path))
    figure = plotting.evaluation(found, "e.csv", "t.csv")
    best, _, errors, density, roll, table = figure.axes
    assert drawn(best) == [drawn(errors)[0], "±2σ joint-inertial"] and any(
        label.startswith("joint 0.7") for label in drawn(errors)
    )
    assert errors.get_ylim()[0] < 0.0
    assert y_labels(figure)[::2][:2] == ["height error (cm) best filter", "height error (cm) all filters"]
    assert roll.get_ylabel() == "roll error (°)"
    share = found.scores[0].statistics()["height"].within_2sigma
    assert drawn(density)[0] == f"joint-inertial {100 * share:.0f} %"
    cells = {key: cell.get_text().get_text() for key, cell in table.tables[0].get_celld().items()}
    assert [cells[0, i] for i in range(9)] == [
        "filter", "quantity", "RMSE", "mean", "worst", "95 %", "NEES", "within ±2σ", "rows"
    ]  # fmt: skip
    assert "imu-baro" in [cells[row, 0] for row in range(1, 7)]


@pytest.mark.parametrize(("ending", "magic"), [(".png", PNG), (".svg", b"<?xml"), (".pdf", b"%PDF")])
def test_the_ending_names_the_format_and_force_replaces(tmp_path, estimate, ending, magic):
    picture = tmp_path / f"p{ending}"
    assert CliRunner().invoke(plot.command, [estimate, "-o", str(picture)]).exit_code == 0
    assert picture.read_bytes().startswith(magic)
    with pytest.raises(LinkposeError, match="exists already"):
        CliRunner().invoke(plot.command, [estimate, "-o", str(picture)], catch_exceptions=False)
    assert CliRunner().invoke(plot.command, [estimate, "-o", str(picture), "--force"]).exit_code == 0
    with pytest.raises(LinkposeError, match=r"must end in \.png, \.svg, \.pdf"):
        CliRunner().invoke(plot.command, [estimate, "-o", str(tmp_path / "p.gif")], catch_exceptions=False)


def test_lines_break_at_gaps_and_where_an_angle_goes_around(tmp_path):
    t = np.delete(np.arange(100) / 100, range(30, 50))
    columns = {"time_s": t, "joint_height_m": t, "joint_roll_deg": (1000 * t + 180) % 360 - 180}
    columns["joint_height_m"] = np.where(t == t[10], np.inf, t)
    figure, _ = plotting.plot_tables([read_table(Path(write(tmp_path / "e.csv", columns)))])
    height, roll = (axes.lines[0].get_ydata() for axes in figure.axes)
    assert np.flatnonzero(np.isnan(height)).tolist() == [10, 30]
    assert np.nanmax(np.abs(np.diff(roll))) < 180


def test_a_plot_is_named_after_its_file(tmp_path, estimate):
    result = CliRunner().invoke(plot.command, [estimate])
    assert result.output.strip() == str(tmp_path / "estimate.png")
    assert (tmp_path / "estimate.png").read_bytes().startswith(PNG)


def test_what_cannot_be_drawn_or_written_is_said(tmp_path, estimate):
    nothing = write(tmp_path / "nothing.csv", {"time_s": [0, 1], "seq": [0, 1]})
    with pytest.raises(LinkposeError, match="nothing to draw"):
        CliRunner().invoke(plot.command, [nothing], catch_exceptions=False)
    with pytest.raises(LinkposeError, match="cannot write"):
        CliRunner().invoke(plot.command, [estimate, "-o", str(tmp_path / "no" / "p.png")], catch_exceptions=False)


def test_reproduce_link_prints_every_method_on_every_test(linkpose, tmp_path):
    picture = tmp_path / "figure2.png"
    result = linkpose("reproduce", "link", "--seeds", 1, "--json", "--plot", picture)
    assert all(line.startswith("Compiling filters") for line in result.err.splitlines())
    rows = [json.loads(line) for line in result.out.splitlines()]
    assert [row["filter"] for row in rows[:5]] == ["joint", "tilt", "imu-baro", "baro", "joint-inertial"]
    assert len(rows) == 15
    for row in rows:
        assert row["seeds"] == 1 and row["height_rmse_cm_mean"] == row["height_rmse_cm_max"] > 0
        assert row["mean_accel_m_s2"] == pytest.approx({1: 6.8, 2: 10.7, 3: 12.5}[row["test"]], rel=0.05)
        assert ("roll_rmse_deg_mean" in row) == (row["filter"] != "baro")
    assert rows[0]["paper_height_rmse_cm"] == 0.58 and rows[4]["paper_height_rmse_cm"] is None
    assert picture.read_bytes().startswith(PNG)


def test_reproduce_link_shows_the_papers_tables_beside(linkpose):
    shown = linkpose("reproduce", "link", "--seeds", 1).out
    assert shown.startswith("Table 1: height RMSE (cm), 1 seed, errors: calibrated\n")
    assert "Table 1" in shown and "Table 2" in shown and "17.34" in shown and "joint A" in shown


@pytest.mark.parametrize("errors_m", [(0.033, 0.048), (0.03, 0.09), (0.027, 79.2)])
def test_the_errors_of_variants_are_labelled_with_plain_numbers(errors_m):
    run = Variant("ekf", "fixed", 0.0, None, scores=[PathScore(error, error, None) for error in errors_m])
    axis = plotting.variants("Indoor localization", [run], [("gate", "fixed R")]).axes[0].xaxis
    low, high = axis.get_view_interval()
    places = [place for place in axis.get_majorticklocs() if low <= place <= high]
    assert 2 <= len(places) <= 15
    labels = axis.get_major_formatter().format_ticks(places)
    assert [float(label) for label in labels] == pytest.approx(places)
    assert not any(label.get_text() for label in axis.get_ticklabels(minor=True))


@pytest.mark.parametrize("experiment", [indoor, underwater])
def test_the_picture_of_all_variants_has_room_for_the_errors(experiment):
    """Names of 60 characters left a fifth of the width to the errors, cut the label of the axis and hid its numbers."""
    if experiment is indoor:
        compared = list(indoor.variants())
    else:
        cases = itertools.product(("asynchronous", "synchronous"), (False, True), (0, underwater.OUTLIERS))
        compared = [variant for case in cases for variant in underwater._case(*case).variants]
    for at, variant in enumerate(compared):
        variant.scores += [PathScore(0.03 * 1.02**at, 0.1, None), PathScore(0.04 * 1.02**at, 0.1, None)]
    figure = plotting.variants("Localization", compared, [experiment.label(variant) for variant in compared])
    figure.draw_without_rendering()
    axes, width = figure.axes[0], figure.bbox.width
    assert axes.get_window_extent().width > 0.55 * width
    low, high = axes.get_xlim()
    texts = [axes.xaxis.label, *axes.get_yticklabels(), *axes.get_legend().get_texts()]
    inside = [text.get_window_extent() for text in texts]
    assert min(box.x0 for box in inside) >= 0 and max(box.x1 for box in inside) <= width
    shown = [text.get_window_extent() for text in axes.get_xticklabels() if low <= text.get_position()[0] <= high]
    assert len(shown) >= 3
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(shown))
    rows = [round(line.get_ydata()[0], 2) for line in axes.lines if line.get_marker() == "o"]
    assert len(set(rows)) == len(rows) == len(compared)


def test_the_panels_of_the_redundant_mice_begin_at_one_height():
    figure = plotting.redundant_mice(paper_run(3, 0))
    figure.draw_without_rendering()
    left, right = (axes.get_legend().get_window_extent() for axes in figure.axes[:2])
    assert left.y1 == pytest.approx(right.y1, abs=2)


def test_a_legend_reads_row_by_row_and_single_values_are_dots(tmp_path):
    axes = plotting.new_figure(3.0).add_subplot()
    names = [letter * 25 for letter in "abcdefg"]  # three fit side by side
    for name in names:
        lines.draw(axes, np.arange(3.0), np.array([1.0, np.nan, 2.0]), label=name)
    legend_above(axes, names)
    shown = [text.get_text() for text in axes.get_legend().get_texts()]
    columns = np.array_split(shown, 3)  # as matplotlib fills them
    assert [column[row] for row in range(3) for column in columns if row < len(column)] == names
    assert axes.lines[1].get_xdata().tolist() == [0.0, 2.0] and axes.lines[1].get_marker() == "."


LEAST_POINTS = 3.3  # of lettering in a column of a journal; a picture of 10 inches with notes of 7 points had 2.4
COLUMN_INCHES = 3.46  # 88 mm


def every_figure(tmp_path):
    """A link, a robot and their evaluations, each with its truth; the mice of the paper."""
    link = link_files(tmp_path)
    t = np.arange(400) / 100
    pose = {"x_m": np.sin(t), "y_m": 1 - np.cos(t), "heading_rad": (t + np.pi) % (2 * np.pi) - np.pi}
    columns = {"time_s": t}
    for name, error in (("planar_ekf", 0.001), ("planar_ukf", 0.01), ("mice", 0.02)):
        columns |= {f"{name}_{of}": value + error * np.sin(7 * t) for of, value in pose.items()}
        columns |= {f"{name}_{of}_std_m": np.full(400, error) for of in "xy"}
    columns |= {"mice_excluded": np.where((t > 1) & (t < 2), 2.0, 0.0)}
    paths = (write(tmp_path / "m.csv", columns), write(tmp_path / "mt.csv", {"time_s": t} | pose, "truth"))
    robot = [read_table(Path(path)) for path in paths]
    for files in (link, link[:1], robot, robot[:1]):
        yield plotting.plot_tables(files)[0]
    yield from (plotting.evaluation(evaluate(*files), "e.csv", "t.csv") for files in (link, robot))
    run = PaperRun(t, np.ones((400, 3, 3)) + np.sin(t)[:, None, None], np.ones((400, 3)), np.array([0.01, 0.01, 0.0]))
    yield plotting.redundant_mice(run)


@pytest.mark.filterwarnings("error")
def test_pictures_have_the_width_of_a_page_and_nothing_overlaps_or_is_cut(tmp_path):
    """Panels, labels and legends do not touch each other, and all lettering is readable in a journal's column."""
    from matplotlib.text import Text

    for figure in every_figure(tmp_path):
        assert figure.get_size_inches()[0] == WIDTH_INCHES
        figure.draw_without_rendering()
        renderer, whole = figure._get_renderer(), figure.bbox
        shown = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
        assert min(text.get_fontsize() for text in shown) * COLUMN_INCHES / WIDTH_INCHES >= LEAST_POINTS
        panels = [axes for axes in figure.axes if axes.axison]
        for axes in panels:
            parts = [axes.bbox, axes.yaxis.label.get_window_extent(renderer)]
            parts += [legend.get_window_extent(renderer)] if (legend := axes.get_legend()) else []
            others = [other.bbox for other in panels if other is not axes]
            assert axes.get_legend() is None or (not axes.get_title() and not axes.get_title(loc="left"))
            for part in parts:
                assert whole.x0 - 1 <= part.x0 and part.x1 <= whole.x1 + 1 and part.y1 <= whole.y1 + 1, axes
                assert not any(part.padded(-1).overlaps(other) for other in others), (axes.get_ylabel(), part)


def test_panels_below_each_other_share_their_left_edge_and_a_square_path_their_top(tmp_path):
    _, _, robot, _, *_ = figures = list(every_figure(tmp_path))
    for figure in figures:
        figure.draw_without_rendering()
    for figure in (figures[0], figures[1]):
        assert len({round(axes.get_position().x0, 3) for axes in figure.axes}) == 1
    path, *over_time = robot.axes
    assert len({round(axes.get_position().x0, 3) for axes in over_time}) == 1
    assert path.get_position().y1 > over_time[-1].get_position().y1 and path.get_anchor() == "N"
    mice = over_time[-1]
    assert [label.get_text() for label in mice.get_yticklabels()] == ["mouse 1", "mouse 2"]


def test_an_arrow_at_the_edge_of_a_path_is_whole(tmp_path):
    t = np.arange(200) / 100
    columns = {"time_s": t, "mice_x_m": -2.5 * t**2, "mice_y_m": 4.55 * t, "mice_heading_rad": np.full(200, np.pi)}
    figure, _ = plotting.plot_tables([read_table(Path(write(tmp_path / "m.csv", columns)))])
    figure.draw_without_rendering()
    path = figure.axes[0]
    (arrows,) = (part for part in path.collections if type(part).__name__ == "Quiver")
    left = path.transData.inverted().transform([0.0, 0.0])[0] - path.transData.inverted().transform([1.0, 0.0])[0]
    tips = arrows.X + left * 0.22 * figure.dpi  # 0.22 inches to the left
    assert path.get_xlim()[0] < tips.min() < -10.0


def test_a_legend_is_not_wider_than_its_axes(tmp_path):
    t = np.arange(400) / 100
    pose = {"x_m": 3 * t, "y_m": 0.1 * t, "heading_rad": 0 * t}
    columns = {"time_s": t}
    for name, error in (("planar_ekf", 0.0012), ("planar_ukf", 0.0013), ("mice", 0.0345)):
        columns |= {f"{name}_{of}": value + error * np.sin(7 * t) for of, value in pose.items()}
        columns |= {f"{name}_{of}_std_m": np.full(400, error) for of in "xy"}
    paths = (write(tmp_path / "m.csv", columns), write(tmp_path / "mt.csv", {"time_s": t} | pose, "truth"))
    figure, _ = plotting.plot_tables([read_table(Path(path)) for path in paths])
    figure.draw_without_rendering()
    legends = [(axes, axes.get_legend()) for axes in figure.axes if axes.get_legend()]
    assert len(legends) == 3
    for axes, legend in legends:
        assert legend.get_window_extent().width <= 1.08 * axes.bbox.width, axes.get_ylabel()
    shown = [text.get_text().split(" ")[0] for text in legends[2][1].get_texts()]
    assert shown == ["planar-ekf", "2σ", "planar-ukf", "mice"]  # column by column; 2σ begins the second row


def test_the_unit_of_a_label_stays_with_its_quantity():
    assert wrapped("position error (m)\nall filters", 0.95, 9.0) == "position\nerror (m)\nall filters"


def test_a_table_s_negative_numbers_have_a_minus_sign(tmp_path):
    figure = plotting.evaluation(evaluate(*link_files(tmp_path)), "e.csv", "t.csv")
    cells = [cell.get_text().get_text() for cell in figure.axes[-1].tables[0].get_celld().values()]
    assert any(text.startswith("−") for text in cells) and not any(text.startswith("-") for text in cells)


def test_of_two_panels_of_errors_each_states_its_filters(tmp_path):
    """A distance has 2σ above zero; that of a robot's position comes from its components also in `evaluate`."""
    figures = list(every_figure(tmp_path))
    assert y_labels(figures[2])[1:3] == ["position error (m) best filter", "position error (m) all filters"]
    position = figures[5].axes[0]
    assert "2σ planar-ekf" in drawn(position) and position.get_ylim()[0] == 0.0
    band = position.collections[0].get_paths()[0].vertices[:, 1]
    assert band.max() == pytest.approx(2 * np.hypot(0.001, 0.001))


def test_a_pressure_is_not_drawn_as_an_offset_and_each_mouse_has_its_colour(tmp_path):
    t = np.arange(200) / 100
    columns = {"time_s": t, "seq": t, "flags": t, "pressure_Pa": 101540.0 + t}
    columns |= {f"mouse{mouse}_d{axis}_counts": t for mouse in (1, 2, 3) for axis in "xy"}
    figure, _ = plotting.plot_tables([read_table(Path(write(tmp_path / "r.csv", columns)))])
    pressure, mice = figure.axes
    figure.draw_without_rendering()
    assert pressure.yaxis.get_offset_text().get_text() == ""
    assert all(label.get_text().startswith("1015") for label in pressure.get_yticklabels())
    styles = {(line.get_color(), line.get_linestyle()) for line in mice.lines}
    assert len(styles) == 6 and len({colour for colour, _ in styles}) == 3


def test_the_yaw_of_a_truth_alone_counts_from_its_start(tmp_path):
    t = np.arange(200) / 100
    path = write(tmp_path / "t.csv", {"time_s": t, "height_m": t, "roll_deg": t, "yaw_deg": t - 63.0}, "truth")
    yaw = plotting.plot_tables([read_table(Path(path))])[0].axes[-1]
    assert "yaw since the start" in " ".join(yaw.get_ylabel().split())
    assert np.allclose(yaw.lines[0].get_ydata(), t)


def test_a_long_name_is_shortened_and_an_empty_estimate_refused(tmp_path):
    t = np.arange(100) / 100
    table = read_table(Path(write(tmp_path / f"{'n' * 150}.csv", {"time_s": t, "tilt_height_m": t})))
    figure, _ = plotting.plot_tables([table])
    assert "…" in figure.get_suptitle() and len(figure.get_suptitle()) < 120
    empty = read_table(Path(write(tmp_path / "empty.csv", {"time_s": t, "tilt_height_m": np.nan * t})))
    with pytest.raises(LinkposeError, match="its quantities are empty in all rows"):
        plotting.plot_tables([empty])


def test_an_evaluation_draws_what_matters_first(tmp_path):
    """The position of a robot; a chain without the filters of one of its sensors, which are in the table."""
    t = np.arange(300) / 100
    place = {"x_m": t, "y_m": np.sin(t), "heading_rad": 0.1 * np.sin(t)}
    estimate = {"time_s": t} | {f"mice_{name}": value + 0.01 for name, value in place.items()}
    paths = (write(tmp_path / "e.csv", estimate), write(tmp_path / "t.csv", {"time_s": t} | place, "truth"))
    figure = plotting.evaluation(evaluate(*(read_table(Path(path)) for path in paths)), "e", "t")
    assert [axes.get_ylabel() for axes in figure.axes[:2]] == ["position error (m)", "heading error (rad)"]
    still = {f"q{axis}": np.full(300, float(axis == "w")) for axis in "wxyz"} | {"height_m": np.sin(t)}
    estimate = {"time_s": t, "tilt_height_m": np.sin(t) + 0.01} | {f"chain_{n}": still[n] for n in still if n[0] == "q"}
    paths = (write(tmp_path / "e.csv", estimate), write(tmp_path / "t.csv", {"time_s": t} | still, "truth"))
    figure = plotting.evaluation(evaluate(*(read_table(Path(path)) for path in paths)), "e", "t")
    assert [axes.get_ylabel() for axes in figure.axes] == ["rotation error (°)", ""]
    cells = [cell.get_text().get_text() for cell in figure.axes[-1].tables[0].get_celld().values()]
    assert {"tilt", "chain"} <= set(cells)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["a$\\frac$", "escape\x1b[31m", "no UTF-8 \udcff", "$(x)`", "추정"])
def test_any_name_of_a_file_or_a_column_is_drawn_as_it_is(tmp_path, name):
    path = tmp_path / f"{name}.csv"
    path.write_text("time_s,$\\frac$_height_m\n0,1\n1,2\n2,3\n")
    figure, _ = plotting.plot_tables([read_table(path)])
    for ending in ("png", "svg"):
        plotting.save(figure, tmp_path / f"picture.{ending}", force=False)
    assert "$\\frac$" in drawn(figure.axes[0])
