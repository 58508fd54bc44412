#include "Sampler.h"

#include <Twi.h>
#include <Uart.h>
#include <string.h>

namespace {

Mpu6050::Settings imu_settings(const wire::Configure& settings) {
  return {settings.accel_range_g, settings.gyro_range_deg_s, settings.dlpf};
}

// The SAMPLE waits for the requests of its tick for this long (us) after the tick. Two inertial sensors, a magnetometer
// and a barometer take 1.6 ms at 400 kHz; at 500 Hz a tick is 2 ms.
constexpr uint32_t kSampleDeadlineUs = 3000;
constexpr uint32_t kFastSampleDeadlineUs = 1500;
constexpr uint16_t kFastHz = 250;

// The number of mice in `sections` counts in these steps.
constexpr uint8_t kOneMouse = 0x10;

// A conversion begins at the end of its request. A conversion that is too long for the rest of this tick waits for the
// next one, but not for more than kMostPostponed: it is then disturbed by the next burst, which is better than none.
constexpr uint32_t kConversionRequestUs = 120;
constexpr uint32_t kConversionsBeginUs = 1000;
constexpr uint8_t kMostPostponed = 2;

template <typename Part>
uint8_t* append(uint8_t* end, const Part& part) {
  memcpy(end, &part, sizeof part);
  return end + sizeof part;
}

template <typename Driver>
wire::DeviceState state_of(const Driver& driver, bool ok, bool unsupported) {
  using wire::DeviceState;
  if (unsupported) return DeviceState::kUnsupported;
  if (driver.present() && ok) return DeviceState::kOk;
  if (driver.settled() && driver.ever_found()) return DeviceState::kFailed;
  return driver.present() || !driver.settled() ? DeviceState::kStarting : DeviceState::kAbsent;
}

wire::Hello::Device device_of(wire::DeviceKind kind, uint8_t address, uint8_t id, uint8_t family,
                              wire::DeviceState state) {
  return {static_cast<uint8_t>(kind), address, id, family, static_cast<uint8_t>(state)};
}

wire::Hello::Device device_of(const Mpu6050& imu) {
  wire::DeviceState state = state_of(imu, imu.healthy(), imu.unsupported());
  const bool unknown = imu.family().kind == ImuFamily::kUnknown;
  if (state == wire::DeviceState::kOk && unknown) state = wire::DeviceState::kUnverified;
  return device_of(wire::DeviceKind::kImu, imu.address(), imu.id(), imu.family().kind, state);
}

}  // namespace

Sampler::Sampler(const wire::Configure& settings, Mice& mice)
    : mice_(mice),
      settings_(settings),
      imus_{{Mpu6050::kAddress, imu_settings(settings)}, {Mpu6050::kSecondAddress, imu_settings(settings)}},
      baro_(settings.baro_oversampling) {}

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
  if (phase_ == Phase::kBursts && twi::bursts_done()) take_bursts();
  if (phase_ != Phase::kBursts && phase_ != Phase::kQuiet && !requests_pending()) phase_ = Phase::kQuiet;
  const uint32_t deadline_us = settings_.sample_rate_hz > kFastHz ? kFastSampleDeadlineUs : kSampleDeadlineUs;
  if (sample_due_ && (phase_ == Phase::kQuiet || clock::now_us() - tick_.t_us > deadline_us)) {
    sample_due_ = false;
    send_sample();
  }
  for (uint8_t i = 0; i < kImus; i++) send_self_test_result(i);
}

void Sampler::begin_tick(const clock::Tick& tick) {
  if (streaming_) {
    // Ticks in between, and the one before if its SAMPLE was not made.
    const uint32_t since = tick.number - tick_.number - 1 + sample_due_;
    const uint32_t streamed = tick.number - first_tick_;
    ticks_missed_ += since < streamed ? since : streamed;
  }
  tick_ = tick;
  phase_ = Phase::kBursts;
  sample_due_ = streaming_ && static_cast<int32_t>(tick.number - first_tick_) >= 0;
}

void Sampler::take_bursts() {
  for (uint8_t i = 0; i < kImus; i++) {
    const twi::State state = twi::burst_state(i);
    if (state == twi::State::kIdle) {
      imus_[i].skip_burst(readings_[i]);
    } else {
      imus_[i].accept_burst(state == twi::State::kDone, twi::burst_data(i), clock::now_us(), readings_[i]);
    }
  }
  if (twi::down()) twi::free_bus();
  apply_commands();
  phase_ = Phase::kMag;
}

