"""What goes wrong with cameras: with images, with depth, with frames as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np

from vislam.core.camera import Camera
from vislam.core.messages import Array, Frame, ImageU8, ImuSample
from vislam.sim.faults.disturbance import PERSON_M, person_box
from vislam.sim.faults.moment import Event, Moment, Stream, changed

_STEPS = (1.0, 0.4, 1.6, 0.7)  # gains, one after the other
_STEP_S = 1.5
_SALT = 0.05  # of the pixels
_COVERED, _GRAIN = 40.0, 2.0  # grey and its noise behind a hand


def pictures(change: Callable[[ImageU8, Moment, float], ImageU8], camera: int | None = None) -> Stream:
    """Return the fault that changes images [H, W], all or those of one camera, by the moment and the time since it."""

    def frame(value: Frame, moment: Moment) -> Frame:
        since_s = (value.t_ns - moment.from_ns) * 1e-9
        return replace(value, images=tuple(
            change(image, moment, since_s) if camera in (None, k) else image for k, image in enumerate(value.images)
        ))  # fmt: skip

    return changed(Frame, frame)


def _even(level: int) -> Callable[[ImageU8, Moment, float], ImageU8]:
    return lambda image, _, __: np.full_like(image, level)


def _gained(image: ImageU8, gain: float) -> ImageU8:
    return np.clip(image * gain, 0.0, 255.0).astype(np.uint8)


def _blurred(image: ImageU8, _: Moment, __: float) -> ImageU8:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 3.0), dtype=np.uint8)


def _salted(image: ImageU8, moment: Moment, _: float) -> ImageU8:
    drawn = moment.rng.random(image.shape, dtype=np.float32)
    return np.where(drawn < 0.5 * _SALT, 0, np.where(drawn > 1.0 - 0.5 * _SALT, 255, image)).astype(np.uint8)


def _covered(image: ImageU8, moment: Moment, _: float) -> ImageU8:
    return np.clip(_COVERED + _GRAIN * moment.rng.standard_normal(image.shape), 0.0, 255.0).astype(np.uint8)


BLACK, WHITE, ONE_BLACK = pictures(_even(0)), pictures(_even(255)), pictures(_even(0), 1)
GAIN = pictures(lambda image, _, since_s: _gained(image, _STEPS[int(since_s / _STEP_S) % len(_STEPS)]))
DIMMED = pictures(lambda image, _, __: _gained(image, _STEPS[1]))
BLURRED, SALTED, COVERED = pictures(_blurred), pictures(_salted), pictures(_covered)
ONE_GONE = changed(Frame, lambda frame, _: replace(frame, images=frame.images[:1]))
NO_DEPTH = changed(Frame, lambda f, _: f if f.depth_m is None else replace(f, depth_m=np.zeros_like(f.depth_m)))
LONG_DEPTH = changed(Frame, lambda f, _: f if f.depth_m is None else replace(f, depth_m=f.depth_m * np.float32(1.05)))


def some_dropped(share: float) -> Stream:
    """Return the fault that a share of the frames never arrives."""
    return changed(Frame, lambda frame, moment: frame if moment.rng.random() >= share else None)


def as_before(before: Frame, frame: Frame) -> Frame:
    """Return a frame with what another one shows."""
    return replace(before, t_ns=frame.t_ns, index=frame.index)


def now_and_then(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """Repeat the frame before in one of ten frames."""
    before: Frame | None = None
    for value in events:
        if not isinstance(value, Frame):
            yield value
            continue
        is_repeated = before is not None and moment.has(value.t_ns) and moment.rng.random() < 0.1
        before = as_before(before, value) if before is not None and is_repeated else value
        yield before


def swapped(frame: Frame, _: Moment) -> Frame:
    """Return a frame with left and right exchanged."""
    tracks = frame.tracks
    if tracks is not None and tracks.right_px is not None:
        tracks = replace(tracks, pixels_px=tracks.right_px, right_px=tracks.pixels_px)
    return replace(frame, images=frame.images[::-1], tracks=tracks)


def person(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """Put a person over a half of the image who walks to and fro 2 m away, dressed in a pattern."""
    rig = moment.rig
    size = (rig.cameras[0].height, rig.cameras[0].width)
    cloth = sum(cv2.resize(moment.rng.random((size[0] // n, size[1] // n)), size[::-1]) for n in (4, 12, 36))
    cloth_u8 = (cloth * (255.0 / 3.0)).astype(np.uint8)
    shift_px = rig.cameras[0].fx * float(np.linalg.norm(rig.T_cam0_cam1[:3, 3])) / PERSON_M if rig.is_stereo else 0.0

    def dressed(frame: Frame, _: Moment) -> Frame:
        box = person_box(rig.cameras[0], 0.5, (frame.t_ns - moment.from_ns) * 1e-9)
        images = tuple(_dressed(im, cloth_u8, box, k * shift_px) for k, im in enumerate(frame.images))
        depth = None if frame.depth_m is None else frame.depth_m.copy()
        if depth is not None:
            left, right = np.clip((box[0, 0] + np.array([-1, 1]) * box[1, 0]).astype(int), 0, size[1])
            depth[:, left:right] = PERSON_M
        return replace(frame, images=images, depth_m=depth)

    return changed(Frame, dressed)(events, moment)


def _dressed(image: ImageU8, cloth: ImageU8, box: Array, shift_px: float) -> ImageU8:
    middle, half = box[0, 0] - shift_px, box[1, 0]
    left, right = np.clip([round(middle - half), round(middle + half)], 0, image.shape[1])
    begin = max(round(half - middle), 0)  # of the cloth, where the person stands half outside
    out = image.copy()
    out[:, left:right] = cloth[: image.shape[0], begin : begin + right - left]
    return out


def rolling(events: Iterator[Event], moment: Moment, readout_s: float) -> Iterator[Event]:
    """Shift rows as the turn of the body during the readout does; the stamp is the middle row's."""
    rig = moment.rig
    rate: Array = np.zeros(3)
    for value in events:
        if isinstance(value, ImuSample):
            rate = value.gyro_rad_s
        if not isinstance(value, Frame):
            yield value
            continue
        rates = [T[:3, :3].T @ rate for T in rig.T_body_cams]
        seen = zip(value.images, rig.cameras, rates, strict=False)
        yield replace(value, images=tuple(_sheared(im, camera, w, readout_s) for im, camera, w in seen))


def _sheared(image: ImageU8, camera: Camera, rate_cam_rad_s: Array, readout_s: float) -> ImageU8:
    height, width = image.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    late_s = readout_s * ((v + 0.5) / height - 0.5)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    wx, wy, wz = (float(w) for w in rate_cam_rad_s)
    du = camera.fx * late_s * (-wx * x * y + wy * (1.0 + x * x) - wz * y)  # a ray of the middle row's camera turns
    dv = camera.fy * late_s * (-wx * (1.0 + y * y) + wy * x * y + wz * x)  # by the opposite of the body's turn
    return np.asarray(cv2.remap(image, u + du.astype(np.float32), v + dv.astype(np.float32), cv2.INTER_LINEAR))
