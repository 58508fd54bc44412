// The magnetometer of a GY-87 as a state machine without I/O: it returns the transaction it needs next and is given the
// result. It finds out which of three chips is fitted.
//
// The chip is behind the inertial sensor's auxiliary bus, which the inertial sensor's driver connects to the main bus
// (bypass). When the inertial sensor restarts, the chip is out of reach for a moment but keeps its settings.
// Data sheets: Honeywell HMC5883L 900405 rev E; QST QMC5883L 13-52-04; QST QMC5883P 13-52-19.
#pragma once
#include <I2cRequest.h>
#include <stdint.h>

class Magnetometer {
 public:
  // Values of wire::DeviceFamily.
  enum Family : uint8_t { kNone = 0, kHmc5883l = 32, kQmc5883l = 33, kQmc5883p = 34 };
  enum class Cause : uint8_t { kSilent, kBlank };
  static constexpr uint8_t kCounted = 2;

  // The next transaction wanted now, if any; call finish() before asking again.
  bool next(uint32_t now_us, I2cRequest& request);
  void finish(bool ok, const uint8_t* data, uint32_t now_us);

  // The latest reading in the chip's axes; new ones are counted.
  int16_t field(uint8_t axis) const { return field_[axis]; }
  uint8_t count() const { return count_; }
  bool valid() const { return present_ && measured_; }
  bool saturated() const { return saturated_; }

  bool present() const { return present_; }
  bool ever_found() const { return ever_found_; }
  // Found, or all three chips were searched for.
  bool settled() const { return ever_found_ || searched_; }
  Family family() const { return family_; }
  uint8_t address() const;
  uint8_t id() const { return id_; }  // as read, 0: never found
  uint16_t restarts() const { return restarts_; }
  uint16_t invalid(uint8_t cause) const { return invalid_[cause]; }

 private:
  enum class State : uint8_t { kSearch, kSetUp, kTrigger, kRead };

  bool due(uint32_t now_us) const { return static_cast<int32_t>(now_us - due_us_) >= 0; }
  void identified(const uint8_t* data, uint32_t now_us);
  void search_next(uint32_t now_us);
  void set_up();
  void take(const uint8_t* data, uint32_t now_us);
  void lost(uint32_t now_us);

  State state_ = State::kSearch;
  uint8_t chip_ = 0;  // index of the chip that is fitted or looked for
  uint8_t step_ = 0;
  uint8_t id_ = 0;
  uint8_t count_ = 0;
  Family family_ = kNone;
  bool present_ = false;
  bool ever_found_ = false;
  bool searched_ = false;
  bool measured_ = false;
  bool saturated_ = false;
  uint16_t restarts_ = 0;
  uint16_t invalid_[kCounted] = {};
  int16_t field_[3] = {};
  uint32_t due_us_ = 0;
  uint32_t measured_us_ = 0;  // when the latest new reading came
};
