// vislam_bridge: reads a GY-85 (ADXL345, ITG3205, HMC5883L) on time and sends frames to vislam over a serial line.
//
// For AVR (Nano, Uno, Mega, Leonardo) and ESP32 with their Arduino cores; no library but Wire. Connect 5 V or 3.3 V as
// your GY-85 is made for, GND, SDA and SCL (Nano and Uno: A4 and A5; ESP32: 21 and 22). docs/cart.md of vislam has the
// protocol, which vislam/hw/bridge/protocol.py reads. Any change of a frame's layout needs a new PROTOCOL_VERSION.
// It also counts the encoders of two wheels and passes on what a satellite receiver says, where it is told their pins:
// docs/sensors/wheels.md and docs/sensors/gnss.md of vislam.

#include <Arduino.h>
#include <Wire.h>

// 500000 is exact on a 16 MHz AVR and a standard rate of Linux; 230400 would be off by 3.5 % and 115200 too slow.
static const uint32_t BAUD = 500000;
static const uint16_t RATE_HZ = 400;      // of samples: 400, 200 or 100
static const uint16_t MAG_RATE_HZ = 50;   // below the chip's 75, so that every reading is a new one
static const uint32_t I2C_HZ = 400000;    // at 100000 reduce RATE_HZ to 100
static const uint32_t RETRY_MS = 100;     // between attempts to set up a chip that does not answer
static const uint16_t I2C_TIMEOUT_MS = 3; // a stuck bus must not stop the clock

// Pins of the encoders' channels A and B; -1: there are none. A has to be a pin with interrupts: 2 and 3 of a Nano or Uno,
// any of an ESP32 (but 34 to 39, which have no pull-up). Both edges of A count, up while the machine goes forward.
#ifndef LEFT_A
#define LEFT_A -1
#define LEFT_B -1
#define RIGHT_A -1
#define RIGHT_B -1
#endif
static const uint16_t COUNTS_HZ = 50;
// A satellite receiver on another serial port: Serial1 of a Mega or Leonardo, Serial2 of an ESP32; a Nano has none.
// #define GNSS_PORT Serial1
static const uint32_t GNSS_BAUD = 9600;

static const uint8_t PROTOCOL_VERSION = 1;
static const uint8_t SAMPLE_TYPE = 1, HELLO_TYPE = 2, COUNTS_TYPE = 3, PASSED_TYPE = 4;
static const uint8_t STATUS_MAG_NEW = 1, STATUS_ACCEL_ERROR = 2, STATUS_GYRO_ERROR = 4, STATUS_MAG_ERROR = 8,
                     STATUS_MISSED = 16;
static const uint8_t CHIPS_ACCEL = 1, CHIPS_GYRO = 2, CHIPS_MAG = 4, CHIPS_ENCODERS = 8, CHIPS_GNSS = 16,
                     CHIPS_STARTED = 128;

static const uint32_t ACCEL_NM_S2 = 38307227;    // 256 counts a g in full resolution, whatever the range
static const uint32_t GYRO_NRAD_S = 1214142;     // 14.375 counts a degree per second
static const uint32_t MAG_PT = 91743;            // 1090 counts a gauss
static const uint32_t TEMPERATURE_NK = 3571429;  // 280 counts a degree
static const int32_t TEMPERATURE_MC = 82143;     // 35 degrees at -13200
static const uint16_t ACCEL_LIMIT = 4095;        // 16 g
static const uint16_t GYRO_LIMIT = 28750;        // 2000 degrees per second
static const uint16_t MAG_LIMIT = 2048;          // 12 bits; -4096 says overflow

