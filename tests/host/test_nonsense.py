"""Recordings whose values contradict their units or each other: named, with what to do."""

from __future__ import annotations

import dataclasses
import functools
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import linkpose
from linkpose.errors import FileFormatError
from linkpose.recording.consistency import contradiction
from linkpose.recording.reader import load_recording
from linkpose.recording.units import suspicions
from linkpose.sensors.conversion import GAP_BEFORE
from linkpose.sensors.measurements import Measurements
from linkpose.simulation.chain import ChainRun
from linkpose.simulation.link import LinkRun

HEAD = '# linkpose recording 1\n# {"settings": {"sample_rate_hz": 100}}\n'
NAMES = [
    "time_s",
    *(f"accel_{a}_m_s2" for a in "xyz"),
    *(f"gyro_{a}_rad_s" for a in "xyz"),
    "pressure_Pa",
    "baro_fresh",
]
N = 600


def columns() -> dict[str, np.ndarray]:
    """Six seconds of a link that swings by ±0.5 rad about its y axis, with rests at both ends."""
    rng = np.random.default_rng(3)
    time_s = np.arange(N) / 100
    swing = np.clip(np.minimum(time_s - 1, 5 - time_s), 0, 1)
    angle = 0.5 * swing * np.sin(2 * np.pi * 0.8 * time_s)
    gyro_y = np.gradient(angle, time_s)
    values = [time_s, -9.81 * np.sin(angle), np.zeros(N), 9.81 * np.cos(angle), np.zeros(N), gyro_y, np.zeros(N)]
    noise = [0, 0.02, 0.02, 0.02, 1e-3, 1e-3, 1e-3]
    noisy = [value + rng.normal(0, std, N) if std else value for value, std in zip(values, noise, strict=True)]
    return dict(zip(NAMES, [*noisy, 101_300 + np.round(rng.normal(0, 4, N)), np.ones(N)], strict=True))


def remarks(tmp_path: Path, change: Callable[[dict[str, np.ndarray]], object]) -> str:
    table = columns()
    change(table)
    path = tmp_path / "r.csv"
    rows = "\n".join(",".join(f"{value:.9g}" for value in row) for row in np.column_stack(list(table.values())))
    path.write_text(f'{HEAD}{",".join(table)}\n{rows}\n# {{"samples": {N}}}\n')
    recording = load_recording(path)
    return "\n".join(recording.remarks)


def scale(factor: float, *names: str) -> Callable[[dict[str, np.ndarray]], None]:
    def change(table: dict[str, np.ndarray]) -> None:
        for name in NAMES:
            if name.startswith(names):
                table[name] = table[name] * factor

    return change


def in_order(table: dict[str, np.ndarray], rows: np.ndarray) -> None:
    """Brings the rows into this order, and leaves the times."""
    table.update({name: values[rows] for name, values in table.items() if name != "time_s"})


@functools.cache
def fast_measurements() -> Measurements:
    return LinkRun(3, 1, 12.0).measurements()


def fast_swing() -> dict[str, np.ndarray]:
    """Twelve seconds about a joint 1.65 m away, up to 60° and 3 rad/s to all sides, from a file without metadata."""
    found = fast_measurements()
    axes = {"accel": found.accel_m_s2, "gyro": found.gyro_rad_s}
    columns = [found.time_s, *(values[:, i] for values in axes.values() for i in range(3))]
    return dict(zip(NAMES, columns, strict=False))


def sentences(measurements: Measurements, rate_hz: float | None = None) -> list[str]:
    return [found.sentence for found in suspicions(measurements, rate_hz)]


def fast_remarks(change: Callable[[dict[str, np.ndarray]], object]) -> str:
    table = fast_swing()
    change(table)
    time_s, *values = table.values()
    accel, gyro = np.split(np.stack(values, axis=1), 2, axis=1)
    return "\n".join(sentences(Measurements.from_imu(time_s, accel, gyro)))


def exchange(one: str, other: str) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda table: table.update({one: table[other], other: table[one]})


def slowly_in_degrees(table: dict[str, np.ndarray]) -> None:
    """The same swing in ten times the time: its rates in °/s are within the range of rad/s."""
    scale(10.0, "time")(table)
    scale(18 / np.pi, "gyro")(table)


