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

// The number of mice in `sections` counts in these steps.
constexpr uint8_t kOneMouse = 0x10;

template <typename Part>
uint8_t* append(uint8_t* end, const Part& part) {
  memcpy(end, &part, sizeof part);
  return end + sizeof part;
}

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

uint8_t Sampler::sections() const {
  uint8_t bits = static_cast<uint8_t>(mice_.in_sample() * kOneMouse);
  if (imu_.ever_found()) bits |= wire::sections::kImu;
  if (baro_.ever_found()) bits |= wire::sections::kBaro;
  return bits;
}

uint8_t Sampler::sample_size() const {
  const uint8_t bits = sections();
  uint8_t size = sizeof(wire::Sample) + bits / kOneMouse * sizeof(wire::Sample::Mouse);
  if (bits & wire::sections::kImu) size += sizeof(wire::Sample::Imu);
  if (bits & wire::sections::kBaro) size += sizeof(wire::Sample::Baro);
  return size;
}

void Sampler::describe(wire::Hello::Device* devices) const {
  using wire::DeviceFamily;
  using wire::DeviceKind;
  using wire::DeviceState;
  const DeviceState imu = imu_.present() ? DeviceState::kOk : DeviceState::kAbsent;
  const DeviceState baro = baro_.present() ? DeviceState::kOk : DeviceState::kAbsent;
  const auto family = [](bool found, DeviceFamily known) {
    return static_cast<uint8_t>(found ? known : DeviceFamily::kNone);
  };
  const uint8_t kImu = static_cast<uint8_t>(DeviceKind::kImu);
  const auto value = [](DeviceState state) { return static_cast<uint8_t>(state); };
  devices[0] = {kImu, 0x68, imu_.id(), family(imu_.present(), DeviceFamily::kMpu6050), value(imu)};
  devices[1] = {kImu, 0x69, 0, 0, value(DeviceState::kAbsent)};
  devices[2] = {static_cast<uint8_t>(DeviceKind::kBarometer), Bmp180::kAddress,
                baro_.present() ? Bmp180::kId : uint8_t{0}, family(baro_.present(), DeviceFamily::kBmp180), value(baro)};
  devices[3] = {static_cast<uint8_t>(DeviceKind::kMagnetometer), 0, 0, 0, value(DeviceState::kAbsent)};
}

void Sampler::count(wire::Status::Device* devices) const {
  memset(devices, 0, wire::Status::kMaxDevices * sizeof *devices);
  devices[0].restarts = imu_.restarts();
  devices[2].restarts = baro_.restarts();
}

void Sampler::send_sample() {
  namespace flag = wire::sample_flags;
  uint8_t body[wire::Sample::kSize];
  wire::Sample head = {static_cast<uint16_t>(tick_.number - first_tick_), tick_.t_us, 0, sections()};
  uint8_t* end = body + sizeof head;
  if (head.sections & wire::sections::kImu) {
    const Mpu6050::Reading& r = reading_;
    const wire::Sample::Imu imu = {r.accel[0], r.accel[1], r.accel[2], r.temperature, r.gyro[0], r.gyro[1], r.gyro[2]};
    end = append(end, imu);
    if (r.valid) head.flags |= flag::kImuValid;
    if (r.valid && r.accel_saturated) head.flags |= flag::kAccelSaturated;
    if (r.valid && r.gyro_saturated) head.flags |= flag::kGyroSaturated;
  }
  if (head.sections & wire::sections::kBaro) {
    const wire::Sample::Baro baro = {baro_.temperature(), baro_.pressure(), baro_.count()};
    end = append(end, baro);
    if (baro_.valid()) head.flags |= flag::kBaroValid;
  }
  // Some mice answer earlier than others: their movement is put off until it is that of all over the same interval.
  const bool mice_read = tick_.serves_mice;
  head.flags |= mice_.flags(mice_read);
  const uint8_t count = head.sections / kOneMouse;
  for (uint8_t i = 0; i < count; i++) {
    const Ps2Mouse& mouse = mice_.mouse(i);
    const int16_t dx = mice_read ? mouse.dx() : 0, dy = mice_read ? mouse.dy() : 0;
    end = append(end, wire::Sample::Mouse{dx, dy});
  }
  append(body, head);
  // Movement that did not get into the transmit ring goes into a later SAMPLE.
  const uint8_t size = static_cast<uint8_t>(end - body);
  if (uart::put(wire::Sample::kType, body, size) && mice_read) mice_.forget_movement();
}

void Sampler::send_self_test_result() {
  Mpu6050::SelfTest test;
  if (!imu_.take_self_test(test)) return;
  wire::SelfTestResult result = {};
  result.family = static_cast<uint8_t>(wire::DeviceFamily::kMpu6050);
  memcpy(&result.trim_1, test.trim, sizeof test.trim);
  memcpy(&result.plain_accel_x, test.plain, sizeof test.plain);
  memcpy(&result.excited_accel_x, test.excited, sizeof test.excited);
  uart::put(wire::SelfTestResult::kType, &result, wire::SelfTestResult::kSize);
}
