// The bits of one PS/2 line, from the host's side: one falling edge of the mouse's clock at a time.
//
// A transaction is an optional byte to the mouse and a number of bytes from it. Between two transactions the host holds
// the clock low, which stops the mouse from sending. The pin-change interrupt calls falling_edge() and carries out the
// action that it returns. All bits of a byte are kept in one word with a marker bit, which needs neither a counter nor a
// loop.
//
// Timing and framing: A. Chapweske, "The PS/2 Mouse/Keyboard Protocol".
#pragma once
#include <stdint.h>

class Ps2Bits {
 public:
  enum class Outcome : uint8_t {
    kRunning,
    kDone,
    kBadParity,   // the clock is held: the mouse has sent the byte and waits
    kBadFraming,  // start or stop bit wrong: out of step
    kNotTaken,    // the mouse sent no acknowledge bit after the byte to it
    kRefused,     // the first answer is not ACK (0xFA): RESEND (0xFE), ERROR (0xFC) or another byte
  };
  enum class Act : uint8_t { kNone, kDataLow, kDataHigh, kHoldClock };

  static constexpr uint8_t kAcknowledge = 0xFA;
  static constexpr uint8_t kMaxAnswers = 4;
  // Unit of the time that falling_edge() receives; it may wrap.
  static constexpr uint8_t kStepUs = 64;

  // Call before the clock is released; data is low already, which is the start bit. `acknowledged`: the first answer must
  // be ACK, any other byte ends the transaction.
  void begin_sending(uint8_t byte, uint8_t answers, bool acknowledged) {
    shift_ = byte | (odd_parity(byte) ? kSendParity : 0) | kSendStop | kSendMarker;
    sending_ = true;
    begin(answers, acknowledged);
  }
  void begin_receiving(uint8_t answers) {
    shift_ = kReceiveMarker;
    sending_ = false;
    begin(answers, false);
  }

  __attribute__((always_inline)) Act falling_edge(bool data, uint8_t now) {
    const uint8_t gap = now - last_edge_;
    last_edge_ = now;
    uint16_t shift = shift_;
    if (sending_) return send_bit(shift, data);
    // A byte whose clock paused for 2 ms is abandoned: this edge is the first of a new byte.
    if (gap > kGapSteps && shift != kReceiveMarker) {
      shift = kReceiveMarker;
      resyncs_ = resyncs_ + 1;
    }
    shift >>= 1;
    if (data) shift |= kReceiveMarker;
    if (shift & 1) return end_byte(shift);
    shift_ = shift;
    return Act::kNone;
  }

  Outcome outcome() const { return outcome_; }
  bool sending() const { return sending_; }
  uint8_t received() const { return received_; }  // bytes without an error
  const uint8_t* bytes() const { return bytes_; }
  // Bytes abandoned; wraps. One byte, because the main loop reads it while interrupts are enabled.
  uint8_t resyncs() const { return resyncs_; }

 private:
  static constexpr uint16_t kSendParity = 1 << 8;
  static constexpr uint16_t kSendStop = 1 << 9;
  static constexpr uint16_t kSendMarker = 1 << 10;
  // Bits enter at the top and shift the marker down: after 11 bits it is bit 0, and the start bit is bit 1.
  static constexpr uint16_t kReceiveMarker = 1 << 11;
  static constexpr uint8_t kGapSteps = 2000 / kStepUs;

  __attribute__((always_inline)) static bool odd_parity(uint8_t byte) {
    byte ^= static_cast<uint8_t>(byte << 4 | byte >> 4);  // one instruction
    byte ^= byte >> 2;
    byte ^= byte >> 1;
    return !(byte & 1);
  }

  void begin(uint8_t answers, bool acknowledged) {
    expected_ = answers;
    acknowledged_ = acknowledged;
    received_ = 0;
    outcome_ = Outcome::kRunning;
  }

  __attribute__((always_inline)) Act send_bit(uint16_t shift, bool data) {
    if (shift == 1) {  // all bits are sent: this is the mouse's acknowledge bit
      if (data) return end(Outcome::kNotTaken);
      sending_ = false;
      shift_ = kReceiveMarker;
      return Act::kNone;
    }
    shift_ = shift >> 1;
    return shift & 1 ? Act::kDataHigh : Act::kDataLow;
  }

  __attribute__((always_inline)) Act end_byte(uint16_t shift) {
    const bool start = shift & 1 << 1, parity = shift & 1 << 10, stop = shift & 1 << 11;
    const uint8_t byte = static_cast<uint8_t>(shift >> 2);
    shift_ = kReceiveMarker;
    if (start || !stop) return end(Outcome::kBadFraming);
    if (parity != odd_parity(byte)) return end(Outcome::kBadParity);
    const uint8_t received = received_;
    if (received == kMaxAnswers) return end(Outcome::kBadFraming);  // more than requested
    bytes_[received] = byte;
    const uint8_t count = received + 1;
    received_ = count;
    if (received == 0 && acknowledged_ && byte != kAcknowledge) return end(Outcome::kRefused);
    return count == expected_ ? end(Outcome::kDone) : Act::kNone;
  }

  __attribute__((always_inline)) Act end(Outcome outcome) {
    outcome_ = outcome;
    return Act::kHoldClock;
  }

  uint16_t shift_ = kReceiveMarker;
  uint8_t bytes_[kMaxAnswers];
  uint8_t last_edge_ = 0;
  uint8_t expected_ = 1;
  volatile uint8_t resyncs_ = 0;
  volatile uint8_t received_ = 0;
  volatile Outcome outcome_ = Outcome::kDone;
  bool sending_ = false;
  bool acknowledged_ = false;
};