// What the host requests of the sensors waits until no transaction runs, whose result would be taken for another's.
void Sampler::apply_commands() {
  if (request_running_) return;
  if (configure_due_) {
    twi::set_clock(settings_.i2c_khz);
    for (Mpu6050& imu : imus_) imu.configure(imu_settings(settings_));
    baro_.configure(settings_.baro_oversampling);
  }
  if (self_test_due_ < kImus) imus_[self_test_due_].start_self_test();
  configure_due_ = false;
  self_test_due_ = kNoTest;
}

// Gives the bus to one driver after the other until none needs it. The magnetometer's reading belongs to this tick and
// comes first. The barometer comes last: its last request starts a
// conversion, which no traffic may follow before the next tick. False when the bus is quiet.
bool Sampler::requests_pending() {
  for (;;) {
    if (request_running_) {
      const twi::State state = twi::take_request_state();
      if (state == twi::State::kBusy) return true;
      finish_request(state == twi::State::kDone);
      if (twi::down()) twi::free_bus();
    }
    I2cRequest request;
    while (phase_ != Phase::kQuiet && !next_request(request)) phase_ = static_cast<Phase>(static_cast<uint8_t>(phase_) + 1);
    if (phase_ == Phase::kQuiet || !twi::begin_request(request)) return false;  // at the next tick, then
    request_running_ = true;
    owner_ = phase_;
  }
}

bool Sampler::next_request(I2cRequest& request) {
  const uint32_t now = clock::now_us();
  switch (phase_) {
    case Phase::kImu: return imus_[0].next(now, request);
    case Phase::kImu2: return imus_[1].next(now, request);
    // The magnetometer is behind the first inertial sensor, or beside it where there is none.
    case Phase::kMag: return imus_[0].settled() && (imus_[0].running() || !imus_[0].present()) && mag_.next(now, request);
    default: return !must_wait_to_convert() && baro_.next(now, request);
  }
}

// A conversion that would fit between two bursts, but no longer before the next one, waits for the next tick.
bool Sampler::must_wait_to_convert() {
  const uint32_t needed_us = baro_.conversion_ahead_us();
  const bool fits_now = clock::steps_left() / 2 >= needed_us + kConversionRequestUs;
  const bool ever_fits = (needed_us + kConversionsBeginUs) * settings_.sample_rate_hz < 1000000;
  if (needed_us == 0 || fits_now || !ever_fits || postponed_ >= kMostPostponed) {
    if (needed_us != 0) postponed_ = 0;
    return false;
  }
  postponed_++;
  return true;
}

void Sampler::finish_request(bool ok) {
  request_running_ = false;
  const uint32_t now = clock::now_us();
  const uint8_t* const data = twi::request_data();
  if (owner_ == Phase::kMag) return mag_.finish(ok, data, now);
  if (owner_ == Phase::kBaro) return baro_.finish(ok, data, now);
  const uint8_t number = owner_ == Phase::kImu ? 0 : 1;
  Mpu6050& imu = imus_[number];
  imu.finish(ok, data, now);
  twi::set_burst(number, imu.address(), Mpu6050::kBurstRegister, imu.wants_burst() ? Mpu6050::kBurstLength : 0);
}

uint8_t Sampler::sections() const {
  uint8_t bits = static_cast<uint8_t>(mice_.in_sample() * kOneMouse);
  if (imus_[0].ever_found()) bits |= wire::sections::kImu;
  if (imus_[1].ever_found()) bits |= wire::sections::kImu2;
  if (baro_.ever_found()) bits |= wire::sections::kBaro;
  if (mag_.ever_found()) bits |= wire::sections::kMag;
  return bits;
}

uint8_t Sampler::sample_size() const {
  const uint8_t bits = sections();
  uint8_t size = sizeof(wire::Sample) + bits / kOneMouse * sizeof(wire::Sample::Mouse);
  if (bits & wire::sections::kImu) size += sizeof(wire::Sample::Imu);
  if (bits & wire::sections::kImu2) size += sizeof(wire::Sample::Imu2);
  if (bits & wire::sections::kBaro) size += sizeof(wire::Sample::Baro);
  if (bits & wire::sections::kMag) size += sizeof(wire::Sample::Mag);
  return size;
}

void Sampler::describe(wire::Hello::Device* devices) const {
  devices[0] = device_of(imus_[0]);
  devices[1] = device_of(imus_[1]);
  devices[2] = device_of(wire::DeviceKind::kBarometer, baro_.address(), baro_.id(), baro_.family(),
                         state_of(baro_, baro_.valid(), baro_.unsupported()));
  devices[3] = device_of(wire::DeviceKind::kMagnetometer, mag_.address(), mag_.id(), mag_.family(),
                         state_of(mag_, mag_.valid(), false));
}

