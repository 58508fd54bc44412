// Reset cause, watchdog, supply voltage, free stack, LED.
#pragma once
#include <stdint.h>

namespace board {

constexpr uint16_t kNotHung = 0xFFFF;

// Bits of wire::reset_cause; 0: not known.
uint8_t reset_cause();
// Byte address in flash at which the watchdog interrupted the program before the last start, or kNotHung.
uint16_t hung_at();

// From now on the program restarts when feed_watchdog() is not called for 0.5 s.
void start_watchdog();
void feed_watchdog();

// Supply voltage in mV, measured against the band gap (1.1 V, +-10 % from part to part) since the last call; 0: no value.
void begin_supply();
uint16_t supply_mv();

// Bytes of the stack never used since boot, as of the last scan that scan_stack() completed.
uint16_t free_stack();
void scan_stack();

void begin_led();
void set_led(bool on);

// Switches the SPI off.
void power_down_unused();

}  // namespace board
