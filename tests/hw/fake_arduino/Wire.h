// Three chips on a bus, or a MPU in their place; each reading of a chip's data gives counts that follow from how often it was read.
#pragma once
#include "Arduino.h"

struct FakeWire {
  uint8_t address = 0, reg = 0, sent = 0;
  uint8_t answer[16];
  int answers = 0, next = 0;
  int reads[128] = {};          // of the data registers
  uint8_t registers[128][128];  // what was written
  int silent_address = -1, silent_from = 0, silent_until = 0;  // does not answer between these transfers to it
  int forgets_at = -1;  // loses its registers then, as when its power fails for a moment
  int transfers[128] = {};
  uint8_t who = 0, mpu_at = 0x68;        // what a MPU says in WHO_AM_I; 0: it is a GY-85
  bool has_hmc = true, has_ak = false;   // the latter behind the MPU
  uint32_t timeout_us = 0;               // as the cores: without, a line that is held low stops the sketch for ever
  uint32_t appears_us = 0;               // before, nothing of either board answers

  void begin() {}
  void end() {}
  void setClock(uint32_t) {}
#if defined(ESP32)
  void setTimeOut(uint16_t ms) { timeout_us = 1000UL * ms; }
#else
  void setWireTimeout(uint32_t us, bool) { timeout_us = us; }
#endif
  bool present() {
    if (timeout_us == 0) fprintf(stderr, "a transfer without a limit"), exit(3);
    fake_pass(100);
    int n = transfers[address]++;
    if (n == forgets_at && address == silent_address) memset(registers[address], 0, 128);
    bool there = who ? address == mpu_at : address == 0x53 || address == 0x68;
    there = there || (address == 0x1E && has_hmc) || (address == 0x0C && has_ak && (registers[mpu_at][0x37] & 2));
    there = there && fake_us >= appears_us;
    return there && !(address == silent_address && n >= silent_from && n < silent_until);
  }
  void beginTransmission(uint8_t to) { address = to, sent = 0; }
  size_t write(uint8_t value) {
    if (sent++ == 0)
      reg = value;
    else
      registers[address][reg] = value;
    if (sent > 1 && who && address == mpu_at && reg == 0x6B && (value & 0x80)) {
      memset(registers[address], 0, 128);
      registers[address][0x6B] = who == 0x68 ? 0x40 : 0x01;  // the later ones come up awake
    }
    return 1;
  }
  uint8_t endTransmission(bool = true) { return present() ? 0 : 2; }
  void put(bool big, int value) {
    answer[answers++] = (uint8_t)(big ? value >> 8 : value);
    answer[answers++] = (uint8_t)(big ? value : value >> 8);
  }
  uint8_t requestFrom(uint8_t from, uint8_t count) {
    address = from, answers = next = 0;
    if (!present()) return 0;
    if (who && from == mpu_at) return mpu(from, count);
    if (from == 0x0C) return ak(from, count);
    if (from == 0x53 && reg == 0x00) answer[answers++] = 0xE5;
    if (from == 0x68 && reg == 0x00) answer[answers++] = 0x69;
    if (from == 0x1E && reg == 0x0A) memcpy(answer, "H43", answers = 3);
    int n = reads[from];
    if (from == 0x53 && reg == 0x31)
      answer[answers++] = registers[from][reg], put(false, n % 500), put(false, -n % 500), put(false, 256), reads[from]++;
    if (from == 0x68 && reg == 0x15) {
      for (int i = 0; i < 6; i++) answer[answers++] = registers[from][0x15 + i];
      put(true, -13200), put(true, -n % 700), put(true, 0), put(true, n % 700), reads[from]++;
    }
    if (from == 0x1E && reg == 0x00)
      memcpy(answer, registers[from], 3), answers = 3, put(true, 200 + n % 9), put(true, -400), put(true, n % 9), reads[from]++;
    return answers == count ? count : 0;
  }
  // Counts as the GY-85's above: accelerometer, temperature, gyro; nothing while it sleeps.
  uint8_t mpu(uint8_t from, uint8_t count) {
    const int n = registers[from][0x6B] & 0x40 ? 0 : reads[from];
    if (reg == 0x75) answer[answers++] = who;
    if (reg == 0x00 || reg == 0x19)
      for (int i = 0; i < count; i++) answer[answers++] = registers[from][reg + i];
    if (reg == 0x3B) {
      put(true, n % 500), put(true, -n % 500), put(true, 4096), put(true, -1234);
      put(true, -n % 700), put(true, 0), put(true, n % 700), reads[from] = n + 1;
    }
    return answers == count ? count : 0;
  }
  uint8_t ak(uint8_t from, uint8_t count) {
    const uint8_t fuses[] = {176, 128, 80};
    const int n = reads[from];
    if (reg == 0x00) answer[answers++] = 0x48;
    if (reg == 0x10)
      for (int i = 0; i < 3; i++) answer[answers++] = registers[from][0x0A] == 0x0F ? fuses[i] : 0;
    if (reg == 0x02) {
      answer[answers++] = n % 5 != 4;  // now and then there is nothing new
      put(false, 160 + n % 9), put(false, -100), put(false, n == 20 ? 32767 : 256);
      answer[answers++] = n == 20 ? 0x18 : 0x10, answer[answers++] = registers[from][0x0A], reads[from]++;
    }
    return answers == count ? count : 0;
  }
  int read() { return answer[next++]; }
};
extern FakeWire Wire;
