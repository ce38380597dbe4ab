"""Odometry of tight coupling: edges and tilts that a sliding window summarised, in a graph of poses alone."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from vislam.config import GraphConfig, MachineConfig
from vislam.core.geometry import se3_log, skew
from vislam.core.memory import EdgeRecord, GravityRecord, WindowRecord
from vislam.core.messages import Array
from vislam.factors.builder import Guess, Label, Step
from vislam.factors.journal import SPEED_MAX_M_S, StartRecord
from vislam.factors.keys import X, bias_of, nearest_rigid
from vislam.factors.motion import no_motion, on_floor, pose_covariance
from vislam.factors.noise_models import gaussian, huber, inflated
from vislam.factors.visual import pose_factor

_SPREAD = 1.5  # a provisional edge is worth replacing when its variance changed by more than this factor
_UP = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
_NO_WAY_M = 1e-6  # an edge so short has no direction


class WindowOdometry:
    """Records of a window, turned into factors; see `vislam.factors.odometry.Odometry`."""

    def __init__(self, config: GraphConfig, machine: MachineConfig) -> None:
        """Start empty."""
        self._config = config
        self._machine = machine
        self._start: StartRecord | None = None
        self._newest: WindowRecord | None = None
        self._t_ns: list[int] = []
        self._edges: list[EdgeRecord | None] = []  # by the newer keyframe
        self._tilts: dict[int, GravityRecord] = {}
        self._rest_from: list[int | None] = []
        self._shared = SharedErrors() if config.edges_share_scale else None

    @property
    def has_imu(self) -> bool:
        """See Odometry: velocities and biases stay in the window."""
        return False

    def begin(self, start: StartRecord) -> None:
        """Take the first state."""
        self._start = start

    def append(self, record: WindowRecord) -> None:
        """Take what the window said with the next keyframe."""
        self._newest = record
        self._t_ns.append(record.t_ns)
        self._edges.append(None)
        self._rest_from.append(record.rest_from)
        for edge in record.edges:
            self._edges[edge.to_id] = edge
        self._tilts |= {tilt.id: tilt for tilt in record.tilts}
        if self._shared is not None:
            for edge in record.edges:
                self._shared.take(edge)
            for tilt in record.tilts:
                self._shared.level(tilt)

    def edge(self, k: int) -> EdgeRecord | None:
        """Return the edge that ends at keyframe k; None for the first."""
        return self._edges[k] if 0 <= k < len(self._edges) else None

    def worth_replacing(self, edge: EdgeRecord) -> float:
        """Return by how many sigmas an edge differs from the one in its place; 0 when it may stay, inf if settled."""
        old = self.edge(edge.to_id)
        if old is None or edge.settled:
            return float("inf")
        moved = se3_log(np.linalg.inv(old.T_previous_body) @ edge.T_previous_body)
        covariance = self.covariance(old, 1.0)
        sigmas = float(np.sqrt(moved @ np.linalg.solve(covariance, moved)))
        ratio = np.trace(self.covariance(edge, 1.0)) / np.trace(covariance)
        if sigmas > self._config.window_refresh_sigma or not 1.0 / _SPREAD < ratio < _SPREAD:
            return sigmas
        return 0.0

    def start(self) -> tuple[list[gtsam.NonlinearFactor], Guess]:
        """See Odometry."""
        start = self._start
        assert start is not None
        model = gaussian(pose_covariance(start), self._config.covariance_ratio_max)
        prior = gtsam.PriorFactorPose3(X(0), gtsam.Pose3(start.T_map_body), model)
        bias = bias_of(start.gyro_bias_rad_s, start.accel_bias_m_s2)
        return [prior], Guess(start.T_map_body, start.velocity_map_m_s, bias)

    def step(self, k: int, before: Guess, T_map_earlier: Array | None, vo_scale: float) -> Step:
        """See Odometry."""
        edge = self._edges[k]
        assert edge is not None and self._newest is not None
        T = nearest_rigid(before.T_map_body @ edge.T_previous_body)
        covariance = self.covariance(edge, vo_scale)
        named: dict[Label, gtsam.NonlinearFactor] = {("edge", k): self._edge_factor(edge, covariance)}
        if k in self._tilts:
            named["tilt", k] = self._gravity_factor(self._tilts[k])
        rest_from, still = self._rest_from[k], list[gtsam.NonlinearFactor]()
        if rest_from is not None:
            still.append(no_motion(rest_from, k, self._machine))
        if self._machine.floor_sigma_m is not None and self._start is not None:
            still.append(on_floor(k, float(self._start.T_map_body[2, 3]), self._machine.floor_sigma_m))
        note = self._newest.note if k == self._newest.id else ""
        guess = Guess(T, before.velocity_map_m_s, before.bias)
        return Step(still, guess, *_variances(covariance), note=note, named=named)

    def amended(self, vo_scale: float) -> list[tuple[int, float, float]]:
        """See Odometry."""
        assert self._newest is not None
        older = [edge for edge in self._newest.edges if edge.to_id != self._newest.id]
        return [(edge.to_id, *_variances(self.covariance(edge, vo_scale))) for edge in older]

    def changed(self, vo_scale: float) -> dict[Label, gtsam.NonlinearFactor]:
        """See Odometry."""
        assert self._newest is not None
        out: dict[Label, gtsam.NonlinearFactor] = {}
        for edge in self._newest.edges:
            if edge.to_id != self._newest.id:
                out["edge", edge.to_id] = self._edge_factor(edge, self.covariance(edge, vo_scale))
        for tilt in self._newest.tilts:
            out["tilt", tilt.id] = self._gravity_factor(tilt)
        return out

    def reach_m(self, k: int) -> float:
        """See Odometry."""
        edge = self._edges[k]
        if edge is not None and edge.begins_submap:
            return float("inf")
        return SPEED_MAX_M_S * (self._t_ns[k] - self._t_ns[k - 1]) * 1e-9

    def shared_error(self, ids: list[int], poses: Array) -> Array | None:
        """See Odometry."""
        return None if self._shared is None else self._shared.effect(ids, poses)

    def relink(self, k: int, T_previous_body: Array) -> None:
        """See Odometry."""
        edge = self._edges[k]
        assert edge is not None
        self._edges[k] = replace(edge, T_previous_body=nearest_rigid(T_previous_body))

    def covariance(self, edge: EdgeRecord, vo_scale: float) -> Array:
        """Return the covariance [6, 6] that the graph gives an edge."""
        config = self._config
        if edge.begins_submap:
            return edge.covariance
        floor_rad = np.deg2rad(config.window_floor_deg)
        return inflated(edge.covariance, vo_scale * config.window_inflation, floor_rad, config.window_floor_m)

    def _edge_factor(self, edge: EdgeRecord, covariance: Array) -> gtsam.NonlinearFactor:
        config = self._config
        model = huber(gaussian(covariance, config.covariance_ratio_max), config.huber_k)
        return pose_factor(X(edge.to_id - 1), X(edge.to_id), edge.T_previous_body, model)

    def _gravity_factor(self, tilt: GravityRecord) -> gtsam.NonlinearFactor:
        sigma_rad = float(np.hypot(tilt.sigma_rad, np.deg2rad(self._config.tilt_floor_deg)))
        model = gtsam.noiseModel.Isotropic.Sigma(2, sigma_rad)
        return gtsam.AttitudeFactorPose3(X(tilt.id), _UP, model, gtsam.Unit3(tilt.up_body))


def _variances(covariance: Array) -> tuple[float, float]:
    """Return the variances in rad^2 and m^2 per axis of an edge's covariance [6, 6]."""
    return float(np.trace(covariance[:3, :3])) / 3.0, float(np.trace(covariance[3:, 3:])) / 3.0


