#include "Mpu6050.h"

namespace {

enum Register : uint8_t {
  kSelfTestX = 0x0D,
  kSampleRateDivider = 0x19,
  kConfig = 0x1A,
  kGyroConfig = 0x1B,
  kAccelConfig = 0x1C,
  kPowerManagement1 = 0x6B,
  kWhoAmI = 0x75,
};
constexpr uint8_t kDeviceReset = 0x80;
constexpr uint8_t kClockFromGyroX = 0x01;  // and awake: the PLL on the gyro is the stabler clock
constexpr uint8_t kExciteAllAxes = 0xE0;

// In the order they are written; the four after the first stand side by side, and are checked in one read.
constexpr uint8_t kSetUpRegisters[] = {kPowerManagement1, kSampleRateDivider, kConfig, kGyroConfig, kAccelConfig};
constexpr uint8_t kSetUpCount = sizeof kSetUpRegisters;

constexpr uint32_t kResetUs = 100000;      // "start-up time for register read/write", largest
constexpr uint32_t kSettleUs = 30000;      // gyro start-up, to 1 deg/s of its final value
constexpr uint32_t kTestSettleUs = 100000;
constexpr uint32_t kCheckUs = 100000;      // how often the settings are checked while all goes well
constexpr uint32_t kRetryUs = 8000;  // a little less than a tick at 100 Hz: once a tick
constexpr uint8_t kTestSamplesLog2 = 4;

// 0x68 is the MPU-6050. The others are its successors, sold on the same boards: 6500, 9250, 9255 and ICM-20689.
bool known(uint8_t id) { return id == 0x68 || id == 0x70 || id == 0x71 || id == 0x73 || id == 0x98; }

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

bool at_end_of_range(const int16_t* axes) {
  for (uint8_t i = 0; i < 3; i++) {
    if (axes[i] == INT16_MAX || axes[i] == INT16_MIN) return true;
  }
  return false;
}

// All bytes alike: a sensor asleep (zeros) or a bus that nobody drives (ones).
bool meaningless(const uint8_t* data) {
  for (uint8_t i = 1; i < Mpu6050::kBurstLength; i++) {
    if (data[i] != data[0]) return false;
  }
  return true;
}

}  // namespace

uint8_t Mpu6050::setting(uint8_t index) const {
  const uint8_t excite = test_ == Test::kExcited ? kExciteAllAxes : 0;
  const bool testing = test_ != Test::kOff;
  switch (kSetUpRegisters[index]) {
    case kPowerManagement1: return kClockFromGyroX;
    // 1 kHz, so that a reading is at most 1 ms old: the gyro gives 8 kHz without its filter, 1 kHz with it.
    case kSampleRateDivider: return settings_.dlpf == 0 ? 7 : 0;
    case kConfig: return settings_.dlpf;
    case kGyroConfig: return full_scale(testing ? 250 : settings_.gyro_range_deg_s, 250) | excite;
    default: return full_scale(testing ? 8 : settings_.accel_range_g, 2) | excite;
  }
}

void Mpu6050::configure(const Settings& settings) {
  settings_ = settings;
  test_ = Test::kOff;
  if (state_ >= State::kTrim) set_up();
}

void Mpu6050::start_self_test() {
  test_ = Test::kPlain;
  state_ = State::kTrim;
}

bool Mpu6050::take_self_test(SelfTest& result) {
  if (!test_ready_) return false;
  test_ready_ = false;
  result = self_test_;
  return true;
}

bool Mpu6050::next(uint32_t now_us, I2cRequest& request) {
  switch (state_) {
    case State::kReset: request = I2cRequest::set(kAddress, kPowerManagement1, kDeviceReset); return true;
    case State::kIdentify: request = I2cRequest::read(kAddress, kWhoAmI, 1); return due(now_us);
    case State::kTrim: request = I2cRequest::read(kAddress, kSelfTestX, 4); return true;
    case State::kSetUp: request = I2cRequest::set(kAddress, kSetUpRegisters[step_], setting(step_)); return true;
    case State::kSettle: return false;
    case State::kRun:
      if (!due(now_us)) return false;
      state_ = State::kCheckPower;
      // fall through
    case State::kCheckPower: request = I2cRequest::read(kAddress, kPowerManagement1, 1); return true;
    default: request = I2cRequest::read(kAddress, kSampleRateDivider, kSetUpCount - 1); return true;
  }
}

void Mpu6050::finish(bool ok, const uint8_t* data, uint32_t now_us) {
  if (!ok) return lost(now_us);
  switch (state_) {
    case State::kReset:
      identify_after(now_us, kResetUs);
      break;
    case State::kIdentify:
      if (!known(data[0])) return lost(now_us);
      id_ = data[0];
      state_ = State::kCheckPower;
      break;
    case State::kTrim:
      for (uint8_t i = 0; i < sizeof self_test_.trim; i++) self_test_.trim[i] = data[i];
      set_up();
      break;
    case State::kSetUp:
      if (++step_ < kSetUpCount) break;
      state_ = State::kSettle;
      due_us_ = now_us + (test_ == Test::kOff ? kSettleUs : kTestSettleUs);
      break;
    case State::kCheckPower:
      if (data[0] != setting(0)) return set_up_again();
      state_ = State::kCheckRanges;
      break;
    default:
      for (uint8_t i = 1; i < kSetUpCount; i++) {
        if (data[i - 1] != setting(i)) return set_up_again();
      }
      run(now_us);
      break;
  }
}

void Mpu6050::accept_burst(bool ok, const uint8_t* data, uint32_t now_us, Reading& reading) {
  reading.valid = false;
  // A sensor that failed or talks nonsense is asked at once who it is and whether it has kept its settings.
  if (!ok || meaningless(data)) return identify_after(now_us, 0);
  for (uint8_t i = 0; i < 3; i++) {
    reading.accel[i] = word(data + 2 * i);
    reading.gyro[i] = word(data + 8 + 2 * i);
  }
  reading.temperature = word(data + 6);
  if (state_ == State::kSettle) {
    if (due(now_us)) run(now_us);
  } else if (test_ != Test::kOff) {
    average(reading);
  } else {
    reading.valid = true;
    reading.accel_saturated = at_end_of_range(reading.accel);
    reading.gyro_saturated = at_end_of_range(reading.gyro);
  }
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

// No answer, or one of a chip we do not know.
void Mpu6050::lost(uint32_t now_us) {
  id_ = 0;
  tried_ = true;
  identify_after(now_us, kRetryUs);
}

// Mean of 16 readings with the self-test off, then of 16 with it on; then back to the settings of before.
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
