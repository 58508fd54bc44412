"""The firmware's .hex on the emulated board, judged by what leaves the pins, the bus and the serial line."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from typing import Any

import numpy as np
import pytest
from measuring import DEFAULTS, busy, invalid, jitter_us, lost, valid_again_ms
from numpy.typing import NDArray
from rig_signals import RigFeed
from wire_link import WATCHED_BUS, WireLink, burst_starts, us

from linkpose.sensors.devices import Sensors, found
from linkpose.simulation.baro import DATASHEET_WORDS
from linkpose.simulation.link import simulate
from linkpose.wire.frames import encode
from linkpose.wire.messages import (
    BAUD,
    PROTOCOL_MAJOR,
    SCHEMA_CRC,
    Ack,
    Command,
    Configure,
    DeviceFamily,
    DeviceKind,
    DeviceState,
    GetInfo,
    Hello,
    HelloDevice,
    Nak,
    NakReason,
    Ping,
    Pong,
    ResetCause,
    Sample,
    SampleFlags,
    Sections,
    SelfTest,
    SelfTestResult,
    Start,
    Stop,
)
from virtual_uno import CLOCK_HZ, Faults

NOT_HUNG = 0xFFFF
MakeBoard = Callable[..., WireLink]


def configured(hello: Hello) -> Configure:
    return Configure(*(getattr(hello, name) for name in Configure._fields))


def ramp(uno_seconds: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A table at 1 kHz whose accel and gyro counts (8 g, 1000 deg/s) name the row they were sampled from."""
    time_s = np.arange(round(uno_seconds * 1000)) / 1000
    number = np.arange(len(time_s))
    rows = np.zeros((len(time_s), 7))
    rows[:, 0] = (number % 30000) * 8 / 32768
    rows[:, 1] = (number // 30000) * 8 / 32768
    rows[:, 2] = -(number % 1000) * 8 / 32768
    rows[:, 3] = (number % 30000) * 1000 / 32768
    rows[:, 4] = -rows[:, 3]
    rows[:, 5] = 123 * 1000 / 32768
    rows[:, 6] = 36.53 + (number % 100) / 340
    return time_s, rows


def valid(sample: Sample, flag: SampleFlags) -> bool:
    return bool(sample.flags & flag)


# --- boot and commands ---


def test_says_hello_at_boot(board: MakeBoard) -> None:
    link = board()
    hello = link.boot()
    assert (hello.protocol_major, hello.schema_crc) == (PROTOCOL_MAJOR, SCHEMA_CRC)
    assert hello.reset_cause & ResetCause.POWER_ON
    assert (hello.sample_rate_hz, hello.accel_range_g, hello.gyro_range_deg_s) == DEFAULTS[:3]
    assert (hello.dlpf, hello.baro_oversampling) == DEFAULTS[3:5]
    assert not hello.streaming


def test_names_its_sensors(board: MakeBoard) -> None:
    link = board()
    link.boot()
    link.run_ms(200)
    link.send(GetInfo())
    hello = link.expect(Hello, 50)
    assert found(hello) == Sensors.MPU6050 | Sensors.BMP180
    assert hello.devices[0] == HelloDevice(DeviceKind.IMU, 0x68, 0x68, DeviceFamily.MPU6050, DeviceState.OK)
    assert hello.devices[2] == HelloDevice(DeviceKind.BAROMETER, 0x77, 0x55, DeviceFamily.BMP180, DeviceState.OK)
    assert hello.baro_words == (*(word & 0xFFFF for word in DATASHEET_WORDS), 0)
    assert hello.sections == Sections.IMU | Sections.BARO


def test_reset_by_the_host_is_told(board: MakeBoard) -> None:
    link = board()
    link.boot()
    link.uno.reset()
    assert link.boot().reset_cause & ResetCause.EXTERNAL


def test_starts_behind_a_bootloader(board: MakeBoard) -> None:
    """An UNO's bootloader waits for a second and leaves no cause of the reset behind."""
    link = board(bootloader_s=1.0)
    link.boot()
    link.uno.reset()
    link.run_ms(1000)
    assert link.messages == []
    assert link.boot().reset_cause == 0
    link.carry_out(Start())


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"sample_rate_hz": 49}, NakReason.SAMPLE_RATE_OUT_OF_RANGE),
        ({"sample_rate_hz": 501}, NakReason.SAMPLE_RATE_OUT_OF_RANGE),
        ({"accel_range_g": 3}, NakReason.ACCEL_RANGE_OUT_OF_RANGE),
        ({"gyro_range_deg_s": 1001}, NakReason.GYRO_RANGE_OUT_OF_RANGE),
        ({"dlpf": 7}, NakReason.DLPF_OUT_OF_RANGE),
        ({"baro_oversampling": 4}, NakReason.BARO_OVERSAMPLING_OUT_OF_RANGE),
        ({"mouse_counts_per_mm": 3}, NakReason.MOUSE_RESOLUTION_OUT_OF_RANGE),
    ],
)
def test_refuses_what_is_out_of_range(board: MakeBoard, change: dict[str, int], reason: NakReason) -> None:
    link = board()
    before = link.boot()
    assert link.command(DEFAULTS._replace(**change)) == Nak(Command.CONFIGURE, reason)
    link.send(GetInfo())
    after = link.expect(Hello, 50)
    assert configured(after) == configured(before)
    assert (after.sample_rate_hz, after.accel_range_g, after.gyro_range_deg_s, after.dlpf) == DEFAULTS[:4]


