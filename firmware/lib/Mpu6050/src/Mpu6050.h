// An inertial sensor of the MPU-6050's kind as a state machine without I/O: it returns the transaction it needs next and
// is given the result.
//
// Registers: InvenSense RM-MPU-6000A-00 and RM-MPU-6500A-00; start-up times: PS-MPU-6000A-00.
// The 14-byte burst of every tick is not requested here: the tick itself starts it (see Twi) while wants_burst() is
// true, and accept_burst() checks the result.
#pragma once
#include <I2cRequest.h>
#include <stdint.h>

#include "ImuFamily.h"

class Mpu6050 {
 public:
  static constexpr uint8_t kAddress = 0x68;
  static constexpr uint8_t kSecondAddress = 0x69;  // with AD0 high
  static constexpr uint8_t kBurstRegister = 0x3B;  // ACCEL_XOUT_H
  static constexpr uint8_t kBurstLength = 14;

  struct Settings {
    uint8_t accel_range_g;
    uint16_t gyro_range_deg_s;
    uint8_t dlpf;
  };
  // Why a reading is invalid. The order is that of the counters.
  enum class Cause : uint8_t { kSilent, kBlank, kFrozen, kOutOfRange, kStarting, kNone };
  static constexpr uint8_t kCounted = 4;  // causes with a counter

  struct Reading {
    int16_t accel[3];
    int16_t temperature;
    int16_t gyro[3];
    bool valid;
    bool accel_saturated;
    bool gyro_saturated;
    Cause cause;
  };
  struct SelfTest {
    uint8_t trim[6];
    int16_t plain[6];  // mean accel x, y, z, gyro x, y, z, self-test off
    int16_t excited[6];
  };

  Mpu6050(uint8_t address, const Settings& settings) : address_(address), settings_(settings) {}

  // Call neither while a transaction runs. The sensor is set up again; a self-test in progress is abandoned.
  void configure(const Settings& settings);
  void start_self_test();
  // True once for each completed self-test.
  bool take_self_test(SelfTest& result);

  // The next transaction wanted now, if any; call finish() before asking again.
  bool next(uint32_t now_us, I2cRequest& request);
  void finish(bool ok, const uint8_t* data, uint32_t now_us);

  bool wants_burst() const { return state_ >= State::kSettle; }
  void accept_burst(bool ok, const uint8_t* data, uint32_t now_us, Reading& reading);
  // The tick had no burst because the sensor is absent or being set up.
  void skip_burst(Reading& reading);

  uint8_t address() const { return address_; }
  bool present() const { return present_; }
  bool ever_found() const { return was_running_; }
  // Set up, or found absent: HELLO can be sent.
  bool settled() const { return was_running_ || tried_; }
  // Runs, with the settings written: the magnetometer behind it can be reached.
  bool running() const { return state_ >= State::kSettle; }
  bool unsupported() const { return unsupported_; }
  bool healthy() const { return running() && cause_ == Cause::kNone; }
  uint8_t id() const { return id_; }  // as last read, 0: nothing ever answered
  const ImuFamily& family() const { return family_; }
  uint16_t restarts() const { return restarts_; }
  uint16_t invalid(uint8_t cause) const { return invalid_[cause]; }

 private:
  enum class State : uint8_t {
    kReset,
    kIdentify,
    kTrim,    // reads the factory trim for the self-test
    kSetUp,   // writes the settings, register by register
    kVerify,  // reads them back
    kSettle,  // bursts are read, but not yet valid
    kRun,
    kCheckPower,  // still running? a sensor whose supply failed for a moment has lost its settings
    kCheckRanges,
  };
  enum class Test : uint8_t { kOff, kPlain, kExcited };

  bool due(uint32_t now_us) const { return static_cast<int32_t>(now_us - due_us_) >= 0; }
  bool writes(uint8_t index) const;
  uint8_t setting(uint8_t index) const;
  bool settings_kept(const uint8_t* data) const;
  void identified(uint8_t id, uint32_t now_us);
  void take_trim(const uint8_t* data);
  void verified(bool kept, uint32_t now_us);
  void run(uint32_t now_us);
  void set_up();
  void set_up_again();
  void identify_after(uint32_t now_us, uint32_t us);
  void lost(uint32_t now_us);
  Cause judge(const uint8_t* data, uint32_t now_us, Reading& reading);
  bool frozen(const uint8_t* data, uint32_t now_us);
  bool possible(const Reading& reading) const;
  void note(Cause cause, Reading& reading);
  void average(const Reading& reading);

  uint8_t address_;
  Settings settings_;
  State state_ = State::kReset;
  Test test_ = Test::kOff;
  Cause cause_ = Cause::kStarting;  // of the latest tick
  bool present_ = false;
  bool was_running_ = false;
  bool tried_ = false;
  bool unsupported_ = false;
  bool test_ready_ = false;
  uint8_t step_ = 0;
  uint8_t id_ = 0;
  uint8_t averaged_ = 0;
  ImuFamily family_ = ImuFamily::of(0);
  uint16_t restarts_ = 0;
  uint16_t invalid_[kCounted] = {};
  uint32_t due_us_ = 0;
  uint16_t last_burst_ = 0;  // checksum
  uint32_t changed_us_ = 0;  // when the burst was last another one
  // One sensor at a time is tested.
  static int32_t sums_[6];
  static SelfTest self_test_;
};
