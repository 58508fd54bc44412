#include "Mice.h"

namespace {

// A poll is 55 clocks and four pauses: 4.4 to 6.6 ms, with mice that clock at 16.7 to 10 kHz.
constexpr uint32_t kPollUs = 7500;

// Ticks between two polls.
uint8_t poll_divider(uint16_t rate_hz) { return static_cast<uint8_t>((kPollUs * rate_hz + 999999) / 1000000); }

Ps2Mouse::Ending ending_of(Ps2Bits::Outcome outcome) {
  switch (outcome) {
    case Ps2Bits::Outcome::kDone: return Ps2Mouse::Ending::kDone;
    case Ps2Bits::Outcome::kBadParity: return Ps2Mouse::Ending::kBadParity;
    case Ps2Bits::Outcome::kBadFraming: return Ps2Mouse::Ending::kBadFraming;
    case Ps2Bits::Outcome::kRefused: return Ps2Mouse::Ending::kRefused;
    default: return Ps2Mouse::Ending::kTimeout;
  }
}

}  // namespace

Mice::Mice(uint8_t counts_per_mm)
    : ports_{{Ps2Mouse(counts_per_mm), false, false, 0, 0},
             {Ps2Mouse(counts_per_mm), false, false, 0, 0},
             {Ps2Mouse(counts_per_mm), false, false, 0, 0},
             {Ps2Mouse(counts_per_mm), false, false, 0, 0}} {}

void Mice::begin(uint16_t rate_hz) {
  ps2::begin();
  ps2::set_divider(poll_divider(rate_hz));
}

void Mice::configure(uint16_t rate_hz, uint8_t counts_per_mm) {
  ps2::set_divider(poll_divider(rate_hz));
  for (Port& port : ports_) port.mouse.configure(counts_per_mm);
}

void Mice::reset(uint8_t ports) {
  for (uint8_t i = 0; i < kPorts; i++) {
    if (ports & 1 << i) ports_[i].mouse.reset();
  }
}

void Mice::run() {
  const uint32_t now = clock::now_us();
  for (uint8_t port = 0; port < kPorts; port++) advance(port, now);
}

void Mice::advance(uint8_t number, uint32_t now_us) {
  Port& port = ports_[number];
  if (port.busy) {
    // The time runs from the tick at which it begins.
    if (port.waits) {
      port.waits = ps2::waiting(number);
      port.since_us = now_us;
    }
    if (port.waits) return;
    const Ps2Bits& bits = ps2::bits(number);
    const bool running = bits.outcome() == Ps2Bits::Outcome::kRunning;
    if (running && now_us - port.since_us < port.timeout_us) return;
    ps2::hold(number);
    port.busy = false;
    port.mouse.finish({ending_of(bits.outcome()), bits.received(), bits.bytes()});
  }
  begin_transaction(number, now_us);
}

void Mice::begin_transaction(uint8_t number, uint32_t now_us) {
  Port& port = ports_[number];
  const Ps2Mouse::Request request = port.mouse.next();
  port.busy = true;
  port.waits = true;
  port.timeout_us = request.timeout_us;
  port.since_us = now_us;
  if (request.sends) {
    ps2::send(number, request.byte, request.answers);
  } else {
    ps2::listen(number, request.answers);
  }
}

bool Mice::settled() const {
  for (const Port& port : ports_) {
    if (!port.mouse.settled()) return false;
  }
  return true;
}

uint8_t Mice::in_sample() const {
  uint8_t count = kPorts;
  while (count > 0 && !mouse(count - 1).ever_found()) count--;
  return count;
}

uint16_t Mice::flags(bool read) const {
  uint16_t flags = read ? 0 : wire::sample_flags::kMiceStale;
  for (uint8_t i = 0; i < kPorts; i++) {
    if (mouse(i).valid()) flags |= wire::sample_flags::kMouse1Valid << i;
    if (read && mouse(i).overflow()) flags |= wire::sample_flags::kMouse1Overflow << i;
  }
  return flags;
}

void Mice::forget_movement() {
  for (Port& port : ports_) port.mouse.forget_movement();
}
