"""The tables of a session, and values as the bytes in them."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError, StorageError
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import EdgeRecord, GravityRecord, WindowRecord
from vislam.core.messages import Array, NavState

APPLICATION_ID = 0x5649534C  # "VISL": distinguishes our files from other SQLite files
SCHEMA_VERSION = 12
OLDEST_VERSION = 8  # read as well; it knows nothing of what `_LATER` holds
FIRST_WITH_READINGS, FIRST_WITH_LABELS, FIRST_WITH_MOTIONS, FIRST_WITH_FURTHER = 9, 10, 11, 12
DESCRIPTOR_BYTES = 32
_MAX_BLOB_BYTES = 64 * 2**20  # no keyframe of ours comes near; a larger one is damage
_STATE_NUMBERS = 250
_EDGE_NUMBERS = 55
_TILT_NUMBERS = 5
_OLD_NOISE_NAMES = {  # before format 10 was released
    "gyro_noise_density": "gyroscope_noise_density",
    "accel_noise_density": "accelerometer_noise_density",
    "gyro_bias_walk": "gyroscope_random_walk",
    "accel_bias_walk": "accelerometer_random_walk",
    "gyro_scale_sigma": "gyroscope_scale_sigma",
    "accel_scale_sigma": "accelerometer_scale_sigma",
}

SCHEMA = """
CREATE TABLE info (key TEXT PRIMARY KEY, value TEXT NOT NULL, crc INTEGER NOT NULL);
CREATE TABLE keyframes (
    id INTEGER PRIMARY KEY, t_ns INTEGER NOT NULL,
    T_map_body BLOB NOT NULL, T_odom_body BLOB NOT NULL,
    keypoints_px BLOB NOT NULL, descriptors BLOB NOT NULL, points_body_m BLOB,
    crc INTEGER NOT NULL, crc_pose INTEGER NOT NULL
);
CREATE TABLE packets (
    id INTEGER PRIMARY KEY,
    vo_t_ns INTEGER NOT NULL, vo_keyframe_id INTEGER NOT NULL, vo_T BLOB, vo_covariance BLOB NOT NULL,
    vo_has_scale INTEGER NOT NULL, vo_tracking TEXT NOT NULL, vo_inliers INTEGER NOT NULL,
    track_ids BLOB NOT NULL, pixels_px BLOB NOT NULL, right_px BLOB, depth_m BLOB, track_noise REAL NOT NULL,
    imu_t_ns BLOB, imu_gyro BLOB, imu_accel BLOB, mag_t_ns INTEGER, mag_field BLOB,
    at_rest INTEGER NOT NULL, time_offset_s REAL NOT NULL, begins_submap INTEGER NOT NULL, state BLOB, imu_noise BLOB,
    crc INTEGER NOT NULL
);
CREATE TABLE windows (
    id INTEGER PRIMARY KEY, edges BLOB NOT NULL, tilts BLOB NOT NULL, note TEXT NOT NULL, rest_from INTEGER,
    crc INTEGER NOT NULL
);
CREATE TABLE states (id INTEGER NOT NULL, whose TEXT NOT NULL, t_ns INTEGER NOT NULL, state BLOB NOT NULL,
    crc INTEGER NOT NULL, PRIMARY KEY (id, whose)
);
CREATE TABLE edges (
    id INTEGER PRIMARY KEY, from_id INTEGER NOT NULL, to_id INTEGER NOT NULL,
    T_from_to BLOB NOT NULL, covariance BLOB NOT NULL, has_scale INTEGER NOT NULL, inliers INTEGER NOT NULL,
    score REAL NOT NULL, offered_with INTEGER NOT NULL, number INTEGER NOT NULL,
    decision TEXT NOT NULL, reason TEXT NOT NULL, chi2 REAL, place TEXT NOT NULL,
    tie_id INTEGER, tie_T BLOB, tie_covariance BLOB, moved_rms_m REAL, moved_max_m REAL,
    crc INTEGER NOT NULL, crc_decided INTEGER NOT NULL, crc_moved INTEGER NOT NULL
);
CREATE TABLE ties (
    id INTEGER PRIMARY KEY, anchor_id INTEGER NOT NULL, covariance BLOB NOT NULL, crc INTEGER NOT NULL
);
CREATE TABLE candidates (
    number INTEGER PRIMARY KEY, from_id INTEGER NOT NULL, to_id INTEGER NOT NULL, source TEXT NOT NULL,
    score REAL, inliers INTEGER NOT NULL, decision TEXT NOT NULL, reason TEXT NOT NULL, sigma_m REAL,
    consistency INTEGER NOT NULL, supporters INTEGER NOT NULL, T_from_to BLOB, crc INTEGER NOT NULL
);
CREATE TABLE retrieved (
    number INTEGER PRIMARY KEY, from_id INTEGER NOT NULL, to_id INTEGER NOT NULL, score REAL, island_score REAL,
    consistency INTEGER NOT NULL, crc INTEGER NOT NULL
);
CREATE TABLE frames (
    t_ns INTEGER PRIMARY KEY, keyframe_id INTEGER NOT NULL, T_keyframe_body BLOB, T_odom_body BLOB, T_map_body BLOB,
    tracking TEXT NOT NULL, inliers INTEGER NOT NULL, vo_keyframe_id INTEGER NOT NULL, reason TEXT NOT NULL,
    localisation TEXT NOT NULL, submap INTEGER NOT NULL, crc INTEGER NOT NULL
);
CREATE TABLE scans (
    id INTEGER PRIMARY KEY, t_ns INTEGER NOT NULL, depth_png BLOB NOT NULL, points BLOB NOT NULL, colors BLOB NOT NULL,
    crc INTEGER NOT NULL
);
CREATE TABLE tags (
    id INTEGER NOT NULL, tag_id INTEGER NOT NULL, side_px REAL NOT NULL, T_cam_tag BLOB, covariance BLOB,
    crc INTEGER NOT NULL, PRIMARY KEY (id, tag_id)
);
CREATE TABLE vocabulary (
    one INTEGER PRIMARY KEY CHECK (one = 1), data BLOB NOT NULL, trained_at INTEGER NOT NULL,
    trainings INTEGER NOT NULL, crc INTEGER NOT NULL
);
CREATE TABLE newest (one INTEGER PRIMARY KEY CHECK (one = 1), value TEXT NOT NULL, crc INTEGER NOT NULL);
"""
_READINGS = """
CREATE TABLE readings (
    id INTEGER NOT NULL, number INTEGER NOT NULL, sensor TEXT NOT NULL, t_ns INTEGER NOT NULL,
    numbers BLOB NOT NULL, covariance BLOB, station BLOB NOT NULL, crc INTEGER NOT NULL, PRIMARY KEY (id, number)
);
CREATE TABLE own_starts (
    id INTEGER NOT NULL, number INTEGER NOT NULL, sensor TEXT NOT NULL, numbers BLOB NOT NULL, sigmas BLOB NOT NULL,
    crc INTEGER NOT NULL, PRIMARY KEY (id, number)
);
"""
_LABELS = """
CREATE TABLE labels (id INTEGER PRIMARY KEY, png BLOB NOT NULL, crc INTEGER NOT NULL);
"""
_MOTIONS = """
CREATE TABLE motions (t_ns INTEGER PRIMARY KEY, numbers BLOB NOT NULL, crc INTEGER NOT NULL);
"""
_FURTHER = """
CREATE TABLE further (
    id INTEGER NOT NULL, camera INTEGER NOT NULL, track_ids BLOB NOT NULL, pixels_px BLOB NOT NULL,
    crc INTEGER NOT NULL, PRIMARY KEY (id, camera)
);
"""
_LATER = (
    (FIRST_WITH_READINGS, _READINGS), (FIRST_WITH_LABELS, _LABELS), (FIRST_WITH_MOTIONS, _MOTIONS),
    (FIRST_WITH_FURTHER, _FURTHER),
)  # fmt: skip


def schema(version: int) -> str:
    """Return the tables of a session of a format that is read here."""
    return SCHEMA + "".join(tables for first, tables in _LATER if version >= first)


def to_bytes(values: NDArray[Any], dtype: str) -> bytes:
    """Return an array as little-endian bytes of a type."""
    return np.ascontiguousarray(values, dtype=dtype).tobytes()


def maybe_bytes(values: NDArray[Any] | None, dtype: str) -> bytes | None:
    """Return an array as bytes, None as None."""
    return None if values is None else to_bytes(values, dtype)


def from_bytes(blob: bytes, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an array of bytes; ValueError or TypeError when they are damaged."""
    if len(blob) > _MAX_BLOB_BYTES:
        raise ValueError(f"a field of {len(blob)} bytes")
    return np.frombuffer(blob, dtype=dtype).reshape(shape)


