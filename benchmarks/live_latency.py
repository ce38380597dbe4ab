"""How late is the published pose while the back end closes a loop over 1,000 keyframes? Real processes, real time.

    .venv/bin/python benchmarks/live_latency.py processes --seconds 60
    .venv/bin/python benchmarks/live_latency.py processes --priority 50        # SCHED_FIFO, where the system permits
    .venv/bin/python benchmarks/live_latency.py filter
    NUMBA_DISABLE_JIT=1 .venv/bin/python benchmarks/live_latency.py filter     # what it costs without a compiler

`processes` runs the fast process of `vislam live` on samples at 400 Hz, with 20 corrections a second that come 50 ms
late from a second process, beside a third one that holds a pose graph of 1,000 keyframes and more, and closes a loop
over 1,000 with every tenth. A fourth one listens to the datagrams: from a sample's stamp to when a reader has it. No
sample may be lost. Quantiles hold for the machine as it is: close everything else. `filter` times the filter's
arithmetic, least of many short rounds.
"""

from __future__ import annotations

import argparse
import gc
import os
import pickle
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import numpy as np  # noqa: E402

RATE_HZ = 400.0
FRAME_EVERY = 20  # samples
LATE_S = 0.05
KEYFRAMES = 1000


def correct(connection, seconds: float, ready, go, epoch) -> None:
    """Send the corrections of a body at rest, each 50 ms late."""
    from vislam.core.messages import NavState, Tracking, VoMeasurement, no_observations
    from vislam.ekf import Correction
    from vislam.live.notices import Start

    ready.wait()
    while not go.wait(1.0):
        continue
    begin_ns = epoch.begin_ns()
    for k in range(int(seconds * RATE_HZ / FRAME_EVERY)):
        t_ns = begin_ns + int((0.5 + k * FRAME_EVERY / RATE_HZ) * 1e9)
        time.sleep(max(0.0, (t_ns - time.monotonic_ns()) * 1e-9 + LATE_S))
        vo = VoMeasurement(t_ns, max(k - 1, 0) // 10, np.eye(4), np.eye(6) * 1e-6, True, Tracking.OK, 100)
        if k == 0:
            state = NavState(t_ns, np.eye(4), *(np.zeros(3) for _ in range(3)), np.eye(15) * 1e-4)
            connection.send(Start(state, vo))
        connection.send(Correction(t_ns, vo, no_observations(), False, False, k // 10 if k % 10 == 0 else None))


def close_loops(connection, stop, grown, closed, keyframes) -> None:
    """Build a graph of so many keyframes, then add more and close a loop over all of them with every tenth."""
    from vislam.config import GraphConfig, MachineConfig, WindowConfig
    from vislam.graph import PoseGraph
    from vislam.live.notices import MapMoved
    from worlds.lap import RIG, World

    world = World(duration_s=2.0 * keyframes / 5.0)
    graph = PoseGraph(GraphConfig(coupling="loose"), world.noise, MachineConfig(), RIG, WindowConfig())
    graph.initialise(world.initial_state(), world.truth[0])
    T_odom_body = world.truth[0]
    for k in range(2 * keyframes):
        if k == keyframes:
            grown.set()
        if stop.is_set():
            return
        is_closed = k >= keyframes and k % 10 == 0
        packet, edges = world.packet(k), [world.loop(k, k - keyframes, k)] if is_closed else []
        T_odom_body = T_odom_body @ packet.vo.T_keyframe_body
        began = time.monotonic()
        update = graph.add(packet, edges, T_odom_body)
        if k >= keyframes:  # before, nobody reads yet, and the pipe would fill
            connection.send(MapMoved(update.revision, update.T_map_odom))
        if is_closed:
            closed.append(time.monotonic() - began)


def listen(address: str, results, ready, stop) -> None:
    """Note for each datagram how old its sample is when it is here."""
    from vislam.live.wire.publisher import PoseListener

    listener = PoseListener(address)
    gc.disable()  # a collection would keep it from reading for a hundred milliseconds
    ready.wait()
    ages, sequences, quiet = [], [], 0
    while quiet < 5 or not (ages or stop.is_set()):
        pose = listener.next(1.0)
        quiet = 0 if pose is not None else quiet + 1
        if pose is not None:
            ages.append(time.monotonic_ns() - pose.t_ns)
            sequences.append((pose.sequence, pose.t_ns, pose.published_ns))
    listener.close()
    results.put((np.array(ages), np.array(sequences)))


def fast(signals, samples, inbox, settings, epoch, table, report) -> None:
    """Run the fast process as `vislam live` does."""
    from functools import partial

    from vislam.config import load
    from vislam.imu import BiasMemory, ImuNoise
    from vislam.live.processes import fast as fast_process
    from vislam.live.processes.child import guarded
    from vislam.live.replayed_imu import ReplayedImu
    from vislam.sensors import Suite

    config = load(None, settings)
    noise = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4, RATE_HZ)
    body = partial(
        fast_process.run, config=config, noise=noise, T_body_camera=np.eye(4),
        open_source=partial(ReplayedImu, table, epoch), samples=samples, inbox=inbox,
        memory=BiasMemory(limit=1), is_mag_calibrated=False, suite=Suite(),
    )  # fmt: skip
    guarded("fast", report, signals, body)


def heard(connection) -> dict | None:
    """Return the next message of the fast process, None when it is ready. Raises SystemExit if it failed."""
    from vislam.live.processes.child import Failure, Ready

    said = connection.recv()
    if isinstance(said, Failure):
        raise SystemExit(said.traceback)
    return None if isinstance(said, Ready) else getattr(said, "values", {})


def processes(seconds: float, priority: int, keyframes: int) -> None:  # noqa: PLR0915
    """Measure."""
    import socket

    from vislam.live.epoch import Epoch
    from vislam.live.processes.child import Flag, Signals
    from vislam.live.replayed_imu import InertialTable

    context = get_context("spawn")
    ready, grown, stop, go = context.Barrier(3), context.Event(), Flag(), Flag()
    signals, epoch, results = Signals(go, stop), Epoch(), context.Queue()
    count = int(seconds * RATE_HZ)
    rng = np.random.default_rng(0)
    samples = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81]) + rng.normal(size=(count, 6)) * np.repeat([0.02, 0.2], 3)
    table = InertialTable((np.arange(count) * (1e9 / RATE_HZ)).astype(np.int64), samples, RATE_HZ)
    to_front, at_front = socket.socketpair()
    hears_front, front_says = context.Pipe(duplex=False)
    hears_back, back_says = context.Pipe(duplex=False)
    hears, says = context.Pipe(duplex=False)
    with context.Manager() as manager, tempfile.TemporaryDirectory() as folder:
        closed, address = manager.list(), f"unix:{folder}/pose.sock"
        settings = {
            "live.name": f"bench-{os.getpid()}",
            "live.send_to": [address],
            "live.realtime_priority": priority,
        }
        listener = context.Process(target=listen, args=(address, results, ready, stop))
        publisher = context.Process(
            target=fast, args=(signals, to_front, [hears_front, hears_back], settings, epoch, table, says)
        )
        front = context.Process(target=correct, args=(front_says, seconds - 1.0, ready, go, epoch))
        back = context.Process(target=close_loops, args=(back_says, stop, grown, closed, keyframes))
        for process in (listener, publisher, front, back):
            process.daemon = True  # none stays behind when another fails
            process.start()
        ready.wait()
        last = {}
        while (values := heard(hears)) is not None:
            last |= values
        grown.wait()
        go.set()
        taken = 0
        at_front.settimeout(10.0)
        while True:
            try:
                taken += len(at_front.recv(1 << 16))
            except TimeoutError:
                break
            while hears.poll():
                last |= heard(hears) or {}
        stop.set()
        ages, poses = results.get()
        publisher.join()
        while hears.poll():
            last |= heard(hears) or {}
        front.join()
        back.join()
        listener.join()
        loops = list(closed)
    if len(poses) == 0:
        raise SystemExit("no pose came to the reader: this machine is too busy")
    fresh = np.diff(poses[:, 1], prepend=poses[0, 1]) > 0  # the others are heartbeats, as is the first
    print(f"SCHED_FIFO {priority}" if priority and "warning" not in last else "no real-time priority")
    print(f"load {os.getloadavg()[0]:.1f}, {os.cpu_count()} CPUs, {count} samples in {seconds:g} s")
    print(f"loops closed over {keyframes} keyframes: {len(loops)}, at most {max(loops, default=0.0):.2f} s each")
    inside = (poses[fresh, 2] - poses[fresh, 1]) / 1e6
    for title, values_ms in (("sample to publication", inside), ("sample to reader", ages[fresh] / 1e6)):
        p50, p99, p999 = np.percentile(values_ms, [50, 99, 99.9])
        print(f"{title:22} p50 {p50:.3f}  p99 {p99:.3f}  p99.9 {p999:.3f}  max {values_ms.max():.2f} ms")
    print(f"samples: {count} made, {int(fresh.sum())} came to the reader, {taken // 64} to vision")
    print(f"counters: {last.get('counters')}, vision accepted {last.get('filter', {}).get('vo_accepted')} times")


