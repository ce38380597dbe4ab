"""What was measured, as plain frozen records, from which the graph can be rebuilt and a batch can redo the run."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.geometry import are_rigid, are_rotations
from vislam.core.memory import WindowRecord
from vislam.core.messages import Array, ImuSpan, KeyframePacket, LoopEdge, NavState, Tracking
from vislam.core.readings import OwnStart, PlacedReading, Station
from vislam.factors.keys import nearest_rigid
from vislam.factors.noise_models import checked_covariance, checked_covariances

_RIGID = 1e-4  # how far R^T R may be from identity
_USELESS_RAD = 0.5  # odometry that knows rotation or translation no better than this is as good as lost
_USELESS_M = 10.0
SPEED_MAX_M_S = 300.0  # nothing that carries a camera here is faster: such odometry, or such an estimate, is broken
_TIME_SLACK_NS = 1_000_000  # an IMU span may overlap its keyframes by this much
_ROTATIONS = ("dR", "dR_all")
_VECTORS = ("dv_m_s", "dp_m", "dp_all_m", "rate_rad_s", "gyro_bias_rad_s", "accel_bias_m_s2")
_NUMBERS = ("since_s", "length_s", "gravity_m_s2", "accel_sigma_m_s2")


@dataclass(frozen=True, slots=True, eq=False)
class StartRecord:
    """The first state; without an IMU only the pose counts."""

    T_map_body: Array  # [4, 4]
    velocity_map_m_s: Array  # [3]
    gyro_bias_rad_s: Array  # [3]
    accel_bias_m_s2: Array  # [3]
    covariance: Array  # [15, 15] as in NavState
    has_imu: bool


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeRecord:
    """One keyframe: its motion since the previous one by vision (None: lost) and by IMU (None: missing)."""

    id: int
    t_ns: int
    T_previous_body: Array | None  # [4, 4]; unscaled: the translation is cam0's unit direction in body axes, or zero
    covariance: Array | None  # [6, 6] as the front end reported it
    has_scale: bool
    degraded: bool
    imu: ImuSpan | None
    rest_from: int | None  # the keyframe since which the body has not moved; None: it may have
    begins_submap: bool = False  # nothing was measured; then the motion above is a guess, with sigmas that say so
    is_tied: bool = False  # as in KeyframePacket; then the sigmas are known
    readings: tuple[PlacedReading, ...] = ()  # of other sensors; none where a submap begins
    own_starts: tuple[OwnStart, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class LoopRecord:
    """One loop edge as it was offered with keyframe `offered_with`; what became of it is in the edge report."""

    id: int
    from_id: int
    to_id: int
    T_from_to: Array  # [4, 4] body to body; unscaled: as in KeyframeRecord
    covariance: Array  # [6, 6]
    has_scale: bool
    offered_with: int


Record = StartRecord | KeyframeRecord | LoopRecord | WindowRecord


def start_record(state: NavState | None, T_map_body: Array | None = None) -> StartRecord:
    """Return the record of an initial state, or of a pose alone; raises DataError when it cannot be used."""
    if state is None:
        pose = np.eye(4) if T_map_body is None else checked_pose(T_map_body, "initial pose")
        return StartRecord(pose, np.zeros(3), np.zeros(3), np.zeros(3), np.eye(15), False)
    what = f"initial state at {state.t_ns} ns"
    vectors = (state.velocity_world_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2)
    if not all(np.shape(v) == (3,) and np.all(np.isfinite(v)) for v in vectors):
        raise DataError(f"{what}: velocity and biases must be three finite numbers each")
    return StartRecord(
        checked_pose(state.T_world_body, what),
        np.array(state.velocity_world_m_s, dtype=np.float64),
        np.array(state.gyro_bias_rad_s, dtype=np.float64),
        np.array(state.accel_bias_m_s2, dtype=np.float64),
        checked_covariance(state.covariance, 15, what),
        True,
    )


def keyframe_record(packet: KeyframePacket, previous: KeyframeRecord | None) -> KeyframeRecord:
    """Return the record of a packet that follows `previous`; raises DataError on anything the graph must not see."""
    return keyframe_records([packet], previous)[0]


def keyframe_records(packets: Sequence[KeyframePacket], previous: KeyframeRecord | None = None) -> list[KeyframeRecord]:
    """Return the records of packets that follow each other, as `keyframe_record` does, checking all at once."""
    out: list[KeyframeRecord] = []
    steps_s: list[float] = []
    for packet in packets:
        out.append(_as_said(packet, previous))
        steps_s.append(np.inf if previous is None else (out[-1].t_ns - previous.t_ns) * 1e-9)
        previous = out[-1]
    odd = [n for n, record in enumerate(out) if record.T_previous_body is not None]
    whats = [f"keyframe {out[n].id} at {out[n].t_ns} ns: odometry" for n in odd]
    T = checked_poses([record.T_previous_body for record in out if record.T_previous_body is not None], whats)
    covariances = checked_covariances([packets[n].vo.covariance for n in odd], 6, whats)
    has_scale = np.array([out[n].has_scale for n in odd], dtype=np.bool_)
    useful = _are_useful(T, covariances, has_scale, np.array(steps_s)[odd])
    for n, motion, covariance, is_useful in zip(odd, T, covariances, useful.tolist(), strict=True):
        is_kept = out[n].is_tied or is_useful
        measured = (motion, covariance) if is_kept else (None, None)
        out[n] = replace(out[n], T_previous_body=measured[0], covariance=measured[1])
    return out


def _as_said(packet: KeyframePacket, previous: KeyframeRecord | None) -> KeyframeRecord:
    """Return the record of a packet whose odometry is not checked yet."""
    keyframe, vo = packet.keyframe, packet.vo
    expected = 0 if previous is None else previous.id + 1
    what = f"keyframe {keyframe.id} at {keyframe.t_ns} ns"
    if keyframe.id != expected:
        raise DataError(f"{what}: ids must be dense, expected {expected}")
    starts = checked_starts(packet.own_starts, what)
    if previous is None:
        return KeyframeRecord(0, keyframe.t_ns, None, None, True, False, None, None, own_starts=starts)
    if packet.begins_submap:  # of another recording perhaps, with a clock of its own
        is_tied = packet.is_tied and vo.keyframe_id == previous.id
        return KeyframeRecord(
            keyframe.id, keyframe.t_ns, vo.T_keyframe_body if is_tied else None, vo.covariance if is_tied else None,
            True, False, None, None, True, is_tied, (), starts,
        )  # fmt: skip
    if keyframe.t_ns <= previous.t_ns:
        raise DataError(f"{what}: time must increase, the previous keyframe is at {previous.t_ns} ns")
    T: Array | None = None
    covariance: Array | None = None
    if vo.tracking is not Tracking.LOST and vo.T_keyframe_body is not None:
        if vo.keyframe_id != previous.id:
            raise DataError(f"{what}: its odometry is relative to keyframe {vo.keyframe_id}, expected {previous.id}")
        T, covariance = vo.T_keyframe_body, vo.covariance
    imu = None if packet.imu is None else checked_span(packet.imu, previous.t_ns, keyframe.t_ns, what)
    degraded = vo.tracking is Tracking.DEGRADED
    rest_from = None
    if packet.at_rest:
        rest_from = previous.id if previous.rest_from is None else previous.rest_from
    return KeyframeRecord(
        keyframe.id, keyframe.t_ns, T, covariance, vo.has_scale, degraded, imu, rest_from,
        readings=checked_readings(packet.readings, what), own_starts=starts,
    )  # fmt: skip


def loop_record(edge: LoopEdge, newest_id: int) -> LoopRecord:
    """Return the record of a loop edge; raises DataError when it cannot be used."""
    what = f"loop {edge.id} from {edge.from_id} to {edge.to_id}"
    if not 0 <= edge.from_id < edge.to_id <= newest_id:
        raise DataError(f"{what}: must go from an older to a newer keyframe of 0..{newest_id}")
    T = checked_pose(edge.T_from_to, what)
    covariance = checked_covariance(edge.covariance, 6, what)
    return LoopRecord(edge.id, edge.from_id, edge.to_id, T, covariance, edge.has_scale, newest_id)


def _are_useful(T: Array, covariances: Array, has_scale: NDArray[np.bool_], durations_s: Array) -> NDArray[np.bool_]:
    """Return whether motions of odometry [N] are certain enough to be used; on others Gauss-Newton diverges."""
    sigma_rad = np.sqrt(np.linalg.eigvalsh(covariances[:, :3, :3])[:, -1])
    sigma_m = np.sqrt(np.linalg.eigvalsh(covariances[:, 3:, 3:])[:, -1])
    speed = np.linalg.norm(T[:, :3, 3], axis=1) / durations_s
    metric = (sigma_m < _USELESS_M) & (speed < SPEED_MAX_M_S)
    return np.asarray((sigma_rad < _USELESS_RAD) & (metric | ~has_scale))


def checked_pose(T: Array, what: str) -> Array:
    """Return a rigid motion [4, 4] freed from rounding; DataError naming `what` when it is none."""
    return np.asarray(checked_poses([T], [what])[0])


def checked_poses(T: Sequence[Array], whats: Sequence[str]) -> Array:
    """Return rigid motions [N, 4, 4], each as `checked_pose` takes it; DataError names one that is none."""
    for matrix, what in zip(T, whats, strict=True):
        if np.shape(matrix) != (4, 4) or not np.isfinite(matrix).all():
            raise DataError(f"{what}: pose must be 4x4 and finite, got shape {np.shape(matrix)}")
    matrices = np.array(T, dtype=np.float64).reshape(-1, 4, 4)
    for n in np.flatnonzero(~are_rigid(matrices, _RIGID)).tolist():
        raise DataError(f"{whats[n]}: pose is not a rigid motion: {matrices[n].tolist()}")
    return nearest_rigid(matrices)


def checked_span(span: ImuSpan, t0_ns: int, t1_ns: int, what: str) -> ImuSpan:
    """Return inertial samples as arrays of float; DataError naming `what` when they cannot belong to [t0_ns, t1_ns]."""
    t: NDArray[np.int64] = np.array(span.t_ns, dtype=np.int64)
    gyro = np.array(span.gyro_rad_s, dtype=np.float64)
    accel = np.array(span.accel_m_s2, dtype=np.float64)
    if gyro.shape != (len(t), 3) or accel.shape != (len(t), 3):
        raise DataError(f"{what}: IMU span has {len(t)} stamps, gyro {gyro.shape} and accel {accel.shape}")
    if not (np.all(np.isfinite(gyro)) and np.all(np.isfinite(accel))):
        raise DataError(f"{what}: IMU span holds NaN or infinity; drop such samples before they get here")
    if np.any(np.diff(t) <= 0):
        raise DataError(f"{what}: IMU stamps must strictly increase")
    if not (np.isfinite(span.noise).all() and min(span.noise) > 0.0):
        raise DataError(f"{what}: the scale of the IMU's noise must be finite and positive, got {tuple(span.noise)}")
    if len(t) and (t[0] < t0_ns - _TIME_SLACK_NS or t[-1] > t1_ns + _TIME_SLACK_NS):
        raise DataError(f"{what}: IMU span [{t[0]}, {t[-1]}] ns is outside the keyframes' [{t0_ns}, {t1_ns}]")
    return replace(span, t_ns=t, gyro_rad_s=gyro, accel_m_s2=accel)


def checked_readings(placed: tuple[PlacedReading, ...], what: str) -> tuple[PlacedReading, ...]:
    """Return readings between two keyframes; DataError, with `what` they belong to, on any that cannot be used."""
    for one in placed:
        reading = one.reading
        name = f"{what}: reading of sensor {reading.sensor!r} at {reading.t_ns} ns"
        if np.ndim(reading.values) != 1 or not _are_finite(reading.values):
            raise DataError(f"{name}: its values must be a row of finite numbers")
        covariance = reading.covariance
        if covariance is not None and not (_is_square(covariance) and _are_finite(covariance)):
            raise DataError(f"{name}: its covariance must be square and finite")
        _check_station(one.station, name)
    return tuple(placed)


def checked_starts(starts: tuple[OwnStart, ...], what: str) -> tuple[OwnStart, ...]:
    """Return first values of sensors' own variables; DataError, with `what` they belong to, where they are none."""
    for start in starts:
        values, sigmas = np.asarray(start.values), np.asarray(start.sigmas)
        sound = values.ndim == 1 and values.shape == sigmas.shape and _are_finite(values) and _are_finite(sigmas)
        if not sound or np.any(sigmas < 0.0):
            raise DataError(
                f"{what}: the start of sensor {start.sensor!r} must be finite values with as many sigmas, "
                f"got shapes {values.shape} and {sigmas.shape}"
            )
    return tuple(starts)


def _check_station(station: Station, name: str) -> None:
    for key in _ROTATIONS:
        R = getattr(station, key)
        if np.shape(R) != (3, 3) or not are_rotations(R, _RIGID):
            raise DataError(f"{name}: its station's {key} is no rotation")
    for key in _VECTORS:
        if np.shape(getattr(station, key)) != (3,) or not _are_finite(getattr(station, key)):
            raise DataError(f"{name}: its station's {key} must be three finite numbers")
    for key in _NUMBERS:
        if not np.isfinite(getattr(station, key)):
            raise DataError(f"{name}: its station's {key} is not finite")
    if not (station.length_s > 0.0 and 0.0 <= station.since_s <= station.length_s):
        raise DataError(
            f"{name}: it must lie between its keyframes, {station.since_s:.6g} s of {station.length_s:.6g} s"
        )


def _are_finite(values: Array) -> bool:
    return bool(np.all(np.isfinite(values)))


def _is_square(matrix: Array) -> bool:
    return np.ndim(matrix) == 2 and np.shape(matrix)[0] == np.shape(matrix)[1]
