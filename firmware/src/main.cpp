// linkpose firmware: an Arduino UNO samples a GY-87 board and PS/2 mice, and sends what it measured as frames.
#include <Arduino.h>
#include <Clock.h>
#include <Idle.h>
#include <System.h>
#include <Twi.h>
#include <Uart.h>

#include "Led.h"
#include "Link.h"
#include "Sampler.h"

static Sampler sampler;
static Link host(sampler);
static Led led(sampler);

void setup() {
  board::power_down_unused();
  board::start_watchdog();
  board::begin_led();
  twi::begin();
  uart::begin();
  clock::begin(sampler.settings().sample_rate_hz);
}

void loop() {
  const uint32_t woken_us = clock::now_us();
  board::feed_watchdog();
  sampler.run();
  host.run();
  led.run();
  board::scan_stack();
  host.note_pass(clock::now_us() - woken_us);
  idle::wait_for_work();
}
