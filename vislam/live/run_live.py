"""A live run: starts the processes, watches over them, and ends them together."""

import logging
import socket
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing import connection, get_context
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from vislam.config import Config, PowerUpConfig
from vislam.core import interrupts
from vislam.core.errors import HardwareError, StorageError, UsageError, VislamError
from vislam.core.files import write_json
from vislam.core.recording import Recording
from vislam.hw.imu_source import InertialSource
from vislam.hw.source import FrameSource, ReadingSource
from vislam.imu import BiasMemory
from vislam.live.beginning import Beginning
from vislam.live.bridges import translator
from vislam.live.processes import back as back_process
from vislam.live.processes import fast as fast_process
from vislam.live.processes import front as front_process
from vislam.live.processes import map as map_process
from vislam.live.processes.child import Child, Failure, Flag, Life, Note, Ready, Signals, measured
from vislam.live.reading_source import live_readings
from vislam.live.web.updates import WebEnds
from vislam.live.wire.slot import remove
from vislam.pipeline.settings import derived
from vislam.runs import imu_noise
from vislam.runs.cost import whole_cost
from vislam.runs.folder import MapChoice
from vislam.sensors import SensorSetup

_LOG = logging.getLogger(__name__)
_WATCH_S = 0.1
_WRITERS = ("fast", "front", "back", "map")
_BRIEF_S = 1.3  # after a signal, that writing down what there is may take
_TAKING_APART_S = 10.0  # that a process with nothing left to write may take to leave
_AFTER_FAILURE_S = 60.0  # that the others may take to write down what there is


class KeptBias:
    """Owns the file of remembered biases; in the parent of all processes, for no sensor waits for a disk.

    Attributes:
        memory: what earlier runs left.
        refusal: why the bias of this run is not kept; None: it is, or there was none yet.
    """

    def __init__(self, config: PowerUpConfig) -> None:
        """Read the file, where one is asked for; raises DataError when it is damaged."""
        self._path = None if config.memory is None else Path(config.memory)
        self.memory = BiasMemory(config.remembered)
        if self._path is not None:
            self.memory = BiasMemory.read(self._path, config.remembered)
        self.refusal: str | None = None
        self._is_kept = False

    def take(self, report: dict[str, Any]) -> None:
        """Keep the bias that power-up reports, once, if it found one."""
        temperature_c = report.get("temperature_c")
        if self._path is None or self._is_kept or temperature_c is None:
            return
        self._is_kept = True
        self.memory.add(temperature_c, np.array(report["gyro_bias_rad_s"]))
        try:
            self.memory.write(self._path)
        except StorageError as error:
            self.refusal = str(error)


class LiveSource(Recording, Protocol):
    """Sensors: what a recording states of itself, and how to open them, each in the process that reads it."""

    duration_s: float | None  # after which there is no more; None: endless
    is_mag_calibrated: bool  # without, a magnetometer is not believed

    def check(self) -> None:
        """Raise HardwareError where a sensor cannot be there, at once: processes need minutes to be ready."""
        ...

    def inertial(self) -> Callable[[], InertialSource]:
        """Return what opens the IMU; it travels to the fast process."""
        ...

    def cameras(self) -> Callable[[], FrameSource]:
        """Return what opens the cameras; it travels to the front process."""
        ...

    def readings(self, setup: SensorSetup) -> Callable[[], ReadingSource]:
        """Return what opens further sensors; it travels to the front process.

        Raises UsageError for a sensor that cannot be read beside these, HardwareError for one that is not there.
        """
        ...

    def helpers(self) -> dict[str, Callable[[Life], None]]:
        """Return processes that the sensors need beside these, such as those of a simulated world."""
        ...

    def close(self) -> None:
        """Remove what the run shared, in the parent, after every process has ended; may be called twice."""
        ...


Show = Callable[["LiveRun"], None]  # is called now and then


