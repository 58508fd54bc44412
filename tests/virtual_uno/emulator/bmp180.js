"use strict";
// The BMP180 behind its registers (BST-BMP180-DS000): conversions that take their time, and readings whose
// compensation by the datasheet's formulas gives the fed pressure and temperature back.

const { CLOCK_HZ } = require("./cpu");
const { I2cSlave } = require("./i2c_bus");
const { Table } = require("./table");
const { normal } = require("./random");

const CALIBRATION = 0xaa;
const ID = 0xd0;
const SOFT_RESET = 0xe0;
const CTRL_MEAS = 0xf4;
const OUT_MSB = 0xf6;
const CHIP_ID = 0x55;
const RESET_COMMAND = 0xb6;
const CONVERTING = 0x20; // the Sco bit
const TEMPERATURE = 0x2e;
const START_UP_S = 0.01; // datasheet table 1: before the first communication
const DURATIONS_S = {
  maximum: { temperature: 0.0045, pressure: [0.0045, 0.0075, 0.0135, 0.0255] },
  typical: { temperature: 0.003, pressure: [0.003, 0.005, 0.009, 0.017] },
};

/** The calibration words of the datasheet's worked example (figure 4). */
const EXAMPLE_WORDS = {
  ac1: 408, ac2: -72, ac3: -14383, ac4: 32741, ac5: 32757, ac6: 23153, b1: 6190, b2: 4, mb: -32768, mc: -8711, md: 2868,
};

class Bmp180 extends I2cSlave {
  /** @param {() => number} traffic count of what has passed on the bus
   *  @param {() => number} random
   *  @param {{ words?: typeof EXAMPLE_WORDS, speed?: "maximum"|"typical", disturbancePa?: number, id?: number,
   *    lateMs?: number }} options
   *  disturbancePa: standard deviation that traffic during a conversion adds; lateMs: how much longer than the data
   *  sheet's maximum a clone converts, with its Sco bit set and the old result in its registers */
  constructor(cpu, traffic, random, options = {}) {
    super(cpu, 0x77);
    const { words = EXAMPLE_WORDS, speed = "maximum", disturbancePa = 0 } = options;
    this.id = options.id ?? CHIP_ID;
    this.lateS = (options.lateMs ?? 0) / 1000;
    this.words = words;
    this.durations = DURATIONS_S[speed];
    this.disturbancePa = disturbancePa;
    this.traffic = traffic;
    this.random = random;
    this.signal = Table.constant([101325, 25]); // pressure in Pa, temperature in degC
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
    Object.values(this.words).forEach((word, i) => {
      registers[CALIBRATION + 2 * i] = (word >> 8) & 0xff;
      registers[CALIBRATION + 2 * i + 1] = word & 0xff;
    });
    registers[ID] = this.id;
    registers[OUT_MSB] = 0x80;
    this.busyUntil = this.cpu.now + START_UP_S * CLOCK_HZ;
  }

  writeRegister(register, byte) {
    if (register === SOFT_RESET && byte === RESET_COMMAND) this.powerOn();
    else if (register === CTRL_MEAS) this.#convert(byte);
  }

  readRegister(register) {
    return this.registers[register];
  }

  #convert(control) {
    const { cpu, registers } = this;
    registers[CTRL_MEAS] = control;
    cpu.cancel(this.conversion);
    this.conversion = null;
    const temperature = (control & 0x3f) === TEMPERATURE;
    if (!temperature && (control & 0x3f) !== 0x34) return;
    const oversampling = control >> 6;
    const duration = temperature ? this.durations.temperature : this.durations.pressure[oversampling];
    const trafficBefore = this.traffic();
    cpu.log.add("baro_begin", cpu.now, control);
    this.conversion = cpu.after((duration + this.lateS) * CLOCK_HZ, () => {
      this.conversion = null;
      const traffic = this.traffic() - trafficBefore;
      this.conversions += 1;
      this.disturbed += traffic > 0 ? 1 : 0;
      cpu.log.add("baro_end", cpu.now, traffic);
      registers[CTRL_MEAS] &= ~CONVERTING;
      this.#store(temperature ? this.#temperatureReading() : this.#pressureReading(oversampling, traffic > 0));
    });
  }

  #store(value) {
    this.registers[OUT_MSB] = (value >> 16) & 0xff;
    this.registers[OUT_MSB + 1] = (value >> 8) & 0xff;
    this.registers[OUT_MSB + 2] = value & 0xff;
  }

  #temperatureReading() {
    const [, temperature] = this.signal.at(this.cpu.now / CLOCK_HZ);
    return Math.round(invert((ut) => this.#b5(ut), temperature * 160 - 8, 0, 65535)) << 8;
  }

  #pressureReading(oversampling, disturbed) {
    const [pressure, temperature] = this.signal.at(this.cpu.now / CLOCK_HZ);
    const noise = disturbed && this.disturbancePa > 0 ? this.disturbancePa * normal(this.random) : 0;
    const b5 = temperature * 160 - 8;
    const highest = 2 ** (16 + oversampling) - 1;
    const up = invert((raw) => this.#pressure(raw, b5, oversampling), pressure + noise, 0, highest);
    return Math.round(up) << (8 - oversampling);
  }

  // The datasheet's compensation (figure 4) in real numbers.
  #b5(ut) {
    const { ac5, ac6, mc, md } = this.words;
    const x1 = ((ut - ac6) * ac5) / 32768;
    return x1 + md > 0 ? x1 + (mc * 2048) / (x1 + md) : -Infinity;
  }

  #pressure(up, b5, oversampling) {
    const { ac1, ac2, ac3, ac4, b1, b2 } = this.words;
    const b6 = b5 - 4000;
    const x3 = (b2 * ((b6 * b6) / 4096)) / 2048 + (ac2 * b6) / 2048;
    const b3 = ((ac1 * 4 + x3) * 2 ** oversampling + 2) / 4;
    const x3Second = ((ac3 * b6) / 8192 + (b1 * ((b6 * b6) / 4096)) / 65536 + 2) / 4;
    const b4 = (ac4 * (x3Second + 32768)) / 32768;
    const p = (((up - b3) * (50000 / 2 ** oversampling)) / b4) * 2;
    const x1 = ((p / 256) * (p / 256) * 3038) / 65536;
    return p + (x1 + (-7357 * p) / 65536 + 3791) / 16;
  }
}

/** The argument at which a rising function reaches a value, by bisection; held inside its limits. */
function invert(rising, value, low, high) {
  let below = low;
  let above = high;
  for (let i = 0; i < 40; i += 1) {
    const middle = (below + above) / 2;
    if (rising(middle) < value) below = middle;
    else above = middle;
  }
  return (below + above) / 2;
}

module.exports = { Bmp180 };
