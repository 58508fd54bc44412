#include "Clock.h"

#include <Messages.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "Idle.h"
#include "Ps2Ports.h"
#include "Twi.h"

namespace clock {
namespace {

constexpr uint32_t kStepsPerSecond = F_CPU / 8;

// The burst begins this many 0.5 us steps after the tick: close to the longest delay by one mouse's pin change
// (10 us; three at once take 24 us). It must not be longer: interrupts are off until the burst has
// begun and the time is latched, and a mouse that sends meanwhile holds its clock low for only 30 us. With 24 steps edges
// of a mouse at 16.6 kHz were missed at 250 Hz and its packets had to be repeated. wire::kImuOffsetUs follows it.
constexpr uint8_t kBurstDelaySteps = 16;
static_assert(kBurstDelaySteps / 2 + 1 == wire::kImuOffsetUs, "the schema states the distance");

volatile uint32_t tick_number;
volatile uint32_t tick_us;
volatile uint8_t tick_half_us;  // 0 or 1 step on top of tick_us
volatile bool tick_has_mice;
volatile uint16_t period_steps;
volatile uint16_t next_period_steps;

uint16_t period_of(uint16_t rate_hz) { return static_cast<uint16_t>(kStepsPerSecond / rate_hz); }

}  // namespace

void begin(uint16_t rate_hz) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    period_steps = next_period_steps = period_of(rate_hz);
    TCCR1A = 0;
    TCCR1B = _BV(WGM12) | _BV(CS11);
    OCR1A = period_steps - 1;
    TCNT1 = 0;
    TIFR1 = _BV(OCF1A) | _BV(OCF1B);
    TIMSK1 = _BV(OCIE1A);
  }
}

void set_rate(uint16_t rate_hz) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { next_period_steps = period_of(rate_hz); }
}

Tick tick() {
  Tick latest;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    latest.number = tick_number;
    latest.t_us = tick_us;
    latest.has_mice = tick_has_mice;
  }
  return latest;
}

uint32_t now_us_locked() {
  uint16_t steps = TCNT1;
  if (TIFR1 & _BV(OCF1A)) steps = TCNT1 + period_steps;  // a tick that waits for its interrupt
  return tick_us + ((steps + tick_half_us) >> 1);
}

uint32_t now_us() {
  uint32_t now;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { now = now_us_locked(); }
  return now;
}

uint16_t steps_left() {
  uint16_t left;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { left = TIFR1 & _BV(OCF1A) ? 0 : OCR1A - TCNT1; }
  return left;
}

}  // namespace clock

ISR(TIMER1_COMPA_vect) {
  idle::note_wake();
  while (TCNT1L < clock::kBurstDelaySteps) {
  }
  twi::start_bursts();
  clock::tick_has_mice = ps2::start_armed();
  // A tick ends the period that was in force until now.
  const uint8_t halves = (clock::period_steps & 1) + clock::tick_half_us;
  clock::tick_us += (clock::period_steps >> 1) + (halves >> 1);
  clock::tick_half_us = halves & 1;
  clock::tick_number++;
  if (clock::period_steps != clock::next_period_steps) {
    clock::period_steps = clock::next_period_steps;
    OCR1A = clock::period_steps - 1;  // well before TCNT1 gets there
  }
  idle::signal_mice_work();
}

ISR(TIMER1_COMPB_vect) {
  idle::note_wake();
  clock::disarm_deadline();
  twi::expire();
  idle::signal_work();
}
