// What several test files need: hexadecimal text, frames, and a random generator that gives the same numbers everywhere.
#pragma once
#include <FrameDecoder.h>
#include <TransmitRing.h>

#include <cstdint>
#include <cstdio>
#include <string>
#include <vector>

using Bytes = std::vector<uint8_t>;

inline Bytes from_hex(const char* hex) {
  Bytes bytes;
  for (unsigned value; std::sscanf(hex, "%2x", &value) == 1; hex += 2) bytes.push_back(static_cast<uint8_t>(value));
  return bytes;
}

inline Bytes drain(TransmitRing& ring) {
  Bytes bytes;
  while (!ring.empty()) bytes.push_back(ring.take());
  return bytes;
}

inline Bytes frame_of(uint8_t type, const Bytes& body) {
  TransmitRing ring;
  ring.put(type, body.data(), static_cast<uint8_t>(body.size()));
  return drain(ring);
}

// xorshift64*
class Random {
 public:
  explicit Random(uint64_t seed) : state_(seed) {}
  uint32_t next() {
    state_ ^= state_ >> 12;
    state_ ^= state_ << 25;
    state_ ^= state_ >> 27;
    return static_cast<uint32_t>(state_ * 0x2545F4914F6CDD1Dull >> 32);
  }
  uint32_t below(uint32_t limit) { return next() % limit; }

 private:
  uint64_t state_;
};
