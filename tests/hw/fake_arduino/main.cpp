// Runs the sketch: `bridge SECONDS BEGIN_US SILENT_ADDRESS FROM UNTIL BLOCKED_FROM_MS BLOCKED_UNTIL_MS FORGETS_AT`.
#include "Arduino.h"
#include "Wire.h"

uint32_t fake_us;
FakeSerial Serial;
FakeWire Wire;

#include "vislam_bridge.ino"

int main(int, char **arguments) {
  const uint32_t length_us = (uint32_t)(atof(arguments[1]) * 1e6);
  const uint32_t begin_us = fake_us = (uint32_t)strtoul(arguments[2], nullptr, 10);
  Wire.silent_address = atoi(arguments[3]);
  Wire.silent_from = atoi(arguments[4]);
  Wire.silent_until = atoi(arguments[5]);
  const uint32_t blocked_from = (uint32_t)atoi(arguments[6]) * 1000, blocked_until = (uint32_t)atoi(arguments[7]) * 1000;
  Wire.forgets_at = atoi(arguments[8]);
  setup();
  while (fake_us - begin_us < length_us) {
    const uint32_t passed = fake_us - begin_us;
    Serial.room = passed >= blocked_from && passed < blocked_until ? 10 : 63;
    loop();
  }
  fprintf(stderr, "%02x %02x %02x", Wire.registers[0x53][0x31], Wire.registers[0x68][0x16], Wire.registers[0x1E][0x01]);
}
