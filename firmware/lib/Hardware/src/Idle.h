// Sleep until there is something to do, and the account of the time awake.
//
// An interrupt that gives the main loop work calls signal_work(). Timer0 counts the time awake: it is stopped
// before each sleep, and every interrupt begins with note_wake(), which lets it go on. Both are one or two instructions,
// as tens of thousands of interrupts a second wake the CPU when mice are polled.
#pragma once
#include <avr/io.h>
#include <stdint.h>

namespace idle {

// GPIOR0 is a register nobody else uses; its bits are tested and set in one or two cycles.
constexpr uint8_t kWork = 0;
constexpr uint8_t kMiceWork = 1;
// A count each 64 us. It takes no part in what is measured, so the mean comes out right.
constexpr uint8_t kCountAwake = _BV(CS02) | _BV(CS00);
constexpr uint8_t kCountUs = 64;

inline __attribute__((always_inline)) void note_wake() { TCCR0B = kCountAwake; }
inline __attribute__((always_inline)) void signal_work() { GPIOR0 |= _BV(kWork); }

// Work for the mice: a tick, or the end of one of their transactions. Most passes of the main loop have other causes.
inline __attribute__((always_inline)) void signal_mice_work() {
  GPIOR0 |= _BV(kMiceWork);
  signal_work();
}
inline bool take_mice_work() {
  if (!(GPIOR0 & _BV(kMiceWork))) return false;
  GPIOR0 &= static_cast<uint8_t>(~_BV(kMiceWork));
  return true;
}

void begin();
// Sleeps until an interrupt has signalled work since the last call.
void wait_for_work();
// Time awake since the last call.
uint32_t take_awake_us();

}  // namespace idle
