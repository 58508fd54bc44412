// Measures the emulated ATmega328P from inside, for test_peripherals.py. Prints one "name value" a line at 250000 baud.
// Needs a slave at 0x68 that acknowledges, and none at 0x50.

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <stdlib.h>
#include <util/delay.h>

namespace {

constexpr uint16_t FIRST_RUN_OVER = 0xA55A;
volatile uint16_t run __attribute__((section(".noinit")));  // SRAM and r0 to r31 survive a reset
volatile uint8_t watchdog_interrupts __attribute__((section(".noinit")));
uint8_t r2_at_start __attribute__((section(".noinit")));

void put(char c) {
  while (!(UCSR0A & _BV(UDRE0))) {
  }
  UDR0 = c;
}

void print(const char *name, uint16_t value) {
  char digits[6];
  utoa(value, digits, 10);
  while (*name) put(*name++);
  put(' ');
  for (const char *c = digits; *c; ++c) put(*c);
  put('\n');
}

void drain() {
  UCSR0A |= _BV(TXC0);
  put('\n');
  while (!(UCSR0A & _BV(TXC0))) {
  }
}

// ---- two-wire interface ----

struct Step {
  uint8_t status;
  uint16_t cycles;
};

Step twi(uint8_t control) {
  TCNT1 = 0;
  TWCR = _BV(TWINT) | _BV(TWEN) | control;
  uint16_t cycles;
  do {
    cycles = TCNT1;
  } while (!(TWCR & _BV(TWINT)) && cycles < 20000);
  return {static_cast<uint8_t>(TWSR & 0xF8), cycles};
}

uint16_t stop() {
  TCNT1 = 0;
  TWCR = _BV(TWINT) | _BV(TWEN) | _BV(TWSTO);
  uint16_t cycles;
  do {
    cycles = TCNT1;
  } while ((TWCR & _BV(TWSTO)) && cycles < 20000);
  return cycles;
}

void show(const char *status_name, const char *cycles_name, Step step) {
  print(status_name, step.status);
  print(cycles_name, step.cycles);
}

void probe_twi() {
  TWBR = 12;  // 400 kHz: a bit takes 40 cycles
  TWCR = _BV(TWEN);
  show("twi_start", "twi_start_cycles", twi(_BV(TWSTA)));
  TWDR = 0xD0;
  show("twi_address_write_ack", "twi_byte_cycles", twi(0));
  TWDR = 0x75;
  print("twi_write_ack", twi(0).status);
  print("twi_repeated_start", twi(_BV(TWSTA)).status);
  TWDR = 0xD1;
  print("twi_address_read_ack", twi(0).status);
  print("twi_read_ack", twi(_BV(TWEA)).status);
  print("twi_who_am_i", TWDR);
  print("twi_read_nack", twi(0).status);
  print("twi_stop_cycles", stop());
  print("twi_flag_after_stop", (TWCR & _BV(TWINT)) != 0);
  print("twi_status_after_stop", TWSR & 0xF8);
  twi(_BV(TWSTA));
  TWDR = 0xA0;
  print("twi_address_nack", twi(0).status);
  stop();
  twi(_BV(TWSTA));
  TWCR = _BV(TWINT) | _BV(TWEN) | _BV(TWSTO);
  print("twi_start_right_after_stop", twi(_BV(TWSTA)).status);
  print("twi_stop_and_start", twi(_BV(TWSTA) | _BV(TWSTO)).status);
  stop();
  TWDR = 0x55;
  print("twi_write_collision", (TWCR & _BV(TWWC)) != 0);
  TWCR = 0;
}

// ---- interrupts, timers and sleep ----

extern "C" void keep_r2() __attribute__((naked, used, section(".init0")));
void keep_r2() { asm volatile("sts %0, r2" ::"i"(&r2_at_start)); }

volatile uint16_t entry_count;  // TCNT1 when the interrupt's first load reads it
volatile uint8_t entries;

}  // namespace

