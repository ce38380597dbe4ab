"""What a run measured, as its session keeps it: enough to estimate everything again without an image."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from vislam.core.camera import Camera, CameraSigmas, Rig
from vislam.core.messages import Array, KeyframePacket, LoopEdge, NavState
from vislam.imu import ImuNoise
from vislam.trajectory.frames import LoggedFrames


@dataclass(frozen=True, slots=True, eq=False)
class LoggedKeyframe:
    """One keyframe: what was measured with it, and what the run believed about it."""

    packet: KeyframePacket  # its keyframe has no image and no features
    T_odom_body: Array  # [4, 4]
    T_map_body: Array  # [4, 4] the run's last estimate
    velocity_map_m_s: Array | None  # [3] when it was the newest; None without an IMU
    gyro_bias_rad_s: Array | None  # [3]
    accel_bias_m_s2: Array | None  # [3]


@dataclass(frozen=True, slots=True, eq=False)
class LoggedEdge:
    """One offered loop edge and whether the run's graph holds it."""

    edge: LoopEdge
    accepted: bool


@dataclass(frozen=True, slots=True, eq=False)
class FactorLog:
    """A run's rig and sensors, its first state, and every keyframe, loop edge and frame up to where it ended."""

    rig: Rig
    noise: ImuNoise | None  # None: no IMU
    gravity_m_s2: float
    first_state: NavState | None  # of keyframe 0; None without gravity, the run was then vision alone
    keyframes: list[LoggedKeyframe]  # ids are 0, 1, 2, ...
    edges: list[LoggedEdge]  # in order of their ids
    frames: LoggedFrames


def rig_data(rig: Rig) -> dict[str, Any]:
    """Return a rig as plain data; JSON keeps every bit of a float."""
    return {
        "cameras": [asdict(camera) for camera in rig.cameras],
        "T_body_cams": [T.tolist() for T in rig.T_body_cams],
        "has_depth": rig.has_depth,
    }


def rig_from(data: dict[str, Any]) -> Rig:
    """Return the rig of plain data; raises KeyError, TypeError or ValueError on what is none."""
    cameras = [
        Camera(
            **{**entry, "coefficients": tuple(entry["coefficients"]), "sigmas": CameraSigmas(**entry.get("sigmas", {}))}
        )
        for entry in data["cameras"]
    ]
    poses = tuple(np.array(T, dtype=np.float64).reshape(4, 4) for T in data["T_body_cams"])
    return Rig(tuple(cameras), poses, bool(data["has_depth"]))


def state_data(state: NavState) -> dict[str, Any]:
    """Return a state as plain data."""
    data = {name: getattr(state, name) for name in NavState.__slots__}
    return {name: value.tolist() if isinstance(value, np.ndarray) else int(value) for name, value in data.items()}


def state_from(data: dict[str, Any]) -> NavState:
    """Return the state of plain data; raises KeyError, TypeError or ValueError on what is none."""

    def numbers(name: str, *shape: int) -> Array:
        return np.array(data[name], dtype=np.float64).reshape(shape)

    return NavState(
        int(data["t_ns"]), numbers("T_world_body", 4, 4), numbers("velocity_world_m_s", 3),
        numbers("gyro_bias_rad_s", 3), numbers("accel_bias_m_s2", 3), numbers("covariance", 15, 15),
    )  # fmt: skip
