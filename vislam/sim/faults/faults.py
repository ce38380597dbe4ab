"""What goes wrong with sensors, put into the values of any recording as it is read: nothing is written to disk.

A fault changes the stream of values, or what is stated of the cameras; the truth stays. Frames that come as tracks
(`points:`) have no images, so faults of images do not fit them; see `Fault.fits`.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from vislam.core.camera import Camera, Rig
from vislam.core.errors import UsageError
from vislam.core.messages import Array, Frame, ImageU8, ImuSample, MagSample
from vislam.core.recording import Recording, WrappedRecording
from vislam.sim.faults.disturbance import PERSON_M, in_window, person_box

Event = ImuSample | MagSample | Frame
Stream = Callable[[Iterator[Event], Rig, np.random.Generator], Iterator[Event]]

_NS = 1_000_000_000
_BEGIN_S = 5.0  # after the first frame: the run has begun by then, and was right so far
_GRAVITY_M_S2 = 9.81
_STEPS = (1.0, 0.4, 1.6, 0.7)  # gains, one after the other
_STEP_S = 1.5
_SALT = 0.05  # of the pixels
_AXIS = np.array([0.3, 0.8, 0.5]) / np.linalg.norm([0.3, 0.8, 0.5])
_VIBRATION = np.array([0.10, 0.12, 0.08, 3.0, 4.0, 5.0])  # amplitudes, rad/s and m/s^2 ...
_VIBRATION_HZ = 87.0  # ... of a propeller, beyond half the rate of many units, so that it is aliased
_ACCEL_RANGE_SHARE, _GYRO_RANGE_RAD_S = 0.05, 0.5


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: what it is in words, what a recording needs for it, and what it changes."""

    words: str
    needs: frozenset[str]  # of "imu", "images", "stereo", "depth"
    stream: Stream | None = None
    rig: Callable[[Rig], Rig] | None = None

    def fits(self, recording: Recording, has_images: bool) -> bool:
        """Whether a recording has what the fault is about."""
        has = {"imu": recording.imu_noise is not None, "images": has_images}
        has |= {"stereo": recording.rig.is_stereo, "depth": recording.rig.has_depth}
        return all(has[need] for need in self.needs)


class FaultyRecording(WrappedRecording):
    """A recording with a fault (see `vislam.core.recording.Recording`), from its first frame on, or only a piece of it.

    The same arguments give the same values.
    """

    def __init__(self, recording: Recording, fault: str = "", seed: int = 0, length_s: float | None = None) -> None:
        """Wrap a recording.

        Args:
            recording: any.
            fault: one of `FAULTS`; empty: none, only the piece is cut.
            seed: of what is random about the fault.
            length_s: the recording ends so long after its first frame; None: where it does.

        Raises:
            UsageError: no such fault.
        """
        if fault and fault not in FAULTS:
            raise UsageError(f"no fault '{fault}'; there are: {', '.join(FAULTS)}")
        super().__init__(recording)
        self._seed, self._length_s = seed, length_s
        self._fault = FAULTS[fault] if fault else Fault("nothing", frozenset())
        self.name = f"{recording.name} {fault}".strip()
        self.rig = recording.rig if self._fault.rig is None else self._fault.rig(recording.rig)

    def events(self, from_ns: int | None = None) -> Iterator[Event]:
        """Yield the values with their fault, all of them: what `from_ns` leaves out would change what is random."""
        events: Iterator[Event] = iter(self._recording.events())
        if self._length_s is not None:
            events = _cut(events, self._length_s)
        if self._fault.stream is not None:
            events = self._fault.stream(events, self._recording.rig, np.random.default_rng(self._seed))
        yield from events


def _cut(events: Iterable[Event], length_s: float) -> Iterator[Event]:
    end_ns: int | None = None
    for value in events:
        if end_ns is None and isinstance(value, Frame):
            end_ns = value.t_ns + round(length_s * _NS)
        if end_ns is not None and value.t_ns > end_ns:
            return
        yield value


# -- images ------------------------------------------------------------------------------------------------------------


def _frames(change: Callable[[Frame, float], Frame], events: Iterator[Event]) -> Iterator[Event]:
    """Yield events with every frame changed, by the time since the first one."""
    first_ns: int | None = None
    for value in events:
        if isinstance(value, Frame):
            first_ns = value.t_ns if first_ns is None else first_ns
            yield change(value, (value.t_ns - first_ns) / _NS)
        else:
            yield value


