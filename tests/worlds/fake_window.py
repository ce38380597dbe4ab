"""A sliding window made of truth plus noise, for tests of what the graph does with one."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import invert, se3_exp, so3_exp, tangent_basis, transform
from vislam.core.messages import KeyframePacket, NavState
from vislam.core.readings import Motion
from vislam.window.messages import CalibrationEstimate, WindowEdge, WindowGravity, WindowUpdate
from worlds.lap import World

Array = NDArray[np.float64]
_EXACT = CalibrationEstimate(np.zeros(16), np.zeros(16))


class FakeWindow:
    """Edges start at three times the settled sigma and shrink while their keyframes stay; `local` is their chain."""

    def __init__(self, world: World, keyframes: int = 6, imu: bool = True, sigma_scale: float = 1.0) -> None:
        self.world = world
        self.keyframes = keyframes
        self.imu = imu
        self.rng = np.random.default_rng(world.seed + 100)
        self.sigma = np.repeat([world.vo_sigma_rad, world.vo_sigma_m], 3) * 0.5
        self.error_scale = sigma_scale  # of the errors against what the covariances claim
        self.errors: list[Array] = []  # settled error of each edge, in sigmas
        self.first: Array = np.eye(4)
        self.count = 0
        self.begin: int | None = None  # the first keyframe after `initialise`
        self.begun_at: NavState | None = None

    def initialise(self, state: NavState | None, T_local_body: Array | None = None) -> None:
        self.begin, self.begun_at = None, state
        self.first = (
            state.T_world_body if state is not None else T_local_body if T_local_body is not None else np.eye(4)
        )

    def edge(self, k: int, settled: bool) -> WindowEdge:
        """The edge that ends at k: the older it is, the smaller its error."""
        age = self.keyframes if settled else min(self.count - 1 - k, self.keyframes)
        scale = 1.0 + 2.0 * (1.0 - age / self.keyframes)
        xi = self.errors[k] * self.sigma * scale * self.error_scale
        T = invert(self.world.truth[k - 1]) @ self.world.truth[k] @ se3_exp(xi)
        return WindowEdge(k - 1, k, T, np.diag((self.sigma * scale) ** 2), settled)

    def add(
        self, packet: KeyframePacket, T_odom_body: Array | None = None, motions: Sequence[Motion] = ()
    ) -> WindowUpdate:
        k = packet.keyframe.id
        self.count = k + 1
        self.begin = k if self.begin is None else self.begin
        while len(self.errors) <= k:
            self.errors.append(self.rng.normal(size=6))
        left = k - self.keyframes  # the keyframe that leaves now
        edges = [self.edge(left + 1, True)] if left >= self.begin else []
        first = max(left + 1, self.begin)
        ids = np.arange(first, k + 1)
        edges += [self.edge(j, False) for j in range(first + 1, k + 1)]
        T_local = self.world.truth[ids]  # good enough: the graph takes edges, not these
        tilts, states = (), ()
        newest = self.state(k) if self.imu else None
        if self.imu and left >= self.begin:
            tilts, states = (self.tilt(left),), ((left, self.state(left)),)
        return WindowUpdate(ids, T_local, newest, tuple(edges), tilts, states, _EXACT, 0.0, 0)

    def tilt(self, k: int, sigma_rad: float = 0.002) -> WindowGravity:
        up = self.world.truth[k, 2, :3]
        basis = tangent_basis(up)
        up = so3_exp(np.cross(up, basis @ self.rng.normal(size=2) * sigma_rad)) @ up
        return WindowGravity(k, up / np.linalg.norm(up), sigma_rad, np.eye(2) * sigma_rad**2)

    def state(self, k: int) -> NavState:
        """The true state in a local frame that is turned by 30 degrees of yaw against truth."""
        turn = transform(so3_exp(np.array([0.0, 0.0, np.deg2rad(30.0)])), np.array([1.0, 2.0, 0.0]))
        n = round(k * self.world.imu_hz / self.world.keyframe_hz)
        sigmas = np.repeat([0.01, 0.05, 0.02, 1e-3, 0.02], 3)
        xi = self.rng.normal(size=15) * sigmas
        covariance = np.diag(sigmas**2)
        return NavState(
            self.world.t_ns(k),
            turn @ self.world.truth[k],
            turn[:3, :3] @ (self.world.velocity[k] + xi[6:9]),
            self.world.true_gyro_bias[n] + xi[9:12],
            self.world.true_accel_bias[n] + xi[12:15],
            covariance,
        )
