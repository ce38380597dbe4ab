"""Topics of a bag as trajectories, to be evaluated: poses and positions one by one, or paths of many."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np

from vislam.core.errors import DataError
from vislam.core.recording import Problems
from vislam.core.trajectory import Trajectory
from vislam.datasets.bags.bag import Bag
from vislam.datasets.bags.choice import topics_there, wanted_topic
from vislam.datasets.bags.decoding import (
    ODOMETRY,
    OLD_TRANSFORMS,
    POSE,
    POSE_COVARIANCE,
    TRANSFORM,
    TRANSFORMS,
    decoded,
    header_ns,
    need_rosbags,
)
from vislam.datasets.bags.listing import Entry, Listing
from vislam.datasets.bags.stored import DamagedError, Found, Topic
from vislam.datasets.bags.streams import topic_rows
from vislam.datasets.formats.truth import trajectory_of
from vislam.datasets.tables import Row

_PATH, _POINT = "nav_msgs/msg/Path", "geometry_msgs/msg/PointStamped"
_SUMS = {_PATH: "6227e2b7e9cce15051f669a5e197bbf7", _POINT: "c63aecb41bfdfd6b7e1fac37c7cbe7bf"}  # of ROS 1
_TREES, _MOST_EDGES = (TRANSFORMS, OLD_TRANSFORMS), 100
_NO_ROTATION = [0.0, 0.0, 0.0, 0.0]


def trajectory_of_topic(path: Path, name: str) -> tuple[Trajectory, str]:
    """Return the poses on a topic of a bag and in words what was read; without a name, of its only topic of poses.

    Of paths it is the longest message, the last of several; of transforms `TOPIC:PARENT:CHILD` the one between two
    frames, which must stand in the messages as such.

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
        else:
            rows = _of_path(bag, entry) if entry.topic.type == _PATH else _one_by_one(bag, entry, problems)
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
    types = (*_VALUES, _PATH)
    if not name:
        fitting = [entry for entry in listing.entries.values() if entry.topic.type in types]
        if len(fitting) != 1:
            kinds = ", ".join(type_.rsplit("/", 1)[-1] for type_ in types)
            raise DataError(f"which topic holds the poses? Give it; of {kinds} {topics_there(listing, types)}")
        name = fitting[0].topic.name
    entry = listing.entries.get(name) or listing.entries.get(f"/{name}")
    if entry is not None and entry.topic.type in _TREES:
        raise DataError(f"topic={name}: it holds transforms between many frames; name two: {name}:odom:base_link")
    if entry is None or entry.topic.type not in _SUMS:
        return wanted_topic(listing, "topic", name, types)
    if why := _why_unreadable(entry.topic):
        raise DataError(f"topic={name}: {why}")
    return entry


def _why_unreadable(topic: Topic) -> str:
    """Return what `decoding.why_unreadable` would of the types that are read for evaluation alone."""
    if topic.encoding not in ("ros1", "cdr"):
        return f"encoded as '{topic.encoding}'; ros1 and cdr are read"
    if topic.encoding == "ros1" and topic.digest not in ("", "*", _SUMS[topic.type]):
        return f"its definition of {topic.type} is not the standard one"
    return ""


def _one_by_one(bag: Bag, entry: Entry, problems: Problems) -> Iterator[Row[list[float]]]:
    return topic_rows(bag, entry.topic, _VALUES[entry.topic.type], False, problems)


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
    rows = [(t_ns, _pose(pose.pose)) for t_ns, pose in zip(stamps, poses, strict=True) if t_ns is not None]
    return [row for row in rows if np.isfinite(row[1]).all()]


def _of_tree(bag: Bag, entry: Entry, edge: list[str]) -> list[Row[list[float]]]:
    """Return the transforms from a parent to its child, in all messages of a topic."""
    wanted, there = tuple(name.strip("/") for name in edge), dict[tuple[str, ...], int]()
    rows: list[Row[list[float]]] = []
    for found in bag.scan(Problems()):  # damage was counted when it was listed
        if found.topic.name != entry.topic.name:
            continue
        with suppress(DamagedError, OSError):
            for one in decoded(entry.topic, bag.read(found.place)).transforms:
                frames = (one.header.frame_id.strip("/"), one.child_frame_id.strip("/"))
                t_ns = header_ns(one.header)
                if frames == wanted and t_ns is not None and np.isfinite(row := _transform(one)).all():
                    rows.append((t_ns, row))
                elif len(there) < _MOST_EDGES:
                    there[frames] = there.get(frames, 0) + 1
    if not rows:
        named = ", ".join(":".join(frames) for frames in sorted(there))
        raise DataError(f"{bag.path}: no transform {':'.join(edge)} on {entry.topic.name}; there are {named[:300]}")
    return rows


def _pose(pose: Any) -> list[float]:
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def _transform(message: Any) -> list[float]:
    p, q = message.transform.translation, message.transform.rotation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


_VALUES = {
    ODOMETRY: lambda message: _pose(message.pose.pose),
    POSE: lambda message: _pose(message.pose),
    POSE_COVARIANCE: lambda message: _pose(message.pose.pose),
    TRANSFORM: _transform,
    _POINT: lambda message: [message.point.x, message.point.y, message.point.z, *_NO_ROTATION],
}
