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

#define CHANGE 1
#define digitalPinToInterrupt(pin) (pin)

extern uint32_t fake_us;
void fake_pass(uint32_t us);  // time passes, and wheels turn
int digitalRead(uint8_t pin);
void attachInterrupt(int pin, void (*turned)(), int mode);
inline void noInterrupts() {}
inline void interrupts() {}
inline uint32_t micros() { return fake_pass(20), fake_us; }
inline uint32_t millis() { return fake_us / 1000; }
inline void delay(uint32_t ms) { fake_pass(1000 * ms); }
inline void delayMicroseconds(uint32_t us) { fake_pass(us); }
inline void pinMode(uint8_t, uint8_t) {}
inline void digitalWrite(uint8_t, uint8_t) {}

struct FakeSerial {
  bool blocked = false;
  long waiting = 0;  // bytes of an AVR's buffer of 63 that are not on the wire yet, one of which goes in 20 us
  uint32_t at_us = 0;
  void begin(uint32_t) {}
#if defined(ESP32) && !(ARDUINO_USB_CDC_ON_BOOT && !ARDUINO_USB_MODE)
  void setTxBufferSize(size_t) {}
#endif
  int availableForWrite() {
    const long gone = (long)((fake_us - at_us) / 20);
    waiting = waiting > gone ? waiting - gone : 0, at_us = fake_us;
    return blocked ? 10 : (int)(63 - waiting);
  }
  size_t write(const uint8_t *data, size_t length) {
    waiting += (long)length;
    return fwrite(data, 1, length, stdout);
  }
};
extern FakeSerial Serial;

// A receiver that says its text again and again, a byte a millisecond, into a buffer of 64 bytes.
struct FakeReceiver {
  const char *text = "";
  uint32_t begun_us = 0;
  unsigned long taken = 0, lost = 0;
  void begin(uint32_t) { begun_us = fake_us; }
  int available() {
    const unsigned long said = (fake_us - begun_us) / 1000;
    if (said - taken > 64) lost += said - taken - 64, taken = said - 64;
    return (int)(said - taken);
  }
  int read() { return text[taken++ % strlen(text)]; }
};
extern FakeReceiver Serial1;
