// The lines of the mouse ports: clock and data on D2/D3, D4/D5, D6/D7, D8/D9.
//
// The main loop prepares a transaction and arms it; the next tick starts all armed transactions at once. Before and after
// a transaction the clock is held low, for at least the 100 us after which a mouse notices that it must wait or repeat.
#pragma once
#include <Ps2Bits.h>
#include <stdint.h>

namespace ps2 {

constexpr uint8_t kPorts = 4;

void begin();

// Prepares a transaction.
void send(uint8_t port, uint8_t byte, uint8_t answers, bool acknowledged);
void receive(uint8_t port, uint8_t answers);
// Abandons a transaction and holds the clock.
void hold(uint8_t port);

// The next tick starts the prepared transaction of this port.
void arm(uint8_t port);
// The next tick starts a round: the prepared transactions of all ports whose bit is 1. That tick publishes the movement
// if `complete` (all running mice answered in the last round) and the last round started exactly `period` ticks earlier.
void arm_round(uint8_t ports, bool complete, uint8_t period);

// Armed and not started.
bool waiting(uint8_t port);
bool round_waiting();
// Whether the tick that started the present round published the movement.
bool published();
// Ticks since the start of the present round.
uint8_t ticks_in_round();
const Ps2Bits& bits(uint8_t port);

// For the interrupt of Timer1, once a tick. Returns whether this tick publishes the movement.
bool start_armed();

}  // namespace ps2