def later(sensor: str, rows: int) -> Callable[[dict[str, np.ndarray]], None]:
    def change(table: dict[str, np.ndarray]) -> None:
        for name in [name for name in table if name.startswith(sensor)]:
            table[name] = np.concatenate([np.full(rows, table[name][0]), table[name][:-rows]])

    return change


FAST = [
    (lambda table: None, None),
    (scale(180 / np.pi, "gyro"), "is it in °/s?"),
    (slowly_in_degrees, "gyro_* states 57 times the rotation of gravity: is it in °/s?"),
    (scale(np.pi / 180, "gyro"), "gyro_* states 0.01745 times the rotation of gravity"),
    (scale(2.0, "gyro"), "gyro_* states 2 times the rotation of gravity"),
    (scale(0.5, "gyro"), "gyro_* states 0.5 times the rotation of gravity"),
    (scale(-1.0, "gyro"), "gyro_* states the reverse"),
    (scale(0.0, "gyro_y"), "gyro_y is 0 in all rows: the gyro gives no reading there"),
    (scale(10.0, "time"), "if time_s is wrong, multiply that by 0.1"),
    (scale(0.001, "time"), "if time_s is wrong, multiply that by 1000"),
    (exchange("accel_x_m_s2", "accel_y_m_s2"), "do not have the same axes (accel x, y, z fit as y, x, z)"),
    (exchange("gyro_y_rad_s", "gyro_z_rad_s"), "do not have the same axes (gyro x, y, z fit as x, z, y)"),
    (scale(-1.0, "gyro_z"), "do not have the same axes (gyro x, y, z fit as x, y, -z)"),
    (scale(-1.0, "accel_z"), "do not have the same axes (accel x, y, z fit as x, y, -z)"),
    (scale(2.0, "accel_x"), "accel_x is 2 times what the motion in the other columns shows"),
    (scale(0.5, "accel_y"), "accel_y is 0.5 times what the motion in the other columns shows"),
    (scale(2.0, "gyro_x"), "gyro_x is 2 times what the motion in the other columns shows"),
    (scale(0.5, "gyro_y"), "multiply it by 2"),
    (scale(0.001, "accel_y"), "accel_y is 0.001 times what the motion in the other columns shows"),
    (scale(0.001, "gyro_z"), "gyro_z is 0.001 times what the motion in the other columns shows"),
    (scale(1 / 9.80665, "accel_x"), "accel_x is 0.101972 times what the motion in the other columns shows"),
    (scale(10.0, "gyro_y"), "gyro_y is 10 times what the motion in the other columns shows"),
    (scale(0.1, "gyro_x"), "gyro_x is 0.1 times what the motion in the other columns shows"),
    (scale(180 / np.pi, "accel_y"), "more than the sensor reads: check the unit of each axis"),
    (
        lambda table: table.update({f"accel_{a}_m_s2": 0 * table["time_s"] + 3 for a in "xyz"}),
        "is the same in all rows while",
    ),
    (later("gyro", 30), "gyro_* comes later than accel_* by 0.3 s, by the motion that both describe"),
    (later("accel", 10), "accel_* comes later than gyro_* by 0.1 s, by the motion that both describe"),
    (scale(0.0, "accel_x"), "accel_x is 0 in all rows: the accelerometer gives no reading there"),
    (scale(0.0, "accel_z"), "accel_z is 0 in all rows: the accelerometer gives no reading there"),
]


@pytest.mark.parametrize(
    ("change", "sentence"),
    FAST,
    ids=[
        "right", "°/s", "°/s slowly", "rad/s twice", "twice", "half", "backwards", "one axis", "time x 10",
        "milliseconds", "accel exchanged", "gyro exchanged", "one axis of the gyro", "one axis backwards",
        "one axis twice", "one axis half", "one axis of the gyro twice", "one axis of the gyro half",
        "one axis in km/s²", "one axis of the gyro in krad/s", "one axis in g",
        "one axis of the gyro ten times", "one axis of the gyro a tenth", "one axis in degrees", "no accel",
        "gyro later", "accel later", "no accel_x", "no accel_z",
    ],
)  # fmt: skip
def test_a_fast_swing_shows_whether_gyro_and_accelerometer_agree(change, sentence: str | None) -> None:
    """Whatever J2S and the attitude are, without any rest."""
    found = fast_remarks(change)
    assert found == "" if sentence is None else sentence in found


def of_second(name: str, factor: float) -> Callable[[Measurements], dict[str, np.ndarray]]:
    return lambda measured: {name: factor * getattr(measured, name)}


