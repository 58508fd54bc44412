// One I2C transaction as a driver requests it: some bytes written, then (after a repeated START) some read.
#pragma once
#include <stdint.h>

struct I2cRequest {
  static constexpr uint8_t kMaxRead = 24;

  uint8_t address;  // 7 bits
  uint8_t write[2];
  uint8_t write_count;
  uint8_t read_count;  // at most kMaxRead
  bool probe;          // searches for a device that may be absent: no answer is not an error

  static I2cRequest read(uint8_t address, uint8_t first_register, uint8_t count, bool probe = false) {
    return {address, {first_register, 0}, 1, count, probe};
  }
  static I2cRequest set(uint8_t address, uint8_t target_register, uint8_t value, bool probe = false) {
    return {address, {target_register, value}, 2, 0, probe};
  }
};
