"""The sliding window against gtsam's fixed-lag smoother, on the same simulated packets.

    .venv/bin/python benchmarks/window.py
    .venv/bin/python benchmarks/window.py --seconds 30 --seeds 3 --tracks 80 --keyframes 15
    .venv/bin/python benchmarks/window.py nees --runs 20

One pinhole camera (1 px noise) and a EuRoC-like IMU move through a room of random landmarks, 5 keyframes a second.
The peers are `IncrementalFixedLagSmoother` with Galilean preintegration and (a) smart projection factors, replaced as a
track grows and left to be marginalised when it reaches the end of the window, or (b) explicit landmarks with a Huber
kernel. Each estimator runs in a process of its own, for gtsam can end it; that is reported, not hidden. Times are CPU
time per keyframe, factor building included. `nees` runs our window alone and prints the normalised error per degree of
freedom of the newest state, with the 95 % band of that many runs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import numpy as np  # noqa: E402

import results  # noqa: E402
from vislam.config import WindowConfig  # noqa: E402
from vislam.core.messages import Array, KeyframePacket, NavState  # noqa: E402
from vislam.window import SlidingWindow  # noqa: E402
from worlds.motion import Motion, state_error  # noqa: E402
from worlds.parts import GRAVITY_M_S2, MACHINE  # noqa: E402
from worlds.room import MONO, PINHOLE, START_SIGMAS, T_BODY_CAM0, World, start_state  # noqa: E402

WARM_UP = 20  # keyframes before times count: compilation, and a window that is not full yet
MIN_VIEWS = 4  # before a peer's explicit landmark is triangulated


def world(seed: int, args: argparse.Namespace) -> World:
    """Return the world of a seed."""
    return World(Motion.random(seed), MONO, seed, duration_s=args.seconds, tracks=args.tracks)


def run_ours(packets: list[KeyframePacket], start: NavState, keyframes: int) -> tuple[Array, list[float]]:
    """Return positions [N, 3] as they were when each keyframe was the newest, and seconds of CPU for each."""
    window = SlidingWindow(replace(WindowConfig(), keyframes=keyframes), MONO, World.noise, MACHINE)
    window.initialise(start)
    positions, times = [], []
    for packet in packets:
        t0 = time.process_time()
        update = window.add(packet)
        times.append(time.process_time() - t0)
        positions.append(update.T_local_body[-1][:3, 3])
    return np.array(positions), times


@dataclass
class Track:
    """What a peer knows of a track."""

    views: list[tuple[int, Array]] = field(default_factory=list)  # keyframe, pixel
    slot: int = -1  # of its factor in the smoother
    in_graph: bool = False  # its landmark is a variable


class Peer:
    """gtsam's incremental fixed-lag smoother, fed as its own examples and its rules ask for."""

    def __init__(self, start: NavState, keyframes: int, smart: bool) -> None:
        import gtsam

        self.g = gtsam
        self.smart, self.lag = smart, keyframes
        isam = gtsam.ISAM2Params()
        isam.findUnusedFactorSlots = True
        isam.relinearizeSkip = 1
        isam.setRelinearizeThreshold(0.01)
        self.smoother = gtsam.IncrementalFixedLagSmoother(keyframes + 0.5, isam)
        self.calibration = gtsam.Cal3_S2(PINHOLE.fx, PINHOLE.fy, 0.0, PINHOLE.cx, PINHOLE.cy)
        self.T_body_cam = gtsam.Pose3(T_BODY_CAM0)
        self.pixel = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
        self.robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(2.0), self.pixel)
        self.smart_params = gtsam.SmartProjectionParams(
            gtsam.LinearizationMode.HESSIAN, gtsam.DegeneracyMode.ZERO_ON_DEGENERACY
        )
        self.smart_params.setLandmarkDistanceThreshold(30.0)
        params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_M_S2)
        noise = World.noise
        params.setGyroscopeCovariance(np.eye(3) * noise.gyroscope_noise_density**2)
        params.setAccelerometerCovariance(np.eye(3) * noise.accelerometer_noise_density**2)
        params.setIntegrationCovariance(np.eye(3) * 1e-8)
        params.setBiasOmegaCovariance(np.eye(3) * noise.gyroscope_random_walk**2)
        params.setBiasAccCovariance(np.eye(3) * noise.accelerometer_random_walk**2)
        self.params = params
        self.tracks: dict[int, Track] = {}
        self.names: dict[int, int] = {}  # the front end's id -> ours: a track starts again under a new name
        self.next_name = 0
        self.bias = gtsam.imuBias.ConstantBias(start.accel_bias_m_s2, start.gyro_bias_rad_s)
        self.state = gtsam.NavState(gtsam.Pose3(start.T_world_body), start.velocity_world_m_s)
        self.k = -1

    def add(self, packet: KeyframePacket) -> Array:
        """Return the position [3] of the new keyframe."""
        g, self.k = self.g, self.k + 1
        k = self.k
        X, V, B = (g.symbol(c, k) for c in "xvb")
        graph, values, stamps, remove = g.NonlinearFactorGraph(), g.Values(), {}, []
        if k == 0:
            pose, velocity = self.state.pose(), self.state.velocity()
            gauge = np.concatenate([START_SIGMAS[:3], START_SIGMAS[3:6]])
            graph.addPriorPose3(X, pose, g.noiseModel.Diagonal.Sigmas(gauge))
            graph.add(g.PriorFactorVector(V, velocity, g.noiseModel.Diagonal.Sigmas(START_SIGMAS[6:9])))
            sigmas = np.concatenate([START_SIGMAS[12:], START_SIGMAS[9:12]])
            graph.addPriorConstantBias(B, self.bias, g.noiseModel.Diagonal.Sigmas(sigmas))
        else:
            pim = g.PreintegratedCombinedMeasurementsG(self.params, self.bias)
            span = packet.imu
            dt = np.diff(span.t_ns) * 1e-9
            accel, gyro = (
                0.5 * (span.accel_m_s2[1:] + span.accel_m_s2[:-1]),
                0.5 * (span.gyro_rad_s[1:] + span.gyro_rad_s[:-1]),
            )
            for i in range(len(dt)):
                pim.integrateMeasurement(accel[i], gyro[i], dt[i])
            before = (g.symbol(c, k - 1) for c in "xvb")
            Xb, Vb, Bb = before
            graph.add(g.GalileanCombinedImuFactor(Xb, Vb, X, V, Bb, B, pim))
            self.state = pim.predict(self.state, self.bias)
        values.insert(X, self.state.pose())
        values.insert(V, self.state.velocity())
        values.insert(B, self.bias)
        for key in (X, V, B):
            stamps[key] = float(k)
        self._extend(packet)
        new = self._smart(graph, remove) if self.smart else self._landmarks(graph, values, stamps)
        self.smoother.update(graph, values, stamps, remove)
        if self.smart and new:
            slots = self.smoother.getISAM2Result().getNewFactorsIndices()
            for name, index in new:
                self.tracks[name].slot = slots[index]
        pose = self.smoother.calculateEstimatePose3(X)
        velocity = self.smoother.calculateEstimate([V]).atVector(V)
        self.bias = self.smoother.calculateEstimateConstantBias(B)
        self.state = g.NavState(pose, velocity)
        return np.asarray(pose.translation())

    def _extend(self, packet: KeyframePacket) -> None:
        seen = packet.observations
        for track_id, pixel in zip(seen.track_ids.tolist(), seen.pixels_px, strict=True):
            name = self.names.get(track_id, -1)
            if name not in self.tracks or self.tracks[name].views[-1][0] != self.k - 1:
                name, self.next_name = self.next_name, self.next_name + 1
                self.names[track_id] = name
                self.tracks[name] = Track()
            self.tracks[name].views.append((self.k, pixel))

    def _smart(self, graph: Any, remove: list[int]) -> list[tuple[int, int]]:
        g, new = self.g, []
        oldest = max(0, self.k - self.lag)
        for name, track in list(self.tracks.items()):
            if track.views[0][0] < oldest:  # its factor is marginalised now; deleting it would lose what it knows
                del self.tracks[name]
                if track.views[-1][0] == self.k:
                    self.tracks[self.next_name] = Track([track.views[-1]])
                    for track_id, known in self.names.items():
                        if known == name:
                            self.names[track_id] = self.next_name
                            break
                    self.next_name += 1
                continue
            if track.views[-1][0] < self.k or len(track.views) < 2:
                continue
            factor = g.SmartProjectionPoseFactorCal3_S2(
                self.pixel, self.calibration, self.T_body_cam, self.smart_params
            )
            for k, pixel in track.views:
                factor.add(pixel, g.symbol("x", k))
            if track.slot >= 0:
                remove.append(track.slot)
            new.append((name, graph.size()))
            graph.add(factor)
        return new

    def _landmarks(self, graph: Any, values: Any, stamps: dict[int, float]) -> list[tuple[int, int]]:
        g, oldest = self.g, max(0, self.k - self.lag)
        for name, track in list(self.tracks.items()):
            if track.views[-1][0] < self.k:
                if track.views[-1][0] < oldest:
                    del self.tracks[name]
                continue
            key = g.symbol("l", name)
            views = [v for v in track.views if v[0] >= oldest]
            if not track.in_graph:
                point = self._triangulate(views) if len(views) >= MIN_VIEWS else None
                if point is None:
                    continue
                values.insert(key, point)
                graph.add(g.PriorFactorPoint3(key, point, g.noiseModel.Isotropic.Sigma(3, 3.0)))
                track.in_graph = True
            else:
                views = views[-1:]
            for k, pixel in views:
                graph.add(
                    g.GenericProjectionFactorCal3_S2(
                        pixel, self.robust, g.symbol("x", k), key, self.calibration, self.T_body_cam
                    )
                )
            stamps[key] = float(self.k)
        return []

    def _triangulate(self, views: list[tuple[int, Array]]) -> Array | None:
        g = self.g
        cameras, pixels = g.CameraSetCal3_S2(), []
        for k, pixel in views:
            pose = self.state.pose() if k == self.k else self.smoother.calculateEstimatePose3(g.symbol("x", k))
            cameras.append(g.PinholeCameraCal3_S2(pose.compose(self.T_body_cam), self.calibration))
            pixels.append(pixel)
        try:
            point = g.triangulatePoint3(cameras, pixels, 1e-9, True)
        except RuntimeError:
            return None
        distance = np.linalg.norm(point - self.state.pose().translation())
        return point if 0.3 < distance < 30.0 else None


