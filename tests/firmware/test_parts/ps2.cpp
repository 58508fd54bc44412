#include <Ps2Bits.h>
#include <Ps2Mouse.h>
#include <doctest/doctest.h>

#include <algorithm>
#include <deque>

#include "support.h"

namespace {

using Act = Ps2Bits::Act;
using Ending = Ps2Mouse::Ending;
using Outcome = Ps2Bits::Outcome;

constexpr uint8_t kBitSteps = 1;  // a bit takes 60 to 100 us

bool odd_parity(uint8_t byte) { return __builtin_parity(byte) == 0; }

// The line of one port, with the time of its edges.
class Line {
 public:
  Ps2Bits bits;
  uint8_t now = 0;
  Act last = Act::kNone;

  void edge(bool data, uint8_t steps = kBitSteps) {
    now = static_cast<uint8_t>(now + steps);
    last = bits.falling_edge(data, now);
  }
  // The 11 bits of a byte from the mouse; stops when the host holds the clock.
  void byte(uint8_t value, bool bad_parity = false, int clocks = 11, bool stop = true) {
    const uint16_t frame = static_cast<uint16_t>(value << 1 | (odd_parity(value) != bad_parity) << 9 | stop << 10);
    for (int i = 0; i < clocks; i++) edge(frame >> i & 1);
  }
  // Takes in a byte as the mouse does, and gives what it read: 8 bits, parity, stop.
  uint16_t take(bool acknowledged = true) {
    uint16_t read = 0;
    bool data = false;  // the start bit
    for (int i = 0; i < 10; i++) {
      edge(data);
      if (last == Act::kDataHigh) data = true;
      if (last == Act::kDataLow) data = false;
      read |= static_cast<uint16_t>(data << i);
    }
    edge(!acknowledged);
    return read;
  }
};

// A mouse in remote mode, as far as the transactions of Ps2Mouse show.
class FakeMouse {
 public:
  bool present = true;
  bool repeats_whole = true;
  Bytes refuses;       // commands answered with RESEND each time
  Bytes refuses_once;  // the next time
  bool remote_works = true;
  bool remote = false, enabled = false;
  uint8_t resolution = 2, rate = 60, id = 0x00;
  int x = 0, y = 0;  // moved, not yet reported
  int resets = 0;
  std::deque<bool> bad_parity;  // of the next bytes
  uint8_t first_flags = 0x08;
  Bytes log;

  // Plays one transaction; the bytes that came stay in `received`.
  Ps2Mouse::Answer play(const Ps2Mouse::Request& request, Bytes& received) {
    received.clear();
    if (!present) return {Ending::kTimeout, 0, nullptr};
    if (request.sends) obey(request.byte);
    while (!output_.empty() && received.size() < request.answers) {
      const bool bad = !bad_parity.empty() && bad_parity.front();
      if (!bad_parity.empty()) bad_parity.pop_front();
      const uint8_t byte = output_.front();
      output_.pop_front();
      sent_++;
      if (bad) return answer(Ending::kBadParity, received);
      received.push_back(byte);
      if (request.acknowledged && received.size() == 1 && byte != 0xFA) return answer(Ending::kRefused, received);
    }
    return answer(received.size() == request.answers ? Ending::kDone : Ending::kTimeout, received);
  }

  void power_on() { output_ = {0xAA, 0x00}; }
  void report_by_itself() {
    report();
    output_.pop_front();  // without ACK
  }

 private:
  static Ps2Mouse::Answer answer(Ending ending, const Bytes& received) {
    return {ending, static_cast<uint8_t>(received.size()), received.data()};
  }

  void obey(uint8_t byte) {
    log.push_back(byte);
    if (byte == 0xFE) return repeat();
    output_.clear();
    if (refuses_now(byte)) return send({0xFE});
    if (byte >= 0xE6) argument_of_ = 0;  // a command takes the place of a missing argument
    if (argument_of_ != 0) {
      (argument_of_ == 0xE8 ? resolution : rate) = byte;
      argument_of_ = 0;
      return send({0xFA});
    }
    switch (byte) {
      case 0xFF:
        resets++;
        remote = enabled = false;
        resolution = 2;
        send({0xFA});
        output_.push_back(0xAA);
        output_.push_back(0x00);
        break;
      case 0xE8:
      case 0xF3:
        argument_of_ = byte;
        send({0xFA});
        break;
      case 0xF2: send({0xFA, id}); break;
      case 0xE9: send({0xFA, static_cast<uint8_t>(remote << 6 | enabled << 5), resolution, rate}); break;
      case 0xEB: report(); break;
      case 0xF0:
        remote = remote_works;
        send({0xFA});
        break;
      case 0xF4:
        enabled = true;
        send({0xFA});
        break;
      case 0xF6:
        remote = enabled = false;
        resolution = 2;
        rate = 100;
        send({0xFA});
        break;
      default: send({0xFA}); break;
    }
  }

