"""evaluate: σ against errors, yaw and position without an absolute origin, chains, windows, and what is refused."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from linkpose.cli.cures import cure
from linkpose.cli.evaluate import command
from linkpose.errors import LinkposeError, TooFewRows
from linkpose.evaluation.mismatches import mismatches
from linkpose.evaluation.scores import evaluate
from linkpose.evaluation.statistics import Statistics
from linkpose.recording.table import Table

T = np.arange(4000) / 100
RNG = np.random.default_rng(0)
NOISE = RNG.standard_normal(len(T))


def table(kind="estimate", **columns):
    return Table(Path(f"{kind}.csv"), kind, {"time_s": T, **columns}, {}, None, 2)


def motion(t=T):
    return 1.5 + 0.1 * np.sin(3 * t) + 0.05 * np.sin(1.3 * t + 1)


def score(estimate, truth, **window):
    (found,) = evaluate(estimate, truth, **window).scores
    return found


def test_an_honest_sigma_has_a_nees_of_one():
    estimate = table(joint_height_m=motion() + 0.01 * NOISE, joint_height_std_m=np.full(len(T), 0.01))
    row = score(estimate, table("truth", height_m=motion())).as_dict()
    assert row["height_nees"] == pytest.approx(1.0, abs=0.05)
    assert row["height_within_2sigma"] == pytest.approx(0.954, abs=0.01)
    assert row["quantities"]["height"]["p95"] == pytest.approx(1.96, abs=0.06)  # cm
    assert row["quantities"]["height"]["nees"] == row["height_nees"]


@pytest.mark.parametrize(
    ("claimed", "verdict"),
    [(1.0, "σ is right: 9"), (0.5, "σ is 2.0 times too small: 6"), (3.0, "σ is 3.0 times too large: 100 %")],
)
def test_the_verdict_says_by_how_much_sigma_is_off(claimed, verdict):
    found = Statistics.of(NOISE, np.full(len(T), claimed)).verdict()
    assert found is not None and found.startswith(verdict)


@pytest.mark.parametrize(
    ("shares", "claimed", "verdict"),
    [
        ((1.0, 1.0, 1.0), 1.0, "σ is right: 99 %"),
        ((1.0, 0.0, 0.0), 1.0, "σ is right: 9"),
        ((1.0, 1.0, 1.0), 2.0, "σ is 2.0 times too large: 100 %"),
        ((1.0, 1.0, 1.0), 0.5, "σ is 1.6 times too small: 6"),
    ],
)
def test_the_angle_of_a_rotation_has_three_components(shares, claimed, verdict):
    """Its σ is that of all three together: with a right σ, up to 99 % of the errors are within 2σ."""
    spread = np.sqrt(np.array(shares) / np.sum(shares))
    angle = np.linalg.norm(spread * np.random.default_rng(1).standard_normal((20000, 3)), axis=1)
    found = Statistics.of(angle, np.full(len(angle), claimed)).verdict(of_three=True)
    assert found is not None and found.startswith(verdict) and "(95 to 99 % expected)" in found


def test_a_sigma_that_was_rounded_to_zero_is_that_of_its_last_digit():
    found = Statistics.of(np.full(100, 3e-6), np.zeros(100), least_std=1e-6)
    assert found.nees == pytest.approx(9.0) and found.within_2sigma == 0.0
    assert Statistics.of(np.ones(9), np.zeros(9)).nees is None


def test_a_constant_error_within_sigma_is_no_error_far_outside():
    """A wrong first air pressure shifts all heights by one error, whose NEES is as large as that of few far ones."""
    found = Statistics.of(np.full(1000, 1.55), np.ones(1000))
    assert found.nees > 2 and found.verdict().startswith("σ is 1.3 times too large: 100 %")
    steady = Statistics.of(np.full(1000, 1.9), np.ones(1000))
    assert steady.verdict() == "σ is right: 100 % of the errors are within ±2σ (95 % expected)."


def test_rows_fixed_by_definition_have_no_part_in_nees():
    """The yaw of the first row is 0 with σ 0. In other rows, σ of 0 with a real error counts as outside."""
    error, std = np.append(0.3 * np.sign(NOISE), [0.0, 1e-6, -1e-6]), np.append(np.full(len(T), 0.3), [0.0, 0.0, 1e-7])
    found = Statistics.of(error, std, least_std=1e-6)
    assert found.rows == len(T) + 3 and found.nees == pytest.approx(1.0) and found.within_2sigma == 1.0
    assert Statistics.of(np.zeros(9), np.zeros(9), least_std=1e-6).verdict() is None
    wrong = Statistics.of(np.append(error, 0.1), np.append(std, 0.0), least_std=1e-6)
    assert wrong.within_2sigma == pytest.approx(len(T) / (len(T) + 1)) and wrong.nees > 1e6


@pytest.mark.parametrize(
    ("claimed", "start"), [(1.0, "σ is right for most"), (3.0, "σ is 3.0 times too large for most")]
)
def test_the_verdict_names_errors_far_outside_of_sigma(claimed, start):
    std = np.full(len(T), claimed)
    std[:4] = np.abs(NOISE[:4]) / 500
    found = Statistics.of(NOISE, std)
    assert found.nees > 200 and found.within_2sigma > 0.9
    assert found.verdict().startswith(start) and found.verdict().endswith("are far outside, up to 500σ.")


def test_no_more_rows_are_compared_than_are_known():
    """Stamps in pairs 1 ms apart every 0.1 s: their usual interval does not state how many there are."""
    time_s = np.sort(np.concatenate([T[::10], T[::10] + 1e-3, T[::10] + 2e-3]))
    height = motion(time_s)
    estimate = Table(Path("e.csv"), "estimate", {"time_s": time_s, "joint_height_m": height}, {}, None, 2)
    at = np.arange(0, 39, 0.1) + 1e-3
    reference = Table(Path("truth.csv"), "truth", {"time_s": at, "height_m": motion(at)}, {}, None, 2)
    found = score(estimate, reference)
    assert 0 < found.rows <= found.known_rows


def test_what_is_not_known_yet_is_left_out_and_counted():
    height, std = motion() + 0.01, np.full(len(T), 0.01)
    height[:1500], std[:1500] = np.nan, np.nan
    found = score(table(joint_height_m=height, joint_height_std_m=std), table("truth", height_m=motion()))
    assert (found.rows, found.known_rows, found.empty_rows) == (2500, 2500, 1500)
    assert found.statistics()["height"].rmse == pytest.approx(1.0)


def test_from_and_to_limit_the_rows():
    height = motion() + np.where(T < 20, 0.05, 0.01)
    estimate, truth = table(joint_height_m=height), table("truth", height_m=motion())
    assert score(estimate, truth, from_s=20.0).statistics()["height"].rmse == pytest.approx(1.0)
    late = score(estimate, truth, from_s=10.0, to_s=19.995)
    assert late.rows == 1000 and late.statistics()["height"].mean == pytest.approx(5.0)


def test_less_than_half_of_the_rows_is_no_score():
    """A reference that ends early, and one whose rows are too far apart to be compared."""
    truth = table("truth", height_m=np.where(T < 12, motion(), np.nan))
    with pytest.raises(TooFewRows, match=r"only 1200 of 4000 estimates of joint .* less than half") as error:
        evaluate(table(joint_height_m=motion()), truth)
    assert cure(error.value) == "to score the common part alone, add --from 0 --to 11.99"
    assert score(table(joint_height_m=motion()), truth, from_s=0.0, to_s=11.99).rows == 1200
    sparse = Table(Path("truth.csv"), "truth", {"time_s": T[:1000:10], "height_m": motion()[:1000:10]}, {}, None, 2)
    with pytest.raises(TooFewRows, match=r"only 100 of 400 estimates of joint"):
        evaluate(table(joint_height_m=motion()), sparse)


def turned(x, y, degrees):
    z = (x + 1j * y) * np.exp(1j * np.radians(degrees))
    return z.real, z.imag


def test_yaw_and_position_count_from_the_start():
    """The estimate begins at 0°, the truth at 130°: turned about the joint by that, they agree but for the drift."""
    x, y, yaw = 0.3 * np.sin(T), 0.2 * np.cos(T) - 0.2, 20 * np.sin(T)
    drift = 1.5 * T / 60
    ours = turned(x, y, 0.0)
    estimate = table(
        joint_inertial_height_m=motion(), joint_inertial_x_m=ours[0] + 0.01, joint_inertial_y_m=ours[1],
        joint_inertial_z_m=motion() + 0.02, joint_inertial_yaw_deg=yaw + drift,
        joint_inertial_yaw_std_deg=np.full(len(T), 0.5),
    )  # fmt: skip
    theirs = turned(x, y, 130.0)
    absolute = (yaw + 130 + 180) % 360 - 180
    row = score(estimate, table("truth", height_m=motion(), x_m=theirs[0], y_m=theirs[1], yaw_deg=absolute)).as_dict()
    assert row["yaw_drift_deg_per_min"] == pytest.approx(1.5, rel=1e-3)
    assert row["yaw_rmse_deg"] == pytest.approx(np.sqrt(np.mean(drift**2)), rel=1e-3)
    assert row["position_rmse_cm"] == pytest.approx(np.hypot(1.0, 2.0), rel=1e-3)
    assert row["yaw_within_2sigma"] == pytest.approx(1.0) and "yaw_nees" in row
    assert "x_rmse_cm" not in row and row["quantities"]["z"]["mean"] == pytest.approx(2.0)


def about(axis, degrees):
    half = np.radians(degrees) / 2
    parts = {"qw": np.cos(half), "qx": 0 * half, "qy": 0 * half, "qz": 0 * half}
    return parts | {f"q{axis}": np.sin(half)}


def test_a_ball_joint_is_scored_by_the_rotation_between_estimate_and_truth():
    angle = 100 * np.sin(T)
    ours = {f"chain_{name}": -value for name, value in about("z", angle + 2).items()}  # −q is the same rotation
    theirs = {f"chain_{name}": value for name, value in about("z", angle).items()}
    estimate = table(**ours, chain_rotation_std_deg=np.full(len(T), 2.0))
    row = score(estimate, table("truth", **theirs)).as_dict()
    assert row["rotation_rmse_deg"] == pytest.approx(2.0)
    assert row["rotation_nees"] == pytest.approx(1.0) and row["rotation_within_2sigma"] == 1.0


def test_a_hinge_is_scored_by_its_angle():
    estimate = table(chain_angle_deg=179 + NOISE, chain_angle_std_deg=np.ones(len(T)))
    row = score(estimate, table("truth", chain_angle_deg=np.full(len(T), 179.0))).as_dict()
    assert row["angle_rmse_deg"] == pytest.approx(1.0, abs=0.03) and row["angle_nees"] == pytest.approx(1.0, abs=0.05)


def test_an_angle_of_the_opposite_sense_is_named():
    angle = 30 * np.sin(2 * T) + 10 * np.sin(0.7 * T)
    (remark,) = evaluate(table(chain_angle_deg=3 - angle), table("truth", angle_deg=angle)).remarks
    assert "opposite senses" in remark and "negate axis1 and axis2" in remark
    assert not evaluate(table(chain_angle_deg=3 + angle), table("truth", angle_deg=angle)).remarks


@pytest.mark.parametrize("late_s", [1e6, 1e12, 1e300])
def test_one_late_stamp_takes_no_memory_and_no_score_away(late_s):
    time_s = T + 7.3
    time_s[-1] = late_s
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    reference = Table(Path("truth.csv"), "truth", {"time_s": time_s, "height_m": motion()}, {}, None, 2)
    found = score(table(joint_height_m=motion() + 0.01), reference)
    assert found.time_offset_s == pytest.approx(7.3, abs=1e-3)
    assert found.statistics()["height"].rmse == pytest.approx(1.0, abs=0.01)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB


def write(path, of):
    np.savetxt(
        path, np.column_stack(list(of.columns.values())), delimiter=",", header=",".join(of.columns), comments=""
    )
    return str(path)


def test_the_command_prints_figures_verdicts_and_rows(tmp_path):
    estimate = table(joint_height_m=motion() + 0.02 * NOISE, joint_height_std_m=np.full(len(T), 0.01))
    files = (write(tmp_path / "e.csv", estimate), write(tmp_path / "t.csv", table("truth", height_m=motion())))
    picture = tmp_path / "e.svg"
    done = CliRunner().invoke(command, [*files, "--from", "10", "--plot", str(picture)], catch_exceptions=False)
    assert "joint: 3000 of 3000 rows compared." in done.stdout
    assert "height: σ is 2.0 times too small: 6" in done.stdout and "NEES" in done.stdout
    assert all(len(line) <= 80 for line in done.stdout.splitlines()[:4])
    assert picture.read_text().startswith("<?xml")
    row = json.loads(CliRunner().invoke(command, [*files, "--json"]).stdout)
    assert {"height_rmse_cm", "height_nees", "height_within_2sigma", "time_offset_s"} <= set(row)
    assert CliRunner().invoke(command, [*files, "--from", "9", "--to", "3"]).exit_code == 2


SWAY = 0.3 * np.sin(2 * T) + 0.1 * np.sin(0.7 * T)
SCALED = {
    "feet": ("height_m", lambda v: v / 0.3048, "height_m moves like the estimate of joint in", "times 3.281"),
    "yaw in radians": ("yaw_deg", np.radians, "yaw_deg moves like", "times 0.01745"),
    "millimetres": ("height_m", lambda v: 1000 * v, "height_m moves like the estimate of joint in", "times 1000"),
    "twice": ("height_m", lambda v: 2 * v, "height_m moves like", "times 2:"),
    "radians": ("roll_deg", np.radians, "roll_deg moves like", "times 0.01745"),
    "reversed": ("roll_deg", np.negative, "roll_deg moves like", "times -1"),
    "centimetres, about another axis": ("x_m", lambda v: 100 * v, "x_m moves like", "times 100"),
    "constant": ("height_m", lambda v: 0 * v + 1, "height_m is the same wherever", "check the column"),
}


@pytest.mark.parametrize("name", SCALED)
def test_a_column_in_another_unit_is_named(name):
    column, change, *words = SCALED[name]
    yaw = np.radians(40)  # the reference counts the yaw from elsewhere
    turning = (180 + 40 * np.sin(T)) % 360 - 180  # beyond half a turn and back
    motion = {"height_m": SWAY, "roll_deg": 20 * SWAY, "pitch_deg": 3 * np.cos(T), "yaw_deg": turning}
    paths = {"x_m": SWAY, "y_m": 0.2 * np.cos(3 * T)}
    turned = {
        "x_m": np.cos(yaw) * paths["x_m"] - np.sin(yaw) * paths["y_m"],
        "y_m": np.sin(yaw) * paths["x_m"] + np.cos(yaw) * paths["y_m"],
    }
    ours = table(**{f"joint_{key}": value + 1e-3 * NOISE for key, value in {**motion, **paths}.items()})
    theirs = {**motion, **turned}
    assert evaluate(ours, table("truth", **theirs)).remarks == []
    columns = ("x_m", "y_m") if column == "x_m" else (column,)
    theirs |= {key: change(theirs[key]) for key in columns}
    found = " ".join(evaluate(ours, table("truth", **theirs)).remarks)
    assert all(word in found for word in words) and "are they of the same run" not in found, found


def test_a_negative_sigma_is_refused():
    estimate = table(joint_height_m=SWAY, joint_height_std_m=np.where(T[5] == T, -0.1, 0.1))
    with pytest.raises(LinkposeError, match="joint_height_std_m is negative, which no standard deviation is"):
        evaluate(estimate, table("truth", height_m=SWAY))


DRIVE = {"vx_m_s": 0.3 + 0.2 * np.sin(T), "wz_rad_s": np.cos(0.8 * T), "heading_rad": np.sin(0.8 * T) / 0.8 + 2 * T}


@pytest.mark.parametrize("part", [None, "qw", "qx", "qy", "qz"])
@pytest.mark.parametrize("factor", [0.0, 2.0, 10.0])
@pytest.mark.parametrize("is_ours", [True, False])
def test_a_quaternion_that_is_no_rotation_is_named(part, factor, is_ours):
    """The error angle was that of its direction, in silence."""
    half = np.column_stack([0.4 * np.sin(T), 0.3 * np.cos(0.8 * T), 0.3 * np.sin(0.7 * T)])
    right = dict(zip(("qw", "qx", "qy", "qz"), [np.sqrt(1 - (half**2).sum(axis=1)), *half.T], strict=True))
    wrong = right | ({} if part is None else {part: factor * right[part]})
    ours, theirs = (wrong, right) if is_ours else (right, wrong)
    found = evaluate(
        table(**{f"chain_{name}": value for name, value in ours.items()}), table("truth", **theirs)
    ).remarks
    named = [remark for remark in found if "are no rotation, whose length is 1: check these columns" in remark]
    assert len(named) == (part is not None)
    assert all(("chain_qw to chain_qz" in remark) == is_ours for remark in named)


@pytest.mark.parametrize("seconds", [1, 2])
def test_odometry_and_a_truth_with_other_times_are_named(seconds):
    """The truth states twice the time."""
    ours = table(**{f"mice_{name}": value + 1e-3 * NOISE for name, value in DRIVE.items()})
    theirs = Table(Path("truth.csv"), "truth", {"time_s": seconds * T, **DRIVE}, {}, None, 2)
    found = evaluate(ours, theirs).remarks
    assert any("hardly any motion in common" in remark for remark in found) == (seconds == 2)
    assert seconds == 2 or not found


@pytest.mark.parametrize("factor", [1, 1e3, 1e6])
@pytest.mark.parametrize("is_ours", [True, False])
def test_times_in_another_unit_are_named(factor, is_ours):
    """Seven instants were compared, and their errors reported, in silence."""
    right, wrong = (
        Table(Path("file.csv"), kind, {"time_s": t}, {}, None, 2)
        for kind, t in (("truth", T), ("truth", factor * (T + 1.7)))
    )
    ours, theirs = (wrong, right) if is_ours else (right, wrong)
    ours.columns["joint_height_m"] = theirs.columns["height_m"] = motion()
    named = [remark for remark in mismatches(ours, theirs, {}, 0.0, np.inf) if "time_s spans" in remark]
    assert len(named) == (factor > 1)
    assert all(f"divide it by {factor:.0f}" in remark for remark in named)


PATH = {"x_m": np.sin(T) + 0.1 * T, "y_m": np.cos(1.7 * T)}


@pytest.mark.parametrize(
    ("theirs", "is_mirrored"),
    [
        (PATH, False),
        ({"x_m": -PATH["y_m"], "y_m": PATH["x_m"]}, False),
        ({"x_m": PATH["y_m"], "y_m": PATH["x_m"]}, True),
        ({"x_m": -PATH["x_m"], "y_m": PATH["y_m"]}, True),
        ({"x_m": PATH["x_m"], "y_m": 0 * T}, False),
    ],
    ids=["right", "turned", "exchanged", "reversed", "a line"],
)
def test_a_mirrored_path_is_named(theirs, is_mirrored):
    ours = table(**{f"joint_{name}": value + 1e-3 * NOISE for name, value in PATH.items()}, joint_height_m=motion())
    found = evaluate(ours, table("truth", height_m=motion(), **theirs)).remarks
    assert any("the path is the mirror image of that of joint" in remark for remark in found) == is_mirrored


@pytest.mark.parametrize(
    ("name", "named"), [("roll_rad", True), ("roll_deg", False), ("roll", False), ("troll_rad", False)]
)
def test_a_column_with_the_name_of_another_unit_is_named(name, named):
    """It was passed over in silence."""
    ours = table(joint_height_m=motion(), joint_roll_deg=20 * SWAY)
    found = evaluate(ours, table("truth", height_m=motion(), **{name: 20 * SWAY})).remarks
    assert found == ["truth.csv: roll_rad is not compared: state it in °, in a column roll_deg"] * named


def test_a_heading_in_degrees_is_named():
    """Headings that turn round and round."""
    ours = table(mice_heading_rad=np.angle(np.exp(1j * DRIVE["heading_rad"])))
    theirs = table("truth", heading_rad=np.radians(DRIVE["heading_rad"]))
    (remark,) = evaluate(ours, theirs).remarks
    assert "heading_rad moves like the estimate of mice" in remark and "times 0.01745" in remark
