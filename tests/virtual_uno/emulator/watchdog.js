"use strict";
// The watchdog timer (datasheet 11.8): timed change sequence, interrupt, reset, and WDRF that keeps it on.

const { CLOCK_HZ, MCUSR, RESET_CAUSE } = require("./cpu");

const WDTCSR = 0x60;
const WDIF = 0x80;
const WDIE = 0x40;
const WDCE = 0x10;
const WDE = 0x08;
const PRESCALER_BITS = 0x27;
const CHANGE_WINDOW_CYCLES = 4;
const OSCILLATOR_HZ = 128_000;

class Watchdog {
  /** @param {(cause: number) => void} resetBoard */
  constructor(cpu, resetBoard) {
    this.cpu = cpu;
    this.resetBoard = resetBoard;
    this.interrupt = { address: 0x0c, flagRegister: WDTCSR, flagMask: WDIF, enableRegister: WDTCSR, enableMask: WDIE };
    cpu.onWatchdogReset = () => { this.deadline = cpu.now + this.timeoutCycles; }; // often: the event looks for itself
    cpu.writeHooks[WDTCSR] = (value) => this.#write(value);
    cpu.attach(this);
  }

  reset() {
    this.changeUntil = 0;
    if (this.cpu.data[MCUSR] & RESET_CAUSE.watchdog) this.cpu.data[WDTCSR] = WDE; // WDRF holds WDE on
    this.#restart(this.cpu.haltedUntil);
  }

  get timeoutCycles() {
    const control = this.cpu.data[WDTCSR];
    const exponent = ((control & 0x20) >> 2) | (control & 7);
    return ((2048 << exponent) * CLOCK_HZ) / OSCILLATOR_HZ;
  }

  #write(value) {
    const { cpu } = this;
    const old = cpu.data[WDTCSR];
    const changeable = cpu.cycles <= this.changeUntil;
    if (value & WDCE && value & WDE) this.changeUntil = cpu.cycles + CHANGE_WINDOW_CYCLES;
    const guarded = changeable ? value & PRESCALER_BITS : old & PRESCALER_BITS;
    let enable = changeable ? value & WDE : (old | value) & WDE;
    if (cpu.data[MCUSR] & RESET_CAUSE.watchdog) enable = WDE;
    const flag = old & WDIF & ~value;
    cpu.data[WDTCSR] = guarded | enable | (value & WDIE) | flag;
    if (value & WDIF) cpu.clearInterrupt(this.interrupt);
    cpu.updateInterruptEnable(this.interrupt, cpu.data[WDTCSR]);
    this.#restart();
    return true;
  }

  #restart(from = this.cpu.now) {
    this.cpu.cancel(this.event ?? null);
    this.event = null;
    this.deadline = from + this.timeoutCycles;
    if (this.cpu.data[WDTCSR] & (WDE | WDIE)) this.#schedule();
  }

  #schedule() {
    this.event = this.cpu.at(this.deadline, () => (this.cpu.now < this.deadline ? this.#schedule() : this.#expire()));
  }

  #expire() {
    const { data } = this.cpu;
    if (data[WDTCSR] & WDIE) {
      this.cpu.setInterruptFlag(this.interrupt);
      if (data[WDTCSR] & WDE) data[WDTCSR] &= ~WDIE; // the next time-out resets
      this.#restart();
      return;
    }
    this.resetBoard(RESET_CAUSE.watchdog);
  }
}

module.exports = { Watchdog };