class LiveRun:
    """Owns the processes of one run.

    Attributes:
        notes: the newest values of each process, by role.
        metrics: those of the run, when it has ended well.
    """

    def __init__(
        self, source: LiveSource, config: Config, out: Path, asked: str, command: list[str],
        base: MapChoice | None = None, beginning: Beginning | None = None, web: WebEnds | None = None,
    ) -> None:  # fmt: skip
        """Make the wires; nothing starts yet.

        Args:
            source: the sensors.
            config: of the run.
            out: a folder for it, which has to be there when it is executed.
            asked: the source as it was asked for.
            command: as it was typed.
            base: the map of another run, to begin in.
            beginning: what `base` holds, or the run itself in `out` that is to be resumed; None: a new run.
            web: wires of a page that shows the run, if there is one.

        Raises:
            UsageError: settings that only make sense with a recording, a bridge or a further sensor that cannot be.
            DataError: the file of remembered biases is damaged.
            HardwareError: a sensor is not there.
        """
        noise = imu_noise(config.imu, source.imu_noise)
        config = derived(config, source.rig, noise)
        if noise is None:
            raise UsageError("a live run needs an IMU: leave imu.enabled on")
        for name, is_on in {
            "ekf.graph_feedback": config.ekf.graph_feedback,
            "ekf.vision_delay_s": config.ekf.vision_delay_s > 0.0,
        }.items():
            if is_on:
                raise UsageError(f"--{name} is for recordings: record the drive and run it with that, or leave it off")
        source.check()
        self.notes: dict[str, dict[str, Any]] = {}
        self.metrics: dict[str, Any] | None = None
        self._source, self._out, self._shared_name = source, out, config.live.name
        self._context = get_context("spawn")
        self._signals = Signals(Flag(), Flag())
        self._children: dict[str, Child] = {}
        self._failure: VislamError | None = None
        self._ends: list[Any] = []  # our copies of wires that belong to children
        self._drivers: list[Connection] = []  # bring the map to who drives by it
        self._guesses: list[Connection] = []  # say where they think that they are
        self._bias = KeptBias(config.power_up)
        self._roles = self._wire(source, config, out, asked, command, noise, base, beginning, web)

    def _wire(
        self, source: LiveSource, config: Config, out: Path, asked: str, command: list[str], noise: Any,
        base: MapChoice | None, beginning: Beginning | None, web: WebEnds | None,
    ) -> dict[str, Callable[[Life], None]]:  # fmt: skip
        """Return what each process does, with its ends of the wires."""
        suite, open_readings = live_readings(config.sensors, source.readings)
        maps = None if config.live.ros2_domain is None else self._wire_of(self._drivers, 1)
        bridges = translator.asked(config.live, tuple(source.rig.T_body_cams), maps)
        send_to = (*config.live.send_to, *(at for at, _ in bridges.values()))
        samples_in, samples_out = socket.socketpair()
        front_says, fast_hears_front = self._context.Pipe(duplex=False)[::-1]
        back_says, fast_hears_back = self._context.Pipe(duplex=False)[::-1]
        packets_out, packets = self._context.Pipe(duplex=False)[::-1]
        frames_out, frames = self._context.Pipe(duplex=False)[::-1]
        keyframes_out, keyframes = self._context.Pipe(duplex=False)[::-1]
        self._ends += [
            samples_in, samples_out, front_says, fast_hears_front, back_says, fast_hears_back, packets_out, packets,
            frames_out, frames, keyframes_out, keyframes, *(() if web is None else (web.frames, web.map, web.back)),
        ]  # fmt: skip
        rig = source.rig
        fast = replace(config, live=replace(config.live, send_to=send_to))
        ours: dict[str, Callable[[Life], None]] = {
            "fast": partial(
                fast_process.run, config=fast, noise=noise, T_body_camera=rig.T_body_cam0,
                open_source=source.inertial(), samples=samples_in, inbox=[fast_hears_front, fast_hears_back],
                memory=self._bias.memory, is_mag_calibrated=source.is_mag_calibrated, suite=suite,
            ),
            "front": partial(
                front_process.run, config=config, rig=rig, noise=noise, open_camera=source.cameras(),
                open_readings=open_readings, suite=suite, samples=samples_out, to_fast=front_says, to_back=packets_out,
                to_map=frames_out, beginning=beginning, to_web=None if web is None else web.frames,
            ),
            "back": partial(
                back_process.run, config=config, rig=rig, noise=noise, keyframes=packets, to_fast=back_says,
                to_map=keyframes_out, beginning=beginning, suite=suite, web=None if web is None else web.back,
                guesses=self._guesses,
            ),
            "map": partial(
                map_process.run, config=config, recording=source, out=out, source=asked, command=command,
                frames=frames, keyframes=keyframes, beginning=beginning, base=base, suite=suite,
                web=None if web is None else web.map, drivers=self._drivers,
            ),
        }  # fmt: skip
        return {
            **source.helpers(),
            **{role: body for role, (_, body) in bridges.items()},
            **{role: partial(measured, body=body) for role, body in ours.items()},
        }

    def add_driver(self, body: Callable[..., None]) -> None:
        """Add a process that gets `MapCells` and sends guesses of `T_map_body` [4, 4]; before anything starts."""
        maps, guesses = self._wire_of(self._drivers, 1), self._wire_of(self._guesses, 0)
        self._roles["drive"] = partial(body, maps=maps, guesses=guesses)

    def _wire_of(self, ours: list[Connection], end: int) -> Connection:
        """Make a wire, of which one end (1: sends, 0: takes) is added to others of a child; return the other one."""
        ends = self._context.Pipe(duplex=False)
        ours.append(ends[end])
        self._ends += ends
        return ends[1 - end]

    @property
    def is_going(self) -> bool:
        """Whether every process is ready and the sensors are read."""
        return self._signals.go.is_set()

    @property
    def is_ending(self) -> bool:
        """Whether the sensors are not read any more, and what there is is written down."""
        return self._signals.stop.is_set()

    @property
    def waits_for(self) -> list[str]:
        """Roles of the processes that are not ready yet."""
        return [role for role, child in self._children.items() if not child.is_ready]

    @property
    def is_brief(self) -> bool:
        """Whether a signal ended it: then there is neither map nor report yet."""
        return self._signals.brief.is_set()

    def stop(self) -> None:
        """Ask for the end, as `duration_s` does."""
        self._signals.stop.set()

    def processes(self) -> dict[str, SpawnProcess]:
        """Return the processes that were started, by role."""
        return {role: child.process for role, child in self._children.items()}

    def execute(self, show: Show | None = None, duration_s: float | None = None) -> dict[str, Any]:
        """Run until a signal (`interrupts.SIGNALS`), `duration_s` or a failure; return the metrics.

        Args:
            show: is called now and then with this object.
            duration_s: ends by itself so long after all sensors are read; None: does not.

        Raises:
            VislamError: what a process raised, or that one was killed; what was computed is in the run folder.
            KeyboardInterrupt: a signal before the sensors were read, while the end was being written down, or one after
                which that took too long.
        """
        try:
            with interrupts.counted() as asked:
                self._start()
                self._watch_until_end(asked, show, duration_s)
                if not self.is_going and self._failure is None:
                    raise KeyboardInterrupt  # nothing was recorded
                self._watch_ending(asked, show)
        finally:
            self._end()
        if self._failure is not None:
            raise self._failure
        if self.metrics is None and self.is_brief:
            raise KeyboardInterrupt  # the session has all but what came since its last keyframe
        if self.metrics is None:
            raise HardwareError("the run ended before its folder was written; see the messages above")
        live = {name: value for name, value in self.notes.get("fast", {}).items() if name != "status"}
        for doubt in self._doubts:
            _LOG.warning("%s", doubt)
        warnings = [*self.metrics["warnings"], *self._doubts]
        cost = whole_cost(self.metrics, self.notes)
        self.metrics = {**self.metrics, "warnings": warnings, "live": live, "cost": cost}
        write_json(self._out / "metrics.json", self.metrics)
        return self.metrics

    def _watch_until_end(self, asked: interrupts.Asked, show: Show | None, duration_s: float | None) -> None:
        """Watch over the processes until the run is to end, and signal that to them."""
        deadline = float("inf")
        while not self._signals.stop.is_set():
            self._watch(show)
            if self.is_going:
                asked.take_time()
                deadline = min(deadline, time.monotonic() + (float("inf") if duration_s is None else duration_s))
            if asked.count:
                self._signals.brief.set()
            if asked.count or time.monotonic() > deadline or self._failure is not None:
                self._signals.stop.set()

    def _watch_ending(self, asked: interrupts.Asked, show: Show | None) -> None:
        """Watch over the processes while they write down what there is; those that had not begun are not waited for."""
        patience = time.monotonic() + _BRIEF_S if self.is_brief else float("inf")
        while self.is_going and any(child.process.is_alive() for child in self._children.values()):
            self._watch(show)
            if asked.count > self.is_brief:
                raise KeyboardInterrupt
            if all("cost" in self.notes.get(role, {}) for role in _WRITERS):  # they have sent all
                patience = min(patience, time.monotonic() + (0.0 if self.is_brief else _TAKING_APART_S))
            if self._failure is not None:  # a killed process may have held what the others wait for
                patience = min(patience, time.monotonic() + _AFTER_FAILURE_S)
            if time.monotonic() >= patience:
                break
        self._watch(show)

    def _start(self) -> None:
        """Start every process."""
        for role, body in self._roles.items():
            self._children[role] = Child.started(role, self._signals, body)
        for end in self._ends:
            end.close()

    def _watch(self, show: Show | None) -> None:
        """Receive messages of the processes, for a moment; notice one that died."""
        reports = [child.report for child in self._children.values() if not child.report.closed]
        sentinels = [child.process.sentinel for child in self._children.values() if child.process.is_alive()]
        connection.wait([*reports, *sentinels], timeout=_WATCH_S)
        for role, child in self._children.items():
            self._hear(role, child)
            code = child.process.exitcode
            if code and self._failure is None:
                how = f"was killed by signal {-code}" if code < 0 else f"left with code {code}"
                self._failure = HardwareError(f"the {role} process {how}; the other processes were ended cleanly")
                _LOG.error("%s", self._failure)
        if not self._signals.go.is_set() and all(child.is_ready for child in self._children.values()):
            _LOG.info("every process is ready: sensors are read from now on")
            self._signals.go.set()
        if show is not None:
            show(self)

    def _hear(self, role: str, child: Child) -> None:
        for message in child.messages():
            if isinstance(message, Ready):
                child.is_ready = True
                _LOG.info("the %s process is ready", role)
            elif isinstance(message, Note):
                self.notes[role] = {**self.notes.get(role, {}), **message.values}
                self.metrics = message.values.get("metrics", self.metrics)
                self._bias.take(message.values.get("power_up", {}))
            else:
                raised = _raised(message)
                _LOG.error("the %s process failed:\n%s", role, message.traceback)
                if self._failure is None:
                    self._failure = raised
                else:
                    self._failure.add_note(f"then: {raised}")

    @property
    def _doubts(self) -> list[str]:
        """What the user should know of power-up."""
        report = self.notes.get("fast", {}).get("power_up", {})
        doubts = [f"no zero at power-up: {report['refused']}"] if "refused" in report else []
        return doubts + ([] if self._bias.refusal is None else [self._bias.refusal])

    def _end(self) -> None:
        """Make sure that nothing is left behind, whatever happened."""
        self._signals.stop.set()
        alive = [child.process for child in self._children.values() if child.process.is_alive()]
        for process in alive:
            process.kill()
        for child in self._children.values():
            child.process.join()
            child.process.close()
            child.report.close()
        for end in self._ends:
            end.close()
        if alive or self._failure is not None:
            remove(self._shared_name)
        self._source.close()


def _raised(failure: Failure) -> VislamError:
    """Return the error of a child as one of this process: ours as it is, others with their traceback."""
    error = failure.error
    if not isinstance(error, VislamError):
        error = ChildError(f"the {failure.role} process failed:\n{failure.traceback}")
    error.add_note(f"in the {failure.role} process:\n{failure.traceback}")
    return error


class ChildError(VislamError):
    """A bug in a child process, with its traceback."""

    exit_code = 1
