// CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, not reflected, no final XOR ("123456789" gives 0x29B1).
#pragma once
#include <stdint.h>

class Crc16 {
 public:
  // One byte in a few shifts: a 512-byte table would be faster by less than it costs in flash.
  void add(uint8_t byte) {
    uint16_t x = static_cast<uint16_t>(value_ << 8 | value_ >> 8) ^ byte;
    x ^= static_cast<uint8_t>(x) >> 4;
    x ^= static_cast<uint16_t>(x << 12);
    x ^= static_cast<uint16_t>(static_cast<uint8_t>(x) << 5);
    value_ = x;
  }
  uint16_t value() const { return value_; }

 private:
  uint16_t value_ = 0xFFFF;
};