  bool refuses_now(uint8_t byte) {
    const auto once = std::find(refuses_once.begin(), refuses_once.end(), byte);
    if (once != refuses_once.end()) {
      refuses_once.erase(once);
      return true;
    }
    return std::find(refuses.begin(), refuses.end(), byte) != refuses.end();
  }

  void report() {
    const uint8_t flags = static_cast<uint8_t>(first_flags | (x < 0 ? 0x10 : 0) | (y < 0 ? 0x20 : 0));
    send({0xFA, flags, static_cast<uint8_t>(x), static_cast<uint8_t>(y)});
    x = y = 0;
  }
  void send(const Bytes& bytes) {
    output_.assign(bytes.begin(), bytes.end());
    said_ = bytes;
    sent_ = 0;
  }
  // FA is a chunk of its own, and so is what follows it.
  void repeat() {
    const size_t chunk = sent_ <= 1 ? 0 : 1;
    const size_t from = repeats_whole || chunk == 0 ? chunk : sent_ - 1;
    output_.assign(said_.begin() + static_cast<long>(from), said_.end());
    sent_ = from;
  }

  std::deque<uint8_t> output_;
  Bytes said_;
  size_t sent_ = 0;
  uint8_t argument_of_ = 0;
};

class Rig {
 public:
  FakeMouse mouse;
  Ps2Mouse driver{8};
  Bytes received;

  void step() {
    if (driver.polls()) driver.begin_round();
    const Ps2Mouse::Request request = driver.next();
    if (!request.sends && driver.running() && mouse.enabled && (mouse.x != 0 || mouse.y != 0)) mouse.report_by_itself();
    driver.finish(mouse.play(request, received));
    if (driver.polls() && driver.answered()) driver.complete_round();
  }
  bool start(int limit = 20) {
    for (int i = 0; i < limit && !driver.valid(); i++) step();
    return driver.valid();
  }
};

}  // namespace

TEST_CASE("PS/2: every byte goes out with its parity and stop bit, and is acknowledged") {
  for (int value = 0; value < 256; value++) {
    const uint8_t byte = static_cast<uint8_t>(value);
    Line line;
    line.bits.begin_sending(byte, 1, true);
    CHECK(line.take() == (value | odd_parity(byte) << 8 | 1 << 9));
    line.byte(0xFA);
    CHECK(line.bits.outcome() == Outcome::kDone);
    CHECK(line.last == Act::kHoldClock);
  }
}

TEST_CASE("PS/2: a byte without the mouse's acknowledge bit was not taken") {
  Line line;
  line.bits.begin_sending(0xEB, 4, true);
  line.take(false);
  CHECK(line.bits.outcome() == Outcome::kNotTaken);
  CHECK(line.last == Act::kHoldClock);
}

TEST_CASE("PS/2: an answer other than ACK ends a command at once, but not a repetition") {
  for (uint8_t answer : {uint8_t{0xFE}, uint8_t{0xFC}, uint8_t{0xAA}}) {
    Line line;
    line.bits.begin_sending(0xEB, 4, true);
    line.take();
    line.byte(answer);
    CHECK(line.bits.outcome() == Outcome::kRefused);
    CHECK(line.last == Act::kHoldClock);
    CHECK(line.bits.bytes()[0] == answer);
    line.bits.begin_sending(0xFE, 3, false);
    line.take();
    line.byte(answer);
    CHECK(line.bits.outcome() == Outcome::kRunning);
  }
}

TEST_CASE("PS/2: every byte is received, and the clock is held after the last") {
  for (int value = 0; value < 256; value++) {
    Line line;
    line.bits.begin_receiving(2);
    line.byte(static_cast<uint8_t>(value));
    CHECK(line.bits.outcome() == Outcome::kRunning);
    CHECK(line.last == Act::kNone);
    line.byte(0x55);
    CHECK(line.bits.outcome() == Outcome::kDone);
    CHECK(line.last == Act::kHoldClock);
    CHECK(line.bits.bytes()[0] == value);
  }
}

