"""The IMU of a RealSense: its samples as the library's threads bring them, on the clock that its images share."""

from __future__ import annotations

from typing import Any

import numpy as np

from vislam.config import BridgeClockConfig, RealsenseConfig
from vislam.core.errors import HardwareError
from vislam.core.messages import Array
from vislam.hw.cameras.factory import looking_ahead, rigid
from vislam.hw.health import Health
from vislam.hw.own_imu import OwnImu
from vislam.hw.shared_clock import SharedClock

_OWN_CLOCK = "the device's clock, on a line under the arrivals of the gyro"


class RealsenseMotion:
    """Turns motion frames into samples of an `OwnImu`. Its methods may be called by several threads of the library."""

    def __init__(self, rs: Any, config: RealsenseConfig, imu: OwnImu) -> None:
        """Begin a clock; the device is started by who owns the pipeline."""
        self._rs, self._config, self._imu = rs, config, imu
        self.clock = SharedClock(BridgeClockConfig(), config.imu_delay_s)
        self._delay_ns = round(config.imu_delay_s * 1e9)
        self._steps, self._is_begun = 0, False

    def begin(self, profile: Any, first: Any) -> None:
        """Take the extrinsics and the rate of a profile that runs; `first` is the stream of the first camera."""
        R_cam_imu = imu_pose(self._rs, profile, first)[:3, :3]
        gyro = profile.get_stream(self._rs.stream.gyro)
        self._is_begun = True
        self._imu.begin(looking_ahead(self._config) @ R_cam_imu, float(gyro.fps()))

    def take(self, frame: Any, arrival_ns: int) -> None:
        """Take a motion frame that has just arrived."""
        if not self._is_begun:
            return  # the library's settings are not made yet
        kind = frame.get_profile().stream_type()
        data = frame.as_motion_frame().get_motion_data()
        value = np.array([data.x, data.y, data.z], dtype=np.float64)
        is_gyro = kind == self._rs.stream.gyro
        domain, domains = frame.get_frame_timestamp_domain(), self._rs.timestamp_domain
        t_ns: int | None = None
        if domain == domains.system_time:
            self._imu.stamped_by = "arrival"
            self._imu.count("bad_stamps")
            t_ns = arrival_ns - self._delay_ns
        elif domain == domains.hardware_clock:  # global time, for a moment after it was switched off, is neither
            device_us = round(frame.get_timestamp() * 1000.0)
            t_ns = self.clock.tick(device_us, arrival_ns) if is_gyro else self.clock.at(device_us)
            self._imu.stamped_by = _OWN_CLOCK
        if self.clock.steps != self._steps:
            self._steps = self.clock.steps
            self._imu.count("clock_steps", Health.CLOCK_STEP)
        if t_ns is None:
            self._imu.count("unstamped")
        elif is_gyro:
            self._imu.add_gyro(t_ns, value)
        else:
            self._imu.add_accel(t_ns, value)


def ask_motion(rs: Any, asked: Any, device: Any, rate_hz: float) -> None:
    """Add gyro and accelerometer to what is asked: the nearest rate of the gyro, the accelerometer's highest.

    Raises HardwareError where the device has no IMU.
    """
    rates: dict[str, list[int]] = {"gyro": [], "accel": []}
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            name = profile.stream_type().name
            if name in rates:
                rates[name].append(int(profile.fps()))
    if not rates["gyro"] or not rates["accel"]:
        raise HardwareError(
            "this RealSense has no IMU, as the models without an i in their name, or its driver does not show it; "
            "take another IMU (--imu), or the one of a D435i, D455 or D457"
        )
    nearest = min(rates["gyro"], key=lambda rate: abs(rate - rate_hz))
    asked.enable_stream(rs.stream.gyro, rs.format.motion_xyz32f, nearest)
    asked.enable_stream(rs.stream.accel, rs.format.motion_xyz32f, max(rates["accel"]))


def imu_pose(rs: Any, profile: Any, first: Any) -> Array:
    """Return the pose [4, 4] of the IMU in a camera (`first`, a stream's profile) by the factory's extrinsics.

    Raises HardwareError where they are no rigid transform.
    """
    e = first.get_extrinsics_to(profile.get_stream(rs.stream.gyro))  # takes points of the camera into the IMU
    return rigid(np.reshape(e.rotation, (3, 3)).T, np.array(e.translation))
