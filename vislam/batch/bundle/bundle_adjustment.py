"""A finished run estimated again, all at once: visual-inertial bundle adjustment over its factor log.

Poses, velocities and biases of all keyframes, and the points that their tracks saw, under projection, depth, inertial,
rest and loop factors, and those of further sensors with their own variables. Loops are chosen first, as of pose-graph
files (`graph_auto`); tracks are judged between rounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from vislam.batch.bundle.adjust import (
    L,
    Solution,
    VisualNoise,
    covariances,
    marginals_at,
    solve,
    variances,
    visual_factors,
)
from vislam.batch.bundle.chain import Chain
from vislam.batch.bundle.loops import Loops, LoopVerdict
from vislam.batch.bundle.rays import Mask, Tracks, collect, residuals, triangulate
from vislam.batch.bundle.shared_errors import Seen, SharedErrors, profiled
from vislam.batch.bundle.shutter import ReadoutSearch, camera_twists, readout_change_s, shear
from vislam.config import BatchConfig, Config
from vislam.core.blas import on_one_blas_thread
from vislam.core.chi_square import chi_square_limit
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Array, NavState
from vislam.factors.factor_log import FactorLog
from vislam.factors.keys import B, V, X, nearest_rigid
from vislam.factors.sensed import Readings
from vislam.factors.solvers import graph_of
from vislam.sensors import Suite

_START_GATE_PX = 20.0  # first round: poses of the run may be off, only gross outliers leave
_START_CAUCHY = 3.0  # standard deviations, scale of the kernel in that round
_GATE_PROBABILITY = 0.999  # chi-square of a pixel or depth that stays, in later rounds
_MAX_RELATIVE_SIGMA = 0.25  # of a landmark's distance by its own rays; farther ones lack parallax or depth
_MIN_SEEN = 12  # landmarks; a keyframe that sees fewer also gets the odometry of the run
_PIXEL_SIGMA_MIN_PX = 0.2  # bounds of the noise that residuals show, from frontend.track_sigma_px on
_PIXEL_SIGMA_MAX_PX = 3.0
_MEDIAN_CHI2_2, _MEDIAN_CHI2_1 = 1.386, 0.455  # medians of chi-square with two degrees of freedom and with one
_GLOBAL_S = 0.004  # a shorter readout than this counts as a global shutter: one that has none came out at 3.5 ms
_MIN_LANDMARK_SEEN = 2  # keyframes
_MAX_OBSERVATIONS = 400_000  # bounds memory (2 kB each in gtsam) and time; the longest tracks stay


@dataclass(frozen=True, slots=True, eq=False)
class BatchResult:
    """A run estimated in batch."""

    T_map_body: Array  # [K, 4, 4]
    states: list[NavState]  # [K]; NaN in what was not estimated and where gtsam gives no covariance
    cost_before: float  # of the last round's factors at the run's own poses and biases
    cost_after: float
    iterations: int
    landmarks: int
    observations: int
    rejected_observations: int  # that did not fit, of tracks that were used or not
    rejected_depths: int  # whose pixel stayed
    sigma_px: float  # noise of the tracks as the residuals show it
    depth_factor: float  # the same for depth, times what was assumed
    readout_s: float  # of a rolling shutter; 0: global
    calibration: Array  # [2, 2] relative errors of focal length and metres, and their sigmas (NaN: not computed)
    loops: list[LoopVerdict]
    tied_by_odometry: list[int]  # keyframes that saw too few landmarks
    own: dict[str, tuple[Array, Array]]  # own variables of further sensors [V] and their sigmas [V], NaN if not known
    readings: dict[str, dict[str, int]]  # of further sensors, what became of them; see `Readings.counts_of`
    note: str  # what was out of the ordinary


@on_one_blas_thread
def optimize_run(log: FactorLog, config: Config, suite: Suite | None = None) -> BatchResult:
    """Estimate a run again from its factor log; deterministic. Readings of the sensors in `suite` are factors, too.

    Raises DataError when the log cannot be used or no solver finds a solution.
    """
    return _Batch(log, config, Suite() if suite is None else suite).run()


class _Batch:
    """The state of one optimisation: current values, and which measurements still count."""

    def __init__(self, log: FactorLog, config: Config, suite: Suite) -> None:
        self._log = log
        self._suite = suite
        self._config: BatchConfig = config.batch
        self._chain = Chain(log, config.graph, config.machine)
        self._T_body_cam0 = log.rig.T_body_cam0
        self._loops = Loops(log.edges, self._chain, config.graph, self._T_body_cam0[:3, 3])
        self._readings = Readings(suite, config.graph)
        for record, keyframe in zip(self._chain.records, log.keyframes, strict=True):
            self._readings.append(record, keyframe.packet.readings)
        self._own_keys = self._readings.keys_of(range(len(self._chain.records)))
        self._seen = Seen(collect(log, config.frontend))
        self._tracks = self._seen.tracks()
        self._values = self._chain.initial()
        self._readings.complete(self._values)
        self._points: Array = np.zeros((self._tracks.points, 3))
        self._keep: Mask = np.zeros(len(self._tracks), dtype=bool)
        self._with_depth: Mask = np.isfinite(self._tracks.rho)
        self._sigma_px = config.frontend.track_sigma_px
        self._readout_s = config.frontend.readout_s or 0.0
        self._learns_readout = config.frontend.readout_s is None
        self._readout = ReadoutSearch()
        self._depth_factor = 1.0
        self._tied: list[int] = []
        self._graph = gtsam.NonlinearFactorGraph()
        self._iterations = 0
        self._notes: list[str] = []

    def run(self) -> BatchResult:
        """Choose loops, then alternate between judging tracks and optimising."""
        config, has_imu, start = self._config, self._chain.has_imu, gtsam.Values(self._values)
        try:
            if undecided := self._loops.choose(self._chain):
                self._notes.append(undecided)
        except (DataError, UsageError) as error:
            self._notes.append(f"no loop was used: {error}")
        solution = None
        for round_number in range(config.rounds):
            self._judge(first=round_number == 0)
            solution = self._optimise(first=round_number == 0)
            self._values = solution.values
            self._points = self._landmarks()
            if round_number > 0:
                self._loops.drop_contradicted(self._poses())
            if has_imu and round_number == 1 < config.rounds - 1 and (shared := self._calibrate()) is not None:
                self._seen.errors = shared.values
            self._undo_shutter()
            self._tracks = self._seen.tracks()
            self._estimate_noise()
        if solution is None:
            raise DataError(f"batch.rounds is {config.rounds}; one at least is needed")
        return self._result(solution, start)

    def _poses(self) -> Array:
        count = len(self._chain.records)
        return np.array([nearest_rigid(self._values.atPose3(X(k)).matrix()) for k in range(count)])

    def _cameras(self, poses: Array | None = None) -> Array:
        """Return the poses [K * C, 4, 4] of all images, at those of the body [K, 4, 4] if they are given."""
        T_body_cams = np.array(self._log.rig.T_body_cams).reshape(-1, 4, 4)
        poses = self._poses() if poses is None else poses
        return (poses[:, None] @ T_body_cams).reshape(-1, 4, 4)

    def _judge(self, first: bool) -> None:
        """Triangulate every track again and decide which observations and depths count.

        In the first round poses are the run's: what is grossly off leaves, the worst of a track before the rest is
        triangulated again.
        """
        tracks, cameras = self._tracks, self._cameras()
        candidates = np.ones(len(tracks), dtype=bool) if first else self._keep
        limit_px, limit_rho = (np.sqrt(chi_square_limit(_GATE_PROBABILITY, n)) for n in (2, 1))
        gate_px = _START_GATE_PX if first else self._sigma_px * limit_px
        gate_rho = np.inf if first else self._depth_factor * limit_rho
        keep = candidates
        for _ in range(3):
            placed = triangulate(tracks, keep, cameras, self._sigma_px)
            error = residuals(tracks, placed.points_m, cameras)
            bad = keep & (error.px > gate_px)
            if not bad.any():
                break
            worst = np.zeros(tracks.points)
            np.maximum.at(worst, tracks.point[keep], error.px[keep])
            keep = keep & ~(bad & (error.px >= worst[tracks.point]))
        if not first:  # where the optimised point is, is known better than by its rays alone
            error = residuals(tracks, self._points, cameras)
            keep = self._keep
        keep = keep & (error.px <= gate_px)
        with np.errstate(invalid="ignore"):
            self._with_depth &= ~(np.abs(error.rho) > gate_rho)
        placed = triangulate(tracks, keep, cameras, self._sigma_px)
        good = (placed.relative_sigma < _MAX_RELATIVE_SIGMA) & (tracks.counts(keep) >= _MIN_LANDMARK_SEEN)
        keep = keep & good[tracks.point]
        self._keep = _bounded(tracks, keep, _MAX_OBSERVATIONS)
        self._points = placed.points_m

    def _optimise(self, first: bool) -> Solution:
        tracks, keep, count = self._tracks, self._keep, len(self._chain.records)
        seen = np.bincount(tracks.keyframe[keep], minlength=count)
        factors, self._tied = self._chain.factors(self._values, seen, _MIN_SEEN)
        factors += self._loops.factors(self._poses())
        factors += self._readings.factors(self._values)
        factors += self._visual_factors(tracks, first)
        graph, values, states = graph_of(factors), gtsam.Values(), []
        for k in range(count):
            values.insert(X(k), self._values.atPose3(X(k)))
            states.append(X(k))
            if self._chain.has_imu:
                values.insert(V(k), self._values.atVector(V(k)))
                values.insert(B(k), self._values.atConstantBias(B(k)))
                states += [V(k), B(k)]
        for key in self._own_keys:
            values.insert(key, self._values.atDouble(key))
        states += self._own_keys
        for j in np.unique(tracks.point[keep]).tolist():
            values.insert(L(j), self._points[j])
        solution = solve(graph, values, states)
        self._graph = graph
        self._iterations += solution.iterations
        if solution.note:
            self._notes.append(solution.note)
        return solution

    def _visual_factors(self, tracks: Tracks, first: bool) -> list[gtsam.NonlinearFactor]:
        estimators, weaker = gtsam.noiseModel.mEstimator, self._config.vision_inflation
        shape, k = (estimators.Cauchy, _START_CAUCHY) if first else (estimators.Huber, self._config.huber_k)
        kernel = shape.Create(k / weaker)  # it bends where it would with the noise as it is
        noise = VisualNoise(weaker * self._sigma_px, weaker * self._depth_factor, kernel)
        return visual_factors(tracks, self._keep, self._with_depth, self._log.rig.T_body_cams, noise)

    def _calibrate(self) -> SharedErrors | None:
        """Return what the last factors at their solution show of focal length and metres; None without cameras."""
        rig = self._log.rig
        if rig.is_blind or not self._keep.any():
            return None
        sigmas = np.array([rig.cameras[0].sigmas.focal, rig.metres_sigma * (self._keep & self._with_depth).any()])
        others = self._graph.size() - int(self._keep.sum())

        def graph_at(errors: Array) -> gtsam.NonlinearFactorGraph:
            visual = self._visual_factors(self._seen.tracks(errors), first=False)
            return graph_of([*(self._graph.at(i) for i in range(others)), *visual])

        count, has_imu = len(self._chain.records), self._chain.has_imu
        return profiled(graph_at, self._values, count, self._seen.errors, sigmas, has_imu)

    def _landmarks(self) -> Array:
        points = self._points.copy()
        for j in np.unique(self._tracks.point[self._keep]).tolist():
            points[j] = self._values.atPoint3(L(j))
        return points

    @property
    def _applied_readout_s(self) -> float:
        return self._readout_s if not self._learns_readout or self._readout_s > _GLOBAL_S else 0.0

    def _undo_shutter(self) -> None:
        """Estimate the readout of a rolling shutter and bring what was seen to the instant of the middle row."""
        tracks, poses = self._tracks, self._poses()
        if not self._learns_readout and self._readout_s == 0.0:
            return
        t_ns = np.array([record.t_ns for record in self._chain.records], dtype=np.int64)
        times = dict(enumerate(t_ns.tolist()))
        twists = camera_twists(self._log.frames.placed(times, dict(enumerate(poses))), t_ns, self._T_body_cam0)
        error = residuals(tracks, self._points, self._cameras(poses))
        if self._learns_readout:
            of_first = self._keep & (tracks.image % len(self._log.rig.cameras) == 0)
            left_s = readout_change_s(tracks, of_first, error.xy, error.predicted_rho, twists)
            self._readout_s = self._readout.next_s(self._readout_s, left_s)
        self._seen.moved_xy = self._applied_readout_s * shear(tracks, error.predicted_rho, twists)

    def _estimate_noise(self) -> None:
        """Take the noise of pixels and depths from the medians of their residuals, three unknowns per point counted."""
        tracks, keep = self._tracks, self._keep
        if not keep.any():
            return
        error = residuals(tracks, self._points, self._cameras())
        deep = keep & self._with_depth
        numbers = 2 * int(keep.sum()) + int(deep.sum())
        share = max(1.0 - 3.0 * len(np.unique(tracks.point[keep])) / numbers, 0.2)
        sigma = float(np.sqrt(np.median(error.px[keep] ** 2) / _MEDIAN_CHI2_2 / share))
        self._sigma_px = float(np.clip(sigma, _PIXEL_SIGMA_MIN_PX, _PIXEL_SIGMA_MAX_PX))
        if deep.any():
            factor = float(np.sqrt(np.median(error.rho[deep] ** 2) / _MEDIAN_CHI2_1 / share))
            self._depth_factor = float(np.clip(factor, 0.5, 5.0))

    def _result(self, solution: Solution, start: gtsam.Values) -> BatchResult:
        tracks, keep = self._tracks, self._keep
        poses = self._poses()
        usable = np.isfinite(tracks.rho)
        marginals = marginals_at(self._graph, self._values) if self._config.covariances else None
        shared = self._calibrate() if self._config.covariances else None
        names = self._suite.names
        own = {name: self._readings.own(name, self._values, lambda keys: variances(marginals, keys)) for name in names}
        return BatchResult(
            T_map_body=poses,
            states=self._states(poses, marginals, shared),
            calibration=np.stack([self._seen.errors, np.full(2, np.nan) if shared is None else shared.sigmas]),
            cost_before=self._cost_at(start),
            cost_after=solution.cost_after,
            iterations=self._iterations,
            landmarks=len(np.unique(tracks.point[keep])),
            observations=int(keep.sum()),
            rejected_observations=len(tracks) - int(keep.sum()),
            rejected_depths=int((keep & usable & ~self._with_depth).sum()),
            sigma_px=self._sigma_px,
            depth_factor=self._depth_factor,
            readout_s=self._applied_readout_s,
            loops=[self._loops.verdicts[i] for i in sorted(self._loops.verdicts)],
            tied_by_odometry=self._tied,
            own={name: found for name, found in own.items() if found is not None},
            readings={name: self._readings.counts_of(name, self._values) for name in names},
            note="; ".join(self._notes),
        )

    def _cost_at(self, start: gtsam.Values) -> float:
        """Return the cost of the last factors at the run's own states, with points triangulated from its poses."""
        tracks, count = self._tracks, len(self._chain.records)
        poses = np.array([start.atPose3(X(k)).matrix() for k in range(count)])
        placed = triangulate(tracks, self._keep, self._cameras(poses), self._sigma_px)
        values = gtsam.Values(start)
        for key in self._own_keys:  # the run's own are not in its log
            values.update(key, self._values.atDouble(key))
        for j in np.unique(tracks.point[self._keep]).tolist():
            values.insert(L(j), placed.points_m[j])
        return float(self._graph.error(values))

    def _states(self, poses: Array, marginals: gtsam.Marginals | None, shared: SharedErrors | None) -> list[NavState]:
        count, has_imu = len(poses), self._chain.has_imu
        known = covariances(marginals, self._values, count, has_imu)
        if shared is not None:
            known += shared.added()
        states = []
        for k, record in enumerate(self._chain.records):
            velocity = gyro = accel = np.full(3, np.nan)
            if has_imu:
                bias = self._values.atConstantBias(B(k))
                velocity = np.array(self._values.atVector(V(k)))
                gyro, accel = np.array(bias.gyroscope()), np.array(bias.accelerometer())
            states.append(NavState(record.t_ns, poses[k], velocity, gyro, accel, known[k]))
        return states


def _bounded(tracks: Tracks, keep: Mask, most: int) -> Mask:
    """Return at most `most` observations, those of the longest tracks."""
    counts = tracks.counts(keep)
    order = np.argsort(-counts, kind="stable")
    chosen = np.zeros(tracks.points, dtype=bool)
    chosen[order[np.cumsum(counts[order]) <= most]] = True
    return np.asarray(keep & chosen[tracks.point])
