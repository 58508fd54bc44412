"""Data health: dead, frozen, stuck and impossible sensors are found within a second, counted, and left to no filter."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pty_board import PtyBoard

from linkpose.recording.reader import load_recording
from linkpose.recording.table import read_table
from linkpose.sensors.checks import Cause
from linkpose.sensors.health import Change, HealthMonitor
from linkpose.sensors.measurements import Measurements
from linkpose.wire.frames import StreamDecoder, encode
from linkpose.wire.messages import Message, Sample, SampleFlags

RATE_HZ = 100.0
N = 400
ALL_OK = {"imu": "ok", "baro": "ok", "mouse1": "ok"}


def healthy(n: int = N, seed: int = 1) -> Measurements:
    """A link at rest as an MPU-6050 at 8 g and 1000 °/s reads it, with a BMP180 at every third sample and a mouse."""
    rng = np.random.default_rng(seed)
    accel = np.round(rng.normal((0.0, 0.0, 9.81), 0.025, (n, 3)) / 0.0024) * 0.0024
    gyro = np.round(rng.normal(0.0, 8e-4, (n, 3)) / 5.3e-4) * 5.3e-4
    fresh = np.arange(n) % 3 == 0
    readings = np.round(rng.normal(101_300.0, 4.0, n))
    latest = np.maximum.accumulate(np.where(fresh, np.arange(n), 0))
    flags = SampleFlags.IMU_VALID | SampleFlags.BARO_VALID | SampleFlags.MOUSE1_VALID
    return Measurements(
        np.arange(n) / RATE_HZ,
        accel,
        gyro,
        np.full(n, 25.0),
        readings[latest],
        np.full(n, 24.0),
        fresh,
        np.zeros((n, 1, 2)),
        np.full(n, int(flags), np.uint16),
    )


def run(block: Measurements, sensors: dict[str, str] = ALL_OK) -> tuple[Measurements, list[Change], dict[str, dict]]:
    monitor = HealthMonitor(RATE_HZ, sensors)
    clean, changes = monitor.check(block)
    return clean, changes, monitor.as_dict()


def between(first: int, last: int, imu: object, **others: object) -> Measurements:
    """Healthy measurements with these IMU values (6,) or values by field in the rows from `first` to `last`."""
    block = healthy()
    changed = {name: getattr(block, name).copy() for name in ("accel_m_s2", "gyro_rad_s", *others)}
    if imu is not None:
        changed["accel_m_s2"][first:last] = np.asarray(imu)[..., :3]
        changed["gyro_rad_s"][first:last] = np.asarray(imu)[..., 3:]
    for name, value in others.items():
        changed[name][first:last] = value
    return replace(block, **changed)


FULL_SCALE_X = np.column_stack([np.full(200, 78.4532), healthy(200, 2).accel_m_s2[:, 1:], healthy(200, 2).gyro_rad_s])
STUCK_Y = FULL_SCALE_X.copy()
STUCK_Y[:, 0], STUCK_Y[:, 1] = healthy(200, 3).accel_m_s2[:, 0], 0.0312


def test_a_healthy_board_has_nothing_to_report() -> None:
    block = healthy(20_000)
    clean, changes, report = run(block)
    assert not changes
    assert clean is block
    assert {sensor["state"] for sensor in report.values()} == {"ok"}
    assert report["imu"] == {"state": "ok", "samples": 20_000, "valid": 20_000, "invalid": {}, "saturated": 0}


@pytest.mark.parametrize(
    ("imu", "cause", "latest_s"),
    [
        ((0.1, 0.2, 9.8, 0.0, 0.001, 0.0), Cause.FROZEN, 0.21),
        (np.zeros(6), Cause.BLANK, 0.0),
        (np.full(6, np.nan), Cause.SILENT, 0.0),
        ((0.1, np.inf, 9.8, 0.0, 0.0, 0.0), Cause.SILENT, 0.0),
        (FULL_SCALE_X, Cause.STUCK, 0.51),
        (STUCK_Y, Cause.STUCK, 0.51),
    ],
    ids=["frozen", "zeros", "missing", "inf", "full scale", "one axis stuck"],
)
def test_a_faulty_imu_is_left_out_counted_and_reported(imu: object, cause: Cause, latest_s: float) -> None:
    clean, changes, report = run(between(100, 300, imu))
    [fault, back] = changes
    assert fault.sensor == "imu"
    assert fault.cause == cause
    assert 1.0 <= fault.time_s <= 1.0 + latest_s + 1e-9
    assert back.cause == Cause.OK
    assert back.time_s == pytest.approx(3.0)
    bad = np.isnan(clean.accel_m_s2).all(axis=1) & np.isnan(clean.gyro_rad_s).all(axis=1)
    assert bad[100 + round(latest_s * RATE_HZ) : 300].all()
    assert not bad[:100].any() and not bad[300:].any()
    assert report["imu"]["invalid"] == {cause.label: int(bad.sum())}
    assert report["imu"]["valid"] == N - bad.sum()
    assert report["imu"]["state"] == "ok"


@pytest.mark.parametrize(
    ("flag", "cause"),
    [
        (SampleFlags.IMU_BLANK, Cause.BLANK),
        (SampleFlags.IMU_FROZEN, Cause.FROZEN),
        (SampleFlags.IMU_OUT_OF_RANGE, Cause.OUT_OF_RANGE),
    ],
)
def test_the_firmware_s_causes_are_used(flag: SampleFlags, cause: Cause) -> None:
    block = between(100, 300, np.full(6, np.nan))
    flags = block.flags.astype(np.uint32)
    flags[100:300] = int(flag)
    _, changes, report = run(replace(block, flags=flags))
    assert changes[0].cause == cause
    assert report["imu"]["invalid"] == {cause.label: 200}


def with_everything() -> Measurements:
    """Healthy measurements with a second inertial sensor and a QMC5883L of 75 Hz at rest."""
    first, second = healthy(), healthy(seed=7)
    fresh = np.arange(N) % 4 != 3
    field = np.round(np.random.default_rng(8).normal((30.0, 0.0, -42.0), 0.2, (N, 3)) * 30) / 30
    held = np.maximum.accumulate(np.where(fresh, np.arange(N), 0))
    return replace(
        first,
        accel2_m_s2=second.accel_m_s2,
        gyro2_rad_s=second.gyro_rad_s,
        imu2_temp_degC=second.imu_temp_degC,
        mag_uT=field[held],
        mag_fresh=fresh,
        flags=first.flags | np.uint32(SampleFlags.IMU2_VALID | SampleFlags.MAG_VALID),
    )


EVERYTHING = ALL_OK | {"imu2": "being set up", "mag": "being set up"}


def test_a_second_imu_and_a_magnetometer_are_counted() -> None:
    block = with_everything()
    block.flags[10:15] |= int(SampleFlags.GYRO2_SATURATED | SampleFlags.MAG_SATURATED)
    clean, changes, report = run(block, EVERYTHING)
    assert not changes
    assert clean is block
    for name in ("imu2", "mag"):
        assert report[name] == {"state": "ok", "samples": N, "valid": N, "invalid": {}, "saturated": 5}
    assert report["imu"]["saturated"] == 0


@pytest.mark.parametrize(
    ("values", "cause", "latest_s"),
    [
        (np.zeros(6), Cause.BLANK, 0.0),
        (np.full(6, np.nan), Cause.SILENT, 0.0),
        ((0.1, 0.2, 9.8, 0.0, 0.001, 0.0), Cause.FROZEN, 0.21),
    ],
    ids=["zeros", "missing", "frozen"],
)
def test_a_faulty_second_imu_does_not_touch_the_first(values: object, cause: Cause, latest_s: float) -> None:
    block = with_everything()
    block.accel2_m_s2[100:300], block.gyro2_rad_s[100:300] = np.asarray(values)[:3], np.asarray(values)[3:]
    clean, [fault, back], report = run(block, EVERYTHING)
    assert (fault.sensor, fault.cause, back.cause) == ("imu2", cause, Cause.OK)
    assert 1.0 <= fault.time_s <= 1.0 + latest_s + 1e-9
    bad = np.isnan(clean.gyro2_rad_s).all(axis=1) & np.isnan(clean.accel2_m_s2).all(axis=1)
    assert bad[100 + round(latest_s * RATE_HZ) : 300].all() and not bad[300:].any()
    assert not (clean.flags[bad] & int(SampleFlags.IMU2_VALID)).any()
    assert report["imu2"]["invalid"] == {cause.label: int(bad.sum())}
    assert clean.accel_m_s2 is block.accel_m_s2


@pytest.mark.parametrize(
    ("field", "fresh", "cause", "latest_s"),
    [
        (np.zeros(3), True, Cause.BLANK, 0.0),
        (np.full(3, np.nan), False, Cause.SILENT, 0.0),
        (np.array([30.0, 0.1, -42.0]), True, Cause.FROZEN, 0.51),
        (np.array([30.0, 0.1, -42.0]), False, Cause.FROZEN, 1.01),
    ],
    ids=["zeros", "missing", "frozen", "no new reading"],
)
def test_a_faulty_magnetometer_is_left_out_counted_and_reported(
    field: np.ndarray, fresh: bool, cause: Cause, latest_s: float
) -> None:
    block = with_everything()
    block.mag_uT[100:300], block.mag_fresh[100:300] = field, fresh
    clean, [fault, back], report = run(block, EVERYTHING)
    assert (fault.sensor, fault.cause, back.cause) == ("mag", cause, Cause.OK)
    assert 1.0 <= fault.time_s <= 1.0 + latest_s + 1e-9
    bad = np.isnan(clean.mag_uT).all(axis=1)
    assert bad[100 + round(latest_s * RATE_HZ) : 300].all() and not bad[300:].any()
    assert not clean.mag_fresh[bad].any()
    assert report["mag"]["invalid"] == {cause.label: int(bad.sum())}


@pytest.mark.parametrize("pressure", [500.0, 200_000.0, np.inf])
def test_one_impossible_pressure_is_left_out_and_only_counted(pressure: float) -> None:
    clean, changes, report = run(between(99, 102, None, pressure_Pa=pressure))
    assert not changes
    assert np.isnan(clean.pressure_Pa[99:102]).all()
    assert not clean.baro_fresh[99:102].any()
    assert np.isfinite(np.delete(clean.pressure_Pa, [99, 100, 101])).all()
    assert report["baro"]["invalid"] == {"out of range": 3}


def test_a_barometer_that_repeats_itself_is_frozen() -> None:
    _, [change, _], report = run(between(100, 300, None, pressure_Pa=101_300.0))
    assert (change.sensor, change.cause) == ("baro", Cause.FROZEN)
    assert change.time_s <= 2.05
    assert report["baro"]["invalid"]["frozen"] > 90


def test_a_mouse_that_disappears_is_reported() -> None:
    block = healthy()
    block.mice_counts[200:] = np.nan
    _, [change], report = run(block)
    assert str(change) == "2.00 s: mouse 1 gives no valid reading. Check its wiring and its supply"
    assert report["mouse1"]["state"] == "silent"


def test_a_lost_reading_is_counted_and_not_reported() -> None:
    _, changes, report = run(between(100, 101, np.full(6, np.nan)))
    assert not changes
    assert report["imu"]["invalid"] == {"silent": 1}


def test_sensors_that_are_set_up_or_absent_are_no_faults() -> None:
    block = healthy()
    block.mice_counts[:150] = np.nan
    block.pressure_Pa[:], block.baro_fresh[:] = np.nan, False
    _, changes, report = run(block, {"imu": "ok", "baro": "absent", "mouse1": "being set up"})
    assert not changes
    assert report["baro"] == {"state": "absent"}
    assert report["mouse1"]["state"] == "ok"
    assert report["mouse1"]["invalid"] == {"being set up": 150}
    block.mice_counts[:] = np.nan
    _, [change], _ = run(block, {"mouse1": "being set up"})
    assert change.time_s == pytest.approx(3.0)


def test_saturated_samples_are_counted() -> None:
    block = healthy()
    block.flags[10:15] |= int(SampleFlags.ACCEL_SATURATED)
    assert run(block)[2]["imu"]["saturated"] == 5


ONE_BY_ONE, SOME_ALONE = list(range(1, N)), [at for at in range(1, N) if at % 10 < 6]  # cuts


@given(st.lists(st.integers(1, N - 1), max_size=12), st.sampled_from([FULL_SCALE_X, np.zeros(6), np.full(6, 1.0)]))
@example(ONE_BY_ONE, np.full(6, 1.0))
@example(ONE_BY_ONE, np.full(6, np.nan))
@example(SOME_ALONE, np.zeros(6))
def test_blocks_of_any_length_give_the_same(cuts: list[int], imu: object) -> None:
    block = between(100, 300, imu, pressure_Pa=99_000.0)
    whole, changes, report = run(block)
    monitor, pieces, found = HealthMonitor(RATE_HZ, ALL_OK), [], []
    edges = [0, *sorted(set(cuts)), N]
    for first, last in itertools.pairwise(edges):
        piece, new = monitor.check(block[first:last])
        pieces.append(piece)
        found += new
    assert sorted(found, key=lambda change: (change.time_s, change.sensor)) == sorted(
        changes, key=lambda change: (change.time_s, change.sensor)
    )
    assert monitor.as_dict() == report
    for name in ("accel_m_s2", "gyro_rad_s", "pressure_Pa", "baro_fresh", "flags"):
        np.testing.assert_array_equal(np.concatenate([getattr(p, name) for p in pieces]), getattr(whole, name))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    cuts=st.lists(st.integers(1, N - 1), max_size=5),
    held=st.lists(
        st.tuples(st.integers(0, N - 1), st.integers(6, 70), st.sampled_from([(0,), (1, 2), tuple(range(6))]))
    ),
)
@example(seed=1, cuts=ONE_BY_ONE, held=[(50, 60, (0,)), (200, 30, tuple(range(6)))])
@example(seed=2, cuts=SOME_ALONE, held=[(50, 30, tuple(range(6))), (200, 60, (1,))])
def test_repeats_are_found_wherever_a_block_ends(
    seed: int, cuts: list[int], held: list[tuple[int, int, tuple[int, ...]]]
) -> None:
    """Long blocks are tested as a whole, short ones sample by sample."""
    rng = np.random.default_rng(seed)
    values = rng.integers(-2, 3, (N, 6)) * 0.01 + 9.0  # coarse: an axis often repeats by chance
    for start, length, axes in held:
        values[start : start + length, axes] = values[start, axes]
    block = replace(healthy(), accel_m_s2=values[:, :3], gyro_rad_s=values[:, 3:])
    results = []
    for edges in ([0, *sorted(set(cuts)), N], [*range(0, N, 20), N]):
        monitor = HealthMonitor(RATE_HZ, ALL_OK)
        parts = [monitor.check(block[a:b])[0].accel_m_s2 for a, b in itertools.pairwise(edges)]
        results.append((np.isnan(np.concatenate(parts)[:, 0]).tolist(), monitor.as_dict()))
    assert results[0] == results[1]


@pytest.mark.parametrize(
    ("imu", "usable"), [((0.1, 0.2, 9.8, 0.0, 0.1, 0.0), False), (np.zeros(6), False), (np.full(6, np.nan), False)]
)
def test_data_without_a_living_sensor_are_named(imu: object, usable: bool) -> None:
    monitor = HealthMonitor(RATE_HZ, {"imu": "ok", "baro": "ok"})
    assert monitor.is_usable  # nothing is known yet
    monitor.check(between(0, N, imu))
    assert monitor.is_usable == usable
    assert "no usable data: the IMU" in monitor.why_unusable


# ---- from the board and from files ----


class FrozenBoard:
    """Repeats one IMU reading in all samples from the n-th on, to the `last`-th."""

    def __init__(self, first: int, last: int = 1 << 30) -> None:
        self._first, self._last, self._count = first, last, 0
        self._decoder = StreamDecoder()
        self._burst: dict[str, int] = {}

    def __call__(self, data: bytes) -> bytes:
        return b"".join(encode(self._change(message)) for message in self._decoder.feed(data))

    def _change(self, message: Message) -> Message:
        if not isinstance(message, Sample):
            return message
        self._count += 1
        if self._count <= self._first or self._count > self._last:
            return message
        names = [f"{kind}_{axis}" for kind in ("accel", "gyro") for axis in "xyz"] + ["imu_temp"]
        self._burst = self._burst or {name: getattr(message, name) for name in names}
        return message._replace(**self._burst)


def test_a_sensor_that_freezes_while_recording_is_reported_and_stored(linkpose, tmp_path) -> None:
    out = tmp_path / "r.csv"
    with PtyBoard(tmp_path / "port", spoil=FrozenBoard(30, 90)):
        result = linkpose("record", out, "--port", tmp_path / "port", "--duration", 1.5, "--json")
    assert result.status == 0
    lines = [line for line in result.err.splitlines() if "the IMU" in line]
    assert re.fullmatch(r"0\.\d\d s: the IMU repeats the same reading\. Unplug the board .*", lines[0])
    assert re.fullmatch(r"0\.\d\d s: the IMU is back after 0\.\d\d s", lines[1])
    summary = json.loads(result.out.splitlines()[-1])
    assert summary["sensors"]["imu"]["invalid"]["frozen"] == pytest.approx(40, abs=2)
    recording = load_recording(out)
    assert recording.health["imu"]["invalid"] == summary["sensors"]["imu"]["invalid"]
    assert any("the IMU repeats the same reading" in remark for remark in recording.remarks)
    closing = read_table(out, "recording").closing
    assert closing is not None
    assert closing["sensors"] == summary["sensors"]


def test_a_run_without_usable_data_fails_with_its_cure(linkpose, refused, tmp_path) -> None:
    out = tmp_path / "r.csv"
    with PtyBoard(tmp_path / "port", spoil=FrozenBoard(0)):
        result = linkpose("record", out, "--port", tmp_path / "port", "--duration", 1.2)
    assert result.status == 1
    last = result.err.splitlines()[-1]
    assert last.startswith("linkpose: no usable data: the IMU repeats the same reading. Check the wiring")
    assert "no usable data: the IMU repeats" in refused("estimate", out)


def test_info_shows_the_health_of_each_sensor(linkpose) -> None:
    report = json.loads(linkpose("info", "--port", "sim://link?speed=20", "--json").out)
    assert report["health"]["imu"]["state"] == "ok"
    assert report["health"]["imu2"] == {"state": "absent"}


def test_a_mouse_that_appears_at_a_port_with_columns_is_found_and_counted() -> None:
    block = healthy()
    block.mice_counts[:150] = np.nan
    _, [change], report = run(block, {"imu": "ok", "mouse1": "absent"})
    assert str(change) == "1.50 s: mouse 1 was found"
    assert report["mouse1"] == {"state": "ok", "samples": 250, "valid": 250, "invalid": {}, "saturated": 0}


def late_mice(first: int, ports: int):
    """A change of the stream: from the n-th sample on it carries mice at `ports` ports."""
    decoder, count = StreamDecoder(), itertools.count()

    def change(message: Message) -> Message:
        if not isinstance(message, Sample) or next(count) < first:
            return message
        valid = sum(int(SampleFlags[f"MOUSE{port}_VALID"]) for port in range(1, ports + 1))
        sections = message.sections & 0x0F | ports << 4
        return message._replace(sections=sections, flags=message.flags | valid, mice=(1, 2) * ports)

    return lambda data: b"".join(encode(change(message)) for message in decoder.feed(data))


def test_a_mouse_without_columns_is_left_out_counted_and_reported_once(linkpose, tmp_path) -> None:
    out = tmp_path / "r.csv"
    with PtyBoard(tmp_path / "port", spoil=late_mice(30, 2)):
        result = linkpose("record", out, "--port", tmp_path / "port", "--duration", 1, "--json")
    assert result.status == 0
    sensors = json.loads(result.out.splitlines()[-1])["sensors"]
    for port in (1, 2):
        assert sensors[f"mouse{port}"] == {"state": "left out", "left_out": 70}
        [line] = [line for line in result.err.splitlines() if f"found at port {port}" in line]
        assert "0.30 s" in line and "add a [[mouse]]" in line
    closing = read_table(out, "recording").closing
    assert closing is not None and closing["sensors"] == sensors
