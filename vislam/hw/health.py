"""The health word: what the controller must know before it trusts a pose, as bits that travel in every datagram."""

from enum import IntFlag


class Health(IntFlag):
    """32 bits. The low half is the state of the estimate, the high half faults of the sensors; 0 is not yet started."""

    LEVELLED = 1 << 0  # gravity is known
    VISION_OK = 1 << 1  # vision corrects the filter; without a camera, further sensors do
    DEAD_RECKONING = 1 << 2  # nothing of that: inertial data, wheels' constraint and rest alone
    INVALID = 1 << 3  # position sigma is beyond the stated limit: do not steer by it
    AT_REST = 1 << 4
    MAG_OK = 1 << 5
    GATE_REJECT = 1 << 6  # vision contradicts the filter now
    DOUBTFUL = 1 << 7  # the run so far contradicts itself: see the verdict's reasons (status line, metrics.json)
    NOT_IN_MAP = 1 << 8  # where odom is in map is a guess: the place was not found yet, or lost
    IMU_MISSING = 1 << 16  # no sample within the time that the source allows
    IMU_GAP = 1 << 17  # samples were lost since the last word
    ACCEL_SATURATED = 1 << 18
    GYRO_SATURATED = 1 << 19
    ACCEL_FAULT = 1 << 20  # chip missing, stuck or failed its self-test
    GYRO_FAULT = 1 << 21
    MAG_FAULT = 1 << 22
    BUS_FAULT = 1 << 23  # NACK, stuck bus, frames that fail their check
    TEMPERATURE_DRIFT = 1 << 24  # too far from where the biases were calibrated
    CLOCK_STEP = 1 << 25  # device time and host time parted and were joined again
    CAMERA_MISSING = 1 << 26
