"""Keyframe states with covariances as CSV, so that consistency can be judged after a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.errors import DataError
from vislam.core.files import write_text
from vislam.core.geometry import quaternion_xyzw_from_rotation
from vislam.core.messages import NavState
from vislam.trajectory.formats import read_table, stamp_ns

_UPPER = np.triu_indices(15)
_POSE_COLUMNS = 8  # after the stamp: keyframe id, position, quaternion; they are always known
_NAMES = (
    "t_ns,keyframe_id,px,py,pz,qx,qy,qz,qw,vx,vy,vz,bgx,bgy,bgz,bax,bay,baz,"
    + ",".join(f"c{i:02d}{j:02d}" for i, j in zip(*_UPPER, strict=True))
).split(",")


def write_states_csv(path: Path, keyframe_ids: Sequence[int], states: Sequence[NavState]) -> None:
    """Write states with their covariance's upper triangle, row-major, in full precision. Raises StorageError."""
    rows = [",".join(_NAMES) + "\n"]
    for keyframe_id, state in zip(keyframe_ids, states, strict=True):
        numbers = np.concatenate(
            (
                state.T_world_body[:3, 3],
                quaternion_xyzw_from_rotation(state.T_world_body[:3, :3]),
                state.velocity_world_m_s,
                state.gyro_bias_rad_s,
                state.accel_bias_m_s2,
                state.covariance[_UPPER],
            )
        )
        rows.append(f"{state.t_ns},{keyframe_id}," + ",".join(map(repr, numbers.tolist())) + "\n")
    write_text(path, "".join(rows))


def read_states_csv(path: Path) -> tuple[NDArray[np.int64], list[NavState]]:
    """Read keyframe ids [N] and states; what was not estimated (velocity and biases without an IMU) is NaN.

    Raises DataError with file and line on damage.
    """
    stamps, numbers, lines = read_table(
        path, separator=",", columns=(len(_NAMES),), header=_NAMES, optional_from=_POSE_COLUMNS
    )
    norms = np.linalg.norm(numbers[:, 4:8], axis=1)
    wrong = np.abs(norms - 1.0) > 1e-3
    if wrong.any():
        i = int(np.argmax(wrong))
        raise DataError(f"{path}:{lines[i]}: quaternion has norm {norms[i]:.4g} instead of 1")
    rotations = Rotation.from_quat(numbers[:, 4:8]).as_matrix()
    states: list[NavState] = []
    for stamp, line, row, R in zip(stamps, lines, numbers, rotations, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, row[1:4]
        upper = np.zeros((15, 15))
        upper[_UPPER] = row[17:]
        covariance = upper + np.triu(upper, 1).T
        states.append(NavState(stamp_ns(stamp, 1, path, line), T, row[8:11], row[11:14], row[14:17], covariance))
    return numbers[:, 0].astype(np.int64), states
