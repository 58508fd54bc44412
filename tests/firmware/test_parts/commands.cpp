#include <Commands.h>
#include <GoldenFrames.h>
#include <doctest/doctest.h>

#include <cstring>

#include "support.h"

namespace {

using wire::NakReason;

// Notes the calls, as text.
class FakeBoard : public commands::Board {
 public:
  std::string log;
  bool is_streaming = false;
  bool has_imu = true;
  uint8_t ports = 3;
  uint8_t body_size = 40;  // an inertial sensor, a barometer and two mice
  uint16_t rate = 100;
  wire::Configure configured = {};

  bool streaming() const override { return is_streaming; }
  uint16_t sample_rate_hz() const override { return rate; }
  bool imu_present(uint8_t device) const override { return has_imu && device == 0; }
  uint8_t mouse_ports() const override { return ports; }
  uint8_t sample_size() const override { return body_size; }
  void send_hello() override { log += "hello "; }
  void send_pong(uint32_t token) override { log += "pong" + std::to_string(token) + " "; }
  void acknowledge(uint8_t command) override { log += "ack" + std::to_string(command) + " "; }
  void refuse(uint8_t command, NakReason reason) override {
    log += "nak" + std::to_string(command) + ":" + std::to_string(static_cast<int>(reason)) + " ";
  }
  void configure(const wire::Configure& settings) override {
    configured = settings;
    log += "configure ";
  }
  void start() override { log += "start "; }
  void stop() override { log += "stop "; }
  void reset_mice(uint8_t port_bits) override { log += "reset" + std::to_string(port_bits) + " "; }
  void self_test(uint8_t device) override { log += "test" + std::to_string(device) + " "; }
};

std::string carry_out(FakeBoard& board, uint8_t type, Bytes body = {}) {
  board.log.clear();
  const uint8_t size = static_cast<uint8_t>(body.size());
  body.resize(FrameDecoder::kKept);
  commands::carry_out(type, body.data(), size, board);
  return board.log;
}

Bytes configure_body(uint16_t rate, uint8_t accel, uint16_t gyro, uint8_t dlpf, uint8_t oversampling, uint8_t mouse) {
  const wire::Configure settings = {rate, accel, gyro, dlpf, oversampling, mouse, 400};
  Bytes body(sizeof settings);
  std::memcpy(body.data(), &settings, sizeof settings);
  return body;
}

std::string nak(uint8_t type, NakReason reason) {
  return "nak" + std::to_string(type) + ":" + std::to_string(static_cast<int>(reason)) + " ";
}

}  // namespace

TEST_CASE("commands without a condition") {
  FakeBoard board;
  CHECK(carry_out(board, wire::GetInfo::kType) == "hello ");
  CHECK(carry_out(board, wire::Ping::kType, {0x0D, 0x0C, 0, 0}) == "pong3085 ");
  CHECK(carry_out(board, wire::Start::kType) == "start ack131 ");
  CHECK(carry_out(board, wire::Stop::kType) == "stop ack132 ");
  CHECK(carry_out(board, wire::SelfTest::kType, {0}) == "test0 ack135 ");
  CHECK(carry_out(board, wire::ResetMice::kType, {5}) == "reset5 ack134 ");
}

TEST_CASE("CONFIGURE takes every value that the protocol allows") {
  FakeBoard board;
  for (uint16_t rate : {50, 64, 80, 100, 125, 128, 160, 200, 250, 320, 400, 500}) {
    CAPTURE(rate);
    CHECK(carry_out(board, wire::Configure::kType, configure_body(rate, 16, 2000, 6, 3, 4)) == "configure ack130 ");
    CHECK(uint16_t{board.configured.sample_rate_hz} == rate);
    CHECK(uint16_t{board.configured.gyro_range_deg_s} == 2000);
    CHECK(board.configured.mouse_counts_per_mm == 4);
  }
  for (uint8_t range : {2, 4, 8, 16}) {
    CHECK(carry_out(board, wire::Configure::kType, configure_body(100, range, 250, 0, 0, 1)) == "configure ack130 ");
  }
}

TEST_CASE("CONFIGURE names what is out of range, and changes nothing") {
  FakeBoard board;
  const auto refused = [&](const Bytes& body) { return carry_out(board, wire::Configure::kType, body); };
  for (uint16_t rate : {0, 1, 49, 99, 333, 501, 1000, 65535}) {
    CHECK(refused(configure_body(rate, 8, 1000, 3, 1, 8)) == nak(0x82, NakReason::kSampleRateOutOfRange));
  }
  for (uint8_t range : {0, 1, 3, 6, 32, 255}) {
    CHECK(refused(configure_body(100, range, 1000, 3, 1, 8)) == nak(0x82, NakReason::kAccelRangeOutOfRange));
  }
  for (uint16_t range : {0, 249, 750, 4000, 64000}) {
    CHECK(refused(configure_body(100, 8, range, 3, 1, 8)) == nak(0x82, NakReason::kGyroRangeOutOfRange));
  }
  CHECK(refused(configure_body(100, 8, 1000, 7, 1, 8)) == nak(0x82, NakReason::kDlpfOutOfRange));
  CHECK(refused(configure_body(100, 8, 1000, 3, 4, 8)) == nak(0x82, NakReason::kBaroOversamplingOutOfRange));
  CHECK(refused(configure_body(100, 8, 1000, 3, 1, 0)) == nak(0x82, NakReason::kMouseResolutionOutOfRange));
  CHECK(refused(configure_body(100, 8, 1000, 3, 1, 16)) == nak(0x82, NakReason::kMouseResolutionOutOfRange));
  Bytes odd_clock = configure_body(100, 8, 1000, 3, 1, 8);
  odd_clock[8] = 0x2C;  // 300 kHz
  odd_clock[9] = 1;
  CHECK(refused(odd_clock) == nak(0x82, NakReason::kI2cClockOutOfRange));
  board.is_streaming = true;
  CHECK(refused(configure_body(100, 8, 1000, 3, 1, 8)) == nak(0x82, NakReason::kStreaming));
}

