"use strict";
// USART0, asynchronous: two transmit buffers, two receive buffers and the shift register, true bit times.

const UCSRA = 0xc0;
const UCSRB = 0xc1;
const UCSRC = 0xc2;
const UBRRL = 0xc4;
const UBRRH = 0xc5;
const UDR = 0xc6;
const RXC = 0x80;
const TXC = 0x40;
const UDRE = 0x20;
const FRAME_ERROR = 0x10;
const OVERRUN = 0x08;
const DOUBLE_SPEED = 0x02;
const RECEIVER_ON = 0x10;
const TRANSMITTER_ON = 0x08;
const RECEIVE_BUFFERS = 2;

class Usart {
  /** @param {(byte: number, start: number, bitCycles: number) => void} onTransmit a byte left: its first bit's cycle, one bit's length */
  constructor(cpu, onTransmit) {
    this.cpu = cpu;
    this.onTransmit = onTransmit;
    const interrupt = (address, flagMask, constant) => ({
      address, flagRegister: UCSRA, flagMask, enableRegister: UCSRB, enableMask: flagMask, constant,
    });
    this.received = interrupt(0x24, RXC, true);
    this.bufferEmpty = interrupt(0x26, UDRE, true);
    this.transmitted = interrupt(0x28, TXC, false);
    cpu.writeHooks[UCSRA] = (value, _old, _address, written) => this.#writeStatus(value, written);
    cpu.writeHooks[UCSRB] = (value) => this.#writeControl(value);
    cpu.writeHooks[UDR] = (value) => this.#transmit(value);
    cpu.readHooks[UDR] = () => this.#readReceived();
    cpu.attach(this);
  }

  reset() {
    this.cpu.cancel(this.shifting ?? null);
    this.shifting = null;
    this.waiting = null; // the byte in the transmit buffer
    this.fifo = []; // bytes received: { byte, frameError, overrun }
    this.shiftRegister = null; // a byte that arrived while the fifo was full
    this.cpu.data[UCSRA] = UDRE;
    this.cpu.data[UCSRC] = 0x06;
  }

  get bitCycles() {
    const { data } = this.cpu;
    const divisor = (((data[UBRRH] & 0x0f) << 8) | data[UBRRL]) + 1;
    return divisor * (data[UCSRA] & DOUBLE_SPEED ? 8 : 16);
  }

  get receiving() {
    return (this.cpu.data[UCSRB] & RECEIVER_ON) !== 0 && this.cpu.cycles >= this.cpu.haltedUntil;
  }

  #writeStatus(value, written) {
    const { cpu } = this;
    if (value & written & TXC) cpu.clearInterrupt(this.transmitted);
    cpu.data[UCSRA] = (cpu.data[UCSRA] & ~0x03) | (value & 0x03);
    return true;
  }

  #writeControl(value) {
    const { cpu } = this;
    cpu.data[UCSRB] = value;
    if (!(value & RECEIVER_ON)) this.#flush();
    for (const interrupt of [this.received, this.bufferEmpty, this.transmitted]) cpu.updateInterruptEnable(interrupt, value);
    return true;
  }

  #flush() {
    this.fifo = [];
    this.shiftRegister = null;
    this.#showHead();
  }

  #transmit(byte) {
    const { cpu } = this;
    if (!(cpu.data[UCSRB] & TRANSMITTER_ON)) return true;
    if (this.shifting === null) {
      this.#shiftOut(byte, cpu.cycles);
    } else if (this.waiting === null) {
      this.waiting = byte;
      cpu.clearInterrupt(this.bufferEmpty);
    } // a write while the buffer is full is lost (datasheet 20.6.2)
    return true;
  }

  #shiftOut(byte, start) {
    const { cpu } = this;
    const bit = this.bitCycles;
    this.shifting = cpu.at(start + 10 * bit, () => {
      this.shifting = null;
      cpu.log.add("uart_tx", cpu.now, byte);
      this.onTransmit(byte, start, bit);
      if (this.waiting === null) {
        cpu.setInterruptFlag(this.transmitted);
        return;
      }
      const next = this.waiting;
      this.waiting = null;
      this.#shiftOut(next, cpu.now);
      cpu.setInterruptFlag(this.bufferEmpty);
    });
  }

  /** A start bit arrived: a byte that still waits in the shift register is lost now (datasheet 20.7.4). */
  startBit() {
    if (this.shiftRegister === null) return;
    this.shiftRegister = null;
    this.fifo[this.fifo.length - 1].overrun = true;
    this.#showHead();
    this.cpu.log.add("uart_overrun", this.cpu.now, 0);
  }

  /** The stop bit of a byte was sampled. */
  receive(byte, frameError) {
    if (!this.receiving) return;
    const entry = { byte, frameError, overrun: false };
    this.cpu.log.add("uart_rx", this.cpu.now, byte);
    if (this.fifo.length === RECEIVE_BUFFERS) {
      this.shiftRegister = entry;
      return;
    }
    this.fifo.push(entry);
    this.#showHead();
  }

  #readReceived() {
    const head = this.fifo.shift();
    if (this.shiftRegister !== null) {
      this.fifo.push(this.shiftRegister);
      this.shiftRegister = null;
    }
    this.#showHead();
    return head === undefined ? 0 : head.byte;
  }

  #showHead() {
    const { cpu } = this;
    const head = this.fifo[0];
    cpu.data[UCSRA] &= ~(FRAME_ERROR | OVERRUN);
    if (head === undefined) {
      cpu.clearInterrupt(this.received);
      return;
    }
    cpu.data[UCSRA] |= (head.frameError ? FRAME_ERROR : 0) | (head.overrun ? OVERRUN : 0);
    cpu.setInterruptFlag(this.received);
  }
}

module.exports = { Usart };
