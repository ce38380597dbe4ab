"""The virtual cart as a source of a live run: `vislam live --source virtual-cart`."""

import math
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from vislam.config import USUAL_SLIP_M_S, Config, Gy85Config
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.messages import Array, Frame, ImuSample, MagSample
from vislam.core.readings import Reading
from vislam.hw.imu_source import InertialSource
from vislam.hw.source import FrameSource, ReadingSource
from vislam.imu import ImuNoise
from vislam.live.driving.pursuit import PathFollower
from vislam.live.epoch import Epoch
from vislam.live.frames import NoCamera
from vislam.live.processes.child import Life
from vislam.live.reading_source import Heard, refuse_unread
from vislam.live.virtual.imu import open_board, open_gy85, run_board
from vislam.live.virtual.motion import Drive, Follower, Segment, locate
from vislam.live.virtual.pilot import CommandReader
from vislam.live.virtual.place import BODY_HEIGHT_M, PlaceOptions, course, virtual_rig
from vislam.live.virtual.virtual_camera import VirtualCamera, run_camera
from vislam.live.wire.slot import remove
from vislam.sensors import BodyState, SensorSetup
from vislam.sensors.simulated import slipping, within
from vislam.trajectory import Trajectory

_NS = 1_000_000_000
_REST_S = 4.0  # before it drives: gravity and gyro bias are found
_STEP_S = 0.01
_TRUTH_STEP_S = 0.01
_COLUMNS = 8
_BRIDGE_HZ = 400.0  # of the sketch
_FRAMES_MISSED = 4  # in a row: then vision counts as lost, however slow the camera is
# the data sheets' noise, with what quantisation to 3.9 mg and 0.07 deg/s adds
NOISE = ImuNoise(5.4e-4, 7.0e-3, 3.0e-5, 4.0e-4, 200.0, gyroscope_scale_sigma=0.0, accelerometer_scale_sigma=0.0)
_KNOWN_S = 5.0  # of the motion; a later query misses what was before


class VirtualReadings(Heard):
    """Satisfies `ReadingSource`; own variables are drawn by their sigmas, as of a recording."""

    def __init__(self, cart: str, epoch: Epoch, setup: SensorSetup, seed: int) -> None:
        """Put the simulated sensors of a setup on the cart whose segments are published under a name."""
        super().__init__(tuple(setup.simulated_hz))
        self._follower, self._epoch, self._setup = Follower.waiting(cart), epoch, setup
        self._rngs, self._own = {}, dict[str, Array]()
        self._is_placed = dict.fromkeys(setup.simulated_hz, False)
        for number, name in enumerate(setup.simulated_hz):
            self._rngs[name] = np.random.default_rng([seed, number])
            self._own[name] = setup.suite.drawn_own(name, self._rngs[name])
        self._drawn = dict.fromkeys(setup.simulated_hz, 0)  # how many of each, those that were missed included
        self._missed = dict.fromkeys(setup.simulated_hz, 0)

    def read(self) -> list[Reading]:
        """Return the readings whose time has come; see `ReadingSource`."""
        begin_ns = self._epoch.begin_ns()
        now_s = (time.monotonic_ns() - begin_ns) / _NS
        out = []
        for name, rate_hz in self._setup.simulated_hz.items():
            while (t_s := self._drawn[name] / rate_hz) <= now_s:
                self._drawn[name] += 1
                if t_s < now_s - _KNOWN_S:
                    self._missed[name] += 1
                    continue
                body = body_at(self._follower.at(t_s), begin_ns + round(t_s * _NS))
                sensor, faults = self._setup.sensors[name], self._setup.simulated_faults[name]
                if not self._is_placed[name]:  # about where it begins: where it will drive is unknown yet
                    self._own[name] = sensor.about(body.position_m[None], self._own[name])
                    self._is_placed[name] = True
                values = sensor.draw(body, self._own[name].copy(), self._rngs[name])
                if within(t_s, faults.slips):
                    values = slipping(sensor, values, faults)
                out.append(Reading(name, body.t_ns, values))
        self.hear(out)
        return out

    def counters(self) -> dict[str, dict[str, int]]:
        """Return how many readings of each sensor were drawn, and how many were not asked for in time."""
        return {name: {"drawn": count, "missed": self._missed[name]} for name, count in self.count.items()}


