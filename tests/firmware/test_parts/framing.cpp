#include <Crc16.h>
#include <GoldenFrames.h>
#include <doctest/doctest.h>

#include "support.h"

namespace {

using Event = FrameDecoder::Event;

struct Decoded {
  Event event = Event::kNone;
  uint8_t type = 0;
  Bytes body;  // its kept part
  uint8_t size = 0;
};

Decoded decode(const Bytes& frame) {
  FrameDecoder decoder;
  Decoded result;
  for (uint8_t byte : frame) {
    const Event event = decoder.push(byte);
    if (event == Event::kNone) continue;
    result.event = event;
    result.type = decoder.type();
    result.size = decoder.size();
    const size_t kept = result.size < FrameDecoder::kKept ? result.size : FrameDecoder::kKept;
    result.body.assign(decoder.body(), decoder.body() + kept);
  }
  return result;
}

}  // namespace

TEST_CASE("golden frames are those of the schema that the header was made from") {
  CHECK(kGoldenSchemaCrc == wire::kSchemaCrc);
}

TEST_CASE("CRC-16 gives the golden values") {
  for (const GoldenCrc& golden : kGoldenCrcs) {
    Crc16 crc;
    for (uint8_t byte : from_hex(golden.data)) crc.add(byte);
    CHECK(crc.value() == golden.crc);
  }
}

TEST_CASE("every golden frame is encoded to the byte") {
  for (const GoldenFrame& golden : kGoldenFrames) {
    CAPTURE(golden.name);
    const Bytes payload = from_hex(golden.payload);
    CHECK(frame_of(payload[0], Bytes(payload.begin() + 1, payload.end())) == from_hex(golden.frame));
  }
}

TEST_CASE("every golden frame is decoded") {
  for (const GoldenFrame& golden : kGoldenFrames) {
    CAPTURE(golden.name);
    const Bytes payload = from_hex(golden.payload);
    const Decoded decoded = decode(from_hex(golden.frame));
    REQUIRE(decoded.event == Event::kFrame);
    CHECK(decoded.type == payload[0]);
    REQUIRE(decoded.size == payload.size() - 1);
    CHECK(std::equal(decoded.body.begin(), decoded.body.end(), payload.begin() + 1));
  }
}

TEST_CASE("a frame that is broken is corrupt; one of an unknown type or length is left to the commands") {
  for (const RejectedFrame& rejected : kRejectedFrames) {
    CAPTURE(rejected.name);
    const std::string name = rejected.name, cause = rejected.cause;
    const bool whole = cause == "type" || name.find("body one byte") != std::string::npos || name.find("declares") != std::string::npos;
    CHECK(decode(from_hex(rejected.frame)).event == (whole ? Event::kFrame : Event::kCorrupt));
  }
}

TEST_CASE("after any rubbish the decoder is in step at the next 0x00") {
  const Bytes good = frame_of(wire::Ping::kType, {1, 0, 0, 4});
  Random random(1);
  int in_step = 0;
  for (int round = 0; round < 2000; round++) {
    FrameDecoder decoder;
    for (uint32_t i = random.below(300); i > 0; i--) decoder.push(static_cast<uint8_t>(random.next()));
    decoder.push(0);
    Event last = Event::kNone;
    for (uint8_t byte : good) last = decoder.push(byte);
    in_step += last == Event::kFrame && decoder.type() == wire::Ping::kType;
  }
  CHECK(in_step == 2000);
}

TEST_CASE("every single-bit error in a frame is found") {
  const Bytes good = frame_of(wire::Configure::kType, {100, 0, 8, 0xE8, 3, 3, 1, 8, 0x90, 1});
  int accepted = 0;
  for (size_t bit = 0; bit < 8 * (good.size() - 1); bit++) {
    Bytes bad = good;
    bad[bit / 8] ^= static_cast<uint8_t>(1 << bit % 8);
    FrameDecoder decoder;
    for (uint8_t byte : bad) accepted += decoder.push(byte) == Event::kFrame;
  }
  CHECK(accepted == 0);
}
