"""The GY-87's registers against the sensors' documents, asked over the bus without any firmware."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import pytest

from linkpose.sensors.bmp180 import Bmp180Calibration, compensate
from virtual_uno import VirtualUno

MPU, BMP = 0x68, 0x77
MakeBoard = Callable[..., VirtualUno]
SIGNAL = [0.5, -0.25, 1.0, 100.0, -200.0, 0.0, 36.53]  # g, deg/s, degC


def awake(uno: VirtualUno, *, accel_config: int = 0, gyro_config: int = 0) -> VirtualUno:
    """Powers the MPU-6050 up at a sample rate of 1 kHz."""
    uno.run_ms(30)
    for register, value in ((0x6B, 0x01), (0x1A, 0x03), (0x19, 0), (0x1B, gyro_config), (0x1C, accel_config)):
        assert uno.transact(MPU, bytes([register, value])) is not None
    uno.run_ms(2)
    return uno


def burst(uno: VirtualUno) -> tuple[int, ...]:
    """accel x y z, temperature, gyro x y z as counts."""
    data = uno.transact(MPU, b"\x3b", 14)
    assert data is not None
    return struct.unpack(">7h", data)


def test_mpu6050_starts_asleep_with_its_reset_values(asleep: MakeBoard) -> None:
    uno = asleep()
    uno.imu.feed([0], [SIGNAL])
    assert uno.transact(MPU, b"\x75", 1) is None  # starting up
    uno.run_ms(100)
    assert uno.transact(MPU, b"\x75", 1) == b"\x68"
    assert uno.transact(MPU, b"\x6b", 2) == b"\x40\x00"
    assert uno.transact(MPU, b"\x19", 4) == bytes(4)
    assert burst(uno) == (0,) * 7


@pytest.mark.parametrize("code", range(4))
def test_mpu6050_scales_with_its_ranges(asleep: MakeBoard, code: int) -> None:
    uno = asleep()
    uno.imu.feed([0], [SIGNAL])
    awake(uno, accel_config=code << 3, gyro_config=code << 3)
    accel_range, gyro_range = 2 << code, 250 << code
    expected = [round(g * 32768 / accel_range) for g in SIGNAL[:3]]
    expected += [pytest.approx(0, abs=1)] + [round(rate * 32768 / gyro_range) for rate in SIGNAL[3:6]]
    assert burst(uno) == tuple(expected)


def test_mpu6050_holds_at_the_ends_of_its_range(asleep: MakeBoard) -> None:
    uno = asleep()
    uno.imu.feed([0], [[2.5, -2.5, 0, 300, -300, 0, 25]])
    counts = burst(awake(uno))
    assert counts[0] == counts[4] == 32767
    assert counts[1] == counts[5] == -32768


def test_mpu6050_samples_at_its_rate(asleep: MakeBoard) -> None:
    """With SMPLRT_DIV 9 a new sample comes every 10 ms; the data-ready bit is set once for each."""
    uno = asleep()
    time_s = np.arange(0, 1, 0.001)
    uno.imu.feed(time_s, np.column_stack([time_s, np.zeros((len(time_s), 6))]))
    awake(uno)
    uno.transact(MPU, b"\x19\x09")
    readings = []
    for _ in range(100):
        uno.run_ms(1)
        readings.append(burst(uno)[0])
    assert len(set(readings)) in (10, 11)
    assert np.diff(sorted(set(readings))) == pytest.approx(0.010 * 16384, abs=17)  # 1 ms of the table
    uno.run_ms(10)
    burst(uno)
    assert [uno.transact(MPU, b"\x3a", 1) for _ in range(2)] == [b"\x01", b"\x00"]


def test_mpu6050_sleeps_resets_and_loses_its_settings_with_its_power(asleep: MakeBoard) -> None:
    uno = asleep()
    uno.imu.feed([0, 0.5], [SIGNAL, [0.0] * 7])
    awake(uno, accel_config=0x10)
    before = burst(uno)
    uno.transact(MPU, b"\x6b\x40")
    uno.run_ms(600)
    assert burst(uno) == before  # asleep: nothing new
    uno.transact(MPU, b"\x6b\x80")
    uno.run_ms(5)
    assert uno.transact(MPU, b"\x1c", 1) == b"\x00"
    awake(uno, accel_config=0x10)
    uno.imu.unplug()
    assert uno.transact(MPU, b"\x75", 1) is None
    uno.imu.plug()
    uno.run_ms(100)
    assert uno.transact(MPU, b"\x6b", 1) == b"\x40"
    assert uno.transact(MPU, b"\x1c", 1) == b"\x00"


def test_mpu6050_self_test_response_fits_its_trim(asleep: MakeBoard) -> None:
    """Register map 4.1: the response is within 14 % of the trim codes' value."""
    uno = asleep(mpu6050={"gyroTrim": [14, 15, 16], "accelTrim": [13, 14, 17], "selfTestError": 0.05})
    uno.imu.feed([0], [[0, 0, 1, 0, 0, 0, 25]])
    plain = np.array(burst(awake(uno, accel_config=0x10)))
    excited = np.array(burst(awake(uno, accel_config=0xF0, gyro_config=0xE0)))
    trim_bytes = uno.transact(MPU, b"\x0d", 4)
    assert trim_bytes is not None
    x, y, z, a = trim_bytes
    accel_codes = np.array([x >> 5 << 2 | a >> 4 & 3, y >> 5 << 2 | a >> 2 & 3, z >> 5 << 2 | a & 3])
    gyro_codes = np.array([x & 31, y & 31, z & 31])
    assert accel_codes.tolist() == [13, 14, 17]
    assert gyro_codes.tolist() == [14, 15, 16]
    accel_trim = 4096 * 0.34 * (0.92 / 0.34) ** ((accel_codes - 1) / 30)
    gyro_trim = np.array([25, -25, 25]) * 131 * 1.046 ** (gyro_codes - 1)
    response = (excited - plain)[[0, 1, 2, 4, 5, 6]]
    assert response / np.concatenate([accel_trim, gyro_trim]) - 1 == pytest.approx(np.full(6, 0.05), abs=0.001)


