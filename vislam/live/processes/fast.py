"""The process that reads the IMU and publishes the pose. It loads neither gtsam, OpenCV, Open3D nor Rerun."""

from __future__ import annotations

import ctypes
import gc
import os
import select
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection

import numpy as np

from vislam.config import Config, LiveConfig
from vislam.core.messages import Array, ImuSample, MagSample, NavState, Tracking, VoMeasurement, no_observations
from vislam.ekf.correction import Correction
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource
from vislam.imu import AttitudeFilter, BiasMemory, ImuNoise
from vislam.live.fast import FastPath
from vislam.live.notices import Start, ToFast
from vislam.live.processes.child import Life
from vislam.live.wire.published_pose import PublishedPose
from vislam.live.wire.publisher import PosePublisher
from vislam.live.wire.stream import SampleSender
from vislam.sensors import Suite

_NS = 1_000_000_000
_READ_S = 0.005  # most that reading waits: messages of vision are looked for in between
_NOTE_S = 0.5
_HEARTBEAT_NS = 50_000_000  # between poses while there are no samples, so that a reader sees why
_BIN_NS = 5_000  # of the histogram of latencies
_BINS = 40_000  # up to 0.2 s; what is longer counts into the last
_PARTS = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}
_ATTRIBUTES = struct.Struct("<IIQiIQQQ")  # sched_attr: size, policy, flags, nice, priority, runtime, deadline, period
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}  # the number of the system call; Python has no function for it
_TURN_NS = 500_000  # for a sample and a late frame; in shorter ones, cut apart, it falls behind on a busy machine


def take_priority(live: LiveConfig, life: Life) -> None:
    """Run before others: always where the system permits `live.realtime_priority`, else sooner than usual."""
    if live.realtime_priority > 0:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(live.realtime_priority))
            return
        except OSError as error:
            life.note(
                warning=f"no real-time priority for the pose ({error}); see docs/cart.md, or --live.realtime-priority 0"
            )
    take_short_turns()


def take_short_turns() -> None:
    """Ask for short turns on the processor: since Linux 6.12 these may cut in on another's long one when they come.

    Anybody may ask. An older kernel, or another processor than the usual ones, goes on as before.
    """
    number = _SCHED_SETATTR.get(os.uname().machine)
    if number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return
    attributes = _ATTRIBUTES.pack(_ATTRIBUTES.size, os.SCHED_OTHER, 0, os.nice(0), 0, _TURN_NS, 0, 0)
    ctypes.CDLL(None).syscall(number, 0, attributes, 0)


def run(
    life: Life,
    config: Config,
    noise: ImuNoise,
    T_body_camera: Array,
    open_source: Callable[[], InertialSource],
    samples: socket.socket,
    inbox: list[Connection],
    memory: BiasMemory,
    is_mag_calibrated: bool,
    suite: Suite,
) -> None:
    """Read, predict, publish, until the run ends; then end the stream of samples.

    Args:
        life: of this process.
        config: of the run.
        noise: of the IMU.
        T_body_camera: [4, 4] of the first camera.
        open_source: opens the IMU, in this process.
        samples: to the front process.
        inbox: from the front and the back process.
        memory: gyro biases that earlier power-ups found.
        is_mag_calibrated: whether the magnetometer's values may be used.
        suite: further sensors, which another process reads.
    """
    warm_up(config, noise, T_body_camera)
    take_priority(config.live, life)
    publisher = PosePublisher(config.live.name, config.live.send_to, config.live.allow_remote, config.live.group)
    sender = SampleSender(samples)
    latency = _Latency()
    try:
        source = open_source()
        try:
            fast = FastPath(config, noise, T_body_camera, publisher.publish, memory, is_mag_calibrated, suite)
            if life.ready():
                _loop(life, fast, source, sender, Messages(inbox), latency)
            counters = {
                **fast.counters,
                **publisher.counters,
                **{f"sensor_{k}": n for k, n in source.counters().items()},
            }
            life.note(latency_ms=latency.summary_ms(), counters=counters, filter=fast.filter_counters)
        finally:
            source.close()
    finally:
        publisher.close()
        sender.close()


