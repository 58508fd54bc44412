"use strict";
// What happened on the board and when, seen from outside. Kinds that nobody asked for cost one comparison.

const KINDS = [
  "reset", // value: MCUSR bit of the cause
  "interrupt", // value: vector number; cycle: the response begins
  "pin_b", // value: all eight levels of port B
  "pin_c",
  "pin_d",
  "i2c_start", // value: 0 START, 1 repeated START; cycle: the edge of SDA
  "i2c_address", // value: address byte | 0x100 when acknowledged; cycle: its first bit
  "i2c_write", // value: byte | 0x100 when acknowledged; cycle: its first bit
  "i2c_read", // value: byte; cycle: its first bit
  "i2c_stop",
  "uart_tx", // value: byte; cycle: end of its stop bit
  "uart_rx", // value: byte; cycle: end of its stop bit
  "uart_overrun",
  "baro_begin", // a conversion of the BMP180; value: ctrl_meas
  "baro_end", // value: traffic on the bus during the conversion, in bytes
  "mouse_byte", // a byte sent by a mouse; value: port * 256 + byte
  "mouse_abort", // a byte given up because the host inhibited; value: port
  "mouse_command", // value: port * 256 + byte, + 0x10000 when its parity or stop bit was wrong
];

class Log {
  constructor() {
    this.enabled = Object.fromEntries(KINDS.map((kind) => [kind, false]));
    this.records = [];
  }

  choose(kinds) {
    for (const kind of kinds) if (!KINDS.includes(kind)) throw new Error(`no event kind '${kind}': ${KINDS.join(", ")}`);
    for (const kind of KINDS) this.enabled[kind] = kinds.includes(kind);
  }

  add(kind, cycle, value) {
    if (this.enabled[kind]) this.records.push(cycle, KINDS.indexOf(kind), value);
  }

  /** All records since the last call: cycle, index of the kind, value, one after the other. */
  take() {
    const { records } = this;
    this.records = [];
    return Float64Array.from(records);
  }
}

module.exports = { Log, KINDS };
