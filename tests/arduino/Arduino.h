// As much of the Arduino core as a sketch needs to run on a computer: time, and a serial port.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>

inline uint32_t elapsed = 0xFFFFFFFFu - 100000u;  // so that it wraps
inline uint32_t micros() { return elapsed += 100u; }

struct SerialPort {
  void begin(long) {}
  size_t write(const uint8_t *bytes, size_t length) { return fwrite(bytes, 1, length, stdout); }
};
inline SerialPort Serial;
