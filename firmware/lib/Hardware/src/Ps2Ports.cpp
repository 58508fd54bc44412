#include "Ps2Ports.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "Idle.h"

namespace ps2 {
namespace {

// Ports 1 to 3 are on port D, port 4 on port B.
constexpr uint8_t kClocks[kPorts] = {_BV(PD2), _BV(PD4), _BV(PD6), _BV(PB0)};
constexpr uint8_t clock_of(uint8_t port) { return kClocks[port]; }
// The data line is the next pin of each clock.
constexpr uint8_t data_of(uint8_t port) { return kClocks[port] << 1; }
constexpr uint8_t kClocksD = clock_of(0) | clock_of(1) | clock_of(2);
constexpr uint8_t kClocksB = clock_of(3);

Ps2Bits lines[kPorts];
volatile uint8_t levels_before_d;
volatile uint8_t levels_before_b;

// Prepared transactions: their lines are moved by the next tick that serves the mice.
volatile uint8_t prepared_d, prepared_b;  // clocks to let go
volatile uint8_t start_bits_d, start_bits_b;  // data to pull low before that
volatile uint8_t divider = 1;
volatile uint8_t ticks_left = 1;

// Open drain: low is driven, high is left to the pull-up. The pull-up is off before the line is driven, and on after it
// is let go, so that no line is ever driven high against a mouse.
inline __attribute__((always_inline)) void pull(uint8_t port, uint8_t line) {
  if (port < 3) {
    PORTD &= static_cast<uint8_t>(~line);
    DDRD |= line;
  } else {
    PORTB &= static_cast<uint8_t>(~line);
    DDRB |= line;
  }
}
inline __attribute__((always_inline)) void release(uint8_t port, uint8_t line) {
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

volatile uint8_t& prepared(uint8_t port) { return port < 3 ? prepared_d : prepared_b; }
volatile uint8_t& start_bits(uint8_t port) { return port < 3 ? start_bits_d : start_bits_b; }

void hold_locked(uint8_t port) {
  prepared(port) &= static_cast<uint8_t>(~clock_of(port));
  start_bits(port) &= static_cast<uint8_t>(~data_of(port));
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
    prepared(port) |= clock_of(port);
    start_bits(port) |= data_of(port);
  }
}

void listen(uint8_t port, uint8_t answers) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    hold_locked(port);
    lines[port].begin_listening(answers);
    prepared(port) |= clock_of(port);
  }
}

void hold(uint8_t port) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { hold_locked(port); }
}

bool waiting(uint8_t port) { return prepared(port) & clock_of(port); }
const Ps2Bits& bits(uint8_t port) { return lines[port]; }

// Data goes low first, which is the start bit, then the clocks go free: the mice begin to clock their byte in.
bool start_prepared() {
  if (--ticks_left != 0) return false;
  ticks_left = divider;
  PORTD &= static_cast<uint8_t>(~start_bits_d);
  DDRD |= start_bits_d;
  DDRD &= static_cast<uint8_t>(~prepared_d);
  PORTD |= prepared_d;
  prepared_d = start_bits_d = 0;
  if (!prepared_b) return true;
  PORTB &= static_cast<uint8_t>(~start_bits_b);
  DDRB |= start_bits_b;
  DDRB &= static_cast<uint8_t>(~prepared_b);
  PORTB |= prepared_b;
  prepared_b = start_bits_b = 0;
  return true;
}

}  // namespace ps2

// Each edge of each clock brings an interrupt, thousands a second. Half of them are rising edges, of which nothing is to
// be done: so the interrupt itself only looks which clocks fell, in registers the compiler would not get along with, and
// jumps to the compiled handler when there are any. An edge of a clock that is held low is our own.
//
// What it hands on: the pins in GPIOR1, the clocks that fell in GPIOR2. The beginning is idle::note_wake().
#define PIN_CHANGE_INTERRUPT(vector, pin_register, direction_register, clocks, before, handler)       \
  extern "C" void handler() __attribute__((signal, used));                                          \
  ISR(vector, ISR_NAKED) {                                                                          \
    asm volatile(                                                                                   \
        "push r24                \n\t"                                                              \
        "in   r24, __SREG__      \n\t"                                                              \
        "push r24                \n\t"                                                              \
        "push r25                \n\t"                                                              \
        "ldi  r24, %[awake]      \n\t"                                                              \
        "out  %[meter], r24      \n\t"                                                              \
        "in   r24, %[pins]       \n\t"                                                              \
        "out  %[now], r24        \n\t"                                                              \
        "lds  r25, %[last]       \n\t"                                                              \
        "sts  %[last], r24       \n\t"                                                              \
        "com  r24                \n\t"                                                              \
        "and  r25, r24           \n\t"                                                              \
        "in   r24, %[driven]     \n\t"                                                              \
        "com  r24                \n\t"                                                              \
        "and  r25, r24           \n\t"                                                              \
        "andi r25, %[mask]       \n\t"                                                              \
        "out  %[fallen], r25     \n\t"                                                              \
        "pop  r25                \n\t" /* POP and OUT leave the flags of ANDI as they are */        \
        "pop  r24                \n\t"                                                              \
        "brne 2f                 \n\t"                                                              \
        "out  __SREG__, r24      \n\t"                                                              \
        "pop  r24                \n\t"                                                              \
        "reti                    \n"                                                                \
        "2: out __SREG__, r24    \n\t"                                                              \
        "pop  r24                \n\t"                                                              \
        "jmp  " #handler "       \n\t" ::[meter] "I"(_SFR_IO_ADDR(TCCR0B)),                         \
        [awake] "M"(idle::kCountAwake),                                                             \
        [pins] "I"(_SFR_IO_ADDR(pin_register)), [driven] "I"(_SFR_IO_ADDR(direction_register)),     \
        [now] "I"(_SFR_IO_ADDR(GPIOR1)), [fallen] "I"(_SFR_IO_ADDR(GPIOR2)), [last] "i"(&before),   \
        [mask] "M"(clocks));                                                                        \
  }                                                                                                 \
  void handler()

PIN_CHANGE_INTERRUPT(PCINT2_vect, PIND, DDRD, ps2::kClocksD, ps2::levels_before_d, __vector_of_port_d) {
  const uint8_t pins = GPIOR1, fallen = GPIOR2, now = TCNT2;
  if (fallen & ps2::clock_of(0)) ps2::edge<0>(pins, now);
  if (fallen & ps2::clock_of(1)) ps2::edge<1>(pins, now);
  if (fallen & ps2::clock_of(2)) ps2::edge<2>(pins, now);
}

PIN_CHANGE_INTERRUPT(PCINT0_vect, PINB, DDRB, ps2::kClocksB, ps2::levels_before_b, __vector_of_port_b) {
  ps2::edge<3>(GPIOR1, TCNT2);
}