TEST_CASE("PS/2: a byte of bad parity is not used, and the clock is held at its stop bit") {
  Line line;
  line.bits.begin_receiving(4);
  line.byte(0xFA);
  line.byte(0x08, true);
  CHECK(line.bits.outcome() == Outcome::kBadParity);
  CHECK(line.last == Act::kHoldClock);
  CHECK(line.bits.received() == 1);
}

TEST_CASE("PS/2: a missing clock is found at the next byte's start bit") {
  Line line;
  line.bits.begin_receiving(4);
  line.byte(0x08, false, 9);
  line.edge(true);  // its stop bit at the place of the parity
  line.edge(false);
  CHECK(line.bits.outcome() == Outcome::kBadFraming);
  CHECK(line.last == Act::kHoldClock);
}

TEST_CASE("PS/2: a byte whose clock stops for 2 ms is given up") {
  Line line;
  line.bits.begin_receiving(1);
  line.byte(0x33, false, 5);
  line.edge(false, 2000 / Ps2Bits::kStepUs + 1);
  for (int i = 1; i < 11; i++) line.edge((0x47 << 1 | odd_parity(0x47) << 9 | 1 << 10) >> i & 1);
  CHECK(line.bits.outcome() == Outcome::kDone);
  CHECK(line.bits.bytes()[0] == 0x47);
  CHECK(line.bits.resyncs() == 1);
}

TEST_CASE("PS/2: a slow mouse, 10 kHz, is not taken for one that stopped") {
  Line line;
  line.bits.begin_receiving(1);
  for (int i = 0; i < 11; i++) line.edge((0x47 << 1 | odd_parity(0x47) << 9 | 1 << 10) >> i & 1, 2);
  CHECK(line.bits.outcome() == Outcome::kDone);
  CHECK(line.bits.resyncs() == 0);
}

TEST_CASE("PS/2 fuzz: a million edges at random do no harm, and a sound transaction works after any of them") {
  Random random(99);
  Line line;
  int working = 0;
  for (int round = 0; round < 20000; round++) {
    if (random.below(2)) {
      line.bits.begin_sending(static_cast<uint8_t>(random.next()), static_cast<uint8_t>(1 + random.below(4)), random.below(2));
    } else {
      line.bits.begin_receiving(static_cast<uint8_t>(1 + random.below(4)));
    }
    for (int i = 0; i < 50; i++) line.edge(random.below(2), static_cast<uint8_t>(random.below(64) ? 1 : random.next()));
    if (line.bits.received() > Ps2Bits::kMaxAnswers) FAIL("too many");
    line.bits.begin_sending(0xF2, 2, true);
    const bool sent = line.take() == (0xF2 | odd_parity(0xF2) << 8 | 1 << 9);
    line.byte(0xFA);
    line.byte(0x03);
    working += sent && line.bits.outcome() == Outcome::kDone && line.bits.bytes()[1] == 0x03;
  }
  CHECK(working == 20000);
}

TEST_CASE("PS/2 mouse: set up as wanted, and its settings read back") {
  Rig rig;
  rig.mouse.id = 0x03;
  REQUIRE(rig.start());
  CHECK(rig.driver.id() == 0x03);
  CHECK(rig.driver.counts_per_mm() == 8);
  CHECK(rig.driver.report_rate_hz() == 200);
  CHECK(rig.driver.status() == 0x60);
  CHECK(rig.driver.lacks() == 0);
  CHECK(rig.mouse.log == Bytes{0xF6, 0xF6, 0xF2, 0xE6, 0xE8, 3, 0xF3, 200, 0xF0, 0xF4, 0xE9, 0xEB, 0xEB});
}

TEST_CASE("PS/2 mouse: a new resolution waits for the poll that runs, and every step of the set-up is taken") {
  Rig rig;
  rig.start();
  rig.mouse.x = 7;
  rig.driver.begin_round();
  const Ps2Mouse::Request poll = rig.driver.next();
  rig.driver.configure(2);
  rig.driver.finish(rig.mouse.play(poll, rig.received));
  CHECK(rig.driver.dx() == 7);
  rig.mouse.log.clear();
  for (int i = 0; i < 12; i++) rig.step();
  CHECK(rig.mouse.log == Bytes{0xF6, 0xF2, 0xE6, 0xE8, 1, 0xF3, 200, 0xF0, 0xF4, 0xE9, 0xEB, 0xEB});
  CHECK(rig.driver.valid());
  CHECK(rig.driver.counts_per_mm() == 2);
}

