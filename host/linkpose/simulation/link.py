"""The rig of the first paper: a link on a ball joint, moved by hand, with a GY-87 on it. Tests 1 to 3.

Truth is a function of time and defined at any instant. What the sensors give is a function of the instant and of
the reading's number (its noise), so that a run is the same whether it is made whole, in blocks, or sample by sample.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import LinkposeError
from linkpose.sensors.barometer import Barometer
from linkpose.sensors.conversion import BoardSettings, Converter, RawSamples
from linkpose.sensors.devices import Sensors
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu, Joint, Mag, Noise, Rig, Vector
from linkpose.simulation import baro, imu, mag_disturbances
from linkpose.simulation import mag as mag_model
from linkpose.simulation.motion import HandMotion, SixSides
from linkpose.wire.frames import sample
from linkpose.wire.messages import IMU2_OFFSET_US_400_KHZ, IMU_OFFSET_US, DeviceFamily, HelloMouse, Sample, SampleFlags

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

PAPER_J2S_M: Vector = (-0.09, -0.04, 1.65)
PAPER_DURATION_S = 65.0
_BLOCK = 1000  # samples made at once
_TRUTH_COLUMNS = ("time_s", "height_m", "roll_deg", "pitch_deg", "x_m", "y_m", "yaw_deg")


class PaperTest(NamedTuple):
    """A Test of the paper's chapter 3."""

    mean_accel_m_s2: float  # mean ‖a‖ over the whole test
    tempo: float  # how much faster than Test 1 the link is swung


MOTIONS = ("swing", "sides", "rest")
TESTS = {1: PaperTest(6.8, 1.0), 2: PaperTest(10.7, 1.12), 3: PaperTest(12.5, 1.2)}

# Streams of random numbers, apart from each other so that a setting changes only what it is about.
_MOTION, _ERRORS, _WEATHER, _IMU_NOISE, _BARO_NOISE, _IMU2_NOISE, _IMU2_ERRORS, _MAG_NOISE, _MAG_ERRORS, _DRIFT = range(
    10
)


@dataclass(frozen=True, slots=True)
class LinkTruth:
    """The truth at N instants; vectors are (N, 3) in the sensor's frame."""

    time_s: Floats
    height_m: Floats  # of the sensor over the joint centre, Z·d
    roll_deg: Floats
    pitch_deg: Floats
    x_m: Floats  # of the sensor from the joint centre, in n
    y_m: Floats
    yaw_deg: Floats  # about the vertical, ±180
    tilt: Floats  # Z, n's Z axis (unit vector)
    accel_m_s2: Floats  # linear acceleration a
    specific_force_m_s2: Floats  # gZ + a
    rate_rad_s: Floats  # ω
    rate_derivative_rad_s2: Floats  # dω/dt
    pressure_Pa: Floats  # of the air at the sensor
    temp_degC: Floats


class RawBlock(NamedTuple):
    """N consecutive SAMPLEs as arrays; the fields are those of `wire.messages.Sample`."""

    tick: Integers
    t_us: Integers
    accel: NDArray[np.int16]  # (N, 3)
    imu_temp: NDArray[np.int16]
    gyro: NDArray[np.int16]  # (N, 3)
    baro_ut: Integers
    baro_up: Integers
    baro_count: Integers  # of all pressures read so far, not wrapped
    flags: Integers
    imu2: NDArray[np.int16]  # (N, 7) accel, temperature, gyro; (N, 0): there is no second sensor
    mag: NDArray[np.int16]  # (N, 3), or (N, 0)

    def samples(self) -> Iterator[Sample]:
        """As messages, with the counters wrapped as the board wraps them."""
        rows = zip(
            (self.tick & 0xFFFF).tolist(),
            (self.t_us & 0xFFFFFFFF).tolist(),
            self.accel.tolist(),
            self.imu_temp.tolist(),
            self.gyro.tolist(),
            self.baro_ut.tolist(),
            self.baro_up.tolist(),
            (self.baro_count & 0xFF).tolist(),
            self.flags.tolist(),
            self.imu2.tolist(),
            self.mag.tolist(),
            strict=True,
        )
        for seq, t_us, (ax, ay, az), temp, (gx, gy, gz), ut, up, count, flags, imu2, mag in rows:
            yield sample(
                seq,
                t_us,
                flags,
                (ax, ay, az, temp, gx, gy, gz),
                tuple(imu2),
                (ut, up, count),
                (*mag, seq & 0xFF) if mag else (),
            )


