"""Sensor models: what an IMU, a magnetometer, a camera and a depth camera make of the truth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import Array, ImageF32, ImageU8
from vislam.imu import ImuNoise
from vislam.sim.motion.spline import Motion

GAMMA = 2.2  # between linear light and the display values of images
_ELECTRONS, _READ_ELECTRONS = 6000.0, 10.0  # full well, whose shot noise is its root; deviation of the read noise

CONSUMER_IMU = ImuNoise(
    gyroscope_noise_density=4.0e-4,  # about 0.02 deg/s/sqrt(Hz), between a phone's and a GY-85's gyro
    accelerometer_noise_density=3.0e-3,
    gyroscope_random_walk=2.0e-5,
    accelerometer_random_walk=3.0e-4,
    rate_hz=200.0,
    gyroscope_scale_sigma=0.0,  # noise and biases are all that is simulated
    accelerometer_scale_sigma=0.0,
)
GY85_IMU = ImuNoise(
    gyroscope_noise_density=5.2e-4,  # ITG3205: 0.03 deg/s/sqrt(Hz)
    accelerometer_noise_density=6.0e-3,  # ADXL345: 1.1 LSB of 3.9 mg rms at 100 Hz
    gyroscope_random_walk=3.0e-5,
    accelerometer_random_walk=4.0e-4,
    rate_hz=200.0,
    gyroscope_scale_sigma=0.0,  # noise and biases are all that is simulated
    accelerometer_scale_sigma=0.0,
)


@dataclass(frozen=True, slots=True)
class TurnOn:
    """Standard deviations of the biases with which an IMU wakes up."""

    gyro_rad_s: float = 0.006
    accel_m_s2: float = 0.06


CONSUMER_TURN_ON = TurnOn()
GY85_TURN_ON = TurnOn(0.015, 0.1)  # after power-up calibration, a few degrees colder
EARTH_FIELD_UT = np.array(
    [18.2, -10.5, -43.0]
)  # central Europe: 21 µT to the north, here 30 degrees right of x; 64 deg dip


@dataclass(frozen=True, slots=True, eq=False)
class ImuRecord:
    """A simulated IMU's samples and the biases in them."""

    gyro_rad_s: Array  # [N, 3]
    accel_m_s2: Array  # [N, 3]
    gyro_bias_rad_s: Array  # [N, 3]
    accel_bias_m_s2: Array  # [N, 3]


def sense_imu(
    motion: Motion, noise: ImuNoise, gravity_m_s2: float, rng: np.random.Generator, disturbed: bool = True,
    turn_on: TurnOn = CONSUMER_TURN_ON,
) -> ImuRecord:  # fmt: skip
    """Return what an IMU at the body measures at N times spaced `1 / noise.rate_hz`.

    Biases start at a random turn-on value and walk; white noise of density s has the deviation `s * sqrt(rate)` per
    sample (Woodman 2007). With `disturbed` False the samples are exact.
    """
    force_world = motion.acceleration_world_m_s2 + np.array([0.0, 0.0, gravity_m_s2])
    accel = np.einsum("nji,nj->ni", motion.T_world_body[:, :3, :3], force_world)
    gyro = motion.rate_body_rad_s
    count = len(gyro)
    if not disturbed:
        return ImuRecord(gyro.copy(), accel, np.zeros((count, 3)), np.zeros((count, 3)))
    step = 1.0 / np.sqrt(noise.rate_hz)
    gyro_walk = np.cumsum(rng.normal(0.0, noise.gyroscope_random_walk * step, (count, 3)), axis=0)
    accel_walk = np.cumsum(rng.normal(0.0, noise.accelerometer_random_walk * step, (count, 3)), axis=0)
    gyro_bias = rng.normal(0.0, turn_on.gyro_rad_s, 3) + gyro_walk
    accel_bias = rng.normal(0.0, turn_on.accel_m_s2, 3) + accel_walk
    gyro = gyro + gyro_bias + rng.normal(0.0, noise.gyroscope_noise_density / step, (count, 3))
    accel = accel + accel_bias + rng.normal(0.0, noise.accelerometer_noise_density / step, (count, 3))
    return ImuRecord(gyro, accel, gyro_bias, accel_bias)


def sense_field(motion: Motion, sigma_ut: float, rng: np.random.Generator) -> Array:
    """Return the earth's field [N, 3] in µT in the body frame, with white noise of `sigma_ut`."""
    field = np.einsum("nji,j->ni", motion.T_world_body[:, :3, :3], EARTH_FIELD_UT)
    return field + rng.normal(0.0, sigma_ut, field.shape) if sigma_ut > 0.0 else field