def numbers(blob: bytes, dtype: str, shape: tuple[int, ...]) -> Array:
    """Return numbers as float64; errors as in `from_bytes`."""
    return from_bytes(blob, dtype, shape).astype(np.float64)


def maybe_numbers(blob: bytes | None, dtype: str, shape: tuple[int, ...]) -> Array | None:
    """Return numbers as float64, NULL as None; errors as in `from_bytes`."""
    return None if blob is None else numbers(blob, dtype, shape)


def integers(blob: bytes) -> NDArray[np.int64]:
    """Return integers; errors as in `from_bytes`."""
    return from_bytes(blob, "<i8", (-1,)).astype(np.int64)


def state_bytes(state: NavState) -> bytes:
    """Return a state, but for its time, as bytes."""
    parts = (
        state.T_world_body, state.velocity_world_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2, state.covariance,
    )  # fmt: skip
    return to_bytes(np.concatenate([np.ravel(part) for part in parts]), "<f8")


def state_of(t_ns: int, blob: bytes) -> NavState:
    """Return the state that `state_bytes` stored; errors as in `from_bytes`."""
    n = numbers(blob, "<f8", (_STATE_NUMBERS,))
    return NavState(t_ns, n[:16].reshape(4, 4), n[16:19], n[19:22], n[22:25], n[25:].reshape(15, 15))


