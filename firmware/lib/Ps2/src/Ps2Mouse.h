// A PS/2 mouse as a state machine without I/O: next() returns the transaction that the mouse needs, finish() receives its
// outcome.
//
// The mouse is set up for remote mode and polled (READ_DATA, 0xEB). All mice are polled at the same tick, which makes
// their movements comparable. If a mouse refuses remote mode, it stays in stream mode, and the clock line gates its
// packets: the host releases the clock once a round. A byte with bad parity is requested again (RESEND, 0xFE), and a
// packet that lost step is read again, so that no counts are lost.
//
// Commands: A. Chapweske, "The PS/2 Mouse Interface".
#pragma once
#include <stdint.h>

#include "Ps2Bits.h"

class Ps2Mouse {
 public:
  static constexpr uint8_t kNoId = 0xFF;

  struct Request {
    bool sends;         // false: only receives
    uint8_t byte;       // to send
    uint8_t answers;    // bytes expected
    bool acknowledged;  // the first answer must be ACK
    uint16_t first_ms;  // time limit of the first answer
    uint16_t next_ms;   // time limit of each further answer
  };
  enum class Ending : uint8_t { kDone, kBadParity, kBadFraming, kNotTaken, kRefused, kTimeout };
  struct Answer {
    Ending ending;
    uint8_t count;  // bytes received without an error
    const uint8_t* bytes;
  };
  enum class Presence : uint8_t { kAbsent, kStarting, kRunning, kLost };
  // Bits of wire::mouse_lacks.
  enum Lack : uint8_t {
    kLacksRemoteMode = 0x01,
    kLacksEnable = 0x02,
    kLacksSampleRate = 0x04,
    kLacksResolution = 0x08,
    kLacksStatus = 0x10,
  };

  explicit Ps2Mouse(uint8_t counts_per_mm);

  // Both take effect with the next transaction.
  void configure(uint8_t counts_per_mm);
  void reset() { reset_wanted_ = true; }

  Request next();
  void finish(const Answer& answer);

  // The next transaction is a poll: it starts together with the polls of all other mice.
  bool polls() const { return state_ == State::kPoll && !set_up_wanted_ && !reset_wanted_; }
  void begin_round() { answered_ = false; }
  bool answered() const { return answered_; }
  // All running mice have answered: the movement until now belongs to the interval since the last complete round.
  void complete_round() {
    measured_ = has_baseline_;
    has_baseline_ = true;
  }

  bool running() const { return state_ >= State::kPoll; }
  bool valid() const { return running() && measured_ && silent_ == 0; }
  bool probed() const { return probed_; }
  bool ever_found() const { return ever_found_; }
  Presence presence() const;

  uint8_t id() const { return running() ? id_ : kNoId; }
  uint8_t counts_per_mm() const { return running() ? counts_per_mm_ : 0; }
  uint8_t report_rate_hz() const { return running() ? report_rate_hz_ : 0; }
  uint8_t status() const { return running() ? status_ : 0; }
  uint8_t lacks() const { return running() ? lacks_ : 0; }

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
  void count_resyncs(uint8_t more) { resyncs_ += more; }
  uint16_t resets() const { return resets_; }

 private:
  enum class State : uint8_t {
    kListen,   // for the 0xAA 0x00 that follows power-on
    kProbe,    // for a mouse that was powered before the board
    kReset,
    kSetUp,
    kPoll,
    kResend,   // requests a packet with bad parity again
    kCollect,  // receives a packet that the mouse repeats after an interruption
  };

  void set_up();
  void go_to_step(uint8_t step);
  void take_listen(const Answer& answer);
  void take_probe(const Answer& answer);
  void take_set_up(const Answer& answer);
  void take_step(const uint8_t* bytes);
  void take_status(const uint8_t* bytes);
  void retry_step(const Answer& answer);
  void skip_step();
  void finish_set_up();
  void use_stream_mode();
  void take_poll(const Answer& answer);
  void take_refused_poll(uint8_t answer);
  void take_gated_packet(const Answer& answer);
  void take_repeated(const Answer& answer);
  void take_packet(const uint8_t* packet);
  void take_answer();
  void packet_lost();
  void count_silence();
  void begin_reset();
  uint8_t set_up_byte() const;

  State state_ = State::kProbe;
  uint8_t step_ = 0;
  uint8_t tries_ = 0;   // of the present step
  uint8_t wanted_resolution_;
  uint8_t id_ = kNoId;
  uint8_t counts_per_mm_ = 0;
  uint8_t report_rate_hz_ = 0;
  uint8_t status_ = 0;
  uint8_t lacks_ = 0;
  uint8_t silent_ = 0;        // transactions without an answer, in a row; in set-up: all of them
  uint8_t refused_ = 0;       // polls answered with RESEND or ERROR, in a row
  uint8_t quiet_ = 0;         // rounds without a packet in stream mode, in a row
  uint8_t bad_packets_ = 0;   // in a row
  uint8_t partial_count_ = 0;
  uint8_t partial_[3];        // bytes of a packet before a byte with bad parity
  uint8_t repeat_ = 0;        // bytes expected after RESEND
  // Single bits: four mice, and RAM is short.
  bool repeats_answer_ : 1;  // in set-up: the answer had bad parity and is requested again
  bool self_testing_ : 1;    // after RESET
  bool no_remote_mode_ : 1;
  bool stream_ : 1;          // gated stream mode in place of remote mode
  bool set_up_wanted_ : 1;
  bool reset_wanted_ : 1;
  bool probed_ : 1;
  bool ever_found_ : 1;
  bool overflow_ : 1;
  bool answered_ : 1;
  bool has_baseline_ : 1;  // the counter was read at the end of a complete round
  bool measured_ : 1;
  uint16_t dx_ = 0;
  uint16_t dy_ = 0;
  uint16_t parity_errors_ = 0;
  uint16_t resyncs_ = 0;
  uint16_t resets_ = 0;
};