def copied(measured: Measurements) -> dict[str, np.ndarray]:
    return {"gyro2_rad_s": measured.gyro_rad_s}


SECOND = [
    (lambda measured: {}, None),
    (of_second("accel2_m_s2", 1 / 9.80665), "(median), not about 9.80665: is it in g? multiply it by 9.80665"),
    (of_second("accel2_m_s2", 2.0), "while the sensor is still, and gravity is 9.8: check the range (accel_range_g)"),
    (of_second("gyro2_rad_s", 180 / np.pi), "rad/s, more than the sensor reads: is it in °/s?"),
    (of_second("gyro2_rad_s", 0.0), "imu2_gyro_* is 0 in all rows"),
    (copied, "of 2000 rows, which no two sensors do: were the columns copied?"),
]


def second_remarks(seed: int, change: Callable[[Measurements], dict[str, np.ndarray]]) -> list[str]:
    measured = ChainRun("hinge", seed, 20.0).measurements()
    return sentences(dataclasses.replace(measured, **change(measured)))


@pytest.mark.parametrize(("change", "sentence"), SECOND, ids=[str(sentence)[:40] for _, sentence in SECOND])
@pytest.mark.parametrize("seed", [2, 3])
def test_a_second_sensor_is_judged_as_the_first(seed: int, change, sentence: str | None) -> None:
    """Only the filter of chains noticed that its readings were wrong, and copied ones passed for two sensors."""
    found = second_remarks(seed, change)
    assert found == [] if sentence is None else [sentence in each for each in found] == [True], found


def on_a_robot(z: float) -> list[str]:
    """With mice that count, and gravity along this direction of the z axis, and along x."""
    measured = ChainRun("hinge", 2, 20.0).measurements()
    accel = np.tile([9.80665 * np.sqrt(1 - z**2), 0.0, 9.80665 * z], (len(measured), 1))
    return sentences(dataclasses.replace(measured[:500], accel_m_s2=accel[:500], mice_counts=np.zeros((500, 2, 2))))


@pytest.mark.parametrize("z", [1.0, 0.8, 0.5, 0.0, -1.0])
def test_a_sensor_of_a_robot_that_is_not_upright_is_named(z: float) -> None:
    assert any("points up: check its mounting" in remark for remark in on_a_robot(z)) == (z < 0.7)


def put(name: str, row: int | slice, value: float) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda table: table[name].__setitem__(row, value)


def test_a_plausible_recording_has_no_remark(tmp_path: Path) -> None:
    assert remarks(tmp_path, lambda table: None) == ""


WRONG = [
    (scale(2.0, "accel"), "accel_* is 19.6 m/s² while the sensor is still"),
    (scale(0.5, "accel"), "accel_* is 4.9"),
    (scale(1000.0, "accel"), "is it in mm/s²? multiply it by 0.001"),
    (scale(0.0, "accel"), "the IMU reads all zeros"),
    (scale(180 / np.pi, "gyro"), "is it in °/s?"),
    (scale(2.0, "gyro"), "multiply it by 0.5"),
    (scale(0.5, "gyro"), "check the range (gyro_range_deg_s) and the unit, and multiply it by 2"),
    (scale(0.01, "gyro"), "multiply it by 100"),
    (scale(-1.0, "gyro"), "gyro_* states the reverse of the rotation of gravity"),
    (scale(0.0, "gyro"), "gyro_* is 0 in all rows"),
    (scale(10.0, "time"), "multiply time_s by 0.1"),
    (scale(1 / 133.322, "pressure"), "is it in mmHg? multiply it by 133.322"),
    (scale(0.01, "pressure"), "is it in hPa? multiply it by 100"),
    (scale(1 / 6894.757, "pressure"), "is it in psi? multiply it by 6894.757"),
    (scale(1 / 3386.389, "pressure"), "is it in inHg? multiply it by 3386.389"),
    (scale(1e-5, "pressure"), "is it in bar? multiply it by 100000"),
    (scale(100.0, "pressure"), "is it in hundredths of Pa? multiply it by 0.01"),
    (scale(0.5, "pressure"), "pressure_Pa is 50650 (median), as above 5100 m of altitude"),
    (lambda table: in_order(table, np.random.default_rng(6).permutation(N)), "brought out of order, and time_s not?"),
    (lambda table: table.update(baro_temp_degC=np.full(N, 24_900.0)), "separator of thousands?"),
]


