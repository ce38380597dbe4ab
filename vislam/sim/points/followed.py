"""A tracker that needs no images: landmarks projected into virtual cameras, with what goes wrong in real tracking.

A track follows one landmark until it leaves the image or its life ends, with white noise on every pixel. Some slip onto
another landmark and stay there, some jump for a single frame, some are not found in a frame. A person may walk through
the image: a part of it in which everything moves together, but not as the world does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.core.camera import Rig
from vislam.core.geometry import invert
from vislam.core.messages import Array, Bools, Observations
from vislam.sim.faults.disturbance import PERSON_M, person_box
from vislam.sim.motion.measured import MeasuredMotion
from vislam.sim.motion.spline import BodySpline
from vislam.sim.sensing import DepthNoise

if TYPE_CHECKING:
    from vislam.sim.points.points import PointOptions

Ids = NDArray[np.int64]
Descriptors = NDArray[np.uint8]

_BORDER_PX = 8.0  # tracks begin at least this far inside the image
_NEAR_M, _FAR_M = 0.4, 40.0  # z-depth within which a landmark can be followed
_SLIP_SHARE = 0.7  # of the outliers; the others are jumps of one frame
_SLIP_LIFE_S = 0.7  # how long a track that slipped goes on
_SLIP_REACH_PX = 60.0  # Lucas-Kanade does not go astray much further
_LONGEST_STEP_S = 0.3  # over a longer pause between frames nothing can be followed
_ROW_STEPS = 2  # the row decides the time, the time moves the row
_STRENGTH_NOISE = 0.3  # what light and view do to a corner's response, of the spread among corners
_SIDES = 6  # a descriptor changes beyond about 60 degrees
_BIT_ERRORS = 0.06  # of the 256 bits: 30 differ between two views of a landmark, as ORB has it
_NOBODY = -1
Indices = NDArray[np.int64]

_ANCHOR_M = 2.0  # the path is thinned to one anchor per cube of this side
_PER_ANCHOR = 600  # points around each: with their neighbours', some 500 in a view of 80 x 60 degrees
_LEAST = 6000  # points in all
_WALLS_M, _HALL_M, _END_M = 1.5, 8.0, 30.0  # walls and furniture between the first two, the rest of the hall beyond
_FAR_SHARE = 0.12
_CLEARANCE_M = 0.9  # from the path: the body does not drive through things
_REACH_M = 16.0  # anchors further away do not count
_STRIDE_M = 1.0  # the camera may move so far before the points around it are chosen again


class LandmarkField:
    """Points [N, 3] in the world, kept by the anchor they were scattered around."""

    def __init__(self, path_m: Array, rng: np.random.Generator) -> None:
        """Scatter points around a path [M, 3]: evenly in all directions, their distances evenly in the logarithm."""
        cubes = np.floor(path_m / _ANCHOR_M).astype(np.int64)
        first = np.sort(np.unique(cubes, axis=0, return_index=True)[1])
        self._anchors: Array = path_m[first]
        each = max(_PER_ANCHOR, -(-_LEAST // len(first)))
        count = each * len(first)
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        far = rng.random(count) < _FAR_SHARE
        low, high = np.where(far, _HALL_M, _WALLS_M), np.where(far, _END_M, _HALL_M)
        distance = low * (high / low) ** rng.random(count)
        points = np.repeat(self._anchors, each, axis=0) + distance[:, None] * direction
        thinned = path_m[np.sort(np.unique(np.floor(path_m / 0.3).astype(np.int64), axis=0, return_index=True)[1])]
        clear = cKDTree(thinned).query(points, distance_upper_bound=_CLEARANCE_M)[0] > _CLEARANCE_M
        self.points_m: Array = np.ascontiguousarray(points[clear])
        self.strength: Array = rng.random(len(self.points_m))  # [N] of the corners that the points are, 0 to 1
        self._anchor_of = np.repeat(np.arange(len(first)), each)[clear]
        self._starts = np.searchsorted(self._anchor_of, np.arange(len(first) + 1))
        self._tree = cKDTree(self._anchors)

    def around(self, position_m: Array) -> Indices:
        """Return the indices of the points whose anchor is within reach of a position [3], ascending."""
        anchors = np.sort(np.asarray(self._tree.query_ball_point(position_m, _REACH_M), dtype=np.int64))
        parts = [np.arange(self._starts[a], self._starts[a + 1]) for a in anchors]
        return np.concatenate(parts).astype(np.int64) if parts else np.empty(0, dtype=np.int64)


class Surroundings:
    """The points around a moving camera; chosen again only when it has moved far enough to matter."""

    def __init__(self, field: LandmarkField) -> None:
        """Start nowhere."""
        self._field = field
        self._centre: Array | None = None
        self._near = np.empty(0, dtype=np.int64)

    def at(self, position_m: Array) -> Indices:
        """Return the indices of the points around a position [3]."""
        if self._centre is None or np.linalg.norm(position_m - self._centre) > _STRIDE_M:
            self._centre = position_m.copy()
            self._near = self._field.around(position_m)
        return self._near


class SimulatedTracker:
    """Follows landmarks from frame to frame; call `see` in order of time."""

    def __init__(
        self, rig: Rig, field: LandmarkField, motion: BodySpline | MeasuredMotion, noise: PointOptions,
        rng: np.random.Generator, first_id: int = 0,
    ) -> None:  # fmt: skip
        """Start without tracks, which go wrong as `noise` states; ids count from `first_id` on."""
        self._rig, self._field, self._motion, self._noise, self._rng = rig, field, motion, noise, rng
        self._surroundings = Surroundings(field)
        self._depth_noise = DepthNoise()
        self._next_id = first_id
        self._last_s: float | None = None
        self._T_world_cam: Array = np.eye(4)  # at that time
        self._visible: tuple[Ids, Array] | None = None  # landmarks that could be seen then, and where; when asked for
        self._ids: Ids = np.empty(0, dtype=np.int64)
        self.landmarks: Ids = np.empty(0, dtype=np.int64)  # [N] whose image each track follows; -1: the person's
        self.slipped: Bools = np.empty(0, dtype=np.bool_)  # [N] no longer on the landmark it began with
        self._on_person: Array = np.empty((0, 2))  # [N, 2] place on the person, relative to its middle

    def see(self, t_s: float, moving: bool) -> Observations:
        """Return what is followed at a time in seconds; `moving` states whether the person is there.

        Track ids ascend. Outliers and slips are in it, unmarked; `landmarks` and `slipped` have the truth until the
        next call, for `track_ids_all`.
        """
        dt_s = 0.0 if self._last_s is None else t_s - self._last_s
        self._last_s, self._visible = t_s, None
        self._T_world_cam = self._motion.at(np.array([t_s])).T_world_body[0] @ self._rig.T_body_cams[0]
        if dt_s > _LONGEST_STEP_S:
            self._keep(np.zeros(len(self._ids), dtype=np.bool_))
        share = self._noise.moving_share
        person = person_box(self._rig.cameras[0], share, t_s) if moving and share > 0.0 else None
        ideal, points_cam = self._look(t_s, person)
        alive = self._survive(ideal, points_cam[:, 2], dt_s, person)
        self._keep(alive)
        self._slip()
        self._begin(person)
        return self._observe(*self._look(t_s, person))

    @property
    def track_ids_all(self) -> Ids:
        """Ids [N] of all tracks, also of those that were not found in the last frame."""
        return self._ids

    # -- geometry ----------------------------------------------------------------------------------------------------

    def _look(self, t_s: float, person: Array | None) -> tuple[Array, Array]:
        """Return ideal pixels [N, 2] of the tracks, NaN where none can be, and their points [N, 3] in the camera."""
        of_person = self.landmarks == _NOBODY
        points = self._field.points_m[np.where(of_person, 0, self.landmarks)]
        pixels, points_cam = self._rolling(points, t_s)
        if of_person.any():
            middle = np.full(2, np.nan) if person is None else person[0]
            pixels[of_person] = middle + self._on_person[of_person]
            points_cam[of_person] = PERSON_M * self._rig.cameras[0].unproject(pixels[of_person])
        return pixels, points_cam

    def _project(self, points: Array) -> tuple[Array, Array]:
        """Return raw pixels [N, 2] of world points [N, 3] at the frame's instant, and the points in the camera."""
        T = self._T_world_cam
        points_cam = (points - T[:3, 3]) @ T[:3, :3]
        return self._rig.cameras[0].project(points_cam), points_cam

    def _rolling(self, points: Array, t_s: float) -> tuple[Array, Array]:
        """Return what `_project` does, each point at the time of the row that sees it."""
        camera, T_body_cam, readout_s = self._rig.cameras[0], self._rig.T_body_cams[0], self._noise.readout_s
        pixels, points_cam = self._project(points)
        if readout_s > 0.0:
            for _ in range(_ROW_STEPS):
                rows = np.clip(np.nan_to_num(pixels[:, 1]), 0.0, camera.height - 1.0)
                times = t_s + (rows / (camera.height - 1.0) - 0.5) * readout_s
                T_rows = self._motion.at(times).T_world_body @ T_body_cam
                points_cam = np.einsum("nji,nj->ni", T_rows[:, :3, :3], points - T_rows[:, :3, 3])
                pixels = camera.project(points_cam)
        return pixels, points_cam

    # -- the life of tracks ------------------------------------------------------------------------------------------

    def _survive(self, ideal: Array, depth_m: Array, dt_s: float, person: Array | None) -> Bools:
        noise, camera = self._noise, self._rig.cameras[0]
        life_s = np.where(self.slipped, _SLIP_LIFE_S, noise.track_life_s)
        alive = camera.contains(ideal) & (depth_m > _NEAR_M) & (depth_m < _FAR_M)
        alive &= self._rng.random(len(ideal)) > 1.0 - np.exp(-dt_s / life_s)
        if person is not None:
            alive &= (self.landmarks == _NOBODY) | ~_within(ideal, person)
        return alive

    def _slip(self) -> None:
        """Let as many tracks go astray as the share of outliers asks for."""
        missing = self._noise.outlier_share * _SLIP_SHARE * len(self._ids) - self.slipped.sum()
        count = int(np.floor(missing + self._rng.random())) if missing > 0.0 else 0
        good = np.flatnonzero(~self.slipped & (self.landmarks != _NOBODY))
        if count == 0 or len(good) == 0:
            return
        free, pixels = self._candidates()
        astray = self._rng.choice(good, size=min(count, len(good)), replace=False)
        here = self._project(self._field.points_m[self.landmarks[astray]])[0]
        for track, pixel in zip(astray, here, strict=True):
            within = np.flatnonzero(np.linalg.norm(pixels - pixel, axis=1) < _SLIP_REACH_PX)
            if len(within):
                self.landmarks[track] = free[self._rng.choice(within)]
                self.slipped[track] = True

    def _begin(self, person: Array | None) -> None:
        """Fill up to the wanted number of tracks: on the person in proportion to its part of the image."""
        wanted = self._noise.tracks
        on_person = int((self.landmarks == _NOBODY).sum())
        share = 0.0 if person is None else self._noise.moving_share
        self._begin_on_person(round(share * wanted) - on_person, person)
        missing = round((1.0 - share) * wanted) - int((self.landmarks != _NOBODY).sum())
        if missing > 0:
            free, pixels = self._candidates()
            if person is not None:
                free = free[~_within(pixels, person)]
            # as corner detectors do, mostly the same ones again, so that a place is recognised
            strength = self._field.strength[free] + _STRENGTH_NOISE * self._rng.random(len(free))
            chosen = np.sort(np.argsort(-strength)[:missing])
            self._append(free[chosen], np.zeros((len(chosen), 2)))

    def _begin_on_person(self, count: int, person: Array | None) -> None:
        if person is not None and count > 0:
            places = (2.0 * self._rng.random((count, 2)) - 1.0) * np.maximum(person[1] - _BORDER_PX, 0.0)
            self._append(np.full(count, _NOBODY), places)

    def _candidates(self) -> tuple[Ids, Array]:
        """Return landmarks [M] that could be seen and are not followed, and about where [M, 2] (no rolling shutter)."""
        if self._visible is None:
            T, points = self._T_world_cam, self._field.points_m
            near = self._surroundings.at(T[:3, 3])
            depth = (points[near] - T[:3, 3]) @ T[:3, 2]
            near = near[(depth > _NEAR_M) & (depth < _FAR_M)]
            pixels = self._project(points[near])[0]
            good = self._rig.cameras[0].contains(pixels, _BORDER_PX)
            self._visible = near[good], pixels[good]
        landmarks, pixels = self._visible
        free = ~np.isin(landmarks, self.landmarks)
        return landmarks[free], pixels[free]

    def _append(self, landmarks: Ids, on_person: Array) -> None:
        count = len(landmarks)
        self._ids = np.concatenate([self._ids, np.arange(self._next_id, self._next_id + count, dtype=np.int64)])
        self._next_id += count
        self.landmarks = np.concatenate([self.landmarks, landmarks])
        self.slipped = np.concatenate([self.slipped, np.zeros(count, dtype=np.bool_)])
        self._on_person = np.vstack([self._on_person, on_person])

    def _keep(self, which: Bools) -> None:
        self._ids, self.landmarks = self._ids[which], self.landmarks[which]
        self.slipped, self._on_person = self.slipped[which], self._on_person[which]

    # -- what is measured --------------------------------------------------------------------------------------------

    def _observe(self, ideal: Array, points_cam: Array) -> Observations:
        noise, camera, count = self._noise, self._rig.cameras[0], len(self._ids)
        error = self._rng.normal(0.0, 1.0, (count, 2)) * noise.pixel_sigma_px
        jumps = self._rng.random(count) < noise.outlier_share * (1.0 - _SLIP_SHARE)
        jumped = self._rng.random((count, 2)) * np.array([camera.width - 1.0, camera.height - 1.0])
        pixels = np.where(jumps[:, None], jumped, ideal + error)
        found = camera.contains(pixels) & (self._rng.random(count) >= noise.dropout_share)
        right = self._right(points_cam, error, jumps)
        depth = self._depth(points_cam, jumps)
        return Observations(
            self._ids[found].copy(),
            pixels[found],
            None if right is None else right[found],
            None if depth is None else depth[found],
            descriptors=self._describe(points_cam[found], self.landmarks[found]) if noise.descriptors else None,
        )

    def _describe(self, points_cam: Array, landmarks: Ids) -> Descriptors:
        """Return descriptors [N, 32]: alike for one landmark seen from about one side, with some wrong bits."""
        back = -points_cam @ self._T_world_cam[:3, :3].T
        side = np.arctan2(back[:, 1], back[:, 0]) / (2.0 * np.pi) + self._field.strength[landmarks]
        key = landmarks * _SIDES + np.floor(side * _SIDES).astype(np.int64) % _SIDES
        key[landmarks == _NOBODY] = self._rng.integers(1 << 40, 1 << 41, int((landmarks == _NOBODY).sum()))
        words = scramble((key[:, None] * 4 + np.arange(4)).astype(np.uint64))
        flipped = self._rng.random((len(key), 256), dtype=np.float32) < _BIT_ERRORS
        return words.view(np.uint8) ^ np.packbits(flipped, axis=1)

    def _right(self, points_cam: Array, error: Array, jumps: Bools) -> Array | None:
        """Return pixels [N, 2] in the right camera: the same patch, so the left's error too, and that of the match."""
        if not self._rig.is_stereo:
            return None
        camera, T_right_left = self._rig.cameras[1], invert(self._rig.T_cam0_cam1)
        pixels = camera.project(points_cam @ T_right_left[:3, :3].T + T_right_left[:3, 3])
        pixels += error + self._rng.normal(0.0, 1.0, pixels.shape) * self._noise.stereo_sigma_px
        pixels[jumps | ~camera.contains(pixels)] = np.nan
        return pixels

    def _depth(self, points_cam: Array, jumps: Bools) -> Array | None:
        """Return z-depths [N] as a depth camera gives them, NaN out of its range and where a track jumped."""
        if not self._rig.has_depth:
            return None
        z, model = points_cam[:, 2], self._depth_noise
        z = z + self._rng.normal(0.0, 1.0, len(z)) * (model.floor_m + model.sigma_m_at_1m * z * z)
        return np.where(jumps | (z < model.min_m) | (z > model.max_m), np.nan, z)


def scramble(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return numbers that look random and are the same for the same number (splitmix64; Steele et al. 2014)."""
    x = numbers * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def _within(pixels: Array, box: Array) -> Bools:
    """Return which pixels [N, 2] lie in a box of middle and half size [2, 2]."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(pixels - box[0]) <= box[1]).all(axis=1), dtype=np.bool_)
