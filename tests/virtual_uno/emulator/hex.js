"use strict";
// Intel HEX, as avr-objcopy writes it.

const FLASH_BYTES = 32768;

/** @param {string} text
 *  @returns {Uint16Array} flash, erased where the file has nothing */
function readHex(text) {
  const flash = new Uint8Array(FLASH_BYTES).fill(0xff);
  let base = 0;
  for (const [index, line] of text.split(/\r?\n/).entries()) {
    if (line === "") continue;
    const record = Buffer.from(line.slice(1), "hex");
    const sum = record.reduce((total, byte) => (total + byte) & 0xff, 0);
    if (line[0] !== ":" || record.length !== record[0] + 5 || sum !== 0) throw new Error(`line ${index + 1} of the program is not Intel HEX`);
    const address = base + record.readUInt16BE(1);
    const type = record[3];
    const data = record.subarray(4, -1);
    if (type === 0 && address + data.length > FLASH_BYTES) throw new Error(`line ${index + 1} of the program lies beyond the flash`);
    if (type === 0) flash.set(data, address);
    else if (type === 2) base = data.readUInt16BE(0) << 4;
    else if (type === 4) base = data.readUInt16BE(0) << 16;
  }
  return new Uint16Array(flash.buffer);
}

module.exports = { readHex };
