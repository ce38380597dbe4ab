"""The pose for control as it leaves: one struct of 256 bytes, the same in shared memory, in datagrams and in C.

`include/vislam_pose.h` is this table in C; docs/cart.md explains every field. Little-endian, no padding. Frames are
those of REP-103 and REP-105: `odom` is continuous and never jumps, `map` is what loops correct, `base` is what a
controller steers (x forward, y left, z up). Covariances are in the order and axes of ROS's nav_msgs/Odometry.
"""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vislam.core.errors import DataError
from vislam.core.geometry import quaternion_wxyz, rotation_from_quaternion_xyzw, skew, so3_exp, transform
from vislam.core.jit import njit
from vislam.core.messages import Array, NavState
from vislam.hw.health import Health

HEADER = Path(__file__).with_name("include") / "vislam_pose.h"
MAGIC = 0x4F505356  # "VSPO"
VERSION = 1
SIZE = 256
NO_VISION_MS = 0xFFFF  # vision was never there, or is longer ago than 65 s
LAYOUT = np.dtype(
    [
        ("magic", "<u4"),
        ("version", "<u2"),
        ("size", "<u2"),
        ("sequence", "<u4"),
        ("health", "<u4"),
        ("stamp_sample_ns", "<i8"),
        ("stamp_publish_ns", "<i8"),
        ("position_m", "<f8", (3,)),
        ("orientation_xyzw", "<f4", (4,)),
        ("velocity_m_s", "<f4", (3,)),
        ("rate_rad_s", "<f4", (3,)),
        ("pose_covariance", "<f4", (21,)),
        ("velocity_covariance", "<f4", (6,)),
        ("rate_variance", "<f4", (3,)),
        ("map_odom_position_m", "<f4", (3,)),
        ("map_odom_orientation_xyzw", "<f4", (4,)),
        ("map_revision", "<u4"),
        ("reset_counter", "<u2"),
        ("vision_age_ms", "<u2"),
        ("crc32", "<u4"),
    ]
)
_UPPER_6 = np.triu_indices(6)
_XYZW = [1, 2, 3, 0]
_UPPER_3 = np.triu_indices(3)
_CHECKED = SIZE - 4


@dataclass(frozen=True, slots=True, eq=False)
class PublishedPose:
    """Where the base is, how it moves, and how far that can be trusted.

    Covariances [6, 6] have the order x, y, z, then rotation about X, Y, Z. Those of the pose are in axes of `odom`,
    those of the twist in axes of `base`.
    """

    t_ns: int  # of the inertial sample, CLOCK_MONOTONIC
    published_ns: int  # when this was handed out
    sequence: int  # one more with each, from 1
    health: Health
    T_odom_base: Array  # [4, 4]
    velocity_m_s: Array  # [3] of the base, in its own axes
    rate_rad_s: Array  # [3] in axes of the base, bias taken off
    pose_covariance: Array
    twist_covariance: Array  # linear and angular are taken as independent
    T_map_odom: Array  # [4, 4]
    map_revision: int  # of the graph; 0: the graph has not spoken, map and odom coincide
    reset_counter: int  # one more whenever the filter gave up its certainty or was restarted
    vision_age_s: float  # since vision, or without a camera a sensor, corrected; infinite: never, or over a minute

    @property
    def T_map_base(self) -> Array:
        """The pose [4, 4] in `map`; it moves by what loops correct, at once where that is much: for planning."""
        return self.T_map_odom @ self.T_odom_base

    @property
    def age_s(self) -> float:
        """How long ago this was handed out, by the clock of this machine: large when `vislam live` has gone."""
        return (time.monotonic_ns() - self.published_ns) * 1e-9

    def predict(
        self, t_ns: int, accel_sigma_m_s2: float = 1.0, angular_accel_sigma_rad_s2: float = 1.0
    ) -> PublishedPose:
        """Return the pose at a time when an actuator will answer: constant twist, and covariance that grows.

        Args:
            t_ns: wanted, not before `t_ns` of the pose.
            accel_sigma_m_s2: what the base may accelerate meanwhile, along each of its axes.
            angular_accel_sigma_rad_s2: the same for rotation.

        Raises:
            DataError: the time is before that of the pose.
        """
        dt = (t_ns - self.t_ns) * 1e-9
        if dt < 0.0:
            raise DataError(
                f"the pose is of {self.t_ns} ns, asked for {-dt:.4f} s earlier; it is predicted forward only"
            )
        R = self.T_odom_base[:3, :3]
        half = so3_exp(0.5 * dt * self.rate_rad_s)
        moved = R @ half @ self.velocity_m_s * dt  # the chord of the arc, to third order in the angle
        T = transform(R @ half @ half, self.T_odom_base[:3, 3] + moved)
        unknown = np.repeat([accel_sigma_m_s2**2, angular_accel_sigma_rad_s2**2], 3)
        to_odom = np.zeros((6, 6))
        to_odom[:3, :3] = to_odom[3:, 3:] = R
        grown = dt**2 * self.twist_covariance + 0.25 * dt**4 * np.diag(unknown)
        swing = np.eye(6)
        swing[:3, 3:] = -skew(moved)  # a wrong heading carries the way that was driven since sideways
        return replace(
            self,
            t_ns=t_ns,
            T_odom_base=T,
            pose_covariance=swing @ self.pose_covariance @ swing.T + to_odom @ grown @ to_odom.T,
            twist_covariance=self.twist_covariance + dt**2 * np.diag(unknown),
        )


