"use strict";
// The BMP280 behind its registers (BST-BMP280-DS001) in forced mode: readings whose compensation by the data sheet's
// formulas (in real numbers) gives the fed pressure and temperature back.

const { CLOCK_HZ } = require("./cpu");
const { I2cSlave } = require("./i2c_bus");
const { Table } = require("./table");

const CALIBRATION = 0x88;
const ID = 0xd0;
const SOFT_RESET = 0xe0;
const STATUS = 0xf3;
const CTRL_MEAS = 0xf4;
const PRESSURE = 0xf7;
const MEASURING = 0x08;
const START_UP_S = 0.002;

/** The calibration words of the data sheet's worked example (section 3.12). */
const EXAMPLE_WORDS = [27504, 26435, -1000, 36477, -10685, 3024, 2855, 140, -7, 15500, -14600, 6000];

class Bmp280 extends I2cSlave {
  constructor(cpu, traffic, { id = 0x58, words = EXAMPLE_WORDS } = {}) {
    super(cpu, 0x77);
    this.id = id;
    this.words = words;
    this.traffic = traffic;
    this.signal = Table.constant([101325, 25]);
    this.registers = new Uint8Array(0x100);
    this.conversions = 0;
    this.disturbed = 0;
    this.conversion = null;
    this.powerOn();
  }

  powerOn() {
    const { registers } = this;
    this.cpu.cancel(this.conversion);
    this.conversion = null;
    registers.fill(0);
    this.words.forEach((word, i) => {
      registers[CALIBRATION + 2 * i] = word & 0xff;
      registers[CALIBRATION + 2 * i + 1] = (word >> 8) & 0xff;
    });
    registers[ID] = this.id;
    registers[PRESSURE] = registers[PRESSURE + 3] = 0x80;
    this.busyUntil = this.cpu.now + START_UP_S * CLOCK_HZ;
  }

  readRegister(register) {
    return this.registers[register];
  }

  writeRegister(register, byte) {
    const { cpu, registers } = this;
    if (register === SOFT_RESET && byte === 0xb6) this.powerOn();
    if (register !== CTRL_MEAS) return;
    registers[CTRL_MEAS] = byte;
    const mode = byte & 3;
    if (mode !== 1 && mode !== 2) return;
    const times = (code) => (code === 0 ? 0 : 2 ** (Math.min(code, 5) - 1));
    const temperature = times(byte >> 5);
    const pressure = times((byte >> 2) & 7);
    const seconds = (1.25 + 2.3 * temperature + (pressure ? 2.3 * pressure + 0.575 : 0)) / 1000; // appendix B, maximum
    registers[STATUS] |= MEASURING;
    const trafficBefore = this.traffic();
    cpu.log.add("baro_begin", cpu.now, byte);
    this.conversion = cpu.after(seconds * CLOCK_HZ, () => {
      this.conversion = null;
      const traffic = this.traffic() - trafficBefore;
      this.conversions += 1;
      this.disturbed += traffic > 0 ? 1 : 0;
      cpu.log.add("baro_end", cpu.now, traffic);
      registers[STATUS] &= ~MEASURING;
      registers[CTRL_MEAS] &= ~3; // sleeping again
      this.#measure(pressure > 0);
    });
  }

  #measure(withPressure) {
    const [pascal, celsius] = this.signal.at(this.cpu.now / CLOCK_HZ);
    const ut = Math.round(search((raw) => this.#fine(raw) / 5120, celsius, false)) & ~0xf; // 16 bits at x1
    this.#store(PRESSURE + 3, ut);
    if (!withPressure) return;
    const fine = this.#fine(ut);
    this.#store(PRESSURE, Math.round(search((raw) => this.#pressure(raw, fine), pascal, true)));
  }

  #store(register, raw) {
    this.registers[register] = raw >> 12;
    this.registers[register + 1] = (raw >> 4) & 0xff;
    this.registers[register + 2] = (raw << 4) & 0xf0;
  }

  #fine(raw) {
    const [t1, t2, t3] = this.words;
    const v = raw / 131072 - t1 / 8192;
    return (raw / 16384 - t1 / 1024) * t2 + v * v * t3;
  }

  #pressure(raw, fine) {
    const [, , , p1, p2, p3, p4, p5, p6, p7, p8, p9] = this.words;
    let v1 = fine / 2 - 64000;
    let v2 = (v1 * v1 * p6) / 32768 + v1 * p5 * 2;
    v2 = v2 / 4 + p4 * 65536;
    v1 = ((p3 * v1 * v1) / 524288 + p2 * v1) / 524288;
    v1 = (1 + v1 / 32768) * p1;
    const p = ((1048576 - raw - v2 / 4096) * 6250) / v1;
    return p + ((p9 * p * p) / 2147483648 + (p * p8) / 32768 + p7) / 16;
  }
}

/** The 20-bit argument at which a monotonic function reaches a value. */
function search(f, value, falling) {
  let low = 0;
  let high = 1048575;
  for (let i = 0; i < 40; i += 1) {
    const middle = (low + high) / 2;
    if (f(middle) < value !== falling) low = middle;
    else high = middle;
  }
  return (low + high) / 2;
}

module.exports = { Bmp280 };
