#include "TransmitRing.h"

#include <Crc16.h>
#include <Messages.h>

// COBS for payloads below 254 bytes: one code byte in front, and every 0x00 becomes the distance to the next one.
class TransmitRing::Encoder {
 public:
  Encoder(uint8_t* ring, uint8_t at) : ring_(ring), code_at_(at), at_(at + 1) {}

  void add(uint8_t byte) {
    if (byte == 0) {
      close_block();
    } else {
      ring_[at_++] = byte;
    }
  }
  uint8_t finish() {
    close_block();
    ring_[code_at_] = 0;  // the delimiter takes the place of the next block's code
    return at_;
  }

 private:
  void close_block() {
    ring_[code_at_] = static_cast<uint8_t>(at_ - code_at_);
    code_at_ = at_++;
  }

  uint8_t* ring_;
  uint8_t code_at_;
  uint8_t at_;
};

bool TransmitRing::put(uint8_t type, const void* body, uint8_t size) {
  static_assert(wire::kMaxPayloadToHost < 254, "a frame has one COBS overhead byte");
  const uint8_t frame = size + 5;  // type, CRC, COBS code, delimiter
  const uint8_t used = head_ - tail_;
  if (frame > 255 - used) {
    dropped_++;
    return false;
  }
  Encoder encoder(bytes_, head_);
  Crc16 crc;
  crc.add(type);
  encoder.add(type);
  const uint8_t* bytes = static_cast<const uint8_t*>(body);
  for (uint8_t i = 0; i < size; i++) {
    crc.add(bytes[i]);
    encoder.add(bytes[i]);
  }
  encoder.add(static_cast<uint8_t>(crc.value()));
  encoder.add(static_cast<uint8_t>(crc.value() >> 8));
  const uint8_t end = encoder.finish();
  __atomic_signal_fence(__ATOMIC_RELEASE);  // the bytes are in the ring before the interrupt sees the new head
  head_ = end;
  return true;
}
