"use strict";
// The host's side of a PS/2 port, bit by bit through the port's own registers: what a program would do, for tests of the
// mouse. The lines are pulled low by making them outputs of 0.

const { CLOCK_HZ } = require("./cpu");

const CYCLES_A_US = CLOCK_HZ / 1e6;
const REQUEST_US = 110; // the clock is held low for at least 100 us before a byte goes to the mouse
const BIT_TIMEOUT_US = 2000;

class Ps2Host {
  /** @param {import("./gpio").Port} port
   *  @param {number} clock mask
   *  @param {number} data mask */
  constructor(cpu, port, clock, data) {
    this.cpu = cpu;
    this.port = port;
    this.clock = clock;
    this.data = data;
    this.received = []; // { byte, sound, cycle }
    this.lastEdge = 0;
    this.#idle();
    port.listeners.push((level, changed, cycle) => {
      if (changed & clock && !(level & clock) && !this.holdsClock) this.#fallingEdge(level, cycle);
    });
  }

  take() {
    const { received } = this;
    this.received = [];
    return received;
  }

  /** Holds the clock low for a while. */
  inhibit(us) {
    this.#drive(this.clock, true);
    this.#idle();
    this.cpu.after(us * CYCLES_A_US, () => this.#drive(this.clock, false));
  }

  send(byte) {
    this.#drive(this.clock, true);
    this.cpu.after(REQUEST_US * CYCLES_A_US, () => {
      this.#drive(this.data, true); // the start bit
      let parity = 1;
      for (let i = 0; i < 8; i += 1) parity ^= (byte >> i) & 1;
      this.toSend = byte | (parity << 8) | (1 << 9);
      this.bit = 0;
      this.#drive(this.clock, false);
    });
  }

  get holdsClock() {
    return (this.cpu.data[this.port.registers.pin + 1] & this.clock) !== 0;
  }

  #drive(pin, low) {
    const direction = this.port.registers.pin + 1;
    const value = this.cpu.data[direction];
    this.cpu.writeData(direction, low ? value | pin : value & ~pin);
  }

  #idle() {
    this.toSend = null;
    this.bit = 0;
    this.shift = 0;
  }

  #fallingEdge(level, cycle) {
    if (this.toSend === null && cycle - this.lastEdge > BIT_TIMEOUT_US * CYCLES_A_US) this.#idle();
    this.lastEdge = cycle;
    if (this.toSend === null) this.#takeBit(level & this.data ? 1 : 0, cycle);
    else if (this.bit < 10) this.#drive(this.data, ((this.toSend >> this.bit++) & 1) === 0);
    else this.#idle(); // the mouse's acknowledge
  }

  #takeBit(bit, cycle) {
    this.shift |= bit << this.bit;
    this.bit += 1;
    if (this.bit < 11) return;
    const byte = (this.shift >> 1) & 0xff;
    let parity = 1;
    for (let i = 1; i < 9; i += 1) parity ^= (this.shift >> i) & 1;
    const sound = (this.shift & 1) === 0 && parity === ((this.shift >> 9) & 1) && this.shift >> 10 === 1;
    this.received.push({ byte, sound, cycle });
    this.#idle();
  }
}

module.exports = { Ps2Host };
