"""Sensors: the data sheets' examples, and what HELLO may contain."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.recording.writer import metadata
from linkpose.sensors import bmp280, magnetometer, mpu6050
from linkpose.sensors.barometer import Barometer
from linkpose.sensors.conversion import BoardSettings
from linkpose.sensors.devices import Sensors, check_hello, describe, found, names
from linkpose.sensors.rig import Rig
from linkpose.simulation import board
from linkpose.simulation.baro import DATASHEET_WORDS
from linkpose.wire.messages import DeviceFamily, DeviceState, HelloMouse

# BST-BMP280-DS001, 3.12.
BMP280_WORDS = bmp280.Bmp280Calibration(27504, 26435, -1000, 36477, -10685, 3024, 2855, 140, -7, 15500, -14600, 6000)


def test_bmp280_data_sheets_example():
    temperature, pressure = bmp280.compensate(519888 / 16, 415148.0, BMP280_WORDS)
    assert temperature == pytest.approx(25.08, abs=0.005)
    assert pressure == pytest.approx(100653.27, abs=0.05)


def test_a_barometer_compensates_by_its_family():
    words = tuple(word & 0xFFFF for word in BMP280_WORDS)
    other = Barometer(DeviceFamily.BMP280, words, 1)
    assert other.is_sound and bmp280.Bmp280Calibration.of(words) == BMP280_WORDS
    temperature, pressure = other.compensate(np.array([519888 // 16] * 2), np.array([415148] * 2))
    assert pressure.tolist() == pytest.approx([100653.27] * 2, abs=0.05) and temperature[0] == pytest.approx(
        25.08, abs=0.005
    )
    usual = Barometer.of(board.hello(board.DEFAULTS._replace(baro_oversampling=0)))
    temperature, pressure = usual.compensate(np.array([27898, 18810]), np.array([23843, 23843]))
    assert (temperature[0], pressure[0]) == (15.0, 69964.0)
    assert not Barometer(DeviceFamily.NONE, (0,) * 12, 1).is_sound
    assert not Barometer(DeviceFamily.BMP280, (0,) * 12, 1).is_sound


def test_every_raw_pair_gives_a_number_or_nan():
    usual = Barometer.of(board.hello(board.DEFAULTS))
    ut = np.arange(65536)
    with np.errstate(all="raise"):
        temperature, pressure = usual.compensate(ut, np.full(65536, 23843))
    assert np.array_equal(np.isnan(temperature), np.isnan(pressure))
    assert np.isnan(pressure).any() and np.isfinite(pressure).mean() > 0.99


@pytest.mark.parametrize(
    ("family", "count", "celsius"),
    [
        (DeviceFamily.MPU6050, -521, 35.0),  # RM-MPU-6000A 4.18: counts / 340 + 36.53
        (DeviceFamily.MPU6500, 0, 21.0),
        (DeviceFamily.ICM20600, 3268, 35.0),
        (DeviceFamily.UNKNOWN_IMU, 0, math.nan),
    ],
)
def test_die_temperature_by_family(family, count, celsius):
    scale, offset = mpu6050.temperature_scale(family)
    assert count * scale + offset == pytest.approx(celsius, abs=0.01, nan_ok=True)


def test_magnetometer_scales():
    """The earth's field, 50 µT, is 545 counts of an HMC5883L at 1090 counts/G."""
    assert 545 * magnetometer.scale(DeviceFamily.HMC5883L) == pytest.approx(50.0)
    assert 1500 * magnetometer.scale(DeviceFamily.QMC5883L) == pytest.approx(50.0)
    assert math.isnan(magnetometer.scale(DeviceFamily.NONE))


