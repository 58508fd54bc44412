#include "System.h"

#include <Messages.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/power.h>
#include <avr/wdt.h>

extern uint8_t _end;  // first byte after the static data, by the linker
extern uint8_t __stack;

namespace {

constexpr uint8_t kPaint = 0xC5;
constexpr uint8_t kStackBytesPerScan = 8;

uint16_t free_stack_bytes = 0;

// Variables that the C start-up leaves alone. SRAM keeps its contents during a reset, and loses them with the supply.
constexpr uint32_t kRanBefore = 0x6C706F73;
constexpr uint32_t kHung = 0x68756E67;
uint32_t ran_before __attribute__((section(".noinit")));
uint32_t hang_mark __attribute__((section(".noinit")));
uint16_t hang_word_address __attribute__((section(".noinit")));
uint8_t cause_of_bootloader __attribute__((section(".noinit")));
uint8_t cause __attribute__((section(".noinit")));
uint16_t hang_at __attribute__((section(".noinit")));

// The watchdog interrupts first and resets 0.5 s later, if interrupts are off.
inline void set_watchdog(uint8_t control) {
  const uint8_t sreg = SREG;
  cli();
  wdt_reset();
  WDTCSR = _BV(WDCE) | _BV(WDE);
  WDTCSR = control;
  SREG = sreg;
}

// Optiboot 4.6 to 6 clears MCUSR and passes it in r2; Optiboot 7 and later leave MCUSR alone; ATmegaBOOT and older
// Optiboots do not write r2, which then holds any value. Optiboot up to 6 ends its own wait with a watchdog reset:
// WDRF in r2 proves nothing.
inline uint8_t reset_cause_now() {
  constexpr uint8_t kAll = _BV(PORF) | _BV(EXTRF) | _BV(BORF) | _BV(WDRF);
  const uint8_t flags = MCUSR & kAll;
  if (flags) return flags;
  if (ran_before != kRanBefore) return wire::reset_cause::kPowerOn;
  return cause_of_bootloader & ~(_BV(EXTRF) | _BV(BORF)) ? 0 : cause_of_bootloader;
}

}  // namespace

// Runs first in the C start-up, while r2 still holds the value of the bootloader.
extern "C" void keep_bootloaders_word() __attribute__((naked, used, section(".init0")));
void keep_bootloaders_word() { asm volatile("sts %0, r2" ::"i"(&cause_of_bootloader)); }

// After a watchdog reset the watchdog stays on, at its shortest time: it is switched off before anything takes time.
extern "C" void keep_cause_and_paint_stack() __attribute__((naked, used, section(".init3")));
void keep_cause_and_paint_stack() {
  const bool hung = hang_mark == kHung && ran_before == kRanBefore;
  cause = hung ? wire::reset_cause::kHung | wire::reset_cause::kWatchdog : reset_cause_now();
  hang_at = hung ? 2 * hang_word_address : board::kNotHung;
  hang_mark = 0;
  ran_before = kRanBefore;
  MCUSR = 0;
  wdt_disable();
  for (uint8_t* at = &_end; at <= &__stack; at++) *at = kPaint;
}

// The main loop hangs. A reset by the watchdog would loop for ever in ATmegaBOOT, which leaves the watchdog on: the
// program restarts by a jump instead. The peripherals keep their state, so their interrupts are switched off; setup()
// initialises all of them. The return address on the stack is where the program was interrupted.
ISR(WDT_vect, ISR_NAKED) {
  asm volatile(
      "clr r1          \n\t"
      "pop r25         \n\t"
      "pop r24         \n\t"
      "sts %0+1, r25   \n\t"
      "sts %0, r24     \n\t" ::"i"(&hang_word_address));
  hang_mark = kHung;
  set_watchdog(0);
  TIMSK0 = TIMSK1 = TIMSK2 = 0;
  PCICR = 0;
  UCSR0B = 0;
  TWCR = 0;
  ADCSRA = 0;
  asm volatile("jmp 0");
}

namespace board {

uint8_t reset_cause() { return cause; }
uint16_t hung_at() { return hang_at; }

void start_watchdog() { set_watchdog(_BV(WDE) | _BV(WDIE) | WDTO_500MS); }
void feed_watchdog() { wdt_reset(); }

uint16_t free_stack() { return free_stack_bytes; }

// A full scan takes half a millisecond: each pass of the main loop does a part of it.
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

void power_down_unused() { power_spi_disable(); }

// One conversion of the band gap with AVCC as reference, at 125 kHz: the first takes 200 us.
void begin_supply() {
  power_adc_enable();
  ADMUX = _BV(REFS0) | 0x0E;
  ADCSRA = _BV(ADEN) | _BV(ADSC) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0);
}

uint16_t supply_mv() {
  constexpr uint32_t kBandGapMv = 1100;
  if (ADCSRA & _BV(ADSC)) return 0;
  const uint16_t counts = ADC;
  ADCSRA |= _BV(ADSC);
  return counts == 0 ? 0 : static_cast<uint16_t>(kBandGapMv * 1024 / counts);
}

}  // namespace board