TEST_CASE("a rate whose SAMPLEs the link does not carry is refused") {
  FakeBoard board;
  board.body_size = 48;  // with four mice
  CHECK(carry_out(board, 0x82, configure_body(500, 8, 1000, 3, 1, 8)) == nak(0x82, NakReason::kLinkTooSlow));
  CHECK(carry_out(board, 0x82, configure_body(400, 8, 1000, 3, 1, 8)) == "configure ack130 ");
  board.rate = 500;
  CHECK(carry_out(board, wire::Start::kType) == nak(0x83, NakReason::kLinkTooSlow));
  board.body_size = 40;
  CHECK(carry_out(board, wire::Start::kType) == "start ack131 ");
}

TEST_CASE("START while streaming is acknowledged and does not begin anew") {
  FakeBoard board;
  board.is_streaming = true;
  CHECK(carry_out(board, wire::Start::kType) == "ack131 ");
}

TEST_CASE("SELF_TEST needs a sensor that is not in use; RESET_MICE ports that there are") {
  FakeBoard board;
  CHECK(carry_out(board, wire::SelfTest::kType, {1}) == nak(0x87, NakReason::kSensorAbsent));
  CHECK(carry_out(board, wire::SelfTest::kType, {2}) == nak(0x87, NakReason::kSensorAbsent));
  board.has_imu = false;
  CHECK(carry_out(board, wire::SelfTest::kType, {0}) == nak(0x87, NakReason::kSensorAbsent));
  board.is_streaming = true;
  CHECK(carry_out(board, wire::SelfTest::kType, {0}) == nak(0x87, NakReason::kStreaming));
  CHECK(carry_out(board, wire::ResetMice::kType, {0}) == nak(0x86, NakReason::kMousePortOutOfRange));
  CHECK(carry_out(board, wire::ResetMice::kType, {8}) == nak(0x86, NakReason::kMousePortOutOfRange));
}

TEST_CASE("every unknown type and every wrong length is refused by name") {
  FakeBoard board;
  for (int type = 0; type < 256; type++) {
    if (type >= 0x81 && type <= 0x87) continue;
    CHECK(carry_out(board, static_cast<uint8_t>(type)) == nak(static_cast<uint8_t>(type), NakReason::kUnknownCommand));
  }
  for (uint8_t type = 0x81; type <= 0x87; type++) {
    CHECK(carry_out(board, type, Bytes(6)) == nak(type, NakReason::kBadLength));
  }
}

TEST_CASE("every golden command is known") {
  for (const GoldenFrame& golden : kGoldenFrames) {
    const Bytes payload = from_hex(golden.payload);
    if (payload[0] < 0x80) continue;
    CAPTURE(golden.name);
    FakeBoard board;
    const std::string done = carry_out(board, payload[0], Bytes(payload.begin() + 1, payload.end()));
    CHECK(done != nak(payload[0], NakReason::kUnknownCommand));
    CHECK(done != nak(payload[0], NakReason::kBadLength));
  }
}

// Bytes as a hostile or broken link gives them: frames of commands with bits flipped, cut, doubled, and plain noise.
TEST_CASE("fuzz: a million inputs, each answered once or counted, none out of bounds") {
  Random random(20240601);
  FakeBoard board;
  FrameDecoder decoder;
  uint32_t frames = 0, corrupt = 0;
  for (int round = 0; round < 1000000; round++) {
    Bytes body(random.below(random.below(8) == 0 ? 100 : 10));
    for (uint8_t& byte : body) byte = static_cast<uint8_t>(random.next());
    Bytes input = frame_of(static_cast<uint8_t>(0x80 + random.below(10)), body);
    for (uint32_t damage = random.below(3); damage > 0; damage--) {
      const uint32_t at = random.below(static_cast<uint32_t>(input.size()));
      switch (random.below(4)) {
        case 0: input[at] ^= static_cast<uint8_t>(1 << random.below(8)); break;
        case 1: input.resize(at + 1); break;
        case 2: input.insert(input.begin() + at, static_cast<uint8_t>(random.next())); break;
        default: input[at] = 0; break;
      }
    }
    board.is_streaming = random.below(2);
    for (uint8_t byte : input) {
      const FrameDecoder::Event event = decoder.push(byte);
      corrupt += event == FrameDecoder::Event::kCorrupt;
      if (event != FrameDecoder::Event::kFrame) continue;
      frames++;
      board.log.clear();
      commands::carry_out(decoder.type(), decoder.body(), decoder.size(), board);
      if (board.log.empty()) FAIL("no answer");
    }
  }
  CHECK(frames > 200000);
  CHECK(corrupt > 300000);
  CHECK(commands::line_carries(board.configured.sample_rate_hz, board.body_size));
}
