"""What a run measured, as its session keeps it: enough to estimate everything again without an image."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.camera import Camera, Rig
from vislam.imu import ImuNoise
from vislam.messages import Array, KeyframePacket, LoopEdge, NavState
from vislam.trajectory import Trajectory


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
class LoggedFrames:
    """All frames of a run, relative to the keyframes that they were tracked against."""

    t_ns: NDArray[np.int64]  # [N]
    keyframe_ids: NDArray[np.int64]  # [N], -1 before the first keyframe
    T_keyframe_body: list[Array | None]  # [4, 4] each; None: known by interpolation only

    def placed(self, keyframe_t_ns: dict[int, int], T_map_body: dict[int, Array]) -> Trajectory:
        """Return the pose of every frame, given times and poses of keyframes by id.

        Frames whose motion since their keyframe is unknown are interpolated between those that are known.
        """
        known = {keyframe_t_ns[i]: T for i, T in T_map_body.items()}
        ids = self.keyframe_ids.tolist()
        for t_ns, keyframe_id, T in zip(self.t_ns.tolist(), ids, self.T_keyframe_body, strict=True):
            if T is not None and keyframe_id in T_map_body:
                known[t_ns] = T_map_body[keyframe_id] @ T
        stamps = np.array(sorted(known), dtype=np.int64)
        anchors = Trajectory(stamps, np.array([known[t] for t in stamps.tolist()]).reshape(-1, 4, 4))
        if len(anchors) == 0:
            return anchors
        frames = self.t_ns[(self.t_ns >= stamps[0]) & (self.t_ns <= stamps[-1])]
        return Trajectory(frames, anchors.at(frames))


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
    cameras = [Camera(**{**entry, "coefficients": tuple(entry["coefficients"])}) for entry in data["cameras"]]
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
