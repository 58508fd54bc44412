#include "Mpu6050.h"

namespace {

enum Register : uint8_t {
  kSelfTestGyro = 0x00,  // of the successors
  kSelfTestX = 0x0D,
  kSampleRateDivider = 0x19,
  kConfig = 0x1A,
  kGyroConfig = 0x1B,
  kAccelConfig = 0x1C,
  kAccelConfig2 = 0x1D,
  kInterruptPin = 0x37,
  kPowerManagement1 = 0x6B,
  kWhoAmI = 0x75,
};
constexpr uint8_t kDeviceReset = 0x80;
constexpr uint8_t kClockFromGyroX = 0x01;  // and awake: the PLL on the gyro is the more stable clock
constexpr uint8_t kExciteAllAxes = 0xE0;
constexpr uint8_t kBypass = 0x02;  // connects the auxiliary bus, with the magnetometer, to the main bus

// In the order in which they are written. kFirstChecked to kLastChecked are adjacent and are checked in one read.
constexpr uint8_t kSetUpRegisters[] = {kPowerManagement1, kSampleRateDivider, kConfig,      kGyroConfig,
                                       kAccelConfig,      kAccelConfig2,      kInterruptPin};
constexpr uint8_t kSetUpCount = sizeof kSetUpRegisters;
constexpr uint8_t kFirstChecked = 1;
constexpr uint8_t kLastChecked = 5;

constexpr uint32_t kResetUs = 100000;   // start-up time for register access, maximum (PS-MPU-6000A 6.3)
constexpr uint32_t kSettleUs = 30000;   // gyro start-up, to 1 deg/s of its final value (6.1)
constexpr uint32_t kTestSettleUs = 100000;
constexpr uint32_t kCheckUs = 100000;   // between two checks of the settings; doubled, a lost setting costs twice the time
constexpr uint32_t kRetryUs = 8000;     // after a failure: a little less than a tick at 100 Hz, so once a tick
constexpr uint32_t kSearchUs = 200000;  // between two searches for a sensor that was never found
constexpr uint32_t kFrozenUs = 200000;  // a reading that repeats for so long is not one: the noise is over 2 counts
constexpr uint8_t kTestSamplesLog2 = 4;

int16_t word(const uint8_t* data) { return static_cast<int16_t>(data[0] << 8 | data[1]); }

// Full-scale select for `range`, a power of two times `smallest`, in bits 4:3.
uint8_t full_scale(uint16_t range, uint16_t smallest) {
  uint8_t select = 0;
  while (range > smallest) {
    range >>= 1;
    select++;
  }
  return select << 3;
}

uint8_t axes_at_end_of_range(const int16_t* axes) {
  uint8_t count = 0;
  for (uint8_t i = 0; i < 3; i++) count += axes[i] == INT16_MAX || axes[i] == INT16_MIN;
  return count;
}

// Differs between two bursts, except for one pair in 65536: no living sensor gives such pairs for long.
uint16_t checksum(const uint8_t* data) {
  uint16_t sum = 1;
  for (uint8_t i = 0; i < Mpu6050::kBurstLength; i++) sum = static_cast<uint16_t>(sum * 31 + data[i]);
  return sum;
}

// All bytes equal: a sensor that is asleep (zeros) or a bus without a driver (ones).
bool blank(const uint8_t* data) {
  for (uint8_t i = 1; i < Mpu6050::kBurstLength; i++) {
    if (data[i] != data[0]) return false;
  }
  return true;
}

}  // namespace

int32_t Mpu6050::sums_[6];
Mpu6050::SelfTest Mpu6050::self_test_;

bool Mpu6050::writes(uint8_t index) const {
  return kSetUpRegisters[index] != kAccelConfig2 || family_.accel_config2;
}

uint8_t Mpu6050::setting(uint8_t index) const {
  const uint8_t excite = test_ == Test::kExcited ? kExciteAllAxes : 0;
  const bool testing = test_ != Test::kOff;
  switch (kSetUpRegisters[index]) {
    case kPowerManagement1: return kClockFromGyroX;
    // 1 kHz, so a reading is at most 1 ms old: the gyro runs at 8 kHz without its filter, at 1 kHz with it.
    case kSampleRateDivider: return settings_.dlpf == 0 ? 7 : 0;
    case kConfig:
    case kAccelConfig2: return settings_.dlpf;
    case kGyroConfig: return full_scale(testing ? 250 : settings_.gyro_range_deg_s, 250) | excite;
    case kAccelConfig: return full_scale(testing ? 8 : settings_.accel_range_g, 2) | excite;
    default: return kBypass;
  }
}

