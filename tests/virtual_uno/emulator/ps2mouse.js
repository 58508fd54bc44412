"use strict";
// A PS/2 mouse at bit level, in both directions, after A. Chapweske, "The PS/2 Mouse Interface" and "The PS/2
// Mouse/Keyboard Protocol". The generator `#life` holds its behaviour and yields the waits. The default options describe
// a mouse that follows the documents; the others describe deviations of real mice.

const { CLOCK_HZ } = require("./cpu");
const { Table } = require("./table");

const CYCLES_A_US = CLOCK_HZ / 1e6;
const ACKNOWLEDGE = 0xfa;
const RESEND = 0xfe;
const ERROR = 0xfc;
const SELF_TEST_PASSED = 0xaa;
const STANDARD_ID = 0x00;
const SAMPLE_RATES = [10, 20, 40, 60, 80, 100, 200];
const COUNTS_PER_MM = [1, 2, 4, 8];
const COUNTER_LIMIT = 255; // 9 bits, two's complement; beyond it the overflow bit is set
const BUS_FREE_US = 50; // the clock must have been high so long before a byte begins
const REACTION_US = 5;
const ROUNDING = 1e-9; // a path in whole counts gives whole counts

const COMMAND = {
  reset: 0xff, resend: 0xfe, defaults: 0xf6, disable: 0xf5, enable: 0xf4, sampleRate: 0xf3, readId: 0xf2, remote: 0xf0,
  wrap: 0xee, endWrap: 0xec, readData: 0xeb, stream: 0xea, status: 0xe9, resolution: 0xe8, scaling2: 0xe7, scaling1: 0xe6,
};

const OPTIONS = {
  clockHz: 12_500, // 10 to 16.7 kHz
  selfTestMs: 400, // from power-on or RESET to 0xAA: usually 300 to 500 ms
  responseUs: 400, // from the last bit of a command to the first bit of the answer: at most 20 ms
  requestUs: 150, // from the host's request to send to the first clock: at most 15 ms
  betweenBytesUs: 120,
  repeatsWholePacket: true, // after an inhibit or RESEND; otherwise it repeats only the interrupted byte
  plugged: true,
  pullUps: true, // resistors to 5 V on both lines; without them only the host's pull-ups raise the lines
  ignores: [], // commands without any answer
  refuses: [], // commands that get RESEND (0xFE) each time
  refusesOnce: [], // commands that get RESEND the next time; one entry each
  errors: [], // commands that get ERROR (0xFC) each time
  darkUntilEnable: false, // the sensor does not run before ENABLE (0xF4), also in remote mode
  noRemoteMode: false, // acknowledges 0xF0 and stays in stream mode; STATUS reports it
  sensorAtReportRate: false, // the sensor is read at the report rate, by the mouse's own clock
  reportRateError: 0, // relative error of that clock
};

class Ps2Mouse {
  /** @param {import("./gpio").Port} port
   *  @param {number[]} pins masks of the clock and the data line
   *  @param {number} number of the mouse port, from 1
   *  @param {Partial<typeof OPTIONS>} options */
  constructor(cpu, port, [clock, data], number, options) {
    Object.assign(this, OPTIONS, options);
    this.cpu = cpu;
    this.port = port;
    this.clock = clock;
    this.data = data;
    this.number = number;
    /** how far the mouse has been moved along its x and y, in mm since the beginning */
    this.path = Table.constant([0, 0]);
    this.reported = [0, 0]; // counts that went into packets
    this.discarded = [0, 0]; // counts that a command or an overflow threw away
    this.packets = 0;
    this.badParityBytes = 0; // so many of the next bytes go out with wrong parity
    this.badParityPeriodS = 0; // and one every so many seconds
    this.nextBadParity = Infinity;
    this.lostClocks = 0; // so many of the next bytes go out without one of their clocks
    port.listeners.push((_level, changed) => this.#linesChanged(changed));
    this.event = null;
    this.waiting = false;
    this.at = [0, 0]; // mm of the path that the counters have followed
    if (this.plugged) this.#powerOn();
  }

  /** Takes its power and its lines away at once, in the middle of whatever it does, or gives them back. */
  plug(present) {
    if (present === this.plugged) return;
    this.plugged = present;
    if (present) {
      this.#powerOn();
      return;
    }
    this.cpu.cancel(this.event);
    this.event = null;
    this.waiting = false;
    this.port.hold(this.clock | this.data, false);
    if (this.pullUps) this.port.pullUp(this.clock | this.data, false);
  }

  /** A new path, from where it is now; what is less than a count of the old one stays. */
  follow(path) {
    const time = this.cpu.now / CLOCK_HZ;
    const before = [...this.path.at(time)];
    this.path = path;
    const after = path.at(time);
    for (let axis = 0; axis < 2; axis += 1) this.at[axis] += after[axis] - before[axis];
  }

  spoilParityEvery(seconds) {
    this.badParityPeriodS = seconds;
    this.nextBadParity = seconds > 0 ? this.cpu.now + seconds * CLOCK_HZ : Infinity;
  }

  #powerOn() {
    if (this.pullUps) this.port.pullUp(this.clock | this.data);
    this.at = [...this.path.at(this.cpu.now / CLOCK_HZ)];
    this.counters = [0, 0];
    this.#setDefaults();
    this.life = this.#life();
    this.#resume();
  }

