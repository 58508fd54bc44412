#include "FrameDecoder.h"

void FrameDecoder::reset() {
  crc_ = Crc16();
  raw_ = decoded_ = block_left_ = 0;
  zero_due_ = false;
}

void FrameDecoder::add(uint8_t byte) {
  if (decoded_ >= 2) {
    const uint8_t settled = last_[0];
    crc_.add(settled);
    if (decoded_ == 2) {
      type_ = settled;
    } else if (decoded_ - 3 < kKept) {
      body_[decoded_ - 3] = settled;
    }
  }
  last_[0] = last_[1];
  last_[1] = byte;
  decoded_++;
}

bool FrameDecoder::complete() const {
  return raw_ <= wire::kMaxFrame && block_left_ == 0 && decoded_ >= 3 &&
         crc_.value() == static_cast<uint16_t>(last_[0] | last_[1] << 8);
}

FrameDecoder::Event FrameDecoder::push(uint8_t byte) {
  if (byte == 0) {
    const bool empty = raw_ == 0;
    const bool good = complete();
    size_ = good ? decoded_ - 3 : 0;
    reset();
    return good ? Event::kFrame : empty ? Event::kNone : Event::kCorrupt;
  }
  if (raw_ > wire::kMaxFrame) return Event::kNone;  // too long: wait for its end
  raw_++;
  if (block_left_ > 0) {
    block_left_--;
    add(byte);
    return Event::kNone;
  }
  if (zero_due_) add(0);
  block_left_ = byte - 1;
  zero_due_ = byte != 0xFF;
  return Event::kNone;
}
