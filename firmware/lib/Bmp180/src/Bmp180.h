// The BMP180 as a state machine without I/O: it says which transaction it wants, and is told how it ended.
//
// Registers and conversion times: Bosch BST-BMP180-DS000. One temperature is measured for every nine pressures, as it
// changes slowly. Traffic on the bus disturbs a conversion; who runs this one starts and reads conversions right after
// the IMU's burst, so that (at 100 Hz, oversampling 1) all of a conversion lies in the quiet gap before the next burst.
#pragma once
#include <I2cRequest.h>
#include <stdint.h>

class Bmp180 {
 public:
  static constexpr uint8_t kAddress = 0x77;
  static constexpr uint8_t kId = 0x55;
  static constexpr uint8_t kCalibrationWords = 11;

  explicit Bmp180(uint8_t oversampling) : oversampling_(oversampling) {}

  // Takes effect with the next conversion.
  void configure(uint8_t oversampling) { oversampling_ = oversampling; }

  // The next transaction wanted now, if any; finish() must be called before it is asked again.
  bool next(uint32_t now_us, I2cRequest& request);
  void finish(bool ok, const uint8_t* data, uint32_t now_us);
  // How long the conversion takes that the next transaction starts, us; 0 when it starts none.
  uint32_t conversion_ahead_us() const;

  bool present() const { return present_; }
  bool ever_found() const { return ever_found_; }
  bool settled() const { return present_ || tried_; }
  // Temperature and pressure were both measured since the sensor last answered, or before with the same calibration.
  bool valid() const { return present_ && pressure_known_; }
  uint16_t temperature() const { return temperature_; }  // UT
  uint32_t pressure() const { return pressure_; }        // UP
  uint8_t count() const { return count_; }               // of pressures, wraps
  const uint16_t* calibration() const { return calibration_; }  // AC1..MD
  uint16_t restarts() const { return restarts_; }

  // Longest conversion in us at an oversampling setting.
  static uint32_t pressure_time_us(uint8_t oversampling);

 private:
  enum class State : uint8_t { kIdentify, kCalibrate, kStart, kConvert };

  uint8_t command() const;
  uint32_t conversion_us(uint8_t oversampling) const;
  void lost(uint32_t now_us);
  bool take_calibration(const uint8_t* data);
  void take_result(const uint8_t* data);

  State state_ = State::kIdentify;
  uint8_t oversampling_;
  uint8_t converting_oversampling_ = 0;
  uint8_t pressures_left_ = 0;  // until the next temperature; 0: this one is a temperature
  uint8_t count_ = 0;
  bool present_ = false;
  bool tried_ = false;
  bool ever_found_ = false;
  bool temperature_known_ = false;
  bool pressure_known_ = false;
  uint16_t temperature_ = 0;
  uint16_t restarts_ = 0;
  uint32_t pressure_ = 0;
  uint32_t due_us_ = 0;
  uint16_t calibration_[kCalibrationWords] = {};
};