static const uint32_t PERIOD_US = 1000000UL / RATE_HZ;
static const uint32_t HELLO_EVERY_US = 1000000UL;
static const uint8_t MAG_EVERY = RATE_HZ / MAG_RATE_HZ;
static const uint8_t ACCEL_FORMAT = 0x0B;          // full resolution, 16 g
static const uint8_t GYRO_FILTER = (3 << 3) | 2;   // 2000 degrees per second, filter at 98 Hz
static const uint8_t MAG_SETTLING = 2;  // its first readings still have the gain before
static const uint8_t MAX_BODY = 48;     // the hello is 42 bytes
static const uint8_t SAMPLE_WIRE = 32;  // bytes that a sample takes; for anything but a hello this much stays free
static const uint8_t MOST_PASSED = 20;  // bytes of a receiver in a frame: with a sample they fill an AVR's buffer

struct Chip {
  uint8_t address;
  uint8_t id[3];
  bool ready;
  uint32_t tried_ms;
};

#if LEFT_A >= 0
static const bool HAS_ENCODERS = true;
#else
static const bool HAS_ENCODERS = false;
#endif
#if defined(GNSS_PORT)
static const bool HAS_GNSS = true;
#else
static const bool HAS_GNSS = false;
#endif

static Chip accelChip, gyroChip, magChip;
static int16_t accel[3], gyro[3], mag[3], temperature;
static uint16_t sequence;
static uint32_t dueUs, helloUs;
static bool helloPending = true, started = true, missed = false;
static uint8_t magCountdown, magSettling, magStatus;
static uint8_t body[MAX_BODY];
static uint8_t bodyLength;

// ---- I2C: every call returns within the timeout, and says whether the chip answered

static void beginBus() {
  Wire.begin();
  Wire.setClock(I2C_HZ);
#if defined(WIRE_HAS_TIMEOUT)
  Wire.setWireTimeout(I2C_TIMEOUT_MS * 1000UL, true);
#elif defined(ESP32)
  Wire.setTimeOut(I2C_TIMEOUT_MS);
#endif
}

// A chip that was interrupted while sending holds SDA down until it has been clocked out.
static void freeBus() {
  Wire.end();
  pinMode(SDA, INPUT_PULLUP);
  pinMode(SCL, OUTPUT);
  for (uint8_t i = 0; i < 9; i++) {
    digitalWrite(SCL, LOW);
    delayMicroseconds(5);
    digitalWrite(SCL, HIGH);
    delayMicroseconds(5);
  }
  pinMode(SCL, INPUT_PULLUP);
  beginBus();
}

static bool writeRegister(uint8_t address, uint8_t number, uint8_t value) {
  Wire.beginTransmission(address);
  Wire.write(number);
  Wire.write(value);
  return Wire.endTransmission() == 0;
}

static bool readRegisters(uint8_t address, uint8_t number, uint8_t *into, uint8_t count) {
  Wire.beginTransmission(address);
  Wire.write(number);
  if (Wire.endTransmission(false) != 0) return false;
  if (Wire.requestFrom(address, count) != count) return false;
  for (uint8_t i = 0; i < count; i++) into[i] = (uint8_t)Wire.read();
  return true;
}

static int16_t littleEndian(const uint8_t *at) { return (int16_t)((uint16_t)at[0] | ((uint16_t)at[1] << 8)); }
static int16_t bigEndian(const uint8_t *at) { return (int16_t)((uint16_t)at[1] | ((uint16_t)at[0] << 8)); }

// ---- chips

static bool beginAccel() {
  const uint8_t addresses[] = {0x53, 0x1D};
  for (uint8_t i = 0; i < 2; i++) {
    accelChip.address = addresses[i];
    if (!readRegisters(addresses[i], 0x00, accelChip.id, 1) || accelChip.id[0] != 0xE5) continue;
    const uint8_t rate = RATE_HZ > 200 ? 0x0C : RATE_HZ > 100 ? 0x0B : 0x0A;
    return writeRegister(addresses[i], 0x2D, 0x00)     // standby
           && writeRegister(addresses[i], 0x38, 0x00)  // no FIFO: the newest sample is read
           && writeRegister(addresses[i], 0x2C, rate)  // its filter is at half the rate
           && writeRegister(addresses[i], 0x31, ACCEL_FORMAT)
           && writeRegister(addresses[i], 0x2D, 0x08);  // measure
  }
  return false;
}