def run_peer(packets: list[KeyframePacket], start: NavState, keyframes: int, smart: bool) -> tuple[Array, list[float]]:
    """Return positions and times of a peer, as `run_ours` does."""
    peer = Peer(start, keyframes, smart)
    positions, times = [], []
    for packet in packets:
        t0 = time.process_time()
        position = peer.add(packet)
        times.append(time.process_time() - t0)
        positions.append(position)
    return np.array(positions), times


def worker(args: argparse.Namespace) -> None:
    """Run one estimator on one seed and print its row as JSON."""
    packets, truths = world(args.seed, args).packets()
    start = start_state(truths[0], packets[0].keyframe.t_ns, np.random.default_rng(args.seed + 1000))
    if args.estimator == "ours":
        run_ours(packets[: WARM_UP + 10], start, args.keyframes)  # compile
        positions, times = run_ours(packets, start, args.keyframes)
    else:
        positions, times = run_peer(packets, start, args.keyframes, args.estimator == "smart")
    true = np.array([T[:3, 3] for T, _, _ in truths])
    ms = 1e3 * np.array(times[WARM_UP:])
    rmse = float(np.sqrt(np.mean(np.sum((positions - true) ** 2, axis=1))))
    print(json.dumps({"median": float(np.median(ms)), "p99": float(np.percentile(ms, 99)), "rmse": rmse}))