ISR(TIMER1_COMPB_vect, ISR_NAKED) {
  asm volatile(
      "push r24\n push r25\n in r24, 0x3f\n push r24\n lds r24, 0x84\n lds r25, 0x85\n sts %0, r24\n sts %0+1, r25\n"
      "lds r24, %1\n subi r24, -1\n sts %1, r24\n pop r24\n out 0x3f, r24\n pop r25\n pop r24\n reti\n" ::"i"(&entry_count),
      "i"(&entries));
}

EMPTY_INTERRUPT(TIMER1_COMPA_vect)

namespace {
volatile uint8_t pin_changes;
volatile uint8_t buffer_empties;
}  // namespace

ISR(WDT_vect) { watchdog_interrupts = watchdog_interrupts + 1; }

ISR(PCINT0_vect) { pin_changes = pin_changes + 1; }

ISR(USART_UDRE_vect) {
  UCSR0B &= ~_BV(UDRIE0);
  buffer_empties = buffer_empties + 1;
}

namespace {

void arm_compare_b(uint16_t from, uint16_t match) {
  OCR1B = match;
  TIFR1 = _BV(OCF1B);
  TIMSK1 = _BV(OCIE1B);
  entries = 0;
  TCNT1 = from;
}

void probe_interrupts() {
  arm_compare_b(900, 1000);
  sei();
  asm volatile(".rept 150\n nop\n .endr\n");
  cli();
  print("entry_after_match", entry_count - 1000);

  arm_compare_b(900, 1000);
  sleep_enable();
  sei();
  sleep_cpu();
  cli();
  print("entry_after_match_asleep", entry_count - 1000);

  // An interrupt that is pending when `sei; sleep` comes wakes the sleep; it must not run between the two.
  arm_compare_b(900, 950);
  _delay_us(10);
  TCNT1 = 0;
  OCR1B = 60000;
  sei();
  sleep_cpu();
  cli();
  print("pending_wakes_sleep", TCNT1 < 100 && entries == 1);
  TIMSK1 = 0;
}

void probe_flags() {
  OCR1A = 10;
  OCR1B = 20;
  TCNT1 = 0;
  _delay_us(5);
  asm volatile("sbi %0, %1" ::"I"(_SFR_IO_ADDR(TIFR1)), "I"(OCF1B));
  print("sbi_clears_one_flag", TIFR1 & (_BV(OCF1A) | _BV(OCF1B)));
}

void probe_cycles() {
  uint16_t sbi, cbi;
  TCNT1 = 0;
  asm volatile(".rept 100\n sbi 0x1e, 0\n .endr\n");
  sbi = TCNT1;
  TCNT1 = 0;
  asm volatile(".rept 100\n cbi 0x1e, 0\n .endr\n");
  cbi = TCNT1;
  print("sbi_100_cycles", sbi);
  print("cbi_100_cycles", cbi);
}

// ---- pins ----

void probe_pins() {
  PORTB &= ~_BV(4);
  DDRB |= _BV(4) | _BV(5);
  PCMSK0 = _BV(4);
  PCICR = _BV(PCIE0);
  PCIFR = _BV(PCIF0);
  sei();
  PORTB |= _BV(4);
  _delay_us(1);
  print("pin_change_on_output", pin_changes);
  cli();
  PORTB &= ~_BV(4);
  _delay_us(1);
  PCMSK0 = _BV(4) | _BV(2);  // the pending interrupt stays
  sei();
  _delay_us(1);
  cli();
  print("pin_change_survives_mask", pin_changes);
  PCICR = 0;

  uint8_t at_once, later;
  asm volatile("sbi 5, 5\n in %0, 3\n in %1, 3\n" : "=r"(at_once), "=r"(later));
  print("pin_read_at_once", (at_once >> 5) & 1);
  print("pin_read_later", (later >> 5) & 1);
  PINB = _BV(5);  // a one written to PIN toggles
  _delay_us(1);
  print("pin_toggled", (PINB >> 5) & 1);
  PORTB |= _BV(0);
  _delay_us(1);
  print("pin_pulled_up", PINB & 1);
}

// ---- USART ----

void probe_transmitter() {
  drain();
  TCNT1 = 0;
  UDR0 = '\n';
  while (!(UCSR0A & _BV(UDRE0))) {
  }
  const uint16_t first = TCNT1;
  UDR0 = '\n';
  while (!(UCSR0A & _BV(UDRE0))) {
  }
  const uint16_t second = TCNT1;
  UCSR0A |= _BV(TXC0);
  while (!(UCSR0A & _BV(TXC0)) && TCNT1 < 5000) {
  }
  const uint16_t complete = TCNT1;
  print("usart_first_taken_cycles", first);
  print("usart_second_taken_cycles", second);
  print("usart_complete_cycles", complete);
  drain();
  sei();
  UCSR0B |= _BV(UDRIE0);
  _delay_us(5);
  UCSR0B |= _BV(UDRIE0);
  _delay_us(5);
  cli();
  print("usart_empty_interrupts", buffer_empties);
}

// Asks for bytes with '?', lets them pile up, and reports what it finds.
void probe_receiver() {
  put('?');
  _delay_ms(2);
  uint8_t count = 0, overruns = 0, frame_errors = 0;
  uint16_t sum = 0;
  while (UCSR0A & _BV(RXC0)) {
    if (UCSR0A & _BV(DOR0)) ++overruns;
    if (UCSR0A & _BV(FE0)) ++frame_errors;
    sum += UDR0;
    ++count;
  }
  print("usart_received", count);
  print("usart_received_sum", sum);
  print("usart_overruns", overruns);
  print("usart_frame_errors", frame_errors);
}

void probe_sleep_with_ticks() {  // seen from outside: ticks of exactly 8000 cycles, the core asleep between them
  TCCR1B = _BV(WGM12) | _BV(CS11);
  OCR1A = 999;
  TCNT1 = 0;
  TIFR1 = _BV(OCF1A);
  TIMSK1 = _BV(OCIE1A);
  sei();
  for (uint8_t i = 0; i < 100; ++i) sleep_cpu();
  cli();
  TIMSK1 = 0;
}

// ---- analogue-to-digital converter ----

uint16_t convert() {
  TCNT1 = 0;
  ADCSRA |= _BV(ADSC);
  while (ADCSRA & _BV(ADSC)) {
  }
  return TCNT1;
}

void probe_adc() {
  ADMUX = _BV(REFS0) | 0x0E;  // the band gap against AVCC
  ADCSRA = _BV(ADEN) | _BV(ADPS2);  // a clock of 1 MHz
  print("adc_first_cycles", convert());
  print("adc_second_cycles", convert());
  print("adc_band_gap", ADC);
  ADMUX = _BV(REFS0);
  convert();
  print("adc_open_input", ADC);
  ADCSRA = 0;
}

// The first time-out interrupts, the second one resets.
[[noreturn]] void wait_for_watchdog() {
  run = FIRST_RUN_OVER;
  watchdog_interrupts = 0;
  wdt_enable(WDTO_15MS);
  WDTCSR |= _BV(WDIE);
  sei();
  asm volatile("ldi r24, 0xA7\n mov r2, r24\n 1: rjmp 1b\n");
  __builtin_unreachable();
}

}  // namespace

int main() {
  const uint8_t cause = MCUSR;
  MCUSR = 0;
  MCUSR = 0xFF;
  const uint8_t cause_after_writing_ones = MCUSR;
  const uint8_t watchdog = WDTCSR;
  wdt_disable();
  UCSR0A = _BV(U2X0);
  UBRR0 = 7;
  UCSR0B = _BV(TXEN0) | _BV(RXEN0);
  TCCR1B = _BV(CS10);
  if (run == FIRST_RUN_OVER && !(cause & _BV(PORF))) {
    print("second_reset_cause", cause);
    print("watchdog_still_on", (watchdog & _BV(WDE)) != 0);
    print("watchdog_interrupts", watchdog_interrupts);
    print("r2_after_reset", r2_at_start);
    print("end", 0);
    for (;;) {
    }
  }
  print("first_reset_cause", cause);
  print("reset_cause_after_writing_ones", cause_after_writing_ones);
  probe_twi();
  probe_interrupts();
  probe_flags();
  probe_cycles();
  probe_pins();
  probe_adc();
  probe_transmitter();
  probe_receiver();
  probe_receiver();
  drain();
  probe_sleep_with_ticks();
  wait_for_watchdog();
}
