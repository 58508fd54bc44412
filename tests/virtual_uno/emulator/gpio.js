"use strict";
// A digital port: three registers, wired-AND with what hangs on the pins, the input synchroniser, pin-change interrupts.

const PCICR = 0x68;
const PCIFR = 0x3b;
const MCUCR = 0x55;
const PULL_UP_DISABLE = 0x10;
const SYNCHRONISER_CYCLES = 1; // datasheet 14.2.4: a level is read one clock after it appears
const PIN_CHANGE_CYCLES = 3; // datasheet 13.1: from the edge to PCIF

const PORTS = {
  B: { pin: 0x23, mask: 0x6b, index: 0, vector: 0x06, kind: "pin_b" },
  C: { pin: 0x26, mask: 0x6c, index: 1, vector: 0x08, kind: "pin_c" },
  D: { pin: 0x29, mask: 0x6d, index: 2, vector: 0x0a, kind: "pin_d" },
};

class Port {
  /** @param {import("./cpu").Cpu} cpu
   *  @param {"B"|"C"|"D"} name */
  constructor(cpu, name) {
    this.cpu = cpu;
    this.registers = PORTS[name];
    this.pulledUp = 0; // pins with a pull-up resistor outside
    this.heldLow = 0; // pins that something outside holds low
    this.level = 0;
    this.levelBefore = 0;
    this.changedAt = 0;
    this.contentions = 0; // times a pin was driven high while something outside held it low
    this.listeners = [];
    const { pin, vector, index } = this.registers;
    this.interrupt = {
      address: vector,
      flagRegister: PCIFR,
      flagMask: 1 << index,
      enableRegister: PCICR,
      enableMask: 1 << index,
    };
    cpu.readHooks[pin] = () => this.#read();
    cpu.writeHooks[pin] = (value, _old, _address, mask) => this.#write(pin + 2, cpu.data[pin + 2] ^ (value & mask));
    cpu.writeHooks[pin + 1] = (value) => this.#write(pin + 1, value);
    cpu.writeHooks[pin + 2] = (value) => this.#write(pin + 2, value);
    cpu.attach(this);
  }

  reset() {
    this.#settle(this.cpu.now);
  }

  /** Something outside holds these pins low (or lets go of them). */
  hold(pins, low) {
    this.heldLow = low ? this.heldLow | pins : this.heldLow & ~pins;
    this.#settle(this.cpu.now);
  }

  /** A pull-up resistor outside. */
  pullUp(pins, present = true) {
    this.pulledUp = present ? this.pulledUp | pins : this.pulledUp & ~pins;
    this.#settle(this.cpu.now);
  }

  #write(register, value) {
    const { cpu } = this;
    cpu.data[register] = value;
    const out = (cpu.progMem[cpu.pc] & 0xf800) === 0xb800; // OUT takes one cycle, SBI, CBI, STS and ST two
    this.#settle(cpu.cycles + (out ? 1 : 2));
    return true;
  }

  #read() {
    return this.cpu.cycles >= this.changedAt + SYNCHRONISER_CYCLES ? this.level : this.levelBefore;
  }

  #settle(cycle) {
    const { cpu, registers } = this;
    const direction = cpu.data[registers.pin + 1];
    const output = cpu.data[registers.pin + 2];
    const inner = cpu.data[MCUCR] & PULL_UP_DISABLE ? 0 : output;
    if (direction & output & this.heldLow) this.contentions += 1;
    const level = ((direction & output) | (~direction & (this.pulledUp | inner))) & ~this.heldLow & 0xff;
    const changed = level ^ this.level;
    if (!changed) return;
    this.levelBefore = this.level;
    this.level = level;
    this.changedAt = cycle;
    if (changed & cpu.data[registers.mask]) cpu.at(cycle + PIN_CHANGE_CYCLES, () => cpu.setInterruptFlag(this.interrupt));
    cpu.log.add(registers.kind, cycle, level);
    for (const listener of this.listeners) listener(level, changed, cycle);
  }
}

/** The three ports, with the pin-change registers that they share. */
function makePorts(cpu) {
  const ports = { B: new Port(cpu, "B"), C: new Port(cpu, "C"), D: new Port(cpu, "D") };
  const interrupts = Object.values(ports).map((port) => port.interrupt);
  cpu.writeHooks[PCIFR] = (value, _old, _address, mask) => {
    for (const interrupt of interrupts) if (value & mask & interrupt.flagMask) cpu.clearInterrupt(interrupt);
    return true;
  };
  cpu.writeHooks[PCICR] = (value) => {
    cpu.data[PCICR] = value;
    for (const interrupt of interrupts) cpu.updateInterruptEnable(interrupt, value);
    return true;
  };
  return ports;
}

module.exports = { makePorts };
