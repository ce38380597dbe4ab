"""The reference pipeline, on one thread: measurements go in by `Slam.feed`, one `Step` per frame comes out.

inertial sample -> EKF                                  -> pose in odom, at IMU rate
reading         -> EKF, and with the next keyframe -> graph
frame           -> front end -> EKF                     -> keyframe?
keyframe        -> loop detector -> graph -> mapper     -> poses in map, T_map_odom, map
"""

from collections import deque

from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.clock import StageClock
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import SlamMemory
from vislam.core.messages import Frame, GraphUpdate, ImuSample, MagSample
from vislam.core.readings import Reading
from vislam.mapping.semantic.images import Labeller
from vislam.pipeline.back import Back, KeyframeIntake
from vislam.pipeline.dark import SilentCamera
from vislam.pipeline.front import Front
from vislam.pipeline.in_map import InMap
from vislam.pipeline.steps import Finish, Step
from vislam.sensors import Suite


class Slam:
    """Camera, if any, and IMU in, poses and map out; deterministic, one thread."""

    def __init__(
        self, config: Config, rig: Rig, noise: ImuNoise | None = None, suite: Suite | None = None,
        labeller: Labeller | None = None,
    ) -> None:  # fmt: skip
        """Build the pipeline for a rig; without `noise` there is no IMU. `suite` are further sensors, if any.

        `labeller` gives the labels of keyframes, as a network does; None: `map.labels.folder` does, if there is one.
        """
        self.clock = StageClock()
        self.front = Front(config, rig, noise, self.clock, suite)
        self._intake = KeyframeIntake(rig, self.front, self.clock, suite, labeller)
        self._in_map = InMap(config.publish)
        self._frames: deque[Frame] = deque()
        self._silence = SilentCamera(rig) if noise is not None and (rig.is_blind or suite) else None

    def __repr__(self) -> str:
        return f"Slam({self.front.frontend.mode}, {0 if self.back is None else len(self.back.graph.poses())} keyframes)"

    @property
    def back(self) -> Back | None:
        """The stages at the rate of keyframes; None before the first."""
        return self._intake.stages

    @property
    def counters(self) -> dict[str, int]:
        """How often the place in the map was lost and found again."""
        return self._in_map.place.counters

    def resume(self, memory: SlamMemory) -> GraphUpdate:
        """Go on where an earlier run was, before the first value; return all its poses.

        The first frame has to be that of its newest keyframe, `memory.front.camera_t_ns`, with the inertial samples
        around it. Raises DataError when the memory contradicts itself.
        """
        self.front.resume(memory.front)
        if self._silence is not None:
            self._silence.go_on(memory.front.camera_t_ns)
        update = self._intake.resume(memory)
        self._in_map.place.submaps = update.submaps
        return update

    def begin_in_map(self, memory: SlamMemory) -> GraphUpdate:
        """Begin in the map of earlier runs, before the first value; return its poses.

        What is recorded now is a new submap until loops join it with the map. Raises DataError when the
        memory contradicts itself.
        """
        first_id = memory.front.keyframe_id + 1
        self.front.begin_in_map(first_id, memory.front.learned.next_track_id)
        update = self._intake.begin_in_map(memory)
        self._in_map.place.submaps = update.submaps.begun(first_id)
        return update

    def feed(self, value: ImuSample | MagSample | Reading | Frame) -> list[Step]:
        """Take one measurement; return a step for every frame that could be processed with it.

        A frame waits until one inertial sample newer than it has come, so that its span ends exactly at its time. With
        further sensors, a camera that is silent for long is taken for a covered one: there are steps of dark frames.
        """
        if isinstance(value, Frame):
            self._frames.append(value)
            if self._silence is not None:
                self._silence.see(value)
        else:
            self.front.add(value)
            self._go_on_without_images(value)
        steps = []
        while self._frames and self.front.is_ready(self._frames[0].t_ns, self._frames[-1].t_ns):
            steps.append(self._step(self._frames.popleft()))
        return steps

    def finish(self) -> Finish:
        """Process the frames that still wait and optimise a last time."""
        steps = [self._step(self._frames.popleft()) for _ in range(len(self._frames))]
        keyframes = self._intake.add(self.front.give_up_waiting())
        return Finish(steps, keyframes, *self._intake.finish())

    def _go_on_without_images(self, value: ImuSample | MagSample | Reading) -> None:
        if self._silence is not None and isinstance(value, ImuSample):
            self._frames += self._silence.stand_in(value.t_ns, self.front.begun.settled is not None)

    def _step(self, frame: Frame) -> Step:
        front = self.front.process(frame)
        keyframes = self._intake.add(front.keyframes)
        self._intake.see(front)
        T_map_odom = None if self.back is None else self.back.T_map_odom
        T_map_body, localisation = self._in_map.take(front, keyframes, T_map_odom)
        return Step(front, T_map_body, localisation, self._in_map.place.submap, keyframes)
