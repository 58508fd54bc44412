"use strict";
// SDA and SCL with the slaves on them, and what can go wrong there.

const SDA = 0x10; // PC4
const SCL = 0x20; // PC5

/** What every slave does: it answers at its address when it has power and is not made to be silent. */
class I2cSlave {
  constructor(cpu, address) {
    this.cpu = cpu;
    this.address = address;
    this.present = true;
    this.nackAddress = false;
    this.nackData = false;
    this.busyUntil = 0; // starting up: no answer
    this.pointer = 0;
    this.pointerNext = true; // the next byte written is the register pointer
  }

  get answers() {
    return this.present && !this.nackAddress && this.cpu.now >= this.busyUntil;
  }

  plug(present) {
    if (present && !this.present) this.powerOn();
    this.present = present;
  }

  begin(writing) {
    if (writing) this.pointerNext = true;
  }

  write(byte) {
    if (this.nackData) return false;
    if (this.pointerNext) {
      this.pointer = byte;
      this.pointerNext = false;
    } else {
      this.writeRegister(this.pointer, byte);
      this.pointer = (this.pointer + 1) & 0xff;
    }
    return true;
  }

  read() {
    const byte = this.readRegister(this.pointer);
    this.pointer = (this.pointer + 1) & 0xff;
    return byte;
  }
}

class I2cBus {
  /** @param {() => number} random */
  constructor(cpu, portC, random) {
    this.cpu = cpu;
    this.port = portC;
    this.random = random;
    this.slaves = [];
    this.selected = null;
    this.sdaHeld = false;
    this.clocksToRelease = Infinity;
    this.corruption = 0; // probability that a byte read has a flipped bit
    this.traffic = 0; // bytes and STARTs since power-on: what disturbs a conversion of the BMP180
    portC.pullUp(SDA | SCL);
    portC.listeners.push((level, changed, cycle) => this.#bitBanged(level, changed, cycle));
  }

  /** Something holds SDA low, until so many clocks of SCL have passed (Infinity: until release()). */
  hold(clocks) {
    this.sdaHeld = true;
    this.clocksToRelease = clocks;
    this.port.hold(SDA, true);
  }

  release() {
    this.sdaHeld = false;
    this.port.hold(SDA, false);
  }

  start(repeated) {
    this.traffic += 1;
    this.selected = null;
    this.cpu.log.add("i2c_start", this.cpu.now, repeated ? 1 : 0);
  }

  address(byte) {
    this.#clock(9);
    this.selected = this.slaves.find((slave) => slave.address === byte >> 1 && slave.answers) ?? null;
    this.selected?.begin((byte & 1) === 0);
    this.cpu.log.add("i2c_address", this.cpu.now, byte | (this.selected ? 0x100 : 0));
    return this.selected !== null;
  }

  write(byte) {
    this.#clock(9);
    const acknowledged = this.selected !== null && this.selected.present && this.selected.write(byte);
    this.cpu.log.add("i2c_write", this.cpu.now, byte | (acknowledged ? 0x100 : 0));
    return acknowledged;
  }

  read() {
    this.#clock(9);
    let byte = this.selected !== null && this.selected.present ? this.selected.read() : 0xff;
    if (this.sdaHeld) byte = 0;
    else if (this.random() < this.corruption) byte ^= 1 << Math.floor(this.random() * 8);
    this.cpu.log.add("i2c_read", this.cpu.now, byte);
    return byte;
  }

  stop() {
    this.selected = null;
    this.cpu.log.add("i2c_stop", this.cpu.now, 0);
  }

  #clock(pulses) {
    this.traffic += 1;
    if (!this.sdaHeld) return;
    this.clocksToRelease -= pulses;
    if (this.clocksToRelease <= 0) this.release();
  }

  /** Pulses and conditions that the program makes with the port's registers: the way to free a bus. */
  #bitBanged(level, changed, cycle) {
    if (changed & SCL && level & SCL && this.sdaHeld) {
      this.clocksToRelease -= 1;
      if (this.clocksToRelease <= 0) this.release();
    } else if (changed & SDA && level & SCL) {
      if (level & SDA) this.stop();
      else if (!this.sdaHeld) this.cpu.log.add("i2c_start", cycle, 0);
    }
  }
}

module.exports = { I2cBus, I2cSlave };
