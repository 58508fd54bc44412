#include "Idle.h"

#include <avr/interrupt.h>
#include <avr/sleep.h>

namespace idle {

namespace {
uint8_t counted = 0;  // TCNT0 when it was read last
uint16_t awake_counts = 0;
}  // namespace

void begin() {
  TIMSK0 = 0;  // the Arduino core's millis() is not used, and its interrupt would disturb the tick
  TCCR0A = 0;
  TCCR0B = kCountAwake;
  set_sleep_mode(SLEEP_MODE_IDLE);
  sleep_enable();
}

void wait_for_work() {
  cli();
  while (!(GPIOR0 & _BV(kWork))) {
    TCCR0B = 0;
    sei();  // takes effect after the next instruction, so that no interrupt slips in before the sleep
    sleep_cpu();
    cli();
  }
  GPIOR0 &= static_cast<uint8_t>(~_BV(kWork));
  sei();
  // Every tick is work, so this comes by before the 16 ms are over in which an 8-bit count wraps.
  const uint8_t now = TCNT0;
  awake_counts += static_cast<uint8_t>(now - counted);
  counted = now;
}

uint32_t take_awake_us() {
  const uint32_t us = static_cast<uint32_t>(awake_counts) * kCountUs;
  awake_counts = 0;
  return us;
}

}  // namespace idle