def least_us(work: Callable[[], object], calls: int, rounds: int) -> float:
    """Return the time of one call in microseconds, least of many rounds that are too short to be interrupted."""
    work()
    best = np.inf
    for _ in range(rounds):
        began = time.perf_counter()
        for _ in range(calls):
            work()
        best = min(best, time.perf_counter() - began)
    return best / calls * 1e6


def filter_cost() -> None:
    """Print what predicting, correcting and replaying cost."""
    from numba import config

    from vislam.ekf.loose import kernels

    x, P = np.zeros(23), np.eye(21) * 1e-4
    x[6] = x[19] = 1.0
    sigmas = np.array([1e-3, 1e-2, 1e-5, 1e-4, 0.5, 2.0])
    sample = np.array([0.01, 0.02, 0.3, 0.1, 0.2, 9.8])
    H = np.zeros((6, 21))
    H[:, :6], H[:, 15:] = np.eye(6), -np.eye(6)
    noise, residual, moves = np.eye(6) * 1e-4, np.full(6, 1e-4), np.eye(21)

    t_ns = np.arange(41) * 2_500_000
    samples, gaps, track = np.tile(sample, (41, 1)), np.zeros(41), np.empty((41, 10))
    calls, rounds = (1, 30) if config.DISABLE_JIT else (20, 1000)
    print(f"compiled: {not config.DISABLE_JIT}; microseconds")
    for title, call in {
        "predict": lambda: kernels.predict(x, P, sample, sample, 0.0025, 0.0, sigmas, 9.81),
        "update, 6 rows": lambda: kernels.update(x, P, H, noise, residual, 1e3, moves),
        "replay of 100 ms at 400 Hz": lambda: kernels.predict_run(x, P, t_ns, samples, gaps, track, sigmas, 9.81),
    }.items():
        print(f"  {title:28} {least_us(call, calls, rounds):10.2f}")
    print(f"  {'frame, 50 ms late, in all':28} {late_frame_us(rounds):10.2f}")


