"""The chips behind a serial bridge: which they are, what their counts mean, how old these are when they are read."""

import numpy as np

from vislam.config import SerialConfig
from vislam.core.messages import Array
from vislam.hw.accel_at_gyro import AccelBefore
from vislam.hw.bridge.protocol import SAMPLE_WIRE_BYTES, Ages, Chips, Hello, RawSample, Spent
from vislam.hw.chips import mpu6050
from vislam.hw.health import Health

_CHIPS_S = 0.0005  # from a sample's time to its first byte, of a sketch that does not state it
_MAG_DELAY_S = 0.0067  # half a period of 75 Hz
_NS = 1_000_000_000
_BITS_PER_BYTE = 10  # start, eight, stop
_ADXL345, _MPU6050 = 0xE5, 0x68
_GYROS = {0x68: "ITG3205", 0x69: "ITG3205"}
_MAGNETOMETERS = {b"H43": "HMC5883L", b"H\0\0": "AK8963"}
_SENSORS = {Health.ACCEL_FAULT: "the accelerometer", Health.GYRO_FAULT: "the gyro"}
_CLOCK = 2**32  # microseconds until it wraps
_MOST_APART = 1.5  # periods between samples that follow each other


class Behind:
    """How old the counts of the chips are, by what the device states about them.

    A GY-85's filters are known from the settings. Any other chip states its own in a frame of `Ages`; before it has,
    nothing is made of its counts.
    """

    def __init__(self, config: SerialConfig) -> None:
        """Take what is known of the line and of a GY-85."""
        self.hello: Hello | None = None
        self._ages: Ages | None = None
        self._config = config
        self._wire_s = SAMPLE_WIRE_BYTES * _BITS_PER_BYTE / config.baud
        self._spent_s = _CHIPS_S
        self._accel_us, self._at_gyro = 0, AccelBefore()

    def forget(self) -> None:
        """Another device may answer from now on."""
        self.hello = self._ages = None
        self._at_gyro.forget()
        self._spent_s = _CHIPS_S

    def take(self, stated: Ages | Spent) -> None:
        """Take the ages that belong to the hello that follows, or how long a sample takes the device."""
        if isinstance(stated, Spent):
            self._spent_s = stated.spent_us * 1e-6
        else:
            self._ages = stated

    @property
    def line_ns(self) -> int:
        """From a sample's time to the arrival of its last byte, at the least."""
        return round((self._wire_s + self._spent_s) * _NS)

    def greet(self, hello: Hello) -> None:
        """Take what the device states about its chips."""
        if self.hello is None or self.hello.accel_id != hello.accel_id:
            self._at_gyro.forget()
        self.hello = hello

    @property
    def is_known(self) -> bool:
        """Whether counts can be made samples of."""
        hello, ages = self.hello, self._ages
        if hello is None:
            return False
        return not _is_one_chip(hello) or (ages is not None and ages.accel_id == hello.accel_id)

    @property
    def name(self) -> str:
        """What the device states to have, in words; empty before it did."""
        hello = self.hello
        if hello is None:
            return ""
        if _is_one_chip(hello):
            names = [mpu6050.IDS[hello.accel_id]]
        else:
            names = ["ADXL345"] if Chips.ACCEL in hello.chips else []
            names += [_GYROS.get(hello.gyro_id, "a gyro")] if Chips.GYRO in hello.chips else []
        names += [_MAGNETOMETERS.get(hello.mag_id, "a magnetometer")] if Chips.MAG in hello.chips else []
        return ", ".join(names) or "no chip that answers"

    @property
    def max_zero_deg_s(self) -> float:
        """Of the gyro at rest, by the data sheet: ITG3205, MPU-6050, later ones."""
        if self.hello is None or not _is_one_chip(self.hello):
            return 40.0
        return 20.0 if self.hello.accel_id == _MPU6050 else 5.0

    def why_silent(self, faults: Health) -> str:
        """Return why a board that said hello gives no samples, and what to do."""
        if stranger := self._stranger():
            return (
                f"the board has {stranger}; put one of these or a GY-85 behind it, or connect the chip to the host's "
                "I2C bus: docs/sensors.md"
            )
        missing = [name for bit, name in _SENSORS.items() if bit in faults]
        what = f"has no answer from {' and '.join(missing)}" if missing else "gives no sample"
        return f"the board runs and {what}; check the chips' power, SDA and SCL"

    def _stranger(self) -> str:
        """Return a chip's id by the device that its sketch does not know; empty: there is none."""
        hello = self.hello
        if hello is None or hello.chips & (Chips.ACCEL | Chips.GYRO):
            return ""
        if hello.accel_id in (0, _ADXL345) or hello.accel_id in mpu6050.IDS:
            return ""
        known = ", ".join(f"{name} 0x{value:02x}" for value, name in mpu6050.IDS.items())
        return f"a chip with the id 0x{hello.accel_id:02x}, and the sketch knows {known}"

    @property
    def mag_delay_ns(self) -> int:
        """From a measurement of the magnetometer to the time of its sample."""
        return round(_MAG_DELAY_S * _NS) if self._stated is None else 1000 * self._stated.mag_us

    @property
    def gyro_delay_ns(self) -> int:
        """From what the gyro's filter shows to the time of its sample."""
        return round(self._config.filter_s * _NS) if self._stated is None else 1000 * self._stated.gyro_us

    def accel(self, raw: RawSample) -> Array:
        """Return the accelerometer's counts [3] at the time of the gyro's."""
        accel, ages = np.array(raw.accel, dtype=np.float64), self._stated
        if ages is None or self.hello is None:
            return accel
        since_us, self._accel_us = (raw.t_us - self._accel_us) % _CLOCK, raw.t_us
        if not 0 < since_us * self.hello.rate_hz <= _MOST_APART * 1e6:
            self._at_gyro.forget()
        return self._at_gyro.moved(accel[None], (ages.gyro_us - ages.accel_us) / max(since_us, 1))[0]

    @property
    def _stated(self) -> Ages | None:
        return self._ages if self.hello is not None and _is_one_chip(self.hello) else None


def _is_one_chip(hello: Hello) -> bool:
    return hello.accel_id in mpu6050.IDS