def test_slaves_can_be_made_silent(asleep: MakeBoard) -> None:
    uno = asleep(mpu6050={"whoAmI": 0x72})
    uno.run_ms(100)
    assert uno.transact(MPU, b"\x75", 1) == b"\x72"
    uno.imu.nack(address=True)
    assert uno.transact(MPU, b"\x75", 1) is None
    assert uno.transact(BMP, b"\xd0", 1) == b"\x55"
    uno.imu.nack(data=True)
    assert uno.transact(MPU, b"\x75", 1) is None
    uno.imu.nack()
    uno.corrupt_i2c(1.0)
    data = uno.transact(MPU, b"\x75", 1)
    assert data is not None
    assert bin(data[0] ^ 0x72).count("1") == 1


# --- BMP180 ---

EXAMPLE = Bmp180Calibration(408, -72, -14383, 32741, 32757, 23153, 6190, 4, -32768, -8711, 2868)


def convert(uno: VirtualUno, control: int, wait_ms: float) -> int:
    uno.transact(BMP, bytes([0xF4, control]))
    uno.run_ms(wait_ms)
    high, low, lowest = uno.transact(BMP, b"\xf6", 3) or (0, 0, 0)
    return high << 16 | low << 8 | lowest


def test_bmp180_gives_the_data_sheets_example(asleep: MakeBoard) -> None:
    """BMP180 data sheet, figure 4: B5 = 2399 is 15.04 degC; UT 27898 and, at 69964 Pa, UP 23843."""
    uno = asleep()
    uno.baro.feed([0], [[69964.0, (2399 + 8) / 160]])
    uno.run_ms(20)
    words = uno.transact(BMP, b"\xaa", 22)
    assert words is not None
    assert struct.unpack(">3h3H5h", words) == EXAMPLE
    assert convert(uno, 0x2E, 5) >> 8 == pytest.approx(27898, abs=1)
    assert convert(uno, 0x34, 5) >> 8 == pytest.approx(23843, abs=1)


@pytest.mark.parametrize("oversampling", range(4))
@pytest.mark.parametrize(("pressure", "temperature"), [(30000.0, -20.0), (100325.0, 25.0), (110000.0, 60.0)])
def test_bmp180_readings_compensate_to_what_was_fed(
    asleep: MakeBoard, oversampling: int, pressure: float, temperature: float
) -> None:
    uno = asleep()
    uno.baro.feed([0], [[pressure, temperature]])
    uno.run_ms(20)
    ut = convert(uno, 0x2E, 5) >> 8
    up = convert(uno, 0x34 | oversampling << 6, 26) >> 8 - oversampling
    got_temperature, got_pressure = compensate(ut, up, EXAMPLE, oversampling)
    assert got_temperature / 10 == pytest.approx(temperature, abs=0.15)
    assert got_pressure == pytest.approx(pressure, abs=12)  # the example's words and 0.1 degC make so much of it


