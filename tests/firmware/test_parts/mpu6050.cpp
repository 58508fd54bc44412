#include <Mpu6050.h>
#include <doctest/doctest.h>

#include <cstring>

#include "support.h"

namespace {

constexpr Mpu6050::Settings kSettings = {8, 1000, 3};

class FakeSensor {
 public:
  bool answers = true;
  bool read_only = false;
  uint8_t id = 0x68;
  uint8_t registers[128] = {};
  int resets = 0;
  bool frozen = false;
  bool zeros = false;
  uint8_t bursts = 0;

  FakeSensor() { lose_power(); }

  void lose_power() {
    std::memset(registers, 0, sizeof registers);
    registers[0x6B] = 0x40;
    registers[0x75] = id;
    for (uint8_t i = 0; i < 4; i++) registers[0x0D + i] = static_cast<uint8_t>(0x11 * (i + 1));
  }
  bool carry_out(const I2cRequest& request, uint8_t* data) {
    if (!answers || request.address != 0x68) return false;
    if (request.write_count == 2) {
      if (request.write[0] == 0x6B && request.write[1] & 0x80) {
        lose_power();
        resets++;
      } else if (!read_only) {
        registers[request.write[0]] = request.write[1];
      }
    }
    std::copy(registers + request.write[0], registers + request.write[0] + request.read_count, data);
    return true;
  }
  // Asleep, it reads all zeros; with its self-test on, the axes read more.
  bool burst(uint8_t* data) {
    const bool asleep = registers[0x6B] & 0x40 || zeros;
    for (uint8_t i = 0; i < 14; i++) {
      const uint8_t excited = registers[i < 6 ? 0x1C : 0x1B] & 0xE0 ? 0x10 : 0;
      data[i] = asleep ? 0 : static_cast<uint8_t>(i + excited);
    }
    if (!asleep && !frozen) data[7] ^= ++bursts & 1;  // the temperature's noise
    return answers;
  }
};

class Rig {
 public:
  FakeSensor sensor;
  Mpu6050 driver{0x68, kSettings};
  Mpu6050::Reading reading = {};
  uint32_t now = 0;

  void power_on_as(uint8_t id) {
    sensor.id = id;
    sensor.lose_power();
  }
  void tick() {
    uint8_t data[I2cRequest::kMaxRead];
    reading.valid = false;
    if (driver.wants_burst()) {
      const bool ok = sensor.burst(data);
      driver.accept_burst(ok, data, now, reading);
    } else {
      driver.skip_burst(reading);
    }
    I2cRequest request;
    for (int i = 0; driver.next(now, request); i++) {
      if (i >= 20) FAIL("never done");
      const bool ok = sensor.carry_out(request, data);
      driver.finish(ok, data, now);
    }
    now += 10000;
  }
  // Ticks until the reading is valid.
  int ticks_to_valid(int limit) {
    for (int ticks = 1; ticks <= limit; ticks++) {
      tick();
      if (reading.valid) return ticks;
    }
    return -1;
  }
};

}  // namespace

TEST_CASE("MPU-6050: reset once, set up, and valid within 200 ms of power-on") {
  Rig rig;
  const int ticks = rig.ticks_to_valid(20);
  CHECK(ticks > 10);  // 100 ms for the reset, 30 ms for the gyro
  CHECK(rig.sensor.resets == 1);
  CHECK(rig.driver.present());
  CHECK(rig.driver.id() == 0x68);
  CHECK(rig.sensor.registers[0x6B] == 0x01);
  CHECK(rig.sensor.registers[0x19] == 0);
  CHECK(rig.sensor.registers[0x1A] == 3);
  CHECK(rig.sensor.registers[0x1B] == 0x10);
  CHECK(rig.sensor.registers[0x1C] == 0x10);
  CHECK(rig.reading.accel[0] == 0x0001);
  CHECK((rig.reading.temperature & ~1) == 0x0606);
  CHECK(rig.reading.gyro[2] == 0x0C0D);
  CHECK(rig.driver.restarts() == 0);
}

TEST_CASE("MPU-6050: every range and filter is in the registers as in the register map") {
  const struct {
    Mpu6050::Settings settings;
    uint8_t divider, config, gyro, accel;
  } cases[] = {{{2, 250, 0}, 7, 0, 0x00, 0x00}, {{4, 500, 1}, 0, 1, 0x08, 0x08}, {{16, 2000, 6}, 0, 6, 0x18, 0x18}};
  Rig rig;
  rig.ticks_to_valid(20);
  for (const auto& expected : cases) {
    rig.driver.configure(expected.settings);
    CHECK(rig.ticks_to_valid(10) <= 6);
    CHECK(rig.sensor.registers[0x19] == expected.divider);
    CHECK(rig.sensor.registers[0x1A] == expected.config);
    CHECK(rig.sensor.registers[0x1B] == expected.gyro);
    CHECK(rig.sensor.registers[0x1C] == expected.accel);
  }
  CHECK(rig.driver.restarts() == 0);
}