// Settings are read with the data: a chip that lost its power for a moment would go on with other ones.
static bool readAccel() {
  uint8_t data[7];
  if (!readRegisters(accelChip.address, 0x31, data, 7) || data[0] != ACCEL_FORMAT) return false;
  for (uint8_t i = 0; i < 3; i++) accel[i] = littleEndian(data + 1 + 2 * i);
  return true;
}

static bool beginGyro() {
  const uint8_t addresses[] = {0x68, 0x69};
  for (uint8_t i = 0; i < 2; i++) {
    gyroChip.address = addresses[i];
    if (!readRegisters(addresses[i], 0x00, gyroChip.id, 1) || (gyroChip.id[0] & 0x7E) != 0x68) continue;
    return writeRegister(addresses[i], 0x3E, 0x01)     // clock from the X gyro's PLL
           && writeRegister(addresses[i], 0x15, 0x00)  // 1 kHz: the newest sample is at most 1 ms old
           && writeRegister(addresses[i], 0x16, GYRO_FILTER)
           && writeRegister(addresses[i], 0x17, 0x00);
  }
  return false;
}

static bool readGyro() {
  uint8_t data[14];
  if (!readRegisters(gyroChip.address, 0x15, data, 14) || data[1] != GYRO_FILTER) return false;
  temperature = bigEndian(data + 6);
  for (uint8_t i = 0; i < 3; i++) gyro[i] = bigEndian(data + 8 + 2 * i);
  return true;
}

static bool beginMag() {
  magChip.address = 0x1E;
  magSettling = MAG_SETTLING;
  return readRegisters(0x1E, 0x0A, magChip.id, 3) && magChip.id[0] == 'H' && magChip.id[1] == '4' &&
         magChip.id[2] == '3' && writeRegister(0x1E, 0x00, 0x18)  // 75 Hz, no averaging
         && writeRegister(0x1E, 0x01, 0x20)                       // 1.3 gauss
         && writeRegister(0x1E, 0x02, 0x00);                      // continuous
}

static bool readMag() {
  uint8_t data[6];
  if (!readRegisters(magChip.address, 0x03, data, 6)) return false;
  mag[0] = bigEndian(data);
  mag[2] = bigEndian(data + 2);  // the chip has x, z, y
  mag[1] = bigEndian(data + 4);
  return true;
}

// Read a chip, or try to set it up again now and then; at most one such attempt in a sample.
static bool readOrRetry(Chip &chip, bool (*begin)(), bool (*read)(), bool &retried) {
  if (chip.ready) {
    if (read()) return true;
    chip.ready = false;
    chip.tried_ms = millis();
    return false;
  }
  if (!retried && millis() - chip.tried_ms >= RETRY_MS) {
    retried = true;
    chip.tried_ms = millis();
    if (!accelChip.ready && !gyroChip.ready) freeBus();
    chip.ready = begin();
  }
  return false;
}

// ---- frames

static void put8(uint8_t value) { body[bodyLength++] = value; }
static void put16(uint16_t value) {
  put8((uint8_t)value);
  put8((uint8_t)(value >> 8));
}
static void put32(uint32_t value) {
  put16((uint16_t)value);
  put16((uint16_t)(value >> 16));
}

static void beginFrame(uint8_t type, uint16_t number, uint32_t timeUs) {
  bodyLength = 0;
  put8(type);
  put16(number);
  put32(timeUs);
}

// CRC-16 of CCITT, x^16 + x^12 + x^5 + 1, initial value 0xFFFF.
static uint16_t crcOfBody() {
  uint16_t crc = 0xFFFF;
  for (uint8_t i = 0; i < bodyLength; i++) {
    crc = (uint16_t)((crc >> 8) | (crc << 8));
    crc ^= body[i];
    crc ^= (uint16_t)((crc & 0xFF) >> 4);
    crc ^= (uint16_t)(crc << 12);
    crc ^= (uint16_t)((crc & 0xFF) << 5);
  }
  return crc;
}