  #setDefaults() {
    this.reportRateHz = 100;
    this.resolution = 2; // code: 4 counts/mm
    this.doubleScaling = false;
    this.reporting = false;
    this.mode = "stream";
    this.output = []; // chunks that wait to be sent: { bytes, sent }
    this.lastChunk = null;
    this.argumentOf = null;
    this.invalid = 0; // invalid commands in a row
    this.nextReport = Infinity;
    this.#clearCounters();
  }

  // --- time: the generator yields µs to wait, or a cycle until which it waits for a change of the lines ---

  #resume() {
    this.waiting = false;
    const { value } = this.life.next();
    if (typeof value === "number") {
      this.event = this.cpu.after(value * CYCLES_A_US, () => this.#resume());
      return;
    }
    this.waiting = true;
    this.event = value.until === Infinity ? null : this.cpu.at(value.until, () => this.#resume());
  }

  #linesChanged(changed) {
    if (!this.waiting || !(changed & (this.clock | this.data))) return;
    this.waiting = false;
    this.cpu.cancel(this.event);
    this.event = this.cpu.after(REACTION_US * CYCLES_A_US, () => this.#resume());
  }

  // --- lines: open collector, so a line that the mouse lets go of shows what the host does ---

  #pullClock(low) {
    this.port.hold(this.clock, low);
  }

  #pullData(low) {
    this.port.hold(this.data, low);
  }

  get #clockHigh() {
    return (this.port.level & this.clock) !== 0;
  }

  get #dataHigh() {
    return (this.port.level & this.data) !== 0;
  }

  get #reportCycles() {
    return CLOCK_HZ / (this.reportRateHz * (1 + this.reportRateError));
  }

  get #halfBitUs() {
    return 5e5 / this.clockHz;
  }

  *#life() {
    yield this.selfTestMs * 1000;
    this.#queue([SELF_TEST_PASSED, STANDARD_ID]);
    for (;;) {
      if (!this.#clockHigh) yield { until: Infinity }; // inhibited
      else if (!this.#dataHigh) yield* this.#receive();
      else if (this.output.length > 0) yield* this.#send();
      else if (this.#reportDue()) this.#queueReport();
      else yield { until: this.#streams ? this.nextReport : Infinity };
    }
  }

  get #streams() {
    return this.reporting && this.mode === "stream";
  }

  #reportDue() {
    if (!this.#streams || this.cpu.now < this.nextReport) return false;
    while (this.nextReport <= this.cpu.now) this.nextReport += this.#reportCycles;
    this.#count();
    return this.counters[0] !== 0 || this.counters[1] !== 0;
  }

  /** One byte of the first chunk; given up when the host inhibits before the last clock. */
  *#send() {
    yield BUS_FREE_US;
    if (!this.#clockHigh || !this.#dataHigh) return;
    const chunk = this.output[0];
    if (!(yield* this.#sendBits(chunk.bytes[chunk.sent]))) {
      if (this.repeatsWholePacket) chunk.sent = 0;
      return;
    }
    chunk.sent += 1;
    if (chunk.sent === chunk.bytes.length) {
      this.output.shift();
      this.lastChunk = chunk;
    }
    yield this.betweenBytesUs;
  }

  *#sendBits(byte) {
    const { cpu } = this;
    const half = this.#halfBitUs;
    const parity = oddParity(byte) ^ (this.#spoilsParity() ? 1 : 0);
    const frame = (byte << 1) | (parity << 9) | (1 << 10);
    const lostClock = this.lostClocks > 0 ? 1 + (cpu.cycles % 9) : -1;
    if (this.lostClocks > 0) this.lostClocks -= 1;
    for (let i = 0; i < 11; i += 1) {
      if (!this.#clockHigh) {
        this.#pullData(false);
        cpu.log.add("mouse_abort", cpu.now, this.number);
        return false;
      }
      this.#pullData(((frame >> i) & 1) === 0);
      yield half / 2;
      if (i !== lostClock) this.#pullClock(true);
      yield half;
      this.#pullClock(false);
      yield half / 2;
    }
    this.#pullData(false);
    cpu.log.add("mouse_byte", cpu.now, (this.number << 8) | byte);
    return true;
  }

  #spoilsParity() {
    if (this.badParityBytes > 0) {
      this.badParityBytes -= 1;
      return true;
    }
    if (this.cpu.now < this.nextBadParity) return false;
    this.nextBadParity += this.badParityPeriodS * CLOCK_HZ;
    return true;
  }

  /** The host holds data low and has let go of the clock: the mouse clocks a byte in and acknowledges it. */
  *#receive() {
    const half = this.#halfBitUs;
    yield this.requestUs;
    if (!this.#clockHigh || this.#dataHigh) return; // the host has thought better of it
    let byte = 0;
    let parity = 0;
    let stop = 0;
    for (let i = 0; i < 10; i += 1) {
      this.#pullClock(true);
      yield half;
      this.#pullClock(false);
      yield half / 2;
      const bit = this.#dataHigh ? 1 : 0;
      if (i < 8) byte |= bit << i;
      else if (i === 8) parity = bit;
      else stop = bit;
      yield half / 2;
      if (!this.#clockHigh) return; // inhibited: the host gives up
    }
    this.#pullData(true);
    yield half / 2;
    this.#pullClock(true);
    yield half;
    this.#pullClock(false);
    this.#pullData(false);
    const sound = parity === oddParity(byte) && stop === 1;
    this.cpu.log.add("mouse_command", this.cpu.now, (sound ? 0 : 0x10000) | (this.number << 8) | byte);
    yield this.responseUs;
    yield* this.#obey(byte, sound);
  }

  // --- commands ---

  #queue(bytes) {
    this.output.push({ bytes, sent: 0 });
  }

  *#obey(byte, sound) {
    if (sound && byte === COMMAND.resend) {
      this.#repeat();
      return;
    }
    this.output = [];
    if (sound && this.ignores.includes(byte)) return;
    if (!sound || this.#refusesNow(byte)) {
      this.#queue([RESEND]);
    } else if (this.errors.includes(byte)) {
      this.#queue([ERROR]);
    } else if (this.mode === "wrap" && byte !== COMMAND.reset && byte !== COMMAND.endWrap) {
      this.#queue([byte]);
    } else if (this.argumentOf !== null) {
      this.#takeArgument(byte);
    } else if (byte === COMMAND.reset) {
      yield* this.#resetByCommand();
    } else {
      this.#carryOut(byte);
    }
  }

  #refusesNow(byte) {
    if (this.refuses.includes(byte)) return true;
    const once = this.refusesOnce.indexOf(byte);
    if (once >= 0) this.refusesOnce.splice(once, 1);
    return once >= 0;
  }

  *#resetByCommand() {
    this.#setDefaults();
    this.#queue([ACKNOWLEDGE]);
    while (this.output.length > 0) {
      if (this.#clockHigh) yield* this.#send();
      else yield { until: Infinity };
    }
    yield this.selfTestMs * 1000;
    this.#queue([SELF_TEST_PASSED, STANDARD_ID]);
  }

  #repeat() {
    const started = this.output.find((chunk) => chunk.sent > 0) ?? null;
    const chunk = started ?? this.lastChunk;
    if (chunk === null) return;
    chunk.sent = this.repeatsWholePacket ? 0 : chunk.sent - 1;
    if (started === null) this.output.unshift(chunk);
  }

  #takeArgument(value) {
    const ofRate = this.argumentOf === COMMAND.sampleRate;
    const valid = ofRate ? SAMPLE_RATES.includes(value) : value < COUNTS_PER_MM.length;
    if (!valid) {
      this.#refuse();
      return;
    }
    this.argumentOf = null;
    this.invalid = 0;
    this.#count();
    if (ofRate) this.reportRateHz = value;
    else this.resolution = value;
    this.#acknowledge([]);
  }

  /** The first invalid command or argument gets RESEND, a second one in a row ERROR. */
  #refuse() {
    this.invalid += 1;
    this.#queue([this.invalid === 1 ? RESEND : ERROR]);
    if (this.invalid > 1) this.argumentOf = null;
  }

  #carryOut(command) {
    const actions = {
      [COMMAND.defaults]: () => this.#setDefaults(),
      [COMMAND.disable]: () => { this.reporting = false; },
      [COMMAND.enable]: () => { this.#count(); this.reporting = true; },
      [COMMAND.sampleRate]: () => { this.argumentOf = command; },
      [COMMAND.resolution]: () => { this.argumentOf = command; },
      [COMMAND.readId]: () => [STANDARD_ID],
      [COMMAND.remote]: () => { if (!this.noRemoteMode) this.mode = "remote"; },
      [COMMAND.stream]: () => { this.mode = "stream"; },
      [COMMAND.wrap]: () => { this.modeBeforeWrap = this.mode; this.mode = "wrap"; },
      [COMMAND.endWrap]: () => { if (this.mode === "wrap") this.mode = this.modeBeforeWrap; },
      [COMMAND.readData]: () => { this.#count(); return this.#report(false); },
      [COMMAND.status]: () => this.#status(),
      [COMMAND.scaling1]: () => { this.doubleScaling = false; },
      [COMMAND.scaling2]: () => { this.doubleScaling = true; },
    };
    const action = actions[command];
    if (action === undefined) {
      this.#refuse();
      return;
    }
    this.invalid = 0;
    this.#acknowledge(action() ?? []);
  }

  #acknowledge(answer) {
    this.#clearCounters();
    this.nextReport = this.cpu.now + this.#reportCycles;
    this.#queue([ACKNOWLEDGE]);
    if (answer.length > 0) this.#queue(answer);
  }

  #status() {
    const flags = (this.mode === "remote" ? 0x40 : 0) | (this.reporting ? 0x20 : 0) | (this.doubleScaling ? 0x10 : 0);
    return [flags, this.resolution, this.reportRateHz];
  }

  // --- movement ---

  /** The time at which the sensor was last read. */
  get #sensedAt() {
    if (!this.sensorAtReportRate) return this.cpu.now;
    return Math.floor(this.cpu.now / this.#reportCycles) * this.#reportCycles;
  }

  /** Lets the counters follow the path up to the present. A dark sensor follows without counting. */
  #count() {
    const perMm = COUNTS_PER_MM[this.resolution];
    const now = this.path.at(this.#sensedAt / CLOCK_HZ);
    if (this.darkUntilEnable && !this.reporting) {
      this.at = [...now];
      return;
    }
    for (let axis = 0; axis < 2; axis += 1) {
      const counts = Math.trunc((now[axis] - this.at[axis]) * perMm * (1 + ROUNDING));
      this.at[axis] += counts / perMm;
      this.counters[axis] += counts;
    }
  }

  #clearCounters() {
    this.#count();
    for (let axis = 0; axis < 2; axis += 1) this.discarded[axis] += this.counters[axis];
    this.counters = [0, 0];
  }

  #queueReport() {
    this.#queue(this.#report(this.doubleScaling));
  }

  #report(scaled) {
    let flags = 0x08;
    const bytes = this.counters.map((count, axis) => {
      const held = Math.max(-COUNTER_LIMIT - 1, Math.min(COUNTER_LIMIT, count));
      const sent = scaled ? doubled(held) : held;
      this.reported[axis] += sent;
      this.discarded[axis] += count - held;
      if (held !== count) flags |= 0x40 << axis;
      if (sent < 0) flags |= 0x10 << axis;
      return sent & 0xff;
    });
    this.counters = [0, 0];
    this.packets += 1;
    return [flags, ...bytes];
  }
}

/** 2:1 scaling of the stream: 1, 1, 3, 6, 9 for 1 to 5, twice the count beyond. */
function doubled(count) {
  const size = Math.abs(count);
  const scaled = size <= 5 ? [0, 1, 1, 3, 6, 9][size] : Math.min(2 * size, COUNTER_LIMIT);
  return Math.sign(count) * scaled;
}

function oddParity(byte) {
  let parity = 1;
  for (let i = 0; i < 8; i += 1) parity ^= (byte >> i) & 1;
  return parity;
}

module.exports = { Ps2Mouse };
