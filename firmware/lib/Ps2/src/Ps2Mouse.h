// A PS/2 mouse as a state machine without I/O: it says which transaction it wants next, and is told how it ended.
//
// The mouse is set up for remote mode and then polled (READ_DATA) at the tick, so that all mice are read over the same
// interval. Nothing it counted is lost on the way: a byte of bad parity is asked for again (RESEND), and a packet that got
// out of step is collected anew.
//
// Commands: A. Chapweske, "The PS/2 Mouse Interface".
#pragma once
#include <stdint.h>

#include "Ps2Bits.h"

class Ps2Mouse {
 public:
  static constexpr uint8_t kNoId = 0xFF;

  struct Request {
    bool sends;       // else only listens
    uint8_t byte;     // to send
    uint8_t answers;  // bytes expected
    uint32_t timeout_us;
  };
  enum class Ending : uint8_t { kDone, kBadParity, kBadFraming, kRefused, kTimeout };
  struct Answer {
    Ending ending;
    uint8_t count;  // sound bytes that came
    const uint8_t* bytes;
  };

  explicit Ps2Mouse(uint8_t counts_per_mm) : wanted_resolution_(counts_per_mm) {}

  // Both take effect with the next transaction.
  void configure(uint8_t counts_per_mm);
  void reset() { reset_wanted_ = true; }

  Request next();
  void finish(const Answer& answer);

  bool valid() const { return state_ >= State::kPoll && silent_ == 0; }
  bool settled() const { return tried_; }
  uint8_t id() const { return running() ? id_ : kNoId; }
  uint8_t counts_per_mm() const { return running() ? counts_per_mm_ : 0; }
  uint8_t report_rate_hz() const { return running() ? report_rate_hz_ : 0; }
  bool ever_found() const { return ever_found_; }

  // Movement since forget_movement(), modulo 2^16.
  int16_t dx() const { return static_cast<int16_t>(dx_); }
  int16_t dy() const { return static_cast<int16_t>(dy_); }
  bool overflow() const { return overflow_; }
  void forget_movement() {
    dx_ = dy_ = 0;
    overflow_ = false;
  }

  uint16_t parity_errors() const { return parity_errors_; }
  uint16_t resyncs() const { return resyncs_; }
  uint16_t resets() const { return resets_; }

 private:
  enum class State : uint8_t {
    kListen,   // for the 0xAA 0x00 of a mouse that has got its power
    kProbe,    // is there a mouse that said it long ago?
    kReset,
    kSetUp,
    kPoll,
    kResend,   // asks again for what came with bad parity
    kCollect,  // the mouse repeats by itself the packet in which it was interrupted
  };

  bool running() const { return state_ >= State::kPoll; }
  void set_up();
  void take_set_up(const Answer& answer);
  void take_poll(const Answer& answer);
  void take_repeated(const Answer& answer);
  void take_packet(const uint8_t* packet);
  void packet_lost();
  void begin_reset();
  uint8_t set_up_byte() const;

  State state_ = State::kProbe;
  uint8_t step_ = 0;
  uint8_t wanted_resolution_;
  uint8_t id_ = kNoId;
  uint8_t counts_per_mm_ = 0;
  uint8_t report_rate_hz_ = 0;
  uint8_t silent_ = 0;       // transactions in a row without an answer
  uint8_t bad_packets_ = 0;  // in a row
  uint8_t partial_count_ = 0;
  uint8_t partial_[3];       // of a packet, before a byte of bad parity
  uint8_t repeat_ = 0;       // bytes expected after a RESEND
  bool set_up_wanted_ = false;
  bool reset_wanted_ = false;
  bool tried_ = false;
  bool ever_found_ = false;
  bool overflow_ = false;
  uint16_t dx_ = 0;
  uint16_t dy_ = 0;
  uint16_t parity_errors_ = 0;
  uint16_t resyncs_ = 0;
  uint16_t resets_ = 0;
};
