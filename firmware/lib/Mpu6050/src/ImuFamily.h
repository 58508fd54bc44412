// Inertial sensors that boards sold as MPU-6050 carry: which registers and formulas belong to which WHO_AM_I.
#pragma once
#include <stdint.h>

struct ImuFamily {
  // Values of wire::DeviceFamily.
  enum Kind : uint8_t { kNone = 0, kMpu6050 = 1, kMpu6500 = 2, kIcm20600 = 3, kUnknown = 15 };

  Kind kind;
  bool accel_config2;  // the accelerometer has a filter setting of its own, at 0x1D
  bool old_self_test;  // trim in 0x0D to 0x10 (RM-MPU-6000A 4.1), else in 0x00 to 0x02 and 0x0D to 0x0F
  // Counts of the die temperature at -40 and 125 degC: beyond these a reading is impossible.
  int16_t coldest;
  int16_t hottest;

  static ImuFamily of(uint8_t who_am_i) {
    switch (who_am_i) {
      case 0x68:
        return {kMpu6050, false, true, -26020, 30080};
      case 0x70:  // MPU-6500
      case 0x71:  // MPU-9250
      case 0x73:  // MPU-9255
      case 0x74:  // MPU-6515
      case 0x75:  // sold as MPU-6500
      case 0x78:  // MPU-6880
        return {kMpu6500, true, false, -20366, 32766};
      case 0x11:  // ICM-20600
      case 0x12:  // ICM-20602
      case 0x19:  // MPU-6886
      case 0x98:  // ICM-20689
      case 0xA6:  // ICM-20609
      case 0xA9:  // IAM-20680
      case 0xAE:  // ICM-20608-D
      case 0xAF:  // ICM-20608-G
        return {kIcm20600, true, false, -21242, 32680};
      case 0x00:
      case 0xFF:  // a bus that nobody drives
        return {kNone, false, false, 0, 0};
      default:
        return {kUnknown, false, true, INT16_MIN, INT16_MAX};
    }
  }
};
