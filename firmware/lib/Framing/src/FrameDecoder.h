// Takes the frames of the wire protocol (COBS, ended by 0x00, CRC-16 over type and body) apart, byte by byte.
//
// Needs no buffer for a whole frame: the CRC runs along, and only the first bytes of the body are kept. A frame of an
// unknown type that is longer than any command of this version is therefore still distinguished from a corrupt one.
#pragma once
#include <Crc16.h>
#include <Messages.h>
#include <stdint.h>

class FrameDecoder {
 public:
  enum class Event : uint8_t {
    kNone,     // in the middle of a frame, or an empty one
    kFrame,    // type(), body() and size() hold a frame until the next push()
    kCorrupt,  // a frame ended that is too short or too long, or whose COBS code or CRC is wrong
  };
  static constexpr uint8_t kKept = wire::kMaxPayloadToBoard - 3;

  Event push(uint8_t byte);

  uint8_t type() const { return type_; }
  const uint8_t* body() const { return body_; }  // its first kKept bytes
  uint8_t size() const { return size_; }         // of the whole body

 private:
  void reset();
  void add(uint8_t byte);
  bool complete() const;

  Crc16 crc_;                 // over all bytes but the last two
  uint8_t last_[2] = {0, 0};  // the last two, which may be the CRC
  uint8_t body_[kKept];
  uint8_t type_ = 0;
  uint8_t size_ = 0;
  uint8_t raw_ = 0;        // bytes since the last 0x00, at most kMaxFrame + 1
  uint8_t decoded_ = 0;    // bytes decoded, the two of the CRC too
  uint8_t block_left_ = 0; // of the present COBS block
  bool zero_due_ = false;  // a 0x00 stands between the present block and the next
};