def test_refuses_commands_out_of_place(board: MakeBoard) -> None:
    link = board()
    link.start()
    assert link.command(DEFAULTS) == Nak(Command.CONFIGURE, NakReason.STREAMING)
    assert link.command(SelfTest(0)) == Nak(Command.SELF_TEST, NakReason.STREAMING)
    assert link.command(Start()) == Ack(Command.START)
    assert link.command(Stop()) == Ack(Command.STOP)
    link.forget()
    link.run_ms(100)
    assert link.samples == []


def test_settings_reach_the_sensor(board: MakeBoard) -> None:
    link = board()
    link.boot()
    link.run_ms(200)
    link.uno.imu.feed([0], [[1.0, 0, 0, 100.0, 0, 0, 25]])
    link.carry_out(DEFAULTS._replace(accel_range_g=2, gyro_range_deg_s=250, dlpf=1))
    link.run_ms(200)
    link.carry_out(Start())
    link.run_ms(100)
    assert link.uno.transact(0x68, b"\x1a", 3) == bytes([1, 0, 0])
    sample = link.samples[-1]
    assert (sample.accel_x, sample.gyro_x) == (16384, round(100 * 32768 / 250))


def test_answers_pings_at_once(board: MakeBoard) -> None:
    """While streaming, the PONG has left 3 ms after the PING came (a SAMPLE may be before it), and its t_us is the
    PING's arrival to 0.1 ms: a host may set its clock by it."""
    link = board()
    link.start()
    link.uno.watch(["uart_rx", "uart_tx"])
    answered_us, stamped_us = [], []
    for token in range(50):
        link.run_ms(13.7)
        link.uno.events()
        link.send(Ping(token))
        link.run_ms(5)
        pong = link.expect(Pong, 0)
        assert pong.token == token
        events = link.uno.events()
        arrived = events["cycle"][events["kind"] == "uart_rx"][-1]
        sent = events[events["kind"] == "uart_tx"]
        frame = encode(pong)
        last = sent["value"].astype(np.uint8).tobytes().index(frame) + len(frame) - 1
        answered_us.append(us(sent["cycle"][last] - arrived))
        stamped_us.append(us(arrived) - pong.t_us)
    assert max(answered_us) < 3000
    assert np.ptp(stamped_us) < 100


