// I2C master at 100 or 400 kHz, driven by interrupts, one transaction at a time. Every transaction has a deadline.
//
// The tick's interrupt starts the bursts of the inertial sensors, the second as soon as the first has ended. The main
// loop starts all other transactions, and only those that will have ended well before the next tick.
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

// Takes effect with the next transaction. Call it with the bus quiet.
void set_clock(uint16_t khz);

// Bursts of each tick from now on, read one after the other; count 0: none.
constexpr uint8_t kBursts = 2;
void set_burst(uint8_t number, uint8_t address, uint8_t first_register, uint8_t count);
bool bursts_done();                        // of the present tick
State burst_state(uint8_t number);
const uint8_t* burst_data(uint8_t number);  // valid until the next tick

// False when there is no time left before the next tick, or the bus is taken or down.
bool begin_request(const I2cRequest& request);
// kDone and kFailed are reported once.
State take_request_state();
const uint8_t* request_data();

// A transaction was overdue: something holds the bus. free_bus() tries to free it and returns whether it succeeded.
bool down();
bool free_bus();

uint32_t errors();
uint16_t recoveries();

// For the interrupts of Timer1.
void start_bursts();
void expire();

}  // namespace twi
