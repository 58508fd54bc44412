// The UART, both ways by interrupt. Bytes to the host come from a TransmitRing; bytes from the host wait in a small ring.
#pragma once
#include <TransmitRing.h>
#include <stdint.h>

namespace uart {

void begin();

// The host sees frames put() here; see TransmitRing.
bool put(uint8_t type, const void* body, uint8_t size);
uint32_t frames_dropped();

// The next byte from the host. For a 0x00, the end of a frame, `t_us` is when it arrived. False when there is none.
bool take(uint8_t& byte, uint32_t& t_us);
uint16_t overruns();

}  // namespace uart