def late_frame_us(frames: int) -> float:
    """Return what a motion that comes 50 ms late costs the process of the pose, least of many."""
    from vislam.config import load
    from vislam.core.messages import ImuSample, NavState, Tracking, VoMeasurement, no_observations
    from vislam.ekf import Correction
    from vislam.imu import ImuNoise
    from vislam.live.fast import FastPath
    from vislam.live.notices import Start

    noise, dt_ns = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4, RATE_HZ), int(1e9 / RATE_HZ)
    fast = FastPath(load(None, {}), noise, np.eye(4), lambda pose: None)
    best = np.inf
    for k in range(frames):
        for i in range(k * FRAME_EVERY, (k + 1) * FRAME_EVERY):
            fast.add(ImuSample(i * dt_ns, np.zeros(3), np.array([0.0, 0.0, 9.81])))
        vo = VoMeasurement(k * FRAME_EVERY * dt_ns, 0, np.eye(4), np.eye(6) * 1e-6, True, Tracking.OK, 100)
        if k == 0:
            fast.correct(Start(NavState(0, np.eye(4), *np.zeros((3, 3)), np.eye(15) * 1e-4), vo))
        message = pickle.dumps(Correction(vo.t_ns, vo, no_observations(), False, False, None))
        began = time.perf_counter()
        fast.correct(pickle.loads(message))  # noqa: S301 what was just made
        best = min(best, time.perf_counter() - began) if k > 0 else best
    return best * 1e6


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["processes", "filter"])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--keyframes", type=int, default=KEYFRAMES, help="of the graph, before the first loop")
    parser.add_argument("--priority", type=int, default=0, help="live.realtime_priority of the fast process")
    arguments = parser.parse_args()
    if arguments.what == "filter":
        filter_cost()
    else:
        processes(arguments.seconds, arguments.priority, arguments.keyframes)


if __name__ == "__main__":
    main()
