// vislam_bridge: reads a GY-85 (ADXL345, ITG3205, HMC5883L) or an MPU-6050, -6500, -9250 or -9255 on time and sends
// frames to vislam over a serial line. Which of them is there it finds when it starts.
//
// For AVR (Nano, Uno, Mega, Leonardo) and ESP32 with their Arduino cores; no library but Wire. Connect 5 V or 3.3 V as
// your board is made for, GND, SDA and SCL (Nano and Uno: A4 and A5; ESP32: 21 and 22). docs/sensors.md of vislam has the
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
static const uint32_t RETRY_MS = 40;      // between attempts to set up a chip that does not answer
static const uint16_t I2C_TIMEOUT_MS = 3; // a stuck bus must not stop the clock

// Ranges of an MPU-6050 and its kin, 0 to 3: 250, 500, 1000, 2000 degrees per second; 2, 4, 8, 16 g. The host is told.
#ifndef MPU_GYRO_RANGE
#define MPU_GYRO_RANGE 1
#endif
#ifndef MPU_ACCEL_RANGE
#define MPU_ACCEL_RANGE 2
#endif

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
static const uint8_t SAMPLE_TYPE = 1, HELLO_TYPE = 2, COUNTS_TYPE = 3, PASSED_TYPE = 4, AGES_TYPE = 5, SPENT_TYPE = 6;
static const uint8_t STATUS_MAG_NEW = 1, STATUS_ACCEL_ERROR = 2, STATUS_GYRO_ERROR = 4, STATUS_MAG_ERROR = 8,
                     STATUS_MISSED = 16;
static const uint8_t CHIPS_ACCEL = 1, CHIPS_GYRO = 2, CHIPS_MAG = 4, CHIPS_ENCODERS = 8, CHIPS_GNSS = 16,
                     CHIPS_FAST_EDGES = 32, CHIPS_STARTED = 128;

// What counts of gyro and accelerometer mean, and from which on they are saturated.
struct Inertial {
  uint32_t accelNmS2, gyroNradS, temperatureNk;
  int32_t temperatureMc;  // at count 0
  uint16_t accelLimit, gyroLimit;
};
// 256 counts a g in full resolution, whatever the range; 14.375 counts a degree per second; 280 a degree, 35 at -13200;
// 16 g and 2000 degrees per second.
static const Inertial GY85 = {38307227, 1214142, 3571429, 82143, 4095, 28750};
static const uint32_t MPU_GYRO_NRAD_S[] = {133231, 266462, 532113, 1064225};      // 131, 65.5, 32.8, 16.4 counts
static const uint32_t MPU_ACCEL_NM_S2[] = {598550, 1197101, 2394202, 4788403};  // 16384, 8192, 4096, 2048 counts a g
// 340 counts a degree and 36.53 at 0; of the later chips 333.87, and 21
static const Inertial MPU6050 = {MPU_ACCEL_NM_S2[MPU_ACCEL_RANGE], MPU_GYRO_NRAD_S[MPU_GYRO_RANGE], 2941176, 36530,
                                 32767, 32767};
static const Inertial LATER_MPU = {MPU_ACCEL_NM_S2[MPU_ACCEL_RANGE], MPU_GYRO_NRAD_S[MPU_GYRO_RANGE], 2995178, 21000,
                                   32767, 32767};

// What those of a magnetometer mean, and how old its values are on average: half a period.
struct Magnetic {
  uint32_t pt;
  uint16_t limit, ageUs;
};
static const Magnetic HMC5883L = {91743, 2048, 6700};   // 1090 counts a gauss; 12 bits, and -4096 says overflow
static const Magnetic AK8963 = {150000, 32760, 5000};  // 0.15 uT, and 16 bits

// How old the values of gyro and accelerometer are when they are read: the delay of their filters (of 98 and 94 Hz; of
// the later chips 92 and 99), and half a millisecond, for they come a thousand times a second.
static const uint16_t MPU6050_AGES_US[] = {3300, 3500}, LATER_MPU_AGES_US[] = {4400, 3380};