def pack(pose: PublishedPose) -> bytes:
    """Return the struct of 256 bytes."""
    record = np.zeros((), LAYOUT)
    record["magic"], record["version"], record["size"] = MAGIC, VERSION, SIZE
    record["sequence"], record["health"] = pose.sequence & 0xFFFFFFFF, int(pose.health)
    record["stamp_sample_ns"], record["stamp_publish_ns"] = pose.t_ns, pose.published_ns
    record["position_m"] = pose.T_odom_base[:3, 3]
    record["orientation_xyzw"] = _quaternion_xyzw(pose.T_odom_base)
    record["velocity_m_s"], record["rate_rad_s"] = pose.velocity_m_s, pose.rate_rad_s
    record["pose_covariance"] = pose.pose_covariance[_UPPER_6]
    record["velocity_covariance"] = pose.twist_covariance[:3, :3][_UPPER_3]
    record["rate_variance"] = np.diag(pose.twist_covariance)[3:]
    record["map_odom_position_m"] = pose.T_map_odom[:3, 3]
    record["map_odom_orientation_xyzw"] = _quaternion_xyzw(pose.T_map_odom)
    record["map_revision"], record["reset_counter"] = pose.map_revision & 0xFFFFFFFF, pose.reset_counter & 0xFFFF
    record["vision_age_ms"] = min(pose.vision_age_s * 1e3, NO_VISION_MS)
    record["crc32"] = zlib.crc32(record.tobytes()[:_CHECKED])
    return record.tobytes()


