// Checks the host's commands: each is carried out and acknowledged, or refused with a named reason.
#pragma once
#include <Messages.h>
#include <stdint.h>

namespace commands {

// Smallest and largest rate that Timer1 reaches with its 0.5 us step; a rate must divide kTimerHz.
constexpr uint16_t kMinRateHz = 50;
constexpr uint16_t kMaxRateHz = 500;
constexpr uint32_t kTimerHz = 2000000;
// At an I2C clock of 100 kHz the bursts of two sensors take 3.5 ms.
constexpr uint16_t kMaxSlowBusHz = 125;

// Carries the commands out.
class Board {
 public:
  virtual bool streaming() const = 0;
  virtual uint16_t sample_rate_hz() const = 0;
  virtual bool imu_present(uint8_t device) const = 0;  // 0: at 0x68, 1: at 0x69
  virtual uint8_t mouse_ports() const = 0;    // that the firmware serves
  virtual uint8_t sample_size() const = 0;    // of the body, with the sections it has now

  virtual void send_hello() = 0;
  virtual void send_pong(uint32_t token) = 0;
  virtual void acknowledge(uint8_t command) = 0;
  virtual void refuse(uint8_t command, wire::NakReason reason) = 0;

  virtual void configure(const wire::Configure& settings) = 0;
  virtual void start() = 0;
  virtual void stop() = 0;
  virtual void reset_mice(uint8_t ports) = 0;
  virtual void self_test(uint8_t device) = 0;

 protected:
  ~Board() = default;
};

// Carries out one frame from the host. `body` holds at least the first kMaxPayloadToBoard - 3 bytes of the `size`.
void carry_out(uint8_t type, const uint8_t* body, uint8_t size, Board& board);

// True if SAMPLEs of this rate and body size leave 5 % of the serial line to STATUS, PONG and ACK.
bool line_carries(uint16_t rate_hz, uint8_t sample_size);

}  // namespace commands