bool Mpu6050::settings_kept(const uint8_t* data) const {
  for (uint8_t i = kFirstChecked; i <= kLastChecked; i++) {
    if (writes(i) && data[i - kFirstChecked] != setting(i)) return false;
  }
  return true;
}

void Mpu6050::configure(const Settings& settings) {
  settings_ = settings;
  test_ = Test::kOff;
  if (state_ >= State::kTrim) set_up();
}

void Mpu6050::start_self_test() {
  test_ = Test::kPlain;
  state_ = State::kTrim;
  step_ = 0;
}

bool Mpu6050::take_self_test(SelfTest& result) {
  if (!test_ready_) return false;
  test_ready_ = false;
  result = self_test_;
  return true;
}

bool Mpu6050::next(uint32_t now_us, I2cRequest& request) {
  const bool searching = !was_running_;
  const uint8_t checked = kLastChecked - kFirstChecked + 1;
  switch (state_) {
    case State::kReset: request = I2cRequest::set(address_, kPowerManagement1, kDeviceReset, searching); return true;
    case State::kIdentify: request = I2cRequest::read(address_, kWhoAmI, 1, searching); return due(now_us);
    case State::kTrim:
      if (family_.old_self_test) {
        request = I2cRequest::read(address_, kSelfTestX, 4);
      } else {
        request = I2cRequest::read(address_, step_ == 0 ? kSelfTestGyro : kSelfTestX, 3);
      }
      return true;
    case State::kSetUp: request = I2cRequest::set(address_, kSetUpRegisters[step_], setting(step_)); return true;
    case State::kSettle: return false;
    case State::kRun:
      if (!due(now_us)) return false;
      state_ = State::kCheckPower;
      // fall through
    case State::kCheckPower: request = I2cRequest::read(address_, kPowerManagement1, 1); return true;
    default: request = I2cRequest::read(address_, kSetUpRegisters[kFirstChecked], checked); return true;
  }
}

void Mpu6050::finish(bool ok, const uint8_t* data, uint32_t now_us) {
  if (!ok) return lost(now_us);
  switch (state_) {
    case State::kReset:
      present_ = true;
      identify_after(now_us, kResetUs);
      break;
    case State::kIdentify: identified(data[0], now_us); break;
    case State::kTrim: take_trim(data); break;
    case State::kSetUp:
      do {
        step_++;
      } while (step_ < kSetUpCount && !writes(step_));
      if (step_ == kSetUpCount) state_ = State::kVerify;
      break;
    case State::kVerify: verified(settings_kept(data), now_us); break;
    case State::kCheckPower:
      if (data[0] != setting(0)) return set_up_again();
      state_ = State::kCheckRanges;
      break;
    default:
      if (!settings_kept(data)) return set_up_again();
      run(now_us);
      break;
  }
}

void Mpu6050::identified(uint8_t id, uint32_t now_us) {
  const ImuFamily family = ImuFamily::of(id);
  if (family.kind == ImuFamily::kNone) return lost(now_us);
  id_ = id;
  family_ = family;
  present_ = true;
  unsupported_ = false;
  if (was_running_) {
    state_ = State::kCheckPower;  // it may have kept its settings
  } else {
    set_up();
  }
}

void Mpu6050::take_trim(const uint8_t* data) {
  const uint8_t count = family_.old_self_test ? 4 : 3;
  for (uint8_t i = 0; i < count; i++) self_test_.trim[3 * step_ + i] = data[i];
  if (family_.old_self_test) self_test_.trim[4] = self_test_.trim[5] = 0;
  if (!family_.old_self_test && step_ == 0) {
    step_ = 1;
  } else {
    set_up();
  }
}

// A chip of unknown id whose settings cannot be read back is not a sensor of this kind; a known one is set up again.
void Mpu6050::verified(bool kept, uint32_t now_us) {
  if (kept) {
    state_ = State::kSettle;
    due_us_ = now_us + (test_ == Test::kOff ? kSettleUs : kTestSettleUs);
    return;
  }
  if (family_.kind != ImuFamily::kUnknown) return set_up_again();
  lost(now_us);
  unsupported_ = true;
  due_us_ = now_us + kSearchUs;
}