@pytest.mark.parametrize(("control", "time_ms"), [(0x2E, 4.5), (0x34, 4.5), (0x74, 7.5), (0xB4, 13.5), (0xF4, 25.5)])
def test_bmp180_conversions_take_their_time(asleep: MakeBoard, control: int, time_ms: float) -> None:
    uno = asleep()
    uno.run_ms(20)
    assert convert(uno, control, time_ms - 0.1) == 0x800000  # as after reset
    assert uno.transact(BMP, b"\xf4", 1) == bytes([control])  # Sco still set
    uno.run_ms(0.2)
    assert uno.transact(BMP, b"\xf4", 1) == bytes([control & ~0x20])
    assert uno.transact(BMP, b"\xf6", 3) != b"\x80\x00\x00"


def test_bmp180_feels_traffic_on_the_bus(asleep: MakeBoard) -> None:
    uno = asleep(bmp180={"disturbancePa": 500.0})
    uno.run_ms(20)
    quiet = {convert(uno, 0x74, 8) for _ in range(5)}
    assert len(quiet) == 1
    assert uno.state()["conversions_disturbed"] == 0
    disturbed = set()
    for _ in range(5):
        uno.transact(BMP, b"\xf4\x74")
        uno.run_ms(3)
        uno.transact(MPU, b"\x3b", 14)
        uno.run_ms(5)
        disturbed.add(uno.transact(BMP, b"\xf6", 3))
    assert len(disturbed) == 5
    assert uno.state()["conversions_disturbed"] == 5


def test_bmp180_resets_by_command(asleep: MakeBoard) -> None:
    uno = asleep()
    uno.run_ms(20)
    convert(uno, 0x2E, 5)
    uno.transact(BMP, b"\xe0\xb6")
    assert uno.transact(BMP, b"\xd0", 1) is None  # starting up
    uno.run_ms(11)
    assert uno.transact(BMP, b"\xf4", 5) == b"\x00\x00\x80\x00\x00"


# --- the parts that are sold in place of these ---


def test_a_successor_has_its_own_registers_and_formulas(asleep: MakeBoard) -> None:
    """PS-MPU-6500A 3.4.2: 333.87 counts/°C, 0 at 21 °C. ACCEL_CONFIG2 is writable there only."""
    for who_am_i, per_degree, zero_at, config2 in ((0x70, 333.87, 21, 3), (0x12, 326.8, 25, 3), (0x68, 340, 36.53, 0)):
        uno = asleep(mpu6050={"whoAmI": who_am_i})
        uno.imu.feed([0], [[0, 0, 1, 0, 0, 0, 30.0]])
        awake(uno)
        uno.transact(MPU, b"\x1d\x03")
        assert uno.transact(MPU, b"\x1d", 1) == bytes([config2])
        assert burst(uno)[3] == pytest.approx((30 - zero_at) * per_degree, abs=1.5)


@pytest.mark.parametrize(
    ("chip", "address", "set_up", "data", "order", "per_gauss"),
    [
        ("hmc5883l", 0x1E, [(0x00, 0x18), (0x01, 0x20), (0x02, 0x00)], 0x03, ">hhh", 1090),
        ("qmc5883l", 0x0D, [(0x0B, 0x01), (0x09, 0x1D)], 0x00, "<hhh", 3000),
        ("qmc5883p", 0x2C, [(0x0B, 0x08), (0x0A, 0xCD)], 0x01, "<hhh", 3750),
    ],
)
def test_magnetometers_answer_behind_the_bypass(
    asleep: MakeBoard,
    chip: str,
    address: int,
    set_up: list[tuple[int, int]],
    data: int,
    order: str,
    per_gauss: int,
) -> None:
    uno = asleep(magnetometer=chip)
    uno.mag.feed([0], [[20.0, -30.0, 45.0]])
    awake(uno)
    assert uno.transact(address, b"\0", 1) is None  # the buses are apart
    uno.transact(MPU, b"\x37\x02")
    for register, value in set_up:
        assert uno.transact(address, bytes([register, value])) is not None
    uno.run_ms(20)
    x, y, z = struct.unpack(order, uno.transact(address, bytes([data]), 6) or b"")
    if chip == "hmc5883l":
        y, z = z, y
    assert [x, y, z] == pytest.approx([v / 100 * per_gauss for v in (20, -30, 45)], abs=1)
    uno.imu.unplug()
    assert uno.transact(address, b"\0", 1) is None