def compare(args: argparse.Namespace) -> None:
    """Print one row per seed and estimator."""
    print(f"{args.seconds:.0f} s, {args.tracks} tracks, {args.keyframes} keyframes; CPU ms per keyframe, position in m")
    print(f"{'seed':>4} {'estimator':>10} {'median':>8} {'p99':>8} {'rmse':>8}")
    medians, tails = [], []
    for seed in range(args.seeds):
        for estimator in ("ours", "smart", "landmarks"):
            command = [sys.executable, __file__, "worker", "--estimator", estimator, "--seed", str(seed)]
            command += [
                "--seconds",
                str(args.seconds),
                "--tracks",
                str(args.tracks),
                "--keyframes",
                str(args.keyframes),
            ]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                lines = done.stderr.strip().splitlines()
                reason = lines[-1][:80] if lines else f"ended by signal {-done.returncode}"
                print(f"{seed:>4} {estimator:>10} failed: {reason}")
                continue
            row = json.loads(done.stdout.strip().splitlines()[-1])
            if estimator == "ours":
                medians.append(row["median"])
                tails.append(row["p99"])
            print(f"{seed:>4} {estimator:>10} {row['median']:8.2f} {row['p99']:8.2f} {row['rmse']:8.4f}", flush=True)
    if args.record:
        setting = f"{args.tracks} tracks, {args.keyframes} keyframes"
        results.record("window", {f"{setting}: p50": np.median(medians), f"{setting}: p99": np.median(tails)})


