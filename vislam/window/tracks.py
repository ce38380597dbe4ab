"""The observations that the window holds: a flat table, each row used once, ordered for the kernels on demand."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.config import WindowConfig
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.messages import Array, Observations
from vislam.window.equations import Ints, Views

RHO_START = 0.2  # 1/m: 5 m, where nothing is known
_VALUES = 8  # of a view, see Views


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """Views ready for the kernels, and which rows and slots of the table they are."""

    views: Views
    slots: Ints  # [L]
    rows: Ints  # [N]


class TrackTable:
    """Owns the observations of the window's keyframes and the landmarks' last estimates."""

    def __init__(self, config: WindowConfig, rig: Rig) -> None:
        """Start empty."""
        self._config = config
        self._rig = rig
        self._slot_of: dict[int, int] = {}
        self._free: list[int] = []
        self._track_of: Ints = np.zeros(0, dtype=np.int64)
        self.points: Array = np.zeros((0, 3))  # by slot
        self.host: Ints = np.zeros(0, dtype=np.int64)  # by slot, keyframe id; -1: no estimate yet
        self.slot: Ints = np.zeros(0, dtype=np.int64)  # by row, as all below
        self.keyframe: Ints = np.zeros(0, dtype=np.int64)
        self.camera: Ints = np.zeros(0, dtype=np.int64)
        self._values: Array = np.zeros((0, _VALUES))

    def __len__(self) -> int:
        """Return the number of observations held."""
        return len(self.slot)

    def track_ids(self, slots: Ints) -> Ints:
        """Return the front end's ids [L] of slots [L]."""
        return self._track_of[slots]

    def add(self, keyframe_id: int, seen: Observations) -> None:
        """Take the observations of a keyframe; pixels that no ray explains are left out.

        Call `check_observations` first.
        """
        values, usable = self._measure(seen)
        slots = self._slots(seen.track_ids[usable])
        self._append(slots, keyframe_id, 0, values[usable])
        if seen.right_px is not None and self._rig.is_stereo:
            at_once = seen.right_instant_px is not None
            pixels = seen.right_px if seen.right_instant_px is None else seen.right_instant_px
            right = _rows_of(self._rig.cameras[1], pixels, seen.noise * self._config.right_sigma_px, at_once)
            both = usable & np.isfinite(right).all(axis=1)
            if both.any():
                place = np.cumsum(usable) - 1
                self._append(slots[place[both]], keyframe_id, 1, right[both])
        for further in seen.further:
            camera, sigma_px = self._rig.cameras[further.camera], seen.noise * self._config.sigma_px
            values = _rows_of(camera, further.pixels_px, sigma_px)
            seen_well = np.asarray(np.isfinite(values).all(axis=1))
            self._append(self._slots(further.track_ids[seen_well]), keyframe_id, further.camera, values[seen_well])

    def select(self, ids: Ints) -> Selection:
        """Return the views of all landmarks that two views or a depth fix; `ids` [M] are the window's keyframes."""
        order, starts = self.ordered()
        counts = np.diff(starts, append=len(order))
        with_depth = np.zeros(len(starts), dtype=bool)
        if len(starts) > 0:
            with_depth = np.maximum.reduceat(self._values[order, 7], starts) > 0.0
        return self.arrange(order[np.repeat((counts >= 2) | with_depth, counts)], ids)

    def continued(self, ids: Ints) -> Ints:
        """Return the rows of all views of the landmarks that the newest keyframe `ids[-1]` saw again, ordered."""
        order, starts = self.ordered()
        counts = np.diff(starts, append=len(order))
        keyframe = self.keyframe[order]
        again = (keyframe[starts] < ids[-1]) & (keyframe[starts + counts - 1] == ids[-1])
        return order[np.repeat(again, counts)]

    def ordered(self) -> tuple[Ints, Ints]:
        """Return the rows ordered by slot, keyframe, camera, and where in that order each slot's begin."""
        order = np.argsort(self.slot, kind="stable")  # rows came in the order of keyframe, camera
        return order, np.flatnonzero(np.diff(self.slot[order], prepend=-1))

    def arrange(self, rows: Ints, ids: Ints) -> Selection:
        """Return views of these rows [N] of the table, ordered as `ordered` does; `ids` [M] are the keyframes."""
        slot = self.slot[rows]
        starts = np.flatnonzero(np.diff(slot, prepend=-1))
        keyframe = np.searchsorted(ids, self.keyframe[rows])
        views = Views(np.append(starts, len(rows)), keyframe[starts], keyframe, self.camera[rows], self._values[rows])
        return Selection(views, slot[starts], rows)

    def remove_rows(self, rows: Ints) -> None:
        """Forget rows by their numbers; see `remove`."""
        gone = np.zeros(len(self), dtype=np.bool_)
        gone[rows] = True
        self.remove(gone)

    def remove(self, gone: NDArray[np.bool_]) -> None:
        """Forget rows [N]; a landmark without rows frees its slot, one that lost its host starts again."""
        if len(gone) == 0 or not gone.any():
            return
        keep = ~gone
        self.slot, self.keyframe, self.camera = self.slot[keep], self.keyframe[keep], self.camera[keep]
        self._values = self._values[keep]
        used = np.bincount(self.slot, minlength=len(self.host)) > 0
        for slot in np.flatnonzero(~used & (self._track_of >= 0)).tolist():
            del self._slot_of[int(self._track_of[slot])]
            self._track_of[slot], self.host[slot] = -1, -1
            self._free.append(slot)

    def _slots(self, track_ids: NDArray[np.int64]) -> Ints:
        known = self._slot_of
        new = [int(t) for t in track_ids.tolist() if t not in known]
        missing = len(new) - len(self._free)
        if missing > 0:
            size = len(self.host)
            grown = size + max(missing, size)
            self._free.extend(range(grown - 1, size - 1, -1))
            self.points = np.concatenate([self.points, np.zeros((grown - size, 3))])
            self.host = np.concatenate([self.host, np.full(grown - size, -1, dtype=np.int64)])
            self._track_of = np.concatenate([self._track_of, np.full(grown - size, -1, dtype=np.int64)])
        for track in new:
            slot = self._free.pop()
            known[track] = slot
            self._track_of[slot], self.host[slot] = track, -1
        return np.array([known[t] for t in track_ids.tolist()], dtype=np.int64)

    def _append(self, slots: Ints, keyframe_id: int, camera: int, values: Array) -> None:
        count = len(slots)
        self.slot = np.concatenate([self.slot, slots])
        self.keyframe = np.concatenate([self.keyframe, np.full(count, keyframe_id, dtype=np.int64)])
        self.camera = np.concatenate([self.camera, np.full(count, camera, dtype=np.int64)])
        self._values = np.concatenate([self._values, values])

    def _measure(self, seen: Observations) -> tuple[Array, NDArray[np.bool_]]:
        at_once = seen.instant_px is not None
        pixels = seen.pixels_px if seen.instant_px is None else seen.instant_px
        values = _rows_of(self._rig.cameras[0], pixels, seen.noise * self._config.sigma_px, at_once)
        if seen.depth_m is not None:
            known = np.isfinite(seen.depth_m) & (seen.depth_m > 0.0)
            values[known, 6] = 1.0 / seen.depth_m[known]
            values[known, 7] = 1.0 / (seen.noise * self._config.depth_sigma_rho)
        return values, np.asarray(np.isfinite(values).all(axis=1))


