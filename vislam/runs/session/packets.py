"""Keyframe packets as rows of a session: all but images and features."""

import math
import sqlite3
from typing import Any

import numpy as np

from vislam.core.messages import (
    Frame,
    FurtherTracks,
    ImuSpan,
    Keyframe,
    KeyframePacket,
    MagSample,
    NavState,
    NoiseScale,
    Observations,
    Tracking,
    VoMeasurement,
)
from vislam.runs.session.schema import DESCRIPTOR_BYTES, integers, maybe_bytes, maybe_numbers, numbers, to_bytes

# without observations, where only the graph is to be built again
LIGHT_COLUMNS = (
    "id, vo_t_ns, vo_keyframe_id, vo_T, vo_covariance, vo_has_scale, vo_tracking, vo_inliers, x'', x'', NULL, NULL, "
    "1.0, imu_t_ns, imu_gyro, imu_accel, mag_t_ns, mag_field, at_rest, time_offset_s, begins_submap, NULL, imu_noise"
)


def packet_row(packet: KeyframePacket, newest: NavState | None) -> tuple[Any, ...]:
    """Return the row of a packet, with velocity and biases of `newest` if that is the keyframe's."""
    vo, seen, imu, mag = packet.vo, packet.observations, packet.imu, packet.mag
    state = None
    if newest is not None and newest.t_ns == packet.keyframe.t_ns:
        state = np.stack([newest.velocity_world_m_s, newest.gyro_bias_rad_s, newest.accel_bias_m_s2])
    return (
        packet.keyframe.id, vo.t_ns, vo.keyframe_id, maybe_bytes(vo.T_keyframe_body, "<f8"),
        to_bytes(vo.covariance, "<f8"), int(vo.has_scale), str(vo.tracking), int(vo.inliers),
        to_bytes(seen.track_ids, "<i8"), to_bytes(seen.pixels_px, "<f4"), maybe_bytes(seen.right_px, "<f4"),
        maybe_bytes(seen.depth_m, "<f4"), float(seen.noise), None if imu is None else to_bytes(imu.t_ns, "<i8"),
        None if imu is None else to_bytes(imu.gyro_rad_s, "<f8"),
        None if imu is None else to_bytes(imu.accel_m_s2, "<f8"), None if mag is None else mag.t_ns,
        None if mag is None else to_bytes(mag.field_ut, "<f8"), int(packet.at_rest), packet.time_offset_s,
        int(packet.begins_submap), maybe_bytes(state, "<f8"),
        None if imu is None else to_bytes(np.array(imu.noise), "<f8"),
    )  # fmt: skip


def packet_of(t_ns: int, row: tuple[Any, ...]) -> KeyframePacket:
    """Return the packet of a row; ValueError or TypeError when it is damaged."""
    T = maybe_numbers(row[3], "<f8", (4, 4))
    vo = VoMeasurement(row[1], row[2], T, numbers(row[4], "<f8", (6, 6)), bool(row[5]), Tracking(row[6]), row[7])
    ids, noise = integers(row[8]), float(row[12])
    n = len(ids)
    if not 1.0 <= noise < math.inf:
        raise ValueError(f"tracks cannot have {noise:g} times the noise that is given")
    observations = Observations(
        ids, numbers(row[9], "<f4", (n, 2)), maybe_numbers(row[10], "<f4", (n, 2)), maybe_numbers(row[11], "<f4", (n,)),
        noise=noise,
    )  # fmt: skip
    imu = None
    if row[13] is not None:
        stamps = integers(row[13])
        shape = (len(stamps), 3)
        scale = NoiseScale(*numbers(row[22], "<f8", (2,)).tolist())
        imu = ImuSpan(stamps, numbers(row[14], "<f8", shape), numbers(row[15], "<f8", shape), scale)
    mag = None if row[16] is None else MagSample(row[16], numbers(row[17], "<f8", (3,)))
    features = np.zeros((0, 2)), np.zeros((0, DESCRIPTOR_BYTES), np.uint8)
    keyframe = Keyframe(row[0], t_ns, Frame(t_ns, row[0], ()), *features, None)
    return KeyframePacket(keyframe, vo, observations, imu, mag, bool(row[18]), float(row[19]), bool(row[20]))


def further_rows(packet: KeyframePacket) -> list[tuple[Any, ...]]:
    """Return the rows of what cameras beyond the first pair saw."""
    return [
        (packet.keyframe.id, seen.camera, to_bytes(seen.track_ids, "<i8"), to_bytes(seen.pixels_px, "<f4"))
        for seen in packet.observations.further
    ]


def further_of(db: sqlite3.Connection) -> dict[int, tuple[FurtherTracks, ...]]:
    """Return all of it by keyframe; ValueError or TypeError on damage."""
    out: dict[int, tuple[FurtherTracks, ...]] = {}
    query = "SELECT id, camera, track_ids, pixels_px FROM further ORDER BY id, camera"
    for k, camera, ids, pixels in db.execute(query):
        found = integers(ids)
        seen = FurtherTracks(int(camera), found, numbers(pixels, "<f4", (len(found), 2)))
        out[k] = (*out.get(k, ()), seen)
    return out
