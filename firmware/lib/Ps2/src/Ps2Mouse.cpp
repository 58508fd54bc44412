#include "Ps2Mouse.h"

#include <string.h>

namespace {

enum Command : uint8_t {
  kScaling1To1 = 0xE6,
  kSetResolution = 0xE8,
  kStatus = 0xE9,
  kReadData = 0xEB,
  kRemoteMode = 0xF0,
  kReadId = 0xF2,
  kSetReportRate = 0xF3,
  kSetDefaults = 0xF6,
  kResendLast = 0xFE,
  kResetMouse = 0xFF,
};
constexpr uint8_t kAcknowledge = 0xFA;
constexpr uint8_t kSelfTestPassed = 0xAA;
constexpr uint8_t kReportRateHz = 100;  // of stream mode; some mice sample their sensor at it in remote mode too

// The first byte of a packet.
constexpr uint8_t kAlwaysSet = 0x08;
constexpr uint8_t kXNegative = 0x10;
constexpr uint8_t kYNegative = 0x20;
constexpr uint8_t kOverflow = 0xC0;
constexpr uint8_t kPacket = 3;

// The set-up, byte by byte. 0 stands for the code of the resolution that is wanted.
constexpr uint8_t kWantedResolution = 0;
constexpr struct {
  uint8_t byte;
  uint8_t answers;
} kSetUp[] = {{kSetDefaults, 1},   {kReadId, 2},         {kScaling1To1, 1}, {kSetResolution, 1},     {kWantedResolution, 1},
              {kSetReportRate, 1}, {kReportRateHz, 1},   {kRemoteMode, 1},  {kStatus, 1 + kPacket}};
constexpr uint8_t kSetUpSteps = sizeof kSetUp / sizeof kSetUp[0];
constexpr uint8_t kScaling2To1 = 0x10;  // in the first byte of the status

constexpr uint32_t kAnswerUs = 25000;     // command and answer; the answer begins within 20 ms by the protocol
constexpr uint32_t kPowerOnUs = 1000000;  // the self-test takes 300 to 500 ms as a rule
constexpr uint32_t kRepeatUs = 8000;       // a repeated packet
constexpr uint8_t kSilentLimit = 3;
constexpr uint8_t kBadPacketLimit = 5;

uint8_t resolution_code(uint8_t counts_per_mm) {
  uint8_t code = 0;
  while (counts_per_mm > 1) {
    counts_per_mm >>= 1;
    code++;
  }
  return code;
}

}  // namespace

void Ps2Mouse::configure(uint8_t counts_per_mm) {
  wanted_resolution_ = counts_per_mm;
  set_up_wanted_ = true;
}

void Ps2Mouse::set_up() {
  state_ = State::kSetUp;
  step_ = 0;
}

void Ps2Mouse::begin_reset() {
  resets_++;
  bad_packets_ = 0;
  silent_ = 0;
  state_ = State::kReset;
}

uint8_t Ps2Mouse::set_up_byte() const {
  const uint8_t byte = kSetUp[step_].byte;
  return byte == kWantedResolution ? resolution_code(wanted_resolution_) : byte;
}

Ps2Mouse::Request Ps2Mouse::next() {
  if (set_up_wanted_ && state_ >= State::kSetUp) set_up();
  if (reset_wanted_) begin_reset();
  set_up_wanted_ = reset_wanted_ = false;
  switch (state_) {
    case State::kListen: return {false, 0, 2, kPowerOnUs};
    case State::kProbe: return {true, kSetDefaults, 1, kAnswerUs};
    case State::kReset: return {true, kResetMouse, 1, kAnswerUs};
    case State::kSetUp: return {true, set_up_byte(), kSetUp[step_].answers, kAnswerUs};
    case State::kPoll: return {true, kReadData, 1 + kPacket, kAnswerUs};
    case State::kResend: return {true, kResendLast, repeat_, kAnswerUs};
    default: return {false, 0, kPacket, kRepeatUs};
  }
}