// Send the body with CRC, stuffed by COBS. Never waits: without room for all of it nothing is sent, and the host sees
// the hole in the sequence.
static bool sendFrame() {
  const uint16_t crc = crcOfBody();
  put16(crc);
  uint8_t wire[MAX_BODY + 4];
  uint8_t codeAt = 0, length = 1;
  for (uint8_t i = 0; i < bodyLength; i++) {
    if (body[i] == 0) {
      wire[codeAt] = length - codeAt;
      codeAt = length++;
    } else {
      wire[length++] = body[i];
    }
  }
  wire[codeAt] = length - codeAt;
  wire[length++] = 0;
  if (Serial.availableForWrite() < length) return false;
  Serial.write(wire, length);
  return true;
}

static void sendSample(uint32_t timeUs, uint8_t status) {
  beginFrame(SAMPLE_TYPE, sequence++, timeUs);
  put8(status);
  for (uint8_t i = 0; i < 3; i++) put16((uint16_t)accel[i]);
  for (uint8_t i = 0; i < 3; i++) put16((uint16_t)gyro[i]);
  for (uint8_t i = 0; i < 3; i++) put16((uint16_t)mag[i]);
  put16((uint16_t)temperature);
  sendFrame();
}

static bool sendHello(uint32_t timeUs) {
  beginFrame(HELLO_TYPE, sequence++, timeUs);
  put8(PROTOCOL_VERSION);
  put8((accelChip.ready ? CHIPS_ACCEL : 0) | (gyroChip.ready ? CHIPS_GYRO : 0) | (magChip.ready ? CHIPS_MAG : 0) |
       (HAS_ENCODERS ? CHIPS_ENCODERS : 0) | (HAS_GNSS ? CHIPS_GNSS : 0) | (started ? CHIPS_STARTED : 0));
  put8(accelChip.id[0]);
  put8(gyroChip.id[0]);
  for (uint8_t i = 0; i < 3; i++) put8(magChip.id[i]);
  put16(RATE_HZ);
  put32(ACCEL_NM_S2);
  put32(GYRO_NRAD_S);
  put32(MAG_PT);
  put32(TEMPERATURE_NK);
  put32((uint32_t)TEMPERATURE_MC);
  put16(ACCEL_LIMIT);
  put16(GYRO_LIMIT);
  put16(MAG_LIMIT);
  return sendFrame();
}

// ---- encoders: an interrupt at each edge of channel A

#if LEFT_A >= 0
#if !defined(IRAM_ATTR)
#define IRAM_ATTR
#endif

static const uint32_t COUNTS_EVERY_US = 1000000UL / COUNTS_HZ;
static const uint8_t COUNTS_WIRE = 19;
static volatile int32_t leftCount, rightCount;
static uint32_t countsDueUs;
static uint16_t countsSent;

// Going forward, A is a quarter ahead of B, so that right after an edge of A both differ.
static void IRAM_ATTR leftTurned() { leftCount = leftCount + (digitalRead(LEFT_A) != digitalRead(LEFT_B) ? 1 : -1); }
static void IRAM_ATTR rightTurned() { rightCount = rightCount + (digitalRead(RIGHT_A) != digitalRead(RIGHT_B) ? 1 : -1); }

static void beginEncoders() {
  const uint8_t pins[] = {LEFT_A, LEFT_B, RIGHT_A, RIGHT_B};
  for (uint8_t i = 0; i < 4; i++) pinMode(pins[i], INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(LEFT_A), leftTurned, CHANGE);
  attachInterrupt(digitalPinToInterrupt(RIGHT_A), rightTurned, CHANGE);
  countsDueUs = micros();
}

