#include <doctest/doctest.h>

#include "support.h"

TEST_CASE("the ring sends whole frames or none, and counts those it drops") {
  Random random(7);
  TransmitRing ring;
  FrameDecoder decoder;
  uint32_t accepted = 0, refused = 0, received = 0, broken = 0;
  Bytes expected_types;
  for (int round = 0; round < 200000; round++) {
    if (random.below(3) == 0) {
      Bytes body(random.below(wire::kMaxPayloadToHost - 2));
      for (uint8_t& byte : body) byte = random.below(4) == 0 ? 0 : static_cast<uint8_t>(random.next());
      const uint8_t type = static_cast<uint8_t>(1 + random.below(255));
      if (ring.put(type, body.data(), static_cast<uint8_t>(body.size()))) {
        accepted++;
        expected_types.push_back(type);
      } else {
        refused++;
      }
    }
    for (uint32_t i = random.below(20); i > 0 && !ring.empty(); i--) {
      const FrameDecoder::Event event = decoder.push(ring.take());
      if (event == FrameDecoder::Event::kFrame && decoder.type() == expected_types[received]) {
        received++;
      } else if (event != FrameDecoder::Event::kNone) {
        broken++;
      }
    }
  }
  for (uint8_t byte : drain(ring)) received += decoder.push(byte) == FrameDecoder::Event::kFrame;
  CHECK(broken == 0);
  CHECK(refused > 1000);
  CHECK(received == accepted);
  CHECK(ring.dropped() == refused);
}

TEST_CASE("a full ring keeps what it has") {
  TransmitRing ring;
  const Bytes body(40, 0);
  uint32_t fitted = 0;
  while (ring.put(1, body.data(), 40)) fitted++;
  CHECK(fitted == 255 / 45);
  CHECK(ring.dropped() == 1);
  CHECK(drain(ring).size() == fitted * 45);
  CHECK(ring.put(1, body.data(), 40));
}
