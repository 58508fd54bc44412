// The barometer, a BMP180 (or BMP085) or a BMP280, as a state machine without I/O: it returns the transaction that it needs
// next and is given the result.
//
// Registers and conversion times: Bosch BST-BMP180-DS000, BST-BMP280-DS001. A BMP180 measures one temperature for every
// nine pressures, because the temperature changes slowly; a BMP280 measures both at once. Traffic on the bus disturbs a
// conversion. The caller starts and reads conversions right after the inertial sensor's burst, so that (at 100 Hz,
// oversampling 1) a whole conversion fits into the quiet time before the next burst.
#pragma once
#include <I2cRequest.h>
#include <stdint.h>

class Barometer {
 public:
  // Values of wire::DeviceFamily.
  enum Family : uint8_t { kNone = 0, kBmp180 = 16, kBmp280 = 17 };
  static constexpr uint8_t kWords = 12;

  explicit Barometer(uint8_t oversampling) : oversampling_(oversampling) {}

  // Takes effect with the next conversion.
  void configure(uint8_t oversampling) { oversampling_ = oversampling; }

  // The next transaction wanted now, if any; call finish() before asking again.
  bool next(uint32_t now_us, I2cRequest& request);
  void finish(bool ok, const uint8_t* data, uint32_t now_us);
  // Duration (us) of the conversion that the next transaction starts; 0: it starts none.
  uint32_t conversion_ahead_us() const;

  bool present() const { return present_; }
  bool ever_found() const { return ever_found_; }
  bool settled() const { return present_ || tried_; }
  // Answers with an id that this driver does not support.
  bool unsupported() const { return !present_ && id_ != 0 && family_ == kNone; }
  // Temperature and pressure were both measured since the sensor last answered, or before with the same calibration.
  bool valid() const { return present_ && pressure_known_; }
  uint16_t temperature() const { return temperature_; }  // 16 bits
  uint32_t pressure() const { return pressure_; }
  uint8_t count() const { return count_; }               // of pressures, wraps
  const uint16_t* calibration() const { return calibration_; }  // AC1..MD and 0, or dig_T1..dig_P9
  uint8_t address() const { return address_; }
  uint8_t id() const { return id_; }  // as last read, 0: nothing ever answered
  Family family() const { return family_; }
  uint16_t restarts() const { return restarts_; }
  uint16_t silent() const { return silent_; }  // failed transactions

  // Maximum duration (us) of a pressure conversion of a BMP180 at an oversampling setting.
  static uint32_t pressure_time_us(uint8_t oversampling);

 private:
  enum class State : uint8_t { kIdentify, kCalibrate, kStart, kConvert };

  uint8_t command() const;
  uint32_t conversion_us(uint8_t oversampling) const;
  void identified(uint8_t id, uint32_t now_us);
  bool take_calibration(const uint8_t* data);
  void take_conversion(const uint8_t* data, uint32_t now_us);
  void take_bmp180(const uint8_t* data);
  void take_bmp280(const uint8_t* data);
  void lost(uint32_t now_us);

  State state_ = State::kIdentify;
  Family family_ = kNone;
  uint8_t address_ = 0x77;
  uint8_t id_ = 0;
  uint8_t oversampling_;
  uint8_t converting_oversampling_ = 0;
  uint8_t pressures_left_ = 0;  // until the next temperature of a BMP180; 0: this one is a temperature
  uint8_t count_ = 0;
  bool present_ = false;
  bool tried_ = false;
  bool ever_found_ = false;
  bool temperature_known_ = false;
  bool pressure_known_ = false;
  uint16_t temperature_ = 0;
  uint16_t restarts_ = 0;
  uint16_t silent_ = 0;
  uint32_t pressure_ = 0;
  uint32_t due_us_ = 0;
  uint32_t converting_since_us_ = 0;
  uint16_t calibration_[kWords] = {};
};
