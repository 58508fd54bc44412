#include "Barometer.h"

namespace {

constexpr uint8_t kAddress = 0x77;
constexpr uint8_t kOtherAddress = 0x76;  // of a BMP280 whose SDO is low
constexpr uint8_t kChipId = 0xD0;
constexpr uint8_t kControl = 0xF4;

constexpr uint8_t k180Calibration = 0xAA;  // the result is at kControl + 2
constexpr uint8_t k180Words = 11;
constexpr uint8_t k180Temperature = 0x2E;
constexpr uint8_t k180Pressure = 0x34;
constexpr uint8_t k180ControlMask = 0x1F;  // what is measured; the bits above are Sco and the oversampling
constexpr uint8_t k180Converting = 0x20;   // Sco

constexpr uint8_t k280Calibration = 0x88;
constexpr uint8_t k280Status = 0xF3;     // control at 0xF4, pressure at 0xF7, temperature at 0xFA
constexpr uint8_t k280Measuring = 0x08;
constexpr uint8_t k280Forced = 0x21;     // temperature x1, one measurement; the pressure's oversampling is in bits 4:2
constexpr uint8_t k280ControlMask = 0xFC;

constexpr uint32_t k180TemperatureUs = 4500;
constexpr uint8_t kPressuresPerTemperature = 9;
constexpr uint32_t kRetryUs = 8000;          // a little less than a tick at 100 Hz: once a tick
constexpr uint32_t kSearchUs = 200000;       // between two searches for a sensor that was never found
constexpr uint32_t kStillConvertingUs = 1000;  // until a result that is late is asked for again: at the next tick
constexpr uint32_t kLongestConversionUs = 100000;  // then the sensor is set up again

}  // namespace

uint32_t Barometer::pressure_time_us(uint8_t oversampling) {
  switch (oversampling) {
    case 0: return 4500;
    case 1: return 7500;
    case 2: return 13500;
    default: return 25500;
  }
}

// BST-BMP280-DS001, appendix B: 1.25 ms + 2.3 ms for the temperature + 2.3 ms a pressure + 0.575 ms.
static uint32_t bmp280_time_us(uint8_t oversampling) { return 4125 + (2300UL << oversampling); }

uint8_t Barometer::command() const {
  if (family_ == kBmp280) return static_cast<uint8_t>(k280Forced | (converting_oversampling_ + 1) << 2);
  return pressures_left_ == 0 ? k180Temperature : k180Pressure | converting_oversampling_ << 6;
}

uint32_t Barometer::conversion_us(uint8_t oversampling) const {
  if (family_ == kBmp280) return bmp280_time_us(oversampling);
  return pressures_left_ == 0 ? k180TemperatureUs : pressure_time_us(oversampling);
}

uint32_t Barometer::conversion_ahead_us() const { return state_ == State::kStart ? conversion_us(oversampling_) : 0; }

bool Barometer::next(uint32_t now_us, I2cRequest& request) {
  const bool due = static_cast<int32_t>(now_us - due_us_) >= 0;
  const bool bmp280 = family_ == kBmp280;
  switch (state_) {
    case State::kIdentify: request = I2cRequest::read(address_, kChipId, 1, !ever_found_); return due;
    case State::kCalibrate:
      request = I2cRequest::read(address_, bmp280 ? k280Calibration : k180Calibration,
                                 2 * (bmp280 ? kWords : k180Words));
      return true;
    case State::kStart:
      converting_oversampling_ = oversampling_;
      request = I2cRequest::set(address_, kControl, command());
      return true;
    default:
      request = bmp280 ? I2cRequest::read(address_, k280Status, 10) : I2cRequest::read(address_, kControl, 5);
      return due;
  }
}

void Barometer::finish(bool ok, const uint8_t* data, uint32_t now_us) {
  if (!ok) {
    if (ever_found_) silent_++;
    return lost(now_us);
  }
  switch (state_) {
    case State::kIdentify: identified(data[0], now_us); break;
    case State::kCalibrate:
      if (!take_calibration(data)) return lost(now_us);
      present_ = ever_found_ = true;
      state_ = State::kStart;
      break;
    case State::kStart:
      due_us_ = now_us + conversion_us(converting_oversampling_);
      converting_since_us_ = now_us;
      state_ = State::kConvert;
      break;
    default: take_conversion(data, now_us); break;
  }
}

