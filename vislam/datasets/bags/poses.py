"""Topics of a bag as trajectories, to be evaluated: poses and positions one by one, or paths of many."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vislam.core.errors import DataError
from vislam.core.recording import Problems
from vislam.core.trajectory import Trajectory
from vislam.datasets.bags.bag import Bag
from vislam.datasets.bags.choice import topics_there, wanted_topic
from vislam.datasets.bags.decoding import (
    OLD_TRANSFORMS,
    PATH,
    POINT,
    POSES,
    TRANSFORMS,
    decoded,
    header_ns,
    need_rosbags,
    pose_numbers,
)
from vislam.datasets.bags.listing import Entry, Listing
from vislam.datasets.bags.stored import DamagedError, Found
from vislam.datasets.bags.streams import topic_rows
from vislam.datasets.formats.truth import trajectory_of
from vislam.datasets.tables import Row

_TREES, _MOST_EDGES = (TRANSFORMS, OLD_TRANSFORMS), 100
_ALWAYS = 2**62  # before every stamp: since when static transforms hold
_LEAST_NORM = 0.5  # of a quaternion
_NO_ROTATION = [0.0, 0.0, 0.0, 0.0]


def trajectory_of_topic(path: Path, name: str) -> tuple[Trajectory, str]:
    """Return the poses on a topic of a bag and in words what was read; without a name, of its only topic of poses.

    Of paths it is the longest message, the last of several; of transforms `TOPIC:PARENT:CHILD` those between two
    frames, of which one lies above the other.

    Raises:
        DataError: there is no such topic, several and no name, or none of its messages can be used.
    """
    need_rosbags()
    problems = Problems()
    with closing(Bag(path)) as bag:
        topic, *edge = name.split(":")
        entry = _wanted(Listing(bag, False, problems), topic, bool(edge))
        rows: Iterable[Row[list[float]]]
        if edge:
            rows = _of_tree(bag, entry, edge)
        elif entry.topic.type == PATH:
            rows = _of_path(bag, entry)
        else:
            values = _place if entry.topic.type == POINT else pose_numbers
            rows = topic_rows(bag, entry.topic, values, False, problems)
        found = trajectory_of(rows, problems, np.eye(4))
    if found is None:
        raise DataError(f"{path}: no message on {entry.topic.name} ({entry.topic.type}) holds a pose that can be used")
    skipped = "".join(f"; {kind}: {count}" for kind, count in problems.items())
    positions = "" if found.has_rotation else ", positions only"
    kind = entry.topic.type.rsplit("/", 1)[-1]
    of = ":".join([entry.topic.name, *edge])
    return found, f"{of}, {kind}{positions}; {len(found)} poses over {found.duration_s:.1f} s{skipped}"


def _wanted(listing: Listing, name: str, is_tree: bool) -> Entry:
    if is_tree:
        return wanted_topic(listing, "topic", name, _TREES)
    types = (*POSES, POINT, PATH)
    if not name:
        fitting = [entry for entry in listing.entries.values() if entry.topic.type in types]
        if len(fitting) != 1:
            kinds = ", ".join(type_.rsplit("/", 1)[-1] for type_ in types)
            raise DataError(f"which topic holds the poses? Give it; of {kinds} {topics_there(listing, types)}")
        name = fitting[0].topic.name
    entry = listing.entries.get(name) or listing.entries.get(f"/{name}")
    if entry is not None and entry.topic.type in _TREES:
        raise DataError(f"topic={name}: it holds transforms between many frames; name two: {name}:odom:base_link")
    return wanted_topic(listing, "topic", name, types)


def _of_path(bag: Bag, entry: Entry) -> list[Row[list[float]]]:
    """Return the poses of the longest path; a topic of them holds every beginning of it."""
    longest: Found | None = None
    for found in bag.scan(Problems()):  # damage was counted when it was listed
        if found.topic.name == entry.topic.name and (longest is None or found.place.length >= longest.place.length):
            longest = found
    if longest is None:
        raise DataError(f"{bag.path}: no message on {entry.topic.name}")
    try:
        poses = decoded(entry.topic, bag.read(longest.place)).poses
    except (DamagedError, OSError) as error:
        raise DataError(f"{bag.path}: the longest path on {entry.topic.name} cannot be read: {error}") from error
    stamps = [header_ns(pose.header) for pose in poses]
    if len({*stamps}) < len(poses) / 2 or None in stamps:
        raise DataError(f"{bag.path}: the poses of {entry.topic.name} have no times of their own; give another topic")
    rows = [(t_ns, pose_numbers(pose)) for t_ns, pose in zip(stamps, poses, strict=True) if t_ns is not None]
    return [row for row in rows if np.isfinite(row[1]).all()]


def _of_tree(bag: Bag, entry: Entry, edge: list[str]) -> list[Row[list[float]]]:
    """Return the transforms from a frame to one below it, in all messages of a topic and of static ones.

    Of a chain they come at the stamps of the transform with most of them; of the others the latest holds.
    """
    wanted, edges = tuple(name.strip("/") for name in edge), dict[tuple[str, str], list[Row[list[float]]]]()
    for found in bag.scan(Problems()):  # damage was counted when it was listed
        is_static = found.topic.type == entry.topic.type and "static" in found.topic.name
        if found.topic.name != entry.topic.name and not is_static:
            continue
        with suppress(DamagedError, OSError):
            for one in decoded(found.topic, bag.read(found.place)).transforms:
                frames = (one.header.frame_id.strip("/"), one.child_frame_id.strip("/"))
                t_ns = header_ns(one.header) or found.log_ns
                if (frames in edges or len(edges) < _MOST_EDGES) and np.isfinite(row := pose_numbers(one)).all():
                    edges.setdefault(frames, []).append((-_ALWAYS if is_static else t_ns, row))
    chain: list[list[Row[list[float]]]] = []
    above = {child: parent for parent, child in edges}
    at = wanted[-1]
    while at in above and at != wanted[0] and len(chain) < _MOST_EDGES:
        chain.insert(0, edges[above[at], at])
        at = above[at]
    if (at, len(wanted)) != (wanted[0], 2) or all(t_ns == -_ALWAYS for rows in chain for t_ns, _ in rows):
        named = ", ".join(":".join(frames) for frames in sorted(edges))
        raise DataError(f"{bag.path}: no transform {':'.join(edge)} on {entry.topic.name}; there are {named[:300]}")
    return chain[0] if len(chain) == 1 else _joined(chain)


def _joined(chain: list[list[Row[list[float]]]]) -> list[Row[list[float]]]:
    """Return the product of transforms, each at the last of its stamps, from where all of them have begun."""
    tables = [sorted(row for row in rows if np.linalg.norm(row[1][3:]) > _LEAST_NORM) for rows in chain]
    if not all(tables):
        return []
    t_ns = np.array([row[0] for row in max(tables, key=len)], dtype=np.int64)
    t_ns = t_ns[t_ns >= max(rows[0][0] for rows in tables)]
    T = np.tile(np.eye(4), (len(t_ns), 1, 1))
    for rows in tables:
        numbers = np.array([row[1] for row in rows])
        held = numbers[np.searchsorted([row[0] for row in rows], t_ns, side="right") - 1]
        step = np.tile(np.eye(4), (len(t_ns), 1, 1))
        step[:, :3, :3], step[:, :3, 3] = Rotation.from_quat(held[:, 3:]).as_matrix(), held[:, :3]
        T = T @ step
    poses = np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()])
    return list(zip(t_ns.tolist(), poses.tolist(), strict=True))


def _place(message: Any) -> list[float]:
    return [message.point.x, message.point.y, message.point.z, *_NO_ROTATION]
