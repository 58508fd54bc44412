"""estimate --mag: the magnetometer bounds the drift of yaw, follows no disturbance, and needs its calibration."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from drifting_yaw import CALIBRATED, HZ, held, run

import linkpose as lp
from linkpose.cli.estimate import command
from linkpose.errors import CannotRun, NoMagnetometer, UncalibratedMagnetometer
from linkpose.filters.magnetic_heading import MagneticHeading
from linkpose.sensors.rig import Mag, Rig
from linkpose.simulation import mag_disturbances
from linkpose.simulation.link import LinkRun
from linkpose.simulation.motion import HandMotion


def rms(error) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


@pytest.mark.parametrize("disturbance", [None, *mag_disturbances.KINDS])
def test_ten_minutes_are_never_worse_than_without(disturbance):
    for seed in range(2):
        inner, block, drift = run(seed, disturbance)
        error, std, out, f = held(inner, block, drift)
        least = 1.0  # °, of a calibration to 1 %
        assert rms(error) <= max(1.05 * rms(drift), least)
        without = np.mean(np.abs(drift) < 2 * inner.rows[:, 5])
        assert np.mean(np.abs(error) < 2 * std) > min(0.9, without - 0.15)
        assert np.all(std <= inner.rows[:, 5] + 1e-9)
        if disturbance is None:
            assert abs(error[-1]) < 1.5 and f.found.rejected_s < 5 and np.nanmedian(out[:, -1]) < 1.5
        else:
            assert f.found.largest_disturbance_uT > 4 and f.found.rejected_s > 15


@pytest.mark.parametrize("disturbance", ["building", "car"])
@pytest.mark.parametrize("seed", range(3))
def test_a_yaw_whose_std_falls_does_not_take_on_the_first_directions(disturbance, seed):
    """As of a gyro with the data sheet's bias, which the motion then shows. The yaw itself hardly drifts."""
    inner, block, drift = run(seed, disturbance, drift_deg_s=0.003, minutes=5)
    inner.rows[:, 5] = np.maximum(2.0, 40.0 * np.exp(-block.time_s / 15.0))
    error, *_ = held(inner, block, drift)
    assert rms(error) < max(1.1 * rms(drift), rms(drift) + 0.2)


def test_a_disturbance_is_a_function_of_kind_seed_and_time():
    t = np.linspace(0.0, 300.0, 601)
    moving = HandMotion(np.random.default_rng(0), 1.0, None)
    for kind in mag_disturbances.KINDS:
        first, again, other = (mag_disturbances.Disturbance(kind, seed) for seed in (1, 1, 2))
        whole = first.field(moving.at(t), t)
        assert np.allclose(again.field(moving.at(t[100:]), t[100:]), whole[100:], rtol=0, atol=1e-9)
        assert np.abs(other.field(moving.at(t), t) - whole).max() > 1.0
        assert 1.0 < np.sqrt(np.mean(whole**2)) < 30.0


