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

// Armed transactions: the next tick moves their lines.
volatile uint8_t armed_d, armed_b;            // clocks to release
volatile uint8_t start_bits_d, start_bits_b;  // data to pull low before that
volatile bool round_armed;
volatile bool round_is_complete;  // the round before the armed one
volatile bool round_published;
volatile uint8_t round_ticks;  // since the start of the last round
volatile uint8_t round_period = 1;

// Open drain: a low level is driven, a high level comes from the pull-ups. The inner pull-up is switched off before the
// line is driven and on after it is released, so that no line is ever driven high against a mouse.
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
      idle::signal_mice_work();
      break;
  }
}

volatile uint8_t& armed(uint8_t port) { return port < 3 ? armed_d : armed_b; }
volatile uint8_t& start_bits(uint8_t port) { return port < 3 ? start_bits_d : start_bits_b; }

void hold_locked(uint8_t port) {
  armed(port) &= static_cast<uint8_t>(~clock_of(port));
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

void send(uint8_t port, uint8_t byte, uint8_t answers, bool acknowledged) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    hold_locked(port);
    lines[port].begin_sending(byte, answers, acknowledged);
  }
}

void receive(uint8_t port, uint8_t answers) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    hold_locked(port);
    lines[port].begin_receiving(answers);
  }
}

void hold(uint8_t port) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { hold_locked(port); }
}

namespace {

void arm_locked(uint8_t port) {
  armed(port) |= clock_of(port);
  if (lines[port].sending()) start_bits(port) |= data_of(port);
}

}  // namespace

void arm(uint8_t port) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { arm_locked(port); }
}

void arm_round(uint8_t ports, bool complete, uint8_t period) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    for (uint8_t port = 0; port < kPorts; port++, ports >>= 1) {
      if (ports & 1) arm_locked(port);
    }
    round_is_complete = complete;
    round_period = period;
    round_armed = true;
  }
}

bool waiting(uint8_t port) { return armed(port) & clock_of(port); }
bool round_waiting() { return round_armed; }
bool published() { return round_published; }
uint8_t ticks_in_round() { return round_ticks; }
const Ps2Bits& bits(uint8_t port) { return lines[port]; }

// Data goes low first, which is the start bit; then the clocks are released, and the mice clock their byte in.
bool start_armed() {
  const uint8_t ticks = round_ticks + 1;
  bool publishes = false;
  round_ticks = ticks;
  if (round_armed) {
    publishes = round_is_complete && ticks == round_period;
    round_published = publishes;
    round_armed = false;
    round_ticks = 0;
  }
  PORTD &= static_cast<uint8_t>(~start_bits_d);
  DDRD |= start_bits_d;
  DDRD &= static_cast<uint8_t>(~armed_d);
  PORTD |= armed_d;
  armed_d = start_bits_d = 0;
  if (!armed_b) return publishes;
  PORTB &= static_cast<uint8_t>(~start_bits_b);
  DDRB |= start_bits_b;
  DDRB &= static_cast<uint8_t>(~armed_b);
  PORTB |= armed_b;
  armed_b = start_bits_b = 0;
  return publishes;
}

}  // namespace ps2

// Each edge of each clock causes an interrupt, tens of thousands a second. Half of them are rising edges, which need no
// action: the interrupt itself only determines which clocks fell, with fewer registers than the compiler would use, and
// jumps to the compiled handler if there are any. The handler ignores edges of a clock that the host holds low.
//
// It passes the pins in GPIOR1 and the clocks that fell in GPIOR2. Its beginning is idle::note_wake().
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