def window_bytes(said: WindowRecord) -> tuple[bytes, bytes]:
    """Return the edges and tilts of a window's record as bytes."""
    edges = [
        np.r_[e.to_id, float(e.settled), float(e.begins_submap), e.T_previous_body.ravel(), e.covariance.ravel()]
        for e in said.edges
    ]
    tilts = [np.r_[t.id, t.sigma_rad, t.up_body] for t in said.tilts]
    return to_bytes(np.array(edges), "<f8"), to_bytes(np.array(tilts), "<f8")


def window_of(
    keyframe_id: int, t_ns: int, edges: bytes, tilts: bytes, note: str, rest_from: int | None
) -> WindowRecord:
    """Return the record that `window_bytes` stored; errors as in `from_bytes`."""
    return WindowRecord(
        keyframe_id,
        t_ns,
        tuple(
            EdgeRecord(int(n[0]), n[3:19].reshape(4, 4), n[19:].reshape(6, 6), bool(n[1]), bool(n[2]))
            for n in numbers(edges, "<f8", (-1, _EDGE_NUMBERS))
        ),
        tuple(GravityRecord(int(n[0]), n[2:], float(n[1])) for n in numbers(tilts, "<f8", (-1, _TILT_NUMBERS))),
        note,
        rest_from,
    )


def noise_of(stored: dict[str, Any]) -> ImuNoise:
    """Return a stored noise model, also under the names that sessions had before those of Kalibr."""
    return ImuNoise(**{_OLD_NOISE_NAMES.get(name, name): value for name, value in stored.items()})


@contextmanager
def storage(path: Path) -> Iterator[None]:
    """Turn failures to write a session into StorageError with the next step."""
    try:
        yield
    except (sqlite3.Error, OSError) as error:
        raise StorageError(
            f"session {path} cannot be written: {error}; free disk space or choose another --out"
        ) from error


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn failures to read a session, and contents that make no sense, into DataError with the next step."""
    try:
        yield
    except sqlite3.Error as error:
        raise DataError(f"session {path} cannot be read: {error}; run the recording again") from error
    except OSError as error:
        raise DataError(f"session {path} cannot be read: {error.strerror or error}") from error
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise DataError(f"{path} is damaged ({reason}); run the recording again") from error
