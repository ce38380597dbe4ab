"""What a bag holds, from one pass over it: its topics, and stamps and places of its images."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.recording import Problems
from vislam.datasets.bags.bag import Bag
from vislam.datasets.bags.decoding import (
    COMPRESSED,
    IMAGES,
    OLD_TRANSFORMS,
    TRANSFORMS,
    VIDEOS,
    decoded,
    stamp_ns,
    why_unreadable,
)
from vislam.datasets.bags.stored import DamagedError, Found, Place, Topic

_PLACES_KEPT = 1000  # of transforms, and of video until a frame that needs no other
_FIRST_KEPT = 5  # of all else, as the very first may be damaged
_COLUMNS = 5  # stamp, and the four numbers of a place


@dataclass(slots=True)
class Entry:
    """One topic of a bag."""

    topic: Topic
    count: int = 0
    first_log_ns: int = 0
    last_log_ns: int = 0
    unstamped: int = 0
    places: list[Place] = field(default_factory=list)  # of its first messages
    images: array[int] = field(default_factory=lambda: array("q"))  # five numbers each

    @property
    def rate_hz(self) -> float:
        """Messages in a second by the recorder's clock; NaN when there are fewer than two."""
        span_s = (self.last_log_ns - self.first_log_ns) * 1e-9
        return (self.count - 1) / span_s if self.count > 1 and span_s > 0.0 else float("nan")

    def stamps_and_places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return stamps [N] and places [N, 4] of images, in the order in which they were stored."""
        table = np.frombuffer(self.images, dtype=np.int64).reshape(-1, _COLUMNS)
        return table[:, 0], table[:, 1:]


class Listing:
    """The topics of a bag."""

    def __init__(self, bag: Bag, by_log_time: bool, problems: Problems) -> None:
        """Go through a bag once; what is damaged is counted. Raises DataError when nothing of it can be read."""
        self.entries: dict[str, Entry] = {}
        self._bag = bag
        self._by_log_time = by_log_time
        for found in bag.scan(problems):
            entry = self.entries.get(found.topic.name)
            if entry is None:
                entry = self.entries[found.topic.name] = Entry(found.topic, first_log_ns=found.log_ns)
            if found.topic.type != entry.topic.type:
                problems.count(f"{found.topic.name}: messages of another type than its first")
                continue
            self._take(entry, found)
        for entry in self.entries.values():
            problems.count(f"{entry.topic.name}: without a stamp, the recorder's time is taken", times=entry.unstamped)

    def _take(self, entry: Entry, found: Found) -> None:
        entry.count += 1
        entry.first_log_ns = min(entry.first_log_ns, found.log_ns)
        entry.last_log_ns = max(entry.last_log_ns, found.log_ns)
        most = _PLACES_KEPT if entry.topic.type in (TRANSFORMS, OLD_TRANSFORMS, COMPRESSED, *VIDEOS) else _FIRST_KEPT
        if len(entry.places) < most:
            entry.places.append(found.place)
        if entry.topic.type in IMAGES:
            t_ns = stamp(found, self._by_log_time)
            if t_ns is None and found.topic.schema:
                t_ns = self._stamp_behind(found)
            entry.unstamped += t_ns is None
            entry.images.extend((fitting(found.log_ns if t_ns is None else t_ns), *found.place))

    def _stamp_behind(self, found: Found) -> int | None:
        """Return the stamp of a message of Foxglove's, whose fields may come in any order, from all of its bytes."""
        try:
            t_ns = stamp_ns(found.topic, self._bag.read(found.place))
        except (DamagedError, OSError):
            return None
        return None if t_ns is None else fitting(t_ns)

    def of_type(self, *types: str) -> list[Entry]:
        """Return the topics of certain types that can be read, with messages, by their names."""
        fitting_ = [entry for entry in self.entries.values() if entry.topic.type in types]
        return sorted((e for e in fitting_ if not why_unreadable(e.topic)), key=lambda entry: entry.topic.name)

    def first_messages(self, entry: Entry) -> Iterator[Any]:
        """Yield the first messages of a topic, decoded; those that cannot be are left out."""
        for place in entry.places:
            try:
                yield decoded(entry.topic, self._bag.read(place))
            except (DamagedError, OSError):
                continue


def stamp(found: Found, by_log_time: bool) -> int | None:
    """Return the time of a message: its header's, or the recorder's where asked; None when its header has none."""
    if by_log_time:
        return fitting(found.log_ns)
    t_ns = stamp_ns(found.topic, found.head)
    return None if t_ns is None else fitting(t_ns)


def fitting(t_ns: int) -> int:
    """Return a time that 64 bits hold, as every clock's does."""
    return min(max(t_ns, -(2**62)), 2**62)
