"""Sensors as boards really carry them: successors, clones, second sensors, magnetometers, and sensors that fail."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from measuring import DEFAULTS, MICE, busy, jitter_us, lost, move_all
from wire_link import WATCHED_BUS, WireLink, burst_starts, us

from linkpose.sensors import mpu6050
from linkpose.sensors.barometer import Barometer
from linkpose.sensors.devices import Sensors, describe, found
from linkpose.wire.messages import (
    IMU2_OFFSET_US_400_KHZ,
    IMU_OFFSET_US,
    DeviceFamily,
    DeviceState,
    GetInfo,
    Hello,
    Sample,
    SampleFlags,
    Sections,
    SelfTest,
    SelfTestResult,
    Start,
)

MakeBoard = Callable[..., WireLink]
GYRO_DPS = 100.0


def streaming(link: WireLink, settle_ms: float = 500.0) -> Hello:
    """Starts the stream and returns a HELLO taken after the sensors came up."""
    link.start(settle_ms)
    link.run_ms(300)
    link.send(GetInfo())
    return link.expect(Hello, 50)


def last(link: WireLink, milliseconds: float = 100.0) -> Sample:
    link.forget()
    link.run_ms(milliseconds)
    return link.samples[-1]


@pytest.mark.parametrize(
    ("who_am_i", "family", "state"),
    [
        (0x70, DeviceFamily.MPU6500, DeviceState.OK),
        (0x75, DeviceFamily.MPU6500, DeviceState.OK),
        (0x12, DeviceFamily.ICM20600, DeviceState.OK),
        (0x72, DeviceFamily.UNKNOWN_IMU, DeviceState.UNVERIFIED),
    ],
)
def test_successors_and_clones_run_by_their_own_data_sheets(
    board: MakeBoard, who_am_i: int, family: DeviceFamily, state: DeviceState
) -> None:
    link = board(mpu6050={"whoAmI": who_am_i, "gyroTrim": [150, 160, 170], "accelTrim": [130, 140, 150]})
    link.uno.imu.feed([0], [[0.5, -0.25, 1.0, GYRO_DPS, 0, 0, 31.0]])
    device = streaming(link).devices[0]
    assert (device.id, device.family, device.state) == (who_am_i, family, state)
    sample = last(link)
    assert sample.flags & SampleFlags.IMU_VALID
    assert (sample.accel_x, sample.accel_y) == (2048, -1024)
    assert (describe(device).remark != "") == (who_am_i != 0x68)
    scale, offset = mpu6050.temperature_scale(family)
    if family == DeviceFamily.UNKNOWN_IMU:
        assert f"{who_am_i:#04x}" in describe(device).remark
        assert np.isnan(offset)
        return
    assert link.uno.transact(0x68, b"\x1d", 1) == b"\x03"  # ACCEL_CONFIG2: DLPF 3
    assert sample.imu_temp * scale + offset == pytest.approx(31.0, abs=0.01)


def test_a_successors_self_test_is_judged_by_its_own_formula(board: MakeBoard) -> None:
    link = board(mpu6050={"whoAmI": 0x71, "gyroTrim": [150, 160, 170], "accelTrim": [130, 140, 150]})
    link.boot()
    link.run_ms(300)
    link.carry_out(SelfTest(0))
    result = link.expect(SelfTestResult, 1500)
    deviations = mpu6050.self_test_deviation(result)
    assert list(deviations.values()) == pytest.approx([0.03] * 6, abs=0.005)
    assert mpu6050.self_test_limit(result) == 0.5


def test_an_unknown_chip_that_keeps_no_settings_is_unsupported(board: MakeBoard) -> None:
    link = board(mpu6050={"whoAmI": 0x42, "readOnly": True})
    device = streaming(link).devices[0]
    assert (device.id, device.state) == (0x42, DeviceState.UNSUPPORTED)
    assert not last(link).sections & Sections.IMU


@pytest.mark.parametrize(
    ("fault", "flag", "count"),
    [
        ("zeros", SampleFlags.IMU_BLANK, "blank"),
        ("frozen", SampleFlags.IMU_FROZEN, "frozen"),
        ("full", SampleFlags.IMU_OUT_OF_RANGE, "out_of_range"),
        ("hot", SampleFlags.IMU_OUT_OF_RANGE, "out_of_range"),
    ],
)
def test_a_sensor_that_fails_is_invalid_with_its_cause(
    board: MakeBoard, fault: str, flag: SampleFlags, count: str
) -> None:
    link = board()
    streaming(link)
    link.uno.imu.set(fault=fault)
    link.run_ms(300)
    sample = last(link, 1500)
    assert not sample.flags & SampleFlags.IMU_VALID
    assert sample.flags & flag
    assert getattr(link.status.devices[0], count) > 20
    link.send(GetInfo())
    assert link.expect(Hello, 50).devices[0].state == DeviceState.FAILED
    link.uno.imu.set(fault=None)
    assert last(link, 300).flags & SampleFlags.IMU_VALID


def test_a_sensor_without_data_from_power_on_has_failed(board: MakeBoard) -> None:
    """It answers with its id and keeps its settings; its data registers stay zero."""
    link = board(mpu6050={"fault": "zeros"}, magnetometer="qmc5883l")
    assert streaming(link).devices[0].state == DeviceState.FAILED
    sample = last(link)
    assert sample.sections & Sections.IMU and sample.flags & SampleFlags.IMU_BLANK
    link.uno.imu.set(fault=None)
    wanted = SampleFlags.IMU_VALID | SampleFlags.MAG_VALID
    assert last(link, 500).flags & wanted == wanted


def test_a_board_with_everything(board: MakeBoard) -> None:
    """Two inertial sensors, a barometer, a magnetometer and three mice at 100 Hz: nothing lost, within the budget."""
    link = board(imu2={"whoAmI": 0x70}, magnetometer="qmc5883l", mice=MICE[:3])
    uno = link.uno
    uno.imu.feed([0], [[1.0, 0, 0, GYRO_DPS, 0, 0, 25]])
    uno.imu2.feed([0], [[0, 1.0, 0, 0, -GYRO_DPS, 0, 25]])
    uno.mag.feed([0], [[20.0, -30.0, 45.0]])
    hello = streaming(link, 1500)
    assert found(hello) == Sensors.MPU6050 | Sensors.BMP180 | Sensors.IMU2 | Sensors.MAG
    assert [device.state for device in hello.devices] == [DeviceState.OK] * 4
    assert hello.sections == 0x0F | 3 << 4
    move_all(link, 6.0)
    uno.watch(WATCHED_BUS)
    before = uno.state()
    link.forget()
    link.run_ms(5000)
    samples, events, after = link.samples, uno.events(), uno.state()
    assert lost(samples) == 0 and len(samples) >= 499
    everything = SampleFlags.IMU_VALID | SampleFlags.IMU2_VALID | SampleFlags.BARO_VALID | SampleFlags.MAG_VALID
    assert all(sample.flags & everything == everything for sample in samples)
    assert {sample.accel_x for sample in samples} == {4096} and {sample.accel2_y for sample in samples} == {4096}
    assert {(s.mag_x, s.mag_y, s.mag_z) for s in samples} == {(600, -900, 1350)}
    assert set(np.diff([s.mag_count for s in samples]) & 0xFF) == {1}
    assert link.status.i2c_errors == 0 and link.status.ticks_missed == 0
    first, second = burst_starts(events), burst_starts(events, 0x69)
    assert jitter_us(first, 100) < 5
    offset_us = us(second - first[: len(second)])
    assert np.mean(offset_us) == pytest.approx(IMU2_OFFSET_US_400_KHZ - IMU_OFFSET_US, abs=40)
    assert busy(before, after) <= 0.5
    assert uno.state()["conversions"] > 400


@pytest.mark.parametrize(("chip", "gain"), [("hmc5883l", 1090), ("qmc5883p", 3750)])
def test_magnetometers_survive_a_restart_of_the_inertial_sensor(board: MakeBoard, chip: str, gain: int) -> None:
    link = board(magnetometer=chip)
    link.uno.mag.feed([0], [[20.0, -30.0, 45.0]])
    hello = streaming(link)
    assert hello.devices[3].state == DeviceState.OK
    sample = last(link)
    assert [sample.mag_x, sample.mag_y, sample.mag_z] == pytest.approx([v / 100 * gain for v in (20, -30, 45)], abs=1)
    counts = [s.mag_count for s in link.samples]
    assert set(np.diff(counts) & 0xFF) == {1}
    link.uno.imu.unplug()
    assert not last(link, 300).flags & SampleFlags.MAG_VALID
    link.uno.imu.plug()
    assert last(link, 400).flags & SampleFlags.MAG_VALID
    assert lost(link.samples) == 0


def test_a_second_sensor_alone(board: MakeBoard) -> None:
    link = board(imu2={})
    link.uno.imu.unplug()
    hello = streaming(link)
    assert found(hello) & (Sensors.MPU6050 | Sensors.IMU2) == Sensors.IMU2
    sample = last(link)
    assert sample.sections == Sections.IMU2 | Sections.BARO
    assert sample.flags & SampleFlags.IMU2_VALID


def test_a_slow_bus_carries_everything(board: MakeBoard) -> None:
    link = board(imu2={}, magnetometer="hmc5883l")
    link.boot()
    link.run_ms(300)
    link.carry_out(DEFAULTS._replace(i2c_khz=100))
    link.run_ms(300)
    link.carry_out(Start())
    link.run_ms(300)
    link.forget()
    link.run_ms(2000)
    wanted = SampleFlags.IMU_VALID | SampleFlags.IMU2_VALID | SampleFlags.BARO_VALID | SampleFlags.MAG_VALID
    assert all(sample.flags & wanted == wanted for sample in link.samples)
    assert lost(link.samples) == 0
    assert len({sample.baro_count for sample in link.samples}) > 50


@pytest.mark.parametrize(
    ("options", "family"),
    [({"bmp280": {}}, DeviceFamily.BMP280), ({"bmp180": {"lateMs": 6}}, DeviceFamily.BMP180)],
    ids=["BMP280", "a clone whose Sco bit stays"],
)
def test_other_barometers(board: MakeBoard, options: dict[str, Any], family: DeviceFamily) -> None:
    link = board(**options)
    link.uno.baro.feed([0], [[98_765.0, 21.5]])
    hello = streaming(link)
    assert (hello.devices[2].family, hello.devices[2].state) == (family, DeviceState.OK)
    sample = last(link, 500)
    temperature, pressure = Barometer.of(hello).compensate(np.array([sample.baro_ut]), np.array([sample.baro_up]))
    assert temperature[0] == pytest.approx(21.5, abs=0.15)
    assert pressure[0] == pytest.approx(98_765, abs=12)
    assert len({s.baro_count for s in link.samples}) > 15