def body_at(segment: Segment, t_ns: int) -> BodyState:
    """Return the body at a time, above the middle of the axle, level."""
    T, none = segment.T_world_body(BODY_HEIGHT_M), np.zeros(3)
    ahead = np.array([math.cos(segment.yaw_rad), math.sin(segment.yaw_rad), 0.0])
    rate = np.array([0.0, 0.0, segment.rate_rad_s])
    return BodyState(t_ns, T[:3, :3], T[:3, 3], segment.speed_m_s * ahead, none, none, rate)


class VirtualCart:
    """Satisfies `LiveSource`."""

    def __init__(self, options: PlaceOptions, gravity_m_s2: float = 9.81) -> None:
        """Choose names for what its processes share; nothing starts yet."""
        self.name = "virtual cart"
        self.rig = virtual_rig(options)
        self.is_mag_calibrated = True
        self.imu_noise: ImuNoise | None = replace(NOISE, rate_hz=_BRIDGE_HZ) if options.bridge else NOISE
        self.frame_count = 0
        self.problems: dict[str, int] = {}
        self.duration_s: float | None = None
        self.options = options
        self._gravity_m_s2 = gravity_m_s2
        self._epoch = Epoch()
        self._shared = f"vislam-virtual-{os.getpid()}-{id(self):x}"
        self._truth = Path(tempfile.gettempdir()) / f"{self._shared}.truth"
        self._port = self._truth.with_suffix(".tty")

    def settings(self, config: Config) -> Config:
        """Return the settings with what this cart knows of itself, see `cart_settings`."""
        return cart_settings(config, self.rig, self.options.camera_hz)

    @property
    def command_name(self) -> str:
        """Name of the shared memory in which commands are looked for."""
        return f"{self._shared}-command"

    def check(self) -> None:
        """Do nothing: its sensors are simulated."""

    def inertial(self) -> Callable[[], InertialSource]:
        """Return what opens its GY-85, or the port that this is behind."""
        if self.options.bridge:
            return partial(open_board, self._port)
        config = replace(Gy85Config(), bus="/dev/i2c-virtual", rate_hz=NOISE.rate_hz)
        return partial(
            open_gy85, f"{self._shared}-cart", self._epoch, config, self.options.seed, self._gravity_m_s2,
            self.options.imu_out,
        )  # fmt: skip

    def cameras(self) -> Callable[[], FrameSource]:
        """Return what opens its camera."""
        if self.rig.is_blind:
            return NoCamera
        return partial(VirtualCamera, f"{self._shared}-camera")

    def readings(self, setup: SensorSetup) -> Callable[[], ReadingSource]:
        """Return what draws further sensors while it drives; raises UsageError for one without `simulated_hz`."""
        asked = "the virtual cart draws its sensors; give simulated_hz, and neither file nor port"
        refuse_unread(setup, {name: 0 for name in setup.simulated_hz if name not in setup.ports}, asked)
        return partial(VirtualReadings, f"{self._shared}-cart", self._epoch, setup, self.options.seed)

    def helpers(self) -> dict[str, Callable[[Life], None]]:
        """Return the processes that move it and that render."""
        names = f"{self._shared}-cart", self._epoch, self.options
        found: dict[str, Callable[[Life], None]] = {
            "cart": partial(_run_cart, shared=names, command_name=self.command_name, truth=self._truth)
        }
        if not self.rig.is_blind:
            found["camera"] = partial(
                run_camera, name=f"{self._shared}-camera", cart=names[0], epoch=self._epoch, options=self.options
            )
        if self.options.bridge:
            found["board"] = partial(
                run_board, port=self._port, cart=names[0], epoch=self._epoch, gravity_m_s2=self._gravity_m_s2,
                seed=self.options.seed, outages=self.options.imu_out, faults=self.options.imu_fault,
            )  # fmt: skip
        return found

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Raise DataError: live sensors cannot be read twice."""
        raise DataError("the virtual cart is live; `vislam simulate` makes recordings")

    def truth(self) -> Trajectory | None:
        """Return where it was, a hundred times a second, as far as it has driven."""
        segments = true_segments(self._truth)
        if not segments:
            return None
        t_s = np.arange(0.0, segments[-1].t_s, _TRUTH_STEP_S)
        poses = np.array([locate(segments, float(t)).T_world_body(BODY_HEIGHT_M) for t in t_s]).reshape(-1, 4, 4)
        return Trajectory(self._epoch.begin_ns() + np.round(t_s * _NS).astype(np.int64), poses)

    def true_path(self) -> list[Segment]:
        """Return the true motion so far."""
        return true_segments(self._truth)

    def close(self) -> None:
        """Remove what its processes wrote and shared; may be called twice."""
        self._truth.unlink(missing_ok=True)
        self._port.unlink(missing_ok=True)
        for part in ("cart", "camera"):
            remove(f"{self._shared}-{part}")


def cart_settings(config: Config, rig: Rig, camera_hz: float) -> Config:
    """Return the settings with what the virtual cart knows of itself: wheels, and how high its one camera is."""
    config = replace(config, machine=replace(config.machine, slip_sigma_m_s=USUAL_SLIP_M_S))
    if rig.is_blind:
        return config
    timeout_s = max(config.live.vision_timeout_s, _FRAMES_MISSED / camera_hz)
    config = replace(config, live=replace(config.live, vision_timeout_s=timeout_s))
    front = config.frontend
    if rig.has_depth or front.mode not in ("auto", "planar") or front.planar.height_m is not None:
        return config
    height_m = BODY_HEIGHT_M + float(rig.T_body_cams[0][2, 3])
    return replace(config, frontend=replace(front, planar=replace(front.planar, height_m=height_m)))


def true_segments(path: Path) -> list[Segment]:
    """Read the segments that the cart's process wrote, whole ones only."""
    if not path.exists():
        return []
    data = path.read_bytes()
    rows = np.frombuffer(data[: len(data) - len(data) % (8 * _COLUMNS)]).reshape(-1, _COLUMNS)
    return [Segment(*row) for row in rows.tolist()]


