// I2C master at 400 kHz, run by interrupts, one transaction at a time. Every transaction has a deadline.
//
// Two things start one: the tick, whose interrupt starts the IMU's burst; and the main loop, for all others, which are
// begun only when they will have ended well before the next tick.
#pragma once
#include <I2cRequest.h>
#include <stdint.h>

namespace twi {

enum class State : uint8_t {
  kIdle,
  kBusy,
  kDone,
  kFailed,  // not acknowledged, a bus error, or overdue
};

void begin();

// The burst of each tick from now on; count 0: none.
void set_burst(uint8_t address, uint8_t first_register, uint8_t count);
State burst_state();           // of the present tick
const uint8_t* burst_data();   // valid until the next tick

// False when there is no time left before the next tick, or the bus is taken or down.
bool begin_request(const I2cRequest& request);
// kDone and kFailed are reported once.
State take_request_state();
const uint8_t* request_data();

// A transaction was overdue: something holds the bus. free_bus() tries to get it back, and says whether it did.
bool down();
bool free_bus();

uint32_t errors();
uint16_t recoveries();

// For the interrupts of Timer1.
void start_burst();
void expire();

}  // namespace twi