static const uint32_t PERIOD_US = 1000000UL / RATE_HZ;
static const uint32_t HELLO_EVERY_US = 1000000UL;
static const uint8_t MAG_EVERY = RATE_HZ / MAG_RATE_HZ;
static const uint8_t ACCEL_FORMAT = 0x0B;          // full resolution, 16 g
static const uint8_t GYRO_FILTER = (3 << 3) | 2;   // 2000 degrees per second, filter at 98 Hz
static const uint8_t MPU_FILTER = 2;               // the widest below half of 200 Hz and more
static const uint32_t MPU_START_MS = 100;          // until its gyro gives good samples
static const uint8_t FIRST_HELLOS = 2;  // of such a chip before its first sample: one may be lost on the line
static const uint8_t MAG_SETTLING = 2;  // its first readings still have the gain before
static const uint8_t MAX_BODY = 48;     // the hello is 42 bytes
static const uint8_t SAMPLE_WIRE = 32;  // bytes that a sample takes; for anything but a hello this much stays free
static const uint8_t MOST_PASSED = 20;  // bytes of a receiver in a frame: with a sample they fill an AVR's buffer

struct Chip {
  uint8_t address;
  uint8_t id[3];
  bool ready, failed;  // set up; not read the last time
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
static bool fastEdges = false;  // since the last hello edges came too fast to be counted for sure
static bool isMpu = false, boardKnown = false;  // which board it is stays until the sketch starts anew
static uint8_t strangerId;                      // that a chip says in a MPU's place, none that is known
static uint8_t hellosOwed;                      // before another sample is sent
static uint8_t toldFirst;                       // before the hello that follows: what is spent, ages
static uint16_t agesSent, spentSent;
static uint32_t readUs, gyroUs, handedUs;  // when data were asked for last, those of the gyro; a frame given to the line
static uint16_t spentUs = 0xFFFF;          // the least from a sample's time to that, since it was told
static uint32_t mpuBegunMs;
static bool magIsAk = false, magFresh = false, magSeen = false;
static bool magUntold = true;  // no hello has said yet which magnetometer it is
static uint8_t akFuses[3];
static uint8_t magCountdown, magSettling, magStatus;
static uint8_t body[MAX_BODY];
static uint8_t bodyLength;

// ---- I2C: every call returns within the timeout, and says whether the chip answered

static void beginBus() {
  Wire.begin();
  Wire.setClock(I2C_HZ);
#if defined(ARDUINO_ARCH_AVR) || defined(WIRE_HAS_TIMEOUT)  // Arduino's AVR core has it and does not define that
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
  readUs = micros();
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
           && writeRegister(addresses[i], 0x2D, 0x08)  // measure
           && (boardKnown = true);
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
           && writeRegister(addresses[i], 0x17, 0x00) && (boardKnown = true);
  }
  return false;
}

static bool readGyro() {
  uint8_t data[14];
  if (!readRegisters(gyroChip.address, 0x15, data, 14) || data[1] != GYRO_FILTER) return false;
  gyroUs = readUs;
  temperature = bigEndian(data + 6);
  for (uint8_t i = 0; i < 3; i++) gyro[i] = bigEndian(data + 8 + 2 * i);
  return true;
}

// ---- an MPU-6050 or one of its kin: gyro and accelerometer in one chip

static bool isMpuId(uint8_t id) { return id == 0x68 || id == 0x70 || id == 0x71 || id == 0x73; }

// The gyro of a GY-85 has no register there, and what it says then nobody knows; but it is never without its ADXL345.
static bool findMpu() {
  const uint8_t adxl345[] = {0x53, 0x1D}, addresses[] = {0x68, 0x69};
  uint8_t id = 0;
  for (uint8_t i = 0; i < 2; i++) {
    if (readRegisters(adxl345[i], 0x00, &id, 1) && id == 0xE5) return false;
  }
  for (uint8_t i = 0; i < 2; i++) {
    if (!readRegisters(addresses[i], 0x75, &id, 1)) continue;
    if (!isMpuId(id)) {
      strangerId = id;
      continue;
    }
    accelChip.address = gyroChip.address = addresses[i];
    accelChip.id[0] = gyroChip.id[0] = id;
    isMpu = boardKnown = true;
    hellosOwed = FIRST_HELLOS;
    return true;
  }
  return false;
}

static bool beginMpu() {
  const uint8_t address = gyroChip.address;
  uint8_t id = 0;
  mpuBegunMs = millis();
  return readRegisters(address, 0x75, &id, 1) && id == gyroChip.id[0]
         && writeRegister(address, 0x6B, 0x01)  // awake, clock from the X gyro's PLL
         && writeRegister(address, 0x19, 0x00)  // 1 kHz: the newest sample is at most 1 ms old
         && writeRegister(address, 0x1A, MPU_FILTER) && writeRegister(address, 0x1B, MPU_GYRO_RANGE << 3) &&
         writeRegister(address, 0x1C, MPU_ACCEL_RANGE << 3) &&
         (id == 0x68 || writeRegister(address, 0x1D, MPU_FILTER))  // the accelerometer has a filter of its own
         && writeRegister(address, 0x6A, 0x00) && writeRegister(address, 0x37, 0x02);  // a magnetometer behind it is let through
}

