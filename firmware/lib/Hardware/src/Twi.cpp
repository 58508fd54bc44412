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

constexpr uint32_t kBusHz = 400000;
constexpr uint8_t kSda = _BV(PC4);
constexpr uint8_t kScl = _BV(PC5);

// The longest transaction, the BMP180's calibration, is 25 bytes of 9 bits at 2.5 us, and about 3 us between two bytes.
constexpr uint16_t kDeadlineSteps = 2000;
constexpr uint16_t kMarginSteps = 200;

constexpr uint8_t kGo = _BV(TWINT) | _BV(TWEN) | _BV(TWIE);

volatile State burst = State::kIdle;
volatile State request_state = State::kIdle;
volatile bool bus_down;
uint8_t burst_bytes[14];
uint8_t request_bytes[I2cRequest::kMaxRead];
I2cRequest burst_request = {0, {0, 0}, 1, 0};
I2cRequest pending;

// The transaction on the bus.
volatile State* volatile state;
const I2cRequest* volatile active;
uint8_t* volatile into;
volatile uint8_t at;

volatile uint32_t error_count;
uint16_t recovery_count;

// `stop`: what ends it on the bus.
inline void end(State how, uint8_t stop) {
  TWCR = _BV(TWINT) | _BV(TWEN) | stop;
  *state = how;
  clock::disarm_deadline();
  idle::signal_work();
}

inline void fail(uint8_t stop) {
  error_count++;
  end(State::kFailed, stop);
}

inline void run(const I2cRequest& request, uint8_t* bytes, volatile State* its_state) {
  active = &request;
  into = bytes;
  state = its_state;
  *its_state = State::kBusy;
  clock::arm_deadline_locked(kDeadlineSteps);
}

void enable() {
  TWSR = 0;
  TWBR = (F_CPU / kBusHz - 16) / 2;
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

void set_burst(uint8_t address, uint8_t first_register, uint8_t count) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { burst_request = I2cRequest::read(address, first_register, count); }
}

State burst_state() { return burst; }
const uint8_t* burst_data() { return burst_bytes; }

bool begin_request(const I2cRequest& request) {
  if (clock::steps_left() < kDeadlineSteps + kMarginSteps || (TWCR & _BV(TWSTO))) return false;
  pending = request;
  bool free;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    free = !bus_down && burst != State::kBusy && request_state == State::kIdle;
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

void start_burst() {
  const bool free = !bus_down && request_state != State::kBusy && burst_request.read_count != 0;
  if (!free) {
    burst = burst_request.read_count == 0 ? State::kIdle : State::kFailed;
    return;
  }
  TWCR = kGo | _BV(TWSTA);
  run(burst_request, burst_bytes, &burst);
}

void expire() {
  if (*state != State::kBusy) return;
  TWCR = 0;  // lets both lines go
  bus_down = true;
  *state = State::kFailed;
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
