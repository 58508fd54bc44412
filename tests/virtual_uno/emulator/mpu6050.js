"use strict";
// The MPU-6050 behind its registers (RM-MPU-6000A 4.2): sleep, reset, ranges, sample rate, self-test, and bursts that
// belong to one sample. The low-pass filter's bandwidth and delay are left to the signal that is fed in. Not modelled:
// FIFO, DMP, auxiliary bus, motion detection, single axes in standby.

const { CLOCK_HZ } = require("./cpu");
const { I2cSlave } = require("./i2c_bus");
const { Table } = require("./table");

const SELF_TEST_X = 0x0d;
const SELF_TEST_A = 0x10;
const SMPLRT_DIV = 0x19;
const CONFIG = 0x1a;
const GYRO_CONFIG = 0x1b;
const ACCEL_CONFIG = 0x1c;
const INT_STATUS = 0x3a;
const ACCEL_XOUT_H = 0x3b;
const LAST_READ_ONLY = 0x60;
const PWR_MGMT_1 = 0x6b;
const WHO_AM_I = 0x75;
const DEVICE_RESET = 0x80;
const SLEEP = 0x40;
const CLOCK_STOPPED = 7;
const DATA_READY = 0x01;
const POWER_UP_S = 0.02; // product specification 6.4: typical time until registers can be read and written
const DEVICE_RESET_S = 0.001;

class Mpu6050 extends I2cSlave {
  /** @param {{ whoAmI?: number, gyroTrim?: number[], accelTrim?: number[], selfTestError?: number }} options
   *  trims are the 5-bit factory codes of the three axes; selfTestError: relative error of the response */
  constructor(cpu, { whoAmI = 0x68, gyroTrim = [14, 15, 16], accelTrim = [13, 14, 17], selfTestError = 0.03 } = {}) {
    super(cpu, 0x68);
    this.whoAmI = whoAmI;
    this.gyroTrim = gyroTrim;
    this.accelTrim = accelTrim;
    this.selfTestError = selfTestError;
    /** specific force x y z in g, rate x y z in deg/s, temperature in degC */
    this.signal = Table.constant([0, 0, 1, 0, 0, 0, 25]);
    this.registers = new Uint8Array(0x80);
    this.powerOn();
  }

  powerOn() {
    this.#initialise(POWER_UP_S);
  }

  #initialise(startUpSeconds) {
    const { registers } = this;
    registers.fill(0);
    registers[PWR_MGMT_1] = SLEEP;
    registers[WHO_AM_I] = this.whoAmI;
    for (let axis = 0; axis < 3; axis += 1) {
      registers[SELF_TEST_X + axis] = ((this.accelTrim[axis] >> 2) << 5) | this.gyroTrim[axis];
      registers[SELF_TEST_A] |= (this.accelTrim[axis] & 3) << (4 - 2 * axis);
    }
    this.busyUntil = this.cpu.now + startUpSeconds * CLOCK_HZ;
    this.sampledFrom = this.busyUntil; // the internal sample clock's zero
    this.sampleNumber = 0;
  }

  get #sampling() {
    const power = this.registers[PWR_MGMT_1];
    return (power & SLEEP) === 0 && (power & 7) !== CLOCK_STOPPED;
  }

  get #samplePeriod() {
    const filter = this.registers[CONFIG] & 7;
    const gyroRate = filter === 0 || filter === 7 ? 8000 : 1000;
    return (CLOCK_HZ / gyroRate) * (1 + this.registers[SMPLRT_DIV]);
  }

  begin(writing) {
    super.begin(writing);
    if (!writing) this.#update(); // the data registers stand still while the bus reads them
  }

  writeRegister(register, byte) {
    if (register >= 0x80 || (register >= INT_STATUS && register <= LAST_READ_ONLY) || register === WHO_AM_I) return;
    if (register >= SELF_TEST_X && register <= SELF_TEST_A) return;
    if (register === PWR_MGMT_1 && byte & DEVICE_RESET) {
      this.#initialise(DEVICE_RESET_S);
      return;
    }
    this.#update();
    this.registers[register] = byte;
    if (register === PWR_MGMT_1 || register === SMPLRT_DIV || register === CONFIG) {
      this.sampledFrom = this.cpu.now;
      this.sampleNumber = 0;
    }
  }

  readRegister(register) {
    const byte = this.registers[register & 0x7f];
    if (register === INT_STATUS) this.registers[INT_STATUS] &= ~DATA_READY;
    return byte;
  }

  /** Brings the data registers to the newest internal sample. */
  #update() {
    if (!this.#sampling) return;
    const period = this.#samplePeriod;
    const number = Math.floor((this.cpu.now - this.sampledFrom) / period);
    if (number <= this.sampleNumber) return;
    this.sampleNumber = number;
    const sampledAt = (this.sampledFrom + number * period) / CLOCK_HZ;
    this.#convert(this.signal.at(sampledAt));
    this.registers[INT_STATUS] |= DATA_READY;
  }

  #convert([ax, ay, az, gx, gy, gz, temperature]) {
    const { registers } = this;
    const accelRange = 2 << ((registers[ACCEL_CONFIG] >> 3) & 3);
    const gyroRange = 250 << ((registers[GYRO_CONFIG] >> 3) & 3);
    const raw = [
      ...[ax, ay, az].map((g, axis) => (g * 32768) / accelRange + this.#accelSelfTest(axis, accelRange)),
      (temperature - 36.53) * 340,
      ...[gx, gy, gz].map((rate, axis) => (rate * 32768) / gyroRange + this.#gyroSelfTest(axis, gyroRange)),
    ];
    raw.forEach((value, i) => {
      const clipped = Math.max(-32768, Math.min(32767, Math.round(value)));
      registers[ACCEL_XOUT_H + 2 * i] = (clipped >> 8) & 0xff;
      registers[ACCEL_XOUT_H + 2 * i + 1] = clipped & 0xff;
    });
  }

  /** Register map 4.1: the factory trim is the response in counts at 8 g and 250 deg/s. */
  #accelSelfTest(axis, range) {
    if (!(this.registers[ACCEL_CONFIG] & (0x80 >> axis)) || this.accelTrim[axis] === 0) return 0;
    const trim = 4096 * 0.34 * (0.92 / 0.34) ** ((this.accelTrim[axis] - 1) / 30);
    return (trim * (1 + this.selfTestError) * 8) / range;
  }

  #gyroSelfTest(axis, range) {
    if (!(this.registers[GYRO_CONFIG] & (0x80 >> axis)) || this.gyroTrim[axis] === 0) return 0;
    const trim = (axis === 1 ? -25 : 25) * 131 * 1.046 ** (this.gyroTrim[axis] - 1);
    return (trim * (1 + this.selfTestError) * 250) / range;
  }
}

module.exports = { Mpu6050 };