def _images(
    change: Callable[[ImageU8, float, int, np.random.Generator], ImageU8],
) -> Stream:
    """Return the fault that changes every image [H, W] of a frame, by the time since the first one and its camera."""

    def stream(events: Iterator[Event], _: Rig, rng: np.random.Generator) -> Iterator[Event]:
        def changed(frame: Frame, since_s: float) -> Frame:
            return replace(frame, images=tuple(change(im, since_s, k, rng) for k, im in enumerate(frame.images)))

        return _frames(changed, events)

    return stream


def _black(image: ImageU8, since_s: float, camera: int, _: np.random.Generator) -> ImageU8:
    return np.zeros_like(image) if in_window(since_s, _BEGIN_S, 5.0) else image


def _one_black(image: ImageU8, since_s: float, camera: int, rng: np.random.Generator) -> ImageU8:
    return image if camera == 0 else _black(image, since_s, camera, rng)


def _gain(image: ImageU8, since_s: float, camera: int, _: np.random.Generator) -> ImageU8:
    return np.clip(image * _STEPS[int(since_s / _STEP_S) % len(_STEPS)], 0.0, 255.0).astype(np.uint8)


def _blur(image: ImageU8, since_s: float, camera: int, _: np.random.Generator) -> ImageU8:
    if not in_window(since_s, _BEGIN_S, 3.0):
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 3.0), dtype=np.uint8)


def _salt(image: ImageU8, since_s: float, camera: int, rng: np.random.Generator) -> ImageU8:
    drawn = rng.random(image.shape, dtype=np.float32)
    return np.where(drawn < 0.5 * _SALT, 0, np.where(drawn > 1.0 - 0.5 * _SALT, 255, image)).astype(np.uint8)


def _frozen(events: Iterator[Event], _: Rig, __: np.random.Generator) -> Iterator[Event]:
    """Repeat one frame for 3 s, with stamps that go on, as a stuck driver does."""
    stuck: list[Frame] = []

    def changed(frame: Frame, since_s: float) -> Frame:
        if not in_window(since_s, _BEGIN_S, 3.0):
            return frame
        stuck.append(frame)
        return replace(stuck[0], t_ns=frame.t_ns, index=frame.index)

    return _frames(changed, events)