class LinkRun:
    """A run of the simulated link. Pure: every method gives the same for the same arguments, in any order."""

    hello_mice: tuple[HelloMouse, ...] = ()

    def __init__(
        self,
        test: int = 1,
        seed: int = 0,
        duration_s: float | None = PAPER_DURATION_S,
        rate_hz: float = 100.0,
        errors: str = "calibrated",
        j2s_m: Vector = PAPER_J2S_M,
        *,
        accel_range_g: int = 8,
        gyro_range_deg_s: int = 1000,
        oversampling: int = 1,
        motion: str = "swing",
        imu2: bool = False,
        mag: bool = False,
        mag_disturbance: str | None = None,
        noise_of: Rig | None = None,
        swing_rad: float | None = None,
    ) -> None:
        """`imu2` adds a second inertial sensor half-way to the joint, with the axes of the first; `mag` a magnetometer,
        whose field `mag_disturbance` (a key of mag_disturbances.KINDS) disturbs.

        `duration_s` None never ends (a live board). `motion` is "swing", "sides" (the sensor is laid on its six sides
        in turn, as `calibrate imu` requires it) or "rest" (as `calibrate noise` does). `noise_of` is a rig whose noise
        and remaining biases the sensors have, in place of those of `errors`. `swing_rad` is the rms of the swing; None:
        the Test's mean acceleration.
        Raises LinkposeError for a value that cannot be.
        """
        _check(test, seed, duration_s, rate_hz, errors, j2s_m, motion)
        self.test, self.seed, self.duration_s = test, seed, duration_s
        self.rate_hz, self.errors, self.j2s_m = rate_hz, errors, j2s_m
        self.accel_range_g, self.gyro_range_deg_s, self.oversampling = accel_range_g, gyro_range_deg_s, oversampling
        self._d = np.array(j2s_m, dtype=np.float64)
        self.hello_sensors = Sensors.MPU6050 | Sensors.BMP180
        self.hello_sensors |= Sensors.IMU2 * imu2 | Sensors.MAG * mag
        paper = TESTS[test]
        self.motion = motion
        self._motion: HandMotion | SixSides
        if motion == "sides":
            self._motion = SixSides(duration_s or PAPER_DURATION_S)
        else:
            swung = HandMotion(np.random.default_rng([seed, _MOTION, test]), paper.tempo, duration_s)
            if motion == "rest":
                swung.amplitude_rad = 0.0
            elif swing_rad is None:
                swung.scale_to(paper.mean_accel_m_s2, self._d, duration_s or PAPER_DURATION_S)
            else:
                swung.amplitude_rad = swing_rad
            self._motion = swung
        rngs = [np.random.default_rng([seed, stream, test]) for stream in (_ERRORS, _IMU2_ERRORS)]
        if noise_of is None:
            ranges = accel_range_g, gyro_range_deg_s
            self.imu_errors, self.imu2_errors = (imu.ImuErrors.draw(errors, rng, *ranges) for rng in rngs)
        else:
            self.imu_errors, self.imu2_errors = (imu.ImuErrors.draw_from(noise_of, rng, rate_hz) for rng in rngs)
        noise = noise_of.noise if noise_of is not None else Noise()
        self._drifts = {s: imu.BiasDrift(noise, (seed, s, _DRIFT, test)) for s in (_IMU_NOISE, _IMU2_NOISE)}
        if mag_disturbance is not None and (mag_disturbance not in mag_disturbances.KINDS or not mag):
            known = ", ".join(mag_disturbances.KINDS)
            raise LinkposeError(
                f"there is no magnetic disturbance {mag_disturbance!r}: take {known}, and a magnetometer"
            )
        self._mag_disturbance = None if mag_disturbance is None else mag_disturbances.Disturbance(mag_disturbance, seed)
        self._hard_iron_uT = mag_model.hard_iron(errors, np.random.default_rng([seed, _MAG_ERRORS, test]))
        self._weather = baro.Weather.draw(np.random.default_rng([seed, _WEATHER, test]), errors != "none")
        self._schedule = baro.Schedule(1 / rate_hz, oversampling)

    @property
    def count(self) -> int | None:
        """How many samples the run has, None when it never ends."""
        return None if self.duration_s is None else round(self.duration_s * self.rate_hz)

    @property
    def description(self) -> str:
        """What a file of this run names as its device: the address of a simulated board with the same sensors."""
        others = "".join(
            f"&{s.name.lower()}=1" for s in (Sensors.IMU2, Sensors.MAG) if s.name and s & self.hello_sensors
        )
        others += "" if self.motion == "swing" else f"&motion={self.motion}"
        return f"sim://link?test={self.test}&seed={self.seed}&errors={self.errors}{others}"

    @property
    def rig(self) -> Rig:
        """The rig file that belongs to the run. Nothing filters its readings: they have no delay."""
        mag = mag_model.calibration(self.errors) if self.hello_sensors & Sensors.MAG else Mag()
        return Rig(Joint(self.j2s_m), Imu(delay_s=0.0), mag=mag)

    def at(self, time_s: Floats) -> LinkTruth:
        """The truth at any instants (N,), s. After the end the link stays at rest."""
        moving = self._motion.at(np.atleast_1d(np.asarray(time_s, dtype=np.float64)))
        accel = moving.acceleration(self._d)
        height = moving.tilt @ self._d
        horizontal = moving.horizontal(self._d)
        speed = np.linalg.norm(np.cross(moving.rate_rad_s, self._d), axis=1)
        return LinkTruth(
            time_s=np.atleast_1d(np.asarray(time_s, dtype=np.float64)),
            height_m=height,
            roll_deg=np.degrees(np.arctan2(moving.tilt[:, 1], moving.tilt[:, 2])),
            pitch_deg=np.degrees(np.arctan2(-moving.tilt[:, 0], np.hypot(moving.tilt[:, 1], moving.tilt[:, 2]))),
            x_m=horizontal[:, 0],
            y_m=horizontal[:, 1],
            yaw_deg=(np.degrees(moving.yaw_rad) + 180.0) % 360.0 - 180.0,
            tilt=moving.tilt,
            accel_m_s2=accel,
            specific_force_m_s2=STANDARD_GRAVITY * moving.tilt + accel,
            rate_rad_s=moving.rate_rad_s,
            rate_derivative_rad_s2=moving.rate_derivative_rad_s2,
            pressure_Pa=self._weather.pressure(time_s, height, speed),
            temp_degC=_temperature(time_s),
        )

    def truth(self) -> LinkTruth:
        """The truth at every sample. Only of a run that ends."""
        if self.count is None:
            raise LinkposeError("a run without an end has no whole truth: give it a duration")
        return self.at(np.arange(self.count) / self.rate_hz)

    def truth_columns(self, time_s: Floats) -> Mapping[str, Floats]:
        """The truth at any instants (N,) as columns of a truth file: height, attitude and position of the sensor."""
        exact = self.at(time_s)
        return {name: getattr(exact, name) for name in _TRUTH_COLUMNS}

    def imu_counts(self, time_s: Floats, first: int) -> NDArray[np.int16]:
        """Raw accel xyz, temperature, gyro xyz (N, 7) as in the MPU-6050's burst, at any instants (N,).

        `first` is the number of the first of these readings since the start: it names their noise.
        """
        return self._imu_counts(time_s, first, self._felt(time_s, self._d), self.imu_errors, _IMU_NOISE)

    def imu2_counts(self, time_s: Floats, first: int) -> NDArray[np.int16]:
        """As `imu_counts`, of the second sensor."""
        return self._imu_counts(time_s, first, self._second(time_s), self.imu2_errors, _IMU2_NOISE)

    def _felt(self, time_s: Floats, at_m: Floats) -> tuple[Floats, Floats]:
        """Specific force (N, 3) m/s² and rate (N, 3) rad/s of a sensor at `at_m` (3,) from the joint, in its axes."""
        moving = self._motion.at(time_s)
        return STANDARD_GRAVITY * moving.tilt + moving.acceleration(at_m), moving.rate_rad_s

    def _second(self, time_s: Floats) -> tuple[Floats, Floats]:
        """As `_felt`, of the second sensor."""
        return self._felt(time_s, self._d / 2)

    def mag_field(self, time_s: Floats, first: int) -> Floats:
        """Field that the magnetometer measures (N, 3), µT, in the link's axes; `first` as for `imu_counts`."""
        noise = imu.white((self.seed, _MAG_NOISE, self.test), first, len(time_s), 3)
        noise = mag_model.noise_uT(self.errors) * noise
        moving = self._motion.at(time_s)
        field = mag_model.field(moving) + self._hard_iron_uT + noise
        if self._mag_disturbance is not None:
            field = field + self._mag_disturbance.field(moving, time_s)
        return field

    def _imu_counts(
        self, time_s: Floats, first: int, felt: tuple[Floats, Floats], errors: imu.ImuErrors, stream: int
    ) -> NDArray[np.int16]:
        """Counts of a sensor with this force and rate; `stream` names its noise."""
        force, rate = felt
        noise = imu.white((self.seed, stream, self.test), first, len(time_s), 7)
        accel = force @ errors.accel_matrix.T + errors.accel_bias_m_s2 + errors.accel_noise_m_s2 * noise[:, :3]
        rate = rate @ errors.gyro_matrix.T + errors.gyro_bias_rad_s
        chip_degC = _temperature(time_s) + 2.0  # the chip warms itself
        gyro_drift, accel_drift = self._drifts[stream].at(time_s, chip_degC)
        rate = rate + errors.gyro_noise_rad_s * noise[:, 4:] + gyro_drift
        accel = accel + accel_drift
        temp = chip_degC + 0.02 * (self.errors != "none") * noise[:, 3]
        return np.column_stack(
            [
                imu.accel_counts(accel, self.accel_range_g),
                imu.temperature_counts(temp),
                imu.gyro_counts(rate, self.gyro_range_deg_s),
            ]
        )

    def baro_temperature(self, time_s: Floats) -> Integers:
        """Raw temperature UT (N,) of the BMP180, with the data sheet's words, at any instants (N,)."""
        return baro.raw_temperature(_temperature(time_s))

    def baro_pressure(self, time_s: Floats, first: int) -> Integers:
        """Raw pressure UP (N,) of the BMP180, with the data sheet's words, at any instants (N,).

        `first` is the number of the first of these readings since the start: it names their noise.
        """
        moving = self._motion.at(time_s)
        speed = np.linalg.norm(np.cross(moving.rate_rad_s, self._d), axis=1)
        pressure = self._weather.pressure(time_s, moving.tilt @ self._d, speed)
        noise = imu.white((self.seed, _BARO_NOISE, self.test), first, len(time_s), 1)[:, 0]
        noise_Pa, noise_counts = (0.0, imu.CONVERTER_NOISE) if self.errors == "none" else (baro.PRESSURE_NOISE_PA, 0.0)
        pressure = pressure + noise_Pa * noise
        return baro.raw_pressure(pressure, _temperature(time_s), self.oversampling, noise_counts=noise_counts * noise)

    def block(self, first: int, count: int) -> RawBlock:
        """The SAMPLEs of ticks first … first + count − 1."""
        tick = np.arange(first, first + count, dtype=np.int64)
        time_s = tick / self.rate_hz
        counts = self.imu_counts(time_s, first)
        pressures = self._schedule.pressures_read(tick)
        ut, up = self._baro_of(tick, pressures)
        full = (counts == -32768) | (counts == 32767)
        flags = np.full(count, int(SampleFlags.IMU_VALID | SampleFlags.BARO_VALID), dtype=np.int64)
        flags |= np.where(full[:, :3].any(axis=1), int(SampleFlags.ACCEL_SATURATED), 0)
        flags |= np.where(full[:, 4:].any(axis=1), int(SampleFlags.GYRO_SATURATED), 0)
        t_us = np.rint(time_s * 1e6).astype(np.int64)
        imu2, mag, more = self._others(time_s, first)
        return RawBlock(
            tick, t_us, counts[:, :3], counts[:, 3], counts[:, 4:], ut, up, pressures, flags | more, imu2, mag
        )

    def _others(self, time_s: Floats, first: int) -> tuple[NDArray[np.int16], NDArray[np.int16], Integers]:
        """Counts of the second inertial sensor (N, 7 or 0) and the magnetometer (N, 3 or 0), and their flags (N,)."""
        size = len(time_s)
        imu2 = mag = np.empty((size, 0), np.int16)
        flags = np.zeros(size, np.int64)
        if self.hello_sensors & Sensors.IMU2:
            imu2 = self.imu2_counts(time_s + 1e-6 * (IMU2_OFFSET_US_400_KHZ - IMU_OFFSET_US), first)
            full = (imu2 == -32768) | (imu2 == 32767)
            flags |= int(SampleFlags.IMU2_VALID)
            flags |= np.where(full[:, :3].any(axis=1), int(SampleFlags.ACCEL2_SATURATED), 0)
            flags |= np.where(full[:, 4:].any(axis=1), int(SampleFlags.GYRO2_SATURATED), 0)
        if self.hello_sensors & Sensors.MAG:
            mag = mag_model.counts(self.mag_field(time_s, first))
            flags |= int(SampleFlags.MAG_VALID)
        return imu2, mag, flags

    def blocks(self) -> Iterator[RawBlock]:
        """All SAMPLEs, block by block; without end when the run has none."""
        first = 0
        while self.count is None or first < self.count:
            count = _BLOCK if self.count is None else min(_BLOCK, self.count - first)
            yield self.block(first, count)
            first += count

    def samples(self) -> Iterator[Sample]:
        """All SAMPLEs one by one, in bounded memory; without end when the run has none."""
        for block in self.blocks():
            yield from block.samples()

    def measurements(self) -> Measurements:
        """The whole run as a recording of it would be read. Only of a run that ends."""
        settings = BoardSettings(
            round(self.rate_hz),
            self.accel_range_g,
            self.gyro_range_deg_s,
            dlpf=0,
            baro_oversampling=self.oversampling,
            barometer=Barometer(DeviceFamily.BMP180, baro.DATASHEET_WORDS.words(), self.oversampling),
            mouse_ports=0,
            imu_families=(DeviceFamily.MPU6050, DeviceFamily.MPU6050 * bool(self.hello_sensors & Sensors.IMU2)),
            mag_family=DeviceFamily.QMC5883L * bool(self.hello_sensors & Sensors.MAG),
        )
        if self.count is None:
            raise LinkposeError("a run without an end has no whole recording: give it a duration")
        converter = Converter(settings)
        samples = list(self.samples())
        raw = RawSamples.of(samples, converter.mouse_ports)
        flags = np.array([sample.flags for sample in samples], dtype=np.int64)
        return converter.convert(raw, np.arange(len(samples)) / self.rate_hz, flags)

    def _baro_of(self, tick: Integers, pressures: Integers) -> tuple[Integers, Integers]:
        """UT and UP that the SAMPLEs of these ticks carry: the last ones read."""
        temperatures = self._schedule.temperatures_read(tick)
        oldest_ut, oldest_up = int(temperatures[0]) - 1, int(pressures[0]) - 1
        uts = self.baro_temperature(self._schedule.temperature_time(np.arange(oldest_ut, temperatures[-1])))
        ups = self.baro_pressure(self._schedule.pressure_time(np.arange(oldest_up, pressures[-1])), oldest_up)
        return uts[temperatures - 1 - oldest_ut], ups[pressures - 1 - oldest_up]


