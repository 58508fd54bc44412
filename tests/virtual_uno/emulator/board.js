"use strict";
// An Arduino UNO with a GY-87 on A4/A5 and PS/2 mice on port D: the parts and the wires between them.

const { Adc } = require("./adc");
const { Bmp180 } = require("./bmp180");
const { Bmp280 } = require("./bmp280");
const { CLOCK_HZ, Cpu, RESET_CAUSE } = require("./cpu");
const { makePorts } = require("./gpio");
const { I2cBus } = require("./i2c_bus");
const { readHex } = require("./hex");
const { Log } = require("./log");
const { makeMagnetometer } = require("./magnetometer");
const { Mpu6050 } = require("./mpu6050");
const { Ps2Host } = require("./ps2host");
const { Ps2Mouse } = require("./ps2mouse");
const { seededRandom } = require("./random");
const { SelfProgramming } = require("./self_programming");
const { SerialLine } = require("./serial_line");
const { Timer } = require("./timer");
const { Twi } = require("./twi");
const { Usart } = require("./usart");
const { Watchdog } = require("./watchdog");

const OPCODE_CLI = 0x94f8;
const OPCODE_JUMP_TO_ITSELF = 0xcfff;
const SREG = 0x5f;
const GLOBAL_INTERRUPT_ENABLE = 0x80;
// Clock and data of each mouse port: Arduino pins D2/D3, D4/D5, D6/D7, D8/D9.
const MOUSE_PORTS = [
  ["D", 0x04, 0x08],
  ["D", 0x10, 0x20],
  ["D", 0x40, 0x80],
  ["B", 0x01, 0x02],
];
const START_UP_S = 0.065; // the UNO's fuses: 16K clocks and 65 ms after every reset

class Board {
  /** @param {string} hex the program, Intel HEX
   *  @param {object} options
   *  @param {number} options.seed of everything random: registers and SRAM at power-on, faults
   *  @param {object} [options.adc] see Adc
   *  @param {object} [options.mpu6050] see Mpu6050
   *  @param {object} [options.imu2] a second inertial sensor, at 0x69: see Mpu6050
   *  @param {object} [options.bmp180] see Bmp180
   *  @param {object} [options.bmp280] a BMP280 in place of the BMP180
   *  @param {string} [options.magnetometer] chip behind the first inertial sensor's auxiliary bus: see magnetometer.js
   *  @param {object[]} [options.mice] see Ps2Mouse; one for each port from the first on
   *  @param {number} [options.bootloaderS] how long the UNO's bootloader waits for a program after a reset from outside;
   *    it clears MCUSR before it starts the one that is there. 0: no bootloader
   *  @param {number} [options.bootAddress] where every reset begins: that of a bootloader which is part of the program */
  constructor(hex, options) {
    const { seed, mpu6050 = {}, imu2 = null, bmp180 = {}, bmp280 = null, magnetometer = null } = options;
    const { adc = {}, mice = [], bootloaderS = 0, bootAddress = 0 } = options;
    const random = seededRandom(seed);
    this.bootloaderCycles = bootloaderS * CLOCK_HZ;
    this.log = new Log();
    this.cpu = new Cpu(readHex(hex), this.log);
    const { cpu } = this;
    cpu.resetVector = bootAddress >> 1;
    this.selfProgramming = new SelfProgramming(cpu);
    for (let address = 0x100; address < cpu.data.length; address += 1) cpu.data[address] = random() * 256;
    for (let register = 0; register < 32; register += 1) cpu.data[register] = random() * 256;
    this.adc = new Adc(cpu, adc);
    this.ports = makePorts(cpu);
    this.timers = [0, 1, 2].map((number) => new Timer(cpu, number));
    this.watchdog = new Watchdog(cpu, (cause) => this.reset(cause));
    this.line = new SerialLine(cpu, random);
    this.usart = new Usart(cpu, (byte, start, bitCycles) => this.line.fromBoard(byte, start, bitCycles));
    this.line.usart = this.usart;
    this.bus = new I2cBus(cpu, this.ports.C, random);
    this.twi = new Twi(cpu, this.bus);
    const traffic = () => this.bus.traffic;
    this.mpu6050 = new Mpu6050(cpu, mpu6050);
    this.bmp180 = bmp280 ? new Bmp280(cpu, traffic, bmp280) : new Bmp180(cpu, traffic, random, bmp180);
    this.bus.slaves.push(this.mpu6050, this.bmp180);
    if (imu2) this.bus.slaves.push((this.imu2 = new Mpu6050(cpu, { address: 0x69, ...imu2 })));
    if (magnetometer) {
      this.magnetometer = makeMagnetometer(magnetometer, cpu, () => this.mpu6050.bypass);
      this.bus.slaves.push(this.magnetometer);
    }
    this.mice = mice.map((mouse, index) => {
      const [name, clock, data] = MOUSE_PORTS[index];
      return new Ps2Mouse(cpu, this.ports[name], [clock, data], index + 1, mouse);
    });
    this.reset(RESET_CAUSE.powerOn);
  }

  reset(cause) {
    const waiting = cause === RESET_CAUSE.external ? this.bootloaderCycles : 0;
    this.cpu.restart(cause, START_UP_S * CLOCK_HZ + waiting, this.bootloaderCycles === 0);
  }

  /** Bit-bangs the host's side of a mouse port in place of the program. */
  ps2Host(mouse) {
    this.hosts ??= [];
    const { port, clock, data } = this.mice[mouse];
    this.hosts[mouse] ??= new Ps2Host(this.cpu, port, clock, data);
    return this.hosts[mouse];
  }

  /** The program stops for ever, in the loop that the C library puts behind main().
   *  @param {boolean} interrupts whether they stay enabled
   *  @returns {number} the byte address of the loop */
  hang(interrupts) {
    const { progMem } = this.cpu;
    const loop = progMem.findIndex((word, at) => word === OPCODE_CLI && progMem[at + 1] === OPCODE_JUMP_TO_ITSELF);
    if (loop < 0) throw new Error("the program has no loop behind main()");
    this.cpu.pc = loop + 1;
    this.cpu.asleep = false;
    if (interrupts) this.cpu.data[SREG] |= GLOBAL_INTERRUPT_ENABLE;
    else this.cpu.data[SREG] &= ~GLOBAL_INTERRUPT_ENABLE;
    return 2 * (loop + 1);
  }

  run(cycles) {
    this.cpu.run(this.cpu.cycles + cycles);
  }
}

module.exports = { Board };