def _person(events: Iterator[Event], rig: Rig, rng: np.random.Generator) -> Iterator[Event]:
    """Put a person over a half of the image who walks to and fro 2 m away, dressed in a pattern."""
    size = (rig.cameras[0].height, rig.cameras[0].width)
    cloth = sum(cv2.resize(rng.random((size[0] // n, size[1] // n)), size[::-1]) for n in (4, 12, 36))
    cloth_u8 = (cloth * (255.0 / 3.0)).astype(np.uint8)
    shift_px = rig.cameras[0].fx * float(np.linalg.norm(rig.T_cam0_cam1[:3, 3])) / PERSON_M if rig.is_stereo else 0.0

    def changed(frame: Frame, since_s: float) -> Frame:
        if since_s < _BEGIN_S:
            return frame
        box = person_box(rig.cameras[0], 0.5, since_s)
        images = tuple(_dressed(im, cloth_u8, box, k * shift_px) for k, im in enumerate(frame.images))
        depth = None if frame.depth_m is None else frame.depth_m.copy()
        if depth is not None:
            left, right = np.clip((box[0, 0] + np.array([-1, 1]) * box[1, 0]).astype(int), 0, size[1])
            depth[:, left:right] = PERSON_M
        return replace(frame, images=images, depth_m=depth)

    return _frames(changed, events)


def _dressed(image: ImageU8, cloth: ImageU8, box: Array, shift_px: float) -> ImageU8:
    middle, half = box[0, 0] - shift_px, box[1, 0]
    left, right = np.clip([round(middle - half), round(middle + half)], 0, image.shape[1])
    begin = max(round(half - middle), 0)  # of the cloth, where the person stands half outside
    out = image.copy()
    out[:, left:right] = cloth[: image.shape[0], begin : begin + right - left]
    return out


def _rolling(events: Iterator[Event], rig: Rig, _: np.random.Generator, readout_s: float) -> Iterator[Event]:
    """Shift rows as the turn of the body during the readout does; the stamp is the middle row's."""
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


def _depth_scaled(events: Iterator[Event], _: Rig, __: np.random.Generator) -> Iterator[Event]:
    def changed(frame: Frame, _: float) -> Frame:
        return frame if frame.depth_m is None else replace(frame, depth_m=frame.depth_m * np.float32(1.05))

    return _frames(changed, events)


# -- frames as a whole -------------------------------------------------------------------------------------------------


def _dropped(events: Iterator[Event], _: Rig, rng: np.random.Generator) -> Iterator[Event]:
    for value in events:
        if not isinstance(value, Frame) or rng.random() >= 0.2:
            yield value


def _late(events: Iterator[Event], _: Rig, __: np.random.Generator, late_s: float) -> Iterator[Event]:
    """Stamp frames late; they come in the order of their stamps."""
    waiting: list[tuple[int, int, Frame]] = []
    for value in events:
        if isinstance(value, Frame):
            t_ns = value.t_ns + round(late_s * _NS)
            heapq.heappush(waiting, (t_ns, value.index, replace(value, t_ns=t_ns)))
            continue
        while waiting and waiting[0][0] <= value.t_ns:
            yield heapq.heappop(waiting)[2]
        yield value
    while waiting:
        yield heapq.heappop(waiting)[2]


def _swapped(events: Iterator[Event], _: Rig, __: np.random.Generator) -> Iterator[Event]:
    def changed(frame: Frame, _: float) -> Frame:
        tracks = frame.tracks
        if tracks is not None and tracks.right_px is not None:
            tracks = replace(tracks, pixels_px=tracks.right_px, right_px=tracks.pixels_px)
        return replace(frame, images=frame.images[::-1], tracks=tracks)

    return _frames(changed, events)


# -- inertial data -----------------------------------------------------------------------------------------------------


def _inertial(change: Callable[[Array, float, np.random.Generator], Array | None]) -> Stream:
    """Return the fault that changes every sample [6] (gyro, accel), by the time since the first frame; None: gone."""

    def stream(events: Iterator[Event], _: Rig, rng: np.random.Generator) -> Iterator[Event]:
        first_ns: int | None = None
        for value in events:
            if isinstance(value, Frame) and first_ns is None:
                first_ns = value.t_ns
            if not isinstance(value, ImuSample):
                yield value
                continue
            since_s = -1.0 if first_ns is None else (value.t_ns - first_ns) / _NS
            changed = change(np.concatenate([value.gyro_rad_s, value.accel_m_s2]), since_s, rng)
            if changed is not None:
                yield ImuSample(value.t_ns, changed[:3], changed[3:])

    return stream


def _noisy(events: Iterator[Event], _: Rig, rng: np.random.Generator) -> Iterator[Event]:
    """Add what makes the white noise eight times that of a unit of the EuRoC drone's class (an ADIS16448)."""
    sigmas = 8.0 * np.sqrt(200.0) * np.repeat([1.7e-4, 2.0e-3], 3)
    yield from _inertial(lambda six, _, r: six + sigmas * r.standard_normal(6))(events, _, rng)


def _thinned(events: Iterator[Event], _: Rig, __: np.random.Generator) -> Iterator[Event]:
    """Keep one sample in four, unfiltered, as a bus that is too slow does."""
    count = 0
    for value in events:
        count += isinstance(value, ImuSample)
        if not isinstance(value, ImuSample) or count % 4 == 0:
            yield value


def _shaken(six: Array, since_s: float, _: np.random.Generator) -> Array:
    phase = 2.0 * np.pi * _VIBRATION_HZ * since_s + np.arange(6)
    return six + _VIBRATION * np.sin(phase)


def _in_g(six: Array, _: float, __: np.random.Generator) -> Array:
    return np.concatenate([six[:3], six[3:] / _GRAVITY_M_S2])


def _flipped(six: Array, _: float, __: np.random.Generator) -> Array:
    return six * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])


def _gyro_flipped(six: Array, _: float, __: np.random.Generator) -> Array:
    return six * np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])


def _clipped(six: Array, _: float, __: np.random.Generator) -> Array:
    return np.concatenate([np.clip(six[:3], -_GYRO_RANGE_RAD_S, _GYRO_RANGE_RAD_S), six[3:]])


