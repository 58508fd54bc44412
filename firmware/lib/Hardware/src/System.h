// Why the board started, the watchdog, the free stack, and the LED.
#pragma once
#include <stdint.h>

namespace board {

// Bits of wire::reset_cause.
uint8_t reset_cause();

// From now on the board resets when feed_watchdog() is not called for 0.5 s.
void start_watchdog();
void feed_watchdog();

// Bytes of the stack never touched since boot, as of the last scan that scan_stack() completed.
uint16_t free_stack();
void scan_stack();

void begin_led();
void set_led(bool on);

// What nobody uses (ADC, SPI) is switched off.
void power_down_unused();

}  // namespace board