static void sendCounts(uint32_t timeUs) {
  if (timeUs - countsDueUs >= 0x80000000UL || Serial.availableForWrite() < SAMPLE_WIRE + COUNTS_WIRE) return;
  countsDueUs = timeUs + COUNTS_EVERY_US;
  noInterrupts();  // an AVR reads 32 bits in four steps
  const int32_t left = leftCount, right = rightCount;
  interrupts();
  beginFrame(COUNTS_TYPE, countsSent++, timeUs);
  put32((uint32_t)left);
  put32((uint32_t)right);
  sendFrame();
}
#else
static void beginEncoders() {}
static void sendCounts(uint32_t) {}
#endif

// ---- a satellite receiver: its bytes as they come, with the time of the first one

#if defined(GNSS_PORT)
static const uint32_t GNSS_QUIET_US = 5000;  // without another byte for so long, what there is is sent
static const uint8_t PASSED_WIRE = 11;       // and the bytes
static uint8_t passed[MOST_PASSED], passedLength;
static uint32_t passedUs, passedLastUs;
static uint16_t passedSent;

static void beginGnss() { GNSS_PORT.begin(GNSS_BAUD); }

static void passOn(uint32_t timeUs) {
  while (passedLength < MOST_PASSED && GNSS_PORT.available() > 0) {
    if (passedLength == 0) passedUs = timeUs;
    passed[passedLength++] = (uint8_t)GNSS_PORT.read();
    passedLastUs = timeUs;
  }
  if (passedLength == 0 || (passedLength < MOST_PASSED && timeUs - passedLastUs < GNSS_QUIET_US)) return;
  if (Serial.availableForWrite() < SAMPLE_WIRE + PASSED_WIRE + passedLength) return;
  beginFrame(PASSED_TYPE, passedSent++, passedUs);
  for (uint8_t i = 0; i < passedLength; i++) put8(passed[i]);
  passedLength = 0;
  sendFrame();
}
#else
static void beginGnss() {}
static void passOn(uint32_t) {}
#endif

// ---- the loop

static void sampleAndSend(uint32_t timeUs) {
  uint8_t status = missed ? STATUS_MISSED : 0;
  missed = false;
  bool retried = false;
  if (!readOrRetry(gyroChip, beginGyro, readGyro, retried)) status |= STATUS_GYRO_ERROR;
  if (!readOrRetry(accelChip, beginAccel, readAccel, retried)) status |= STATUS_ACCEL_ERROR;
  if (magCountdown-- == 0) {
    magCountdown = MAG_EVERY - 1;
    magStatus = readOrRetry(magChip, beginMag, readMag, retried) ? 0 : STATUS_MAG_ERROR;
    if (magStatus == 0) {
      if (magSettling > 0)
        magSettling--;
      else
        status |= STATUS_MAG_NEW;
    }
  }
  sendSample(timeUs, status | magStatus);
}

void setup() {
#if defined(ESP32)
  Serial.setTxBufferSize(512);
#endif
  Serial.begin(BAUD);
  beginEncoders();
  beginGnss();
  freeBus();
  writeRegister(0x68, 0x3E, 0x80);  // reset the gyro, at either address
  writeRegister(0x69, 0x3E, 0x80);
  delay(70);  // it starts, and so do the others
  gyroChip.ready = beginGyro();
  accelChip.ready = beginAccel();
  magChip.ready = beginMag();
  delay(50);  // a gyro's first samples have a larger offset
  helloUs = dueUs = micros();
}

void loop() {
  const uint32_t now = micros();
  if ((int32_t)(now - dueUs) >= 0) {
    dueUs += PERIOD_US;
    if ((int32_t)(now - dueUs) >= 0) {  // more than a period late
      missed = true;
      dueUs = now + PERIOD_US;
    }
    sampleAndSend(now);
  } else if (helloPending) {
    if (Serial.availableForWrite() >= MAX_BODY + 4 && sendHello(now)) {
      helloPending = started = false;
    }
  } else if (now - helloUs >= HELLO_EVERY_US) {
    helloUs = now;
    helloPending = true;
  } else {
    sendCounts(now);
    passOn(now);
  }
}
