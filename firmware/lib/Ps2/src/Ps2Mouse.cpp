#include "Ps2Mouse.h"

#include <string.h>

#ifdef __AVR__
#include <avr/pgmspace.h>
#else
#define PROGMEM
#define memcpy_P memcpy
#endif

namespace {

enum Command : uint8_t {
  kScaling1To1 = 0xE6,
  kSetResolution = 0xE8,
  kStatus = 0xE9,
  kStreamMode = 0xEA,
  kReadData = 0xEB,
  kRemoteMode = 0xF0,
  kReadId = 0xF2,
  kSetReportRate = 0xF3,
  kEnable = 0xF4,
  kSetDefaults = 0xF6,
  kResendLast = 0xFE,
  kResetMouse = 0xFF,
};
constexpr uint8_t kAcknowledge = Ps2Bits::kAcknowledge;
constexpr uint8_t kResendAnswer = 0xFE;
constexpr uint8_t kErrorAnswer = 0xFC;
constexpr uint8_t kSelfTestPassed = 0xAA;

// The highest rate. Some mice read their sensor at the report rate, also in remote mode: at 100 Hz it beats with polls at
// 100 Hz, which makes the counts of a constant speed vary by 9 to 13 % (emulated board). At 200 Hz the variation is half.
constexpr uint8_t kReportRateHz = 200;
// What SET_DEFAULTS sets.
constexpr uint8_t kDefaultRateHz = 100;
constexpr uint8_t kDefaultCountsPerMm = 4;

// The first byte of a packet.
constexpr uint8_t kAlwaysSet = 0x08;
constexpr uint8_t kXNegative = 0x10;
constexpr uint8_t kYNegative = 0x20;
constexpr uint8_t kOverflow = 0xC0;
constexpr uint8_t kPacket = 3;

// The first byte of the answer to STATUS.
constexpr uint8_t kInRemoteMode = 0x40;
constexpr uint8_t kEnabled = 0x20;

// The set-up. An argument follows its command. A mouse without a `required` command does not work.
enum Argument : uint8_t { kResolutionArgument = 0, kRateArgument = 1 };
struct Step {
  uint8_t byte;
  uint8_t answers;
  uint8_t lack;
  bool required;
  bool argument;
};
constexpr Step kSteps[] PROGMEM = {
    {kSetDefaults, 1, 0, true, false},
    {kReadId, 2, 0, false, false},
    {kScaling1To1, 1, 0, false, false},
    {kSetResolution, 1, Ps2Mouse::kLacksResolution, false, false},
    {kResolutionArgument, 1, Ps2Mouse::kLacksResolution, false, true},
    {kSetReportRate, 1, Ps2Mouse::kLacksSampleRate, false, false},
    {kRateArgument, 1, Ps2Mouse::kLacksSampleRate, false, true},
    {kRemoteMode, 1, Ps2Mouse::kLacksRemoteMode, false, false},
    {kEnable, 1, Ps2Mouse::kLacksEnable, false, false},
    {kStatus, 1 + kPacket, Ps2Mouse::kLacksStatus, false, false},
};
constexpr uint8_t kStepCount = sizeof kSteps / sizeof kSteps[0];
constexpr uint8_t kModeStep = 7;

Step step_at(uint8_t number) {
  Step step;
  memcpy_P(&step, &kSteps[number], sizeof step);
  return step;
}

// Time limits. The protocol allows a mouse 15 ms to the first clock of a request, 2 ms for the byte and 20 ms to the answer.
constexpr uint16_t kAnswerMs = 50;
constexpr uint16_t kNextMs = 25;
constexpr uint16_t kPowerOnMs = 1000;  // the self-test usually takes 300 to 500 ms; an empty port is probed once a second
constexpr uint16_t kRepeatedMs = 8;    // between two bytes of a repeated packet, which is ready; a byte takes 1.1 ms
constexpr uint16_t kGatedMs = 8;       // a report in stream mode is at most 5 ms away at 200 Hz; its first byte 1.1 ms
constexpr uint8_t kTries = 3;             // of a command: the first and two repetitions
constexpr uint8_t kSilentTries = 2;       // of a command without any answer
constexpr uint8_t kSilentLimit = 3;       // polls without an answer: the mouse is absent
constexpr uint8_t kSilentSetUpLimit = 6;  // three commands without an answer: the mouse is absent
constexpr uint8_t kRefusedLimit = 3;      // polls refused: remote mode does not work
constexpr uint8_t kQuietLimit = 50;       // rounds without a packet in stream mode: check that the mouse is there
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

Ps2Mouse::Ps2Mouse(uint8_t counts_per_mm)
    : wanted_resolution_(counts_per_mm),
      repeats_answer_(false),
      self_testing_(false),
      no_remote_mode_(false),
      stream_(false),
      set_up_wanted_(false),
      reset_wanted_(false),
      probed_(false),
      ever_found_(false),
      overflow_(false),
      answered_(false),
      has_baseline_(false),
      measured_(false) {}

void Ps2Mouse::configure(uint8_t counts_per_mm) {
  wanted_resolution_ = counts_per_mm;
  set_up_wanted_ = true;
}

void Ps2Mouse::set_up() {
  state_ = State::kSetUp;
  go_to_step(0);
  silent_ = 0;
  lacks_ = no_remote_mode_ ? kLacksRemoteMode : 0;
  status_ = 0;
  stream_ = no_remote_mode_;
  self_testing_ = false;
  measured_ = has_baseline_ = false;
}

void Ps2Mouse::go_to_step(uint8_t step) {
  step_ = step;
  tries_ = 0;
  repeats_answer_ = false;
}

void Ps2Mouse::begin_reset() {
  resets_++;
  bad_packets_ = 0;
  silent_ = 0;
  no_remote_mode_ = false;
  state_ = State::kReset;
}

uint8_t Ps2Mouse::set_up_byte() const {
  const Step step = step_at(step_);
  if (step.argument) return step.byte == kResolutionArgument ? resolution_code(wanted_resolution_) : kReportRateHz;
  return step_ == kModeStep && stream_ ? uint8_t{kStreamMode} : step.byte;
}

Ps2Mouse::Presence Ps2Mouse::presence() const {
  if (running()) return Presence::kRunning;
  if (state_ >= State::kReset || self_testing_ || !probed_) return Presence::kStarting;
  return ever_found_ ? Presence::kLost : Presence::kAbsent;
}

Ps2Mouse::Request Ps2Mouse::next() {
  if (set_up_wanted_ && state_ >= State::kSetUp) set_up();
  if (reset_wanted_) begin_reset();
  set_up_wanted_ = reset_wanted_ = false;
  switch (state_) {
    case State::kListen: return {false, 0, 2, false, kPowerOnMs, kNextMs};
    case State::kProbe: return {true, kSetDefaults, 1, true, kAnswerMs, kNextMs};
    case State::kReset: return {true, kResetMouse, 1, true, kAnswerMs, kNextMs};
    case State::kSetUp:
      if (repeats_answer_) return {true, kResendLast, 1, true, kAnswerMs, kNextMs};
      return {true, set_up_byte(), step_at(step_).answers, true, kAnswerMs, kNextMs};
    case State::kPoll:
      if (!stream_) return {true, kReadData, 1 + kPacket, true, kAnswerMs, kNextMs};
      if (quiet_ >= kQuietLimit) return {true, kEnable, 1, true, kAnswerMs, kNextMs};
      return {false, 0, kPacket, false, kGatedMs, kRepeatedMs};
    case State::kResend: return {true, kResendLast, repeat_, false, kAnswerMs, kRepeatedMs};
    default: return {false, 0, kPacket, false, kAnswerMs, kRepeatedMs};
  }
}

void Ps2Mouse::finish(const Answer& answer) {
  if (answer.ending == Ending::kBadParity) parity_errors_++;
  if (answer.ending == Ending::kBadFraming) resyncs_++;
  switch (state_) {
    case State::kListen: return take_listen(answer);
    case State::kProbe: return take_probe(answer);
    case State::kReset:
      self_testing_ = answer.ending == Ending::kDone;
      state_ = State::kListen;
      return;
    case State::kSetUp: return take_set_up(answer);
    case State::kPoll: return stream_ ? take_gated_packet(answer) : take_poll(answer);
    default: return take_repeated(answer);
  }
}

void Ps2Mouse::take_listen(const Answer& answer) {
  if (answer.ending != Ending::kDone || answer.bytes[0] != kSelfTestPassed) {
    self_testing_ = false;
    state_ = State::kProbe;
    tries_ = 0;
    return;
  }
  no_remote_mode_ = false;
  set_up();
}

void Ps2Mouse::take_probe(const Answer& answer) {
  if (answer.ending == Ending::kDone) {
    probed_ = true;
    return set_up();
  }
  if (answer.ending != Ending::kTimeout && ++tries_ < kTries) return;
  probed_ = true;
  state_ = State::kListen;
}

void Ps2Mouse::take_set_up(const Answer& answer) {
  if (answer.ending == Ending::kDone) return take_step(answer.bytes);
  if (answer.ending == Ending::kRefused && answer.bytes[0] == kSelfTestPassed) return set_up();  // it was reset
  retry_step(answer);
}

void Ps2Mouse::take_step(const uint8_t* bytes) {
  const uint8_t byte = step_at(step_).byte;
  if (byte == kReadId) id_ = bytes[1];
  if (byte == kStatus) return take_status(bytes + 1);
  go_to_step(step_ + 1);
}

void Ps2Mouse::take_status(const uint8_t* bytes) {
  status_ = bytes[0];
  if (!stream_ && !(status_ & kInRemoteMode)) return use_stream_mode();
  if (!(status_ & kEnabled)) lacks_ |= kLacksEnable;
  counts_per_mm_ = static_cast<uint8_t>(1 << (bytes[1] & 3));
  report_rate_hz_ = bytes[2];
  if (counts_per_mm_ != wanted_resolution_) lacks_ |= kLacksResolution;
  if (report_rate_hz_ != kReportRateHz) lacks_ |= kLacksSampleRate;
  finish_set_up();
}

void Ps2Mouse::use_stream_mode() {
  stream_ = no_remote_mode_ = true;
  lacks_ |= kLacksRemoteMode;
  go_to_step(kModeStep);
}

void Ps2Mouse::retry_step(const Answer& answer) {
  const Step step = step_at(step_);
  const bool silent = answer.ending == Ending::kTimeout;
  if (silent && ++silent_ >= kSilentSetUpLimit) {
    state_ = State::kListen;
    return;
  }
  if (++tries_ >= (silent ? kSilentTries : kTries)) return skip_step();
  // The mouse has obeyed: only its acknowledgement is requested again, as an argument must not be sent twice.
  repeats_answer_ = answer.ending == Ending::kBadParity && step.answers == 1;
  // After ERROR or silence a mouse no longer waits for the argument.
  const bool error = answer.ending == Ending::kRefused && answer.bytes[0] == kErrorAnswer;
  if ((silent || error) && step.argument) step_--;
}

void Ps2Mouse::skip_step() {
  const Step step = step_at(step_);
  lacks_ |= step.lack;
  if (step.required) {
    state_ = State::kListen;
    return;
  }
  if (step.byte == kRemoteMode) {
    if (stream_) return go_to_step(kModeStep + 1);  // stream mode is the default, also where 0xEA is refused
    return use_stream_mode();
  }
  if (step.byte == kStatus) {
    counts_per_mm_ = lacks_ & kLacksResolution ? kDefaultCountsPerMm : wanted_resolution_;
    report_rate_hz_ = lacks_ & kLacksSampleRate ? kDefaultRateHz : kReportRateHz;
    return finish_set_up();
  }
  const uint8_t next = step_ + 1;
  go_to_step(step_at(next).argument ? next + 1 : next);
}

void Ps2Mouse::finish_set_up() {
  state_ = State::kPoll;
  silent_ = refused_ = quiet_ = bad_packets_ = 0;
  ever_found_ = true;
}

void Ps2Mouse::take_poll(const Answer& answer) {
  const uint8_t in_packet = answer.count > 0 ? answer.count - 1 : 0;
  switch (answer.ending) {
    case Ending::kDone: return take_packet(answer.bytes + 1);
    case Ending::kRefused: return take_refused_poll(answer.bytes[0]);
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
  if (answer.count == 0) return count_silence();
  // The packet ended early, for example because a clock was missed.
  resyncs_++;
  partial_count_ = in_packet;
  memcpy(partial_, answer.bytes + 1, in_packet);
  repeat_ = kPacket;
  state_ = State::kResend;
}

// A refused poll leaves the counts in the mouse: the next round reads them.
void Ps2Mouse::take_refused_poll(uint8_t answer) {
  if (answer == kSelfTestPassed) return set_up();  // it was unplugged and plugged in again
  if (answer != kResendAnswer && answer != kErrorAnswer) return packet_lost();
  if (++refused_ < kRefusedLimit) return;
  no_remote_mode_ = true;
  set_up();
}

void Ps2Mouse::count_silence() {
  if (++silent_ >= kSilentLimit) {
    tries_ = 0;
    state_ = State::kProbe;
  }
}

// In stream mode a mouse that does not move sends nothing.
void Ps2Mouse::take_gated_packet(const Answer& answer) {
  if (quiet_ >= kQuietLimit) {
    if (answer.ending != Ending::kDone) return count_silence();
    quiet_ = 0;
    return take_answer();
  }
  if (answer.ending == Ending::kDone) {
    quiet_ = 0;
    if (answer.bytes[0] == kSelfTestPassed) return set_up();
    return take_packet(answer.bytes);
  }
  if (answer.ending == Ending::kTimeout && answer.count == 0) {
    quiet_++;
    return take_answer();
  }
  partial_count_ = answer.count;
  memcpy(partial_, answer.bytes, answer.count);
  repeat_ = kPacket;
  state_ = answer.ending == Ending::kBadFraming ? State::kCollect : State::kResend;
}

// After RESEND most mice repeat the whole packet; others repeat only the byte concerned and what follows it.
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
  take_answer();
  if (!has_baseline_) return;  // since an unknown time
  dx_ += packet[1] - (flags & kXNegative ? 0x100 : 0);
  dy_ += packet[2] - (flags & kYNegative ? 0x100 : 0);
  if (flags & kOverflow) overflow_ = true;
}

void Ps2Mouse::take_answer() {
  state_ = State::kPoll;
  silent_ = refused_ = bad_packets_ = 0;
  answered_ = true;
}

// Counts are missing: the mouse is invalid until its counter has been read at the end of a complete round.
void Ps2Mouse::packet_lost() {
  resyncs_++;
  measured_ = has_baseline_ = false;
  if (++bad_packets_ == kBadPacketLimit) begin_reset();
}
