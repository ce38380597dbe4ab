"""What does a sensor of one's own cost, in plain Python and without derivatives, beside built-in kinds?

    .venv/bin/python benchmarks/sensor_cost.py                # --seconds 20 --rate 50 --rounds 3

Two pairs of about equal complexity: the laser that looks down (examples/10) beside `height`, each a number with one own
variable; and a Doppler log with a lever arm and three own variables beside `twist` with its mounting estimated. A
simulated cart with two cameras and an IMU goes through filter and graph without any of them and with each, readings 50
times a second; runs take turns and of each number the least counts. `linearised` is one reading as a linear system,
`filter` and `graph` what a reading adds to a run. Times are CPU time of this process; the ratios are the result.
"""

from __future__ import annotations

import argparse
import heapq
import importlib.util
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from vislam import Config, Slam, open_source  # noqa: E402
from vislam.config.ranges import NonNegative, Positive  # noqa: E402
from vislam.core.messages import Array  # noqa: E402
from vislam.core.readings import Reading  # noqa: E402
from vislam.core.recording import Recording  # noqa: E402
from vislam.sensors import BodyState, Configured, Suite, Variable, linearised  # noqa: E402
from vislam.sensors.kinds import Height, Twist, TwistSettings  # noqa: E402
from vislam.sensors.simulated import bodies_on, drawn_readings  # noqa: E402

TIMES = 7
LEVER_M = (0.2, 0.1, -0.3)


@dataclass(frozen=True)
class DopplerSettings:
    """The keys of its table."""

    sigma_m_s: Positive = 0.03
    scale_sigma: NonNegative = 0.02
    mount_sigma_rad: NonNegative = 0.05


class DopplerLog(Configured):
    """Velocity over ground of a point of the body, in axes whose yaw and pitch against it are not known well."""

    Settings = DopplerSettings
    columns = ("vx_m_s", "vy_m_s", "vz_m_s")
    touches = ("rotation", "velocity", "gyro_bias")

    def __init__(self, settings: DopplerSettings | None = None) -> None:
        """Take settings; the defaults without any."""
        self.settings = s = settings or DopplerSettings()
        mount = [Variable(name, s.mount_sigma_rad) for name in ("yaw_rad", "pitch_rad")]
        self.variables = (Variable("scale", s.scale_sigma, 1.0), *mount)
        self.lever_m = np.array(LEVER_M)

    def predicted(self, body: BodyState, own: Array) -> Array:
        """Return what it tells [3] of a body."""
        velocity = body.R_world_body.T @ body.velocity_m_s + np.cross(body.rate_rad_s, self.lever_m)
        c, s, cp, sp = math.cos(own[1]), math.sin(own[1]), math.cos(own[2]), math.sin(own[2])
        R_log_body = np.array([[cp * c, cp * s, -sp], [-s, c, 0.0], [sp * c, sp * s, cp]])
        return R_log_body @ velocity / own[0]

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return measured minus predicted velocity [3]."""
        return values - self.predicted(body, own)

    def noise(self, values: Array) -> Array:
        """Return the covariance [3, 3]."""
        return self.settings.sigma_m_s**2 * np.eye(3)

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return the velocity that it tells of a true body."""
        return self.predicted(body, own) + self.settings.sigma_m_s * rng.normal(size=3)


def example_laser() -> Configured:
    """Return the sensor of examples/10_own_sensor.py."""
    spec = importlib.util.spec_from_file_location("own_sensor", ROOT / "examples" / "10_own_sensor.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sensor: Configured = module.DownwardLaser()
    return sensor


def pairs() -> list[tuple[str, Configured, str, Configured]]:
    """Return sensors of one's own, each beside a built-in one that is about as complex."""
    twist = Twist(TwistSettings(mount_sigma_rad=0.05))
    return [("laser", example_laser(), "height", Height()), ("doppler", DopplerLog(), "twist", twist)]


def least_us(work: Callable[[], object], calls: int) -> float:
    """Return CPU microseconds of a call, the least of several rounds of `calls`."""
    work()
    best = math.inf
    for _ in range(TIMES):
        begun_s = time.process_time()
        for _ in range(calls):
            work()
        best = min(best, time.process_time() - begun_s)
    return 1e6 * best / calls


def linearised_us(
    sensor: Configured, readings: list[Reading], bodies: list[BodyState], own: Array, calls: int
) -> float:
    """Return CPU microseconds of a reading as a linear system."""
    k = len(readings) // 2
    return least_us(lambda: linearised(sensor, readings[k], bodies[k], own), calls)


def run_ms(recording: Recording, suite: Suite | None, readings: list[Reading]) -> tuple[float, float]:
    """Return CPU milliseconds of a run, and of its graph alone."""
    slam = Slam(Config(), recording.rig, recording.imu_noise, suite)
    begun_s = time.process_time()
    for value in heapq.merge(recording.events(), readings, key=lambda value: value.t_ns):
        slam.feed(value)
    slam.finish()
    whole_s = time.process_time() - begun_s
    stages = slam.clock.summary_ms()
    graph_s = sum(stages[name]["cpu_s"] for name in ("graph", "graph finish") if name in stages)
    return 1e3 * whole_s, 1e3 * graph_s


def main() -> None:
    """Print what a reading costs, and what it costs in a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="of the drive")
    parser.add_argument("--rate", type=float, default=50.0, help="readings a second")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each, of which the least counts")
    parser.add_argument("--calls", type=int, default=500, help="of `linearised`, in each of several rounds")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    recording = open_source(f"points:workshop-cart,rig=stereo,duration_s={args.seconds},camera_hz=10,tracks=100")
    truth = recording.truth()
    assert truth is not None
    t_ns = np.arange(int(truth.t_ns[0]) + 10**8, int(truth.t_ns[-1]) - 10**8, round(1e9 / args.rate), dtype=np.int64)
    bodies = bodies_on(truth, t_ns)
    sensors = {name: sensor for pair in pairs() for name, sensor in (pair[:2], pair[2:])}
    owns = {name: np.array([variable.start for variable in sensor.variables]) for name, sensor in sensors.items()}
    readings = {name: drawn_readings(name, sensors[name], bodies, owns[name], seed=1) for name in sensors}
    one_us = {name: linearised_us(sensors[name], readings[name], bodies, owns[name], args.calls) for name in sensors}
    runs: dict[str, list[tuple[float, float]]] = {}
    for _ in range(args.rounds):
        runs.setdefault("none", []).append(run_ms(recording, None, []))
        for name, sensor in sensors.items():
            runs.setdefault(name, []).append(run_ms(recording, Suite({name: sensor}), readings[name]))
    least = {name: np.min(found, axis=0) for name, found in runs.items()}
    print(
        f"{args.seconds:g} s of run without them: {least['none'][0]:.0f} ms of CPU, {least['none'][1]:.0f} in the graph"
    )
    print(f"{'us a reading':14s}{'linearised':>11s}{'filter':>8s}{'graph':>8s}{'both':>8s}{'CPU share':>11s}")
    added = {}
    for name in sensors:
        whole, graph = 1e3 * (least[name] - least["none"]) / len(readings[name])
        added[name] = np.array([one_us[name], whole - graph, graph, whole])
        share = 1e-6 * whole * args.rate
        print(f"{name:14s}{one_us[name]:11.0f}{whole - graph:8.0f}{graph:8.0f}{whole:8.0f}{share:10.2%}")
    for own, _, built_in, _ in pairs():
        ratios = added[own] / added[built_in]
        print(f"{own} / {built_in}: " + ", ".join(f"{ratio:.2f}" for ratio in ratios))


if __name__ == "__main__":
    main()
