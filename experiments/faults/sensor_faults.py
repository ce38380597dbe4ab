"""What goes wrong with sensors, put into the values of any recording as it is read: nothing is written to disk.

A fault changes the stream of values, or what is stated of the cameras; the truth stays. Frames that come as tracks
(`points:`) have no images, so faults of images do not fit them; see `Fault.fits`.
"""

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, takewhile

import numpy as np
from faults import camera_faults as cam
from faults import inertial_faults as imu
from faults.fault_moment import Event, Moment, Stream, again, glued, gone, held, stepped
from scipy.spatial.transform import Rotation

from vislam.core import Frame, ImuSample, Problems, Recording, Rig, UsageError
from vislam.core.camera import CameraSigmas
from vislam.core.recording import WrappedRecording
from vislam.core.streams import StreamJudge
from vislam.trajectory import Trajectory

_NS = 1_000_000_000
_BEGIN_S = 5.0  # after the first frame: the run has begun by then, and was right so far
_EVER_S = 1e6  # longer than a recording
_AXIS = np.array([0.3, 0.8, 0.5]) / np.linalg.norm([0.3, 0.8, 0.5])


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: what it is in words, what a recording needs for it, and what it changes.

    Needs are some of "imu", "images", "stereo", "depth" and "scale" (stereo or depth).
    """

    words: str
    needs: frozenset[str]
    stream: Stream | None = None
    lasts_s: tuple[float, float] | None = None  # least and most; None: it is there from the beginning to the end
    named: tuple[str, ...] = ()  # events that it is, as "imu0 hole"; "?": there is no kind for it yet
    spares: frozenset[str] | None = None  # needs of a recording whose other values suffice; None: they never do
    steps_s: float = 0.0  # by which frames after it are stamped later
    rig: Callable[[Rig], Rig] | None = None

    def fits(self, recording: Recording, has_images: bool) -> bool:
        """Whether a recording has what the fault is about."""
        return self.needs <= _has(recording) | ({"images"} if has_images else set())

    def spared(self, recording: Recording) -> bool:
        """Whether what is left of a recording suffices for the estimate."""
        return self.spares is not None and self.spares <= _has(recording)


def _has(recording: Recording) -> set[str]:
    stereo, depth = recording.rig.is_stereo, recording.rig.has_depth
    has = {"imu": recording.imu_noise is not None, "stereo": stereo, "depth": depth, "scale": stereo or depth}
    return {name for name, there in has.items() if there}


class FaultyRecording(WrappedRecording):
    """A recording with a fault (see `vislam.core.recording.Recording`), or only a piece of it.

    Stamps that a fault disordered are judged as readers of files do it. The same arguments give the same values.

    Attributes:
        fault: that is put in.
        from_s, to_s: when it is there, in seconds since the first frame.
    """

    def __init__(
        self, recording: Recording, fault: str = "", seed: int = 0, length_s: float | None = None,
        from_s: float = _BEGIN_S,
    ) -> None:  # fmt: skip
        """Wrap a recording.

        Args:
            recording: any.
            fault: one of `FAULTS`; empty: none, only the piece is cut.
            seed: of what is random about the fault, its length too.
            length_s: the recording ends so long after its first frame; None: where it does.
            from_s: when the fault begins, after the first frame, unless it is there from the beginning.

        Raises:
            UsageError: no such fault.
        """
        if fault and fault not in FAULTS:
            raise UsageError(f"no fault '{fault}'; there are: {', '.join(FAULTS)}")
        super().__init__(recording)
        self._seed, self._length_s, self._first_ns = seed, length_s, 0
        self.fault = FAULTS[fault] if fault else Fault("nothing", frozenset())
        least_s, most_s = self.fault.lasts_s or _ON
        self.from_s = from_s if self.fault.lasts_s else -_EVER_S
        self.to_s = self.from_s + np.random.default_rng([seed]).uniform(least_s, most_s)
        self.name = f"{recording.name} {fault}".strip()
        self.rig = recording.rig if self.fault.rig is None else self.fault.rig(recording.rig)

    def events(self, from_ns: int | None = None) -> Iterator[Event]:
        """Yield the values with their fault, all of them: what `from_ns` leaves out would change what is random."""
        events: Iterator[Event] = iter(self._recording.events())
        before: list[Event] = []
        while not (before and isinstance(before[-1], Frame)) and (value := next(events, None)) is not None:
            before.append(value)
        self._first_ns = before[-1].t_ns if before else 0
        end_ns = self._ns(_EVER_S if self._length_s is None else self._length_s)
        events = takewhile(lambda value: value.t_ns <= end_ns, chain(before, events))
        if self.fault.stream is None:
            return events
        moment = Moment(self._ns(self.from_s), self._ns(self.to_s), np.random.default_rng(self._seed), self.rig)
        self.problems = judged = Problems()
        judged.update(self._recording.problems)
        noise = self._recording.imu_noise
        imu_hz = 0.0 if noise is None else noise.rate_hz or 0.0
        judged.judges = {n: StreamJudge(n, rate_hz=hz, recorded=True) for n, hz in (("imu0", imu_hz), ("cam0", 0.0))}
        return _as_read(self.fault.stream(events, moment), judged.judges)

    def truth(self) -> Trajectory | None:
        """Return the truth by the clock of the frames; what they leave out is not in it. After `events`."""
        truth = super().truth()
        if truth is None or not self.fault.steps_s:
            return truth
        from_ns, t_ns = self._ns(self.from_s), truth.t_ns + round(self.fault.steps_s * _NS)
        late = (truth.t_ns >= from_ns) & (t_ns >= from_ns)
        early = truth.t_ns < from_ns
        poses = truth.T_world_body
        return Trajectory(np.concatenate([truth.t_ns[early], t_ns[late]]), np.concatenate([poses[early], poses[late]]))

    def _ns(self, since_s: float) -> int:
        return self._first_ns + round(since_s * _NS)


def _as_read(events: Iterator[Event], judges: Mapping[str, StreamJudge]) -> Iterator[Event]:
    """Yield values in the order of their stamps, without those that do not advance; tear frames where a clock stepped.

    As `vislam.datasets` does it, which this room does not know.
    """
    waiting: dict[str, deque[Event]] = {}
    last_ns: int | None = None
    for value in events:
        stream = "cam0" if isinstance(value, Frame) else "imu0" if isinstance(value, ImuSample) else "mag0"
        if stream in judges and not judges[stream].takes(value.t_ns):
            continue
        if isinstance(value, Frame):
            steps_ns = judges[stream].steps_ns
            is_torn = last_ns is not None and any(last_ns <= step_ns < value.t_ns for step_ns in steps_ns)
            last_ns, value = value.t_ns, replace(value, follows_step=is_torn)  # noqa: PLW2901
        waiting.setdefault(stream, deque()).append(value)
        while all(waiting.values()):
            yield min(waiting.values(), key=lambda some: some[0].t_ns).popleft()
    yield from heapq.merge(*waiting.values(), key=lambda value: value.t_ns)


def _turned(rig: Rig, deg: float) -> Rig:
    """Return a rig that is stated to be turned on the body by `deg` degrees, about the body's origin."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.deg2rad(deg) * _AXIS).as_matrix()
    return Rig(rig.cameras, tuple(turn @ T for T in rig.T_body_cams), rig.has_depth)


