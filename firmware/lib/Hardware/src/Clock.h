// Timer1: the sampling clock, and the only clock of the firmware.
//
// It counts 0.5 us steps and starts anew at each tick. At a tick its interrupt starts the IMU's burst, always at the same
// distance, and latches the tick's time.
#pragma once
#include <avr/io.h>
#include <stdint.h>

namespace clock {

struct Tick {
  uint32_t number;  // of ticks since boot
  uint32_t t_us;
  bool has_mice;  // the SAMPLE of this tick carries the movement of the mice
};

void begin(uint16_t rate_hz);
// The time goes on without a jump: the present period ends as it was begun.
void set_rate(uint16_t rate_hz);

// The latest tick.
Tick tick();
uint32_t now_us();
// The same for use with interrupts off.
uint32_t now_us_locked();
// Steps of 0.5 us left until the next tick.
uint16_t steps_left();

// Lets the interrupt of compare B wake the main loop and end an overdue I2C transaction `steps` from now.
// Inline: an interrupt that calls no function saves only the registers that it uses.
inline __attribute__((always_inline)) void arm_deadline_locked(uint16_t steps) {
  OCR1B = TCNT1 + steps;
  TIFR1 = _BV(OCF1B);
  TIMSK1 |= _BV(OCIE1B);
}
inline __attribute__((always_inline)) void disarm_deadline() { TIMSK1 &= static_cast<uint8_t>(~_BV(OCIE1B)); }

}  // namespace clock
