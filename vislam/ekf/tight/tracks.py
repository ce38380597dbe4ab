"""Tracks as the tight filter keeps them: what each frame saw, and which tracks are ripe to be used."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, Observations
from vislam.ekf.tight.features import COLUMNS

if TYPE_CHECKING:  # the fast path must not load OpenCV
    from vislam.core.camera import Camera, Rig


@dataclass(frozen=True, slots=True, eq=False)
class FrameTracks:
    """What one frame saw, ready for the filter."""

    t_ns: int  # stamp of the frame
    ids: NDArray[np.int64]  # [N] ascending
    pixels_px: Array  # [N, 2]
    seen: Array  # [N, 12] rows of `features`
    unused: NDArray[np.bool_]  # [N] each observation is used once
    shows_scale: bool = True  # False: the motion before it was too uniform for one camera to see how large things are


@dataclass(frozen=True, slots=True, eq=False)
class Ripe:
    """Tracks to be used now, and their observations one after the other."""

    ids: NDArray[np.int64]  # [F]
    starts: NDArray[np.int64]  # [F + 1]
    at: NDArray[np.int64]  # [M] clone
    row: NDArray[np.int64]  # [M] within the frame of that clone
    alive: NDArray[np.bool_]  # [F] still followed


def prepare(t_ns: int, observations: Observations, rig: Rig, readout_s: float, shows_scale: bool = True) -> FrameTracks:
    """Return the usable observations of a frame: finite, one per track, with a ray in the camera model."""
    at_once = observations.instant_px is not None
    given = observations.instant_px if observations.instant_px is not None else observations.pixels_px
    ids, pixels, seen, first = _seen_by(0, rig, observations.track_ids, given, 0.0 if at_once else readout_s)
    right = observations.right_instant_px if at_once else observations.right_px
    if right is not None and rig.is_stereo:
        seen[:, 4:8] = _rays(rig.cameras[1], np.asarray(right, dtype=np.float64)[first])
    if observations.depth_m is not None:
        depth = np.asarray(observations.depth_m, dtype=np.float64)[first]
        good = np.isfinite(depth) & (depth > 0.0)
        seen[good, 8] = 1.0 / depth[good]
    if observations.further:
        others = [_seen_by(o.camera, rig, o.track_ids, o.pixels_px, readout_s)[:3] for o in observations.further]
        ids, pixels, seen = (np.concatenate(parts) for parts in zip((ids, pixels, seen), *others, strict=True))
        order = np.argsort(ids, kind="stable")
        ids, pixels, seen = ids[order], pixels[order], seen[order]
    seen[:, 10] = observations.noise
    fit = np.isfinite(seen[:, :4]).all(axis=1) & np.isfinite(seen[:, 9])
    return FrameTracks(t_ns, ids[fit], pixels[fit], seen[fit], np.ones(int(fit.sum()), dtype=np.bool_), shows_scale)


def _seen_by(
    number: int, rig: Rig, track_ids: NDArray[np.int64], pixels_px: Array, readout_s: float
) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int64]]:
    """Return ids [N] of a camera's tracks, ascending, pixels [N, 2] and rows [N, 12] without noise, and where each was.

    Of tracks that come twice the first is taken.
    """
    ids, first = np.unique(np.asarray(track_ids, dtype=np.int64), return_index=True)
    pixels = np.asarray(pixels_px, dtype=np.float64).reshape(-1, 2)[first]
    camera, seen = rig.cameras[number], np.full((len(ids), COLUMNS), np.nan)
    seen[:, :4] = _rays(camera, pixels)
    rows = np.clip(pixels[:, 1], 0.0, camera.height - 1.0)
    seen[:, 9] = (rows / max(camera.height - 1.0, 1.0) - 0.5) * readout_s
    seen[:, 11] = number
    return ids, pixels, seen, first


def _rays(camera: Camera, pixels: Array) -> Array:
    return np.column_stack((camera.normalise(pixels), pixels - (camera.cx, camera.cy)))


def ripe_tracks(frames: tuple[FrameTracks, ...], leaving: int | None, least: int, most: int) -> Ripe:
    """Return the tracks that ended, and those whose first observation is in the clone that leaves; longest first.

    Args:
        frames: of the clones, oldest first; the last is the newest frame.
        leaving: clone that will be dropped; None: none yet.
        least: observations of a track to be of use.
        most: tracks.
    """
    rows = [np.flatnonzero(f.unused) for f in frames]
    ids = np.concatenate([f.ids[r] for f, r in zip(frames, rows, strict=True)])
    if not len(ids):
        nothing = np.zeros(0, dtype=np.int64)
        return Ripe(nothing, np.zeros(1, dtype=np.int64), nothing, nothing, np.zeros(0, dtype=np.bool_))
    order = np.argsort(ids, kind="stable")
    ids, row = ids[order], np.concatenate(rows)[order]
    at = np.repeat(np.arange(len(frames)), [len(r) for r in rows])[order]
    starts = np.flatnonzero(np.concatenate(([True], ids[1:] != ids[:-1])))
    found, counts = ids[starts], np.diff(np.append(starts, len(ids)))
    alive = at[starts + counts - 1] == len(frames) - 1
    ripe = ~alive
    if leaving is not None:
        ripe |= at[starts] == leaving
    chosen = np.flatnonzero(ripe & (counts >= least))
    chosen = chosen[np.argsort(-counts[chosen], kind="stable")][:most]
    bounds = np.concatenate(([0], np.cumsum(counts[chosen]))).astype(np.int64)
    flat = np.arange(bounds[-1]) + np.repeat(starts[chosen] - bounds[:-1], counts[chosen])
    return Ripe(found[chosen], bounds, at[flat], row[flat], alive[chosen])


def seen_at(frames: tuple[FrameTracks, ...], at: NDArray[np.int64], row: NDArray[np.int64]) -> Array:
    """Return rows [M, 12] of `features`, each of the frame `at` [M] and the row within it."""
    begins = np.cumsum([0, *(len(frame.ids) for frame in frames[:-1])])
    return np.asarray(np.concatenate([frame.seen for frame in frames])[begins[at] + row])


def marked(frames: tuple[FrameTracks, ...], at: NDArray[np.int64], row: NDArray[np.int64]) -> tuple[FrameTracks, ...]:
    """Return the frames with these observations marked as used."""
    out = list(frames)
    for i in np.unique(at):
        unused = out[i].unused.copy()
        unused[row[at == i]] = False
        out[i] = replace(out[i], unused=unused)
    return tuple(out)


def image_motion_px(before: FrameTracks, after: FrameTracks) -> float:
    """Return the median motion of the tracks that both frames saw; infinite without any."""
    _, i, j = np.intersect1d(before.ids, after.ids, assume_unique=True, return_indices=True)
    if not len(i):
        return float("inf")
    return float(np.median(np.linalg.norm(after.pixels_px[j] - before.pixels_px[i], axis=1)))
