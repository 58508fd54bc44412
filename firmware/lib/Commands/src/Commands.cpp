#include "Commands.h"

#include <string.h>

namespace commands {
namespace {

using wire::NakReason;

constexpr NakReason kFine = static_cast<NakReason>(0);

bool is_one_of(uint16_t value, uint16_t first, uint16_t last) {
  for (uint16_t allowed = first; allowed <= last; allowed *= 2) {
    if (value == allowed) return true;
  }
  return false;
}

NakReason check(const wire::Configure& c, const Board& board) {
  if (board.streaming()) return NakReason::kStreaming;
  if (c.sample_rate_hz < kMinRateHz || c.sample_rate_hz > kMaxRateHz || kTimerHz % c.sample_rate_hz != 0) {
    return NakReason::kSampleRateOutOfRange;
  }
  if (!is_one_of(c.accel_range_g, 2, 16)) return NakReason::kAccelRangeOutOfRange;
  if (!is_one_of(c.gyro_range_deg_s, 250, 2000)) return NakReason::kGyroRangeOutOfRange;
  if (c.dlpf > 6) return NakReason::kDlpfOutOfRange;
  if (c.baro_oversampling > 3) return NakReason::kBaroOversamplingOutOfRange;
  if (!is_one_of(c.mouse_counts_per_mm, 1, 8)) return NakReason::kMouseResolutionOutOfRange;
  const bool slow_bus = c.i2c_khz == 100 && c.sample_rate_hz <= kMaxSlowBusHz;
  if (!slow_bus && c.i2c_khz != 400) return NakReason::kI2cClockOutOfRange;
  if (!line_carries(c.sample_rate_hz, board.sample_size())) return NakReason::kLinkTooSlow;
  return kFine;
}

NakReason configure(const uint8_t* body, Board& board) {
  wire::Configure settings;
  memcpy(&settings, body, sizeof settings);
  const NakReason reason = check(settings, board);
  if (reason == kFine) board.configure(settings);
  return reason;
}

NakReason start(uint16_t rate_hz, Board& board) {
  // Mice or sensors may have been found since the rate was set.
  if (!line_carries(rate_hz, board.sample_size())) return NakReason::kLinkTooSlow;
  if (!board.streaming()) board.start();
  return kFine;
}

NakReason reset_mice(const uint8_t* body, Board& board) {
  const uint8_t ports = body[0];
  if (ports == 0 || ports >> board.mouse_ports() != 0) return NakReason::kMousePortOutOfRange;
  board.reset_mice(ports);
  return kFine;
}

NakReason self_test(const uint8_t* body, Board& board) {
  const uint8_t device = body[0];
  if (board.streaming()) return NakReason::kStreaming;
  if (device > 1 || !board.imu_present(device)) return NakReason::kSensorAbsent;
  board.self_test(device);
  return kFine;
}

// Length of a command's body, -1 for an unknown command.
int16_t body_size(uint8_t type) {
  switch (type) {
    case wire::GetInfo::kType: return wire::GetInfo::kSize;
    case wire::Configure::kType: return wire::Configure::kSize;
    case wire::Start::kType: return wire::Start::kSize;
    case wire::Stop::kType: return wire::Stop::kSize;
    case wire::Ping::kType: return wire::Ping::kSize;
    case wire::ResetMice::kType: return wire::ResetMice::kSize;
    case wire::SelfTest::kType: return wire::SelfTest::kSize;
    default: return -1;
  }
}

}  // namespace

bool line_carries(uint16_t rate_hz, uint8_t sample_size) {
  constexpr uint8_t kOverhead = 5;  // type, CRC, COBS code, delimiter
  constexpr uint32_t kBytesPerSecond = wire::kBaud / 10;
  constexpr uint32_t kForTheRest = kBytesPerSecond / 20;
  return static_cast<uint32_t>(rate_hz) * (sample_size + kOverhead) <= kBytesPerSecond - kForTheRest;
}

void carry_out(uint8_t type, const uint8_t* body, uint8_t size, Board& board) {
  const int16_t expected = body_size(type);
  if (expected < 0) return board.refuse(type, NakReason::kUnknownCommand);
  if (size != expected) return board.refuse(type, NakReason::kBadLength);

  NakReason reason = kFine;
  switch (type) {
    case wire::GetInfo::kType: return board.send_hello();
    case wire::Ping::kType: {
      uint32_t token;
      memcpy(&token, body, sizeof token);
      return board.send_pong(token);
    }
    case wire::Configure::kType: reason = configure(body, board); break;
    case wire::Start::kType: reason = start(board.sample_rate_hz(), board); break;
    case wire::Stop::kType: board.stop(); break;
    case wire::ResetMice::kType: reason = reset_mice(body, board); break;
    default: reason = self_test(body, board); break;
  }
  if (reason != kFine) return board.refuse(type, reason);
  board.acknowledge(type);
}

}  // namespace commands
