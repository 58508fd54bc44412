// The MPU-6050 as a state machine without I/O: it says which transaction it wants, and is told how it ended.
//
// Register names and meanings: InvenSense RM-MPU-6000A-00 (register map), start-up times: PS-MPU-6000A-00.
// The 14-byte burst that is read at every tick is not asked for here: the tick itself starts it (see Twi), as long as
// wants_burst() says so, and accept_burst() judges what it brought.
#pragma once
#include <I2cRequest.h>
#include <stdint.h>

class Mpu6050 {
 public:
  static constexpr uint8_t kAddress = 0x68;
  static constexpr uint8_t kBurstRegister = 0x3B;  // ACCEL_XOUT_H
  static constexpr uint8_t kBurstLength = 14;

  struct Settings {
    uint8_t accel_range_g;
    uint16_t gyro_range_deg_s;
    uint8_t dlpf;
  };
  struct Reading {
    int16_t accel[3];
    int16_t temperature;
    int16_t gyro[3];
    bool valid;
    bool accel_saturated;
    bool gyro_saturated;
  };
  struct SelfTest {
    uint8_t trim[4];
    int16_t plain[6];  // mean accel x, y, z, gyro x, y, z, self-test off
    int16_t excited[6];
  };

  explicit Mpu6050(const Settings& settings) : settings_(settings) {}

  // Both not while a transaction runs. The sensor is set up again; a self-test that runs is given up.
  void configure(const Settings& settings);
  void start_self_test();
  // True once for each self-test that came to its end.
  bool take_self_test(SelfTest& result);

  // The next transaction wanted now, if any; finish() must be called before it is asked again.
  bool next(uint32_t now_us, I2cRequest& request);
  void finish(bool ok, const uint8_t* data, uint32_t now_us);

  bool wants_burst() const { return state_ >= State::kSettle; }
  void accept_burst(bool ok, const uint8_t* data, uint32_t now_us, Reading& reading);

  bool present() const { return id_ != 0; }
  bool ever_found() const { return was_running_; }
  // Set up, or found absent: HELLO can be sent.
  bool settled() const { return was_running_ || tried_; }
  uint8_t id() const { return id_; }
  uint16_t restarts() const { return restarts_; }

 private:
  enum class State : uint8_t {
    kReset,
    kIdentify,
    kTrim,     // reads the factory trim for the self-test
    kSetUp,    // writes the settings, register by register
    kSettle,   // burst is read, not yet believed
    kRun,
    kCheckPower,   // still running? a sensor that lost its supply for a moment has not the settings it was given
    kCheckRanges,
  };
  enum class Test : uint8_t { kOff, kPlain, kExcited };

  bool due(uint32_t now_us) const { return static_cast<int32_t>(now_us - due_us_) >= 0; }
  uint8_t setting(uint8_t index) const;
  void run(uint32_t now_us);
  void set_up();
  void set_up_again();
  void identify_after(uint32_t now_us, uint32_t us);
  void lost(uint32_t now_us);
  void average(const Reading& reading);

  Settings settings_;
  State state_ = State::kReset;
  Test test_ = Test::kOff;
  bool was_running_ = false;
  bool tried_ = false;
  bool test_ready_ = false;
  uint8_t step_ = 0;
  uint8_t id_ = 0;
  uint8_t averaged_ = 0;
  uint16_t restarts_ = 0;
  uint32_t due_us_ = 0;
  int32_t sums_[6];
  SelfTest self_test_;
};
