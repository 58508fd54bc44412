#include "Twi.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>
#include <util/delay.h>
#include <util/twi.h>

#include "Clock.h"
#include "Idle.h"

namespace twi {
namespace {

constexpr uint8_t kSda = _BV(PC4);
constexpr uint8_t kScl = _BV(PC5);

// The longest transaction, a barometer's calibration, is 27 bytes of 9 bits, and about 3 us between two bytes: 0.7 ms at
// 400 kHz, 2.5 ms at 100 kHz. In steps of 0.5 us.
constexpr uint16_t kDeadlineSteps = 2000;
constexpr uint16_t kSlowDeadlineSteps = 6000;
constexpr uint16_t kMarginSteps = 200;

constexpr uint8_t kGo = _BV(TWINT) | _BV(TWEN) | _BV(TWIE);

volatile State burst[kBursts] = {State::kIdle, State::kIdle};
volatile State request_state = State::kIdle;
volatile bool bus_down;
uint8_t burst_bytes[kBursts][14];
uint8_t request_bytes[I2cRequest::kMaxRead];
I2cRequest burst_request[kBursts] = {{0, {0, 0}, 1, 0, false}, {0, {0, 0}, 1, 0, false}};
volatile uint8_t next_burst = kBursts;  // to be started when the present one ends
uint16_t deadline_steps = kDeadlineSteps;
uint8_t bit_rate = (F_CPU / 400000 - 16) / 2;
I2cRequest pending;

// The transaction on the bus.
volatile State* volatile state;
const I2cRequest* volatile active;
uint8_t* volatile into;
volatile uint8_t at;

volatile uint32_t error_count;
uint16_t recovery_count;

// Inline, as is all that the interrupt does: an interrupt that calls no function saves only the registers that it uses.
inline __attribute__((always_inline)) void run(const I2cRequest& request, uint8_t* bytes, volatile State* its_state) {
  active = &request;
  into = bytes;
  state = its_state;
  *its_state = State::kBusy;
  clock::arm_deadline_locked(deadline_steps);
}

// Number of the next burst to be read, kBursts when there is none.
inline __attribute__((always_inline)) uint8_t burst_from(uint8_t number) {
  while (number < kBursts && burst_request[number].read_count == 0) number++;
  return number;
}

// Starts a burst; `stop` ends the transaction before it on the bus, if there was one.
inline __attribute__((always_inline)) void run_burst(uint8_t number, uint8_t stop) {
  next_burst = burst_from(number + 1);
  TWCR = kGo | _BV(TWSTA) | stop;
  run(burst_request[number], burst_bytes[number], &burst[number]);
}

// `stop`: how it ends on the bus.
inline __attribute__((always_inline)) void end(State how, uint8_t stop) {
  *state = how;
  if (next_burst < kBursts && stop) {
    run_burst(next_burst, stop);
    return;
  }
  TWCR = _BV(TWINT) | _BV(TWEN) | stop;
  if (next_burst < kBursts) burst[next_burst] = State::kFailed;
  next_burst = kBursts;
  clock::disarm_deadline();
  idle::signal_work();
}

inline __attribute__((always_inline)) void fail(uint8_t stop) {
  if (!(active->probe && TW_STATUS == TW_MT_SLA_NACK)) error_count++;
  end(State::kFailed, stop);
}

void enable() {
  TWSR = 0;
  TWBR = bit_rate;
  TWCR = _BV(TWEN);
}

// Open drain, by hand: an output is only ever low.
void pull(uint8_t line) { DDRC |= line; }
void release(uint8_t line) { DDRC &= static_cast<uint8_t>(~line); }
bool high(uint8_t line) { return PINC & line; }

}  // namespace

void begin() {
  PORTC &= static_cast<uint8_t>(~(kSda | kScl));  // the board has its own pull-ups, to 3.3 V
  release(kSda);
  release(kScl);
  enable();
  if (!high(kSda)) bus_down = true;  // a reset in the middle of a read leaves the sensor in the middle of its answer
}

void set_clock(uint16_t khz) {
  const bool slow = khz < 400;
  bit_rate = slow ? (F_CPU / 100000 - 16) / 2 : (F_CPU / 400000 - 16) / 2;
  deadline_steps = slow ? kSlowDeadlineSteps : kDeadlineSteps;
  TWBR = bit_rate;
}

void set_burst(uint8_t number, uint8_t address, uint8_t first_register, uint8_t count) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { burst_request[number] = I2cRequest::read(address, first_register, count); }
}