@pytest.mark.parametrize(
    ("change", "sentence"),
    WRONG,
    ids=[
        "twice",
        "half",
        "mm/s²",
        "zero",
        "°/s",
        "twice the rate",
        "half the rate",
        "a hundredth",
        "backwards",
        "no gyro",
        "time",
        "mmHg",
        "hPa",
        "psi",
        "inHg",
        "bar",
        "hundredths",
        "half the pressure",
        "shuffled",
        "thousands",
    ],
)
def test_a_wrong_unit_is_named(tmp_path: Path, change: Callable[[dict[str, np.ndarray]], None], sentence: str) -> None:
    assert sentence in remarks(tmp_path, change)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (put("time_s", slice(None), 1.0), "time_s is 1 in all rows; it must increase"),
        (put("time_s", N - 1, np.inf), f"line {N + 3}: time_s is inf; it must be a number of seconds"),
        (put("time_s", N - 1, 1e300), f"line {N + 3}: time_s is 1e"),
        (put("baro_fresh", 10, 2.0), "line 14: baro_fresh is 2; it must be 0 or 1"),
        (lambda table: table.update(flags=np.full(N, 0.5)), "line 4: flags must be a whole number"),
    ],
    ids=["one stamp", "inf", "huge", "fresh", "flags"],
)
def test_an_impossible_value_is_refused_with_its_line(
    tmp_path: Path, change: Callable[[dict[str, np.ndarray]], None], sentence: str
) -> None:
    with pytest.raises(FileFormatError) as caught:
        remarks(tmp_path, change)
    assert sentence in str(caught.value)


@pytest.mark.parametrize("rate", ["0", "-1", "1e200", "NaN", '"100"', "9" * 400, "[]", "100"])
def test_an_impossible_rate_in_the_metadata_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate: str
) -> None:
    """It was passed over in silence."""
    monkeypatch.setattr(sys.modules[__name__], "HEAD", HEAD.replace("100", rate))
    found = remarks(tmp_path, lambda table: None)
    assert ("sample_rate_hz in the metadata is" in found) == (rate != "100")


IMU2 = {f"imu2_{name}": name for name in NAMES[1:7]}
BOTH_VALID = 65_537.0


def with_second_sensor(table: dict[str, np.ndarray], flags: np.ndarray | None = None) -> None:
    table.update({second: table[first] * 1.0001 for second, first in IMU2.items()})
    if flags is not None:
        table["flags"] = flags


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_flags_that_contradict_the_readings_are_named(tmp_path: Path, factor: float) -> None:
    """A wrong factor in `flags` made the filters leave out all readings without a word."""
    found = remarks(tmp_path, lambda table: with_second_sensor(table, np.full(N, factor * BOTH_VALID)))
    for sensor in ("the IMU", "the second IMU"):
        named = f"flags marks {sensor} as invalid in 600 rows with a reading" in found
        assert named == (factor != 1)
    assert found.count("If the column was changed, delete it") == (0 if factor == 1 else 2)


def test_without_flags_every_reading_is_valid(tmp_path: Path) -> None:
    """Those of the second sensor, too: chains were blank without the column."""
    assert remarks(tmp_path, with_second_sensor) == ""
    assert (load_recording(tmp_path / "r.csv").measurements.flags == BOTH_VALID).all()


@pytest.mark.parametrize("pressure", [500.0, 200_000.0])
def test_one_impossible_pressure_is_left_out(tmp_path: Path, pressure: float) -> None:
    assert remarks(tmp_path, put("pressure_Pa", 100, pressure)) == ""
    recording = load_recording(tmp_path / "r.csv")
    assert np.isnan(recording.measurements.pressure_Pa[100])
    assert recording.health["baro"]["invalid"] == {"out of range": 1}


def repeating(rows: int) -> Callable[[dict[str, np.ndarray]], None]:
    """Each reading stands in so many rows, all of them marked as new."""

    def change(table: dict[str, np.ndarray]) -> None:
        table["pressure_Pa"] = np.repeat(table["pressure_Pa"][::rows], rows)[:N]

    return change


def coarse(table: dict[str, np.ndarray]) -> None:
    """As in a file in hPa with one decimal: a new reading seldom differs from the one before."""
    table["pressure_Pa"] = np.round(table["pressure_Pa"] / 10) * 10


