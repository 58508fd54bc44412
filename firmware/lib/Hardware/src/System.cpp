#include "System.h"

#include <avr/io.h>
#include <avr/power.h>
#include <avr/wdt.h>

extern uint8_t _end;  // first byte after the static data, by the linker
extern uint8_t __stack;

namespace {

constexpr uint8_t kPaint = 0xC5;
constexpr uint8_t kStackBytesPerScan = 8;

uint16_t free_stack_bytes = 0;

// Kept out of .bss, which is cleared after these were written.
uint8_t cause_of_hardware __attribute__((section(".noinit")));
uint8_t cause_of_bootloader __attribute__((section(".noinit")));

}  // namespace

// Run by the C start-up, before any variable is set up. Optiboot clears MCUSR and hands its value over in r2.
extern "C" void keep_bootloaders_word() __attribute__((naked, used, section(".init0")));
void keep_bootloaders_word() { asm volatile("sts %0, r2" ::"i"(&cause_of_bootloader)); }

// The watchdog stays on, at its shortest, after it has reset the board: it must be off before anything takes time.
extern "C" void keep_cause_and_paint_stack() __attribute__((naked, used, section(".init3")));
void keep_cause_and_paint_stack() {
  cause_of_hardware = MCUSR;
  MCUSR = 0;
  wdt_disable();
  for (uint8_t* at = &_end; at <= &__stack; at++) *at = kPaint;
}

namespace board {

uint8_t reset_cause() {
  constexpr uint8_t kAll = _BV(PORF) | _BV(EXTRF) | _BV(BORF) | _BV(WDRF);
  if (cause_of_hardware & kAll) return cause_of_hardware & kAll;
  // Bootloaders older than that convention leave anything in r2.
  return cause_of_bootloader & ~kAll ? 0 : cause_of_bootloader;
}

void start_watchdog() { wdt_enable(WDTO_500MS); }
void feed_watchdog() { wdt_reset(); }

uint16_t free_stack() { return free_stack_bytes; }

// A full scan takes half a millisecond, so each pass of the main loop does a part of it.
void scan_stack() {
  static const uint8_t* at = &_end;
  for (uint8_t left = kStackBytesPerScan; left > 0; left--, at++) {
    if (at <= &__stack && *at == kPaint) continue;
    free_stack_bytes = static_cast<uint16_t>(at - &_end);
    at = &_end;
    return;
  }
}

void begin_led() { DDRB |= _BV(DDB5); }
void set_led(bool on) {
  if (on) {
    PORTB |= _BV(PORTB5);
  } else {
    PORTB &= static_cast<uint8_t>(~_BV(PORTB5));
  }
}

void power_down_unused() {
  ADCSRA = 0;
  power_adc_disable();
  power_spi_disable();
}

}  // namespace board