class SharedErrors:
    """Errors that a window's edges have in common, where scale and level are known from inertial data alone.

    One camera's window sees directions well and lengths only up to a scale that wanders slowly: what an edge's sigma
    along its way has beyond that across it is scale, and the next edge has the same. Summed as if independent, a
    thousand such errors nearly cancel; they do not. Nor is level known better from many keyframes than from the one
    that knows it best: the accelerometer's bias is the same in all. Nothing in a graph of poses measures either better
    than the window did, so both are considered and not estimated (Schmidt 1966; Jazwinski 1970, section 8.4): they
    move no pose.
    """

    def __init__(self) -> None:
        """Start with keyframe 0."""
        self._along: Array = np.zeros((64, 3))  # sigma of scale's part of an edge along its way, in body axes, m
        self._level_rad = np.inf

    def take(self, edge: EdgeRecord) -> None:
        """Take an edge, in the place of an older one to the same keyframe; weak links know nothing of scale."""
        while edge.to_id >= len(self._along):
            self._along = np.concatenate([self._along, np.zeros_like(self._along)])
        T = edge.T_previous_body
        way = T[:3, :3].T @ T[:3, 3]
        length_m = float(np.linalg.norm(way))
        self._along[edge.to_id] = 0.0
        if edge.begins_submap or length_m < _NO_WAY_M:
            return
        way /= length_m
        across = np.eye(3) - np.outer(way, way)
        P = edge.covariance[3:, 3:]
        beyond = float(way @ P @ way) - float(np.linalg.eigvalsh(across @ P @ across)[-1])
        self._along[edge.to_id] = np.sqrt(max(beyond, 0.0)) * way

    def level(self, tilt: GravityRecord) -> None:
        """Take how well level is known at a keyframe."""
        self._level_rad = min(self._level_rad, tilt.sigma_rad)

    def effect(self, ids: list[int], poses: Array) -> Array:
        """Return what one sigma of each of three errors does to poses [6 N, 3]: rotation and position, in body axes.

        `poses` [M, 4, 4] are those of all keyframes in map. The errors are scale, and level about map's x and y.
        """
        newest = max(ids)
        R, p = poses[: newest + 1, :3, :3], poses[: newest + 1, :3, 3]
        by_scale = np.cumsum(np.einsum("kij,kj->ki", R, self._along[: newest + 1]), axis=0)
        level_rad = self._level_rad if np.isfinite(self._level_rad) else 0.0
        out = np.zeros((len(ids), 6, 3))
        for row, k in enumerate(ids):
            turn = R[k].T[:, :2] * level_rad
            out[row, :3, 1:] = turn
            out[row, 3:, 0] = R[k].T @ by_scale[k]
            out[row, 3:, 1:] = -R[k].T @ skew(p[k] - p[0])[:, :2] * level_rad
        return out.reshape(-1, 3)