@pytest.mark.parametrize(
    ("change", "is_named"),
    [(repeating(1), False), (repeating(2), True), (repeating(4), True), (coarse, False)],
    ids=["all new", "twice", "four times", "coarse"],
)
def test_readings_that_are_repeated_and_marked_as_new_are_named(tmp_path: Path, change, is_named: bool) -> None:
    assert ("baro_fresh is 1 in 600 rows, and pressure_Pa changes in" in remarks(tmp_path, change)) == is_named


@pytest.mark.parametrize("shake_hz", [9.0, 12.5, 24.0])
def test_a_vibration_is_no_disorder(shake_hz: float) -> None:
    """At 50 Hz and this frequency, readings change from row to row as much as over the recording."""
    time_s = np.arange(1000) / 50
    wave = np.sin(2 * np.pi * shake_hz * time_s + 0.2)[:, None]
    noise = np.random.default_rng(7).normal(0.0, 1.0, (1000, 6))
    accel = [0.0, 0.0, 9.81] + 3.0 * wave + 0.05 * noise[:, :3]
    found = sentences(Measurements.from_imu(time_s, accel, wave + 0.01 * noise[:, 3:]), 50.0)
    assert not any("order" in sentence for sentence in found)


@pytest.mark.parametrize("every", [2, 3])
def test_a_recording_with_many_losses_is_not_called_one_with_wrong_times_or_repeated_readings(every: int) -> None:
    """Every second sample was lost: "multiply time_s by 0.5", and "pressure_Pa changes in 41 of 147 rows"."""
    rows = np.arange(0, 1200, every)
    pressure_pa = 100_000 + np.random.default_rng(3).normal(0.0, 3.0, 400)[rows // 3]
    fresh = np.diff(rows // 3, prepend=-1) > 0
    flags = np.full(len(rows), GAP_BEFORE | 9, dtype=np.int64)
    still = np.tile([0.0, 0.0, 9.81], (len(rows), 1)) + np.random.default_rng(4).normal(0.0, 0.02, (len(rows), 3))
    values = Measurements.from_imu(rows / 100, still, np.random.default_rng(5).normal(0.0, 0.001, (len(rows), 3)))
    assert not suspicions(dataclasses.replace(values, pressure_Pa=pressure_pa, baro_fresh=fresh, flags=flags), 100.0)


@pytest.mark.parametrize(("every", "is_named"), [(2, True), (5, True), (20, False)])
def test_many_single_missing_readings_are_named(tmp_path: Path, every: int, is_named: bool) -> None:
    """No state of the sensor lasts long enough to be reported."""
    found = remarks(tmp_path, put("gyro_y_rad_s", slice(None, None, every), np.nan))
    assert (f"the IMU has no valid reading in {N // every} of 600 rows" in found) == is_named


@pytest.mark.parametrize("rows", [1, 2, 49, 150, 1200])
@pytest.mark.parametrize("factor", [1.0, 1e12])
def test_few_rows_and_huge_values_are_no_contradiction(rows: int, factor: float) -> None:
    table = {name: factor * values[:rows] for name, values in fast_swing().items()}
    accel, gyro = np.split(np.stack(list(table.values())[1:], axis=1), 2, axis=1)
    assert contradiction(Measurements.from_imu(fast_swing()["time_s"][:rows], accel, gyro)) == ""


def test_each_remark_of_the_documentation_is_produced(tmp_path: Path) -> None:
    page = (Path(linkpose.__file__).parents[1] / "docs" / "messages.md").read_text(encoding="utf-8")
    shown = re.findall(r"^\| `([^`]+)` \|", page.split("\n## Remarks on recordings")[1].split("\n## ")[0], re.MULTILINE)
    found = "\n".join(remarks(tmp_path, change) for change, _ in [*WRONG, (scale(1000.0, "time"), "")])
    found += "\n".join(fast_remarks(change) for change, _ in FAST)
    found += "\n" + remarks(tmp_path, repeating(4)) + "\n".join([*second_remarks(2, copied), *on_a_robot(-1.0)])
    found += "\n" + remarks(tmp_path, lambda table: with_second_sensor(table, np.full(N, 2 * BOTH_VALID)))
    assert len(shown) > 10
    for remark in shown:
        assert re.search(".*".join(map(re.escape, remark.split("…"))), found), remark
