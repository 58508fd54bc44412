#include <Barometer.h>
#include <doctest/doctest.h>

#include "support.h"

namespace {

// The registers of a BMP180 with the datasheet's calibration and readings, and the time its conversions take.
class FakeSensor {
 public:
  bool answers = true;
  uint8_t control = 0;
  uint16_t ut = 27898;
  uint32_t up = 23843;
  Bytes calibration = {0x01, 0x98, 0xFF, 0xB8, 0xC7, 0xD1, 0x7F, 0xE5, 0x7F, 0xF5, 0x5A,
                       0x71, 0x18, 0x2E, 0x00, 0x04, 0x80, 0x00, 0xDD, 0xF9, 0x0B, 0x34};
  int temperatures = 0, pressures = 0;
  uint32_t ready_us = 0;
  bool read_early = false;
  uint32_t late_us = 0;  // how much longer than the data sheet permits a clone converts

  // Carries the request out; false when nobody answers.
  bool carry_out(const I2cRequest& request, uint32_t now_us, uint8_t* data) {
    if (!answers || request.address != 0x77) return false;
    if (request.write_count == 2) {
      if (request.write[0] != 0xF4) FAIL("unexpected register");
      control = request.write[1];
      const bool temperature = control == 0x2E;
      (temperature ? temperatures : pressures)++;
      ready_us = now_us + (temperature ? 4500 : Barometer::pressure_time_us(control >> 6));
      return true;
    }
    switch (request.write[0]) {
      case 0xD0: data[0] = 0x55; break;
      case 0xAA: std::copy(calibration.begin(), calibration.end(), data); break;
      case 0xF4: result(now_us, data); break;
      default: FAIL("unexpected register");
    }
    return true;
  }

 private:
  void result(uint32_t now_us, uint8_t* data) {
    read_early = read_early || now_us < ready_us;
    const uint32_t raw = control == 0x2E ? static_cast<uint32_t>(ut) << 8 : up << (8 - (control >> 6));
    const uint8_t sco = now_us < ready_us + late_us ? 0x20 : 0;
    const uint8_t bytes[] = {static_cast<uint8_t>((control & 0xDF) | sco), 0, static_cast<uint8_t>(raw >> 16),
                             static_cast<uint8_t>(raw >> 8), static_cast<uint8_t>(raw)};
    std::copy(bytes, bytes + 5, data);
  }
};

// One tick: the driver gets the bus until it needs it no more.
void tick(Barometer& driver, FakeSensor& sensor, uint32_t now_us) {
  uint8_t data[I2cRequest::kMaxRead];
  I2cRequest request;
  for (int i = 0; driver.next(now_us, request); i++) {
    if (i >= 10) FAIL("never done");
    const bool ok = sensor.carry_out(request, now_us, data);
    driver.finish(ok, data, now_us);
  }
}

}  // namespace

TEST_CASE("BMP180: the datasheet's readings at 100 Hz, one temperature for nine pressures") {
  Barometer driver(1);
  FakeSensor sensor;
  for (uint32_t n = 0; n < 1001; n++) tick(driver, sensor, n * 10000);
  CHECK(driver.valid());
  CHECK(driver.temperature() == 27898);
  CHECK(driver.pressure() == 23843);
  CHECK(driver.calibration()[0] == 408);
  CHECK(static_cast<int16_t>(driver.calibration()[10]) == 2868);
  CHECK(sensor.temperatures == 101);
  CHECK(sensor.pressures == 900);
  CHECK(driver.count() == 900 % 256);
  CHECK_FALSE(sensor.read_early);
  CHECK(driver.restarts() == 0);
}

TEST_CASE("BMP180: valid two conversions after power-on") {
  Barometer driver(1);
  FakeSensor sensor;
  for (uint32_t n = 0; n < 2; n++) tick(driver, sensor, n * 10000);
  CHECK_FALSE(driver.valid());
  tick(driver, sensor, 20000);
  CHECK(driver.valid());
}

TEST_CASE("BMP180: reports how long the conversion takes that it is about to start") {
  Barometer driver(1);
  FakeSensor sensor;
  uint8_t data[I2cRequest::kMaxRead];
  I2cRequest request;
  CHECK(driver.conversion_ahead_us() == 0);  // first it asks who answers
  for (int i = 0; i < 2; i++) {
    REQUIRE(driver.next(0, request));
    driver.finish(sensor.carry_out(request, 0, data), data, 0);
  }
  CHECK(driver.conversion_ahead_us() == 4500);  // a temperature comes first
  tick(driver, sensor, 0);
  CHECK(driver.conversion_ahead_us() == 0);  // it is under way
  REQUIRE(driver.next(10000, request));
  driver.finish(sensor.carry_out(request, 10000, data), data, 10000);
  CHECK(driver.conversion_ahead_us() == 7500);
}

TEST_CASE("BMP180: every oversampling is read no sooner than it is ready, at every rate") {
  for (uint8_t oversampling = 0; oversampling < 4; oversampling++) {
    for (uint32_t rate : {50, 100, 125, 200, 500}) {
      Barometer driver(oversampling);
      FakeSensor sensor;
      for (uint32_t n = 0; n < 4 * rate; n++) tick(driver, sensor, n * (1000000 / rate));
      CAPTURE(oversampling);
      CAPTURE(rate);
      CHECK_FALSE(sensor.read_early);
      CHECK(driver.pressure() == 23843);
      CHECK(sensor.pressures > 50);
    }
  }
}

