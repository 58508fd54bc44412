// What happens between two ticks: the sampler waits for the bursts of the inertial sensors, then gives the bus to the
// drivers in turn, then makes the SAMPLE. From there to the next tick the bus is quiet, for the barometer's conversion.
#pragma once
#include <Barometer.h>
#include <Clock.h>
#include <Magnetometer.h>
#include <Messages.h>
#include <Mpu6050.h>

#include "Mice.h"

class Sampler {
 public:
  static constexpr uint8_t kImus = 2;

  Sampler(const wire::Configure& settings, Mice& mice);

  void run();

  void configure(const wire::Configure& settings);
  void start();
  // No SAMPLE follows, not even that of the present tick.
  void stop() { streaming_ = sample_due_ = false; }
  void self_test(uint8_t device) { self_test_due_ = device; }

  const wire::Configure& settings() const { return settings_; }
  bool streaming() const { return streaming_; }
  bool sensors_settled() const {
    return imus_[0].settled() && imus_[1].settled() && baro_.settled() && mag_.settled();
  }
  bool healthy() const { return imus_[0].healthy() && baro_.present(); }
  uint32_t ticks_missed() const { return ticks_missed_; }
  // Of the next SAMPLE: HELLO's field `sections`, and the size of the body.
  uint8_t sections() const;
  uint8_t sample_size() const;
  void describe(wire::Hello::Device* devices) const;
  void count(wire::Status::Device* devices) const;
  const Mpu6050& imu(uint8_t number) const { return imus_[number]; }
  const Barometer& baro() const { return baro_; }

 private:
  // In the order in which the drivers get the bus.
  enum class Phase : uint8_t { kBursts, kMag, kImu, kImu2, kBaro, kQuiet };

  void begin_tick(const clock::Tick& tick);
  void take_bursts();
  void apply_commands();
  bool requests_pending();
  bool next_request(I2cRequest& request);
  bool must_wait_to_convert();
  void finish_request(bool ok);
  uint8_t* append_imu(uint8_t number, uint8_t* end, uint32_t& flags) const;
  uint8_t* append_baro(uint8_t* end, uint32_t& flags) const;
  uint8_t* append_mag(uint8_t* end, uint32_t& flags) const;
  void send_sample();
  void send_self_test_result(uint8_t number);

  Mice& mice_;
  wire::Configure settings_;
  Mpu6050 imus_[kImus];
  Magnetometer mag_;
  Barometer baro_;
  Mpu6050::Reading readings_[kImus] = {};
  clock::Tick tick_ = {0, 0, false};
  uint32_t first_tick_ = 0;  // the one with seq 0
  uint32_t ticks_missed_ = 0;
  uint8_t postponed_ = 0;  // ticks in a row in which a conversion came too late to fit before the next burst
  static constexpr uint8_t kNoTest = 0xFF;
  uint8_t self_test_due_ = kNoTest;
  Phase phase_ = Phase::kQuiet;
  Phase owner_ = Phase::kQuiet;  // whose request is running
  bool sample_due_ = false;
  bool streaming_ = false;
  bool configure_due_ = false;
  bool request_running_ = false;
};
