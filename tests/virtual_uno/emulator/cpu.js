"use strict";
// The ATmega328P's core: avr8js decodes the instructions; events in time, interrupt entry, sleep and reset are here.

const { CPU, avrInstruction } = require("avr8js");

const CLOCK_HZ = 16_000_000;
const SRAM_BYTES = 2048;
const FIRST_IO = 0x20;
const FIRST_SRAM = 0x100;
const SREG = 0x5f;
const SMCR = 0x53;
const MCUSR = 0x54;
const GLOBAL_INTERRUPT_ENABLE = 0x80;
const SLEEP_ENABLE = 0x01;
const OPCODE_SLEEP = 0x9588;
const OPCODE_SPM = 0x95e8;
const INTERRUPT_CYCLES = 4; // datasheet 7.7.1: until the vector's first instruction
const WAKE_CYCLES = 4; // datasheet 7.7.1: in addition, out of sleep

const RESET_CAUSE = { powerOn: 0x01, external: 0x02, brownOut: 0x04, watchdog: 0x08 };

class Cpu extends CPU {
  /** @param {Uint16Array} program flash, one word an element
   *  @param {import("./log").Log} log */
  constructor(program, log) {
    super(program, SRAM_BYTES);
    this.log = log;
    this.readHooks = new Array(this.data.length).fill(undefined); // dense: data accesses look here first
    this.writeHooks = new Array(this.data.length).fill(undefined);
    this.peripherals = [];
    this.writeHooks[MCUSR] = (value) => { // its flags can only be cleared
      this.data[MCUSR] &= value;
      return true;
    };
    this.nextEvent = null;
    this.nextEventCycle = Infinity;
    this.eventCycle = -1; // cycle of the event that is running, -1 outside of events
    this.asleep = false;
    this.haltedUntil = 0;
    this.sleepCycles = 0;
    this.resetVector = 0; // a word address, as the fuse BOOTRST chooses it
    this.selfProgramming = null; // what carries SPM out
  }

  /** The present, exact inside an event too (instructions run on over an event's cycle). */
  get now() {
    return this.eventCycle >= 0 ? this.eventCycle : this.cycles;
  }

  /** Calls `action` at a cycle; events of one cycle run in the order in which they were asked for. */
  at(cycle, action) {
    const event = { cycle: Math.max(cycle, this.now + 1), action, next: null };
    if (this.nextEvent === null || event.cycle < this.nextEvent.cycle) {
      event.next = this.nextEvent;
      this.#setNextEvent(event);
      return event;
    }
    let before = this.nextEvent;
    while (before.next !== null && before.next.cycle <= event.cycle) before = before.next;
    event.next = before.next;
    before.next = event;
    return event;
  }

  after(cycles, action) {
    return this.at(this.now + cycles, action);
  }

  /** Takes an event out that has not run yet; null and one that has run are no matter. */
  cancel(event) {
    let before = null;
    let each = this.nextEvent;
    while (each !== event && each !== null) {
      before = each;
      each = each.next;
    }
    if (each === null) return;
    if (before !== null) before.next = each.next;
    else this.#setNextEvent(each.next);
  }

  #setNextEvent(event) {
    this.nextEvent = event;
    this.nextEventCycle = event === null ? Infinity : event.cycle;
  }

  /** Adds a peripheral; its reset() puts its registers to their values after a reset. */
  attach(peripheral) {
    this.peripherals.push(peripheral);
    peripheral.reset();
  }

  /** A reset: I/O registers take their initial values, r0 to r31 and SRAM keep theirs, the core waits the start-up time.
   *  @param {boolean} causeKept whether MCUSR still holds it when the program starts */
  restart(cause, startUpCycles, causeKept) {
    const flags = this.data[MCUSR];
    this.data.fill(0, FIRST_IO, FIRST_SRAM);
    if (causeKept) this.data[MCUSR] = cause === RESET_CAUSE.powerOn ? cause : flags | cause;
    this.pendingInterrupts.fill(null);
    this.nextInterrupt = -1;
    this.pc = this.resetVector;
    this.SP = FIRST_SRAM + SRAM_BYTES - 1;
    this.asleep = false;
    this.haltedUntil = this.now + startUpCycles;
    for (const peripheral of this.peripherals) peripheral.reset();
    this.log.add("reset", this.now, cause);
  }

  /** Runs up to a cycle (the last instruction may go a few cycles beyond). */
  run(until) {
    const { data, progMem } = this;
    while (this.cycles < until) {
      if (this.asleep || this.cycles < this.haltedUntil) {
        this.#idle(until);
        continue;
      }
      // The instruction after the one that sets I runs before any interrupt (datasheet 7.3.1): `sei; sleep` has no gap.
      const enabledBefore = data[SREG] & GLOBAL_INTERRUPT_ENABLE;
      const opcode = progMem[this.pc];
      avrInstruction(this);
      if ((opcode & 0xff00) === 0x9800) this.cycles += 1; // CBI takes 2 cycles, avr8js counts 1
      else if (opcode === OPCODE_SLEEP && data[SMCR] & SLEEP_ENABLE) this.asleep = true;
      else if (opcode === OPCODE_SPM) this.selfProgramming.execute();
      if (this.nextEventCycle <= this.cycles) this.#runEvents();
      const wanted = this.nextInterrupt >= 0 && !this.asleep;
      if (wanted && enabledBefore && data[SREG] & GLOBAL_INTERRUPT_ENABLE) this.#enterInterrupt();
    }
  }

  #runEvents() {
    while (this.nextEventCycle <= this.cycles) {
      const event = this.nextEvent;
      this.#setNextEvent(event.next);
      this.eventCycle = event.cycle;
      event.action();
      this.eventCycle = -1;
    }
  }

  #idle(until) {
    const halted = this.cycles < this.haltedUntil;
    if (!halted && this.nextInterrupt >= 0 && this.data[SREG] & GLOBAL_INTERRUPT_ENABLE) {
      this.asleep = false;
      this.cycles += WAKE_CYCLES;
      this.#enterInterrupt();
      return;
    }
    const end = halted ? Math.min(until, this.haltedUntil) : until;
    const next = Math.max(this.cycles, Math.min(end, this.nextEventCycle));
    if (!halted) this.sleepCycles += next - this.cycles;
    this.cycles = next;
    if (this.nextEventCycle <= next) this.#runEvents();
  }

  #enterInterrupt() {
    const interrupt = this.pendingInterrupts[this.nextInterrupt];
    const { data } = this;
    const sp = this.SP;
    data[sp] = this.pc & 0xff;
    data[sp - 1] = this.pc >> 8;
    this.SP = sp - 2;
    data[SREG] &= ~GLOBAL_INTERRUPT_ENABLE;
    this.pc = interrupt.address;
    this.log.add("interrupt", this.cycles, interrupt.address / 2);
    this.cycles += INTERRUPT_CYCLES;
    if (!interrupt.constant) this.clearInterrupt(interrupt);
  }
}

module.exports = { Cpu, CLOCK_HZ, MCUSR, RESET_CAUSE };
