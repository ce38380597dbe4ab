"""What the filter costs and whether its covariance is honest.

    .venv/bin/python benchmarks/ekf.py cost
    .venv/bin/python benchmarks/ekf.py nees --runs 100 --jobs 2
    .venv/bin/python benchmarks/ekf.py nees --runs 20 --only "cart, on time" --odom corrected --vision accumulated
    .venv/bin/python benchmarks/ekf.py soak --minutes 60

`cost` times one prediction and one correction against the same filter in plain numpy and against gtsam's NavStateImuEKF
(9 states, no biases, no clone), alternating within one run: the ratios are the result. `nees` runs the Monte-Carlo
campaign: simulated noise known exactly, so no inflation; numbers are NEES per degree of freedom, "!" where the average
leaves the 95 % chi-square band of so many runs, and the fraction of seconds inside it. `soak` drives for an hour and
reports the smallest eigenvalue the covariance ever had. Times are CPU time of this process.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import gtsam  # noqa: E402
import numpy as np  # noqa: E402

import results  # noqa: E402
from vislam.config import EkfConfig  # noqa: E402
from vislam.core.messages import Array, ImuSample  # noqa: E402
from vislam.ekf import Ekf  # noqa: E402
from vislam.ekf.loose import kernels  # noqa: E402
from worlds import monte_carlo as mc  # noqa: E402
from worlds.parts import GRAVITY_M_S2, MACHINE  # noqa: E402

DT = 1.0 / mc.IMU.rate_hz
SIGMAS = np.array(
    [
        mc.IMU.gyroscope_noise_density,
        mc.IMU.accelerometer_noise_density,
        mc.IMU.gyroscope_random_walk,
        mc.IMU.accelerometer_random_walk,
        0.0,
        0.0,
    ]
)


def hat(v: Array) -> Array:
    """Return the cross-product matrix [3, 3]."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def exp(w: Array) -> Array:
    """Return the rotation [3, 3] of a rotation vector."""
    angle = np.sqrt(w @ w)
    K = hat(w)
    if angle < 1e-8:
        return np.eye(3) + K
    return np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / angle**2 * K @ K


def left_jacobian(w: Array) -> Array:
    """Return the left Jacobian [3, 3] of SO(3)."""
    angle = np.sqrt(w @ w)
    K = hat(w)
    if angle < 1e-8:
        return np.eye(3) + 0.5 * K
    return np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * K @ K


class NumpyFilter:
    """The same equations without a compiler: dense matrices, rotations instead of quaternions."""

    def __init__(self, x: Array, P: Array) -> None:
        self.R, self.R_clone = kernels.pose(x, 0, 6)[:3, :3], kernels.pose(x, 16, 19)[:3, :3]
        self.p, self.v, self.p_clone = x[0:3].copy(), x[3:6].copy(), x[16:19].copy()
        self.accel_bias, self.gyro_bias = x[10:13].copy(), x[13:16].copy()
        self.P = P.copy()

    def predict(self, rate0: Array, rate1: Array, dt: float) -> None:
        """Do what `kernels.predict` does."""
        mean = 0.5 * (rate0 + rate1)
        w, a = (mean[:3] - self.gyro_bias) * dt, mean[3:] - self.accel_bias
        R, M = self.R, self.R @ exp(0.5 * w)
        force = M @ a
        F = np.eye(21)
        F[0:3, 0:3] = exp(-w)
        F[0:3, 9:12] = -dt * left_jacobian(-w)
        F[6:9, 0:3] = -dt * R @ hat(R.T @ force)
        F[6:9, 9:12] = 0.5 * dt * dt * M @ hat(a)
        F[6:9, 12:15] = -dt * M
        F[3:6] += 0.5 * dt * F[6:9]
        F[3:6, 6:9] = dt * np.eye(3)
        Q = np.zeros((21, 21))
        gyro, accel, gyro_walk, accel_walk = SIGMAS[:4] ** 2 * dt
        Q[0:3, 0:3] = gyro * np.eye(3)
        Q[3:6, 3:6] = accel * dt * dt / 3.0 * np.eye(3)
        Q[3:6, 6:9] = Q[6:9, 3:6] = 0.5 * dt * accel * np.eye(3)
        Q[6:9, 6:9] = accel * np.eye(3)
        Q[9:12, 9:12], Q[12:15, 12:15] = gyro_walk * np.eye(3), accel_walk * np.eye(3)
        self.P = F @ self.P @ F.T + Q
        self.P = 0.5 * (self.P + self.P.T)
        force = force - np.array([0.0, 0.0, GRAVITY_M_S2])
        self.p = self.p + dt * self.v + 0.5 * dt * dt * force
        self.v = self.v + dt * force
        self.R = R @ exp(w)

    def correct(self, H: Array, noise: Array, residual: Array) -> None:
        """Do what `kernels.innovation` and `kernels.correct` do."""
        PHt = self.P @ H.T
        K = PHt @ np.linalg.inv(H @ PHt + noise)
        d, A, G = K @ residual, np.eye(21) - K @ H, np.eye(21)
        along, along_clone = left_jacobian(self.R @ d[0:3]), left_jacobian(self.R_clone @ d[15:18])
        moved = [along @ d[3:6], along @ d[6:9], along_clone @ d[18:21]]
        G[0:3, 0:3], G[15:18, 15:18] = exp(-d[0:3]), exp(-d[15:18])
        G[3:6, 0:3], G[6:9, 0:3] = -hat(moved[0]) @ self.R, -hat(moved[1]) @ self.R
        G[18:21, 15:18] = -hat(moved[2]) @ self.R_clone
        A, K = G @ A, G @ K
        self.P = A @ self.P @ A.T + K @ noise @ K.T
        self.P = 0.5 * (self.P + self.P.T)
        self.p, self.v, self.p_clone = self.p + moved[0], self.v + moved[1], self.p_clone + moved[2]
        self.R, self.R_clone = self.R @ exp(d[0:3]), self.R_clone @ exp(d[15:18])
        self.gyro_bias, self.accel_bias = self.gyro_bias + d[9:12], self.accel_bias + d[12:15]