def test_self_test_fits_the_factory_trim(board: MakeBoard) -> None:
    link = board(mpu6050={"accelTrim": [13, 14, 17], "gyroTrim": [14, 15, 16], "selfTestError": 0.04})
    link.boot()
    link.run_ms(300)
    link.uno.imu.feed([0], [[0.01, -0.02, 1.0, 0.5, -0.5, 0.2, 25]])
    link.carry_out(SelfTest(0))
    result = link.expect(SelfTestResult, 1500)
    expected = 25 * 131 * 1.046 ** (14 - 1) * 1.04
    assert result.excited_gyro_x - result.plain_gyro_x == pytest.approx(expected, abs=3)
    expected = 4096 * 0.34 * (0.92 / 0.34) ** ((17 - 1) / 30) * 1.04
    assert result.excited_accel_z - result.plain_accel_z == pytest.approx(expected, abs=3)
    assert (result.device, result.family) == (0, DeviceFamily.MPU6050)


def test_counts_corrupt_commands_and_carries_on(board: MakeBoard) -> None:
    link = board()
    link.start()
    link.uno.set_line(to_board=Faults(flip=0.2, drop=0.02, insert=0.02))
    for token in range(100):
        link.send(Ping(token))
        link.run_ms(10)
    link.uno.set_line()
    link.uno.send(b"\0")
    link.forget()
    link.run_ms(1500)
    assert link.status.commands_corrupt > 20
    assert lost(link.samples) == 0
    link.send(Ping(7))
    assert link.expect(Pong, 50).token == 7


def test_noise_from_the_host_does_no_harm(board: MakeBoard) -> None:
    """Two seconds of random bytes at the line's full rate, some stretches of them without any 0x00."""
    link = board()
    link.start()
    rng = np.random.default_rng(8)
    for turn in range(100):
        link.uno.send(rng.integers(turn % 2, 256, 500, dtype=np.uint8).tobytes())
        link.run_ms(20)
    link.uno.send(b"\0")
    link.run_ms(1100)
    assert lost(link.samples) == 0
    assert link.status.rx_overruns == 0
    assert link.status.commands_corrupt > 50
    link.send(Ping(9))
    assert link.expect(Pong, 50).token == 9


# --- the stream ---


def test_a_minute_without_a_gap(board: MakeBoard) -> None:
    """100 Hz for 60 s: every tick one SAMPLE, its counts those of the instant at which the sensor was read."""
    link = board()
    link.uno.imu.feed(*ramp(65))
    link.start()
    link.uno.watch(WATCHED_BUS)
    link.run_ms(100)
    link.forget()
    link.uno.events()
    link.run_ms(60_000)
    samples = link.samples
    starts = burst_starts(link.uno.events())
    assert len(samples) == 6000
    assert len(starts) in (6000, 6001)
    assert lost(samples) == 0
    assert set(np.diff([sample.t_us for sample in samples])) == {10_000}
    assert link.decoder.corrupt.total == 0
    assert all(valid(sample, SampleFlags.IMU_VALID) for sample in samples)
    _check_ramp(samples, starts)
    status = link.status
    assert (status.ticks_missed, status.frames_dropped, status.i2c_errors, status.rx_overruns) == (0, 0, 0, 0)
    assert link.uno.state()["contentions"] == 0