def check_observations(seen: Observations, where: str) -> None:
    """Raise DataError unless ids are unique and pixels finite, with one row per track everywhere."""
    count = len(seen.track_ids)
    if seen.pixels_px.shape != (count, 2):
        raise DataError(f"{where}: {count} tracks but pixels of shape {seen.pixels_px.shape}; give one row per track")
    if not np.isfinite(seen.pixels_px).all():
        bad = int(np.sum(~np.isfinite(seen.pixels_px).all(axis=1)))
        raise DataError(f"{where}: {bad} of {count} tracks have pixels that are not finite; leave such tracks out")
    if len(np.unique(seen.track_ids)) != count:
        raise DataError(f"{where}: a track is seen twice in one frame; track ids must be unique")
    if seen.right_px is not None and seen.right_px.shape != (count, 2):
        raise DataError(f"{where}: right pixels {seen.right_px.shape} for {count} tracks; use NaN for no match")
    for further in seen.further:
        if further.pixels_px.shape != (len(further.track_ids), 2) or not np.isfinite(further.pixels_px).all():
            raise DataError(f"{where}: tracks of cam{further.camera} need one finite pixel each; leave others out")
    if seen.depth_m is not None and seen.depth_m.shape != (count,):
        raise DataError(f"{where}: depths of shape {seen.depth_m.shape} for {count} tracks; use NaN where unknown")


def _rows_of(camera: Camera, pixels_px: Array, sigma_px: float, at_once: bool = False) -> Array:
    """Return rows [N, 8] of the table without depth; NaN where no ray gives the pixel.

    `at_once`: all rows of the image count as seen at the frame's own time.
    """
    out = np.zeros((len(pixels_px), _VALUES))
    out[:, :2] = camera.normalise(pixels_px)
    out[:, 2:4] = pixels_px - (camera.cx, camera.cy)
    out[:, 4] = 1.0 / sigma_px
    if not at_once:
        out[:, 5] = pixels_px[:, 1] / camera.height - 0.5
    return out
