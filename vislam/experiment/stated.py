"""How sure an estimator by others states its poses to be: optional columns of its file, optional parts of its answers.

A covariance [6, 6] is of (rotation [rad], position [m]): rotation perturbed on the body side, position in the axes of
its own world, as `NavState` has it. It goes through the same statistics as that of our states.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.files import write_text
from vislam.core.messages import Array, NavState
from vislam.trajectory import read_tum
from vislam.trajectory.formats import read_table
from vislam.trajectory.states import write_states_csv

_UPPER = np.triu_indices(6)
_POSE_COLUMNS = 8  # stamp, position, quaternion
_ASYMMETRIC = 1e-6  # relative to the largest entry; programs round
_NEGATIVE = 1e-6  # of an eigenvalue, likewise


def checked(covariance: Array, where: str) -> Array:
    """Return a covariance [6, 6], made symmetric. Raises DataError when it is none."""
    P = np.array(covariance, dtype=np.float64)
    if P.shape != (6, 6):
        raise DataError(f"{where}: a covariance is an array [6, 6] of rotation and position, not {[*P.shape]}")
    size = float(np.abs(P).max())
    if not np.isfinite(size):
        raise DataError(f"{where}: the covariance is not finite; leave it away where it is not known")
    if np.abs(P - P.T).max() > _ASYMMETRIC * size or np.linalg.eigvalsh(0.5 * (P + P.T))[0] < -_NEGATIVE * size:
        raise DataError(f"{where}: the covariance is not symmetric with eigenvalues of at least 0")
    return 0.5 * (P + P.T)


def write_stated(path: Path, t_ns: NDArray[np.int64], T_world_body: Array, covariances: Sequence[Array]) -> None:
    """Write poses [N, 4, 4] and their covariances, each [6, 6], as states that know no more. Raises StorageError."""
    unknown = np.full(3, np.nan)
    states = []
    for t, T, P in zip(t_ns.tolist(), T_world_body, covariances, strict=True):
        covariance = np.full((15, 15), np.nan)
        covariance[:6, :6] = P
        states.append(NavState(t, T, unknown, unknown, unknown, covariance))
    write_states_csv(path, range(len(states)), states)


def split_stated(trajectory: Path, states: Path) -> None:
    """Take the covariances out of a TUM file, if it has them, and write them as states; the file keeps its poses.

    With them a line has 21 more numbers, the upper triangle row by row; "nan" where a pose has none. Raises DataError
    with file and line on damage, StorageError.
    """
    with_covariance = _POSE_COLUMNS + len(_UPPER[0])
    _, numbers, lines = read_table(
        trajectory, separator=None, columns=(_POSE_COLUMNS, with_covariance), optional_from=_POSE_COLUMNS - 1
    )
    if numbers.shape[1] == _POSE_COLUMNS - 1:
        return
    kept = [line.split()[:_POSE_COLUMNS] for line in trajectory.read_text(encoding="utf-8").splitlines()]
    write_text(trajectory, "".join(" ".join(fields) + "\n" for fields in kept if fields and fields[0][0] != "#"))
    poses = read_tum(trajectory)
    upper = numbers[:, _POSE_COLUMNS - 1 :]
    rows, covariances = [], []
    for i in np.flatnonzero(~np.isnan(upper).all(axis=1)).tolist():
        P = np.zeros((6, 6))
        P[_UPPER] = upper[i]
        rows.append(i)
        covariances.append(checked(P + np.triu(P, 1).T, f"{trajectory}:{lines[i]}"))
    if rows:
        write_stated(states, poses.t_ns[rows], poses.T_world_body[rows], covariances)
