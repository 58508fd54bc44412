"use strict";
// The MPU-6050 and its successors behind their registers (RM-MPU-6000A 4.2, RM-MPU-6500A 3.1): sleep, reset, ranges,
// sample rate, self-test, I2C bypass, and bursts that belong to one sample. The family follows from WHO_AM_I: registers,
// temperature formula and self-test differ. The low-pass filter's bandwidth and delay are left to the signal that is
// fed in. Not modelled: FIFO, DMP, auxiliary master, motion detection, single axes in standby.
//
// Faults (option or property `fault`): "zeros" (all data registers 0), "frozen" (no new samples), "full" (every axis at
// the end of its range), "stuck" (accelerometer x keeps one value), "hot" (a die temperature of 130 degC).

const { CLOCK_HZ } = require("./cpu");
const { I2cSlave } = require("./i2c_bus");
const { seededRandom } = require("./random");
const { Table } = require("./table");

const SELF_TEST_X = 0x0d;
const SELF_TEST_A = 0x10;
const SMPLRT_DIV = 0x19;
const CONFIG = 0x1a; // DLPF_CFG
const GYRO_CONFIG = 0x1b;
const ACCEL_CONFIG = 0x1c;
const ACCEL_CONFIG2 = 0x1d;
const INT_PIN_CFG = 0x37;
const INT_STATUS = 0x3a;
const ACCEL_XOUT_H = 0x3b;
const LAST_READ_ONLY = 0x60;
const PWR_MGMT_1 = 0x6b;
const WHO_AM_I = 0x75;
const DEVICE_RESET = 0x80;
const SLEEP = 0x40;
const CLOCK_STOPPED = 7;
const DATA_READY = 0x01;
const BYPASS = 0x02;

/** By WHO_AM_I; `default` also for unknown ids. `power`: PWR_MGMT_1 after reset. */
const FAMILIES = {
  mpu6050: { perDegree: 340, zeroAt: 36.53, accelConfig2: false, oldSelfTest: true, power: 0x40 },
  mpu6500: { perDegree: 333.87, zeroAt: 21, accelConfig2: true, oldSelfTest: false, power: 0x01 },
  icm20600: { perDegree: 326.8, zeroAt: 25, accelConfig2: true, oldSelfTest: false, power: 0x41 },
};
const FAMILY_OF_ID = {
  0x70: "mpu6500", 0x71: "mpu6500", 0x73: "mpu6500", 0x74: "mpu6500", 0x75: "mpu6500", 0x78: "mpu6500",
  0x11: "icm20600", 0x12: "icm20600", 0x19: "icm20600", 0x98: "icm20600", 0xa6: "icm20600", 0xa9: "icm20600",
  0xae: "icm20600", 0xaf: "icm20600",
};
const POWER_UP_S = 0.02; // product specification 6.4: typical time until registers can be read and written
const DEVICE_RESET_S = 0.001;

class Mpu6050 extends I2cSlave {
  /** @param {{ address?: number, whoAmI?: number, family?: string, gyroTrim?: number[], accelTrim?: number[],
   *    selfTestError?: number, readOnly?: boolean, fault?: string }} options
   *  family: in place of the one that whoAmI has; trims are the factory codes of the three axes (5 bits of an MPU-6050,
   *  8 bits of a successor); selfTestError: relative error of the response; readOnly: settings are not kept */
  constructor(cpu, options = {}) {
    super(cpu, options.address ?? 0x68);
    const { whoAmI = 0x68, gyroTrim = [14, 15, 16], accelTrim = [13, 14, 17], selfTestError = 0.03 } = options;
    this.random = seededRandom(this.address);
    this.family = FAMILIES[options.family ?? FAMILY_OF_ID[whoAmI] ?? "mpu6050"];
    this.readOnly = options.readOnly ?? false;
    this.fault = options.fault ?? null;
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
    registers[PWR_MGMT_1] = this.family.power;
    registers[WHO_AM_I] = this.whoAmI;
    for (let axis = 0; axis < 3; axis += 1) {
      if (!this.family.oldSelfTest) {
        registers[axis] = this.gyroTrim[axis];
        registers[SELF_TEST_X + axis] = this.accelTrim[axis];
        continue;
      }
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
    if (register <= 0x02 || (register >= SELF_TEST_X && register <= SELF_TEST_A)) return;
    if (register === ACCEL_CONFIG2 && !this.family.accelConfig2) return;
    if (this.readOnly && register !== PWR_MGMT_1) return;
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

  /** Whether the auxiliary bus is connected to the main one (RM 4.17). */
  get bypass() {
    return this.answers && (this.registers[INT_PIN_CFG] & BYPASS) !== 0;
  }

  readRegister(register) {
    if (this.fault === "zeros" && register >= ACCEL_XOUT_H && register < ACCEL_XOUT_H + 14) return 0;
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
    if (this.fault === "frozen") return;
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
      // Noise of a count: no reading of a living sensor repeats to the last bit for long.
      (temperature - this.family.zeroAt) * this.family.perDegree + Math.round(this.random()),
      ...[gx, gy, gz].map((rate, axis) => (rate * 32768) / gyroRange + this.#gyroSelfTest(axis, gyroRange)),
    ];
    if (this.fault === "full") raw.forEach((_, i) => (raw[i] = i === 3 ? raw[3] : 40000));
    if (this.fault === "stuck") raw[0] = 1234;
    if (this.fault === "hot") raw[3] = (130 - this.family.zeroAt) * this.family.perDegree + Math.round(this.random());
    raw.forEach((value, i) => {
      const clipped = Math.max(-32768, Math.min(32767, Math.round(value)));
      registers[ACCEL_XOUT_H + 2 * i] = (clipped >> 8) & 0xff;
      registers[ACCEL_XOUT_H + 2 * i + 1] = clipped & 0xff;
    });
  }

  /** RM-MPU-6000A 4.1: the factory trim is the response in counts at 8 g and 250 deg/s. AN-MPU-9250A-03: at 2 g. */
  #accelSelfTest(axis, range) {
    if (!(this.registers[ACCEL_CONFIG] & (0x80 >> axis)) || this.accelTrim[axis] === 0) return 0;
    if (!this.family.oldSelfTest) {
      return (2620 * 1.01 ** (this.accelTrim[axis] - 1) * (1 + this.selfTestError) * 2) / range;
    }
    const trim = 4096 * 0.34 * (0.92 / 0.34) ** ((this.accelTrim[axis] - 1) / 30);
    return (trim * (1 + this.selfTestError) * 8) / range;
  }

  #gyroSelfTest(axis, range) {
    if (!(this.registers[GYRO_CONFIG] & (0x80 >> axis)) || this.gyroTrim[axis] === 0) return 0;
    if (!this.family.oldSelfTest) {
      return (2620 * 1.01 ** (this.gyroTrim[axis] - 1) * (1 + this.selfTestError) * 250) / range;
    }
    const trim = (axis === 1 ? -25 : 25) * 131 * 1.046 ** (this.gyroTrim[axis] - 1);
    return (trim * (1 + this.selfTestError) * 250) / range;
  }
}

module.exports = { Mpu6050 };
