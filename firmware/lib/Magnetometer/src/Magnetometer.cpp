#include "Magnetometer.h"

#include <string.h>
#ifdef __AVR__
#include <avr/pgmspace.h>
#else  // the native tests have one address space
#define PROGMEM
#define memcpy_P memcpy
#endif

namespace {

struct Setting {
  uint8_t target;
  uint8_t value;
};

struct Chip {
  Magnetometer::Family family;
  uint8_t address;
  uint8_t id_register;
  uint8_t id_length;
  uint8_t id[3];
  Setting settings[3];
  uint8_t setting_count;
  uint8_t first_register;  // of a reading
  uint8_t length;
};

// HMC5883L: one average, +-1.3 gauss, one measurement at each request (6 ms; its own rate ends at 75 Hz).
constexpr uint8_t kHmcMode = 0x02;
constexpr uint8_t kHmcSingle = 0x01;
constexpr int16_t kHmcOverflow = -4096;
// The QSTs: +-8 gauss, 200 Hz, so that a reading is new at each tick of 100 Hz. The QMC5883L is read from its status
// register 0x06, from which the pointer rolls over to the data at 0x00; the QMC5883P's status 0x09 follows its data.
constexpr uint8_t kReady = 0x01;
constexpr uint8_t kOverflow = 0x02;

const Chip kChips[] PROGMEM = {
    {Magnetometer::kHmc5883l, 0x1E, 0x0A, 3, {'H', '4', '3'}, {{0x00, 0x18}, {0x01, 0x20}, {0x02, 0x01}}, 3, 0x03, 6},
    {Magnetometer::kQmc5883l, 0x0D, 0x0D, 1, {0xFF, 0, 0}, {{0x0B, 0x01}, {0x0A, 0x40}, {0x09, 0x1D}}, 3, 0x06, 7},
    {Magnetometer::kQmc5883p, 0x2C, 0x00, 1, {0x80, 0, 0}, {{0x29, 0x06}, {0x0B, 0x08}, {0x0A, 0xCD}}, 3, 0x01, 9},
};
constexpr uint8_t kChipCount = sizeof kChips / sizeof *kChips;

constexpr uint32_t kMeasureUs = 6500;   // HMC5883L: 6 ms, typical; doubled, it is new at every other tick of 100 Hz
constexpr uint32_t kSearchUs = 1000000; // between two searches when no chip answered
constexpr uint32_t kRetryUs = 8000;     // once a tick at 100 Hz
constexpr uint32_t kStaleUs = 300000;   // without a new reading: the chip lost its settings and is set up again

Chip chip_at(uint8_t index) {
  Chip chip;
  memcpy_P(&chip, &kChips[index], sizeof chip);
  return chip;
}

int16_t big_endian(const uint8_t* data) { return static_cast<int16_t>(data[0] << 8 | data[1]); }
int16_t little_endian(const uint8_t* data) { return static_cast<int16_t>(data[1] << 8 | data[0]); }

}  // namespace

uint8_t Magnetometer::address() const { return ever_found_ ? chip_at(chip_).address : 0; }

bool Magnetometer::next(uint32_t now_us, I2cRequest& request) {
  const Chip chip = chip_at(chip_);
  switch (state_) {
    case State::kSearch:
      request = I2cRequest::read(chip.address, chip.id_register, chip.id_length, !ever_found_);
      return due(now_us);
    case State::kSetUp:
      request = I2cRequest::set(chip.address, chip.settings[step_].target, chip.settings[step_].value);
      return true;
    case State::kTrigger:
      request = I2cRequest::set(chip.address, kHmcMode, kHmcSingle);
      return true;
    default:
      request = I2cRequest::read(chip.address, chip.first_register, chip.length);
      return due(now_us);
  }
}

void Magnetometer::finish(bool ok, const uint8_t* data, uint32_t now_us) {
  switch (state_) {
    case State::kSearch:
      if (ok) return identified(data, now_us);
      return search_next(now_us);
    case State::kSetUp:
      if (!ok) return lost(now_us);
      if (++step_ < chip_at(chip_).setting_count) return;
      present_ = ever_found_ = true;
      state_ = State::kRead;
      due_us_ = now_us + kMeasureUs;
      measured_us_ = now_us;
      return;
    case State::kTrigger:
      if (!ok) return lost(now_us);
      state_ = State::kRead;
      due_us_ = now_us + kMeasureUs;
      return;
    default:
      if (!ok) return lost(now_us);
      return take(data, now_us);
  }
}

void Magnetometer::identified(const uint8_t* data, uint32_t now_us) {
  const Chip chip = chip_at(chip_);
  for (uint8_t i = 0; i < chip.id_length; i++) {
    if (data[i] != chip.id[i]) return search_next(now_us);
  }
  id_ = data[0];
  family_ = chip.family;
  set_up();
}

// A chip that was found once is the only one looked for.
void Magnetometer::search_next(uint32_t now_us) {
  if (ever_found_) {
    invalid_[static_cast<uint8_t>(Cause::kSilent)]++;
    due_us_ = now_us + kRetryUs;
    return;
  }
  chip_ = chip_ + 1 < kChipCount ? chip_ + 1 : 0;
  searched_ = searched_ || chip_ == 0;
  due_us_ = now_us + (chip_ == 0 ? kSearchUs : 0);
}

void Magnetometer::set_up() {
  if (ever_found_) restarts_++;
  state_ = State::kSetUp;
  step_ = 0;
}

void Magnetometer::take(const uint8_t* data, uint32_t now_us) {
  bool fresh = true;
  int16_t field[3];
  if (family_ == kHmc5883l) {
    field[0] = big_endian(data);
    field[2] = big_endian(data + 2);
    field[1] = big_endian(data + 4);
    saturated_ = field[0] == kHmcOverflow || field[1] == kHmcOverflow || field[2] == kHmcOverflow;
    state_ = State::kTrigger;
  } else {
    const uint8_t status = family_ == kQmc5883l ? data[0] : data[8];
    const uint8_t* const values = family_ == kQmc5883l ? data + 1 : data;
    for (uint8_t i = 0; i < 3; i++) field[i] = little_endian(values + 2 * i);
    fresh = status & kReady;
    if (fresh) saturated_ = status & kOverflow;
    // Once a tick: half a tick at 200 Hz, the chip's rate.
    due_us_ = now_us + 2500;
  }
  if (fresh && field[0] == 0 && field[1] == 0 && field[2] == 0) {
    invalid_[static_cast<uint8_t>(Cause::kBlank)]++;
    fresh = measured_ = false;
  }
  if (fresh) {
    for (uint8_t i = 0; i < 3; i++) field_[i] = field[i];
    count_++;
    measured_ = true;
    measured_us_ = now_us;
  } else if (now_us - measured_us_ > kStaleUs) {
    measured_us_ = now_us;
    measured_ = false;
    set_up();
  }
}

void Magnetometer::lost(uint32_t now_us) {
  invalid_[static_cast<uint8_t>(Cause::kSilent)]++;
  present_ = false;
  measured_ = false;
  state_ = State::kSearch;
  due_us_ = now_us + kRetryUs;
}