TEST_CASE("MPU-6050: a missed answer costs that reading and no set-up") {
  Rig rig;
  rig.ticks_to_valid(20);
  rig.sensor.answers = false;
  for (int i = 0; i < 10; i++) rig.tick();
  CHECK_FALSE(rig.reading.valid);
  CHECK_FALSE(rig.driver.present());
  rig.sensor.answers = true;
  CHECK(rig.ticks_to_valid(10) <= 3);
  CHECK(rig.driver.restarts() == 0);
}

TEST_CASE("MPU-6050: a sensor that lost its supply is set up again, and used when its gyro has settled") {
  Rig rig;
  rig.ticks_to_valid(20);
  SUBCASE("asleep, all zeros") { rig.sensor.lose_power(); }
  SUBCASE("pulled and put back") {
    rig.sensor.answers = false;
    for (int i = 0; i < 50; i++) rig.tick();
    rig.sensor.lose_power();
    rig.sensor.answers = true;
  }
  const int ticks = rig.ticks_to_valid(20);
  CHECK(ticks >= 4);
  CHECK(ticks <= 7);
  CHECK(rig.driver.restarts() == 1);
}

TEST_CASE("MPU-6050: a changed range is found within 100 ms") {
  Rig rig;
  rig.ticks_to_valid(20);
  rig.sensor.registers[0x1C] = 0;
  for (int i = 0; i < 12; i++) rig.tick();
  CHECK(rig.sensor.registers[0x1C] == 0x10);
  CHECK(rig.driver.restarts() == 1);
}

TEST_CASE("MPU-6050: a chip of unknown id runs if its settings read back, and keeps its id") {
  Rig rig;
  rig.power_on_as(0x42);
  CHECK(rig.ticks_to_valid(20) > 0);
  CHECK(rig.driver.id() == 0x42);
  CHECK(rig.driver.family().kind == ImuFamily::kUnknown);
}

TEST_CASE("MPU-6050: a chip of unknown id whose settings do not read back is unsupported") {
  Rig rig;
  rig.power_on_as(0x42);
  rig.sensor.read_only = true;
  CHECK(rig.ticks_to_valid(100) == -1);
  CHECK(rig.driver.unsupported());
  CHECK(rig.driver.settled());
  CHECK(rig.driver.id() == 0x42);
  CHECK_FALSE(rig.driver.wants_burst());
}

TEST_CASE("MPU-6050: the successors get the accelerometer's own filter setting, and it is checked") {
  for (uint8_t id : {0x70, 0x71, 0x73, 0x74, 0x75, 0x98, 0x12, 0x19, 0xAF}) {
    CAPTURE(id);
    Rig rig;
    rig.power_on_as(id);
    CHECK(rig.ticks_to_valid(20) > 0);
    CHECK(rig.sensor.registers[0x1D] == 3);
    rig.sensor.registers[0x1D] = 0;
    for (int i = 0; i < 12; i++) rig.tick();
    CHECK(rig.sensor.registers[0x1D] == 3);
    CHECK(rig.driver.restarts() == 1);
  }
  Rig genuine;
  CHECK(genuine.ticks_to_valid(20) > 0);
  CHECK(genuine.sensor.registers[0x1D] == 0);
  CHECK(genuine.sensor.registers[0x37] == 2);  // the magnetometer's bus is connected
}

TEST_CASE("MPU-6050: a sensor that is blank or frozen from the start has failed, and is not being set up for ever") {
  for (const bool zeros : {false, true}) {
    Rig rig;
    rig.sensor.zeros = zeros;
    rig.sensor.frozen = !zeros;
    for (int i = 0; i < 100; i++) rig.tick();
    CHECK(rig.driver.present());
    CHECK(rig.driver.ever_found());
    CHECK(!rig.driver.healthy());
    CHECK(rig.driver.invalid(static_cast<uint8_t>(zeros ? Mpu6050::Cause::kBlank : Mpu6050::Cause::kFrozen)) > 0);
    rig.sensor.zeros = rig.sensor.frozen = false;
    CHECK(rig.ticks_to_valid(30) > 0);
    CHECK(rig.driver.healthy());
    CHECK(rig.reading.valid);
  }
}

