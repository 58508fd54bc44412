"use strict";
// The wire between board and host: each side has its own bit time, and a receiver samples at its own.

const TOLERANCE = 0.025; // both sides read each other up to here (datasheet table 20-2 allows about 2 % in normal mode)
const FRAME_BITS = 10; // start, eight data bits, stop

/** Samples one direction of the line as a UART of another bit time does: garbage and framing errors come out. */
class MismatchedReceiver {
  constructor() {
    this.edges = []; // [cycle, level] of the last bytes, in order
    this.busyUntil = 0;
  }

  /** Adds a byte's waveform and gives the bytes that were complete before the line's last known level ended. */
  push(byte, start, senderBit, receiverBit) {
    const frame = (byte << 1) | 0x200;
    let level = this.edges.length > 0 ? this.edges[this.edges.length - 1][1] : 1;
    for (let i = 0; i < FRAME_BITS; i += 1) {
      const bit = (frame >> i) & 1;
      if (bit !== level) this.edges.push([start + i * senderBit, bit]);
      level = bit;
    }
    return this.#receive(start + FRAME_BITS * senderBit, receiverBit);
  }

  #level(cycle) {
    let level = 1;
    for (const [at, value] of this.edges) {
      if (at > cycle) break;
      level = value;
    }
    return level;
  }

  #receive(known, bit) {
    const bytes = [];
    for (;;) {
      const start = this.edges.find(([at, level]) => level === 0 && at >= this.busyUntil);
      if (start === undefined || start[0] + 9.5 * bit > known) break;
      let byte = 0;
      for (let i = 0; i < 8; i += 1) byte |= this.#level(start[0] + (i + 1.5) * bit) << i;
      this.busyUntil = start[0] + 9.5 * bit;
      bytes.push({ byte, frameError: this.#level(this.busyUntil) === 0 });
    }
    const keep = known - 2 * FRAME_BITS * bit;
    while (this.edges.length > 1 && this.edges[1][0] < keep) this.edges.shift();
    return bytes;
  }
}

class SerialLine {
  /** @param {import("./cpu").Cpu} cpu
   *  @param {() => number} random */
  constructor(cpu, random) {
    this.cpu = cpu;
    this.random = random;
    this.usart = null; // the board's end, set by the board
    this.hostBitCycles = null; // null: the host follows the board's bit time
    this.toHost = [];
    this.toBoard = [];
    this.sending = false;
    this.faults = { toHost: noFaults(), toBoard: noFaults() };
    this.receivers = { toHost: new MismatchedReceiver(), toBoard: new MismatchedReceiver() };
  }

  #matches(bit, other) {
    return Math.abs(bit / other - 1) <= TOLERANCE;
  }

  /** A byte that the board has sent. */
  fromBoard(byte, start, boardBit) {
    const hostBit = this.hostBitCycles ?? boardBit;
    const bytes = this.#matches(boardBit, hostBit)
      ? [{ byte }]
      : this.receivers.toHost.push(byte, start, boardBit, hostBit);
    for (const got of bytes) this.toHost.push(...this.#disturb([got.byte], this.faults.toHost));
  }

  /** Bytes that the host sends, one behind the other. */
  fromHost(bytes) {
    this.toBoard.push(...this.#disturb(bytes, this.faults.toBoard));
    if (!this.sending) this.#next();
  }

  #next() {
    if (this.toBoard.length === 0) {
      this.sending = false;
      return;
    }
    this.sending = true;
    const { cpu, usart } = this;
    const byte = this.toBoard.shift();
    const boardBit = usart.bitCycles;
    const hostBit = this.hostBitCycles ?? boardBit;
    const start = cpu.now;
    usart.startBit();
    cpu.after(FRAME_BITS * hostBit, () => {
      const got = this.#matches(boardBit, hostBit)
        ? [{ byte, frameError: false }]
        : this.receivers.toBoard.push(byte, start, hostBit, boardBit);
      for (const each of got) usart.receive(each.byte, each.frameError);
      this.#next();
    });
  }

  #disturb(bytes, { flip, drop, insert }) {
    if (flip === 0 && drop === 0 && insert === 0) return bytes;
    const out = [];
    for (const byte of bytes) {
      if (this.random() < insert) out.push(Math.floor(this.random() * 256));
      if (this.random() < drop) continue;
      out.push(this.random() < flip ? byte ^ (1 << Math.floor(this.random() * 8)) : byte);
    }
    return out;
  }

  takeToHost() {
    const bytes = this.toHost;
    this.toHost = [];
    return Buffer.from(bytes);
  }
}

/** Probabilities a byte. */
function noFaults() {
  return { flip: 0, drop: 0, insert: 0 };
}

module.exports = { SerialLine };
