// Runs the sketch: `bridge SECONDS BEGIN_US SILENT_ADDRESS FROM UNTIL BLOCKED_FROM_MS BLOCKED_UNTIL_MS FORGETS_AT`
// and for a sketch with encoders and a receiver `LEFT RIGHT TEXT`: quarters of a period per second, and what it says.
// The environment's MPU, as `WHO_AM_I ADDRESS MAGNETOMETER APPEARS_US`, puts another board in the place of the GY-85.
#include <cmath>

#include "Arduino.h"
#include "Wire.h"

uint32_t fake_us;
FakeSerial Serial;
FakeReceiver Serial1;
FakeWire Wire;

// Two wheels of which channel A is a quarter ahead of B going forward: A is at an even pin, B at the next.
struct FakeWheel {
  double quarters_s = 0.0;
  long quarters = 0;
  void (*turned)() = nullptr;
  bool channel(long ahead) const { return ((quarters + ahead) & 3) >= 2; }
  void turn_to(double seconds) {
    const long there = lround(quarters_s * seconds);
    while (quarters != there) {
      const bool before = channel(1);
      quarters += there > quarters ? 1 : -1;
      if (turned && channel(1) != before) turned();
    }
  }
};
static FakeWheel wheels[2];
static double fake_s;
void fake_pass(uint32_t us) {
  fake_us += us, fake_s += us * 1e-6;
  for (FakeWheel &wheel : wheels) wheel.turn_to(fake_s);
}
int digitalRead(uint8_t pin) { return wheels[pin / 2 - 1].channel(pin % 2 ? 0 : 1); }
void attachInterrupt(int pin, void (*turned)(), int) { wheels[pin / 2 - 1].turned = turned; }

#include "vislam_bridge.ino"

int main(int count, char **arguments) {
  const uint32_t length_us = (uint32_t)(atof(arguments[1]) * 1e6);
  const uint32_t begin_us = fake_us = (uint32_t)strtoul(arguments[2], nullptr, 10);
  Wire.silent_address = atoi(arguments[3]);
  Wire.silent_from = atoi(arguments[4]);
  Wire.silent_until = atoi(arguments[5]);
  const uint32_t blocked_from = (uint32_t)atoi(arguments[6]) * 1000, blocked_until = (uint32_t)atoi(arguments[7]) * 1000;
  Wire.forgets_at = atoi(arguments[8]);
  if (const char *mpu = getenv("MPU")) {
    unsigned who, at;
    unsigned long appears_us;
    char magnetometer[8];
    if (sscanf(mpu, "%u %u %7s %lu", &who, &at, magnetometer, &appears_us) != 4) return 2;
    Wire.who = (uint8_t)who, Wire.mpu_at = (uint8_t)at, Wire.appears_us = (uint32_t)appears_us;
    Wire.has_hmc = !strcmp(magnetometer, "hmc"), Wire.has_ak = !strcmp(magnetometer, "ak");
  }
  if (count > 11) {
    wheels[0].quarters_s = atof(arguments[9]), wheels[1].quarters_s = atof(arguments[10]);
    Serial1.text = arguments[11];
  }
  setup();
  while (fake_us - begin_us < length_us) {
    const uint32_t passed = fake_us - begin_us;
    Serial.blocked = passed >= blocked_from && passed < blocked_until;
    loop();
  }
  fprintf(stderr, "%02x %02x %02x", Wire.registers[0x53][0x31], Wire.registers[0x68][0x16], Wire.registers[0x1E][0x01]);
  if (count > 11) fprintf(stderr, " %ld %ld %lu", wheels[0].quarters, wheels[1].quarters, Serial1.lost);
}
