"""plot draws what it is given; reproduce link measures what it prints."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from linkpose import plotting
from linkpose.cli import plot
from linkpose.errors import LinkposeError
from linkpose.recording.table import read_table

PNG = b"\x89PNG"


def write(path, columns):
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")
    return str(path)


@pytest.fixture
def estimate(tmp_path):
    t = np.arange(50) / 100
    columns = {"time_s": t, "joint_height_m": np.sin(t), "joint_height_std_m": t, "mice_x_m": t, "mice_y_m": t**2}
    return write(tmp_path / "estimate.csv", columns)


def test_plot_draws_each_quantity_once(tmp_path, estimate):
    truth = write(tmp_path / "truth.csv", {"time_s": [0, 1], "height_m": [1, 2]})
    figure = plotting.plot_tables([read_table(tmp_path / "estimate.csv"), read_table(tmp_path / "truth.csv")])
    assert [axes.get_ylabel() for axes in figure.axes] == ["height (m)", "y (m)"]
    assert [len(axes.lines) for axes in figure.axes] == [2, 1]
    assert CliRunner().invoke(plot.command, [estimate, truth, "-o", str(tmp_path / "both.png")]).exit_code == 0
    assert (tmp_path / "both.png").read_bytes().startswith(PNG)


def test_lines_break_at_gaps_and_where_an_angle_goes_around(tmp_path):
    t = np.delete(np.arange(100) / 100, range(30, 50))
    columns = {"time_s": t, "joint_height_m": t, "joint_roll_deg": (1000 * t + 180) % 360 - 180}
    columns["joint_height_m"] = np.where(t == t[10], np.inf, t)
    figure = plotting.plot_tables([read_table(Path(write(tmp_path / "e.csv", columns)))])
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


def test_reproduce_link_prints_every_method_on_every_test(linkpose, impatient, tmp_path):
    picture = tmp_path / "figure2.png"
    impatient()
    result = linkpose("reproduce", "link", "--seeds", 1, "--json", "--plot", picture)
    assert result.err == "compiling the filters, this once (some seconds) ...\n"
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
    assert "Table 1" in shown and "Table 2" in shown and "17.34" in shown and "joint A" in shown
