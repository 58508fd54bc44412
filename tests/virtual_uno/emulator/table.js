"use strict";
// A signal over time, given as rows: what a sensor feels.

class Table {
  /** @param {Float64Array} times seconds, rising
   *  @param {Float64Array} values row after row
   *  @param {boolean} interpolated between rows on a straight line; otherwise a row holds until the next */
  constructor(times, values, interpolated) {
    if (times.length === 0 || values.length % times.length !== 0) throw new Error("a table needs rows of one length");
    this.times = times;
    this.values = values;
    this.columns = values.length / times.length;
    this.interpolated = interpolated;
    this.row = 0; // where the last look was
    this.out = new Float64Array(this.columns);
  }

  static constant(values) {
    return new Table(Float64Array.of(0), Float64Array.from(values), false);
  }

  /** The values at a time; before the first row the first, after the last row the last. The array is reused. */
  at(time) {
    const { times, values, columns, out } = this;
    if (time < times[this.row]) this.row = 0;
    while (this.row + 1 < times.length && times[this.row + 1] <= time) this.row += 1;
    const { row } = this;
    const next = Math.min(row + 1, times.length - 1);
    const span = times[next] - times[row];
    const share = this.interpolated && span > 0 && time > times[row] ? (time - times[row]) / span : 0;
    for (let i = 0; i < columns; i += 1) {
      const value = values[row * columns + i];
      out[i] = value + share * (values[next * columns + i] - value);
    }
    return out;
  }
}

module.exports = { Table };
