// Just enough of the Arduino core to run the sketch on a PC: time that is counted, a serial line that is stdout.
#pragma once
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#define INPUT_PULLUP 2
#define OUTPUT 1
#define LOW 0
#define HIGH 1
#define SDA 18
#define SCL 19

extern uint32_t fake_us;
inline uint32_t micros() { return fake_us += 20; }
inline uint32_t millis() { return fake_us / 1000; }
inline void delay(uint32_t ms) { fake_us += 1000 * ms; }
inline void delayMicroseconds(uint32_t us) { fake_us += us; }
inline void pinMode(uint8_t, uint8_t) {}
inline void digitalWrite(uint8_t, uint8_t) {}

struct FakeSerial {
  int room = 63;
  void begin(uint32_t) {}
  int availableForWrite() { return room; }
  size_t write(const uint8_t *data, size_t length) { return fwrite(data, 1, length, stdout); }
};
extern FakeSerial Serial;