TEST_CASE("BMP180: a sensor that is pulled and put back is valid again within 30 ms") {
  Barometer driver(1);
  FakeSensor sensor;
  uint32_t now = 0;
  for (; now < 500000; now += 10000) tick(driver, sensor, now);
  sensor.answers = false;
  for (; now < 700000; now += 10000) tick(driver, sensor, now);
  CHECK_FALSE(driver.present());
  CHECK_FALSE(driver.valid());
  sensor.answers = true;
  sensor.control = 0;
  for (; now < 720000; now += 10000) tick(driver, sensor, now);
  CHECK(driver.valid());
  CHECK(driver.restarts() == 1);
}

TEST_CASE("BMP180: a sensor that lost its supply unseen is set up again") {
  Barometer driver(1);
  FakeSensor sensor;
  uint32_t now = 0;
  for (; now < 500000; now += 10000) tick(driver, sensor, now);
  const uint8_t before = driver.count();
  sensor.control = 0;
  tick(driver, sensor, now);
  CHECK(driver.count() == before);
  CHECK_FALSE(driver.valid());
  for (now += 10000; now < 550000; now += 10000) tick(driver, sensor, now);
  CHECK(driver.valid());
  CHECK(driver.restarts() == 1);
}

TEST_CASE("BMP180: another sensor in its place starts with a temperature of its own") {
  Barometer driver(1);
  FakeSensor sensor;
  uint32_t now = 0;
  for (; now < 500000; now += 10000) tick(driver, sensor, now);
  sensor.answers = false;
  tick(driver, sensor, now);
  sensor.answers = true;
  sensor.calibration[1] ^= 1;
  const int before = sensor.temperatures;
  for (now += 10000; now < 530000; now += 10000) tick(driver, sensor, now);
  CHECK(sensor.temperatures == before + 1);
}

TEST_CASE("BMP180: calibration words of 0 or 0xFFFF, or another chip's id, are not used") {
  for (uint8_t rubbish : {0x00, 0xFF}) {
    Barometer driver(1);
    FakeSensor sensor;
    sensor.calibration[4] = sensor.calibration[5] = rubbish;
    for (uint32_t n = 0; n < 10; n++) tick(driver, sensor, n * 10000);
    CHECK_FALSE(driver.present());
    CHECK(driver.settled());
  }
}

TEST_CASE("BMP180: a result is not taken while Sco is set, and a clone that is a little late loses nothing") {
  Barometer driver(1);
  FakeSensor sensor;
  sensor.late_us = 6000;
  for (uint32_t n = 0; n < 400; n++) tick(driver, sensor, n * 10000);
  CHECK(driver.valid());
  CHECK(driver.restarts() == 0);
  CHECK(sensor.pressures - driver.count() <= 1);  // one is under way
  sensor.late_us = 1000000;  // it never ends
  for (uint32_t n = 400; n < 420; n++) tick(driver, sensor, n * 10000);
  CHECK(driver.restarts() >= 1);
}

namespace {

// A BMP280 at one of its addresses with the data sheet's example (BST-BMP280-DS001, 3.12).
class FakeBmp280 {
 public:
  uint8_t address = 0x76;
  uint8_t id = 0x58;
  uint8_t control = 0;

  bool carry_out(const I2cRequest& request, uint8_t* data) {
    if (request.address != address) return false;
    if (request.write_count == 2) {
      CHECK(request.write[0] == 0xF4);
      control = request.write[1];
      return true;
    }
    switch (request.write[0]) {
      case 0xD0: data[0] = id; break;
      case 0x88:
        for (uint8_t i = 0; i < request.read_count; i++) data[i] = static_cast<uint8_t>(i + 1);
        break;
      case 0xF3: {
        const uint8_t bytes[] = {0, static_cast<uint8_t>(control & 0xFC), 0, 0, 0x65, 0x5A, 0xC0, 0x7E, 0xED, 0x00};
        std::copy(bytes, bytes + 10, data);
        break;
      }
      default: FAIL("unexpected register");
    }
    return true;
  }
};

void tick(Barometer& driver, FakeBmp280& sensor, uint32_t now_us) {
  uint8_t data[I2cRequest::kMaxRead];
  I2cRequest request;
  for (int i = 0; driver.next(now_us, request); i++) {
    if (i >= 10) FAIL("never done");
    const bool ok = sensor.carry_out(request, data);
    driver.finish(ok, data, now_us);
  }
}

}  // namespace

TEST_CASE("BMP280: found at either address, named by its id, measured in forced mode") {
  for (uint8_t address : {0x76, 0x77}) {
    Barometer driver(1);
    FakeBmp280 sensor;
    sensor.address = address;
    for (uint32_t n = 0; n < 100; n++) tick(driver, sensor, n * 10000);
    CHECK(driver.valid());
    CHECK(driver.id() == 0x58);
    CHECK(driver.family() == Barometer::kBmp280);
    CHECK(driver.address() == address);
    CHECK(driver.pressure() == 415148);
    CHECK(driver.temperature() == 519888 / 16);
    CHECK(driver.calibration()[0] == 0x0201);
    CHECK(driver.calibration()[11] == 0x1817);
    CHECK(sensor.control == 0x29);  // temperature x1, pressure x2, forced
    CHECK(driver.count() > 80);
  }
}

TEST_CASE("Barometer: another chip's id is kept and the chip is not used") {
  Barometer driver(1);
  FakeBmp280 sensor;
  sensor.id = 0x61;
  for (uint32_t n = 0; n < 100; n++) tick(driver, sensor, n * 10000);
  CHECK_FALSE(driver.present());
  CHECK(driver.unsupported());
  CHECK(driver.id() == 0x61);
}
