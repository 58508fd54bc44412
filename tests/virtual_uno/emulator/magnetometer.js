"use strict";
// The magnetometers that GY-87 boards carry behind the MPU-6050's auxiliary bus, each behind its registers:
// HMC5883L (Honeywell 900405 rev E), QMC5883L (QST 13-52-04) and QMC5883P (QST 13-52-19).
// They are reachable only while the inertial sensor connects the two buses.

const { CLOCK_HZ } = require("./cpu");
const { I2cSlave } = require("./i2c_bus");
const { Table } = require("./table");

const START_UP_S = 0.01;
const UT_PER_GAUSS = 100;

class Magnetometer extends I2cSlave {
  /** @param {() => boolean} reachable */
  constructor(cpu, address, reachable) {
    super(cpu, address);
    this.reachable = reachable;
    this.signal = Table.constant([22, 4, -42]); // microtesla, in the chip's own axes
    this.registers = new Uint8Array(0x40);
    this.conversion = null;
    this.powerOn();
  }

  get answers() {
    return super.answers && this.reachable();
  }

  powerOn() {
    this.cpu.cancel(this.conversion);
    this.conversion = null;
    this.registers.fill(0);
    this.reset();
    this.busyUntil = this.cpu.now + START_UP_S * CLOCK_HZ;
  }

  readRegister(register) {
    return this.registers[register & 0x3f];
  }

  /** A new reading every `seconds`, until the next call. */
  repeat(seconds, perGauss, store) {
    this.cpu.cancel(this.conversion);
    this.conversion = null;
    if (seconds === null) return;
    this.conversion = this.cpu.after(seconds * CLOCK_HZ, () => {
      this.conversion = null;
      const field = this.signal.at(this.cpu.now / CLOCK_HZ);
      store(Array.from(field, (uT) => Math.round((uT / UT_PER_GAUSS) * perGauss)));
      if (this.continuous) this.repeat(seconds, perGauss, store);
    });
  }

  putLittleEndian(first, values) {
    values.forEach((value, i) => {
      const held = Math.max(-32768, Math.min(32767, value));
      this.registers[first + 2 * i] = held & 0xff;
      this.registers[first + 2 * i + 1] = (held >> 8) & 0xff;
    });
    return values.some((value) => Math.abs(value) > 32767);
  }
}

class Hmc5883l extends Magnetometer {
  static ADDRESS = 0x1e;
  static GAIN = [1370, 1090, 820, 660, 440, 390, 330, 230]; // counts a gauss
  static RATE_HZ = [0.75, 1.5, 3, 7.5, 15, 30, 75, 75];

  constructor(cpu, reachable) {
    super(cpu, Hmc5883l.ADDRESS, reachable);
  }

  reset() {
    this.registers.set([0x10, 0x20, 0x01]);
    this.registers.set([0x48, 0x34, 0x33], 10); // "H43"
  }

  writeRegister(register, byte) {
    if (register > 2) return;
    this.registers[register] = byte;
    const mode = this.registers[2] & 3;
    this.continuous = mode === 0;
    const seconds = mode === 0 ? 1 / Hmc5883l.RATE_HZ[(this.registers[0] >> 2) & 7] : mode === 1 ? 0.006 : null;
    this.repeat(seconds, Hmc5883l.GAIN[this.registers[1] >> 5], ([x, y, z]) => {
      [x, z, y].forEach((value, i) => {
        const held = value < -2048 || value > 2047 ? -4096 : value;
        this.registers[3 + 2 * i] = (held >> 8) & 0xff;
        this.registers[4 + 2 * i] = held & 0xff;
      });
      this.registers[9] |= 1;
      if (mode === 1) this.registers[2] = (this.registers[2] & ~3) | 2; // single measurement: idle again
    });
  }
}

class Qmc5883l extends Magnetometer {
  static ADDRESS = 0x0d;
  static RATE_HZ = [10, 50, 100, 200];

  constructor(cpu, reachable) {
    super(cpu, Qmc5883l.ADDRESS, reachable);
  }

  reset() {
    this.registers[0x0d] = 0xff;
  }

  /** The pointer rolls over from 6 to 0 (ROL_PNT) where that is set. */
  read() {
    const byte = this.readRegister(this.pointer);
    if (this.pointer <= 5) this.registers[6] &= ~1; // reading data clears DRDY
    this.pointer = this.pointer === 6 && this.registers[0x0a] & 0x40 ? 0 : this.pointer + 1;
    return byte;
  }

  writeRegister(register, byte) {
    if (register === 0x0a && byte & 0x80) return this.powerOn();
    if (register < 9 || register > 0x0b) return undefined;
    this.registers[register] = byte;
    const control = this.registers[9];
    this.continuous = (control & 3) === 1;
    const perGauss = control & 0x10 ? 3000 : 12000;
    this.repeat(this.continuous ? 1 / Qmc5883l.RATE_HZ[(control >> 2) & 3] : null, perGauss, (values) => {
      const overflow = this.putLittleEndian(0, values);
      this.registers[6] = (this.registers[6] & ~2) | 1 | (overflow ? 2 : 0);
    });
    return undefined;
  }
}

class Qmc5883p extends Magnetometer {
  static ADDRESS = 0x2c;
  static RATE_HZ = [10, 50, 100, 200];
  static GAIN = [1000, 2500, 3750, 15000];

  constructor(cpu, reachable) {
    super(cpu, Qmc5883p.ADDRESS, reachable);
  }

  reset() {
    this.registers[0] = 0x80;
  }

  readRegister(register) {
    const byte = super.readRegister(register);
    if (register === 9) this.registers[9] &= ~1; // reading the status clears DRDY
    return byte;
  }

  writeRegister(register, byte) {
    if (register === 0x0b && byte & 0x80) return this.powerOn();
    if (register < 0x0a) return undefined;
    this.registers[register & 0x3f] = byte;
    const [control1, control2] = [this.registers[0x0a], this.registers[0x0b]];
    this.continuous = (control1 & 1) === 1; // normal or continuous
    const seconds = this.continuous ? 1 / Qmc5883p.RATE_HZ[(control1 >> 2) & 3] : null;
    this.repeat(seconds, Qmc5883p.GAIN[(control2 >> 2) & 3], (values) => {
      const overflow = this.putLittleEndian(1, values);
      this.registers[9] = 1 | (overflow ? 2 : 0);
    });
    return undefined;
  }
}

const CHIPS = { hmc5883l: Hmc5883l, qmc5883l: Qmc5883l, qmc5883p: Qmc5883p };

/** @param {"hmc5883l"|"qmc5883l"|"qmc5883p"} chip */
function makeMagnetometer(chip, cpu, reachable) {
  if (!(chip in CHIPS)) throw new Error(`there is no magnetometer ${chip}: take ${Object.keys(CHIPS).join(", ")}`);
  return new CHIPS[chip](cpu, reachable);
}

module.exports = { makeMagnetometer };