def test_the_drift_is_bounded():
    without, with_mag = [], []
    for seed in range(3):
        inner, block, drift = run(seed, None)
        error, *_ = held(inner, block, drift)
        without.append(rms(drift[len(drift) // 2 :]))
        with_mag.append(rms(error[len(drift) // 2 :]))
    assert np.mean(with_mag) < 0.4 * np.mean(without)


@pytest.mark.parametrize("seed", range(3))
def test_a_calibration_that_does_not_fit_does_no_harm(seed):
    """20 µT of hard iron that the rig file does not state."""
    inner, block, drift = run(seed, None, hard_iron_uT=20.0)
    error, *_ = held(inner, block, drift)
    assert rms(error) < 1.05 * rms(drift) + 0.2


def test_a_disturbance_that_grows_slowly_moves_the_heading_little():
    """Sideways by 0.2 µT a minute, up to 4 µT: strength and dip stay, and 4 µT would be 8°."""
    inner, block, drift = run(1, None)
    moving_out = np.minimum(block.time_s / 60 * 0.4, 4.0)
    level = np.column_stack([np.zeros(len(block)), moving_out, np.zeros(len(block))])
    error, std, _, _ = held(inner, replace(block, mag_uT=block.mag_uT + level), drift)
    assert np.abs(error).max() < 8.0 and np.mean(np.abs(error) < 3 * std) > 0.9


def test_north_and_disturbance_are_reported():
    inner, block, drift = run(0, "desk", minutes=1)
    _, _, out, f = held(inner, block, drift)
    assert f.columns[-1] == "inertial_mag_disturbance_uT"
    assert abs(f.found.north_deg) < 2.5  # the simulated north is the n frame's X axis
    assert np.nanmedian(out[40 * HZ :, -1]) == pytest.approx(np.linalg.norm(mag_disturbances.DESK_UT), abs=2.0)
    assert np.isnan(out[: HZ - 1, -1]).all()


@pytest.mark.parametrize("size", [1, 7, 333])
def test_blocks_of_any_length_give_the_same_to_the_bit(size):
    whole = held(*run(2, "iron", minutes=0.7))[2]
    inner, block, _ = run(2, "iron", minutes=0.7)
    f = MagneticHeading(inner, CALIBRATED)
    parts = [f.process(block[at : at + size]) for at in range(0, len(block), size)]
    assert np.array_equal(np.concatenate(parts), whole, equal_nan=True)


def test_what_it_refuses():
    block = LinkRun(1, 0, 2.0, mag=True, errors="datasheet").measurements()
    rig = Rig().with_j2s((-0.09, -0.04, 1.65))
    with pytest.raises(UncalibratedMagnetometer):
        lp.estimate(block, ["joint-inertial"], rig=rig, mag=True)
    with pytest.raises(NoMagnetometer):
        lp.estimate(LinkRun(1, 0, 2.0).measurements(), ["joint-inertial"], rig=rig, mag=True)
    calibrated = replace(rig, mag=Mag((1.0, 2.0, 3.0)))
    with pytest.raises(CannotRun, match="none of the filters"):
        lp.estimate(block, ["tilt"], rig=calibrated, mag=True)


def test_an_uncalibrated_magnetometer_gets_one_sentence_with_its_cure(tmp_path: Path, linkpose) -> None:
    """Whether the recording brings no calibration, or the named rig file replaces the one that it brings."""
    for errors in ("datasheet", "calibrated"):
        files = ("-o", tmp_path / f"{errors}.csv", "--truth", tmp_path / f"{errors}-truth.csv")
        assert linkpose("simulate", "link", "--mag", "--errors", errors, "--duration", 3, *files).status == 0
    rig = tmp_path / "rig.toml"
    Rig().with_j2s((-0.09, -0.04, 1.65)).save(rig)
    brought = linkpose("estimate", tmp_path / "datasheet.csv", "--mag", "-o", tmp_path / "e.csv", "-q")
    named = linkpose("estimate", tmp_path / "calibrated.csv", "--rig", rig, "--mag", "-o", tmp_path / "e.csv", "-q")
    assert brought.status == named.status == 1 and brought.err == named.err
    assert "the rig has no [mag]" in named.err and "linkpose calibrate mag RECORDING --rig rig.toml" in named.err


@pytest.mark.parametrize("port", ["sim://link", "sim://mice"])
def test_a_simulated_board_without_a_magnetometer_names_the_one_that_has_it(port: str, linkpose) -> None:
    done = linkpose("estimate", "--live", "--port", port, "--mag", "--duration", 1, "-q")
    assert done.status == 1 and f"{port} simulates no magnetometer; type --port 'sim://link?mag=1'" in done.err


def test_the_command(tmp_path: Path, linkpose) -> None:
    recording, estimates = tmp_path / "r.csv", tmp_path / "e.csv"
    typed = ["simulate", "link", "--mag-disturbance", "iron", "--duration", 30, "-o", recording, "--truth"]
    assert linkpose(*typed, tmp_path / "t.csv").status == 0
    done = CliRunner().invoke(
        command, [str(recording), "--mag", "--filter", "joint-inertial", "-o", str(estimates)], catch_exceptions=False
    )
    assert "The magnetometer held the heading for" in done.stderr and "µT at most" in done.stderr
    header = next(line for line in estimates.read_text().splitlines() if not line.startswith("#"))
    assert "joint_inertial_mag_disturbance_uT" in header
    closing = json.loads(estimates.read_text().splitlines()[-1].removeprefix("# "))
    assert closing["mag"]["rejected_s"] > 3 and closing["mag"]["largest_disturbance_uT"] > 10
    assert -180 <= closing["mag"]["magnetic_north_deg"] <= 180
    uncalibrated = tmp_path / "u.csv"
    linkpose("simulate", "link", "--mag", "--errors", "datasheet", "--duration", 2, "-o", uncalibrated, "--truth",
             tmp_path / "u_t.csv")  # fmt: skip
    refused = linkpose("estimate", uncalibrated, "--mag", "--filter", "joint-inertial")
    assert refused.status == 1 and "linkpose calibrate mag" in refused.err and "Traceback" not in refused.err