static bool readMpu() {
  uint8_t data[14], settings[5];
  if (!readRegisters(gyroChip.address, 0x3B, data, 14)) return false;
  gyroUs = readUs;
  if (!readRegisters(gyroChip.address, 0x19, settings, 5) || settings[0] != 0x00 || settings[1] != MPU_FILTER || settings[2] != MPU_GYRO_RANGE << 3 ||
      settings[3] != MPU_ACCEL_RANGE << 3 || (gyroChip.id[0] != 0x68 && settings[4] != MPU_FILTER))
    return false;
  temperature = bigEndian(data + 6);
  for (uint8_t i = 0; i < 3; i++) {
    accel[i] = bigEndian(data + 2 * i);
    gyro[i] = bigEndian(data + 8 + 2 * i);
  }
  return true;
}

static bool beginGyroOrMpu() {
  if (isMpu || (!boardKnown && findMpu())) return beginMpu();
  return beginGyro();
}

static bool readGyroOrMpu() { return isMpu ? readMpu() : readGyro(); }

// ---- magnetometers

// The one inside an MPU-9250. Its sensitivity is burnt in, and readable in a mode of its own.
static bool beginAk() {
  uint8_t id = 0;
  if (!readRegisters(0x0C, 0x00, &id, 1) || id != 0x48) return false;
  magChip.address = 0x0C;
  magChip.id[0] = id;
  magChip.id[1] = magChip.id[2] = 0;
  if (!writeRegister(0x0C, 0x0A, 0x00)) return false;  // off, between any two modes
  delayMicroseconds(100);
  if (!writeRegister(0x0C, 0x0A, 0x0F) || !readRegisters(0x0C, 0x10, akFuses, 3)) return false;
  if (!writeRegister(0x0C, 0x0A, 0x00)) return false;
  delayMicroseconds(100);
  return writeRegister(0x0C, 0x0A, 0x16);  // 100 Hz, 16 bits
}

// In the axes of the chip around it: x and y change places, z is turned over.
static bool readAk() {
  const uint8_t places[] = {1, 0, 2};
  uint8_t data[9];
  if (!readRegisters(0x0C, 0x02, data, 9) || data[8] != 0x16) return false;
  magFresh = (data[0] & 0x01) != 0;
  if (!magFresh) return true;
  for (uint8_t i = 0; i < 3; i++) {
    const int32_t raw = littleEndian(data + 1 + 2 * i), scaled = raw * (128 + (int32_t)akFuses[i]);
    int32_t counts = (scaled + (scaled < 0 ? -128 : 128)) / 256;
    if (i == 2) counts = -counts;
    if ((data[7] & 0x08) || counts > 32767 || counts < -32767) counts = -32767;  // overflow
    mag[places[i]] = (int16_t)counts;
  }
  return true;
}

static bool beginHmc() {
  magChip.address = 0x1E;
  return readRegisters(0x1E, 0x0A, magChip.id, 3) && magChip.id[0] == 'H' && magChip.id[1] == '4' &&
         magChip.id[2] == '3' && writeRegister(0x1E, 0x00, 0x18)  // 75 Hz, no averaging
         && writeRegister(0x1E, 0x01, 0x20)                       // 1.3 gauss
         && writeRegister(0x1E, 0x02, 0x00);                      // continuous
}

static bool beginMag() {
  magSettling = MAG_SETTLING;
  const bool wasAk = magIsAk;
  bool found = beginHmc();
  if (found || !isMpu) {
    magIsAk = false;
  } else {
    found = magIsAk = beginAk();
  }
  if (magIsAk != wasAk) magUntold = helloPending = true;
  return found;
}

static bool readMag() {
  if (magIsAk) return readAk();
  uint8_t data[9];  // its settings, which it loses with its power, and what it measured
  magFresh = true;
  if (!readRegisters(magChip.address, 0x00, data, 9) || data[0] != 0x18 || data[1] != 0x20 || data[2] != 0x00)
    return false;
  mag[0] = bigEndian(data + 3);
  mag[2] = bigEndian(data + 5);  // the chip has x, z, y
  mag[1] = bigEndian(data + 7);
  return true;
}

