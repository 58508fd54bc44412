"""calibrate mice: scale and angle come back from a line and a turn, and what is missing is named."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from linkpose.calibration.mice import calibrate_mice, with_calibration
from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.rig import Mouse, Rig
from linkpose.simulation.drive import Move
from linkpose.simulation.mice import Fault, MiceRun, ring
from linkpose.wire.messages import SampleFlags

LENGTH_M = 2.0


def driven(path: str, seed: int = 3, errors: str = "datasheet", **more) -> tuple[MiceRun, Recording]:
    run = MiceRun(seed, 12.0, path=path, errors=errors, length_m=LENGTH_M, **more)
    return run, Recording(Path(f"{path}.csv"), run.measurements(), run.rig, 100.0, {}, [])


@pytest.mark.parametrize("mice", [1, 2, 3, 4])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_scale_and_angle_of_each_mouse_come_back(mice, seed):
    run, line = driven("line", seed, mice=ring(mice))
    _, turn = driven("turn", seed, mice=ring(mice))
    found = calibrate_mice([turn, line], run.rig, LENGTH_M)
    for i, mouse in enumerate(found):
        assert mouse.mouse == i + 1
        assert mouse.counts_per_m == pytest.approx(run.true_counts_per_m[i], rel=0.003)
        assert mouse.angle_deg == pytest.approx(run.true_angle_deg[i], abs=0.4 if mice == 1 else 0.2)
        assert mouse.counts_per_m_std < 0.002 * mouse.counts_per_m and mouse.residual_mm < 2


@pytest.mark.parametrize("mice", [2, 3])
def test_a_line_of_unknown_length_will_do_where_the_turn_tells_the_scale(mice):
    run, line = driven("line", mice=ring(mice))
    _, turn = driven("turn", mice=ring(mice))
    found = calibrate_mice([turn, line], run.rig, None)
    for i, mouse in enumerate(found):
        assert mouse.counts_per_m == pytest.approx(run.true_counts_per_m[i], rel=0.01)
        assert abs(mouse.counts_per_m - run.true_counts_per_m[i]) < 4 * mouse.counts_per_m_std
        assert mouse.angle_deg == pytest.approx(run.true_angle_deg[i], abs=0.2)


def test_one_mouse_needs_the_length():
    run, line = driven("line", mice=ring(1))
    _, turn = driven("turn", mice=ring(1))
    with pytest.raises(LinkposeError, match="measure the length of the line"):
        calibrate_mice([turn, line], run.rig, None)


def test_mice_mounted_at_any_angle_are_told():
    mounted = tuple(replace(mouse, angle_deg=angle) for mouse, angle in zip(ring(3), (0, 120, -95), strict=True))
    run, line = driven("line", errors="none", mice=mounted)
    _, turn = driven("turn", errors="none", mice=mounted)
    unknown = Rig(mouse=tuple(replace(mouse, angle_deg=0.0, counts_per_m=5000.0) for mouse in mounted))
    rig = with_calibration(unknown, calibrate_mice([line, turn], unknown, LENGTH_M))
    for mouse, true in zip(rig.mouse, run.mice, strict=True):
        assert mouse.angle_deg == pytest.approx(true.angle_deg, abs=0.01)
        assert mouse.counts_per_m == pytest.approx(8000, rel=1e-3)
        assert (mouse.x_m, mouse.y_m) == (true.x_m, true.y_m)


def test_a_place_that_was_measured_wrong_shows_in_the_residual_and_at_last_refuses():
    run, line = driven("line", errors="none")
    _, turn = driven("turn", errors="none")

    def moved(by_m: float) -> Rig:
        first, *others = run.mice
        return Rig(mouse=(replace(first, x_m=first.x_m + by_m), *others))

    residuals = [calibrate_mice([line, turn], moved(by), LENGTH_M)[0].residual_mm for by in (0.0, 0.004)]
    assert residuals[1] > 5 * residuals[0]
    with pytest.raises(LinkposeError, match="contradict one another"):
        calibrate_mice([line, turn], moved(0.05), LENGTH_M)


def cut(recording: Recording, name: str, **changes) -> Recording:
    return replace(recording, path=Path(name), measurements=replace(recording.measurements, **changes))


def broken() -> dict[str, tuple[list[Recording], Rig, str]]:
    run, line = driven("line")
    _, turn = driven("turn")
    flags = line.measurements.flags.copy()
    flags[600] |= int(SampleFlags.GAP_BEFORE)
    no_gyro = np.full_like(line.measurements.gyro_rad_s, np.nan)
    half = replace(turn, measurements=turn.measurements[:600])
    moving = replace(line, measurements=line.measurements[300:])
    _, away = driven("line", faults=(Fault("unplug", 2, 5.0, 6.0),))
    still = replace(line, measurements=line.measurements[:100])
    counts = line.measurements.mice_counts.copy()
    counts[:, 2] = 0.0
    dead = cut(line, "dead.csv", mice_counts=counts)
    counts = turn.measurements.mice_counts.copy()
    counts[600:, 1] = 0.0
    dies = cut(turn, "dies.csv", mice_counts=counts)
    slid = cut(line, "slid.csv", mice_counts=np.round(1.04 * line.measurements.mice_counts))
    return {
        "no turn": ([line], run.rig, "no recording is of a full turn"),
        "no line": ([turn], run.rig, "no recording is of a straight line; drive one of 2 m"),
        "half a turn": ([line, half], run.rig, "neither a straight line nor full turns"),
        "no rest": ([moving, turn], run.rig, "line.csv begins in motion"),
        "no motion": ([still, turn], run.rig, "line.csv: no mouse moves in it"),
        "a dead mouse": ([dead, turn], run.rig, "mouse 3 counts 0 while another counts 1"),
        "a mouse that died in the turn": ([line, dies], run.rig, "mice contradict one another .* mouse 2 most of all"),
        "a slippery floor": ([slid, turn], run.rig, "line and turn contradict each other.* 3.7 % fewer per metre"),
        "a mouse away": ([away, turn], run.rig, "mouse 2 is away at 5.00 s"),
        "lost samples": ([cut(line, "lost.csv", flags=flags), turn], run.rig, "samples were lost before 6.00"),
        "no gyro": ([cut(line, "blind.csv", gyro_rad_s=no_gyro), turn], run.rig, "blind.csv holds no gyro"),
        "no places": ([line, turn], Rig(), "lacks the positions of the mice"),
        "a mouse too many": ([line, turn], Rig(mouse=(*run.mice, Mouse(0.0, 0.0))), "has 3 mice, and the rig file 4"),
    }


@pytest.mark.parametrize("case", broken())
def test_what_is_missing_is_named(case):
    recordings, rig, reason = broken()[case]
    with pytest.raises(LinkposeError, match=reason):
        calibrate_mice(recordings, rig, LENGTH_M)


def test_the_command_completes_the_rig_file(linkpose, tmp_path):
    rig_file, truth = tmp_path / "rig.toml", tmp_path / "t.csv"
    rig_file.write_text(Rig(mouse=ring(3)).with_j2s((0.0, 0.0, 1.0)).to_toml())
    for path in ("line", "turn"):
        more = ("--path", path, "--duration", 12, "--errors", "datasheet", "--force")
        assert linkpose("simulate", "mice", "-o", tmp_path / f"{path}.csv", "--truth", truth, *more).status == 0
    recordings = (tmp_path / "line.csv", tmp_path / "turn.csv")
    done = linkpose("calibrate", "mice", *recordings, "--rig", rig_file, "--length", 2, "--json")
    assert done.status == 0, done.err
    rows = [json.loads(line) for line in done.out.splitlines()]
    rig = Rig.load(rig_file)
    assert rig.joint.j2s_m == (0.0, 0.0, 1.0)
    for row, mouse in zip(rows, rig.mouse, strict=True):
        assert mouse.counts_per_m == pytest.approx(row["counts_per_m"], abs=0.01)
        assert mouse.angle_deg == pytest.approx(row["angle_deg"], abs=1e-4)


def turned(turns: float, seed: int, duration_s: float, rig: Rig | None = None, **more) -> Recording:
    run = MiceRun(seed, duration_s, errors="datasheet", drive=Move((0.0, 0.0, 2 * np.pi * turns), duration_s), **more)
    return Recording(Path("turns.csv"), run.measurements(), rig or run.rig, 100.0, {}, [])


@pytest.mark.parametrize(("turns", "closing_deg"), [(10, 1.0), (-10, 0.5), (1, 1.0)])
def test_scale_angle_and_position_are_within_their_standard_deviations(turns, closing_deg):
    """Mice a millimetre from their places, turns that do not close, and a gyro that was never calibrated."""
    z = []
    for seed in range(8):
        rng = np.random.default_rng([seed, 7])
        exact, ruler = ring(3), rng.normal(0, 1e-3, (3, 2)).tolist()
        stated = Rig(
            mouse=tuple(replace(m, x_m=m.x_m + x, y_m=m.y_m + y) for m, (x, y) in zip(exact, ruler, strict=True))
        )
        run, line = driven("line", seed)
        whole = turns + np.radians(closing_deg) * rng.standard_normal() / (2 * np.pi)
        found = calibrate_mice([line, turned(whole, seed, 4.0 * abs(turns) + 8.0)], stated, LENGTH_M)
        off_x, off_y = (np.array([getattr(m, name) for m in found]) for name in ("x_m", "y_m"))
        off_x, off_y = off_x - [m.x_m for m in exact], off_y - [m.y_m for m in exact]
        for i, mouse in enumerate(found):
            z += [
                (mouse.counts_per_m - run.true_counts_per_m[i]) / mouse.counts_per_m_std,
                (mouse.angle_deg - run.true_angle_deg[i]) / mouse.angle_std_deg,
                (off_x - off_x.mean())[i] / mouse.position_std_m,
                (off_y - off_y.mean())[i] / mouse.position_std_m,
            ]
            assert mouse.counts_per_m == pytest.approx(run.true_counts_per_m[i], rel=0.003)
            assert mouse.angle_deg == pytest.approx(run.true_angle_deg[i], abs=0.2)
    z = np.abs(z).reshape(-1, 4)
    assert (np.mean(z < 2.0, axis=0) > 0.9).all() and z.max() < 4.0


def test_more_turns_than_such_a_gyro_can_count_are_refused():
    run, line = driven("line")
    many = MiceRun(3, 60.0, drive=Move((0.0, 0.0, 28 * np.pi), 60.0))
    turns = Recording(Path("turns.csv"), many.measurements(), many.rig, 100.0, {}, [])
    with pytest.raises(LinkposeError, match="has 14 full turns"):
        calibrate_mice([line, turns], run.rig, LENGTH_M)
