// linkpose firmware: an Arduino UNO samples a GY-87 board and PS/2 mice, and sends what it measured as frames.
#include <Arduino.h>
#include <Clock.h>
#include <Idle.h>
#include <System.h>
#include <Twi.h>
#include <Uart.h>

#include "Led.h"
#include "Link.h"
#include "Mice.h"
#include "Sampler.h"

// In force until the host sends others: 100 Hz, 8 g, 1000 deg/s, DLPF 3, oversampling 1, 8 counts/mm, I2C at 400 kHz.
static constexpr wire::Configure kDefaults = {100, 8, 1000, 3, 1, 8, 400};

static Mice mice(kDefaults.mouse_counts_per_mm);
static Sampler sampler(kDefaults, mice);
static Link host(sampler, mice);
static Led led(sampler);

void setup() {
  board::power_down_unused();
  board::start_watchdog();
  board::begin_led();
  board::begin_supply();
  idle::begin();
  twi::begin();
  uart::begin();
  mice.begin();
  clock::begin(kDefaults.sample_rate_hz);
}

void loop() {
  const uint32_t woken_us = clock::now_us();
  board::feed_watchdog();
  mice.run();  // before the SAMPLE of this tick is made
  sampler.run();
  host.run();
  led.run();
  board::scan_stack();
  host.note_pass(clock::now_us() - woken_us);
  idle::wait_for_work();
}