def _focal(rig: Rig, factor: float) -> Rig:
    cameras = tuple(replace(camera.with_focal(factor), sigmas=CameraSigmas()) for camera in rig.cameras)
    return Rig(cameras, rig.T_body_cams, rig.has_depth)


def _needs(*names: str) -> frozenset[str]:
    return frozenset(names)


_ANY, _IMU, _IMAGES, _PAIR = _needs(), _needs("imu"), _needs("images"), _needs("images", "stereo")
_SCALE, _RGBD = _needs("scale"), _needs("images", "depth")
_ON, _LONG = (2 * _EVER_S, 2 * _EVER_S), (1.0, 3.0)
_BOTH_BACK, _BOTH_HOLE = ("imu0 step back", "cam0 step back"), ("imu0 hole", "cam0 hole")

# what is there from the beginning to the end: calibration, units, mounting
_THROUGHOUT: Mapping[str, Fault] = {
    "rolling": Fault("a rolling shutter of 30 ms that is not stated", _needs("images", "imu"), partial(
        cam.rolling, readout_s=0.03)),
    "depth": Fault("depth 5 % too long", _RGBD, cam.LONG_DEPTH),
    "dropped": Fault("a fifth of the frames never arrives", _ANY, cam.some_dropped(0.2)),
    "late": Fault("the camera's clock is 20 ms late", _IMU, stepped(Frame, 0.02)),
    "swapped": Fault("the cables of a stereo pair are swapped", _needs("stereo"), cam.SWAPPED),
    "turned": Fault("the camera is stated 3 degrees wrong on the body", _IMU, rig=partial(_turned, deg=3.0)),
    "focal": Fault("focal length 2 % too long", _ANY, rig=partial(_focal, factor=1.02)),
    "slow": Fault("a quarter of the inertial samples arrives", _IMU, imu.thinned(4)),
    "in g": Fault("the accelerometer is in g, not m/s^2", _IMU, imu.IN_G),
    "flipped": Fault("the y axis of the unit has the wrong sign", _IMU, imu.scaled(1, -1, 1, 1, -1, 1)),
    "gyro flipped": Fault("the gyro's z axis has the wrong sign", _IMU, imu.scaled(1, 1, -1, 1, 1, 1)),
    "stretched": Fault("the accelerometer reads 5 % too much", _IMU, imu.STRETCHED),
}  # fmt: skip

