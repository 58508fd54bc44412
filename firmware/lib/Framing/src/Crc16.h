// CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, not reflected, no final XOR ("123456789" gives 0x29B1).
#pragma once
#include <stdint.h>

class Crc16 {
 public:
  // The polynomial's bits, 12, 5 and 0, as shifts of a byte; each half by itself, as the AVR computes in bytes. A table
  // of 512 bytes would be faster by less than it costs in flash.
  void add(uint8_t byte) {
    const uint8_t x = high_ ^ byte;
    const uint8_t y = x ^ static_cast<uint8_t>(x >> 4);
    high_ = low_ ^ static_cast<uint8_t>(y << 4) ^ static_cast<uint8_t>(y >> 3);
    low_ = static_cast<uint8_t>(y << 5) ^ y;
  }
  uint16_t value() const { return static_cast<uint16_t>(high_ << 8 | low_); }

 private:
  uint8_t high_ = 0xFF;
  uint8_t low_ = 0xFF;
};
