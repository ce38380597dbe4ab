"""What goes wrong with cameras: with images, with depth, with frames as a whole."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from faults.fault_moment import Event, Moment, Stream, changed

from vislam.core import Array, Camera, Frame, ImuSample
from vislam.core.messages import ImageU8
from vislam.sim.faults.disturbance import Disturbance
from vislam.sim.worlds.simulation import SimOptions

_STEPS = (1.0, 0.4, 1.6, 0.7)  # gains, one after the other
_STEP_S = 1.5
_SALT = 0.05  # of the pixels
_HICCUPS = 0.1  # of the frames
_COVERED, _GRAIN = 40.0, 2.0  # grey and its noise behind a hand


def framed(change: Callable[[Frame, Moment], Frame | None]) -> Stream:
    """Return the fault that changes every frame; None: it never arrives."""
    return changed(Frame, lambda frame, moment, _: [new for new in [change(frame, moment)] if new is not None])


def pictures(change: Callable[[ImageU8, Moment, float], ImageU8], camera: int | None = None) -> Stream:
    """Return the fault that changes images [H, W], all or those of one camera, by the moment and the time since it."""

    def pictured(frame: Frame, moment: Moment) -> Frame:
        since_s = (frame.t_ns - moment.from_ns) * 1e-9
        images = enumerate(frame.images)
        return replace(frame, images=tuple(change(i, moment, since_s) if camera in (None, k) else i for k, i in images))

    return framed(pictured)


def _gained(image: ImageU8, gain: float) -> ImageU8:
    return np.clip(image * gain, 0.0, 255.0).astype(np.uint8)


def _salted(image: ImageU8, moment: Moment, _: float) -> ImageU8:
    drawn = moment.rng.random(image.shape, dtype=np.float32)
    return np.where(drawn < 0.5 * _SALT, 0, np.where(drawn > 1.0 - 0.5 * _SALT, 255, image)).astype(np.uint8)


BLACK, ONE_BLACK = (pictures(lambda image, _, __: np.zeros_like(image), camera) for camera in (None, 1))
WHITE = pictures(lambda image, _, __: np.full_like(image, 255))
GAIN = pictures(lambda image, _, since_s: _gained(image, _STEPS[int(since_s / _STEP_S) % len(_STEPS)]))
DIMMED = pictures(lambda image, _, __: _gained(image, _STEPS[1]))
BLURRED = pictures(lambda image, _, __: np.asarray(cv2.GaussianBlur(image, (0, 0), 3.0), np.uint8))
COVERED = pictures(lambda image, m, __: (_COVERED + _GRAIN * m.rng.standard_normal(image.shape)).astype(np.uint8))
SALTED = pictures(_salted)
ONE_GONE = framed(lambda frame, _: replace(frame, images=frame.images[:1]))
NO_DEPTH = framed(lambda f, _: f if f.depth_m is None else replace(f, depth_m=np.zeros_like(f.depth_m)))
LONG_DEPTH = framed(lambda f, _: f if f.depth_m is None else replace(f, depth_m=f.depth_m * np.float32(1.05)))


def some_dropped(share: float) -> Stream:
    """Return the fault that a share of the frames never arrives."""
    return framed(lambda frame, moment: frame if moment.rng.random() >= share else None)


def as_before(before: Frame, frame: Frame) -> Frame:
    """Return a frame with what another one shows."""
    return replace(before, t_ns=frame.t_ns, index=frame.index)


def _hiccup(frame: Frame, moment: Moment, kept: list[Frame]) -> list[Frame]:
    kept[:] = [as_before(kept[0], frame) if kept and moment.rng.random() < _HICCUPS else frame]
    return [*kept]


HICCUPS = changed(Frame, _hiccup)


def _swapped(frame: Frame, _: Moment) -> Frame:
    tracks = frame.tracks
    if tracks is not None and tracks.right_px is not None:
        tracks = replace(tracks, pixels_px=tracks.right_px, right_px=tracks.pixels_px)
    return replace(frame, images=frame.images[::-1], tracks=tracks)


SWAPPED = framed(_swapped)


def person(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """Put a person over a half of the image who walks to and fro 2 m away, dressed in a pattern."""
    walking = Disturbance(
        moment.rig, SimOptions(moving_share=0.5), np.random.SeedSequence(int(moment.rng.integers(1 << 31)))
    )

    def met(frame: Frame, _: Moment) -> Frame:
        since_s = (frame.t_ns - moment.from_ns) * 1e-9
        depth_m = np.zeros(frame.images[0].shape, np.float32) if frame.depth_m is None else frame.depth_m
        lights = [np.repeat(image[..., None], 3, axis=2).astype(np.float32) for image in frame.images]
        seen = [walking.spoil(k, since_s, light, depth_m) for k, light in enumerate(lights)]
        images = tuple(light[..., 0].astype(np.uint8) for light, _ in seen)
        return replace(frame, images=images, depth_m=None if frame.depth_m is None else seen[0][1])

    return framed(met)(events, moment)


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
