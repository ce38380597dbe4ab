"""Real recordings whose inertial data and truth carry simulated vision, cut short so that tests stay fast."""

from pathlib import Path

import numpy as np

from vislam.core.geometry import so3_log
from vislam.core.messages import Array, Frame, ImuSample
from vislam.sim import PointRecording, Simulation


def frames(recording: PointRecording) -> list[Frame]:
    return [event for event in recording.events() if isinstance(event, Frame)]


def samples(recording: PointRecording) -> list[ImuSample]:
    return [event for event in recording.events() if isinstance(event, ImuSample)]


def real(data_root: Path, name: str) -> str:
    return f"points:{data_root / f'euroc_{name}_imu'}"


def angles_rad(R: Array) -> Array:
    return np.array([np.linalg.norm(so3_log(np.ascontiguousarray(part))) for part in R])


def frame_seconds(world: Simulation) -> Array:
    """Return the seconds [N] of a simulated world's own time at which its frames are taken."""
    return 1e-9 * (world.truth().t_ns - world.dense_truth().t_ns[0])