TEST_CASE("MPU-6050: a burst that repeats for 0.2 s is frozen until it changes") {
  Rig rig;
  rig.ticks_to_valid(20);
  rig.sensor.frozen = true;
  for (int i = 0; i < 18; i++) rig.tick();
  CHECK(rig.reading.valid);
  for (int i = 0; i < 20; i++) {
    if (i >= 4) CHECK(rig.reading.cause == Mpu6050::Cause::kFrozen);
    rig.tick();
  }
  CHECK(rig.driver.invalid(2) > 10);
  CHECK_FALSE(rig.driver.healthy());
  rig.sensor.frozen = false;
  CHECK(rig.ticks_to_valid(4) > 0);
}

TEST_CASE("MPU-6050: impossible readings are out of range") {
  const auto cause = [](uint8_t id, std::initializer_list<uint8_t> ends, uint8_t temp_high, uint8_t temp_low) {
    Rig rig;
    rig.power_on_as(id);
    rig.ticks_to_valid(20);
    uint8_t data[14] = {1, 2, 3, 4, 5, 6, temp_high, temp_low, 9, 10, 11, 12, 13, 14};
    for (uint8_t word : ends) {
      data[2 * word] = 0x7F;
      data[2 * word + 1] = 0xFF;
    }
    rig.driver.accept_burst(true, data, rig.now, rig.reading);
    return rig.reading.cause;
  };
  CHECK(cause(0x68, {}, 0xF0, 0x00) == Mpu6050::Cause::kNone);
  CHECK(cause(0x68, {0, 1}, 0xF0, 0x00) == Mpu6050::Cause::kNone);
  CHECK(cause(0x68, {0, 1, 2}, 0xF0, 0x00) == Mpu6050::Cause::kOutOfRange);
  CHECK(cause(0x68, {4, 5, 6}, 0xF0, 0x00) == Mpu6050::Cause::kOutOfRange);
  CHECK(cause(0x68, {}, 0x7F, 0xFF) == Mpu6050::Cause::kOutOfRange);  // 133 degC
  CHECK(cause(0x68, {}, 0x9A, 0x00) == Mpu6050::Cause::kOutOfRange);  // -41 degC
  CHECK(cause(0x70, {}, 0xB0, 0x00) == Mpu6050::Cause::kOutOfRange);  // -40.3 degC
  CHECK(cause(0x68, {}, 0xB0, 0x00) == Mpu6050::Cause::kNone);
}

TEST_CASE("MPU-6050: an axis at the end of its range is marked") {
  const auto saturated = [](uint8_t word, uint8_t high, uint8_t low) {
    Rig rig;
    rig.ticks_to_valid(20);
    uint8_t data[14] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14};
    data[2 * word] = high;
    data[2 * word + 1] = low;
    rig.driver.accept_burst(true, data, rig.now, rig.reading);
    CHECK(rig.reading.valid);
    return (rig.reading.accel_saturated ? 1 : 0) + (rig.reading.gyro_saturated ? 2 : 0);
  };
  CHECK(saturated(0, 0x7F, 0xFF) == 1);
  CHECK(saturated(2, 0x80, 0x00) == 1);
  CHECK(saturated(4, 0x80, 0x00) == 2);
  CHECK(saturated(6, 0x7F, 0xFF) == 2);
  CHECK(saturated(6, 0x7F, 0xFE) == 0);
}

TEST_CASE("MPU-6050: self-test, plain and excited at 8 g and 250 deg/s, then the settings of before") {
  Rig rig;
  rig.ticks_to_valid(20);
  Mpu6050::SelfTest result;
  rig.driver.start_self_test();
  int ticks = 0;
  for (; ticks < 100 && !rig.driver.take_self_test(result); ticks++) {
    rig.tick();
    CHECK_FALSE(rig.reading.valid);
  }
  CHECK(ticks < 60);
  for (uint8_t i = 0; i < 4; i++) CHECK(result.trim[i] == 0x11 * (i + 1));
  CHECK(result.plain[0] == 0x0001);
  CHECK(result.plain[5] == 0x0C0D);
  CHECK(result.excited[0] == 0x1011);
  CHECK(result.excited[5] == 0x1C1D);
  CHECK(rig.ticks_to_valid(10) > 0);
  CHECK(rig.sensor.registers[0x1B] == 0x10);
  CHECK(rig.sensor.registers[0x1C] == 0x10);
  CHECK_FALSE(rig.driver.take_self_test(result));
}