void Barometer::identified(uint8_t id, uint32_t now_us) {
  if (id == 0 || id == 0xFF) return lost(now_us);
  id_ = id;
  switch (id) {
    case 0x55: family_ = kBmp180; break;
    case 0x56:
    case 0x57:  // samples of the BMP280
    case 0x58:
    case 0x60: family_ = kBmp280; break;  // BME280: the same registers, and a humidity that is not used
    default: family_ = kNone; return lost(now_us);
  }
  state_ = State::kCalibrate;
}

// The data sheet of the BMP180: no word is 0 or 0xFFFF. A BMP280 promises nothing, but a divisor of 0 cannot be. A sensor
// with the known calibration keeps its last temperature, so that one pressure makes it valid again.
bool Barometer::take_calibration(const uint8_t* data) {
  const uint8_t count = family_ == kBmp280 ? kWords : k180Words;
  bool same = true;
  for (uint8_t i = 0; i < kWords; i++) {
    uint16_t word = 0;
    if (i < count) {
      const uint8_t high = family_ == kBmp280 ? data[2 * i + 1] : data[2 * i];
      const uint8_t low = family_ == kBmp280 ? data[2 * i] : data[2 * i + 1];
      word = static_cast<uint16_t>(high << 8 | low);
      const bool checked = family_ == kBmp180 || i == 0 || i == 3;
      if (checked && (word == 0 || word == 0xFFFF)) return false;
    }
    same = same && word == calibration_[i];
    calibration_[i] = word;
  }
  temperature_known_ = temperature_known_ && same;
  pressures_left_ = temperature_known_ ? kPressuresPerTemperature : 0;
  return true;
}

// A clone may convert for longer than the data sheet permits; the old result is in the registers until then.
void Barometer::take_conversion(const uint8_t* data, uint32_t now_us) {
  const bool bmp280 = family_ == kBmp280;
  const uint8_t control = bmp280 ? data[1] : data[0];
  const uint8_t mask = bmp280 ? k280ControlMask : k180ControlMask;
  // A sensor whose supply failed in between answers, but its command register is as after reset.
  if ((control ^ command()) & mask) return lost(now_us);
  if (bmp280 ? data[0] & k280Measuring : control & k180Converting) {
    if (now_us - converting_since_us_ > kLongestConversionUs) return lost(now_us);
    due_us_ = now_us + kStillConvertingUs;
    return;
  }
  if (bmp280) {
    take_bmp280(data + 4);
  } else {
    take_bmp180(data + 2);
  }
  state_ = State::kStart;
}

void Barometer::take_bmp180(const uint8_t* data) {
  if (pressures_left_ == 0) {
    temperature_ = static_cast<uint16_t>(data[0] << 8 | data[1]);
    temperature_known_ = true;
    pressures_left_ = kPressuresPerTemperature;
    return;
  }
  const uint32_t raw = static_cast<uint32_t>(data[0]) << 16 | static_cast<uint16_t>(data[1] << 8 | data[2]);
  pressure_ = raw >> (8 - converting_oversampling_);
  pressure_known_ = true;
  count_++;
  pressures_left_--;
}

void Barometer::take_bmp280(const uint8_t* data) {
  pressure_ = (static_cast<uint32_t>(data[0]) << 16 | static_cast<uint16_t>(data[1] << 8 | data[2])) >> 4;
  temperature_ = static_cast<uint16_t>(data[3] << 8 | data[4]);
  temperature_known_ = pressure_known_ = true;
  count_++;
}

void Barometer::lost(uint32_t now_us) {
  if (present_) restarts_++;
  // The other address is tried only while nothing was ever found.
  if (!ever_found_) address_ = address_ == kAddress ? kOtherAddress : kAddress;
  tried_ = tried_ || address_ == kAddress || ever_found_;
  present_ = false;
  pressure_known_ = false;
  state_ = State::kIdentify;
  due_us_ = now_us + (ever_found_ || address_ == kOtherAddress ? kRetryUs : kSearchUs);
}
