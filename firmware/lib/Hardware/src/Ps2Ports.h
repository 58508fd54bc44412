// The lines of the mouse ports: clock and data on D2/D3, D4/D5, D6/D7, D8/D9.
//
// A transaction is prepared by the main loop and begun by the tick, for all mice at once. Until then, and from the end of
// one on, the clock is held low: long enough (100 us) for a mouse to notice that it must wait or repeat.
#pragma once
#include <Ps2Bits.h>
#include <stdint.h>

namespace ps2 {

constexpr uint8_t kPorts = 4;

void begin();
// Mice are served at every n-th tick.
void set_divider(uint8_t ticks);

// Prepares a transaction.
void send(uint8_t port, uint8_t byte, uint8_t answers);
void listen(uint8_t port, uint8_t answers);
// Gives the transaction up, and holds the clock.
void hold(uint8_t port);

// It waits for its tick.
bool waiting(uint8_t port);
const Ps2Bits& bits(uint8_t port);

// For the interrupt of Timer1. Whether this is a tick that serves the mice.
bool start_prepared();

}  // namespace ps2
