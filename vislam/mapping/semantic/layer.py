"""The labels of a map: the label of each occupied voxel, and the things that connected voxels of one label make up."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vislam.core.messages import Array
from vislam.mapping.semantic.classes import UNLABELLED, LabelClasses
from vislam.mapping.semantic.votes import voxel_centres, voxel_keys

_NO_THING = -1


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """Connected voxels of one label: a door, a table, the floor of a room."""

    id: int  # its number in the map, the largest of each class first
    label: int
    voxels: int
    from_m: Array  # [3] lowest corner of its box along the map's axes
    to_m: Array  # [3]
    centre_m: Array  # [3] mean of its voxels
    share: float  # of the votes at its voxels that are for its label


@dataclass(frozen=True, eq=False)
class LabelLayer:
    """Labelled voxels of a map, in the order of their keys."""

    resolution_m: float
    classes: LabelClasses
    keys: NDArray[np.int64]  # [N] packed, ascending
    labels: NDArray[np.uint16]  # [N]
    votes: NDArray[np.int32]  # [N] keyframes that are for the label
    total: NDArray[np.int32]  # [N] keyframes that said anything
    least_voxels: int = 1  # of a thing

    def __len__(self) -> int:
        return len(self.keys)

    @cached_property
    def points_m(self) -> NDArray[np.float32]:
        """Centres [N, 3] of the voxels in the map frame."""
        return voxel_centres(self.keys, self.resolution_m).astype(np.float32)

    @cached_property
    def colors(self) -> NDArray[np.uint8]:
        """Colours [N, 3] of the labels, RGB."""
        return self.colors_of(self.labels)

    @cached_property
    def thing_of(self) -> NDArray[np.int32]:
        """The thing [N] that each voxel belongs to; -1: a stray one."""
        return self._things[0]

    @property
    def things(self) -> list[Thing]:
        """All things, by class, in each the largest first."""
        return self._things[1]

    def colors_of(self, labels: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """Return the colours [N, 3] of labels [N]; grey where there is none."""
        ids, index = np.unique(labels, return_inverse=True)
        table = [(128, 128, 128) if i == UNLABELLED else self.classes[i].color for i in ids.tolist()]
        return np.array(table, np.uint8).reshape(-1, 3)[index]

    def label_at(self, points_m: NDArray[np.floating]) -> NDArray[np.uint16]:
        """Return the labels [N] of the voxels that points [N, 3] lie in; 0 where nothing is known."""
        rows = self.rows_of(voxel_keys(np.asarray(points_m).reshape(-1, 3), self.resolution_m))
        return np.where(rows >= 0, self.labels[rows], UNLABELLED) if len(self) else np.zeros(len(rows), np.uint16)

    def rows_of(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return which of the voxels each of some keys [M] is; -1: none."""
        if len(self) == 0:
            return np.full(len(keys), -1, np.int64)
        at = np.minimum(np.searchsorted(self.keys, keys), len(self) - 1)
        return np.where(self.keys[at] == keys, at, -1)

    def describe(self) -> dict[str, Any]:
        """Return classes, voxels, volumes and things as plain data."""
        cube_m3 = self.resolution_m**3
        classes = []
        for i in np.unique(self.labels).tolist():
            one, count = self.classes[i], int((self.labels == i).sum())
            things = [thing_data(thing) for thing in self.things if thing.label == i]
            classes.append(
                {"id": i, "name": one.name, "color": list(one.color), "voxels": count,
                 "volume_m3": round(count * cube_m3, 6), "things": things}
            )  # fmt: skip
        return {
            "resolution_m": self.resolution_m,
            "least_voxels": self.least_voxels,
            "classes": classes,
            "names": self.classes.data(),
        }

    @cached_property
    def _things(self) -> tuple[NDArray[np.int32], list[Thing]]:
        if len(self) == 0:
            return np.zeros(0, np.int32), []
        number = self._components()
        sizes = np.bincount(number)
        first = np.unique(number, return_index=True)[1]
        kept = np.flatnonzero(sizes >= self.least_voxels)
        kept = kept[np.lexsort((first[kept], -sizes[kept], self.labels[first[kept]]))]
        new_id = np.full(len(sizes), _NO_THING, np.int32)
        new_id[kept] = np.arange(len(kept))
        thing_of = new_id[number]
        half_m = 0.5 * self.resolution_m
        order = np.argsort(thing_of, kind="stable")
        order = order[thing_of[order] >= 0]
        things = []
        for i, rows in enumerate(np.split(order, np.cumsum(sizes[kept])[:-1]) if len(kept) else []):
            points = self.points_m[rows].astype(np.float64)
            share = float(self.votes[rows].sum() / self.total[rows].sum())
            low, high = points.min(axis=0) - half_m, points.max(axis=0) + half_m
            things.append(Thing(i, int(self.labels[rows[0]]), len(rows), low, high, points.mean(axis=0), share))
        return thing_of, things

    def _components(self) -> NDArray[np.int64]:
        """Return the number [N] of the group of touching voxels, be it at a corner, with one label."""
        pairs = []
        for dz in (-1, 0, 1):
            for dy in (-1, 0, 1):
                for dx in (-1, 0, 1):
                    step = (dz << 32) + (dy << 16) + dx
                    if step <= 0:
                        continue  # the other voxel finds it
                    other = self.rows_of(self.keys + step)
                    alike = np.flatnonzero((other >= 0) & (self.labels[other] == self.labels))
                    pairs.append(np.stack([alike, other[alike]]))
        first, second = np.concatenate(pairs, axis=1)
        graph = coo_array((np.ones(len(first), np.int8), (first, second)), shape=(len(self), len(self)))
        return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def thing_data(thing: Thing) -> dict[str, Any]:
    """Return a thing as plain data."""
    return {
        "id": thing.id,
        "voxels": thing.voxels,
        "from_m": thing.from_m.round(3).tolist(),
        "to_m": thing.to_m.round(3).tolist(),
        "centre_m": thing.centre_m.round(3).tolist(),
        "share": round(thing.share, 4),
    }
