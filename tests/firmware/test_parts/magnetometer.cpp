#include <Magnetometer.h>
#include <doctest/doctest.h>

#include <cstring>

#include "support.h"

namespace {

// One of the three chips: its registers, and a reading that is new whenever the driver may expect one.
class FakeChip {
 public:
  explicit FakeChip(Magnetometer::Family family) : family_(family) { lose_power(); }

  bool answers = true;
  bool measures = true;
  int16_t field[3] = {100, -200, 300};
  uint8_t registers[0x40];

  void lose_power() {
    std::memset(registers, 0, sizeof registers);
    if (family_ == Magnetometer::kHmc5883l) std::memcpy(registers + 10, "H43", 3);
    if (family_ == Magnetometer::kQmc5883l) registers[0x0D] = 0xFF;
    if (family_ == Magnetometer::kQmc5883p) registers[0x00] = 0x80;
  }
  uint8_t address() const {
    return family_ == Magnetometer::kHmc5883l ? 0x1E : family_ == Magnetometer::kQmc5883l ? 0x0D : 0x2C;
  }
  bool carry_out(const I2cRequest& request, uint8_t* data) {
    if (!answers || request.address != address()) return false;
    if (request.write_count == 2) {
      registers[request.write[0]] = request.write[1];
      return true;
    }
    measure();
    for (uint8_t i = 0; i < request.read_count; i++) {
      const uint8_t at = request.write[0] + i;
      const bool rolled_over = family_ == Magnetometer::kQmc5883l && request.write[0] == 6 && i > 0;
      data[i] = registers[rolled_over ? at - 7 : at];
    }
    return true;
  }

 private:
  void measure() {
    const bool configured = family_ == Magnetometer::kHmc5883l   ? (registers[2] & 3) == 1
                            : family_ == Magnetometer::kQmc5883l ? registers[9] & 1
                                                                 : registers[0x0A] & 1;
    const uint8_t status = family_ == Magnetometer::kQmc5883l ? 6 : 9;
    registers[status] = measures && configured;
    if (!registers[status]) return;
    static const uint8_t kHmcOrder[] = {0, 2, 1};
    for (uint8_t i = 0; i < 3; i++) {
      const bool hmc = family_ == Magnetometer::kHmc5883l;
      const uint16_t value = static_cast<uint16_t>(field[hmc ? kHmcOrder[i] : i]);
      uint8_t* const at = registers + 2 * i + (hmc ? 3 : family_ == Magnetometer::kQmc5883l ? 0 : 1);
      at[hmc ? 0 : 1] = static_cast<uint8_t>(value >> 8);
      at[hmc ? 1 : 0] = static_cast<uint8_t>(value);
    }
  }

  Magnetometer::Family family_;
};

void run(Magnetometer& driver, FakeChip& chip, uint32_t& now, int ticks) {
  for (; ticks > 0; ticks--, now += 10000) {
    uint8_t data[I2cRequest::kMaxRead];
    I2cRequest request;
    for (int i = 0; driver.next(now, request); i++) {
      if (i >= 20) FAIL("never done");
      const bool ok = chip.carry_out(request, data);
      driver.finish(ok, data, now);
    }
  }
}

constexpr Magnetometer::Family kFamilies[] = {Magnetometer::kHmc5883l, Magnetometer::kQmc5883l, Magnetometer::kQmc5883p};

}  // namespace

TEST_CASE("magnetometer: each chip is found, and read at every tick of 100 Hz") {
  for (Magnetometer::Family family : kFamilies) {
    CAPTURE(family);
    Magnetometer driver;
    FakeChip chip(family);
    uint32_t now = 0;
    run(driver, chip, now, 20);
    REQUIRE(driver.valid());
    CHECK(driver.family() == family);
    CHECK(driver.address() == chip.address());
    for (uint8_t i = 0; i < 3; i++) CHECK(driver.field(i) == chip.field[i]);
    const uint8_t before = driver.count();
    run(driver, chip, now, 100);
    CHECK(static_cast<uint8_t>(driver.count() - before) == 100);
    CHECK(driver.restarts() == 0);
  }
}

TEST_CASE("magnetometer: out of reach while the inertial sensor restarts, and back") {
  for (Magnetometer::Family family : kFamilies) {
    CAPTURE(family);
    Magnetometer driver;
    FakeChip chip(family);
    uint32_t now = 0;
    run(driver, chip, now, 20);
    chip.answers = false;
    run(driver, chip, now, 15);
    CHECK_FALSE(driver.valid());
    CHECK(driver.ever_found());
    CHECK(driver.invalid(0) > 5);
    chip.answers = true;
    run(driver, chip, now, 5);
    CHECK(driver.valid());
    CHECK(driver.restarts() == 1);
  }
}

TEST_CASE("magnetometer: a QMC chip that lost its settings unseen is set up again") {
  for (Magnetometer::Family family : {Magnetometer::kQmc5883l, Magnetometer::kQmc5883p}) {
    Magnetometer driver;
    FakeChip chip(family);
    uint32_t now = 0;
    run(driver, chip, now, 20);
    chip.lose_power();
    run(driver, chip, now, 40);
    CHECK(driver.valid());
    CHECK(driver.restarts() == 1);
  }
}

TEST_CASE("magnetometer: a bus without one is searched once a second, one chip after the other") {
  Magnetometer driver;
  FakeChip chip(Magnetometer::kHmc5883l);
  chip.answers = false;
  uint32_t now = 0;
  I2cRequest request;
  int probes = 0;
  for (int tick = 0; tick < 1000; tick++, now += 10000) {
    uint8_t data[I2cRequest::kMaxRead];
    for (; driver.next(now, request); probes++) {
      CHECK(request.probe);
      driver.finish(false, data, now);
    }
  }
  CHECK(probes == 30);
  CHECK_FALSE(driver.ever_found());
  CHECK(driver.address() == 0);
}

TEST_CASE("magnetometer: an overflow is marked; a reading of zeros is none") {
  Magnetometer driver;
  FakeChip chip(Magnetometer::kHmc5883l);
  uint32_t now = 0;
  run(driver, chip, now, 20);
  chip.field[1] = -4096;
  run(driver, chip, now, 2);
  CHECK(driver.saturated());
  chip.field[0] = chip.field[1] = chip.field[2] = 0;
  run(driver, chip, now, 2);
  CHECK_FALSE(driver.valid());
  CHECK(driver.invalid(1) >= 1);
}
