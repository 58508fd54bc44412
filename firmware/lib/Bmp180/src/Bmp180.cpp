#include "Bmp180.h"

namespace {

enum Register : uint8_t { kCalibration = 0xAA, kChipId = 0xD0, kControl = 0xF4 };  // the result stands at kControl + 2
constexpr uint8_t kMeasureTemperature = 0x2E;
constexpr uint8_t kMeasurePressure = 0x34;
constexpr uint8_t kControlMask = 0x1F;  // what is measured; the bits above are "busy" and the oversampling

constexpr uint32_t kTemperatureUs = 4500;
constexpr uint8_t kPressuresPerTemperature = 9;
constexpr uint32_t kRetryUs = 8000;  // a little less than a tick at 100 Hz: once a tick

}  // namespace

uint32_t Bmp180::pressure_time_us(uint8_t oversampling) {
  switch (oversampling) {
    case 0: return 4500;
    case 1: return 7500;
    case 2: return 13500;
    default: return 25500;
  }
}

uint8_t Bmp180::command() const {
  return pressures_left_ == 0 ? kMeasureTemperature : kMeasurePressure | converting_oversampling_ << 6;
}

uint32_t Bmp180::conversion_us(uint8_t oversampling) const {
  return pressures_left_ == 0 ? kTemperatureUs : pressure_time_us(oversampling);
}

uint32_t Bmp180::conversion_ahead_us() const { return state_ == State::kStart ? conversion_us(oversampling_) : 0; }

bool Bmp180::next(uint32_t now_us, I2cRequest& request) {
  const bool due = static_cast<int32_t>(now_us - due_us_) >= 0;
  switch (state_) {
    case State::kIdentify: request = I2cRequest::read(kAddress, kChipId, 1); return due;
    case State::kCalibrate: request = I2cRequest::read(kAddress, kCalibration, 2 * kCalibrationWords); return true;
    case State::kStart:
      converting_oversampling_ = oversampling_;
      request = I2cRequest::set(kAddress, kControl, command());
      return true;
    default: request = I2cRequest::read(kAddress, kControl, 5); return due;
  }
}

void Bmp180::finish(bool ok, const uint8_t* data, uint32_t now_us) {
  if (!ok) return lost(now_us);
  switch (state_) {
    case State::kIdentify:
      if (data[0] != kId) return lost(now_us);
      state_ = State::kCalibrate;
      break;
    case State::kCalibrate:
      if (!take_calibration(data)) return lost(now_us);
      present_ = ever_found_ = true;
      state_ = State::kStart;
      break;
    case State::kStart:
      due_us_ = now_us + conversion_us(converting_oversampling_);
      state_ = State::kConvert;
      break;
    default:
      // A sensor that lost its supply since answers, but has forgotten what it was to measure.
      if ((data[0] ^ command()) & kControlMask) return lost(now_us);
      take_result(data);
      state_ = State::kStart;
      break;
  }
}

// The datasheet: none of the words is 0 or 0xFFFF. A sensor with the calibration we know keeps its last temperature, so
// that one pressure makes it valid again; any other one begins anew.
bool Bmp180::take_calibration(const uint8_t* data) {
  bool same = true;
  for (uint8_t i = 0; i < kCalibrationWords; i++) {
    const uint16_t word = static_cast<uint16_t>(data[2 * i] << 8 | data[2 * i + 1]);
    if (word == 0 || word == 0xFFFF) return false;
    same = same && word == calibration_[i];
    calibration_[i] = word;
  }
  temperature_known_ = temperature_known_ && same;
  pressures_left_ = temperature_known_ ? kPressuresPerTemperature : 0;
  return true;
}

void Bmp180::take_result(const uint8_t* data) {
  if (pressures_left_ == 0) {
    temperature_ = static_cast<uint16_t>(data[2] << 8 | data[3]);
    temperature_known_ = true;
    pressures_left_ = kPressuresPerTemperature;
    return;
  }
  const uint32_t raw = static_cast<uint32_t>(data[2]) << 16 | static_cast<uint16_t>(data[3] << 8 | data[4]);
  pressure_ = raw >> (8 - converting_oversampling_);
  pressure_known_ = true;
  count_++;
  pressures_left_--;
}

void Bmp180::lost(uint32_t now_us) {
  if (present_) restarts_++;
  tried_ = true;
  present_ = false;
  pressure_known_ = false;
  state_ = State::kIdentify;
  due_us_ = now_us + kRetryUs;
}
