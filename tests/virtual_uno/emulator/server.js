"use strict";
// One JSON object a line on stdin, one answer a line on stdout; see virtual_uno.py. Numbers that come in crowds travel
// as base64 of little-endian bytes.

const fs = require("fs");
const { Board } = require("./board");
const { RESET_CAUSE } = require("./cpu");
const { KINDS } = require("./log");
const { Table } = require("./table");

let board = null;

const OPERATIONS = {
  create({ hex, options }) {
    board = new Board(fs.readFileSync(hex, "utf8"), options);
    return { kinds: KINDS };
  },
  run({ cycles, rx }) {
    if (rx) board.line.fromHost(Buffer.from(rx, "base64"));
    board.run(cycles);
    return { cycle: board.cpu.cycles, tx: board.line.takeToHost().toString("base64") };
  },
  reset() {
    board.reset(RESET_CAUSE.external);
    return {};
  },
  hang({ interrupts }) {
    return { at: board.hang(interrupts) };
  },
  supply({ volts }) {
    board.adc.supplyV = volts;
    return {};
  },
  feed({ sensor, times, values, interpolated }) {
    board[sensor].signal = new Table(floats(times), floats(values), interpolated);
    return {};
  },
  slave({ sensor, set }) {
    Object.assign(board[sensor], set);
    return {};
  },
  plug({ sensor, present }) {
    board[sensor].plug(present);
    return {};
  },
  /** A transaction that some other master makes in no time; null when the slave does not answer. */
  transact({ address, write, read }) {
    const { bus } = board;
    const written = write.length === 0 || (bus.address(address << 1) && write.every((byte) => bus.write(byte)));
    const answered = written && (read === 0 || bus.address((address << 1) | 1));
    const bytes = answered ? Array.from({ length: read }, () => bus.read()) : null;
    bus.stop();
    return { bytes };
  },
  hold_sda({ clocks }) {
    board.bus.hold(clocks ?? Infinity);
    return {};
  },
  release_sda() {
    board.bus.release();
    return {};
  },
  corrupt_i2c({ probability }) {
    board.bus.corruption = probability;
    return {};
  },
  line({ baud, to_host: toHost, to_board: toBoard }) {
    board.line.hostBitCycles = baud === null ? null : 16e6 / baud;
    board.line.faults = { toHost, toBoard };
    return {};
  },
  feed_mouse({ mouse, times, values }) {
    board.mice[mouse].follow(new Table(floats(times), floats(values), true));
    return {};
  },
  set_mouse({ mouse, set }) {
    Object.assign(board.mice[mouse], set);
    return {};
  },
  spoil_mouse({ mouse, seconds }) {
    board.mice[mouse].spoilParityEvery(seconds);
    return {};
  },
  plug_mouse({ mouse, present }) {
    board.mice[mouse].plug(present);
    return {};
  },
  mouse_state({ mouse }) {
    const { reported, discarded, counters, packets, reporting, mode, reportRateHz, resolution } = board.mice[mouse];
    return { reported, discarded, counters, packets, reporting, mode, report_rate_hz: reportRateHz, resolution };
  },
  /** A host at a mouse port in place of the program: for tests of the mouse. */
  ps2_host({ mouse, send, inhibit_us: inhibitUs }) {
    const host = board.ps2Host(mouse);
    if (inhibitUs) host.inhibit(inhibitUs);
    if (send !== null) host.send(send);
    return { received: host.take() };
  },
  log({ kinds }) {
    board.log.choose(kinds);
    return {};
  },
  events() {
    return { records: Buffer.from(board.log.take().buffer).toString("base64") };
  },
  peek({ address, length }) {
    return { bytes: Buffer.from(board.cpu.data.subarray(address, address + length)).toString("base64") };
  },
  flash({ address, length }) {
    return { bytes: Buffer.from(board.cpu.progBytes.subarray(address, address + length)).toString("base64") };
  },
  stick_flash({ address, bits }) {
    board.selfProgramming.stuck.set(address >> 1, bits << (8 * (address & 1)));
    return {};
  },
  state() {
    const { cpu, bmp180, ports, bus, selfProgramming } = board;
    return {
      cycle: cpu.cycles,
      sleep_cycles: cpu.sleepCycles,
      conversions: bmp180.conversions,
      conversions_disturbed: bmp180.disturbed,
      contentions: ports.B.contentions + ports.C.contentions + ports.D.contentions,
      sda_held: bus.sdaHeld,
      pages_written: selfProgramming.pagesWritten,
    };
  },
};

function floats(text) {
  const bytes = Uint8Array.from(Buffer.from(text, "base64")); // copied, so that it is aligned
  return new Float64Array(bytes.buffer);
}

function answer(line) {
  try {
    const request = JSON.parse(line);
    return OPERATIONS[request.op](request);
  } catch (error) {
    const foreseen = error.constructor === Error; // other kinds are mistakes of the emulator itself
    return { error: foreseen ? error.message : error.stack };
  }
}

function serve() {
  const chunk = Buffer.alloc(1 << 16);
  let pending = "";
  for (;;) {
    const count = fs.readSync(0, chunk, 0, chunk.length, null);
    if (count === 0) return;
    pending += chunk.toString("latin1", 0, count);
    for (let end = pending.indexOf("\n"); end >= 0; end = pending.indexOf("\n")) {
      const reply = Buffer.from(JSON.stringify(answer(pending.slice(0, end))) + "\n");
      pending = pending.slice(end + 1);
      for (let written = 0; written < reply.length; ) written += fs.writeSync(1, reply, written);
    }
  }
}

serve();
