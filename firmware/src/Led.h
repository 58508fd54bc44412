// The LED on D13: on while streaming, a slow blink (1 Hz) while idle, a fast one (5 Hz) while a sensor does not answer.
#pragma once
#include <Clock.h>
#include <System.h>

#include "Sampler.h"

class Led {
 public:
  explicit Led(const Sampler& sampler) : sampler_(sampler) {}

  void run() {
    if (sampler_.healthy() && sampler_.streaming()) {
      board::set_led(true);
      return;
    }
    const uint32_t now = clock::now_us();
    if (now - turned_us_ < (sampler_.healthy() ? kSlowUs : kFastUs)) return;
    turned_us_ = now;
    on_ = !on_;
    board::set_led(on_);
  }

 private:
  static constexpr uint32_t kSlowUs = 500000;
  static constexpr uint32_t kFastUs = 100000;

  const Sampler& sampler_;
  uint32_t turned_us_ = 0;
  bool on_ = false;
};
