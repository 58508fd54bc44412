// Frames on their way to the UART: one writer (the main loop), one reader (the transmit interrupt).
//
// A frame is encoded straight into the ring and published by one store of `head_`, so that the reader sees the whole
// frame or nothing. When there is no room the whole frame is dropped and counted: the sampler never waits for the link.
#pragma once
#include <stdint.h>

class TransmitRing {
 public:
  // Adds the frame of one message. False when it was dropped.
  bool put(uint8_t type, const void* body, uint8_t size);
  uint32_t dropped() const { return dropped_; }

  // For the reader. The indices are bytes, and the ring has 256: they wrap by themselves.
  bool empty() const { return head_ == tail_; }
  uint8_t take() {
    const uint8_t at = tail_;
    tail_ = at + 1;
    return bytes_[at];
  }

 private:
  class Encoder;

  uint8_t bytes_[256];
  volatile uint8_t head_ = 0;
  volatile uint8_t tail_ = 0;
  uint32_t dropped_ = 0;
};