TEST_CASE("PS/2 mouse: movement is 9 bits signed, summed until it is taken; overflow is passed on") {
  Rig rig;
  rig.start();
  const int moves[][2] = {{255, -256}, {-1, 1}, {-256, 255}, {0, 0}};
  for (const auto& move : moves) {
    rig.mouse.x = move[0];
    rig.mouse.y = move[1];
    rig.step();
  }
  CHECK(rig.driver.dx() == -2);
  CHECK(rig.driver.dy() == 0);
  CHECK_FALSE(rig.driver.overflow());
  rig.mouse.first_flags = 0x48;
  rig.mouse.x = 255;
  rig.step();
  CHECK(rig.driver.overflow());
  CHECK(rig.driver.dx() == 253);
  rig.driver.forget_movement();
  CHECK(rig.driver.dx() == 0);
  CHECK_FALSE(rig.driver.overflow());
}

TEST_CASE("PS/2 mouse: no count is lost to bytes of bad parity, whatever the mouse repeats") {
  for (bool whole : {true, false}) {
    for (int bad_byte = 0; bad_byte < 4; bad_byte++) {
      CAPTURE(whole);
      CAPTURE(bad_byte);
      Rig rig;
      rig.mouse.repeats_whole = whole;
      rig.start();
      rig.mouse.x = 8;  // the byte that follows the flags equals them
      rig.mouse.y = -5;
      rig.mouse.bad_parity.assign(4, false);
      rig.mouse.bad_parity[static_cast<size_t>(bad_byte)] = true;
      rig.step();
      CHECK(rig.driver.dx() == 0);
      rig.step();
      CHECK(rig.driver.dx() == 8);
      CHECK(rig.driver.dy() == -5);
      CHECK(rig.driver.parity_errors() == 1);
      rig.step();
      CHECK(rig.driver.dx() == 8);
      CHECK(rig.driver.valid());
    }
  }
}

TEST_CASE("PS/2 mouse: parity errors in the repetition too") {
  Rig rig;
  rig.start();
  rig.mouse.x = 30;
  rig.mouse.bad_parity = {false, false, true, false, true, true, false, false, false};
  for (int i = 0; i < 4; i++) rig.step();
  CHECK(rig.driver.dx() == 30);
  CHECK(rig.driver.parity_errors() == 3);
}

TEST_CASE("PS/2 mouse: reset after five packets that are none") {
  Rig rig;
  rig.start();
  rig.mouse.first_flags = 0;
  rig.mouse.x = 9;
  for (int i = 0; i < 5; i++) {
    CHECK(rig.mouse.resets == 0);
    rig.step();
  }
  rig.step();
  CHECK(rig.mouse.resets == 1);
  CHECK(rig.driver.resets() == 1);
  CHECK(rig.driver.dx() == 0);
  rig.mouse.first_flags = 0x08;
  CHECK(rig.start());
  CHECK(rig.driver.counts_per_mm() == 8);
}

TEST_CASE("PS/2 mouse: pulled, it is missed after three polls; put back, it announces itself and is set up") {
  Rig rig;
  rig.start();
  rig.mouse.present = false;
  rig.step();
  CHECK_FALSE(rig.driver.valid());
  CHECK(rig.driver.id() == 0x00);
  for (int i = 0; i < 2; i++) rig.step();
  CHECK(rig.driver.id() == uint8_t{Ps2Mouse::kNoId});
  CHECK(rig.driver.counts_per_mm() == 0);
  for (int i = 0; i < 10; i++) rig.step();
  while (rig.driver.next().sends) rig.step();
  rig.mouse.present = true;
  rig.mouse.power_on();
  CHECK(rig.start());
  CHECK(rig.driver.ever_found());
}

TEST_CASE("PS/2 mouse: one that was there before the board is found by the probe; an empty port stays empty") {
  Rig rig;
  rig.mouse.present = false;
  for (int i = 0; i < 5; i++) rig.step();
  CHECK(rig.driver.probed());
  CHECK_FALSE(rig.driver.ever_found());
  rig.mouse.present = true;
  CHECK(rig.start());
}

TEST_CASE("PS/2 mouse: RESET_MICE resets and sets up again") {
  Rig rig;
  rig.start();
  rig.driver.reset();
  rig.step();
  CHECK(rig.mouse.resets == 1);
  CHECK_FALSE(rig.driver.valid());
  CHECK(rig.start());
  CHECK(rig.driver.resets() == 1);
}

