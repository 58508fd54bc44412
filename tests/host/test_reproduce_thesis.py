"""The thesis's experiments: verdicts by sign test, tables and figures by number."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from statistics import fmean

import numpy as np
import pytest

from linkpose import plotting
from linkpose.experiments import indoor, underwater
from linkpose.experiments.paths import ComparedPath, rms_within, worst_sections
from linkpose.experiments.variants import Variant, remark, sign_test, verdict
from linkpose.localization.grid import GridMap
from linkpose.localization.tables import PathScore
from linkpose.plotting.canvas import COLOURS
from linkpose.simulation.underwater import BEACONS

SHORT_S = 8.0


@pytest.mark.parametrize(
    ("wins", "losses", "p"),
    [
        (6, 0, 0.03125),
        (5, 0, 0.0625),
        (9, 1, 0.021484375),
        (1, 9, 0.021484375),
        (8, 2, 0.109375),
        (3, 3, 1.0),
        (0, 0, 1.0),
    ],
)
def test_the_sign_test_is_the_exact_two_sided_binomial_test(wins: int, losses: int, p: float) -> None:
    """As scipy.stats.binomtest(wins, wins + losses) gives it."""
    assert sign_test(wins, losses) == pytest.approx(p)


def scored(*errors_m: float) -> Variant:
    return Variant("ekf", "fixed", 0.0, None, scores=[PathScore(error, error, 0.0) for error in errors_m])


@pytest.mark.parametrize(
    ("after", "result"),
    [
        ([0.9] * 6, "holds"),
        ([1.1] * 6, "does not hold"),
        ([0.9] * 5 + [1.1], "no difference"),  # better on most seeds, p = 0.22
        ([0.9] * 5 + [1.0], "no difference"),  # a tie is no win
    ],
)
def test_a_claim_holds_only_where_the_sign_test_says_so(after: list[float], result: str) -> None:
    found = verdict("it is better", scored(*[1.0] * 6), scored(*after), "3.2")
    assert found.result == found.as_row()["result"] == result
    assert found.text.startswith(f"Table 3.2: it is better: {result}; {fmean(after):.4g} m instead of 1 m")


def test_too_few_seeds_are_named() -> None:
    assert remark(6) is None
    assert "at least 6 seeds" in str(remark(5))


def path(name: str, label: str, errors_m: list[float]) -> ComparedPath:
    """A path along y = 5 m, 1 m a sample, that is off to the left by these errors."""
    n = len(errors_m)
    truth = np.column_stack([np.arange(n) + 1.0, np.full(n, 5.0), np.full(n, -3.0)])
    error = np.array(errors_m)
    position = truth + np.column_stack([np.zeros(n), error, np.zeros(n)])
    at = np.arange(n, dtype=float)
    return ComparedPath(
        name, label, at, at, position, truth, error, np.full(n, 0.02), np.radians(error), np.full(n, 0.01), at[3:4]
    )  # fmt: skip


ERRORS = [0.1] * 40
ERRORS[12], ERRORS[30] = 0.9, 0.6
FIXED, ADAPTIVE = path("ukf", "UKF, fixed R", ERRORS), path("ukf", "UKF, adaptive R", [0.05] * 40)
EKF = path("ekf", "EKF", ERRORS)


@pytest.fixture(scope="module")
def floor():  # type: ignore[no-untyped-def]
    grid = GridMap(np.eye(20, 100, dtype=np.uint8), np.array([0.5, 0.0, 0.0, 0.0]))
    paths = {"3.2": FIXED, "3.3": ADAPTIVE, "3.5": EKF, "3.6": ADAPTIVE}
    return plotting.indoor_figures(indoor.DrawnDrive(grid, FIXED.truth_m[:, :2], FIXED.truth_m[:, :2] + 1.0, paths))


@pytest.fixture(scope="module")
def sea():  # type: ignore[no-untyped-def]
    dive = underwater.Dive(
        EKF.time_s, EKF.truth_m + 0.5, EKF.truth_m, [FIXED, FIXED, ADAPTIVE], {"3.9": EKF, "3.10": FIXED}
    )
    return plotting.underwater_figures(dive, BEACONS)


def lines(axes):  # type: ignore[no-untyped-def]
    return {line.get_label(): line for line in axes.lines}


def test_each_figure_of_chapter_3_has_its_number(floor, sea) -> None:  # type: ignore[no-untyped-def]
    assert (*floor, *sea) == ("3.1", "3.2", "3.3", "3.4", "3.5", "3.6", "3.7", "3.8", "3.9", "3.10")
    for number, figure in (floor | sea).items():
        assert figure.get_suptitle().startswith(f"Figure {number}  ")
        above = figure.axes[0]
        assert above.get_aspect() == 1.0
        assert (above.get_xlabel(), above.get_ylabel()) == ("x (m)", "y (m)")
        truth = lines(above)["truth"]
        assert (truth.get_color(), truth.get_linestyle()) == ("black", "--")
        assert np.allclose(truth.get_xdata(), FIXED.truth_m[:, 0])
        assert "truth" in [text.get_text() for text in above.get_legend().get_texts()]


@pytest.mark.parametrize(("number", "name"), [("3.2", "ukf"), ("3.3", "ukf"), ("3.5", "ekf"), ("3.6", "ukf")])
def test_an_estimate_is_drawn_with_its_errors_along_the_way(floor, number: str, name: str) -> None:  # type: ignore[no-untyped-def]
    drawn = {"3.2": FIXED, "3.3": ADAPTIVE, "3.5": EKF, "3.6": ADAPTIVE}[number]
    above, position, heading = floor[number].axes
    assert len(above.images) == 1
    assert lines(above)[name].get_color() == lines(position)[name].get_color() == COLOURS[name]
    assert np.allclose(lines(above)[name].get_ydata(), drawn.position_m[:, 1])
    assert np.allclose(lines(position)[name].get_ydata(), 100 * drawn.error_m)
    assert np.allclose(heading.lines[0].get_ydata(), drawn.error_m)
    labels = [" ".join(axes.get_ylabel().split()) for axes in (position, heading)]
    assert labels == ["position error (cm)", "heading error (°)"]
    assert heading.get_xlabel() == "distance travelled (m)"
    band = position.collections[0].get_paths()[0].get_extents()
    assert band.y1 == pytest.approx(2 * 2.0)  # 2σ in cm
    within = 100 * np.mean(drawn.error_m <= 2 * drawn.std_m)
    assert position.collections[0].get_label() == f"2σ ({within:.0f} % within)"
    assert position.get_ylim() == floor["3.2"].axes[1].get_ylim()  # comparable between the figures
    assert f"{100 * drawn.rms_m:.1f} cm rms" in floor[number].get_suptitle()


def test_panels_of_a_figure_share_their_left_edge_and_no_text_lies_on_another(floor, sea) -> None:  # type: ignore[no-untyped-def]
    """Also under a map that is not as wide as the panels below it."""
    grid = GridMap(np.eye(80, 100, dtype=np.uint8), np.array([0.5, 0.0, 0.0, 0.0]))
    paths = {"3.2": FIXED, "3.3": ADAPTIVE, "3.5": EKF, "3.6": ADAPTIVE}
    high = plotting.indoor_figures(indoor.DrawnDrive(grid, FIXED.truth_m[:, :2], FIXED.truth_m[:, :2], paths))
    for number in ("3.2", "3.3", "3.5", "3.6"):
        for figure in (floor[number], high[number]):
            figure.draw_without_rendering()
            assert len({round(axes.get_position().x0, 3) for axes in figure.axes}) == 1, number
    for figure in (floor["3.4"], sea["3.8"], sea["3.9"], sea["3.10"]):
        figure.draw_without_rendering()
        renderer = figure._get_renderer()
        texts = [axes.get_legend().get_window_extent(renderer) for axes in figure.axes if axes.get_legend()]
        texts += [axes._left_title.get_window_extent(renderer) for axes in figure.axes if axes._left_title.get_text()]
        assert not any(one.padded(-1).overlaps(other) for one, other in itertools.combinations(texts, 2))
        assert all(text.x1 <= figure.bbox.x1 + 1 for text in texts)


def test_figure_3_4_shows_where_errors_are_large(floor) -> None:  # type: ignore[no-untyped-def]
    above, *details = floor["3.4"].axes
    assert [text.get_text() for text in above.texts] == ["1", "2", "3"]
    largest = [float(lines(axes)["UKF, fixed R"].get_ydata().max()) for axes in details]
    assert sorted(largest)[1:] == pytest.approx([60.0, 90.0])
    for axes in details:
        assert {"UKF, fixed R", "UKF, adaptive R"} <= set(lines(axes))
        assert lines(axes)["UKF, fixed R"].get_linestyle() != lines(axes)["UKF, adaptive R"].get_linestyle()
    marked = [line for line in above.lines if line.get_label() == "large errors"]
    assert any(12.0 <= x <= 14.0 for line in marked for x in line.get_xdata())


def test_worst_sections_do_not_overlap_and_stay_on_the_way() -> None:
    sections = worst_sections(FIXED, 3, 10.0)
    assert all(a.end_m <= b.start_m for a, b in itertools.pairwise(sections))
    assert (sections[0].start_m, sections[-1].end_m) >= (0.0, 30.0)
    assert rms_within(FIXED, sections[0]) > rms_within(ADAPTIVE, sections[0])


def test_figures_of_the_dive(sea) -> None:  # type: ignore[no-untyped-def]
    above, depth, distance = sea["3.7"].axes
    assert np.allclose(lines(above)["command"].get_xdata(), EKF.truth_m[:, 0] + 0.5)
    assert np.allclose(distance.lines[0].get_ydata(), np.sqrt(3 * 0.25))
    assert depth.yaxis_inverted()
    assert "0.87 m apart at the end" in sea["3.7"].get_suptitle()
    assert len(sea["3.8"].axes) == 1 + 3
    for number, name in (("3.9", "ekf"), ("3.10", "ukf")):
        above, depth, position, heading = sea[number].axes
        assert lines(above)[name].get_color() == COLOURS[name]
        assert np.allclose(depth.lines[0].get_ydata(), 3.0)
        assert list(lines(position)["rejected"].get_xdata()) == [3.0]
        assert heading.get_xlabel() == "time (s)"
        assert len(lines(above)["beacons"].get_xdata()) == len(BEACONS)


def kinds(text: str) -> dict[str, list[dict[str, object]]]:
    """JSON lines by what they report."""
    found: dict[str, list[dict[str, object]]] = {}
    for row in map(json.loads, text.splitlines()):
        found.setdefault(next(key for key in ("check", "set", "claim", "filter") if key in row), []).append(row)
    return found


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):  # type: ignore[no-untyped-def]
    """What both commands print and draw, from short runs of one seed."""
    from click.testing import CliRunner

    from linkpose.cli.reproduce_indoor import command as floor
    from linkpose.cli.reproduce_underwater import command as sea

    folder = tmp_path_factory.mktemp("figures")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(indoor, "DURATION_S", SHORT_S)
        patch.setattr(underwater, "DURATION_S", SHORT_S)
        printed = [
            CliRunner().invoke(command, ["--seeds", "1", "--json", "--plot", str(folder)], catch_exceptions=False)
            for command in (floor, sea)
        ]
    return folder, *(kinds(result.stdout) for result in printed)


def test_reproduce_prints_every_variant_and_the_thesis_s_tables(reproduced) -> None:  # type: ignore[no-untyped-def]
    _, floor, sea = reproduced
    for rows in (floor["filter"], sea["filter"]):
        assert {row["filter"] for row in rows} == {"ekf", "ukf"}
        assert {row["gate"] for row in rows} == {None, 0.997}
        assert all(row["position_rmse_m_mean"] < 0.25 for row in rows if row["gate"])
    tables = {(row["table"], row["check"]): row for row in sea["check"]}
    moved = tables["3.5", "motion_vx_std_m_s"]
    assert moved["measured"] == pytest.approx(moved["asked"], rel=0.2)
    assert sum(table == "3.5" for table, _ in tables) == 6
    assert tables["2.4", "dvl_period_s"]["thesis"] == 0.2
    assert moved["thesis"] is None
    assert [row["set"] for row in sea["set"]] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert {row["table"] for row in sea["set"]} == {"3.10"}
    assert sea["set"][0]["ranges"] == 4 * (int(SHORT_S / 0.1) - 1)


def test_reproduce_judges_no_claim_by_one_seed(reproduced) -> None:  # type: ignore[no-untyped-def]
    _, floor, sea = reproduced
    assert {row["table"] for row in floor["claim"]} == {"3.2", "3.3", "3.4", ""}
    assert {row["table"] for row in sea["claim"]} == {"3.8", "3.9", "3.11"}
    assert {row["result"] for row in (*floor["claim"], *sea["claim"])} == {"no difference"}


def test_reproduce_draws_one_picture_per_figure(reproduced) -> None:  # type: ignore[no-untyped-def]
    folder = reproduced[0]
    assert {file.name for file in folder.iterdir()} == {
        "variants-indoor.png",
        "variants-underwater.png", *(f"figure-3.{i}.png" for i in range(1, 11))
    }  # fmt: skip
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in folder.iterdir())


def test_pictures_lie_beside_a_named_file_and_are_kept(tmp_path: Path, refused) -> None:  # type: ignore[no-untyped-def]
    files = plotting.picture_files(tmp_path / "u.svg", "variants", ["figure-3.7"], force=False)
    assert files == {"variants": tmp_path / "u.svg", "figure-3.7": tmp_path / "u-figure-3.7.svg"}
    (tmp_path / "u-figure-3.7.svg").touch()
    assert "u-figure-3.7.svg exists already" in refused("reproduce", "underwater", "--plot", tmp_path / "u.svg")
    assert "name a file for the picture" in refused("reproduce", "indoor", "--plot", "-")
    assert "its name must end in" in refused("reproduce", "indoor", "--plot", tmp_path / "u.gif")