def _stretched(six: Array, _: float, __: np.random.Generator) -> Array:
    return np.concatenate([six[:3], (1.0 + _ACCEL_RANGE_SHARE) * six[3:]])


def _missing(six: Array, since_s: float, _: np.random.Generator) -> Array | None:
    return None if in_window(since_s, _BEGIN_S, 1.5) else six


def _stuck(events: Iterator[Event], _: Rig, __: np.random.Generator) -> Iterator[Event]:
    """Repeat one sample from `_BEGIN_S` on, with stamps that go on."""
    first_ns: int | None = None
    kept: ImuSample | None = None
    for value in events:
        if isinstance(value, Frame) and first_ns is None:
            first_ns = value.t_ns
        if isinstance(value, ImuSample) and first_ns is not None and value.t_ns - first_ns > _BEGIN_S * _NS:
            kept = value if kept is None else kept
            yield replace(kept, t_ns=value.t_ns)
        else:
            yield value


# -- what is stated of the cameras -------------------------------------------------------------------------------------


def _turned(rig: Rig, deg: float) -> Rig:
    """Return a rig that is stated to be turned on the body by `deg` degrees, about the body's origin."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.deg2rad(deg) * _AXIS).as_matrix()
    return Rig(rig.cameras, tuple(turn @ T for T in rig.T_body_cams), rig.has_depth)


def _focal(rig: Rig, factor: float) -> Rig:
    cameras = tuple(replace(camera, fx=camera.fx * factor, fy=camera.fy * factor) for camera in rig.cameras)
    return Rig(cameras, rig.T_body_cams, rig.has_depth)


def _needs(*names: str) -> frozenset[str]:
    return frozenset(names)


FAULTS: Mapping[str, Fault] = {
    "black": Fault("black images for 5 s", _needs("images"), _images(_black)),
    "one black": Fault("one camera of two is black for 5 s", _needs("images", "stereo"), _images(_one_black)),
    "gain": Fault("exposure jumps every 1.5 s", _needs("images"), _images(_gain)),
    "blur": Fault("3 s out of focus", _needs("images"), _images(_blur)),
    "salt": Fault("5 % of the pixels are salt and pepper", _needs("images"), _images(_salt)),
    "frozen": Fault("the same image again and again for 3 s", _needs("images"), _frozen),
    "person": Fault("a person over half of the image, from 5 s on", _needs("images"), _person),
    "rolling": Fault("a rolling shutter of 30 ms that is not stated", _needs("images", "imu"), partial(
        _rolling, readout_s=0.03)),
    "depth": Fault("depth 5 % too long", _needs("depth", "images"), _depth_scaled),
    "dropped": Fault("a fifth of the frames never arrives", _needs(), _dropped),
    "late": Fault("the camera's clock is 20 ms late", _needs("imu"), partial(_late, late_s=0.02)),
    "swapped": Fault("the cables of a stereo pair are swapped", _needs("stereo"), _swapped),
    "turned": Fault("the camera is stated 3 degrees wrong on the body", _needs("imu"), None, partial(_turned, deg=3.0)),
    "focal": Fault("focal length 2 % too long", _needs(), None, partial(_focal, factor=1.02)),
    "noise": Fault("white noise eight times that of the model", _needs("imu"), _noisy),
    "slow": Fault("a quarter of the inertial samples arrives", _needs("imu"), _thinned),
    "vibration": Fault("the vibration of a propeller, aliased", _needs("imu"), _inertial(_shaken)),
    "in g": Fault("the accelerometer is in g, not m/s^2", _needs("imu"), _inertial(_in_g)),
    "flipped": Fault("the y axis of the unit has the wrong sign", _needs("imu"), _inertial(_flipped)),
    "gyro flipped": Fault("the gyro's z axis has the wrong sign", _needs("imu"), _inertial(_gyro_flipped)),
    "clipped": Fault("the gyro saturates at 0.5 rad/s", _needs("imu"), _inertial(_clipped)),
    "stretched": Fault("the accelerometer reads 5 % too much", _needs("imu"), _inertial(_stretched)),
    "stuck": Fault("one inertial sample again and again", _needs("imu"), _stuck),
    "missing": Fault("no inertial sample for 1.5 s", _needs("imu"), _inertial(_missing)),
}  # fmt: skip
