#include "Idle.h"

#include <avr/interrupt.h>
#include <avr/sleep.h>

namespace idle {

volatile uint16_t woken_at;

namespace {
uint32_t slept = 0;
}

void wait_for_work() {
  set_sleep_mode(SLEEP_MODE_IDLE);
  cli();
  while (!(GPIOR0 & _BV(kWork))) {
    const uint16_t before = TCNT1;
    GPIOR0 |= _BV(kAsleep);
    sleep_enable();
    sei();  // takes effect after the next instruction, so that no interrupt slips in before the sleep
    sleep_cpu();
    sleep_disable();
    cli();
    const uint16_t after = woken_at;
    slept += after >= before ? after - before : after + (OCR1A - before) + 1;  // Timer1 starts anew at each tick
  }
  GPIOR0 &= static_cast<uint8_t>(~_BV(kWork));
  sei();
}

uint32_t take_slept() {
  const uint32_t steps = slept;
  slept = 0;
  return steps;
}

}  // namespace idle