def microseconds(work: Callable[[], None], calls: int) -> float:
    """Return CPU microseconds a call."""
    begin = time.process_time()
    for _ in range(calls):
        work()
    return (time.process_time() - begin) / calls * 1e6


def cost(rounds: int) -> dict[str, float]:
    """Print microseconds of the compiled filter and of its peers, and their ratios; return CPU ms of the filter."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(21, 21)) * 0.01
    x, P = np.zeros(kernels.NOMINAL), root @ root.T + 1e-6 * np.eye(21)
    x[6] = x[19] = 1.0
    rate0, rate1 = rng.normal(size=6), rng.normal(size=6)
    rate0[5] += GRAVITY_M_S2
    rate1[5] += GRAVITY_M_S2
    H, noise, residual = rng.normal(size=(6, 21)), 1e-2 * np.eye(6), rng.normal(size=6) * 1e-3
    plain = NumpyFilter(x, P)
    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY_M_S2)
    peer = gtsam.NavStateImuEKF(gtsam.NavState(), P[:9, :9].copy(), params)
    H9, mean = np.ascontiguousarray(H[:, :9]), 0.5 * (rate0 + rate1)

    ours = {
        "predict": lambda: kernels.predict(x, P, rate0, rate1, DT, 0.0, SIGMAS, GRAVITY_M_S2),
        "correct": lambda: kernels.update(x, P, H, noise, residual, 1e3, np.eye(21)),
    }
    numpy_ = {"predict": lambda: plain.predict(rate0, rate1, DT), "correct": lambda: plain.correct(H, noise, residual)}
    gtsam_ = {
        "predict": lambda: peer.predict(mean[:3], mean[3:], DT),
        "correct": lambda: peer.updateWithVector(residual, H9, 2.0 * residual, noise),
    }
    for name, work_of_ours in ours.items():  # warm, and the same answer
        work_of_ours()
        numpy_[name]()
    apart = max(np.abs(plain.P - P).max() / np.abs(P).max(), np.abs(plain.p - x[:3]).max())
    print(f"numpy and compiled filter differ by {apart:.1e} after one of each")
    times: dict[str, list[list[float]]] = {name: [] for name in ours}
    for _ in range(rounds):
        for name, rows in times.items():
            rows.append([microseconds(f[name], n) for f, n in ((ours, 2000), (numpy_, 200), (gtsam_, 1000))])
    print(
        f"{f'median of {rounds}':14s}{'compiled us':>13s}{'numpy us':>10s}{'gtsam us':>10s}{'numpy':>9s}{'gtsam':>9s}"
    )
    cpu_ms = {}
    for name, rows in times.items():
        table = np.array(rows)
        cpu_ms[f"kernel {name}"] = 1e-3 * float(np.median(table[:, 0]))
        a, b, c = np.median(table, axis=0)
        by_numpy, by_gtsam = np.median(table[:, 1] / table[:, 0]), np.median(table[:, 2] / table[:, 0])
        print(f"{name:14s}{a:13.2f}{b:10.1f}{c:10.2f}{by_numpy:8.1f}x{by_gtsam:8.2f}x")
    return cpu_ms | _whole_filter()


def _whole_filter() -> dict[str, float]:
    """Print what a caller waits for, and return it in CPU ms: bookkeeping, history and replay included."""
    cpu_ms = {}
    way = mc.drive("hand", 1, 20.0)
    samples = [ImuSample(int(t), v[:3], v[3:]) for t, v in zip(way.t_ns, way.samples, strict=True)]
    for delay_s in (0.0, 0.1, 0.25):
        scenario = mc.Scenario("", delay_s=delay_s, duration_s=20.0)
        rng = np.random.default_rng(1)
        ekf = Ekf(mc.honest(), mc.IMU, MACHINE)
        ekf.initialise(mc.start(way, scenario.start_sigmas, rng))
        deliveries, i, in_vision, frames = list(mc.vision(scenario, way, rng)), 0, 0.0, 0
        begin = time.process_time()
        for sample in samples:
            ekf.predict(sample)
            while i < len(deliveries) and deliveries[i][0] <= sample.t_ns:
                before = time.process_time()
                mc.deliver(ekf, *deliveries[i][1:])
                in_vision += time.process_time() - before
                i, frames = i + 1, frames + 1
        rest = time.process_time() - begin - in_vision
        print(
            f"Ekf.predict {rest / len(samples) * 1e6:6.1f} us a sample, "
            f"update_vo {in_vision / frames * 1e6:6.0f} us a frame that is {delay_s * 1e3:3.0f} ms late"
        )
        cpu_ms[f"update_vo {delay_s * 1e3:.0f} ms late"] = 1e3 * in_vision / frames
    return cpu_ms | {"predict": 1e3 * rest / len(samples)}


def one(job: tuple[mc.Scenario, EkfConfig, int]) -> mc.Run:
    """Return one run of the campaign; a function of the module, for the pool."""
    return mc.run(*job)


def nees(args: argparse.Namespace) -> None:
    """Print the campaign's table, a row as soon as it is there."""
    chosen = [s for s in mc.SCENARIOS if not args.only or s.name in args.only]
    if not chosen:
        sys.exit(f"no such scenario; there are: {', '.join(s.name for s in mc.SCENARIOS)}")
    config = mc.honest(odom=args.odom, vision=args.vision)
    print(f"{args.runs} runs of 60 s, seeds {args.seed}..{args.seed + args.runs - 1}, {args.vision}, odom {args.odom}")
    for group, degrees in (("all", 15), ("rotation, position, velocity, biases", 3), ("yaw", 1)):
        low, high = mc.band(degrees, args.runs)
        print(f"95 % band of {group}: {low / degrees:.3f} to {high / degrees:.3f}")
    begin, header = time.perf_counter(), True
    with ProcessPoolExecutor(args.jobs) as pool:
        for scenario in chosen:
            jobs = [(scenario, config, args.seed + i) for i in range(args.runs)]
            result = mc.Consistency(list(pool.map(one, jobs, chunksize=5)))
            lines = list(mc.table([(scenario.name, result)]))
            print("\n".join(lines if header else lines[1:]), flush=True)
            header = False
    print(f"{time.perf_counter() - begin:.0f} s with {args.jobs} processes")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    verb = verbs.add_parser("cost", help="microseconds against numpy and gtsam")
    verb.add_argument("--rounds", type=int, default=9)
    verb.add_argument("--record", action="store_true", help="keep the times in benchmarks/results")
    verb = verbs.add_parser("nees", help="the Monte-Carlo campaign")
    verb.add_argument("--runs", type=int, default=100)
    verb.add_argument("--seed", type=int, default=5000, help="of the first run")
    verb.add_argument("--only", action="append", metavar="SCENARIO", help="by name; again for more")
    verb.add_argument("--odom", choices=["continuous", "corrected"], default="continuous")
    verb.add_argument("--vision", choices=["relative", "accumulated"], default="relative")
    verb.add_argument("--jobs", type=int, default=1)
    verb = verbs.add_parser("soak", help="does the covariance stay one?")
    verb.add_argument("--minutes", type=float, default=60.0)
    args = parser.parse_args()
    if args.verb == "cost":
        cpu_ms = cost(args.rounds)
        if args.record:
            results.record("ekf", cpu_ms)
    elif args.verb == "nees":
        nees(args)
    else:
        smallest, counters = mc.soak(args.minutes * 60.0, mc.honest())
        print({name: count for name, count in counters.items() if count}, f"smallest eigenvalue {smallest:.2e}")


if __name__ == "__main__":
    main()