def _run_cart(life: Life, shared: tuple[str, Epoch, PlaceOptions], command_name: str, truth: Path) -> None:
    """Move the cart until the run ends, and write down how."""
    name, epoch, options = shared
    follower = PathFollower(course(options.world, options.laps))
    commands = CommandReader(command_name)
    drive = Drive(name, *options.start)
    try:
        with truth.open("wb") as out:
            out.write(_bytes(drive.at(0.0)))
            if not life.ready():
                return
            begin_ns = epoch.begin_ns()
            while not life.stopped:
                now_s = (time.monotonic_ns() - begin_ns) / _NS
                speed, rate = 0.0, 0.0
                if options.steered:
                    speed, rate = commands.newest(now_s)
                elif now_s > _REST_S and options.laps > 0:
                    here = drive.at(now_s)
                    speed, rate, _ = follower.command(here.x_m, here.y_m, here.yaw_rad)
                for segment in drive.advance(max(now_s, 0.0), speed, rate):
                    out.write(_bytes(segment))
                out.flush()
                time.sleep(_STEP_S)
    finally:
        drive.close()


def _bytes(s: Segment) -> bytes:
    values = s.t_s, s.x_m, s.y_m, s.yaw_rad, s.speed_m_s, s.rate_rad_s, s.accel_m_s2, s.angular_accel_rad_s2
    return np.array(values).tobytes()
