#include "Link.h"

#include <Idle.h>
#include <System.h>
#include <Twi.h>
#include <Uart.h>
#include <avr/pgmspace.h>
#include <stddef.h>
#include <string.h>

namespace {

// HELLO goes out at boot when all sensors are set up or found absent, and after this time at the latest.
constexpr uint32_t kGreetUs = 300000;
constexpr uint32_t kStatusUs = 1000000;

// Which firmware this is. It stands in the flash as it goes out in HELLO, behind a mark that `linkpose flash` looks for in
// a .hex before it writes it. The members are the first of wire::Hello.
struct __attribute__((packed)) Identity {
  char mark[8];
  uint8_t protocol_major;
  uint8_t protocol_minor;
  uint32_t schema_crc;
  uint8_t firmware_major;
  uint8_t firmware_minor;
  uint8_t firmware_patch;
  uint32_t source_revision;
};
constexpr size_t kIdentityInHello = sizeof(Identity) - sizeof Identity::mark;
static_assert(kIdentityInHello == offsetof(wire::Hello, reset_cause), "HELLO begins with the identity");

const Identity kIdentity PROGMEM = {
    {'l', 'i', 'n', 'k', 'p', 'o', 's', 'e'},
    wire::kProtocolMajor, wire::kProtocolMinor, wire::kSchemaCrc,
    wire::kVersionMajor, wire::kVersionMinor, wire::kVersionPatch,
    LINKPOSE_SOURCE_REVISION,
};

wire::DeviceState state_of(Ps2Mouse::Presence presence) {
  switch (presence) {
    case Ps2Mouse::Presence::kStarting: return wire::DeviceState::kStarting;
    case Ps2Mouse::Presence::kRunning: return wire::DeviceState::kOk;
    case Ps2Mouse::Presence::kLost: return wire::DeviceState::kFailed;
    default: return wire::DeviceState::kAbsent;
  }
}

}  // namespace

void Link::note_pass(uint32_t us) {
  if (us > longest_pass_us_) longest_pass_us_ = us < UINT16_MAX ? static_cast<uint16_t>(us) : UINT16_MAX;
}

void Link::run() {
  receive();
  greet();
  send_status();
}

void Link::configure(const wire::Configure& settings) {
  sampler_.configure(settings);
  mice_.configure(settings.mouse_counts_per_mm);
}

void Link::receive() {
  uint8_t byte;
  while (uart::take(byte, received_us_)) {
    switch (decoder_.push(byte)) {
      case FrameDecoder::Event::kNone: break;
      case FrameDecoder::Event::kCorrupt: corrupt_++; break;
      case FrameDecoder::Event::kFrame:
        commands::carry_out(decoder_.type(), decoder_.body(), decoder_.size(), *this);
        break;
    }
  }
}

void Link::greet() {
  if (greeted_ || !((sampler_.sensors_settled() && mice_.probed()) || clock::now_us() > kGreetUs)) return;
  greeted_ = true;
  send_hello();
}

void Link::send_hello() {
  const wire::Configure& settings = sampler_.settings();
  wire::Hello hello;
  memcpy_P(&hello, &kIdentity.protocol_major, kIdentityInHello);
  hello.reset_cause = board::reset_cause();
  hello.hung_at = board::hung_at();
  hello.streaming = sampler_.streaming();
  hello.sections = sampler_.sections();
  hello.sample_rate_hz = settings.sample_rate_hz;
  hello.accel_range_g = settings.accel_range_g;
  hello.gyro_range_deg_s = settings.gyro_range_deg_s;
  hello.dlpf = settings.dlpf;
  hello.baro_oversampling = settings.baro_oversampling;
  hello.mouse_counts_per_mm = settings.mouse_counts_per_mm;
  hello.i2c_khz = settings.i2c_khz;
  sampler_.describe(hello.devices);
  static_assert(sizeof hello.baro_words == 2 * Barometer::kWords, "all words");
  memcpy(hello.baro_words, sampler_.baro().calibration(), sizeof hello.baro_words);
  for (uint8_t i = 0; i < Mice::kPorts; i++) {
    const Ps2Mouse& mouse = mice_.mouse(i);
    hello.mice[i] = {static_cast<uint8_t>(state_of(mouse.presence())), mouse.id(), mouse.status(),
                     mouse.counts_per_mm(), mouse.report_rate_hz(), mouse.lacks()};
  }
  uart::put(wire::Hello::kType, &hello, wire::Hello::size(Mice::kPorts));
}

void Link::send_status() {
  const uint32_t now = clock::now_us();
  const uint32_t elapsed_us = now - status_us_;
  if (elapsed_us < kStatusUs) return;
  status_us_ = now;
  const uint32_t awake_us = idle::take_awake_us();
  const uint16_t longest_pass_us = longest_pass_us_;
  longest_pass_us_ = 0;
  if (!sampler_.streaming()) return;

  wire::Status status;
  status.t_us = now;
  status.ticks = clock::tick().number;
  status.ticks_missed = sampler_.ticks_missed();
  status.frames_dropped = uart::frames_dropped();
  status.commands_corrupt = corrupt_;
  status.rx_overruns = uart::overruns();
  status.i2c_errors = twi::errors();
  status.i2c_recoveries = twi::recoveries();
  status.loop_worst_us = longest_pass_us;
  status.stack_free = board::free_stack();
  status.cpu_load = static_cast<uint16_t>(awake_us / (elapsed_us / 1000));
  status.vcc_mv = board::supply_mv();
  sampler_.count(status.devices);
  for (uint8_t i = 0; i < Mice::kPorts; i++) {
    const Ps2Mouse& mouse = mice_.mouse(i);
    status.mice[i] = {mouse.parity_errors(), mouse.resyncs(), mouse.resets(), mice_.take_poll_us(i)};
  }
  uart::put(wire::Status::kType, &status, wire::Status::size(Mice::kPorts));
}

void Link::send_pong(uint32_t token) {
  const wire::Pong pong = {token, received_us_};
  uart::put(wire::Pong::kType, &pong, wire::Pong::kSize);
}

void Link::acknowledge(uint8_t command) {
  const wire::Ack ack = {command};
  uart::put(wire::Ack::kType, &ack, wire::Ack::kSize);
}

void Link::refuse(uint8_t command, wire::NakReason reason) {
  const wire::Nak nak = {command, static_cast<uint8_t>(reason)};
  uart::put(wire::Nak::kType, &nak, wire::Nak::kSize);
}
