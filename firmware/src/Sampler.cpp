#include "Sampler.h"

#include <Twi.h>
#include <Uart.h>
#include <string.h>

namespace {

Mpu6050::Settings imu_settings(const wire::Configure& settings) {
  return {settings.accel_range_g, settings.gyro_range_deg_s, settings.dlpf};
}

// The SAMPLE does not wait longer for the requests of a tick than this: at 500 Hz a tick is 2 ms.
constexpr uint32_t kSampleDeadlineUs = 1500;

// A conversion begins at the end of its request, and after a tick not before this.
constexpr uint32_t kConversionRequestUs = 120;
constexpr uint32_t kConversionsBeginUs = 1000;

}  // namespace

Sampler::Sampler(const wire::Configure& settings, Mice& mice)
    : mice_(mice), settings_(settings), imu_(imu_settings(settings)), baro_(settings.baro_oversampling) {}

void Sampler::configure(const wire::Configure& settings) {
  settings_ = settings;
  configure_due_ = true;
  clock::set_rate(settings.sample_rate_hz);
}

void Sampler::start() {
  streaming_ = true;
  mice_.forget_movement();
  first_tick_ = clock::tick().number + 1;
}

void Sampler::run() {
  const clock::Tick now = clock::tick();
  if (now.number != tick_.number) begin_tick(now);
  if (phase_ == Phase::kBurst && twi::burst_state() != twi::State::kBusy) take_burst();
  if ((phase_ == Phase::kImuRequests || phase_ == Phase::kBaroRequests) && !requests_pending()) phase_ = Phase::kQuiet;
  if (sample_due_ && (phase_ == Phase::kQuiet || clock::now_us() - tick_.t_us > kSampleDeadlineUs)) {
    sample_due_ = false;
    send_sample();
  }
  send_self_test_result();
}

void Sampler::begin_tick(const clock::Tick& tick) {
  if (streaming_) {
    // Ticks in between, and the one before when its SAMPLE was not made.
    const uint32_t since = tick.number - tick_.number - 1 + sample_due_;
    const uint32_t streamed = tick.number - first_tick_;
    ticks_missed_ += since < streamed ? since : streamed;
  }
  tick_ = tick;
  phase_ = Phase::kBurst;
  sample_due_ = streaming_ && static_cast<int32_t>(tick.number - first_tick_) >= 0;
}

void Sampler::take_burst() {
  const twi::State state = twi::burst_state();
  reading_.valid = false;
  if (state != twi::State::kIdle) {
    imu_.accept_burst(state == twi::State::kDone, twi::burst_data(), clock::now_us(), reading_);
  }
  if (twi::down()) twi::free_bus();
  tell_sensors();
  phase_ = Phase::kImuRequests;
}

// What the host wants of the sensors waits until no transaction runs, whose answer would be taken for that of another.
void Sampler::tell_sensors() {
  if (request_running_) return;
  if (configure_due_) {
    imu_.configure(imu_settings(settings_));
    baro_.configure(settings_.baro_oversampling);
  }
  if (self_test_due_) imu_.start_self_test();
  configure_due_ = self_test_due_ = false;
}

// Gives the bus to the IMU's driver, then to the barometer's, until neither wants it: what the barometer is told last is
// to convert, and nothing must follow that before the next tick. False when the bus is quiet.
bool Sampler::requests_pending() {
  for (;;) {
    if (request_running_) {
      const twi::State state = twi::take_request_state();
      if (state == twi::State::kBusy) return true;
      finish_request(state == twi::State::kDone);
      if (twi::down()) twi::free_bus();
    }
    I2cRequest request;
    const uint32_t now = clock::now_us();
    if (phase_ == Phase::kImuRequests && !imu_.next(now, request)) phase_ = Phase::kBaroRequests;
    if (phase_ == Phase::kBaroRequests && (too_late_to_convert() || !baro_.next(now, request))) return false;
    if (!twi::begin_request(request)) return false;  // at the next tick, then
    request_running_ = true;
    request_is_imu_ = phase_ == Phase::kImuRequests;
  }
}

// A conversion that would fit between two bursts, but not any more before the next one, waits for the next tick.
bool Sampler::too_late_to_convert() const {
  const uint32_t needed_us = baro_.conversion_ahead_us();
  if (needed_us == 0 || clock::steps_left() / 2 >= needed_us + kConversionRequestUs) return false;
  return (needed_us + kConversionsBeginUs) * settings_.sample_rate_hz < 1000000;
}

void Sampler::finish_request(bool ok) {
  request_running_ = false;
  const uint32_t now = clock::now_us();
  if (request_is_imu_) {
    imu_.finish(ok, twi::request_data(), now);
    twi::set_burst(Mpu6050::kAddress, Mpu6050::kBurstRegister, imu_.wants_burst() ? Mpu6050::kBurstLength : 0);
  } else {
    baro_.finish(ok, twi::request_data(), now);
  }
}

void Sampler::send_sample() {
  namespace flag = wire::sample_flags;
  wire::Sample sample;
  sample.seq = static_cast<uint16_t>(tick_.number - first_tick_);
  sample.t_us = tick_.t_us;
  sample.accel_x = reading_.accel[0];
  sample.accel_y = reading_.accel[1];
  sample.accel_z = reading_.accel[2];
  sample.imu_temp = reading_.temperature;
  sample.gyro_x = reading_.gyro[0];
  sample.gyro_y = reading_.gyro[1];
  sample.gyro_z = reading_.gyro[2];
  sample.baro_ut = baro_.temperature();
  sample.baro_up = baro_.pressure();
  sample.baro_count = baro_.count();
  sample.flags = 0;
  if (reading_.valid) sample.flags |= flag::kImuValid;
  if (reading_.valid && reading_.accel_saturated) sample.flags |= flag::kAccelSaturated;
  if (reading_.valid && reading_.gyro_saturated) sample.flags |= flag::kGyroSaturated;
  if (baro_.valid()) sample.flags |= flag::kBaroValid;
  // Some mice answer earlier than others: their movement is put off until it is that of all over the same interval.
  const bool mice_read = tick_.serves_mice;
  sample.flags |= mice_.flags(mice_read);
  const uint8_t count = mice_.in_sample();
  for (uint8_t i = 0; i < count; i++) {
    const Ps2Mouse& mouse = mice_.mouse(i);
    sample.mice[i] = {mice_read ? mouse.dx() : int16_t{0}, mice_read ? mouse.dy() : int16_t{0}};
  }
  // Movement that did not get into the transmit ring goes into a later SAMPLE.
  if (uart::put(wire::Sample::kType, &sample, wire::Sample::size(count)) && mice_read) mice_.forget_movement();
}

void Sampler::send_self_test_result() {
  Mpu6050::SelfTest test;
  if (!imu_.take_self_test(test)) return;
  wire::SelfTestResult result;
  static_assert(sizeof result == sizeof test.trim + sizeof test.plain + sizeof test.excited + 1, "same order");
  memcpy(&result.trim_x, test.trim, sizeof test.trim);
  memcpy(&result.plain_accel_x, test.plain, sizeof test.plain);
  memcpy(&result.excited_accel_x, test.excited, sizeof test.excited);
  result.baro_id = baro_.present() ? Bmp180::kId : 0;
  uart::put(wire::SelfTestResult::kType, &result, wire::SelfTestResult::kSize);
}