void Ps2Mouse::finish(const Answer& answer) {
  if (answer.ending == Ending::kBadParity) parity_errors_++;
  if (answer.ending == Ending::kBadFraming) resyncs_++;
  const bool done = answer.ending == Ending::kDone;
  switch (state_) {
    case State::kListen:
      if (done && answer.bytes[0] == kSelfTestPassed) {
        set_up();
      } else {
        state_ = State::kProbe;
      }
      break;
    case State::kProbe:
      tried_ = true;
      if (done && answer.bytes[0] == kAcknowledge) {
        set_up();
      } else {
        state_ = State::kListen;
      }
      break;
    case State::kReset:
      state_ = State::kListen;
      break;
    case State::kSetUp:
      take_set_up(answer);
      break;
    case State::kPoll:
      take_poll(answer);
      break;
    default:
      take_repeated(answer);
      break;
  }
}

// A set-up that fails leaves the mouse alone until it announces itself or the next probe finds it.
void Ps2Mouse::take_set_up(const Answer& answer) {
  const uint8_t* const bytes = answer.bytes;
  if (answer.ending != Ending::kDone || bytes[0] != kAcknowledge) {
    state_ = State::kListen;
    return;
  }
  if (kSetUp[step_].byte == kReadId) id_ = bytes[1];
  if (++step_ < kSetUpSteps) return;
  if (bytes[1] & kScaling2To1) {
    begin_reset();
    return;
  }
  counts_per_mm_ = static_cast<uint8_t>(1 << (bytes[2] & 3));
  report_rate_hz_ = bytes[3];
  state_ = State::kPoll;
  silent_ = 0;
  bad_packets_ = 0;
  ever_found_ = true;
}

void Ps2Mouse::take_poll(const Answer& answer) {
  const uint8_t in_packet = answer.count > 0 ? answer.count - 1 : 0;
  switch (answer.ending) {
    case Ending::kDone:
      if (answer.bytes[0] != kAcknowledge) return packet_lost();
      return take_packet(answer.bytes + 1);
    case Ending::kBadParity:
      partial_count_ = in_packet;
      memcpy(partial_, answer.bytes + 1, in_packet);
      repeat_ = answer.count == 0 ? 1 + kPacket : kPacket;
      state_ = State::kResend;
      return;
    case Ending::kBadFraming:
      state_ = State::kCollect;
      partial_count_ = 0;
      repeat_ = kPacket;
      return;
    default:
      break;
  }
  // The packet broke off: its last clock was missed, say. A mouse that said nothing is polled again.
  if (answer.count == 0 || answer.bytes[0] != kAcknowledge) {
    if (++silent_ == kSilentLimit) state_ = State::kListen;
    return;
  }
  resyncs_++;
  partial_count_ = in_packet;
  memcpy(partial_, answer.bytes + 1, in_packet);
  repeat_ = kPacket;
  state_ = State::kResend;
}

// After a RESEND most mice repeat the whole packet, others only the byte concerned and what follows it.
void Ps2Mouse::take_repeated(const Answer& answer) {
  const bool whole = answer.ending == Ending::kDone;
  const bool rest = answer.ending == Ending::kTimeout && partial_count_ > 0 && answer.count == kPacket - partial_count_;
  if (answer.ending == Ending::kBadParity && ++bad_packets_ < kBadPacketLimit) {
    if (answer.count > 0) partial_count_ = 0;
    state_ = State::kResend;
    return;
  }
  state_ = State::kPoll;
  if (whole) {
    const uint8_t* const packet = answer.bytes + (repeat_ - kPacket);
    return take_packet(packet);
  }
  if (!rest) return packet_lost();
  memcpy(partial_ + partial_count_, answer.bytes, answer.count);
  take_packet(partial_);
}

void Ps2Mouse::take_packet(const uint8_t* packet) {
  const uint8_t flags = packet[0];
  if (!(flags & kAlwaysSet)) return packet_lost();
  state_ = State::kPoll;
  silent_ = 0;
  bad_packets_ = 0;
  dx_ += packet[1] - (flags & kXNegative ? 0x100 : 0);
  dy_ += packet[2] - (flags & kYNegative ? 0x100 : 0);
  if (flags & kOverflow) overflow_ = true;
}

void Ps2Mouse::packet_lost() {
  resyncs_++;
  if (++bad_packets_ == kBadPacketLimit) begin_reset();
}
