#include "Uart.h"

#include <Messages.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "Clock.h"
#include "Idle.h"

namespace uart {
namespace {

constexpr uint8_t kReceived = 64;  // a power of two
constexpr uint8_t kEnds = 4;       // frame ends that wait, with their times; a power of two

TransmitRing transmitted;

uint8_t received[kReceived];
volatile uint8_t received_head;
volatile uint8_t received_tail;
uint32_t end_us[kEnds];
volatile uint8_t ends_head;
volatile uint8_t ends_tail;
bool after_end = true;  // the last byte was a 0x00
volatile uint16_t overrun_count;

inline void receive(uint8_t byte) {
  const bool end = byte == 0;
  if (end && after_end) return;  // an empty frame carries nothing
  const bool full = static_cast<uint8_t>(received_head - received_tail) >= kReceived;
  const bool no_time = end && static_cast<uint8_t>(ends_head - ends_tail) >= kEnds;
  if (full || no_time) {
    overrun_count++;
    return;
  }
  after_end = end;
  if (end) {
    end_us[ends_head % kEnds] = clock::now_us_locked();
    ends_head = ends_head + 1;
  }
  received[received_head % kReceived] = byte;
  received_head = received_head + 1;
  idle::signal_work();
}

}  // namespace

void begin() {
  UCSR0A = _BV(U2X0);
  UBRR0 = F_CPU / 8 / wire::kBaud - 1;
  static_assert(F_CPU % (8 * wire::kBaud) == 0, "the baud rate is exact");
  UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
  UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
  UDR0 = 0;  // ends the frame that a reset has cut, so that HELLO is not lost with it
}

bool put(uint8_t type, const void* body, uint8_t size) {
  if (!transmitted.put(type, body, size)) return false;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { UCSR0B |= _BV(UDRIE0); }
  return true;
}

uint32_t frames_dropped() { return transmitted.dropped(); }

bool take(uint8_t& byte, uint32_t& t_us) {
  const uint8_t tail = received_tail;
  if (tail == received_head) return false;
  byte = received[tail % kReceived];
  received_tail = tail + 1;
  if (byte == 0) {
    t_us = end_us[ends_tail % kEnds];
    ends_tail = ends_tail + 1;
  }
  return true;
}

uint16_t overruns() {
  uint16_t count;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { count = overrun_count; }
  return count;
}

}  // namespace uart

ISR(USART_RX_vect) {
  idle::note_wake();
  const uint8_t status = UCSR0A;
  const uint8_t byte = UDR0;
  if (status & _BV(DOR0)) uart::overrun_count++;
  // A framing error (a break, noise) is passed on as a byte that ends nothing; the CRC finds the damage.
  uart::receive(status & _BV(FE0) ? 0xFF : byte);
}

ISR(USART_UDRE_vect) {
  idle::note_wake();
  UDR0 = uart::transmitted.take();
  if (uart::transmitted.empty()) UCSR0B &= static_cast<uint8_t>(~_BV(UDRIE0));
}