bool bursts_done() {
  for (const volatile State& each : burst) {
    if (each == State::kBusy) return false;
  }
  return next_burst == kBursts;
}
State burst_state(uint8_t number) { return burst[number]; }
const uint8_t* burst_data(uint8_t number) { return burst_bytes[number]; }

bool begin_request(const I2cRequest& request) {
  if (clock::steps_left() < deadline_steps + kMarginSteps || (TWCR & _BV(TWSTO))) return false;
  pending = request;
  bool free;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    free = !bus_down && bursts_done() && request_state == State::kIdle;
    if (free) {
      TWCR = kGo | _BV(TWSTA);
      run(pending, request_bytes, &request_state);
    }
  }
  return free;
}

State take_request_state() {
  const State now = request_state;
  if (now == State::kDone || now == State::kFailed) request_state = State::kIdle;
  return now;
}

const uint8_t* request_data() { return request_bytes; }

bool down() { return bus_down; }

// A slave that waits in the middle of a byte lets SDA go after at most nine clocks; a STOP then ends its transaction.
// It takes 100 us, with interrupts on: nothing here is disturbed by a pause.
bool free_bus() {
  TWCR = 0;
  const bool stuck = !high(kSda);
  if (stuck) {
    for (uint8_t i = 0; i < 9 && !high(kSda); i++) {
      pull(kScl);
      _delay_us(5);
      release(kScl);
      _delay_us(5);
    }
    pull(kSda);
    _delay_us(5);
    release(kSda);
    _delay_us(5);
  }
  enable();
  bus_down = !high(kSda) || !high(kScl);
  if (stuck && !bus_down) recovery_count++;
  return !bus_down;
}

uint32_t errors() {
  uint32_t count;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { count = error_count; }
  return count;
}
uint16_t recoveries() { return recovery_count; }

void start_bursts() {
  const uint8_t first = burst_from(0);
  const bool free = !bus_down && request_state != State::kBusy && bursts_done();
  for (uint8_t i = 0; i < kBursts; i++) {
    if (burst[i] != State::kBusy) burst[i] = burst_request[i].read_count == 0 ? State::kIdle : State::kFailed;
  }
  if (free && first < kBursts) run_burst(first, 0);
}

void expire() {
  if (*state != State::kBusy) return;
  TWCR = 0;  // lets both lines go
  bus_down = true;
  *state = State::kFailed;
  if (next_burst < kBursts) burst[next_burst] = State::kFailed;
  next_burst = kBursts;
  error_count++;
}

}  // namespace twi

ISR(TWI_vect) {
  idle::note_wake();
  using namespace twi;
  const I2cRequest& request = *active;
  switch (TW_STATUS) {
    case TW_START:
      at = 0;
      TWDR = static_cast<uint8_t>(request.address << 1);
      TWCR = kGo;
      break;
    case TW_REP_START:
      at = 0;
      TWDR = static_cast<uint8_t>(request.address << 1 | 1);
      TWCR = kGo;
      break;
    case TW_MT_SLA_ACK:
    case TW_MT_DATA_ACK:
      if (at < request.write_count) {
        TWDR = request.write[at];
        at = at + 1;
        TWCR = kGo;
      } else if (request.read_count > 0) {
        TWCR = kGo | _BV(TWSTA);
      } else {
        end(State::kDone, _BV(TWSTO));
      }
      break;
    case TW_MR_DATA_ACK:
      into[at] = TWDR;
      at = at + 1;
      // fall through
    case TW_MR_SLA_ACK:  // all but the last byte are acknowledged
      TWCR = at + 1 < request.read_count ? kGo | _BV(TWEA) : kGo;
      break;
    case TW_MR_DATA_NACK:
      into[at] = TWDR;
      end(State::kDone, _BV(TWSTO));
      break;
    case TW_MT_ARB_LOST:
      fail(0);
      break;
    default:  // not acknowledged, or a bus error: both ask for a STOP
      fail(_BV(TWSTO));
      break;
  }
}
