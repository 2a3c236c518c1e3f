// Inertial samples (MPU-6050) and a magnetometer (RM3100) as binary frames for
//   magfusion listen serial:/dev/ttyUSB0@460800 --encoding frames
//     --counts imu.gyro=1.332e-4 --counts imu.accel=5.986e-4 --counts magnetometer=1.333e-8
// Connect both by I2C. Frame: COBS(kind, type, COUNT, MICROS, values, CRC-32), and a zero byte.
#include <Arduino.h>
#include <Wire.h>

const uint8_t IMU = 0x68, MAG = 0x20;
const uint32_t INTERVAL = 2500;  // microseconds: 400 Hz
uint32_t next_sample = 0;
uint16_t imu_count = 0, mag_count = 0;

uint32_t crc32(const uint8_t *bytes, size_t length) {
  uint32_t crc = 0xFFFFFFFFu;
  while (length--) {
    crc ^= *bytes++;
    for (int k = 0; k < 8; k++) crc = (crc >> 1) ^ ((crc & 1u) ? 0xEDB88320u : 0u);
  }
  return ~crc;
}

void send_frame(char kind, char type, uint16_t count, uint32_t micros_now, const void *values, size_t size) {
  uint8_t body[40], frame[44];
  body[0] = kind;
  body[1] = type;
  memcpy(body + 2, &count, 2);  // these processors are little-endian
  memcpy(body + 4, &micros_now, 4);
  memcpy(body + 8, values, size);
  uint32_t crc = crc32(body, 8 + size);
  memcpy(body + 8 + size, &crc, 4);
  size_t code = 0, end = 1;  // COBS: each zero becomes the distance to the next one
  for (size_t k = 0; k < 12 + size; k++) {
    if (body[k]) {
      frame[end++] = body[k];
    } else {
      frame[code] = end - code;
      code = end++;
    }
  }
  frame[code] = end - code;
  frame[end++] = 0;
  Serial.write(frame, end);
}

void write_register(uint8_t device, uint8_t address, uint8_t value) {
  Wire.beginTransmission(device);
  Wire.write(address);
  Wire.write(value);
  Wire.endTransmission();
}

void read_registers(uint8_t device, uint8_t address, uint8_t *bytes, uint8_t length) {
  Wire.beginTransmission(device);
  Wire.write(address);
  Wire.endTransmission(false);
  Wire.requestFrom(device, length);
  for (uint8_t k = 0; k < length; k++) bytes[k] = Wire.read();
}

void setup() {
  Serial.begin(460800);
  Wire.begin();
  Wire.setClock(400000);
  write_register(IMU, 0x6B, 0x01);  // awake, by the clock of the gyroscope
  write_register(IMU, 0x1A, 0x01);  // filter of 184 Hz
  write_register(IMU, 0x1B, 0x00);  // 250 deg/s
  write_register(IMU, 0x1C, 0x00);  // 2 g
  write_register(MAG, 0x0B, 0x92);  // 600 Hz at most
  write_register(MAG, 0x01, 0x71);  // continuously
  next_sample = micros();
}

void loop() {
  if ((int32_t)(micros() - next_sample) < 0) return;
  next_sample += INTERVAL;
  uint8_t raw[14];
  uint32_t now = micros();
  read_registers(IMU, 0x3B, raw, 14);
  int16_t sample[6];  // gyro, accel; the sensor has accel, temperature, gyro
  for (int k = 0; k < 3; k++) {
    sample[k] = (int16_t)((raw[8 + 2 * k] << 8) | raw[9 + 2 * k]);
    sample[3 + k] = (int16_t)((raw[2 * k] << 8) | raw[2 * k + 1]);
  }
  send_frame('i', 'h', imu_count++, now, sample, sizeof sample);
  uint8_t status;
  now = micros();
  read_registers(MAG, 0x34, &status, 1);
  if (!(status & 0x80)) return;  // no new measurement
  read_registers(MAG, 0x24, raw, 9);
  int32_t field[3];
  for (int k = 0; k < 3; k++) {
    uint32_t bits = ((uint32_t)raw[3 * k] << 24) | ((uint32_t)raw[3 * k + 1] << 16) | ((uint32_t)raw[3 * k + 2] << 8);
    field[k] = (int32_t)bits >> 8;
  }
  send_frame('m', 'i', mag_count++, now, field, sizeof field);
}