def _loop(
    life: Life, fast: FastPath, source: InertialSource, sender: SampleSender, inbox: Messages, latency: _Latency
) -> None:
    gc.collect()
    gc.freeze()
    gc.disable()  # nothing here makes cycles, and a collection would cost the pose a millisecond
    published_ns, noted_ns = 0, 0
    while not life.stopped:
        values = source.read(_READ_S)
        for value in values:
            hint = fast.add(value)
            if isinstance(value, ImuSample):
                published_ns = time.monotonic_ns()
                fast.publish(published_ns, source.health)
                latency.add(time.monotonic_ns() - value.t_ns)
            sender.send(value)
            if hint is not None:
                sender.send(hint)
        if not values:
            sender.flush()
        inbox.take(fast.correct)
        now_ns = time.monotonic_ns()
        if now_ns - published_ns > _HEARTBEAT_NS:
            published_ns = now_ns
            fast.publish(now_ns, source.health)
        if now_ns - noted_ns > _NOTE_S * _NS:
            noted_ns = now_ns
            power_up(fast, source)
            life.note(status=fast.status(), latency_ms=latency.summary_ms(), power_up=fast.alone.report())


class Messages:
    """What the other processes say; looking for it costs the pose one call of the system."""

    def __init__(self, connections: list[Connection]) -> None:
        self._connections = {connection.fileno(): connection for connection in connections}
        self._poll = select.poll()
        for descriptor in self._connections:
            self._poll.register(descriptor, select.POLLIN)

    def take(self, correct: Callable[[ToFast], None]) -> None:
        """Take one from each, for a sample must not wait for more than that; a process that has ended sends none."""
        for descriptor, _ in self._poll.poll(0):
            try:
                message = self._connections[descriptor].recv()
            except (EOFError, OSError):
                self._poll.unregister(descriptor)
                continue
            correct(message)


def power_up(fast: FastPath, source: InertialSource) -> None:
    """Look for the zero of a cart that stands; once it is there, the source takes the gyro's drift from it off."""
    zero = fast.power_up(source.temperature_c)
    if zero is not None and zero.temperature_c is not None:
        source.zeroed_at(zero.temperature_c, fast.alone.bias_per_c)


def warm_up(config: Config, noise: ImuNoise, T_body_camera: Array) -> None:
    """Run all that is compiled once: the first sample and the first frame must not wait for a compiler."""
    rest = np.array([0.0, 0.0, config.machine.gravity_m_s2])
    dt_ns = round(_NS / noise.rate_hz)
    fast = FastPath(config, noise, T_body_camera, _ignore)
    keyframe = VoMeasurement(60 * dt_ns, 0, np.eye(4), np.eye(6) * 1e-6, True, Tracking.OK, 100)
    state = NavState(keyframe.t_ns, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.eye(15) * 1e-4)
    attitude = AttitudeFilter(config.attitude, config.machine.gravity_m_s2, np.eye(3), np.zeros(3))
    for k in (1, 2):
        attitude.add(ImuSample(k * dt_ns, np.zeros(3), rest), MagSample(k * dt_ns, np.array([20.0, 0.0, -42.0])))
    for k in range(1, 200):
        fast.add(ImuSample(k * dt_ns, np.zeros(3), rest))
        if k == 80:
            fast.correct(Start(state, keyframe))
        if k in (120, 140, 160):  # a keyframe at rest, rest that goes on, wheels
            frame = replace(keyframe, t_ns=(k - 20) * dt_ns, keyframe_id=int(k > 120))
            fast.correct(Correction(frame.t_ns, frame, no_observations(), k < 160, k == 160, 1 if k == 120 else None))
        fast.publish(k * dt_ns, _well)


def _ignore(pose: PublishedPose) -> None:
    """Publish nothing."""


def _well() -> Health:
    return Health(0)


class _Latency:
    """Histogram of how long poses take from sample to publication: constant memory over days."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, dtype=np.int64)
        self._largest_ns = 0

    def add(self, ns: int) -> None:
        """Count one duration."""
        self._counts[min(max(ns, 0) // _BIN_NS, _BINS - 1)] += 1
        self._largest_ns = max(self._largest_ns, ns)

    def summary_ms(self) -> dict[str, float]:
        """Return quantiles, the largest and the count; only the count while there is none."""
        count = int(self._counts.sum())
        if count == 0:
            return {"count": 0}
        below = np.cumsum(self._counts)
        quantiles = {name: (int(np.searchsorted(below, q * count)) + 1) * _BIN_NS * 1e-6 for name, q in _PARTS.items()}
        return {**quantiles, "max": self._largest_ns * 1e-6, "count": count}
