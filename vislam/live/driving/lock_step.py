"""The virtual cart driven to goals in time that passes only as the pipeline takes what the cart senses.

The reference pipeline on one thread, the filter that a live run publishes, the driver and the cart take turns; the
answer depends on the seed alone, not on how fast the machine is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vislam.config import Config, Gy85Config
from vislam.core.errors import DataError, UsageError
from vislam.core.memory import SlamMemory
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.core.progress import Progress, silent
from vislam.ekf import Hint
from vislam.hw.emulator import SteppedClock
from vislam.hw.health import Health
from vislam.imu import ImuNoise
from vislam.live.corrections import Corrections
from vislam.live.driving.driver import Driver
from vislam.live.fast import FastPath
from vislam.live.notices import MapMoved
from vislam.live.virtual.cart import NOISE, cart_settings
from vislam.live.virtual.imu import VirtualGy85
from vislam.live.virtual.motion import Drive, Segment, locate
from vislam.live.virtual.place import BODY_HEIGHT_M, PlaceOptions, virtual_rig
from vislam.live.virtual.virtual_camera import Eye
from vislam.live.wire.published_pose import PublishedPose
from vislam.pipeline.settings import derived
from vislam.pipeline.steps import Step
from vislam.runs import Run, begun, imu_noise
from vislam.runs.folder import MapChoice
from vislam.runs.session import SessionWriter
from vislam.slam import Slam
from vislam.trajectory import Trajectory

_NS = 1_000_000_000
_READ_S = 0.005
_COMMAND_NS = 20_000_000
_TRUTH_STEP_S = 0.02
_REST_S = 0.5  # after the last goal


def drive(
    cart: LockStepCart, driver: Driver, config: Config, out: Path, source: str, command: list[str],
    base: MapChoice | None = None, progress: Progress = silent,
) -> dict[str, Any]:  # fmt: skip
    """Drive until the driver has no goal left, write the run into a prepared folder, and return its metrics.

    Args:
        cart: which has not been driven yet.
        driver: with its goals.
        config: of the run.
        out: the folder.
        source: the cart as it was asked for.
        command: as it was typed.
        base: the map of another run, to begin in.
        progress: as `Run.execute` calls it.

    Raises:
        VislamError: as a run of a recording.
    """
    config = cart_settings(config, cart.rig, cart.options.camera_hz)
    config = derived(config, cart.rig, imu_noise(config.imu, cart.imu_noise))
    return begun(cart, config, out, source, command, base, partial(_DrivenRun, cart, config, out, driver)).execute(
        progress
    )


class LockStepCart:
    """Satisfies `Recording`: what the cart senses, as it is driven by who sits at the helm."""

    def __init__(self, options: PlaceOptions, gravity_m_s2: float) -> None:
        """Put the cart at its start.

        Raises UsageError for options that there are in real time only.
        """
        if options.bridge or options.steered or options.rig == "none":
            raise UsageError("vislam drive needs a camera, and has neither bridge nor steered: leave them off")
        self.name = "virtual cart, driven"
        self.rig = virtual_rig(options)
        self.imu_noise: ImuNoise | None = NOISE
        self.frame_count = 0
        self.problems: dict[str, int] = {}
        self.segments: list[Segment] = []  # the true motion so far
        self.begin_ns = 0
        self.helm: Helm | None = None
        self.options, self._gravity_m_s2 = options, gravity_m_s2

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Yield what the cart senses until the helm has no goal left; what it decides depends on what it took."""
        helm = self.helm
        if helm is None or from_ns is not None:
            raise DataError("a drive cannot be read again: its way was decided on the way; drive again")
        drive, clock, eye = Drive(None, *self.options.start), SteppedClock(), Eye(self.options)
        self.segments = [drive.at(0.0)]
        begin_ns = self.begin_ns = clock.now_ns()
        chips = Gy85Config(bus="/dev/i2c-virtual", rate_hz=NOISE.rate_hz)
        options = self.options
        board = VirtualGy85(drive, lambda: begin_ns, chips, options.seed, self._gravity_m_s2, options.imu_out, clock)
        index, commanded_ns, end_ns, command = 1, 0, None, (0.0, 0.0)
        with closing(board):
            while end_ns is None or clock.now_ns() < end_ns:
                for value in board.read(_READ_S):
                    while begin_ns + round(index * _NS / options.camera_hz) < value.t_ns:
                        yield from self._seen(eye, drive, index)
                        index += 1
                    helm.hear(value)  # first, as in a live run: corrections are never ahead of samples
                    yield value
                    helm.hand_on_hint()
                now_ns = clock.now_ns()
                if now_ns - commanded_ns >= _COMMAND_NS:
                    commanded_ns, command = now_ns, helm.command(now_ns, board.health)
                    if end_ns is None and helm.driver.is_over:
                        end_ns = now_ns + round(_REST_S * _NS)
                self.segments += drive.advance((now_ns - begin_ns) / _NS, *command)

    def _seen(self, eye: Eye, drive: Drive, index: int) -> Iterator[Frame]:
        """Yield a frame, unless the camera is away."""
        t_s = index / self.options.camera_hz
        if not any(begin <= t_s < end for begin, end in self.options.camera_out):
            grey, depth_m = eye.see(drive.at(t_s))
            stamp_ns = self.begin_ns + round((t_s + self.options.camera_delay_s) * _NS)
            yield Frame(stamp_ns, index, (grey,), None, depth_m)

    def truth(self) -> Trajectory | None:
        """Return where it was, fifty times a second."""
        if not self.segments:
            return None
        t_s = np.arange(0.0, self.segments[-1].t_s, _TRUTH_STEP_S)
        poses = np.array([locate(self.segments, float(t)).T_world_body(BODY_HEIGHT_M) for t in t_s])
        return Trajectory(self.begin_ns + np.round(t_s * _NS).astype(np.int64), poses.reshape(-1, 4, 4))


