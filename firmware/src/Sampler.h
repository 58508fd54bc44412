// What happens between two ticks: the IMU's burst is awaited, then the drivers get their turn on the bus, then the
// SAMPLE is made. The bus is quiet from there to the next tick, for the BMP180's conversion.
#pragma once
#include <Bmp180.h>
#include <Clock.h>
#include <Messages.h>
#include <Mpu6050.h>

#include "Mice.h"

class Sampler {
 public:
  Sampler(const wire::Configure& settings, Mice& mice);

  void run();

  void configure(const wire::Configure& settings);
  void start();
  // No SAMPLE follows, not even that of the present tick.
  void stop() { streaming_ = sample_due_ = false; }
  void self_test() { self_test_due_ = true; }

  const wire::Configure& settings() const { return settings_; }
  bool streaming() const { return streaming_; }
  bool sensors_settled() const { return imu_.settled() && baro_.settled(); }
  bool healthy() const { return imu_.present() && baro_.present(); }
  uint32_t ticks_missed() const { return ticks_missed_; }
  // Of the next SAMPLE: HELLO's field `sections`, and the size of the body.
  uint8_t sections() const;
  uint8_t sample_size() const;
  void describe(wire::Hello::Device* devices) const;
  void count(wire::Status::Device* devices) const;
  const Mpu6050& imu() const { return imu_; }
  const Bmp180& baro() const { return baro_; }

 private:
  enum class Phase : uint8_t { kBurst, kImuRequests, kBaroRequests, kQuiet };

  void begin_tick(const clock::Tick& tick);
  void take_burst();
  void tell_sensors();
  bool requests_pending();
  bool too_late_to_convert() const;
  void finish_request(bool ok);
  void send_sample();
  void send_self_test_result();

  Mice& mice_;
  wire::Configure settings_;
  Mpu6050 imu_;
  Bmp180 baro_;
  Mpu6050::Reading reading_ = {};
  clock::Tick tick_ = {0, 0, false};
  uint32_t first_tick_ = 0;  // the one with seq 0
  uint32_t ticks_missed_ = 0;
  Phase phase_ = Phase::kQuiet;
  bool sample_due_ = false;
  bool streaming_ = false;
  bool configure_due_ = false;
  bool self_test_due_ = false;
  bool request_running_ = false;
  bool request_is_imu_ = false;
};