def simulate(
    test: int,
    seed: int,
    duration_s: float | None = PAPER_DURATION_S,
    rate_hz: float = 100.0,
    errors: str = "calibrated",
    j2s_m: Vector = PAPER_J2S_M,
) -> LinkRun:
    """A run of Test 1, 2 or 3. Raises LinkposeError for a value that cannot be."""
    return LinkRun(test, seed, duration_s, rate_hz, errors, j2s_m)


def _temperature(time_s: Floats) -> Floats:
    """Temperature (°C) of the air: a room that warms by a few tenths of a degree in minutes."""
    return np.asarray(25.0 + 0.3 * (1 - np.exp(-time_s / 200.0)))


def _check(
    test: int, seed: int, duration_s: float | None, rate_hz: float, errors: str, j2s_m: Vector, motion: str
) -> None:
    if motion not in MOTIONS:
        raise LinkposeError(f"there is no motion called {motion!r}: take {', '.join(MOTIONS)}")
    if test not in TESTS:
        raise LinkposeError(f"there is no Test {test}: take 1, 2 or 3")
    if seed < 0:
        raise LinkposeError(f"the seed is {seed}: take a whole number from 0 up")
    if duration_s is not None and not (math.isfinite(duration_s) and duration_s >= 1):
        raise LinkposeError(f"a duration of {duration_s} s is too short to move the link: take 1 s or more")
    if not 50 <= rate_hz <= 500:
        raise LinkposeError(f"the board samples at 50 to 500 Hz, not at {rate_hz:g} Hz")
    if errors not in imu.LEVELS:
        raise LinkposeError(f"there are no errors called {errors!r}: take {', '.join(imu.LEVELS)}")
    if not 0.01 <= math.hypot(*j2s_m) <= 10:
        raise LinkposeError(f"a J2S of {j2s_m} m is no link: its length must be 0.01 to 10 m")
