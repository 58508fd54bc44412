"use strict";
// Timer/counters 0, 1 and 2. The count is worked out when somebody looks; events exist only for enabled interrupts,
// so a sleeping core costs nothing. Not modelled: compare outputs, input capture, external clocks, OCR double buffering.

const PRESCALERS_0_1 = [0, 1, 8, 64, 256, 1024, 0, 0];
const PRESCALERS_2 = [0, 1, 8, 32, 64, 128, 256, 1024];

const TIMERS = [
  { wide: false, a: 0x44, count: 0x46, compareA: 0x47, compareB: 0x48, flags: 0x35, mask: 0x6e, vectors: [0x20, 0x1c, 0x1e], prescalers: PRESCALERS_0_1 },
  { wide: true, a: 0x80, count: 0x84, compareA: 0x88, compareB: 0x8a, capture: 0x86, flags: 0x36, mask: 0x6f, vectors: [0x1a, 0x16, 0x18], prescalers: PRESCALERS_0_1 },
  { wide: false, a: 0xb0, count: 0xb2, compareA: 0xb3, compareB: 0xb4, flags: 0x37, mask: 0x70, vectors: [0x12, 0x0e, 0x10], prescalers: PRESCALERS_2 },
];

const OVERFLOW = 0;
const MATCH_A = 1;
const MATCH_B = 2;

// Waveform modes (datasheet tables 15-8 and 16-4): the top of the count, and whether it counts up and down.
const MODES_NARROW = [
  { top: 0xff }, { top: 0xff, slopes: 2 }, { top: "compareA", ctc: true }, { top: 0xff },
  { top: 0xff }, { top: "compareA", slopes: 2 }, { top: 0xff }, { top: "compareA" },
];
const MODES_WIDE = [
  { top: 0xffff }, { top: 0xff, slopes: 2 }, { top: 0x1ff, slopes: 2 }, { top: 0x3ff, slopes: 2 },
  { top: "compareA", ctc: true }, { top: 0xff }, { top: 0x1ff }, { top: 0x3ff },
  { top: "capture", slopes: 2 }, { top: "compareA", slopes: 2 }, { top: "capture", slopes: 2 }, { top: "compareA", slopes: 2 },
  { top: "capture", ctc: true }, { top: 0xffff }, { top: "capture" }, { top: "compareA" },
];