// Read a chip. What failed once is read again in the next sample, for a setup costs an MPU a tenth of a second; what
// failed twice is set up again, now and then, and at most one chip in a sample.
static bool readOrRetry(Chip &chip, bool (*begin)(), bool (*read)(), bool &retried) {
  if (chip.ready) {
    const bool isRead = read();
    chip.ready = isRead || !chip.failed;
    chip.failed = !isRead;
    chip.tried_ms = millis() - RETRY_MS;  // it may be well again in the next sample
    return isRead;
  }
  if (!retried && millis() - chip.tried_ms >= RETRY_MS) {
    retried = true;
    chip.tried_ms = millis();
    if (!accelChip.ready && !gyroChip.ready) freeBus();
    chip.ready = begin();
    chip.failed = false;
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
  handedUs = micros();
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
  if (sendFrame() && handedUs - timeUs < spentUs) spentUs = (uint16_t)(handedUs - timeUs);
}

static void sendSpent(uint32_t timeUs) {
  beginFrame(SPENT_TYPE, spentSent++, timeUs);
  put16(spentUs);
  spentUs = 0xFFFF;
  sendFrame();
}

static void sendAges(uint32_t timeUs) {
  const uint16_t *ages = gyroChip.id[0] == 0x68 ? MPU6050_AGES_US : LATER_MPU_AGES_US;
  beginFrame(AGES_TYPE, agesSent++, timeUs);
  put8(accelChip.id[0]);
  put16(ages[0]);
  put16(ages[1]);
  put16(magIsAk ? AK8963.ageUs : HMC5883L.ageUs);
  sendFrame();
}

static bool sendHello(uint32_t timeUs) {
  const Inertial &inertial = !isMpu ? GY85 : gyroChip.id[0] == 0x68 ? MPU6050 : LATER_MPU;
  const Magnetic &magnetic = magIsAk ? AK8963 : HMC5883L;
  beginFrame(HELLO_TYPE, sequence++, timeUs);
  put8(PROTOCOL_VERSION);
  put8((accelChip.ready ? CHIPS_ACCEL : 0) | (gyroChip.ready ? CHIPS_GYRO : 0) | (magChip.ready ? CHIPS_MAG : 0) |
       (HAS_ENCODERS ? CHIPS_ENCODERS : 0) | (HAS_GNSS ? CHIPS_GNSS : 0) |
       (fastEdges ? CHIPS_FAST_EDGES : 0) | (started ? CHIPS_STARTED : 0));
  put8(boardKnown ? accelChip.id[0] : strangerId);
  put8(gyroChip.id[0]);
  for (uint8_t i = 0; i < 3; i++) put8(magChip.id[i]);
  put16(RATE_HZ);
  put32(inertial.accelNmS2);
  put32(inertial.gyroNradS);
  put32(magnetic.pt);
  put32(inertial.temperatureNk);
  put32((uint32_t)inertial.temperatureMc);
  put16(inertial.accelLimit);
  put16(inertial.gyroLimit);
  put16(magnetic.limit);
  if (!sendFrame()) return false;
  helloPending = started = magUntold = fastEdges = false;
  return true;
}

// Say hello where the line takes it, before it how long samples took, and how old the values of a MPU are. Returns
// whether it was said.
static bool greet(uint32_t timeUs) {
  if (Serial.availableForWrite() < MAX_BODY + 4) return false;
  if (toldFirst == 0 && spentUs != 0xFFFF) {
    toldFirst = 1;
    sendSpent(timeUs);
    return false;
  }
  if (toldFirst <= 1 && isMpu) {
    toldFirst = 2;
    sendAges(timeUs);
    return false;
  }
  toldFirst = 0;
  return sendHello(timeUs);
}

// ---- encoders: an interrupt at each edge of channel A

#if LEFT_A >= 0
#if !defined(IRAM_ATTR)
#define IRAM_ATTR
#endif

static const uint32_t COUNTS_EVERY_US = 1000000UL / COUNTS_HZ;
static const uint8_t COUNTS_WIRE = 19;
// Of both wheels together. From about 28 on an Uno reads B after its next edge and counts the wrong way, which looks like a
// wheel that turns back: only how many interrupts there are gives it away.
static const uint32_t MOST_EDGES_MS = 20;
static volatile int32_t leftCount, rightCount;
static volatile uint16_t edges;
static uint32_t countsDueUs, edgesUs;
static uint16_t countsSent;

// Going forward, A is a quarter ahead of B, so that right after an edge of A both differ.
static void IRAM_ATTR leftTurned() {
  leftCount = leftCount + (digitalRead(LEFT_A) != digitalRead(LEFT_B) ? 1 : -1);
  edges = edges + 1;
}
static void IRAM_ATTR rightTurned() {
  rightCount = rightCount + (digitalRead(RIGHT_A) != digitalRead(RIGHT_B) ? 1 : -1);
  edges = edges + 1;
}

static void beginEncoders() {
  const uint8_t pins[] = {LEFT_A, LEFT_B, RIGHT_A, RIGHT_B};
  for (uint8_t i = 0; i < 4; i++) pinMode(pins[i], INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(LEFT_A), leftTurned, CHANGE);
  attachInterrupt(digitalPinToInterrupt(RIGHT_A), rightTurned, CHANGE);
  countsDueUs = edgesUs = micros();
}

static void watchEdges(uint32_t timeUs) {
  noInterrupts();
  const uint16_t seen = edges;
  edges = 0;
  interrupts();
  if (1000UL * seen > MOST_EDGES_MS * (timeUs - edgesUs)) fastEdges = true;
  edgesUs = timeUs;
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
static void watchEdges(uint32_t) {}
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
  if (readOrRetry(gyroChip, beginGyroOrMpu, readGyroOrMpu, retried))
    timeUs = gyroUs;
  else
    status |= STATUS_GYRO_ERROR;
  if (isMpu) {
    accelChip.ready = gyroChip.ready;
    if (millis() - mpuBegunMs < MPU_START_MS) status |= STATUS_GYRO_ERROR;  // it was set up anew, and is starting
    if (status & STATUS_GYRO_ERROR) status |= STATUS_ACCEL_ERROR;
  } else if (!readOrRetry(accelChip, beginAccel, readAccel, retried)) {
    status |= STATUS_ACCEL_ERROR;
  }
  if (magCountdown-- == 0) {
    magCountdown = MAG_EVERY - 1;
    const bool isRead = readOrRetry(magChip, beginMag, readMag, retried);
    magSeen = magSeen || isRead;
    magStatus = isRead || (isMpu && !magSeen) ? 0 : STATUS_MAG_ERROR;  // many boards with a MPU have none
    if (isRead) {
      if (magSettling > 0)
        magSettling--;
      else if (magFresh && !magUntold)
        status |= STATUS_MAG_NEW;
    }
  }
  sendSample(timeUs, status | magStatus);
}

void setup() {
#if defined(ESP32) && !(ARDUINO_USB_CDC_ON_BOOT && !ARDUINO_USB_MODE)  // no member of USBCDC, which S2 and S3 may have
  Serial.setTxBufferSize(512);
#endif
  Serial.begin(BAUD);
  beginEncoders();
  beginGnss();
  freeBus();
  writeRegister(0x68, 0x3E, 0x80);  // reset the gyro, at either address; a MPU has data there, which stay what they are
  writeRegister(0x69, 0x3E, 0x80);
  delay(70);  // it starts, and so do the others
  if (findMpu()) {
    writeRegister(gyroChip.address, 0x6B, 0x80);
    delay(100);  // it resets itself
  }
  gyroChip.ready = beginGyroOrMpu();
  accelChip.ready = isMpu ? gyroChip.ready : beginAccel();
  magChip.ready = beginMag();
  delay(isMpu ? MPU_START_MS : 50);  // a gyro's first samples have a larger offset
  helloUs = dueUs = micros();
}

void loop() {
  const uint32_t now = micros();
  if (hellosOwed > 0) {
    if (greet(now)) hellosOwed--;
    helloUs = dueUs = now;
  } else if ((int32_t)(now - dueUs) >= 0) {
    dueUs += PERIOD_US;
    if ((int32_t)(now - dueUs) >= 0) {  // more than a period late
      missed = true;
      dueUs = now + PERIOD_US;
    }
    watchEdges(now);
    sampleAndSend(now);
  } else if (helloPending) {
    greet(now);
  } else if (now - helloUs >= HELLO_EVERY_US) {
    helloUs = now;
    helloPending = true;
  } else {
    sendCounts(now);
    passOn(now);
  }
}
