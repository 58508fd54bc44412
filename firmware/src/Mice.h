// The mice at their ports: moves transactions between each mouse's driver and its lines, and applies the time limits.
//
// A round is one poll of every running mouse, all started at the same tick. It ends when each mouse has answered or its
// time limit has passed. It is complete if every running mouse has answered; otherwise all mice are polled again, and
// their movements add up.
//
// Rounds start every `period_` ticks. The tick that starts a round publishes the movement of the rounds before, until the
// start of the last one, `period_` ticks ago. If the last round took longer (a repeated packet, for example), the movement
// waits for a later tick. The SAMPLEs that carry movement are therefore late by the same time, and the movement of each
// belongs to the time since the last one. The period follows the slowest mouse.
#pragma once
#include <Clock.h>
#include <Messages.h>
#include <Ps2Mouse.h>
#include <Ps2Ports.h>

class Mice {
 public:
  static constexpr uint8_t kPorts = ps2::kPorts;
  static_assert(kPorts <= wire::Sample::kMaxMice, "the protocol has room for them");

  explicit Mice(uint8_t counts_per_mm);

  void begin() { ps2::begin(); }
  void run();
  void configure(uint8_t counts_per_mm);
  void reset(uint8_t ports);

  const Ps2Mouse& mouse(uint8_t port) const { return ports_[port].mouse; }
  // Longest poll since the last call, 0: none.
  uint16_t take_poll_us(uint8_t port);
  // Every port has been probed once.
  bool probed() const;
  // Ports up to the last one at which a mouse was ever found.
  uint8_t in_sample() const;
  // `read`: the SAMPLE carries the movement of a complete round.
  uint16_t flags(bool read) const;
  void forget_movement();

 private:
  struct Port {
    Ps2Mouse mouse;
    bool busy;
    bool waits;  // for its tick
    uint8_t received;
    uint8_t resyncs;
    uint16_t poll_us;
    uint16_t limit_ms;       // from `since_us`
    uint16_t next_limit_ms;  // of each further byte
    uint32_t since_us;
  };

  void advance(uint8_t port, uint32_t now_us);
  bool transaction_ended(uint8_t port, uint32_t now_us);
  void finish_transaction(uint8_t port, uint32_t now_us);
  void prepare(uint8_t port, const Ps2Mouse::Request& request);
  bool round_ended() const;
  bool round_complete() const;
  void begin_round();
  void adapt_period(uint8_t needed);

  Port ports_[kPorts];
  uint8_t round_ = 0;     // ports that were polled
  uint8_t finished_ = 0;  // ports of the round before
  uint32_t round_us_ = 0;  // its start
  bool armed_ = false;
  bool measured_round_ = false;  // adapt_period() was called for it
  uint8_t period_ = 1;
  uint8_t late_ = 0;
  uint8_t on_time_ = 0;
  uint8_t longest_ = 0;
};