class Timer {
  constructor(cpu, number) {
    this.cpu = cpu;
    this.config = TIMERS[number];
    const { wide, a, flags, mask, vectors } = this.config;
    this.max = wide ? 0xffff : 0xff;
    this.interrupts = vectors.map((address, bit) => ({
      address, flagRegister: flags, flagMask: 1 << bit, enableRegister: mask, enableMask: 1 << bit,
    }));
    const control = (register) => {
      cpu.writeHooks[register] = (value) => this.#change(() => { cpu.data[register] = value; });
    };
    control(a);
    control(a + 1);
    this.#hookCounters();
    cpu.readHooks[flags] = () => { this.#sync(); return cpu.data[flags]; };
    cpu.writeHooks[flags] = (value, _old, _address, written) => this.#change(() => {
      for (const interrupt of this.interrupts) if (value & written & interrupt.flagMask) cpu.clearInterrupt(interrupt);
    });
    cpu.writeHooks[mask] = (value) => this.#change(() => {
      cpu.data[mask] = value;
      for (const interrupt of this.interrupts) cpu.updateInterruptEnable(interrupt, value);
    });
    cpu.attach(this);
  }

  reset() {
    this.cpu.cancel(this.event ?? null);
    this.event = null;
    this.values = { compareA: 0, compareB: 0, capture: 0 };
    this.position = 0; // place in the period: the count itself, or up and down a slope
    this.syncedAt = this.cpu.now;
    this.highByte = 0; // the TEMP register that makes 16-bit accesses atomic
    this.#configure();
  }

  #hookCounters() {
    const { cpu, config } = this;
    const names = ["compareA", "compareB", ...(config.wide ? ["capture"] : [])];
    const define = (register, read, write) => {
      if (config.wide) {
        cpu.writeHooks[register + 1] = (value) => { this.highByte = value; return true; };
        cpu.readHooks[register + 1] = () => (register === config.count ? this.highByte : cpu.data[register + 1]);
      }
      cpu.writeHooks[register] = (value) => this.#change(() => write(config.wide ? (this.highByte << 8) | value : value));
      cpu.readHooks[register] = () => {
        const value = read();
        if (register === config.count) this.highByte = value >> 8;
        return value & 0xff;
      };
    };
    define(config.count, () => { this.#sync(); return this.#count(); }, (value) => { this.position = value; });
    for (const name of names) {
      define(config[name], () => this.values[name], (value) => {
        this.values[name] = value;
        cpu.data[config[name]] = value & 0xff;
        if (config.wide) cpu.data[config[name] + 1] = value >> 8;
      });
    }
  }

  /** Brings the count up to now, lets `write` change registers, and looks ahead anew. */
  #change(write) {
    this.#sync();
    write();
    this.#configure();
    return true;
  }

  #configure() {
    const { data } = this.cpu;
    const { wide, a, prescalers } = this.config;
    const control = data[a + 1];
    this.divider = prescalers[control & 7];
    const mode = wide ? MODES_WIDE[(data[a] & 3) | ((control >> 1) & 0xc)] : MODES_NARROW[(data[a] & 3) | ((control >> 1) & 4)];
    const top = typeof mode.top === "string" ? this.values[mode.top] : mode.top;
    this.slopes = mode.slopes ?? 1;
    this.top = top;
    this.period = this.slopes === 2 ? Math.max(1, 2 * top) : top + 1;
    this.#placeFlags(mode.ctc === true);
    this.#schedule();
  }

  /** Positions at which each flag rises: one timer clock after the match, at the bottom for an overflow. */
  #placeFlags(ctc) {
    const { top, period, values } = this;
    const match = (value) => {
      if (value > top) return [];
      return this.slopes === 2 ? [(value + 1) % period, (period - value + 1) % period] : [(value + 1) % period];
    };
    const overflows = ctc && top < this.max ? [] : [0];
    this.flagPositions = [overflows, match(values.compareA), match(values.compareB)];
  }

  #count() {
    return this.slopes === 2 && this.position > this.top ? this.period - this.position : this.position;
  }

  /** The prescaler runs freely from reset on and is shared: its ticks are multiples of the divider. */
  #ticks(cycle) {
    return Math.floor(cycle / this.divider);
  }

  /** Timer clocks from now until `position`; a count written above the top runs through the maximum first. */
  #ticksUntil(position) {
    const wrap = this.slopes === 1 && this.position > this.top ? this.max + 1 : this.period;
    const ahead = position - this.position;
    return ahead > 0 && position < wrap ? ahead : wrap - this.position + position;
  }

  #sync() {
    const { now } = this.cpu;
    const elapsed = this.divider ? this.#ticks(now) - this.#ticks(this.syncedAt) : 0;
    this.syncedAt = now;
    if (elapsed === 0) return;
    for (const flag of [OVERFLOW, MATCH_A, MATCH_B]) {
      if (this.flagPositions[flag].some((position) => this.#ticksUntil(position) <= elapsed)) {
        this.cpu.setInterruptFlag(this.interrupts[flag]);
      }
    }
    const wrap = this.#ticksUntil(0);
    this.position = elapsed < wrap ? this.position + elapsed : (elapsed - wrap) % this.period;
  }

  #schedule() {
    const { cpu } = this;
    cpu.cancel(this.event);
    this.event = null;
    if (!this.divider) return;
    let soonest = Infinity;
    for (const flag of [OVERFLOW, MATCH_A, MATCH_B]) {
      if (!(cpu.data[this.config.mask] & (1 << flag))) continue;
      for (const position of this.flagPositions[flag]) soonest = Math.min(soonest, this.#ticksUntil(position));
    }
    if (soonest === Infinity) return;
    this.event = cpu.at((this.#ticks(cpu.now) + soonest) * this.divider, () => {
      this.#sync();
      this.#schedule();
    });
  }
}

module.exports = { Timer };
