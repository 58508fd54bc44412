"use strict";
// The analogue-to-digital converter (data sheet 23), for the one channel that needs no wire: the band gap against AVCC.
// All other channels read 0. No free-running or triggered conversions, no noise.

const ADCL = 0x78;
const ADCH = 0x79;
const ADCSRA = 0x7a;
const ADMUX = 0x7c;
const PRR = 0x64;
const ADEN = 0x80;
const ADSC = 0x40;
const ADIF = 0x10;
const ADIE = 0x08;
const PRADC = 0x01;
const REFERENCE_AVCC = 0x40;
const REFERENCE = 0xc0;
const LEFT_ADJUSTED = 0x20;
const CHANNEL = 0x0f;
const BAND_GAP = 0x0e;
const FULL_SCALE = 1024;
const FIRST_CONVERSION = 25; // ADC clocks, after ADEN: table 23-1
const CONVERSION = 13;

const OPTIONS = {
  supplyV: 5.0,
  bandGapV: 1.1, // 1.0 to 1.2 V, table 29-9
};

class Adc {
  /** @param {Partial<typeof OPTIONS>} options */
  constructor(cpu, options) {
    Object.assign(this, OPTIONS, options);
    this.cpu = cpu;
    this.interrupt = { address: 0x2a, flagRegister: ADCSRA, flagMask: ADIF, enableRegister: ADCSRA, enableMask: ADIE };
    cpu.writeHooks[ADCSRA] = (value) => this.#control(value);
    cpu.writeHooks[ADCL] = () => true; // read-only
    cpu.writeHooks[ADCH] = () => true;
    cpu.attach(this);
  }

  reset() {
    this.cpu.cancel(this.event ?? null);
    this.event = null;
    this.first = true;
  }

  #control(value) {
    const { cpu } = this;
    if (cpu.data[PRR] & PRADC) return true; // without a clock the registers keep their values
    const old = cpu.data[ADCSRA];
    const running = this.event !== null;
    const flag = old & ADIF & ~value;
    cpu.data[ADCSRA] = (value & ~(ADIF | ADSC)) | flag | (running ? ADSC : 0);
    if (value & ADIF) cpu.clearInterrupt(this.interrupt);
    cpu.updateInterruptEnable(this.interrupt, cpu.data[ADCSRA]);
    if (!(value & ADEN)) this.reset();
    else if (value & ADSC && !running) this.#start();
    if (this.event === null) cpu.data[ADCSRA] &= ~ADSC;
    return true;
  }

  #start() {
    const prescaler = 1 << Math.max(1, this.cpu.data[ADCSRA] & 7);
    this.cpu.data[ADCSRA] |= ADSC;
    this.event = this.cpu.after((this.first ? FIRST_CONVERSION : CONVERSION) * prescaler, () => this.#finish());
    this.first = false;
  }

  #finish() {
    const { data } = this.cpu;
    const mux = data[ADMUX];
    const bandGap = (mux & CHANNEL) === BAND_GAP && (mux & REFERENCE) === REFERENCE_AVCC;
    const ideal = bandGap ? Math.floor((this.bandGapV / this.supplyV) * FULL_SCALE) : 0;
    const value = Math.min(FULL_SCALE - 1, ideal) << (mux & LEFT_ADJUSTED ? 6 : 0);
    data[ADCL] = value & 0xff;
    data[ADCH] = value >> 8;
    data[ADCSRA] &= ~ADSC;
    this.event = null;
    this.cpu.setInterruptFlag(this.interrupt);
  }
}

module.exports = { Adc };