def unpack(data: bytes | memoryview) -> PublishedPose:
    """Return what a struct holds. Raises DataError when it is damaged, or another version's."""
    if len(data) != SIZE:
        raise DataError(f"a published pose has {SIZE} bytes, got {len(data)}; is this another datagram?")
    record = np.frombuffer(data, LAYOUT)[0]
    if record["magic"] != MAGIC or record["version"] != VERSION or record["size"] != SIZE:
        raise DataError(
            f"not a published pose of version {VERSION}: magic {int(record['magic']):#x}, version {record['version']}, "
            f"size {record['size']}; build the reader and the sender from one release"
        )
    if zlib.crc32(memoryview(data)[:_CHECKED]) != record["crc32"]:
        raise DataError("a published pose fails its checksum; it was changed on the way")
    covariance, velocity, twist = np.zeros((6, 6)), np.zeros((3, 3)), np.zeros((6, 6))
    covariance[_UPPER_6] = record["pose_covariance"]
    velocity[_UPPER_3] = record["velocity_covariance"]
    twist[:3, :3] = velocity + np.triu(velocity, 1).T
    twist[3:, 3:] = np.diag(record["rate_variance"])
    age_ms = int(record["vision_age_ms"])
    return PublishedPose(
        t_ns=int(record["stamp_sample_ns"]),
        published_ns=int(record["stamp_publish_ns"]),
        sequence=int(record["sequence"]),
        health=Health(int(record["health"])),
        T_odom_base=_pose(record["position_m"], record["orientation_xyzw"]),
        velocity_m_s=record["velocity_m_s"].astype(np.float64),
        rate_rad_s=record["rate_rad_s"].astype(np.float64),
        pose_covariance=covariance + np.triu(covariance, 1).T,
        twist_covariance=twist,
        T_map_odom=_pose(record["map_odom_position_m"], record["map_odom_orientation_xyzw"]),
        map_revision=int(record["map_revision"]),
        reset_counter=int(record["reset_counter"]),
        vision_age_s=float("inf") if age_ms == NO_VISION_MS else age_ms * 1e-3,
    )


def _quaternion_xyzw(T: Array) -> Array:
    return quaternion_wxyz(np.ascontiguousarray(T[:3, :3]))[_XYZW]


def _pose(position_m: Array, orientation_xyzw: Array) -> Array:
    T = np.eye(4)  # not `transform`: loading what is compiled would make a reader miss its first third of a second
    T[:3, :3] = rotation_from_quaternion_xyzw(orientation_xyzw.astype(np.float64))
    T[:3, 3] = position_m
    return T


def of_base(
    state: NavState, gyro_rad_s: Array, gyro_variance: float, base_offset_m: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return pose, velocity, rate and their covariances of the base, as `PublishedPose` has them.

    Args:
        state: of the body (the IMU), in odom.
        gyro_rad_s: [3] the newest sample, bias included.
        gyro_variance: (rad/s)^2 of one axis of one sample, white part.
        base_offset_m: [3] the base's origin in body axes; both have the same axes.
    """
    T = state.T_world_body
    rate = gyro_rad_s - state.gyro_bias_rad_s
    velocity, pose_covariance, twist_covariance = _of_base(
        T, state.velocity_world_m_s, rate, state.covariance, gyro_variance, base_offset_m
    )
    return transform(T[:3, :3], T[:3, 3] + T[:3, :3] @ base_offset_m), velocity, rate, pose_covariance, twist_covariance


@njit(cache=True, nogil=True)
def _of_base(
    T: Array, velocity_m_s: Array, rate_rad_s: Array, P: Array, gyro_variance: float, offset_m: Array
) -> tuple[Array, Array, Array]:
    """Return velocity and both covariances of the base; see `of_base`."""
    R = T[:3, :3].copy()
    R_T = R.T.copy()
    lever = skew(offset_m)
    velocity_body = R_T @ velocity_m_s
    J = np.zeros((6, 15))  # x, y, z, then rotation about the axes of odom
    J[:3, :3] = -R @ lever
    J[:3, 3:6] = np.eye(3)
    J[3:, :3] = R
    K = np.zeros((3, 15))
    K[:, :3] = skew(velocity_body)
    K[:, 6:9] = R_T
    K[:, 9:12] = lever  # the rate is the gyro less its bias
    twist = np.zeros((6, 6))
    twist[:3, :3] = K @ P @ K.T + gyro_variance * (lever @ lever.T)
    twist[3:, 3:] = P[9:12, 9:12] + gyro_variance * np.eye(3)
    return velocity_body - lever @ rate_rad_s, J @ P @ J.T, twist
