#include "Ps2Ports.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "Idle.h"

namespace ps2 {
namespace {

// Ports 1 to 3 are on port D, port 4 on port B.
constexpr uint8_t clock_of(uint8_t port) { return port < 3 ? 1 << (2 + 2 * port) : _BV(PB0); }
constexpr uint8_t data_of(uint8_t port) { return port < 3 ? 1 << (3 + 2 * port) : _BV(PB1); }
constexpr uint8_t kClocksD = clock_of(0) | clock_of(1) | clock_of(2);
constexpr uint8_t kClocksB = clock_of(3);

Ps2Bits lines[kPorts];
uint8_t clocks_before_d;
uint8_t clocks_before_b;

// Prepared bytes: their lines are moved by the next tick that serves the mice.
volatile uint8_t prepared_clocks_d, prepared_data_d, prepared_clocks_b, prepared_data_b;
volatile uint8_t divider = 1;
volatile uint8_t ticks_left = 1;

// Open drain: low is driven, high is left to the pull-up. The pull-up is off before the line is driven, and on after it
// is let go, so that no line is ever driven high against a mouse.
void pull(uint8_t port, uint8_t line) {
  if (port < 3) {
    PORTD &= static_cast<uint8_t>(~line);
    DDRD |= line;
  } else {
    PORTB &= static_cast<uint8_t>(~line);
    DDRB |= line;
  }
}
void release(uint8_t port, uint8_t line) {
  if (port < 3) {
    DDRD &= static_cast<uint8_t>(~line);
    PORTD |= line;
  } else {
    DDRB &= static_cast<uint8_t>(~line);
    PORTB |= line;
  }
}

// All constants, so that each line is moved by instructions of one bit.
template <uint8_t port>
inline __attribute__((always_inline)) void edge(uint8_t pins, uint8_t now) {
  switch (lines[port].falling_edge(pins & data_of(port), now)) {
    case Ps2Bits::Act::kNone: break;
    case Ps2Bits::Act::kDataLow: pull(port, data_of(port)); break;
    case Ps2Bits::Act::kDataHigh: release(port, data_of(port)); break;
    case Ps2Bits::Act::kHoldClock:
      pull(port, clock_of(port));
      release(port, data_of(port));
      idle::signal_work();
      break;
  }
}

void prepare(uint8_t port, bool wanted) {
  volatile uint8_t& clocks = port < 3 ? prepared_clocks_d : prepared_clocks_b;
  volatile uint8_t& data = port < 3 ? prepared_data_d : prepared_data_b;
  if (wanted) {
    clocks |= clock_of(port);
    data |= data_of(port);
  } else {
    clocks &= static_cast<uint8_t>(~clock_of(port));
    data &= static_cast<uint8_t>(~data_of(port));
  }
}

void hold_locked(uint8_t port) {
  prepare(port, false);
  pull(port, clock_of(port));
  release(port, data_of(port));
}

}  // namespace

void begin() {
  // Timer2 gives the time between two edges: 64 us a step, read in one instruction.
  static_assert(F_CPU / 1024 * Ps2Bits::kStepUs == 1000000, "the prescaler gives the step");
  TCCR2A = 0;
  TCCR2B = _BV(CS22) | _BV(CS21) | _BV(CS20);
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    for (uint8_t port = 0; port < kPorts; port++) hold_locked(port);
    PCMSK2 = kClocksD;
    PCMSK0 = kClocksB;
    PCICR |= _BV(PCIE2) | _BV(PCIE0);
  }
}

void set_divider(uint8_t ticks) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    divider = ticks;
    ticks_left = ticks;
  }
}

void send(uint8_t port, uint8_t byte, uint8_t answers) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    hold_locked(port);
    lines[port].begin_sending(byte, answers);
    prepare(port, true);
  }
}

void listen(uint8_t port, uint8_t answers) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    lines[port].begin_listening(answers);
    release(port, clock_of(port));
  }
}

void hold(uint8_t port) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { hold_locked(port); }
}

bool waiting(uint8_t port) { return (port < 3 ? prepared_clocks_d : prepared_clocks_b) & clock_of(port); }
const Ps2Bits& bits(uint8_t port) { return lines[port]; }

// Data goes low first, which is the start bit, then the clocks go free: the mice begin to clock their byte in.
void start_prepared() {
  if (--ticks_left != 0) return;
  ticks_left = divider;
  PORTD &= static_cast<uint8_t>(~prepared_data_d);
  DDRD |= prepared_data_d;
  DDRD &= static_cast<uint8_t>(~prepared_clocks_d);
  PORTD |= prepared_clocks_d;
  prepared_clocks_d = prepared_data_d = 0;
  if (prepared_clocks_b) {
    PORTB &= static_cast<uint8_t>(~prepared_data_b);
    DDRB |= prepared_data_b;
    DDRB &= static_cast<uint8_t>(~prepared_clocks_b);
    PORTB |= prepared_clocks_b;
    prepared_clocks_b = prepared_data_b = 0;
  }
}

}  // namespace ps2

// One pass for all clocks of a port. An edge of a clock that is held low is our own.
ISR(PCINT2_vect) {
  idle::note_wake();
  const uint8_t pins = PIND;
  const uint8_t fallen = ps2::clocks_before_d & ~pins & ~DDRD;
  ps2::clocks_before_d = pins & ps2::kClocksD;
  if (!fallen) return;
  const uint8_t now = TCNT2;
  if (fallen & ps2::clock_of(0)) ps2::edge<0>(pins, now);
  if (fallen & ps2::clock_of(1)) ps2::edge<1>(pins, now);
  if (fallen & ps2::clock_of(2)) ps2::edge<2>(pins, now);
}

ISR(PCINT0_vect) {
  idle::note_wake();
  const uint8_t pins = PINB;
  const uint8_t fallen = ps2::clocks_before_b & ~pins & ~DDRB;
  ps2::clocks_before_b = pins & ps2::kClocksB;
  if (fallen) ps2::edge<3>(pins, TCNT2);
}