@njit(cache=True, nogil=True)
def _expose(color: ImageF32, response: ImageF32, sigma: ImageF32, white: ImageF32, out: ImageU8) -> None:
    """Apply gain and vignetting (`response` [H, W]) and noise (`sigma` [256] by grey level), and round to bytes."""
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            for c in range(3):
                value = min(max(color[v, u, c] * response[v, u], 0.0), 255.0)
                value += sigma[int(value)] * white[v, u, c] + 0.5
                out[v, u, c] = int(min(max(value, 0.0), 255.0))


class Imager:
    """Turns rendered images into what an 8-bit camera delivers: gain, vignetting, shot and read noise, clipping."""

    def __init__(self, width: int, height: int, noisy: bool) -> None:
        """Prepare the tables.

        Args:
            width: image width in pixels.
            height: image height in pixels.
            noisy: False leaves out noise and vignetting.
        """
        y, x = np.mgrid[0:height, 0:width].astype(np.float64)
        squared = ((x - 0.5 * (width - 1)) ** 2 + (y - 0.5 * (height - 1)) ** 2) / (0.25 * (width**2 + height**2))
        falloff = 0.28 if noisy else 0.0  # light lost in the corners
        self._vignette = ((1.0 - falloff * squared) ** (1.0 / GAMMA)).astype(np.float32)
        light = np.maximum((np.arange(256) + 0.5) / 255.0, 0.02) ** GAMMA
        slope = 255.0 / GAMMA * light ** (1.0 / GAMMA - 1.0)  # of the display value by light
        deviation = np.sqrt(light * _ELECTRONS + _READ_ELECTRONS**2) / _ELECTRONS * slope
        self._sigma = (deviation if noisy else np.zeros(256)).astype(np.float32)
        self._noisy = noisy

    def sense(self, color: ImageF32, gain: float, rng: np.random.Generator) -> ImageU8:
        """Return a BGR image [H, W, 3] from display values [H, W, 3]; `gain` multiplies linear light."""
        out = np.empty(color.shape, dtype=np.uint8)
        white = rng.standard_normal(color.shape, dtype=np.float32) if self._noisy else np.zeros(color.shape, np.float32)
        _expose(color, self._vignette * np.float32(gain ** (1.0 / GAMMA)), self._sigma, white, out)
        return out


def exposure_gains(t_s: Array, rng: np.random.Generator) -> Array:
    """Return gains [N] of a restless automatic exposure: a slow drift and a step every ten seconds or so."""
    drift = sum(
        0.05 * np.sin(2.0 * np.pi * frequency * t_s + rng.uniform(0.0, 2.0 * np.pi))
        for frequency in (0.021, 0.053, 0.11)
    )
    logarithm = np.asarray(drift)
    when = rng.uniform(5.0, 12.0)
    while len(t_s) and when < t_s[-1]:
        # A step settles within about three frames, as a camera's control loop does.
        logarithm = logarithm + rng.normal(0.0, 0.12) / (1.0 + np.exp(-np.clip((t_s - when) / 0.05, -50.0, 50.0)))
        logarithm -= 0.5 * logarithm.mean()
        when += rng.uniform(6.0, 14.0)
    return np.exp(np.clip(logarithm, -0.5, 0.4))


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """A depth camera like the Kinect: error grows with the square of the distance (Khoshelham and Elberink 2012)."""

    sigma_m_at_1m: float = 1.5e-3
    floor_m: float = 5e-4
    min_m: float = 0.35
    max_m: float = 7.0
    edge_jump: float = 0.04  # relative step of depth that counts as an edge
    edge_loss: float = 0.6  # part of the edge pixels without a value
    speckle_loss: float = 0.002


def sense_depth(depth_m: ImageF32, noise: DepthNoise, rng: np.random.Generator) -> ImageF32:
    """Return depth [H, W] as a depth camera gives it: noisy, 0 out of range and at part of the edges."""
    white = rng.standard_normal(depth_m.shape, dtype=np.float32)
    chance = rng.random(depth_m.shape, dtype=np.float32)
    noisy = depth_m + white * (np.float32(noise.floor_m) + np.float32(noise.sigma_m_at_1m) * depth_m * depth_m)
    kernel = np.ones((3, 3), dtype=np.uint8)
    jump = cv2.dilate(depth_m, kernel) - cv2.erode(depth_m, kernel)
    loss = np.where(jump > noise.edge_jump * depth_m, np.float32(noise.edge_loss), np.float32(noise.speckle_loss))
    valid = (chance >= loss) & (noisy >= noise.min_m) & (noisy <= noise.max_m)
    return np.where(valid, noisy, np.float32(0.0)).astype(np.float32)
