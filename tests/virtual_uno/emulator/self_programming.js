"use strict";
// Self-programming (datasheet 26): what SPM does with the page buffer and the flash, as a bootloader uses it. Not here:
// the lock bits, and what reading a section gives while a page of it is being written.

const { CLOCK_HZ } = require("./cpu");

const SPMCSR = 0x57;
const SPMEN = 0x01;
const PGERS = 0x02;
const PGWRT = 0x04;
const RWWSRE = 0x10;
const COMMAND = 0x1f;
const R0 = 0;
const R1 = 1;
const Z = 30;
const PAGE_WORDS = 64;
const PAGE_S = 0.004; // datasheet table 26-6: 3.7 to 4.5 ms

class SelfProgramming {
  constructor(cpu) {
    this.cpu = cpu;
    this.buffer = new Uint16Array(PAGE_WORDS).fill(0xffff);
    this.pagesWritten = 0;
    this.stuck = new Map(); // word address -> bits that cannot be programmed to 1
    cpu.selfProgramming = this;
  }

  /** The instruction SPM: SPMCSR selects the operation, Z the address. */
  execute() {
    const { data } = this.cpu;
    const word = (data[Z] | (data[Z + 1] << 8)) >> 1;
    switch (data[SPMCSR] & COMMAND) {
      case SPMEN:
        this.buffer[word % PAGE_WORDS] &= data[R0] | (data[R1] << 8);
        return this.#done();
      case SPMEN | PGERS:
        this.#page(word).fill(0xffff);
        return this.#doneAfter(PAGE_S);
      case SPMEN | PGWRT:
        this.#write(word);
        return this.#doneAfter(PAGE_S);
      case SPMEN | RWWSRE:
        this.buffer.fill(0xffff);
        return this.#done();
      default:
        return undefined;
    }
  }

  #page(word) {
    const first = word - (word % PAGE_WORDS);
    return this.cpu.progMem.subarray(first, first + PAGE_WORDS);
  }

  #write(word) {
    const page = this.#page(word);
    this.buffer.forEach((value, at) => (page[at] &= value));
    for (const [at, bits] of this.stuck) this.cpu.progMem[at] &= ~bits;
    this.buffer.fill(0xffff);
    this.pagesWritten += 1;
  }

  #done() {
    this.cpu.data[SPMCSR] &= ~COMMAND;
  }

  #doneAfter(seconds) {
    this.cpu.after(seconds * CLOCK_HZ, () => this.#done());
  }
}

module.exports = { SelfProgramming };
