// Sleep until there is something to do, and the account of the time slept.
//
// An interrupt that gives the main loop work says so with signal_work(). Each interrupt begins with note_wake(), which
// stamps the end of a sleep, so that the time spent in interrupts counts as busy.
#pragma once
#include <avr/io.h>
#include <stdint.h>

namespace idle {

// GPIOR0 is a register nobody else uses; its bits are tested and set in one or two cycles.
constexpr uint8_t kAsleep = 0;
constexpr uint8_t kWork = 1;
extern volatile uint16_t woken_at;

inline void note_wake() {
  if (GPIOR0 & _BV(kAsleep)) {
    GPIOR0 &= static_cast<uint8_t>(~_BV(kAsleep));
    woken_at = TCNT1;
  }
}
inline void signal_work() { GPIOR0 |= _BV(kWork); }

// Sleeps until an interrupt has signalled work since the last call.
void wait_for_work();
// Steps of 0.5 us slept since the last call.
uint32_t take_slept();

}  // namespace idle
