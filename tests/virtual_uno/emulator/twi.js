"use strict";
// The two-wire interface as a master: status codes of datasheet table 22-3, bit times from TWBR and TWPS.
// Not modelled: slave mode, clock stretching, arbitration between masters.

const TWBR = 0xb8;
const TWSR = 0xb9;
const TWDR = 0xbb;
const TWCR = 0xbc;
const TWINT = 0x80;
const TWEA = 0x40;
const TWSTA = 0x20;
const TWSTO = 0x10;
const TWWC = 0x08;
const TWEN = 0x04;
const TWIE = 0x01;
const STATUS_MASK = 0xf8;
const BITS_A_BYTE = 9; // eight and the acknowledge

const STATUS = {
  start: 0x08,
  repeatedStart: 0x10,
  addressWriteAck: 0x18,
  addressWriteNack: 0x20,
  writeAck: 0x28,
  writeNack: 0x30,
  arbitrationLost: 0x38,
  addressReadAck: 0x40,
  addressReadNack: 0x48,
  readAck: 0x50,
  readNack: 0x58,
  nothing: 0xf8,
};

class Twi {
  /** @param {import("./i2c_bus").I2cBus} bus */
  constructor(cpu, bus) {
    this.cpu = cpu;
    this.bus = bus;
    this.interrupt = { address: 0x30, flagRegister: TWCR, flagMask: TWINT, enableRegister: TWCR, enableMask: TWIE, constant: true };
    cpu.writeHooks[TWSR] = (value) => {
      cpu.data[TWSR] = (cpu.data[TWSR] & STATUS_MASK) | (value & 3);
      return true;
    };
    cpu.writeHooks[TWDR] = (value) => this.#writeData(value);
    cpu.writeHooks[TWCR] = (value) => this.#writeControl(value);
    cpu.attach(this);
  }

  reset() {
    this.cpu.cancel(this.operation ?? null);
    this.operation = null;
    this.owner = false; // between START and STOP
    this.phase = "address";
    this.cpu.data[TWSR] = STATUS.nothing;
    this.cpu.data[TWDR] = 0xff;
  }

  get bitCycles() {
    const { data } = this.cpu;
    return 16 + 2 * data[TWBR] * 4 ** (data[TWSR] & 3);
  }

  #writeData(value) {
    const { data } = this.cpu;
    if (data[TWCR] & TWINT) {
      data[TWDR] = value;
      data[TWCR] &= ~TWWC;
    } else {
      data[TWCR] |= TWWC; // a byte may be written only while TWINT is set
    }
    return true;
  }

  #writeControl(value) {
    const { cpu } = this;
    const { data } = cpu;
    if (!(value & TWEN)) {
      this.#disable(value);
      return true;
    }
    const flag = data[TWCR] & TWINT;
    const clear = (value & TWINT) !== 0;
    const stopping = data[TWCR] & TWSTO;
    data[TWCR] = (value & (TWEA | TWSTA | TWSTO | TWEN | TWIE)) | (data[TWCR] & TWWC) | stopping | (clear ? 0 : flag);
    if (clear) cpu.clearInterrupt(this.interrupt);
    cpu.updateInterruptEnable(this.interrupt, value);
    if (this.operation === null && (clear || !flag)) this.#command();
    return true;
  }

  #disable(value) {
    const { cpu } = this;
    cpu.clearInterrupt(this.interrupt);
    cpu.cancel(this.operation);
    this.operation = null;
    this.owner = false;
    cpu.data[TWCR] = value & (TWEA | TWIE);
    cpu.data[TWSR] |= STATUS.nothing;
  }

  #command() {
    const control = this.cpu.data[TWCR];
    if (control & TWSTO) this.#stop();
    else if (control & TWSTA) this.#start();
    else if (this.owner) this.#transfer();
  }

  #after(bits, action) {
    this.operation = this.cpu.after(bits * this.bitCycles, () => {
      this.operation = null;
      action();
    });
  }

  #finish(status) {
    const { data } = this.cpu;
    data[TWSR] = (data[TWSR] & 3) | status;
    this.cpu.setInterruptFlag(this.interrupt);
  }

  #start() {
    if (this.bus.sdaHeld) {
      this.#after(1, () => this.#start()); // the bus is not free: the START waits
      return;
    }
    const repeated = this.owner;
    this.#after(0.5, () => {
      this.bus.start(repeated);
      this.#after(0.5, () => {
        this.owner = true;
        this.phase = "address";
        this.#finish(repeated ? STATUS.repeatedStart : STATUS.start);
      });
    });
  }

  #stop() {
    this.#after(1, () => {
      if (this.owner && this.bus.sdaHeld) {
        this.#stop(); // SDA cannot rise: TWSTO stays set
        return;
      }
      const { data } = this.cpu;
      data[TWCR] &= ~TWSTO;
      data[TWSR] |= STATUS.nothing;
      if (this.owner) this.bus.stop();
      this.owner = false;
      if (data[TWCR] & TWSTA) this.#start();
    });
  }

  #transfer() {
    const byte = this.cpu.data[TWDR];
    const heldAtFirst = this.bus.sdaHeld;
    if (this.phase === "read") {
      this.#read();
    } else if (heldAtFirst && byte !== 0) {
      this.#after(8 - Math.floor(Math.log2(byte)), () => this.#loseArbitration());
    } else if (this.phase === "address") {
      const acknowledged = this.bus.address(byte) || heldAtFirst;
      const reading = byte & 1;
      this.#after(BITS_A_BYTE, () => {
        this.phase = reading ? "read" : "write";
        if (reading) this.#finish(acknowledged ? STATUS.addressReadAck : STATUS.addressReadNack);
        else this.#finish(acknowledged ? STATUS.addressWriteAck : STATUS.addressWriteNack);
      });
    } else {
      const acknowledged = this.bus.write(byte) || heldAtFirst;
      this.#after(BITS_A_BYTE, () => this.#finish(acknowledged ? STATUS.writeAck : STATUS.writeNack));
    }
  }

  #read() {
    const { data } = this.cpu;
    const acknowledge = data[TWCR] & TWEA;
    const byte = this.bus.read(acknowledge !== 0);
    this.#after(BITS_A_BYTE, () => {
      data[TWDR] = byte;
      if (acknowledge) this.#finish(STATUS.readAck);
      else if (this.bus.sdaHeld) this.#loseArbitration(); // the NACK's high level does not appear
      else this.#finish(STATUS.readNack);
    });
  }

  #loseArbitration() {
    this.owner = false;
    this.#finish(STATUS.arbitrationLost);
  }
}

module.exports = { Twi };
