// The board's side of the wire protocol: commands in, HELLO, STATUS and answers out.
#pragma once
#include <Commands.h>
#include <FrameDecoder.h>

#include "Mice.h"
#include "Sampler.h"

class Link : public commands::Board {
 public:
  Link(Sampler& sampler, Mice& mice) : sampler_(sampler), mice_(mice) {}

  // The time from wake-up to the present, for the longest pass in STATUS.
  void note_pass(uint32_t us);
  void run();

  bool streaming() const override { return sampler_.streaming(); }
  uint16_t sample_rate_hz() const override { return sampler_.settings().sample_rate_hz; }
  bool imu_present(uint8_t device) const override { return sampler_.imu(device).present(); }
  uint8_t mouse_ports() const override { return Mice::kPorts; }
  uint8_t sample_size() const override { return sampler_.sample_size(); }
  void send_hello() override;
  void send_pong(uint32_t token) override;
  void acknowledge(uint8_t command) override;
  void refuse(uint8_t command, wire::NakReason reason) override;
  void configure(const wire::Configure& settings) override;
  void start() override { sampler_.start(); }
  void stop() override { sampler_.stop(); }
  void reset_mice(uint8_t ports) override { mice_.reset(ports); }
  void self_test(uint8_t device) override { sampler_.self_test(device); }

 private:
  void receive();
  void greet();
  void send_status();

  Sampler& sampler_;
  Mice& mice_;
  FrameDecoder decoder_;
  uint32_t received_us_ = 0;
  uint32_t status_us_ = 0;
  uint16_t longest_pass_us_ = 0;
  uint16_t corrupt_ = 0;
  bool greeted_ = false;
};
