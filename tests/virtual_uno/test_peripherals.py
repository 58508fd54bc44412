"""The emulated ATmega328P against its data sheet: a program measures it from inside, events show it from outside."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from virtual_uno import VirtualUno

BIT = 16 + 2 * 12  # cycles of an I2C bit at TWBR 12, data sheet 22.5.2
POLL = 25  # the probe's loop sees a flag at most so many cycles late
TIMER1_COMPA = 11  # vector numbers, data sheet table 12-6


class Probed(NamedTuple):
    values: dict[str, list[int]]
    events: NDArray[Any]


@pytest.fixture(scope="module")
def probe_hex(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("probe")
    flags = ["-std=gnu++14", "-mmcu=atmega328p", "-DF_CPU=16000000UL", "-Os", "-Wall", "-Wextra", "-Werror"]
    source = Path(__file__).with_name("probe.cpp")
    subprocess.run(["avr-g++", *flags, "-o", folder / "probe.elf", source], check=True)
    subprocess.run(["avr-objcopy", "-O", "ihex", folder / "probe.elf", folder / "probe.hex"], check=True)
    return folder / "probe.hex"


@pytest.fixture(scope="module")
def probed(probe_hex: Path) -> Iterator[Probed]:
    with VirtualUno(probe_hex, seed=3) as uno:
        uno.watch(["interrupt", "uart_tx", "reset", "i2c_start", "i2c_address"])
        text = ""
        asked = 0
        while "\nend 0\n" not in text and uno.time_s < 2:
            uno.run_ms(0.1)
            text += uno.take_received().decode()
            if text.count("?") > asked:  # it waits for 2 ms with nothing to send
                asked += 1
                # First four bytes, one more than the receiver holds; then one at a rate that is not the board's.
                uno.set_line(baud=None if asked == 1 else 115200)
                uno.send(bytes([1, 2, 3, 4]) if asked == 1 else b"\0")
                uno.run_ms(1.0)
                uno.set_line()
        events = uno.events()
    lines = [line.replace("?", "").split() for line in text.splitlines() if line.strip("?")]
    values: dict[str, list[int]] = {}
    for name, value in lines:
        values.setdefault(name, []).append(int(value))
    yield Probed(values, events)


STATUS_CODES = {  # data sheet tables 22-3 and 22-4
    "twi_start": 0x08,
    "twi_repeated_start": 0x10,
    "twi_address_write_ack": 0x18,
    "twi_address_nack": 0x20,
    "twi_write_ack": 0x28,
    "twi_address_read_ack": 0x40,
    "twi_read_ack": 0x50,
    "twi_read_nack": 0x58,
    "twi_status_after_stop": 0xF8,
    "twi_start_right_after_stop": 0x08,
    "twi_stop_and_start": 0x08,
}


@pytest.mark.parametrize(("name", "code"), STATUS_CODES.items())
def test_twi_status_codes(probed: Probed, name: str, code: int) -> None:
    assert probed.values[name] == [code]


def test_twi_transfers_take_their_bit_times(probed: Probed) -> None:
    assert BIT <= probed.values["twi_start_cycles"][0] <= BIT + POLL
    assert 9 * BIT <= probed.values["twi_byte_cycles"][0] <= 9 * BIT + POLL
    assert BIT <= probed.values["twi_stop_cycles"][0] <= BIT + POLL


def test_twi_sets_no_flag_after_stop_and_marks_a_write_collision(probed: Probed) -> None:
    assert probed.values["twi_flag_after_stop"] == [0]
    assert probed.values["twi_write_collision"] == [1]
    assert probed.values["twi_who_am_i"] == [0x68]


def test_interrupt_entry(probed: Probed) -> None:
    """The flag rises one clock after the match; then 4 cycles, the vector's jump (3), three pushes (2 each), an `in`
    and the load's first cycle. Out of sleep 4 more (7.7.1)."""
    awake = 1 + 4 + 3 + 3 * 2 + 1 + 1
    assert probed.values["entry_after_match"] == [awake]
    assert probed.values["entry_after_match_asleep"] == [awake + 4]


def test_a_pending_interrupt_cannot_run_between_sei_and_sleep(probed: Probed) -> None:
    assert probed.values["pending_wakes_sleep"] == [1]


def test_flags_and_cycles_of_bit_instructions(probed: Probed) -> None:
    assert probed.values["sbi_clears_one_flag"] == [0x02]  # OCF1A stays
    for name in ("sbi_100_cycles", "cbi_100_cycles"):
        assert 200 <= probed.values[name][0] <= 200 + POLL


def test_pins(probed: Probed) -> None:
    assert probed.values["pin_change_on_output"] == [1]
    assert probed.values["pin_change_survives_mask"] == [2]
    assert probed.values["pin_read_at_once"] == [0]  # the synchroniser, 14.2.4
    assert probed.values["pin_read_later"] == [1]
    assert probed.values["pin_toggled"] == [0]
    assert probed.values["pin_pulled_up"] == [1]


def test_usart_transmitter_holds_two_bytes(probed: Probed) -> None:
    character = 10 * 64  # 250000 baud
    assert probed.values["usart_first_taken_cycles"][0] <= POLL
    assert character <= probed.values["usart_second_taken_cycles"][0] <= character + POLL
    assert 2 * character <= probed.values["usart_complete_cycles"][0] <= 2 * character + POLL
    assert probed.values["usart_empty_interrupts"] == [2]


def test_usart_bytes_follow_each_other_without_a_gap(probed: Probed) -> None:
    sent = probed.events["cycle"][probed.events["kind"] == "uart_tx"]
    gaps = np.diff(sent)
    assert gaps.min() == 640
    assert np.count_nonzero(gaps == 640) > 300


def test_usart_receiver_holds_three_bytes_and_marks_what_is_lost(probed: Probed) -> None:
    assert probed.values["usart_received"][0] == 3
    assert probed.values["usart_received_sum"][0] == 1 + 2 + 4  # the third was still in the shift register
    assert probed.values["usart_overruns"][0] == 1


def test_usart_at_another_rate_gives_framing_errors(probed: Probed) -> None:
    assert probed.values["usart_frame_errors"][1] >= 1


def test_timer_ticks_wake_the_core_without_drift(probed: Probed) -> None:
    entered = probed.events[(probed.events["kind"] == "interrupt") & (probed.events["value"] == TIMER1_COMPA)]
    assert len(entered) == 100
    assert set(np.diff(entered["cycle"])) == {8000.0}


def test_watchdog_resets_and_stays_on(probed: Probed) -> None:
    assert probed.values["first_reset_cause"] == [0x01]
    assert probed.values["reset_cause_after_writing_ones"] == [0]
    assert probed.values["second_reset_cause"] == [0x08]
    assert probed.values["watchdog_still_on"] == [1]
    resets = probed.events[probed.events["kind"] == "reset"]
    assert list(resets["value"]) == [0x08]


def test_watchdog_interrupts_before_it_resets_and_a_reset_keeps_the_registers(probed: Probed) -> None:
    assert probed.values["watchdog_interrupts"] == [1]
    assert probed.values["r2_after_reset"] == [0xA7]


def test_adc_measures_the_band_gap(probed: Probed) -> None:
    """Data sheet table 23-1: 25 clocks for the first conversion, then 13; a prescaler of 16."""
    assert 25 * 16 <= probed.values["adc_first_cycles"][0] <= 25 * 16 + POLL
    assert 13 * 16 <= probed.values["adc_second_cycles"][0] <= 13 * 16 + POLL
    assert probed.values["adc_band_gap"] == [225]  # 1.1 V of 5.0 V
    assert probed.values["adc_open_input"] == [0]
