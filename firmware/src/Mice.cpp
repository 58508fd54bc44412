#include "Mice.h"

#include <Idle.h>

namespace {

// The period grows after three late rounds in a row, or when one round in five is late; it shrinks after a second (at
// 100 Hz) of rounds that needed fewer ticks.
constexpr uint8_t kLateWeight = 4;
constexpr uint8_t kLateLimit = 12;
constexpr uint8_t kShortenAfter = 100;

Ps2Mouse::Ending ending_of(Ps2Bits::Outcome outcome) {
  switch (outcome) {
    case Ps2Bits::Outcome::kDone: return Ps2Mouse::Ending::kDone;
    case Ps2Bits::Outcome::kBadParity: return Ps2Mouse::Ending::kBadParity;
    case Ps2Bits::Outcome::kBadFraming: return Ps2Mouse::Ending::kBadFraming;
    case Ps2Bits::Outcome::kNotTaken: return Ps2Mouse::Ending::kNotTaken;
    case Ps2Bits::Outcome::kRefused: return Ps2Mouse::Ending::kRefused;
    default: return Ps2Mouse::Ending::kTimeout;
  }
}

}  // namespace

Mice::Mice(uint8_t counts_per_mm)
    : ports_{{Ps2Mouse(counts_per_mm), false, false, 0, 0, 0, 0, 0, 0},
             {Ps2Mouse(counts_per_mm), false, false, 0, 0, 0, 0, 0, 0},
             {Ps2Mouse(counts_per_mm), false, false, 0, 0, 0, 0, 0, 0},
             {Ps2Mouse(counts_per_mm), false, false, 0, 0, 0, 0, 0, 0}} {}

void Mice::configure(uint8_t counts_per_mm) {
  for (Port& port : ports_) port.mouse.configure(counts_per_mm);
}

void Mice::reset(uint8_t ports) {
  for (uint8_t i = 0; i < kPorts; i++) {
    if (ports & 1 << i) ports_[i].mouse.reset();
  }
}

void Mice::run() {
  if (!idle::take_mice_work()) return;
  const uint32_t now = clock::now_us();
  if (armed_ && !ps2::round_waiting()) {
    armed_ = false;
    round_us_ = clock::tick().t_us;
    for (uint8_t i = 0; ps2::published() && i < kPorts; i++) {
      if (finished_ & 1 << i) ports_[i].mouse.complete_round();
    }
  }
  for (uint8_t port = 0; port < kPorts; port++) advance(port, now);
  if (!armed_ && round_ended()) begin_round();
}

// Takes the outcome of a transaction, and starts the next one unless it is a poll.
void Mice::advance(uint8_t number, uint32_t now_us) {
  Port& port = ports_[number];
  if (port.busy) {
    if (!transaction_ended(number, now_us)) return;
    finish_transaction(number, now_us);
  }
  if (port.mouse.polls()) return;
  prepare(number, port.mouse.next());
  ps2::arm(number);
}

bool Mice::transaction_ended(uint8_t number, uint32_t now_us) {
  Port& port = ports_[number];
  if (port.waits) {
    port.waits = ps2::waiting(number);
    port.since_us = now_us;
    if (port.waits) return false;
  }
  const Ps2Bits& bits = ps2::bits(number);
  if (bits.outcome() != Ps2Bits::Outcome::kRunning) return true;
  const uint8_t received = bits.received();
  if (received != port.received) {
    port.received = received;
    port.since_us = now_us;
    port.limit_ms = port.next_limit_ms;
  }
  return (now_us - port.since_us) >> 10 >= port.limit_ms;  // 1024 us for 1 ms: a division would take longer
}

void Mice::finish_transaction(uint8_t number, uint32_t now_us) {
  Port& port = ports_[number];
  const Ps2Bits& bits = ps2::bits(number);
  ps2::hold(number);  // from here on no interrupt changes `bits`
  port.busy = false;
  const uint8_t resyncs = bits.resyncs();
  port.mouse.count_resyncs(resyncs - port.resyncs);
  port.resyncs = resyncs;
  const bool polled = port.mouse.running();
  port.mouse.finish({ending_of(bits.outcome()), bits.received(), bits.bytes()});
  if (!polled || !port.mouse.answered()) return;
  const uint32_t took_us = now_us - round_us_;
  if (took_us > port.poll_us) port.poll_us = took_us < UINT16_MAX ? static_cast<uint16_t>(took_us) : UINT16_MAX;
}

void Mice::prepare(uint8_t number, const Ps2Mouse::Request& request) {
  Port& port = ports_[number];
  port.busy = true;
  port.waits = true;
  port.received = 0;
  port.limit_ms = request.first_ms;
  port.next_limit_ms = request.next_ms;
  if (request.sends) {
    ps2::send(number, request.byte, request.answers, request.acknowledged);
  } else {
    ps2::receive(number, request.answers);
  }
}

bool Mice::round_ended() const {
  for (const Port& port : ports_) {
    if (port.busy && port.mouse.running()) return false;
  }
  return true;
}

bool Mice::round_complete() const {
  for (uint8_t i = 0; i < kPorts; i++) {
    if (round_ & 1 << i && mouse(i).running() && !mouse(i).answered()) return false;
  }
  return true;
}

void Mice::begin_round() {
  const bool complete = round_complete();
  const uint8_t needed = ps2::ticks_in_round() + 1;
  if (complete && round_ && !measured_round_) adapt_period(needed);
  measured_round_ = true;
  if (needed < period_) return;
  finished_ = 0;
  uint8_t ports = 0;
  for (uint8_t i = 0; i < kPorts; i++) {
    Port& port = ports_[i];
    if (!port.mouse.polls() || port.busy) continue;
    finished_ |= round_ & 1 << i;
    port.mouse.begin_round();
    prepare(i, port.mouse.next());
    ports |= 1 << i;
  }
  round_ = ports;
  armed_ = true;
  measured_round_ = false;
  ps2::arm_round(ports, complete, period_);
}

// Called once for each complete round, with the ticks that it needed. Rounds that are late now and then, because a packet
// was repeated, do not change the period.
void Mice::adapt_period(uint8_t needed) {
  if (needed > period_) {
    late_ += kLateWeight;
    if (late_ < kLateLimit) return;
    period_ = needed;
  } else {
    if (late_ > 0) late_--;
    if (needed > longest_) longest_ = needed;
    if (++on_time_ < kShortenAfter) return;
    period_ = longest_;
  }
  late_ = on_time_ = longest_ = 0;
}

uint16_t Mice::take_poll_us(uint8_t number) {
  const uint16_t us = ports_[number].poll_us;
  ports_[number].poll_us = 0;
  return us;
}

bool Mice::probed() const {
  for (const Port& port : ports_) {
    if (!port.mouse.probed()) return false;
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
