"""Tracks of a keyframe on the floor and off it: where they were first seen, and what is known of their depth."""

from dataclasses import replace

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.messages import Array, Bools, Frame, ImageU8, Observations
from vislam.frontend.planar.fit import FloorPair
from vislam.frontend.planar.floor import Regions
from vislam.frontend.tracker import CELL_PX, MIN_CORNER_RESPONSE, Tracker
from vislam.vision.brightness import matched
from vislam.vision.features import FlowSettings, follow
from vislam.vision.landmarks import UNKNOWN_RHO, Landmarks

# of floor points: a pixel is worth d^2 / H; at 8, patches come out 0.2 % short
_MAX_DISTANCE_HEIGHTS = 5.0
_GUESSED_RHO_SIGMA = 0.15  # 1/m, of a corner under the horizon, which is on the floor or on what stands there
_NEAR_PX = 12.0  # of a track, within which a feature lies on the same surface
_TELLING_PX = 3.0  # of image motion; less, and anything fits


class FloorTracks:
    """Owns the tracker and the landmark of each track; rotations R [3, 3] are those of cam0 to the level frame.

    Attributes:
        tracker: the corners.
        landmarks: as the keyframe sees them.
        candidates: [N] tracks that lie where the floor should be.
    """

    def __init__(self, config: FrontEndConfig, camera: Camera, regions: Regions, height_m: float) -> None:
        """Start without tracks."""
        self._config, self._planar = config, config.planar
        self._camera = camera
        self._regions = regions
        self._height_m = height_m
        self._is_split = config.planar.method == "split"
        self.px = 2.0 / (camera.fx + camera.fy)
        self.max_distance_m = _MAX_DISTANCE_HEIGHTS * height_m
        self.tracker = Tracker(replace(config, max_tracks=config.planar.max_tracks), self._find)
        self.landmarks = Landmarks()
        self._off_floor: Bools = np.zeros(0, dtype=np.bool_)  # that are seen not to lie on the floor
        self._confirmed: Bools = np.zeros(0, dtype=np.bool_)  # that moved as the floor does
        self.candidates: Bools = np.zeros(0, dtype=np.bool_)

    def __len__(self) -> int:
        return len(self.tracker)

    @property
    def rays(self) -> Array:
        """Where the keyframe saw them: [N, 2] on z = 1."""
        return self.landmarks.mean[:, :2]

    @property
    def pixels(self) -> Array:
        """The same as pixels [N, 2]."""
        return self.tracker.pixels

    def usable(self, pair: FloorPair) -> Bools:
        """Return which tracks [N] lie on the floor, near enough, in both images of a pair."""
        return pair.usable(self.max_distance_m) & ~self._off_floor

    def on_floor(self, R_level_cam: Array) -> Bools:
        """Return which tracks [N] of the keyframe lie where the floor should be."""
        return self.usable(FloorPair(self.rays, self.rays, R_level_cam, R_level_cam, self._height_m, self.px))

    def forget(self) -> None:
        """Drop all."""
        self.tracker.forget()
        self.landmarks = Landmarks()
        self._off_floor = self._confirmed = self.candidates = np.zeros(0, dtype=np.bool_)

    def begin(self, frame: Frame, R_level_cam: Array) -> int:
        """Look for tracks in a first keyframe; return how many there are."""
        self.forget()
        count = self.tracker.begin(frame, np.zeros(0, dtype=np.bool_), np.empty((0, 2)))
        self._add_landmarks(count, R_level_cam)
        return count

    def continue_in(
        self, frame: Frame, kept: Bools, pixels: Array, xy: Array, T_key_cam: Array, R_level_cam: Array
    ) -> None:
        """Make a frame the keyframe: tracks `kept` [N] go on, seen at `pixels` and `xy` [N, 2]; new ones fill gaps."""
        unknown, sigma_xy = np.full(int(kept.sum()), np.nan), self._planar.sigma_px * self.px
        landmarks = self.landmarks.carried(kept, T_key_cam, xy[kept], sigma_xy, unknown, unknown, unknown)
        landmarks.mean[:, :2] = xy[kept]  # the patch that is followed from now on
        self.landmarks = landmarks
        self._off_floor, self._confirmed = self._off_floor[kept], self._confirmed[kept]
        count = self.tracker.begin(frame, kept, pixels)
        self._add_landmarks(count, R_level_cam)

    def install(self, R_level_cam: Array) -> None:
        """Settle which tracks of the new keyframe count as floor."""
        self.candidates = self.on_floor(R_level_cam)

    def judge_floor(self, on: Bools, xy: Array) -> None:
        """Take note which tracks, now at `xy` [N, 2] on z = 1, move as the floor does (`on` [N]) and which do not."""
        moved_px = np.linalg.norm(xy - self.rays, axis=1) / self.px
        with np.errstate(invalid="ignore"):
            telling = moved_px > _TELLING_PX
        self._confirmed |= on & telling
        self._off_floor |= np.isfinite(xy[:, 0]) & ~on & telling & ~self._confirmed
        self.candidates = self.candidates & ~self._off_floor

    def judge(self, good: Bools) -> Bools:
        """Drop what has not been `good` [N] for too long; return which tracks [N, before the call] are left."""
        alive = self.tracker.judge(good)
        self.landmarks.keep(alive)
        self._off_floor, self._confirmed = self._off_floor[alive], self._confirmed[alive]
        self.candidates = self.candidates[alive]
        return alive

    def observed(self, which: Bools, pixels: Array, R_level_cam: Array) -> Observations:
        """Return the tracks `which` [N] at `pixels` [N, 2], with the depth of those known to be on the floor."""
        xy = self._camera.normalise(pixels[which])
        rho = np.where((self._confirmed & ~self._off_floor)[which], self._floor_rho(xy, R_level_cam), np.nan)
        return Observations(self.tracker.ids[which].copy(), pixels[which].copy(), depth_m=1.0 / rho)

    def depth_m(self, pixels: Array, R_level_cam: Array) -> Array:
        """Return the z-depth [N] of features of the keyframe near tracks whose depth is known; NaN elsewhere."""
        depth: Array = np.full(len(pixels), np.nan)
        on_floor = self._confirmed & ~self._off_floor
        known = self.landmarks.known | on_floor
        if not known.any() or len(pixels) == 0:
            return depth
        apart = np.linalg.norm(pixels[:, None] - self.pixels[known][None], axis=2)
        nearest = np.argmin(apart, axis=1)
        close = apart[np.arange(len(pixels)), nearest] < _NEAR_PX
        by_floor = self._floor_rho(self._camera.normalise(pixels), R_level_cam)
        rho = np.where(on_floor[known][nearest], by_floor, self.landmarks.mean[known][nearest, 2])
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(close & (rho > 1.0 / self._config.max_depth_m), 1.0 / rho, np.nan)

    def _find(self, image: ImageU8, live: Array, mask: ImageU8 | None) -> Array:
        apart_px = self._config.min_distance_px
        if self._is_split:
            return self._regions.harris(image, live, apart_px, mask)
        wanted = self._planar.max_tracks - len(live)
        return self._regions.shi_tomasi(image, live, wanted, CELL_PX, apart_px, MIN_CORNER_RESPONSE, mask)

    def _add_landmarks(self, count: int, R_level_cam: Array) -> None:
        """Give the tracker's last `count` corners landmarks: under the horizon on the floor, as a guess."""
        xy = self._camera.normalise(self.pixels[len(self.tracker) - count :])
        rho = self._floor_rho(xy, R_level_cam)
        guessed: Array = np.where(np.isfinite(rho), rho, UNKNOWN_RHO)
        self.landmarks.append(xy, guessed, self._planar.sigma_px * self.px, np.full(count, np.nan))
        self.landmarks.covariance[len(self.landmarks) - count :, 2, 2] = (
            np.where(np.isfinite(rho), _GUESSED_RHO_SIGMA + 0.3 * guessed, 3.0 * UNKNOWN_RHO) ** 2
        )
        none = np.zeros(count, dtype=np.bool_)
        self._off_floor = np.concatenate([self._off_floor, none])
        self._confirmed = np.concatenate([self._confirmed, none])

    def _floor_rho(self, xy: Array, R_level_cam: Array) -> Array:
        """Return the inverse z-depth [N] in 1/m of the floor in directions [N, 2]; NaN above it and too far away."""
        down = -(np.column_stack([xy, np.ones(len(xy))]) @ R_level_cam[2])
        rho = down / self._height_m
        return np.where(rho * self.max_distance_m > 1.0, rho, np.nan)


class Steps:
    """Follows from frame to frame, as method split does; what is lost stays lost until the next base."""

    def __init__(self, max_back_px: float) -> None:
        """Start without an image."""
        self._flow = FlowSettings(max_back_px=max_back_px)
        self._image: ImageU8 | None = None
        self._pixels: Array = np.empty((0, 2))

    def begin(self, frame: Frame, pixels: Array) -> None:
        """Start from a keyframe and its tracks [N, 2]."""
        self._image, self._pixels = (frame.images[0] if frame.images else None), pixels.copy()

    def follow(self, frame: Frame) -> Array:
        """Return where the tracks are now: [N, 2], NaN where lost."""
        if self._image is None or not frame.images:
            return np.full_like(self._pixels, np.nan)
        source = matched(self._image, frame.images[0], self._pixels, self._pixels, self._flow.window_px)
        self._pixels = follow(source, frame.images[0], self._pixels, self._pixels, self._flow, frame.mask(0))[0]
        self._image = frame.images[0]
        return self._pixels

    def keep(self, alive: Bools) -> None:
        """Forget the tracks that are not `alive` [N]."""
        self._pixels = self._pixels[alive]
