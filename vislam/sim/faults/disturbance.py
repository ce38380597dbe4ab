"""What spoils vision: a view without texture, light that jumps, a person who fills part of the image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert
from vislam.core.messages import Array, ImageF32, ImageU8

if TYPE_CHECKING:
    from vislam.sim.worlds.simulation import SimOptions

PERSON_M = 2.0  # away from the camera
_SWEEP_S = 7.0  # of the person, to the other side and back
_BLANK = 110.0  # display value of a view without texture
_CLOTH_PX = (3, 9, 27)  # sizes of the patterns on the person's clothes
_SETTLED_S = 0.1  # a camera's control of exposure follows a jump of light within about three frames
_STAYS = 0.35  # of the jump, in logarithms: what the control of exposure leaves


def in_window(t_s: float, begin_s: float, length_s: float | None, every_s: float = 0.0) -> bool:
    """Whether a time lies in a window that begins at `begin_s`, and again every `every_s` if that is not 0.

    Without a length it has no end.
    """
    after_s = t_s - begin_s
    if every_s > 0.0 and after_s >= 0.0:
        after_s %= every_s
    return after_s >= 0.0 and (length_s is None or after_s < length_s)


def person_box(camera: Camera, share: float, t_s: float) -> Array:
    """Return middle and half size [2, 2] in pixels of the upright part of the image that a person fills at a time."""
    half = np.array([0.5 * share * camera.width, 0.5 * camera.height])
    swing = (0.5 * camera.width - half[0]) * np.sin(2.0 * np.pi * t_s / _SWEEP_S)
    return np.array([[0.5 * camera.width + swing, 0.5 * camera.height], half])


class Disturbance:
    """Spoils rendered images."""

    def __init__(self, rig: Rig, options: SimOptions, seed: np.random.SeedSequence) -> None:
        """Dress the person, if there is one; times of the options are seconds since the first frame."""
        self._rig, self._options = rig, options
        self._cloth: ImageF32 = np.empty((0, 0, 3), dtype=np.float32)
        if options.moving_share > 0.0:
            self._cloth = _cloth(rig.cameras[0], options.moving_share, np.random.default_rng(seed))

    def gain(self, t_s: float) -> float:
        """Return by how much the image is brighter (linear light): the room is lit and dark in turn, from lit on."""
        every_s, stops = self._options.light_every_s, self._options.light_stops
        if every_s <= 0.0 or t_s < every_s:
            return 1.0
        dark = -stops if int(t_s / every_s) % 2 else 0.0
        before = 0.0 if dark else -stops
        jump = (dark - before) * np.exp(-(t_s % every_s) / _SETTLED_S) * (1.0 - _STAYS)
        return float(2.0 ** (_STAYS * dark + jump))

    def spoil(self, camera: int, t_s: float, light: ImageF32, depth_m: ImageF32) -> tuple[ImageF32, ImageF32]:
        """Return display values [H, W, 3] and z-depth [H, W] of a camera's view as they become."""
        options = self._options
        if in_window(t_s, options.blank_begin_s, options.blank_length_s, options.blank_every_s):
            return np.full_like(light, _BLANK), np.zeros_like(depth_m)
        seen = self._person(camera, t_s)
        if seen is None:
            return light, depth_m
        drawn, cover = seen
        spoilt = drawn + (1.0 - cover[..., None]) * light
        return np.asarray(spoilt, np.float32), np.where(cover > 0.5, np.float32(PERSON_M), depth_m)

    def mask(self, camera: int, t_s: float) -> ImageU8 | None:
        """Return 0 where a camera's image shows the person, and 255 elsewhere [H, W]; None without one."""
        seen = self._person(camera, t_s)
        return None if seen is None else np.where(seen[1] > 0.0, np.uint8(0), np.uint8(255))

    def _person(self, camera: int, t_s: float) -> tuple[ImageF32, ImageF32] | None:
        """Return display values [H, W, 3] of the person, and how much of each pixel it is [H, W]; None without one."""
        options = self._options
        if options.moving_share <= 0.0 or not in_window(t_s, options.moving_begin_s, options.moving_length_s):
            return None
        box = person_box(self._rig.cameras[0], self._options.moving_share, t_s)
        middle = box[0]
        if camera > 0:
            point = PERSON_M * self._rig.cameras[0].unproject(middle[None])
            T_camera_cam0 = invert(invert(self._rig.T_body_cams[0]) @ self._rig.T_body_cams[camera])
            middle = self._rig.cameras[camera].project(point @ T_camera_cam0[:3, :3].T + T_camera_cam0[:3, 3])[0]
        corner = middle - box[1]
        shift = np.array([[1.0, 0.0, corner[0]], [0.0, 1.0, corner[1]]])
        size = (self._rig.cameras[camera].width, self._rig.cameras[camera].height)
        drawn = cv2.warpAffine(self._cloth, shift, size, flags=cv2.INTER_LINEAR)
        body = np.ones(self._cloth.shape[:2], dtype=np.float32)
        cover = cv2.warpAffine(body, shift, size, flags=cv2.INTER_LINEAR)
        return np.asarray(drawn, np.float32), np.asarray(cover, np.float32)


def _cloth(camera: Camera, share: float, rng: np.random.Generator) -> ImageF32:
    """Return display values [H, W, 3] of clothes: patterns of several sizes, as rich in corners as the rooms are."""
    size = (max(round(share * camera.width), 1), camera.height)
    image = np.full((size[1], size[0], 3), 100.0, dtype=np.float32)
    for cell in _CLOTH_PX:
        patches = rng.normal(0.0, 28.0, (-(-size[1] // cell), -(-size[0] // cell), 3)).astype(np.float32)
        image += cv2.resize(patches, size, interpolation=cv2.INTER_CUBIC)
    return np.clip(image, 5.0, 250.0)
