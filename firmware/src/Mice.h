// The mice at their ports: transactions from the driver of each mouse to its lines and back, and the time-outs.
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

  void begin(uint16_t rate_hz);
  void run();
  void configure(uint16_t rate_hz, uint8_t counts_per_mm);
  void reset(uint8_t ports);

  const Ps2Mouse& mouse(uint8_t port) const { return ports_[port].mouse; }
  uint16_t resyncs(uint8_t port) const { return mouse(port).resyncs() + ps2::bits(port).resyncs(); }
  bool settled() const;
  // Of a SAMPLE: ports up to the last at which a mouse was ever found.
  uint8_t in_sample() const;
  // `read`: the SAMPLE carries their movement, of the interval between two polls, the same for all.
  uint16_t flags(bool read) const;
  void forget_movement();

 private:
  struct Port {
    Ps2Mouse mouse;
    bool busy;
    bool waits;  // for its tick
    uint32_t timeout_us;
    uint32_t since_us;
  };

  void advance(uint8_t port, uint32_t now_us);
  void begin_transaction(uint8_t port, uint32_t now_us);

  Port ports_[kPorts];
};
