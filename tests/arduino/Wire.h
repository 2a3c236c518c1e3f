// An I2C bus with an MPU-6050 and an RM3100 that always measure the same.
#pragma once
#include "Arduino.h"

struct Bus {
  uint8_t device = 0, address = 0, written = 0, imu[256] = {}, mag[256] = {};
  void begin() {
    const uint8_t inertial[14] = {0x40, 0x00, 0x00, 0x01, 0xFF, 0xFE, 0, 0, 0, 3, 0xFF, 0xFC, 0, 0};
    const uint8_t field[9] = {0x00, 0x00, 0x00, 0xFF, 0xFF, 0xFE, 0x01, 0x00, 0x00};
    memcpy(imu + 0x3B, inertial, 14);
    memcpy(mag + 0x24, field, 9);
    mag[0x34] = 0x80;
  }
  void setClock(long) {}
  void beginTransmission(uint8_t one) { device = one, written = 0; }
  void write(uint8_t byte) {
    if (written++ == 0) address = byte;
    else (device == 0x68 ? imu : mag)[address] = byte;
  }
  void endTransmission(bool = true) {}
  void requestFrom(uint8_t one, uint8_t) { device = one; }
  uint8_t read() { return (device == 0x68 ? imu : mag)[address++]; }
};
inline Bus Wire;