class Helm:
    """The filter that is published, as in a live run, and the driver who has nothing but that and the map."""

    def __init__(self, slam: Slam, config: Config, noise: ImuNoise, cart: LockStepCart, driver: Driver) -> None:
        """Sit down; `slam` is the pipeline that the cart's values go to."""
        self.driver = driver
        self._slam = slam
        self._fast = FastPath(config, noise, cart.rig.T_body_cam0, self._take, is_mag_calibrated=True)
        self._corrections = Corrections(slam.front)
        self._pose: PublishedPose | None = None
        self._hint: Hint | None = None

    def begin_in_map(self) -> None:
        """Know that the cart is in a map, but not where."""
        self._fast.correct(MapMoved(0, np.eye(4), is_in_map=False))

    def hear(self, value: ImuSample | MagSample) -> None:
        """Take a sample that goes to the pipeline next."""
        self._hint = self._fast.add(value)

    def hand_on_hint(self) -> None:
        """Give the pipeline's filter what this one found out with the newest sample."""
        if self._hint is not None:
            self._slam.front.add_hint(self._hint)

    def see(self, step: Step) -> None:
        """Take what the pipeline made of a frame."""
        for message in self._corrections.of_step(step.front):
            self._fast.correct(message)
        back = self._slam.back
        for keyframe in step.keyframes:
            update = keyframe.update
            self._fast.correct(MapMoved(update.revision, update.T_map_odom, update.submaps.is_joined))
        if step.keyframes and back is not None and back.mapper is not None:
            self.driver.see(back.mapper.drive())

    def command(self, now_ns: int, look: Callable[[], Health]) -> tuple[float, float]:
        """Return speed and turn rate to ask of the wheels."""
        self._fast.publish(now_ns, look)
        return self.driver.command(self._pose, now_ns)

    def _take(self, pose: PublishedPose) -> None:
        self._pose = pose


class _DrivenRun(Run):
    """A run whose recording depends on what comes of it."""

    def __init__(
        self, cart: LockStepCart, config: Config, out: Path, driver: Driver, session: SessionWriter
    ) -> None:  # fmt: skip
        super().__init__(cart, config, out, session)
        assert isinstance(self.slam, Slam) and self.noise is not None
        self._helm = cart.helm = Helm(self.slam, config, self.noise, cart, driver)

    def begin_in_map(self, memory: SlamMemory) -> None:
        """Begin in the map of another session; the place in it is not known yet."""
        super().begin_in_map(memory)
        self._helm.begin_in_map()

    def _take(self, step: Step) -> None:
        super()._take(step)
        self._helm.see(step)
