"""A live run: starts the processes, watches over them, and ends them together."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import connection, get_context
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from vislam.config import Config
from vislam.errors import HardwareError, StorageError, UsageError, VislamError
from vislam.front import filter_config
from vislam.hw.source import InertialSource
from vislam.imu import BiasMemory
from vislam.live import back_process, bridge, fast_process, front_process, map_process
from vislam.live.beginning import Beginning
from vislam.live.child import Failure, Flag, Life, Note, Ready, Signals, guarded
from vislam.live.frames import FrameSource
from vislam.live.slot import remove
from vislam.recording import Recording
from vislam.run import imu_noise
from vislam.runfolder import MapChoice, write_json

_WATCH_S = 0.2
_AFTER_FAILURE_S = 60.0  # that the others may take to write down what there is
_END_S = 10.0  # that a process may take to end after it was told twice


class LiveSource(Recording, Protocol):
    """Sensors: what a recording says of itself, and how to open them, each in the process that reads it."""

    duration_s: float | None  # after which there is no more; None: endless
    has_camera: bool  # without one, attitude alone is published
    is_mag_calibrated: bool  # without, a magnetometer is not believed

    def inertial(self) -> Callable[[], InertialSource]:
        """Return what opens the IMU; it travels to the fast process."""
        ...

    def cameras(self) -> Callable[[], FrameSource]:
        """Return what opens the cameras; it travels to the front process."""
        ...

    def helpers(self) -> dict[str, Callable[[Life], None]]:
        """Return processes that the sensors need beside these, such as those of a simulated world."""
        ...

    def close(self) -> None:
        """Remove what the run shared, in the parent, after every process has ended; may be called twice."""
        ...


@dataclass(slots=True)
class _Child:
    process: SpawnProcess
    report: Connection
    is_ready: bool = False


class LiveRun:
    """Owns the processes of one run.

    Attributes:
        notes: the newest of what each process told, by role.
        metrics: those of the run, when it has ended well.
    """

    def __init__(
        self, source: LiveSource, config: Config, out: Path, asked: str, command: list[str],
        base: MapChoice | None = None, beginning: Beginning | None = None,
    ) -> None:  # fmt: skip
        """Make the wires; nothing starts yet.

        Args:
            source: the sensors.
            config: of the run.
            out: a folder for it, which has to be there when it is executed.
            asked: the source as it was asked for.
            command: as it was typed.
            base: the map of another run, to begin in.
            beginning: what `base` holds, or the run itself in `out` that is to be resumed; None: it begins anew.

        Raises:
            UsageError: settings that only make sense with a recording, or a bridge that cannot be.
            DataError: the file of remembered biases is damaged.
        """
        noise = imu_noise(config.imu, source.imu_noise)
        if noise is None:
            raise UsageError("a live run needs an IMU: leave imu.enabled on")
        for name, is_on in {
            "ekf.graph_feedback": config.ekf.graph_feedback,
            "ekf.vision_delay_s": config.ekf.vision_delay_s > 0.0,
        }.items():
            if is_on:
                raise UsageError(f"--{name} is for recordings: record the drive and run it with that, or leave it off")
        self.notes: dict[str, dict[str, Any]] = {}
        self.metrics: dict[str, Any] | None = None
        self._source, self._out, self._shared_name = source, out, config.live.name
        self._context = get_context("spawn")
        self._signals = Signals(Flag(), Flag())
        self._children: dict[str, _Child] = {}
        self._failure: VislamError | None = None
        self._ends: list[Any] = []  # our copies of wires that belong to children
        path = config.power_up.memory
        self._memory_path = None if path is None else Path(path)
        self._memory = BiasMemory(config.power_up.remembered)
        if self._memory_path is not None:
            self._memory = BiasMemory.read(self._memory_path, config.power_up.remembered)
        self._is_zeroed = False  # power-up found a bias
        self._unremembered: str | None = None  # why it is not kept
        self._roles = self._wire(source, config, out, asked, command, noise, base, beginning)

    def _wire(
        self,
        source: LiveSource,
        config: Config,
        out: Path,
        asked: str,
        command: list[str],
        noise: Any,
        base: MapChoice | None,
        beginning: Beginning | None,
    ) -> dict[str, Callable[[Life], None]]:
        """Return what each process does, with its ends of the wires."""
        bridges = bridge.asked(config.live)
        send_to = (*config.live.send_to, *(at for at, _ in bridges.values()))
        samples_in, samples_out = socket.socketpair()
        front_says, fast_hears_front = self._context.Pipe(duplex=False)[::-1]
        back_says, fast_hears_back = self._context.Pipe(duplex=False)[::-1]
        packets_out, packets = self._context.Pipe(duplex=False)[::-1]
        frames_out, frames = self._context.Pipe(duplex=False)[::-1]
        keyframes_out, keyframes = self._context.Pipe(duplex=False)[::-1]
        self._ends = [
            samples_in, samples_out, front_says, fast_hears_front, back_says, fast_hears_back, packets_out, packets,
            frames_out, frames, keyframes_out, keyframes,
        ]  # fmt: skip
        rig = source.rig
        fast = replace(config, live=replace(config.live, send_to=send_to), ekf=filter_config(config, rig))
        return {
            **source.helpers(),
            **{role: body for role, (_, body) in bridges.items()},
            "fast": partial(
                fast_process.run, config=fast, noise=noise, T_body_camera=rig.T_body_cams[0],
                open_source=source.inertial(), samples=samples_in, inbox=[fast_hears_front, fast_hears_back],
                memory=self._memory, is_mag_calibrated=source.is_mag_calibrated,
            ),
            "front": partial(
                front_process.run, config=config, rig=rig, noise=noise, open_camera=source.cameras(),
                samples=samples_out, to_fast=front_says, to_back=packets_out, to_map=frames_out, beginning=beginning,
            ),
            "back": partial(
                back_process.run, config=config, rig=rig, noise=noise, keyframes=packets, to_fast=back_says,
                to_map=keyframes_out, beginning=beginning,
            ),
            "map": partial(
                map_process.run, config=config, recording=source, out=out, source=asked, command=command,
                frames=frames, keyframes=keyframes, beginning=beginning, base=base, has_camera=source.has_camera,
            ),
        }  # fmt: skip

    @property
    def is_going(self) -> bool:
        """Whether every process is ready and the sensors are read."""
        return self._signals.go.is_set()

    @property
    def waits_for(self) -> list[str]:
        """Roles of the processes that are not ready yet."""
        return [role for role, child in self._children.items() if not child.is_ready]

    def stop(self) -> None:
        """Ask for the end, as Ctrl-C does."""
        self._signals.stop.set()

    def processes(self) -> dict[str, SpawnProcess]:
        """Return the processes that were started, by role."""
        return {role: child.process for role, child in self._children.items()}

    def execute(self, show: Callable[[LiveRun], None] | None = None, duration_s: float | None = None) -> dict[str, Any]:
        """Run until Ctrl-C, `duration_s` or a failure; return the metrics.

        Args:
            show: is called now and then with this object.
            duration_s: ends by itself so long after all sensors are read; None: does not.

        Raises:
            VislamError: what a process raised, or that one was killed; what was computed is in the run folder.
            KeyboardInterrupt: a second Ctrl-C, while the first was being obeyed.
        """
        try:
            self._start()
            with _interrupts() as asked:
                deadline = float("inf")
                while not self._signals.stop.is_set():
                    self._watch(show)
                    if duration_s is not None and self._signals.go.is_set() and deadline == float("inf"):
                        deadline = time.monotonic() + duration_s
                    if asked() or time.monotonic() > deadline or self._failure is not None:
                        self._signals.stop.set()
                patience = float("inf")
                while any(child.process.is_alive() for child in self._children.values()):
                    self._watch(show)
                    if asked() > 1:
                        raise KeyboardInterrupt
                    if self._failure is not None and patience == float("inf"):
                        patience = time.monotonic() + _AFTER_FAILURE_S
                    if time.monotonic() > patience:
                        break  # a killed process may have held what the others wait for
                self._watch(show)
        finally:
            self._end()
        if self._failure is not None:
            raise self._failure
        if self.metrics is None:
            raise HardwareError("the run ended before its folder was written; see what is said above")
        told = {name: value for name, value in self.notes.get("fast", {}).items() if name != "status"}
        warnings = [*self.metrics["warnings"], *self._doubts]
        self.metrics = {**self.metrics, "warnings": warnings, "live": told}
        write_json(self._out / "metrics.json", self.metrics)
        return self.metrics

    def _start(self) -> None:
        """Start every process; Ctrl-C does not reach one that is not ready for it."""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            for role, body in self._roles.items():
                hears, says = self._context.Pipe(duplex=False)
                process = self._context.Process(
                    target=guarded, args=(role, says, self._signals, body), name=f"vislam {role}"
                )
                process.start()
                says.close()
                self._children[role] = _Child(process, hears)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for end in self._ends:
            end.close()

    def _watch(self, show: Callable[[LiveRun], None] | None) -> None:
        """Hear what the processes tell, for a moment; notice one that died."""
        reports = [child.report for child in self._children.values() if not child.report.closed]
        sentinels = [child.process.sentinel for child in self._children.values() if child.process.is_alive()]
        connection.wait([*reports, *sentinels], timeout=_WATCH_S)
        for role, child in self._children.items():
            self._hear(role, child)
            code = child.process.exitcode
            if code and self._failure is None:
                how = f"was killed by signal {-code}" if code < 0 else f"left with code {code}"
                self._failure = HardwareError(f"the {role} process {how}; the other processes were ended cleanly")
        if not self._signals.go.is_set() and all(child.is_ready for child in self._children.values()):
            self._signals.go.set()
        if show is not None:
            show(self)

    def _hear(self, role: str, child: _Child) -> None:
        try:
            while not child.report.closed and child.report.poll():
                message = child.report.recv()
                if isinstance(message, Ready):
                    child.is_ready = True
                elif isinstance(message, Note):
                    self.notes[role] = {**self.notes.get(role, {}), **message.values}
                    self.metrics = message.values.get("metrics", self.metrics)
                    self._remember(message.values.get("power_up", {}))
                else:
                    raised = _raised(message)
                    if self._failure is None:
                        self._failure = raised
                    else:
                        self._failure.add_note(f"then: {raised}")
        except (EOFError, OSError):
            child.report.close()

    @property
    def _doubts(self) -> list[str]:
        """What the user should know of power-up."""
        told = self.notes.get("fast", {}).get("power_up", {})
        doubts = [f"no zero at power-up: {told['refused']}"] if "refused" in told else []
        return doubts + ([] if self._unremembered is None else [self._unremembered])

    def _remember(self, told: dict[str, Any]) -> None:
        """Keep the gyro's bias for the next power-up, once; here, for no sensor waits for a disk."""
        temperature_c = told.get("temperature_c")
        if self._memory_path is None or self._is_zeroed or temperature_c is None:
            return
        self._is_zeroed = True
        self._memory.add(temperature_c, np.array(told["gyro_bias_rad_s"]))
        try:
            self._memory.write(self._memory_path)
        except StorageError as error:
            self._unremembered = str(error)

    def _end(self) -> None:
        """Make sure that nothing is left behind, whatever happened."""
        self._signals.stop.set()
        self._signals.go.set()
        for child in self._children.values():
            if child.process.is_alive():
                child.process.terminate()
        for child in self._children.values():
            child.process.join(_END_S)
            if child.process.is_alive():
                child.process.kill()
                child.process.join()
            child.process.close()
            child.report.close()
        for end in self._ends:
            end.close()
        if self._failure is not None:
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


@contextmanager
def _interrupts() -> Iterator[Callable[[], int]]:
    """Count Ctrl-C and SIGTERM instead of raising."""
    count = 0

    def note(signum: int, frame: object) -> None:
        nonlocal count
        count += 1

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: count
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