TEST_CASE("PS/2 mouse: every command may be refused once, arguments too") {
  for (uint8_t byte : {0xF6, 0xF2, 0xE6, 0xE8, 3, 0xF3, 200, 0xF0, 0xF4, 0xE9}) {
    CAPTURE(byte);
    Rig rig;
    rig.mouse.refuses_once = {byte};
    REQUIRE(rig.start());
    CHECK(rig.driver.lacks() == 0);
    CHECK(rig.driver.status() == 0x60);
  }
}

TEST_CASE("PS/2 mouse: an answer with bad parity in the set-up is requested again") {
  for (size_t bad = 0; bad < 12; bad++) {
    CAPTURE(bad);
    Rig rig;
    rig.mouse.bad_parity.assign(bad + 1, false);
    rig.mouse.bad_parity[bad] = true;
    REQUIRE(rig.start(25));
    CHECK(rig.driver.lacks() == 0);
    CHECK(rig.driver.counts_per_mm() == 8);
  }
}

TEST_CASE("PS/2 mouse: commands that are refused each time are reported, and the mouse works without them") {
  const struct {
    Bytes refuses;
    uint8_t lacks;
  } cases[] = {{{0xE6, 0xF2}, 0},
               {{0xE8}, Ps2Mouse::kLacksResolution},
               {{200}, Ps2Mouse::kLacksSampleRate},
               {{0xF4}, Ps2Mouse::kLacksEnable},
               {{0xE9}, Ps2Mouse::kLacksStatus},
               {{0xF0}, Ps2Mouse::kLacksRemoteMode},
               {{0xEB}, Ps2Mouse::kLacksRemoteMode}};
  for (const auto& each : cases) {
    Rig rig;
    rig.mouse.refuses = each.refuses;
    REQUIRE(rig.start(60));
    for (int i = 0; i < 40; i++) rig.step();
    CHECK(rig.driver.lacks() == each.lacks);
    rig.driver.forget_movement();
    rig.mouse.x = 12;
    rig.step();
    CHECK(rig.driver.dx() == 12);
  }
}

TEST_CASE("PS/2 mouse: remote mode that STATUS does not confirm is not used") {
  Rig rig;
  rig.mouse.remote_works = false;
  REQUIRE(rig.start());
  CHECK(rig.driver.lacks() == uint8_t{Ps2Mouse::kLacksRemoteMode});
  CHECK(rig.driver.status() == 0x20);
  for (int i = 0; i < 200; i++) rig.step();
  CHECK(rig.driver.valid());
  rig.mouse.present = false;
  for (int i = 0; i < 60; i++) rig.step();
  CHECK_FALSE(rig.driver.running());
}

TEST_CASE("PS/2 mouse: a refused poll leaves the counts in the mouse and its driver unanswered") {
  Rig rig;
  rig.start();
  rig.mouse.x = 21;
  rig.mouse.refuses_once = {0xEB};
  rig.step();
  CHECK_FALSE(rig.driver.answered());
  CHECK(rig.driver.valid());
  rig.step();
  CHECK(rig.driver.answered());
  CHECK(rig.driver.dx() == 21);
}

TEST_CASE("PS/2 mouse: what it counted before the first complete round is not measured") {
  Rig rig;
  while (!rig.driver.running()) rig.step();
  rig.mouse.x = 50;
  rig.step();
  CHECK_FALSE(rig.driver.valid());
  CHECK(rig.driver.dx() == 0);
  rig.mouse.x = 3;
  rig.step();
  CHECK(rig.driver.valid());
  CHECK(rig.driver.dx() == 3);
}

TEST_CASE("PS/2 mouse fuzz: a mouse that answers at random is survived, and set up when it comes to its senses") {
  Random random(4);
  for (int round = 0; round < 2000; round++) {
    Rig rig;
    Bytes bytes(4);
    for (int i = 0; i < 100; i++) {
      const Ps2Mouse::Request request = rig.driver.next();
      for (uint8_t& byte : bytes) byte = random.below(3) ? uint8_t{0xFA} : static_cast<uint8_t>(random.next());
      const Ending ending = static_cast<Ending>(random.below(5));
      const uint8_t count = ending == Ending::kDone ? request.answers : static_cast<uint8_t>(random.below(request.answers));
      rig.driver.finish({ending, count, bytes.data()});
    }
    rig.driver.reset();
    if (!rig.start(40)) FAIL("never set up");
  }
}