def nees(args: argparse.Namespace) -> None:
    """Print the consistency of the newest state over many runs."""
    from scipy.stats import chi2

    names = ("rotation", "position", "velocity", "gyro bias", "accel bias")
    sums, drift = np.zeros(6), []
    config = replace(WindowConfig(), keyframes=args.keyframes)
    for seed in range(args.runs):
        packets, truths = world(seed, args).packets()
        window = SlidingWindow(config, MONO, World.noise, MACHINE)
        window.initialise(start_state(truths[0], packets[0].keyframe.t_ns, np.random.default_rng(seed + 1000)))
        for packet in packets:
            newest = window.add(packet).newest
        error, P = state_error(truths[-1], newest), newest.covariance
        for i in range(5):
            part = slice(3 * i, 3 * i + 3)
            sums[i] += error[part] @ np.linalg.solve(P[part, part], error[part])
        sums[5] += error @ np.linalg.solve(P, error)
        path = sum(np.linalg.norm(b[0][:3, 3] - a[0][:3, 3]) for a, b in pairwise(truths))
        drift.append(float(np.linalg.norm(error[3:6]) / path))
    for label, total, dof in zip((*names, "all"), sums, (3, 3, 3, 3, 3, 15), strict=True):
        low, high = chi2.ppf([0.025, 0.975], dof * args.runs) / (dof * args.runs)
        print(f"{label:>10} {total / (dof * args.runs):5.2f}   95 % band {low:.2f} to {high:.2f}")
    print(f"drift at the end: median {100 * np.median(drift):.2f} % of the distance, worst {100 * max(drift):.2f} %")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=("compare", "nees", "worker"), default="compare")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--tracks", type=int, default=80)
    parser.add_argument("--keyframes", type=int, default=15)
    parser.add_argument("--estimator", choices=("ours", "smart", "landmarks"), default="ours")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--record", action="store_true", help="keep the times in benchmarks/results")
    args = parser.parse_args()
    {"compare": compare, "nees": nees, "worker": worker}[args.what](args)


if __name__ == "__main__":
    main()