def _check_ramp(samples: list[Sample], starts: NDArray[np.float64]) -> None:
    """The row that each sample's counts name is the newest one the sensor had when its burst began."""
    rows = np.array([sample.accel_x + 30000 * sample.accel_y for sample in samples])
    for sample, row in zip(samples, rows.tolist(), strict=True):
        assert sample[4:7] == (row % 30000, row // 30000, -(row % 1000))
        assert sample.imu_temp - row % 100 in (0, 1)  # the emulated sensor's noise
        assert sample[8:11] == (row % 30000, -(row % 30000), 123)
    read_at_ms = starts[: len(rows)] / CLOCK_HZ * 1000
    age_ms = read_at_ms - rows
    assert age_ms.min() >= 0
    assert age_ms.max() < 2.1  # one period of the table and one of the sensor's own samples


def test_the_simulated_rig_reaches_the_wire_unchanged(board: MakeBoard) -> None:
    """In the run's own ranges, each SAMPLE carries the counts of the run at the instant of the sensor's sample."""
    link = board()
    run = simulate(1, 5, None)
    feed = RigFeed(link.uno, run)
    link.start()
    link.uno.watch(WATCHED_BUS)
    for _ in range(120):
        feed.supply()
        link.run_ms(100)
    starts = burst_starts(link.uno.events())[: len(link.samples)]
    newest = np.floor(starts / CLOCK_HZ * 1000).astype(int)
    counts = run.imu_counts(np.arange(newest[-1] + 1) / 1000, 0)
    for sample, row in zip(link.samples, newest.tolist(), strict=True):
        candidates = [counts[max(0, row - age)].tolist() for age in (0, 1, 2)]
        assert [*sample[4:7], *sample[8:11]] in [counts[:3] + counts[4:] for counts in candidates]


def test_imu_reads_begin_at_a_fixed_distance_from_the_tick(board: MakeBoard) -> None:
    link = board()
    link.start()
    link.uno.watch(WATCHED_BUS)
    for token in range(100):
        link.send(Ping(token))
        link.run_ms(50)
    starts = burst_starts(link.uno.events())
    assert len(starts) >= 499
    assert jitter_us(starts, 100) <= 5.0


@pytest.mark.parametrize("oversampling", [0, 1])
def test_barometer_converts_in_the_quiet_gap(board: MakeBoard, oversampling: int) -> None:
    """No traffic during a conversion, nine pressures to a temperature, every one counted once by baro_count."""
    link = board(bmp180={"disturbancePa": 1000.0})
    link.uno.baro.feed([0], [[100_000.0, 25.0]])
    link.boot()
    link.carry_out(DEFAULTS._replace(baro_oversampling=oversampling))
    link.run_ms(500)
    link.carry_out(Start())
    before = link.uno.state()
    link.uno.watch(["baro_begin", "baro_end"])
    link.run_ms(10_000)
    after = link.uno.state()
    assert after["conversions"] - before["conversions"] >= 900
    assert after["conversions_disturbed"] == before["conversions_disturbed"]
    events = link.uno.events()
    controls = events["value"][events["kind"] == "baro_begin"]
    temperatures = np.flatnonzero(controls == 0x2E)
    assert set(np.diff(temperatures)) == {10}
    assert set(controls.tolist()) == {0x2E, 0x34 | oversampling << 6}
    _check_pressures(link.samples[20:])


def _check_pressures(samples: list[Sample]) -> None:
    counts = np.array([sample.baro_count for sample in samples])
    steps = np.diff(counts) & 0xFF
    assert set(steps.tolist()) <= {0, 1}
    assert np.count_nonzero(steps) >= 0.88 * len(steps)
    assert len({(sample.baro_ut, sample.baro_up) for sample in samples}) == 1


def test_saturation_is_flagged(board: MakeBoard) -> None:
    link = board()
    link.start()
    link.uno.imu.feed([0], [[9.0, 0, 0, 0, 0, -1200, 25]])
    link.run_ms(50)
    flags = link.samples[-1].flags
    assert flags & SampleFlags.ACCEL_SATURATED
    assert flags & SampleFlags.GYRO_SATURATED


def at_500_hz(link: WireLink) -> WireLink:
    link.boot()
    link.carry_out(DEFAULTS._replace(sample_rate_hz=500))
    link.run_ms(300)
    link.carry_out(Start())
    link.forget()
    return link


def test_highest_rate_without_mice(board: MakeBoard) -> None:
    link = at_500_hz(board())
    link.run_ms(5000)
    assert 2499 <= len(link.samples) <= 2501
    assert lost(link.samples) == 0
    assert link.status.ticks_missed == 0


def test_resources(board: MakeBoard) -> None:
    """The load and stack that the firmware reports are those seen from outside."""
    link = board()
    link.start()
    link.run_ms(1000)
    before = link.uno.state()
    link.run_ms(5000)
    after = link.uno.state()
    assert link.status.cpu_load / 1000 == pytest.approx(busy(before, after), abs=0.05)
    assert link.status.stack_free >= 400
    assert longest_run(link.uno.peek(0x100, 2048)) == pytest.approx(link.status.stack_free, abs=2)


def longest_run(memory: bytes) -> int:
    """The longest stretch of one byte other than 0: the paint on the stack that was never touched."""
    return max(len(list(group)) for byte, group in groupby(memory) if byte != 0)


def test_a_full_transmitter_drops_whole_frames(board: MakeBoard) -> None:
    """PINGs faster than PONGs fit beside 500 SAMPLEs a second: what arrives is sound, what is missing is counted."""
    link = at_500_hz(board())
    for token in range(1000):
        link.send(Ping(token))
        if token % 2:
            link.run_ms(1)
    link.run_ms(1200)
    assert link.decoder.corrupt.total == 0
    dropped = lost(link.samples) + 1000 - len(link.of(Pong))
    assert link.status.frames_dropped == dropped > 0


# --- faults ---


def _break(link: WireLink, fault: str) -> None:
    uno = link.uno
    actions: dict[str, Callable[[], Any]] = {
        "imu pulled": uno.imu.unplug,
        "imu NACK": lambda: uno.imu.nack(address=True),
        "imu data NACK": lambda: uno.imu.nack(data=True),
        "baro pulled": uno.baro.unplug,
        "baro NACK": lambda: uno.baro.nack(address=True),
        "SDA stuck": uno.hold_sda,
    }
    actions[fault]()


def _mend(link: WireLink) -> None:
    for sensor in (link.uno.imu, link.uno.baro):
        sensor.plug()
        sensor.nack()
    link.uno.release_sda()


@pytest.mark.parametrize(
    ("fault", "harmed", "kept"),
    [
        ("imu pulled", SampleFlags.IMU_VALID, SampleFlags.BARO_VALID),
        ("imu NACK", SampleFlags.IMU_VALID, SampleFlags.BARO_VALID),
        ("imu data NACK", SampleFlags.IMU_VALID, SampleFlags.BARO_VALID),
        ("baro pulled", SampleFlags.BARO_VALID, SampleFlags.IMU_VALID),
        ("baro NACK", SampleFlags.BARO_VALID, SampleFlags.IMU_VALID),
        ("SDA stuck", SampleFlags.IMU_VALID, None),
    ],
)
def test_a_broken_sensor_harms_no_other_and_comes_back(
    board: MakeBoard, fault: str, harmed: SampleFlags, kept: SampleFlags | None
) -> None:
    link = board()
    link.uno.imu.feed([0], [[0.5, 0.25, 1.0, 10, 20, 30, 25]])
    link.start()
    link.run_ms(500)
    _break(link, fault)
    link.run_ms(1000)
    broken = link.samples[-50:]
    assert not any(valid(sample, harmed) for sample in broken)
    if kept is not None:
        assert invalid(link.samples, kept) == 0
    assert lost(link.samples) == 0
    link.forget()
    _mend(link)
    link.run_ms(1000)
    assert valid_again_ms(link.samples, harmed) <= 100
    assert lost(link.samples) == 0
    assert link.samples[-1][4:7] == (2048, 1024, 4096)
    assert link.status.ticks_missed == 0


@pytest.mark.parametrize("clocks", [1, 5, 9])
def test_a_stuck_bus_is_freed_with_clocks(board: MakeBoard, clocks: int) -> None:
    link = board()
    link.start()
    link.run_ms(200)
    link.expect(Sample, 20)  # sent when the bus has become quiet: only bit-banged clocks can release SDA
    link.run_ms(2)
    link.forget()
    link.uno.hold_sda(clocks)
    link.run_ms(500)
    assert not link.uno.state()["sda_held"]
    assert valid_again_ms(link.samples, SampleFlags.IMU_VALID) <= 50
    assert lost(link.samples) == 0
    link.run_ms(1000)
    assert link.status.i2c_recoveries >= 1
    assert link.status.ticks_missed == 0


def test_every_moment_may_be_the_one_in_which_the_bus_sticks(board: MakeBoard) -> None:
    """SDA is caught at 60 places of the tick, held for three clocks; each time it comes back, with no SAMPLE lost."""
    link = board()
    link.start()
    for _ in range(60):
        link.uno.hold_sda(3)
        link.run_ms(100.17)
    link.run_ms(1000)
    assert lost(link.samples) == 0
    assert valid(link.samples[-1], SampleFlags.IMU_VALID)
    assert link.status.ticks_missed == 0


def test_wrong_bytes_never_set_the_sensor_up_wrong(board: MakeBoard) -> None:
    """A noisy bus corrupts bytes for two seconds; afterwards the readings are right again within 100 ms."""
    link = board(seed=4)
    link.uno.imu.feed([0], [[0.5, 0.25, 1.0, 10, 20, 30, 25]])
    link.start()
    link.uno.corrupt_i2c(0.05)
    link.run_ms(2000)
    link.uno.corrupt_i2c(0.0)
    link.forget()
    link.run_ms(1000)
    settled = link.samples[10:]
    assert all(valid(sample, SampleFlags.IMU_VALID) for sample in settled)
    assert {sample[4:7] for sample in settled} == {(2048, 1024, 4096)}


def test_boots_without_sensors(board: MakeBoard) -> None:
    link = board()
    link.uno.imu.unplug()
    link.uno.baro.unplug()
    hello = link.boot()
    assert found(hello) == 0
    link.carry_out(Start())
    link.run_ms(1000)
    assert len(link.samples) >= 99
    assert lost(link.samples) == 0


def test_a_program_that_hangs_with_interrupts_off_is_reset(board: MakeBoard) -> None:
    link = board()
    link.start()
    link.uno.hang()
    hello = link.boot()
    assert hello.reset_cause & ResetCause.WATCHDOG
    assert hello.hung_at == NOT_HUNG
    link.carry_out(Start())
    link.run_ms(100)
    assert len(link.samples) >= 9


def test_a_program_that_hangs_restarts_and_reports_where(board: MakeBoard) -> None:
    """It restarts without a reset: a bootloader that leaves the watchdog on would be reset in a loop."""
    link = board(mice=[{}])
    link.start(1500)
    link.uno.watch(["reset"])
    at = link.uno.hang(interrupts=True)
    hello = link.boot()
    assert hello.reset_cause == ResetCause.WATCHDOG | ResetCause.HUNG
    assert hello.hung_at == at
    assert len(link.uno.events()) == 0
    link.carry_out(Start())
    link.run_ms(1500)
    assert valid(link.samples[-1], SampleFlags.IMU_VALID) and valid(link.samples[-1], SampleFlags.MOUSE1_VALID)
    assert lost(link.samples) == 0
    link.uno.reset()
    hello = link.boot()
    assert (hello.reset_cause, hello.hung_at) == (ResetCause.EXTERNAL, NOT_HUNG)


def test_a_reset_within_a_frame_does_not_cost_hello(board: MakeBoard) -> None:
    """A frame is 1.5 ms long: the resets cut it near its beginning, in its middle and near its end."""
    link = board()
    link.start()
    for cut_ms in (0.2, 0.5, 0.8):
        link.run_ms(5)
        while not (begun := link.uno.take_received()):
            link.uno.run_ms(0.05)
        link.decoder.feed(begun)
        link.run_ms(cut_ms)
        corrupt = link.decoder.corrupt.total
        link.uno.reset()
        link.forget()
        assert link.expect(Hello, 500).streaming == 0
        assert link.decoder.corrupt.total == corrupt + 1
        link.carry_out(Start())


@pytest.mark.parametrize(("supply_v", "band_gap_v"), [(5.0, 1.1), (4.2, 1.1), (5.0, 1.0)])
def test_supply_voltage_is_measured_against_the_band_gap(board: MakeBoard, supply_v: float, band_gap_v: float) -> None:
    link = board(adc={"bandGapV": band_gap_v})
    link.uno.supply(supply_v)
    link.start()
    link.run_ms(2100)
    assert link.status.vcc_mv / 1000 == pytest.approx(supply_v * 1.1 / band_gap_v, abs=0.025)


def test_a_wrong_bit_rate_is_garbage_both_ways(board: MakeBoard) -> None:
    link = board()
    link.start()
    link.uno.set_line(baud=115200)
    link.run_ms(500)
    assert link.samples == []
    assert link.decoder.corrupt.total > 0
    link.uno.set_line(baud=BAUD)
    link.run_ms(50)
    link.send(Ping(1))
    assert link.expect(Pong, 100).token == 1