void Mpu6050::accept_burst(bool ok, const uint8_t* data, uint32_t now_us, Reading& reading) {
  if (ok && state_ == State::kSettle && due(now_us)) run(now_us);  // whatever it reads: that is its state from now on
  const Cause cause = ok ? judge(data, now_us, reading) : Cause::kSilent;
  note(cause, reading);
  // A sensor that failed or returns nonsense is asked at once for its id and whether it has kept its settings.
  if (cause == Cause::kSilent || (cause == Cause::kBlank && state_ != State::kSettle)) {
    identify_after(now_us, 0);
  } else if (test_ != Test::kOff && cause == Cause::kStarting) {
    average(reading);
  }
}

void Mpu6050::skip_burst(Reading& reading) { note(was_running_ && !present_ ? Cause::kSilent : Cause::kStarting, reading); }

Mpu6050::Cause Mpu6050::judge(const uint8_t* data, uint32_t now_us, Reading& reading) {
  for (uint8_t i = 0; i < 3; i++) {
    reading.accel[i] = word(data + 2 * i);
    reading.gyro[i] = word(data + 8 + 2 * i);
  }
  reading.temperature = word(data + 6);
  const bool repeats = frozen(data, now_us);
  if (blank(data)) return Cause::kBlank;
  if (repeats) return Cause::kFrozen;
  if (state_ == State::kSettle || test_ != Test::kOff) return Cause::kStarting;
  return possible(reading) ? Cause::kNone : Cause::kOutOfRange;
}

bool Mpu6050::frozen(const uint8_t* data, uint32_t now_us) {
  const uint16_t sum = checksum(data);
  if (sum != last_burst_) {
    last_burst_ = sum;
    changed_us_ = now_us;
    return false;
  }
  const bool repeats = now_us - changed_us_ >= kFrozenUs;
  if (repeats) changed_us_ = now_us - kFrozenUs;  // stays true over the wrap of the clock
  return repeats;
}

bool Mpu6050::possible(const Reading& reading) const {
  return axes_at_end_of_range(reading.accel) < 3 && axes_at_end_of_range(reading.gyro) < 3 &&
         reading.temperature >= family_.coldest && reading.temperature <= family_.hottest;
}

void Mpu6050::note(Cause cause, Reading& reading) {
  cause_ = reading.cause = cause;
  reading.valid = cause == Cause::kNone;
  reading.accel_saturated = reading.valid && axes_at_end_of_range(reading.accel) > 0;
  reading.gyro_saturated = reading.valid && axes_at_end_of_range(reading.gyro) > 0;
  if (was_running_ && static_cast<uint8_t>(cause) < kCounted) invalid_[static_cast<uint8_t>(cause)]++;
}

void Mpu6050::run(uint32_t now_us) {
  state_ = State::kRun;
  due_us_ = now_us + kCheckUs;
  was_running_ = true;
}

void Mpu6050::set_up() {
  state_ = State::kSetUp;
  step_ = 0;
  averaged_ = 0;
}

void Mpu6050::set_up_again() {
  if (was_running_) restarts_++;
  set_up();
}

void Mpu6050::identify_after(uint32_t now_us, uint32_t us) {
  state_ = State::kIdentify;
  due_us_ = now_us + us;
}

// No answer, or that of a chip which is not an inertial sensor.
void Mpu6050::lost(uint32_t now_us) {
  present_ = false;
  tried_ = true;
  identify_after(now_us, was_running_ ? kRetryUs : kSearchUs);
}

// Mean of 16 readings with the self-test off, then of 16 with it on; then the previous settings again.
void Mpu6050::average(const Reading& reading) {
  if (averaged_ == 0) {
    for (int32_t& sum : sums_) sum = 0;
  }
  for (uint8_t i = 0; i < 3; i++) {
    sums_[i] += reading.accel[i];
    sums_[3 + i] += reading.gyro[i];
  }
  if (++averaged_ < 1 << kTestSamplesLog2) return;
  int16_t* means = test_ == Test::kPlain ? self_test_.plain : self_test_.excited;
  for (uint8_t i = 0; i < 6; i++) means[i] = static_cast<int16_t>(sums_[i] >> kTestSamplesLog2);
  test_ready_ = test_ == Test::kExcited;
  test_ = test_ready_ ? Test::kOff : Test::kExcited;
  set_up();
}
