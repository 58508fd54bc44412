"""evaluate of long files, which are read in blocks: the same figures as of tables in memory, in bounded memory."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from linkpose.cli.evaluate import command
from linkpose.errors import FileFormatError, LinkposeError, TooFewRows
from linkpose.evaluation import longfiles
from linkpose.evaluation.longfiles import evaluate_files
from linkpose.evaluation.scores import evaluate
from linkpose.recording import chunks, thinned
from linkpose.recording.table import read_table

N = 3000
T = np.arange(N) / 100
RNG = np.random.default_rng(3)


@pytest.fixture
def in_small_blocks(monkeypatch):
    """Files of more than 200 rows are long."""
    monkeypatch.setattr(chunks, "CHUNK_BYTES", 20_000)
    monkeypatch.setattr(thinned, "MOST_ROWS", 200)
    monkeypatch.setattr(longfiles, "_PIECE_ROWS", 150)
    monkeypatch.setattr(longfiles, "_MOST_OTHER_ROWS", 400)


def write(path: Path, **columns) -> Path:
    table = np.column_stack(list(columns.values()))
    rows = "".join(",".join("" if np.isnan(v) else f"{v:.7f}" for v in row) + "\n" for row in table.tolist())
    path.write_text(",".join(columns) + "\n" + rows)
    return path


def motion(t, k=1.0):
    return 0.4 * np.sin(2.1 * k * t) + 0.2 * np.sin(0.83 * t + k) + 0.1 * np.sin(0.171 * t * k + 2)


def noise(size=0.01):
    return size * RNG.standard_normal(N)


def link(t):
    columns = {"height_m": 1.6 + 0.1 * motion(t), "roll_deg": 20 * motion(t, 1.3), "pitch_deg": 15 * motion(t, 0.7)}
    columns |= {"yaw_deg": 170 + 30 * motion(t, 0.5), "x_m": motion(t, 0.9), "y_m": motion(t, 1.1)}
    columns["yaw_deg"] = (columns["yaw_deg"] + 180) % 360 - 180
    return columns


def link_estimate(clock_s=0.0):
    """Two filters with σ, a gap, a start without estimates, and yaw from another direction."""
    true = link(T + clock_s)
    ours = {f"joint_inertial_{name}": value + noise() for name, value in true.items()}
    ours["joint_inertial_yaw_deg"] += 40 + 0.01 * T
    ours |= {"joint_inertial_height_std_m": np.full(N, 0.01), "joint_inertial_yaw_std_deg": np.full(N, 0.02)}
    ours |= {"tilt_height_m": true["height_m"] + noise(0.05), "tilt_height_std_m": np.full(N, 0.03)}
    for name in ours:
        ours[name][: 25 if name.startswith("joint") else 3] = np.nan
    keep = (T < 11) | (T > 13.5)
    return {"time_s": T[keep]} | {name: value[keep] for name, value in ours.items()}


def robot(t):
    heading = 0.3 * t + motion(t, 0.4)
    return {
        "x_m": 3 * motion(t, 0.2),
        "y_m": 2 * motion(t, 0.31),
        "heading_rad": (heading + np.pi) % (2 * np.pi) - np.pi,
    }


def robot_estimate():
    true = robot(T)
    turn = 0.7
    x, y = (
        np.cos(turn) * true["x_m"] - np.sin(turn) * true["y_m"],
        np.sin(turn) * true["x_m"] + np.cos(turn) * true["y_m"],
    )
    columns = {"mice_x_m": x + 3 + noise(), "mice_y_m": y - 1 + noise(), "mice_heading_rad": true["heading_rad"] + turn}
    return {"time_s": T} | columns | {"mice_vx_m_s": motion(T)}


def chain(t):
    angle = 20 * motion(t) + 5 * t
    return {"chain_qw": np.cos(angle), "chain_qx": np.sin(angle), "chain_qy": 0 * t, "chain_qz": 0 * t}


def reference(columns, t):
    return {"time_s": t} | columns(t)


def blank_start(columns, rows):
    for name, values in columns.items():
        if name != "time_s":
            values[:rows] = np.nan
    return columns


SPARSE, DENSE = np.arange(0, 30, 0.04), np.arange(-1, 33, 0.0025)
CASES = {
    "link": (link_estimate(), reference(link, T)),
    "clocks differ": (link_estimate(0.37), reference(link, T)),
    "sparse reference": (link_estimate(), reference(link, SPARSE)),
    "dense reference": (link_estimate(), reference(link, DENSE)),
    "reference starts late": (link_estimate(), blank_start(reference(link, T), 700)),
    "robot": (robot_estimate(), blank_start(reference(robot, T) | {"vx_m_s": motion(T)}, 400)),
    "chain": ({"time_s": T} | chain(T + 0.001), reference(chain, T)),
    "no z in common": ({"time_s": T, "joint_x_m": motion(T), "joint_y_m": motion(T), "joint_z_m": T * np.nan},
                       reference(link, T)),
}  # fmt: skip


def assert_same(found, expected, tolerance):
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if isinstance(value, dict):
            assert_same(found[name], value, tolerance)
        elif isinstance(value, float):
            assert found[name] == pytest.approx(value, rel=tolerance, abs=tolerance), name
        else:
            assert found[name] == value, name


@pytest.mark.parametrize(
    ("case", "window"),
    [*((case, (None, None)) for case in CASES), ("link", (5.0, 21.003)), ("sparse reference", (5.0, 21.003))],
)
def test_blocks_give_the_figures_of_the_whole(case, window, tmp_path, in_small_blocks):
    estimate, truth = (write(tmp_path / name, **of) for name, of in zip(("e.csv", "t.csv"), CASES[case], strict=True))
    expected = evaluate(read_table(estimate), read_table(truth), *window)
    shares: list[float] = []
    found = evaluate_files(estimate, truth, None, *window, shares.append)
    assert len(found.scores) == len(expected.scores) and found.remarks == expected.remarks
    for ours, theirs in zip(found.scores, expected.scores, strict=True):
        assert_same(ours.as_dict(), theirs.as_dict(), 1e-9)
        kept = next(iter(ours.errors.values()))
        assert np.isfinite(kept.error).sum() > 0 and len(kept.time_s) == len(kept.error)
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 10
    if case == "clocks differ":
        assert expected.scores[0].time_offset_s == pytest.approx(0.37, abs=0.002)


def test_short_stretches_show_the_offset(tmp_path, in_small_blocks, monkeypatch):
    monkeypatch.setattr(longfiles, "_STRETCHES", 12)
    monkeypatch.setattr(longfiles, "_STRETCH_ROWS", 40)
    monkeypatch.setattr(longfiles, "_COARSE_ROWS", 600)
    estimate = write(tmp_path / "e.csv", **link_estimate(0.37))
    found = evaluate_files(estimate, write(tmp_path / "t.csv", **reference(link, T))).scores[0]
    assert found.time_offset_s == pytest.approx(0.37, abs=0.002)


def test_long_files_that_do_not_belong_together(tmp_path, in_small_blocks):
    estimate = write(tmp_path / "e.csv", **link_estimate())
    with pytest.raises(LinkposeError, match="no estimates"):
        evaluate_files(write(tmp_path / "t.csv", **reference(link, T)), estimate)
    with pytest.raises(LinkposeError, match="is no reference"):
        evaluate_files(estimate, write(tmp_path / "r.csv", time_s=T, roll_rad_s=T))
    with pytest.raises(TooFewRows, match="less than half"):
        evaluate_files(estimate, write(tmp_path / "s.csv", **reference(link, T[:900])))
    other = reference(link, T) | {"height_m": 1.6 + noise(), "roll_deg": noise(20), "pitch_deg": noise(20)}
    assert "hardly any motion" in evaluate_files(estimate, write(tmp_path / "o.csv", **other)).remarks[0]


def test_a_long_reference_whose_stamps_do_not_increase_is_named(tmp_path, in_small_blocks, monkeypatch):
    """All its rows would be in memory at once."""
    monkeypatch.setattr(longfiles, "_MOST_HELD_ROWS", 1_000)
    estimate = write(tmp_path / "e.csv", **link_estimate())
    truth = write(tmp_path / "t.csv", **(reference(link, T) | {"time_s": np.full(N, 5.0)}))
    with pytest.raises(FileFormatError, match=r"more than 1000 rows at about .* its time_s must increase"):
        evaluate_files(estimate, truth)


def test_the_command_scores_and_draws_long_files(tmp_path, in_small_blocks):
    estimate = write(tmp_path / "e.csv", **link_estimate())
    truth = write(tmp_path / "t.csv", **reference(link, T))
    picture = tmp_path / "p.svg"
    ran = CliRunner().invoke(command, [str(estimate), str(truth), "--json", "--plot", str(picture)])
    assert ran.exit_code == 0, ran.output
    assert [json.loads(line)["filter"] for line in ran.stdout.splitlines()] == ["joint-inertial", "tilt"]
    assert "joint-inertial" in picture.read_text()


def test_memory_does_not_grow_with_the_files(tmp_path, in_small_blocks, monkeypatch):
    """Five times the rows: only the stamps and the largest twentieth of the errors are kept of each."""
    monkeypatch.setattr(longfiles, "_COARSE_ROWS", 500)
    monkeypatch.setattr(longfiles, "_STRETCHES", 5)
    monkeypatch.setattr(longfiles, "_STRETCH_ROWS", 50)
    monkeypatch.setattr(longfiles, "_KEPT_FOR_PICTURES", 0.002)
    peaks = []
    columns = link_estimate()
    for times in (1, 1, 5):  # the first run fills caches
        many = {name: np.tile(values, times) for name, values in columns.items()}
        many["time_s"] += np.repeat(30 * np.arange(times), len(columns["time_s"]))
        estimate = write(tmp_path / "e.csv", **many)
        truth = write(tmp_path / "t.csv", **reference(link, np.arange(times * N) / 100))
        tracemalloc.start()
        evaluate_files(estimate, truth)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    rows = 5 * len(columns["time_s"])
    assert peaks[2] - peaks[1] < 8 * rows * 10  # 10 numbers a row; there are 16 columns