# what begins at some moment
BREAKS: Mapping[str, Fault] = {
    "person": Fault("a person over half of the image", _IMAGES, cam.person, _ON, ("cam0 moving",)),
    **{f"imu hole {s}": Fault(f"no inertial sample for {s} s", _IMU, gone(ImuSample), (s, s), ("imu0 hole",), _ANY)
       for s in (0.3, 1.0, 3.0)},
    "camera hole 0.3": Fault("no frame for 0.3 s", _ANY, gone(Frame), (0.3, 0.3), ("cam0 hole",), _IMU),
    **{f"camera hole {s}": Fault(f"no frame for {s} s", _ANY, gone(Frame), (s, s), ("cam0 hole",)) for s in (1.0, 3.0)},
    "hole": Fault("nothing arrives", _IMU, gone(object), _LONG, _BOTH_HOLE),
    "all back 5": Fault("all clocks step back by 5 s", _IMU, stepped(object, -5.0), _ON, _BOTH_BACK, None, -5.0),
    "all back 1": Fault("all clocks step back by 1 s", _IMU, stepped(object, -1.0), _ON, _BOTH_BACK, None, -1.0),
    "all forth": Fault("all clocks step forth by 5 s", _IMU, stepped(object, 5.0), _ON, _BOTH_HOLE, None, 5.0),
    "camera back": Fault("the camera's clock steps back by 1 s", _ANY, stepped(Frame, -1.0), _ON,
        ("cam0 step back",), None, -1.0),
    "camera forth": Fault("the camera's clock steps forth by 1 s", _ANY, stepped(Frame, 1.0), _ON, ("cam0 hole",),
        None, 1.0),
    "imu back": Fault("the IMU's clock steps back by 1 s", _IMU, stepped(ImuSample, -1.0), _ON,
        ("imu0 step back",), _SCALE),
    "imu forth": Fault("the IMU's clock steps forth by 1 s", _IMU, stepped(ImuSample, 1.0), _ON,
        ("imu0 hole",), _SCALE),
    "again": Fault("the log is played twice", _ANY, again, _ON, ("cam0 looped",)),
    "glued": Fault("two logs as one, stamps go on as if they were", _ANY, glued, (2.0, 2.0), ("cam0 ?",), None, -2.0),
    "ended": Fault("the end is missing", _ANY, gone(object), _ON, (), _ANY),
    "stuck": Fault("one inertial sample again and again", _IMU, held(
        ImuSample, lambda first, row: replace(first, t_ns=row.t_ns)), _ON, ("imu0 stuck",), _SCALE),
    "axis stuck": Fault("the gyro's z axis repeats one value", _IMU, held(ImuSample, lambda first, row: replace(
        row, gyro_rad_s=np.append(row.gyro_rad_s[:2], first.gyro_rad_s[2]))), _ON, ("imu0 stuck",), _SCALE),
    "twice": Fault("half of the inertial rows come twice", _IMU, imu.TWICE, _LONG, ("imu0 duplicate",), _ANY),
    "repeated": Fault("every other sample is the one before", _IMU, imu.TWINS, _LONG, (), _SCALE),
    "disordered": Fault("one inertial row in fifty is late", _IMU, imu.DISORDERED, _ON, ("imu0 late",), _ANY),
    "no number": Fault("inertial rows are NaN", _IMU, imu.NO_NUMBER, _LONG, ("imu0 unusable",), _ANY),
    "bursts": Fault("inertial rows come in bursts, stamped then", _IMU, imu.BURSTS, _ON, ("imu0 burst",), _SCALE),
    "coarse": Fault("inertial stamps are rounded to 10 ms", _IMU, imu.COARSE, _ON, ("imu0 duplicate",), _SCALE),
    "halved": Fault("every other inertial sample is missing", _IMU, imu.thinned(2), _ON, ("imu0 wrong rate",), _ANY),
    "clipped": Fault("the gyro saturates at 0.5 rad/s", _IMU, imu.CLIPPED, _ON, ("imu0 clipped",), _SCALE),
    "noise": Fault("white noise eight times that of the model", _IMU, imu.NOISY, _ON),
    "vibration": Fault("the vibration of a propeller, aliased", _IMU, imu.SHAKEN, _ON),
    "spikes": Fault("one inertial sample in a hundred is a spike", _IMU, imu.SPIKES, _ON, ("imu0 spike",), _SCALE),
    "reconnected": Fault("the IMU comes back with two axes turned", _IMU, imu.scaled(-1, -1, 1, -1, -1, 1), _ON,
        ("imu0 contradicting",), _SCALE),
    "now in g": Fault("the IMU comes back with another unit", _IMU, imu.IN_G, _ON, ("imu0 contradicting",), _SCALE),
    "black": Fault("black images", _IMAGES, cam.BLACK, _LONG, ("cam0 dark",)),
    "white": Fault("white images", _IMAGES, cam.WHITE, _LONG, ("cam0 dark",)),
    "covered": Fault("a hand on the lens", _IMAGES, cam.COVERED, _LONG, ("cam0 dark",)),
    "frozen": Fault("the same image again and again", _IMAGES, held(Frame, cam.as_before), _LONG, ("cam0 repeated",)),
    "now and then": Fault("one image in ten repeats the one before", _IMAGES, cam.HICCUPS, _ON, (), _ANY),
    "salt": Fault("5 % of the pixels are salt and pepper", _IMAGES, cam.SALTED, _ON),
    "gain": Fault("exposure jumps every 1.5 s", _IMAGES, cam.GAIN, _ON, (), _ANY),
    "blur": Fault("out of focus", _IMAGES, cam.BLURRED, _LONG, ("cam0 blurred",)),
    "dimmed": Fault("exposure falls to 40 %", _IMAGES, cam.DIMMED, _ON, (), _ANY),
    "half dropped": Fault("half of the frames never arrives", _ANY, cam.some_dropped(0.5), _LONG, (), _IMU),
    "one black": Fault("one camera of two is black", _PAIR, cam.ONE_BLACK, _LONG, ("cam1 dark",), _IMU),
    "one frozen": Fault("one camera of two repeats one image", _PAIR, held(Frame, lambda first, frame: replace(
        frame, images=(frame.images[0], *first.images[1:]))), _LONG, ("cam1 repeated",), _IMU),
    "one gone": Fault("one camera of two sends nothing", _PAIR, cam.ONE_GONE, _LONG, ("cam1 hole",), _IMU),
    "crossed": Fault("left and right are exchanged", _needs("stereo"), cam.SWAPPED, _ON, ("cam0 ?",)),
    "no depth": Fault("no pixel has depth", _RGBD, cam.NO_DEPTH, _LONG, ("depth0 dark",)),
    "frozen depth": Fault("the same depth image again and again", _RGBD, held(
        Frame, lambda first, frame: replace(frame, depth_m=first.depth_m)), _LONG, ("depth0 repeated",)),
}  # fmt: skip

FAULTS: Mapping[str, Fault] = {**_THROUGHOUT, **BREAKS}