void Sampler::count(wire::Status::Device* devices) const {
  for (uint8_t i = 0; i < kImus; i++) {
    const Mpu6050& imu = imus_[i];
    devices[i] = {imu.restarts(), imu.invalid(0), imu.invalid(1), imu.invalid(2), imu.invalid(3)};
  }
  devices[2] = {baro_.restarts(), baro_.silent(), 0, 0, 0};
  devices[3] = {mag_.restarts(), mag_.invalid(0), mag_.invalid(1), 0, 0};
}

// A section's fields have one order for both sensors; the flags of the second are shifted.
uint8_t* Sampler::append_imu(uint8_t number, uint8_t* end, uint32_t& flags) const {
  namespace flag = wire::sample_flags;
  static_assert(sizeof(wire::Sample::Imu) == sizeof(wire::Sample::Imu2), "one order for both");
  static_assert(flag::kImu2Valid == flag::kImuValid << 16 && flag::kGyro2Saturated == flag::kGyroSaturated << 16, "shift");
  static_assert(flag::kImu2Blank == flag::kImuBlank << 3 && flag::kImu2OutOfRange == flag::kImuOutOfRange << 3, "shift");
  const Mpu6050::Reading& r = readings_[number];
  uint32_t bits = 0, causes = 0;
  if (r.valid) bits |= flag::kImuValid;
  if (r.accel_saturated) bits |= flag::kAccelSaturated;
  if (r.gyro_saturated) bits |= flag::kGyroSaturated;
  if (r.cause == Mpu6050::Cause::kBlank) causes = flag::kImuBlank;
  if (r.cause == Mpu6050::Cause::kFrozen) causes = flag::kImuFrozen;
  if (r.cause == Mpu6050::Cause::kOutOfRange) causes = flag::kImuOutOfRange;
  flags |= number == 0 ? bits | causes : bits << 16 | causes << 3;
  const wire::Sample::Imu imu = {r.accel[0], r.accel[1], r.accel[2], r.temperature, r.gyro[0], r.gyro[1], r.gyro[2]};
  return append(end, imu);
}

uint8_t* Sampler::append_baro(uint8_t* end, uint32_t& flags) const {
  if (baro_.valid()) flags |= wire::sample_flags::kBaroValid;
  return append(end, wire::Sample::Baro{baro_.temperature(), baro_.pressure(), baro_.count()});
}

uint8_t* Sampler::append_mag(uint8_t* end, uint32_t& flags) const {
  if (mag_.valid()) flags |= wire::sample_flags::kMagValid;
  if (mag_.valid() && mag_.saturated()) flags |= wire::sample_flags::kMagSaturated;
  return append(end, wire::Sample::Mag{mag_.field(0), mag_.field(1), mag_.field(2), mag_.count()});
}

void Sampler::send_sample() {
  uint8_t body[wire::Sample::kSize];
  wire::Sample head = {static_cast<uint16_t>(tick_.number - first_tick_), tick_.t_us, 0, sections()};
  uint32_t flags = 0;
  uint8_t* end = body + sizeof head;
  if (head.sections & wire::sections::kImu) end = append_imu(0, end, flags);
  if (head.sections & wire::sections::kBaro) end = append_baro(end, flags);
  if (head.sections & wire::sections::kImu2) end = append_imu(1, end, flags);
  if (head.sections & wire::sections::kMag) end = append_mag(end, flags);
  // Some mice answer earlier than others: their movement is put off until it is that of all over the same interval.
  const bool mice_read = tick_.has_mice;
  head.flags = flags | mice_.flags(mice_read);
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

void Sampler::send_self_test_result(uint8_t number) {
  Mpu6050::SelfTest test;
  if (!imus_[number].take_self_test(test)) return;
  wire::SelfTestResult result;
  static_assert(sizeof result == sizeof test.trim + sizeof test.plain + sizeof test.excited + 2, "same order");
  result.device = number;
  result.family = imus_[number].family().kind;
  memcpy(&result.trim_1, test.trim, sizeof test.trim);
  memcpy(&result.plain_accel_x, test.plain, sizeof test.plain);
  memcpy(&result.excited_accel_x, test.excited, sizeof test.excited);
  uart::put(wire::SelfTestResult::kType, &result, wire::SelfTestResult::kSize);
}