def test_hello_names_what_is_there():
    hello = board.hello(board.DEFAULTS, sensors=Sensors.MPU6050 | Sensors.MAG)
    assert found(hello) == Sensors.MPU6050 | Sensors.MAG
    assert names(hello) == ["mpu6050", "mag"]
    chips = [describe(device) for device in hello.devices]
    assert [chip.chip for chip in chips] == ["MPU-6050", "none", "none", "QMC5883L"]
    failed = hello.devices[0]._replace(state=DeviceState.FAILED)
    assert "check its wiring" in describe(failed).remark
    unknown = hello.devices[0]._replace(id=0x72, family=DeviceFamily.UNKNOWN_IMU, state=DeviceState.UNVERIFIED)
    assert describe(unknown).state == "unverified" and "0x72" in describe(unknown).remark


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"sample_rate_hz": 0}, "sample_rate_hz = 0"),
        ({"dlpf": 7}, "dlpf = 7"),
        ({"accel_range_g": 0}, "accel_range_g = 0"),
        ({"gyro_range_deg_s": 255}, "gyro_range_deg_s = 255"),
        ({"i2c_khz": 0}, "i2c_khz = 0"),
        ({"sample_rate_hz": 51}, "sample_rate_hz = 51"),
        ({"streaming": 2}, "streaming = 2"),
        ({"sections": 0x53}, "5 mice"),
        ({"mice": (HelloMouse(9, 0, 0, 8, 200, 0),)}, "state 9 for mouse port 1"),
    ],
)
def test_an_impossible_hello_is_refused(change, named):
    check_hello(board.hello(board.DEFAULTS))
    with pytest.raises(LinkposeError, match=named):
        check_hello(board.hello(board.DEFAULTS)._replace(**change))


WORD = st.integers(-0x8000, 0x7FFF)


@given(
    words=st.tuples(*[WORD] * 11),
    ut=st.integers(0, 0xFFFF),
    up=st.integers(0, 0x7FFFF),
    oversampling=st.integers(0, 3),
)
@example(words=tuple(DATASHEET_WORDS), ut=27898, up=23843, oversampling=0)
@example(words=(1,) * 11, ut=1, up=0x7FFFF, oversampling=3)  # a divisor near 0: products beyond 64 bits
@settings(max_examples=300, deadline=None)
def test_a_reading_alone_gives_the_same_bits_as_in_a_block(words, ut, up, oversampling):
    barometer = Barometer(DeviceFamily.BMP180, (*(word & 0xFFFF for word in words), 0), oversampling)
    with np.errstate(all="ignore"):  # arrays hold meaningless numbers for words that no BMP180 has
        alone = barometer.compensate_one(ut, up)
        block = barometer.compensate(np.array([ut] * 2), np.array([up] * 2))
    for one, two in zip(alone, block, strict=True):
        assert np.array([one]).tobytes() == two[:1].tobytes()


@pytest.mark.parametrize(
    ("dlpf", "family", "filter_ms"),
    [
        (3, DeviceFamily.MPU6050, 4.9),  # RM-MPU-6000A 4.3
        (6, DeviceFamily.MPU6050, 19.0),
        (3, DeviceFamily.MPU6500, 5.9),  # RM-MPU-6500A, register 0x1A
        (6, DeviceFamily.ICM20600, 33.48),
        (3, DeviceFamily.UNKNOWN_IMU, 4.9),
    ],
)
def test_readings_are_as_old_as_their_family_filters_them(dlpf, family, filter_ms):
    """In addition, a sample of a 1 kHz sensor is 0.5 ms old in the mean."""
    assert 1e3 * mpu6050.delay_s(dlpf, family) == pytest.approx(filter_ms + 0.5)
    hello = board.hello(board.DEFAULTS._replace(dlpf=dlpf))
    hello = hello._replace(devices=(hello.devices[0]._replace(family=family), *hello.devices[1:]))
    settings = BoardSettings.of(hello)
    head = metadata(hello, settings, "sim", Rig(), {})
    recording = Recording(Path("r.csv"), None, None, 100.0, head, [])
    assert recording.imu_delay_s == settings.imu_delay_s == mpu6050.delay_s(dlpf, family)
