"""A session as the memory that a pipeline goes on from."""

from pathlib import Path
from typing import Any

import numpy as np

from vislam.core import collector
from vislam.core.errors import DataError
from vislam.core.geometry import are_rigid
from vislam.core.memory import (
    FrontMemory,
    GraphMemory,
    Learned,
    PlacesMemory,
    SlamMemory,
    StartFacts,
    TagSighting,
    Tied,
    WindowRecord,
    at_pose,
)
from vislam.core.messages import Array, Frame, Keyframe, NavState
from vislam.factors import state_from
from vislam.runs.session.reader import Session
from vislam.runs.session.reading_rows import own_of
from vislam.runs.session.schema import maybe_numbers, noise_of, numbers, readable, window_of

_RIGID = 1e-4  # how far R R^T may be from identity


def can_go_on(path: Path) -> bool:
    """Return whether a session file holds something to go on from, as `recall` has it; False for a damaged one."""
    try:
        with Session(path) as session:
            return _has_keyframe(session)
    except DataError:
        return False


def _has_keyframe(session: Session) -> bool:
    info, newest = session.info(), session.newest()
    with readable(session.path):
        if not newest or (_start(info) is None and info["imu_noise"] is not None):
            return False
        count = next(session.rows("SELECT COUNT(*) FROM keyframes"))[0]
        return bool(count > (info.get("map") or {}).get("keyframes", 0))


@collector.paused()
def recall(session: Session) -> SlamMemory | None:
    """Return what a pipeline goes on from; None when the session has nothing worth going on from.

    That is one without a keyframe of its own, or one with an IMU whose gravity had not been found. Raises DataError
    when the session is damaged.
    """
    info, newest = session.info(), session.newest()
    with readable(session.path):
        if not _has_keyframe(session):
            return None
        start, base = _start(info), info.get("map") or {}
        stored = list(session.keyframes())
        packets = session.packets(light=True)
        states = session.states("graph")
        loops = session.loops()
        T_map_body = np.array([k.T_map_body for k in stored])
        _check_rigid(T_map_body)
        last = stored[-1]
        graph = GraphMemory(
            packets=packets,
            T_map_body=T_map_body,
            T_odom_body=last.T_odom_body,
            windows=_windows(session),
            states=states,
            loops=loops,
            ties=_ties(session),
            vo_scale=float(newest["vo_scale"]),
            revision=int(newest["revision"]),
            own=own_of(newest.get("own", [])),
        )
        places = PlacesMemory(
            keyframes=[
                Keyframe(k.id, k.t_ns, Frame(k.t_ns, k.id, ()), k.keypoints_px, k.descriptors, k.points_body_m)
                for k in stored
            ],
            T_map_body=T_map_body,
            words=session.words(),
            tags=_tags(session),
            next_edge_id=1 + max((loop.edge.id for loop in loops), default=-1),
        )
        front = FrontMemory(
            keyframe_id=last.id,
            t_ns=last.t_ns,
            time_offset_s=packets[-1].time_offset_s,
            T_odom_body=last.T_odom_body,
            start=start,
            state=None if start is None else _filter_state(session, states, last.id, last.T_odom_body),
            learned=_front(newest["front"]),
        )
        first = info.get("first_state")
        return SlamMemory(
            front=front,
            first_state=None if first is None else state_from(first),
            T_start=stored[0].T_odom_body,
            graph=graph,
            places=places,
            scans=session.scans(),
            held=int(base["keyframes"]) if base.get("localize_only") else 0,
            map_keyframes=int(base.get("keyframes", 0)),
        )


def _check_rigid(T: Array) -> None:
    """Raise ValueError where one of the poses [M, 4, 4] is no rigid motion."""
    sound = are_rigid(T, _RIGID)
    if not sound.all():
        raise ValueError(f"the pose of keyframe {int(np.flatnonzero(~sound)[0])} is no rigid motion")


def _start(info: dict[str, Any]) -> StartFacts | None:
    facts = info.get("start")
    if facts is None:
        return None
    return StartFacts(
        str(facts["status"]), str(facts["reason"]), state_from(facts["last"]), float(facts["scale_sigma"]),
        float(facts["excitation_m_s2"]), noise_of(facts["noise"]), state_from(facts["first_state"]),
        int(facts.get("begun_t_ns", 0)),
    )  # fmt: skip


def _front(data: dict[str, Any]) -> Learned:
    camera, tilt, habits = data["filter_camera"], data.get("tilt"), data.get("habits")
    delay, rows = data.get("depth_delay_s"), data.get("depth_rows_s")
    return Learned(
        int(data["next_track_id"]),
        float(data["time_offset_sigma_s"]),
        None if data["readout_s"] is None else float(data["readout_s"]),
        None if camera is None else np.array(camera, dtype=np.float64).reshape(8),
        None if tilt is None else np.array(tilt, dtype=np.float64).reshape(6),
        None if delay is None else float(delay),
        None if rows is None else float(rows),
        None if habits is None else np.array(habits, dtype=np.float64).reshape(11),
    )


def _filter_state(session: Session, states: dict[int, NavState], newest_id: int, T_odom_body: Array) -> NavState:
    """Return the filter's state at the newest keyframe; that of the graph where the filter came later."""
    state = session.states("filter").get(newest_id)
    return at_pose(states[newest_id], T_odom_body) if state is None else state


def _windows(session: Session) -> list[WindowRecord]:
    query = (
        "SELECT w.id, k.t_ns, w.edges, w.tilts, w.note, w.rest_from "
        "FROM windows w JOIN keyframes k USING (id) ORDER BY id"
    )
    return [window_of(*row) for row in session.rows(query)]


def _ties(session: Session) -> list[Tied]:
    rows = session.rows("SELECT id, anchor_id, covariance FROM ties ORDER BY rowid")
    return [Tied(i, anchor_id, numbers(blob, "<f8", (6, 6))) for i, anchor_id, blob in rows]


def _tags(session: Session) -> dict[int, tuple[TagSighting, ...]]:
    out: dict[int, tuple[TagSighting, ...]] = {}
    rows = session.rows("SELECT id, tag_id, side_px, T_cam_tag, covariance FROM tags ORDER BY id, rowid")
    for i, tag_id, side_px, T, covariance in rows:
        poses = maybe_numbers(T, "<f8", (4, 4)), maybe_numbers(covariance, "<f8", (6, 6))
        out[i] = (*out.get(i, ()), TagSighting(tag_id, side_px, *poses))
    return out
