"""The filter: its linearisations, its gates, and that time of arrival does not matter."""

from dataclasses import asdict, replace
from multiprocessing import Pipe

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.config import EkfConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import (
    quaternion_wxyz,
    se3_exp,
    skew,
    so3_exp,
    so3_left_jacobian,
    so3_log,
    so3_right_jacobian,
    transform,
)
from vislam.core.messages import Array, ImuSample, NavState, Observations, Tracking, VoMeasurement
from vislam.core.small import write_right_jacobian
from vislam.ekf import Correction, Ekf
from vislam.ekf.loose import kernels, visual_motion
from vislam.ekf.loose.visual_motion import relative_motion, shared_error, why_unusable
from vislam.imu import preintegrate
from vislam.vision.relative_motion import camera_displacement, direction_residual, metric_residual
from worlds import monte_carlo as mc
from worlds.motion import EUROC_NOISE, NS, T0_NS, Motion, SimulatedVision, to_span
from worlds.parts import GRAVITY_M_S2, MACHINE

LEVER = np.array([0.1, -0.05, 0.2])
NOTHING_SEEN = Observations(np.empty(0, dtype=np.int64), np.empty((0, 2)))


def random_pose(rng: np.random.Generator) -> Array:
    return transform(so3_exp(rng.normal(size=3)), rng.normal(size=3))


def random_nominal(rng: np.random.Generator) -> Array:
    x = rng.normal(size=kernels.NOMINAL) * 0.3
    x[6:10] = quaternion_wxyz(random_pose(rng)[:3, :3])
    x[19:23] = quaternion_wxyz(random_pose(rng)[:3, :3])
    return x


def perturbed(x: Array, d: Array) -> Array:
    """The nominal state with an error [21] put on it, by the definition in `kernels`."""
    y = x.copy()
    y[0:3] += d[3:6]
    y[3:6] += d[6:9]
    y[13:16] += d[9:12]
    y[10:13] += d[12:15]
    y[16:19] += d[18:21]
    for at, w in ((6, d[0:3]), (19, d[15:18])):
        y[at : at + 4] = quaternion_wxyz(kernels.pose(x, 0, at)[:3, :3] @ so3_exp(w))
    return y


def difference(y: Array, x: Array) -> Array:
    """The error [21] of y against x."""
    d = np.zeros(kernels.ERRORS)
    d[3:6], d[6:9], d[9:12], d[12:15], d[18:21] = (
        (y - x)[0:3],
        (y - x)[3:6],
        (y - x)[13:16],
        (y - x)[10:13],
        (y - x)[16:19],
    )
    for at, rows in ((6, slice(0, 3)), (19, slice(15, 18))):
        d[rows] = so3_log(kernels.pose(x, 0, at)[:3, :3].T @ kernels.pose(y, 0, at)[:3, :3])
    return d


def invariant(x: Array) -> Array:
    """The matrix [21, 21] that turns the error of `NavState` at x into the right-invariant one (world axes)."""
    T = np.eye(21)
    for at_q, row, vectors in ((6, 0, ((0, 3), (3, 6))), (19, 15, ((16, 18),))):
        R = kernels.pose(x, 0, at_q)[:3, :3]
        T[row : row + 3, row : row + 3] = R
        for at, error in vectors:
            T[error : error + 3, row : row + 3] = skew(x[at : at + 3].copy()) @ R
    return T


def reference_step(x: Array, s0: Array, s1: Array, dt: float) -> Array:
    """One prediction in plain numpy, written from the equations."""
    y = x.copy()
    R = kernels.pose(x, 0, 6)[:3, :3]
    w, a = 0.5 * (s0 + s1)[:3] - x[13:16], 0.5 * (s0 + s1)[3:] - x[10:13]
    acceleration = R @ so3_exp(0.5 * dt * w) @ a + np.array([0.0, 0.0, -GRAVITY_M_S2])
    y[0:3] += x[3:6] * dt + 0.5 * acceleration * dt**2
    y[3:6] += acceleration * dt
    y[6:10] = quaternion_wxyz(R @ so3_exp(dt * w))
    return y


def step(
    x: Array, P: Array, s0: Array, s1: Array, dt: float, gap_s: float = 0.0, white: float = 0.0
) -> tuple[Array, Array]:
    x, P = x.copy(), P.copy()
    sigmas = np.array([white, white, 0.0, 0.0, 0.5, 2.0])
    kernels.predict(x, P, s0, s1, dt, gap_s, sigmas, GRAVITY_M_S2)
    return x, P


@pytest.mark.parametrize("seed", range(5))
def test_prediction_against_plain_numpy_and_its_numerical_jacobian(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, s0, s1, dt = random_nominal(rng), rng.normal(size=6), rng.normal(size=6), 0.01
    root = rng.normal(size=(21, 21))
    P = root @ root.T
    y, P_next = step(x, P, s0, s1, dt)
    assert np.abs(difference(y, reference_step(x, s0, s1, dt))).max() < 1e-13
    F, h = np.empty((21, 21)), 1e-6
    for k in range(21):
        d = np.eye(21)[k] * h
        forward = reference_step(perturbed(x, d), s0, s1, dt)
        backward = reference_step(perturbed(x, -d), s0, s1, dt)
        F[:, k] = (difference(forward, y) - difference(backward, y)) / (2 * h)
    np.testing.assert_allclose(P_next, F @ P @ F.T, atol=2e-7 * np.abs(P).max())
    np.testing.assert_array_equal(P_next, P_next.T)


def test_prediction_is_preintegration() -> None:
    """The same samples through the filter and through `preintegrate` end in the same state, noise included."""
    motion = Motion.random(2)
    samples = motion.samples(0.5)[0]
    T, v, *_ = motion.at(0.0)
    ekf = Ekf(EkfConfig(), replace(EUROC_NOISE, gyroscope_random_walk=0.0, accelerometer_random_walk=0.0), MACHINE)
    ekf.predict(samples[0])
    ekf.initialise(NavState(T0_NS, T, v, np.zeros(3), np.zeros(3), np.zeros((15, 15))))
    for s in samples[1:]:
        ekf.predict(s)
    piece, state, R, g = (
        preintegrate(to_span(samples), noise=EUROC_NOISE),
        ekf.state(),
        T[:3, :3],
        np.array([0, 0, -9.81]),
    )
    np.testing.assert_allclose(state.T_world_body[:3, :3], R @ piece.dR, atol=1e-12)
    np.testing.assert_allclose(state.velocity_world_m_s, v + 0.5 * g + R @ piece.dv_m_s, atol=1e-12)
    np.testing.assert_allclose(state.T_world_body[:3, 3], T[:3, 3] + 0.5 * v + g / 8 + R @ piece.dp_m, atol=1e-12)
    order = [0, 1, 2, 6, 7, 8, 3, 4, 5]  # NavState has position before velocity
    turn = np.kron(np.eye(3), R)
    turn[:3, :3] = np.eye(3)
    expected = turn @ piece.covariance @ turn.T
    np.testing.assert_allclose(state.covariance[np.ix_(order, order)], expected, rtol=0.02, atol=2e-3 * expected.max())


def numerical(f, T_a: Array, T_b: Array) -> tuple[Array, Array]:
    out = []
    for which in (0, 1):
        columns = []
        for k in range(6):
            sides = []
            for sign in (1.0, -1.0):
                d = np.eye(6)[k] * 1e-6 * sign
                poses = [T_a.copy(), T_b.copy()]
                poses[which][:3, :3] = poses[which][:3, :3] @ so3_exp(d[:3])
                poses[which][:3, 3] += d[3:]
                sides.append(f(*poses))
            columns.append(-(sides[0] - sides[1]) / 2e-6)
        out.append(np.array(columns).T)
    return out[0], out[1]


@pytest.mark.parametrize("seed", range(5))
def test_jacobians_of_metric_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_a, T_b, T_a_b = random_pose(rng), random_pose(rng), random_pose(rng)
    residual, J_a, J_b = metric_residual(T_a, T_b, T_a_b)
    N_a, N_b = numerical(lambda a, b: metric_residual(a, b, T_a_b)[0], T_a, T_b)
    np.testing.assert_allclose(J_a, N_a, atol=1e-7)
    np.testing.assert_allclose(J_b, N_b, atol=1e-7)
    exact, *_ = metric_residual(T_a, T_b, np.linalg.inv(T_a) @ T_b)
    np.testing.assert_allclose(exact, 0.0, atol=1e-12)
    assert np.linalg.norm(residual) > 0.1


@pytest.mark.parametrize("seed", range(5))
def test_jacobians_of_direction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_a, T_b = random_pose(rng), random_pose(rng)
    c = camera_displacement(T_a, T_b, LEVER)
    u = so3_exp(rng.normal(size=3) * 0.1) @ c / np.linalg.norm(c)
    T_a_b = transform(T_a[:3, :3].T @ T_b[:3, :3] @ so3_exp(rng.normal(size=3) * 0.1), u)
    _, J_a, J_b, axes, along = direction_residual(T_a, T_b, T_a_b, LEVER)

    def residual(a: Array, b: Array) -> Array:
        moved = camera_displacement(a, b, LEVER)
        across = np.linalg.norm(c) * axes.T @ (u - moved / np.linalg.norm(moved))
        return np.concatenate([metric_residual(a, b, T_a_b)[0][:3], across])

    N_a, N_b = numerical(residual, T_a, T_b)
    np.testing.assert_allclose(J_a, N_a, atol=1e-7)
    np.testing.assert_allclose(J_b, N_b, atol=1e-7)
    assert along == pytest.approx(c @ u)
    np.testing.assert_allclose(axes.T @ c, 0.0, atol=1e-12)


def test_correction_is_the_textbook_s_in_the_invariant_error() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(21, 21)) * 0.1
    x, P = random_nominal(rng), root @ root.T
    H, noise, residual = rng.normal(size=(6, 21)), np.diag(rng.uniform(0.1, 1.0, 6)), rng.normal(size=6) * 0.1
    nis, K = kernels.innovation(P, H, noise, residual)
    S = H @ P @ H.T + noise
    np.testing.assert_allclose(K, P @ H.T @ np.linalg.inv(S), atol=1e-10)
    assert nis == pytest.approx(residual @ np.linalg.inv(S) @ residual)
    y, P_after = x.copy(), P.copy()
    kernels.correct(y, P_after, K, H, noise, residual)
    before, after = invariant(x), invariant(y)
    np.testing.assert_allclose(after @ P_after @ after.T, before @ (P - K @ S @ K.T) @ before.T, atol=1e-9)
    xi = before @ K @ residual
    for at_p, at_q, row in ((0, 6, 0), (16, 19, 15)):
        turned = so3_exp(xi[row : row + 3])
        expected = kernels.pose(x, at_p, at_q)
        expected[:3, :3] = turned @ expected[:3, :3]
        expected[:3, 3] = turned @ expected[:3, 3] + so3_left_jacobian(xi[row : row + 3]) @ xi[row + 3 : row + 6]
        np.testing.assert_allclose(kernels.pose(y, at_p, at_q), expected, atol=1e-10)
    velocity = so3_exp(xi[:3]) @ x[3:6] + so3_left_jacobian(xi[:3]) @ xi[6:9]
    np.testing.assert_allclose(y[3:6], velocity, atol=1e-10)
    np.testing.assert_allclose(y[10:16], x[10:16] + (K @ residual)[[12, 13, 14, 9, 10, 11]], atol=1e-12)


def test_motions_tell_nothing_about_heading_and_place() -> None:
    """However wrong the state was: the information about what cannot be seen is what it was at the start."""
    rng = np.random.default_rng(8)
    root = rng.normal(size=(21, 21))
    x, P = random_nominal(rng), 0.1 * root @ root.T + 0.01 * np.eye(21)
    unseen = np.zeros((21, 4))  # in the invariant error: turning about the vertical, shifting
    unseen[[2, 17], 0] = 1.0
    unseen[3:6, 1:] = unseen[18:21, 1:] = np.eye(3)

    def information() -> Array:
        T = invariant(x)
        return unseen.T @ np.linalg.inv(T @ P @ T.T) @ unseen

    start = information()
    for i in range(30):
        T = se3_exp(rng.normal(size=6) * 0.5)
        unscaled = T.copy()
        unscaled[:3, 3] /= np.linalg.norm(T[:3, 3])
        m, _ = relative_motion(x, P, unscaled if i % 2 else T, np.eye(6) * 1e-2, i % 2 == 0, LEVER)
        _, K = kernels.innovation(P, m.H, m.noise, m.residual)
        kernels.correct(x, P, K, m.H, m.noise, m.residual)
    np.testing.assert_allclose(information(), start, rtol=1e-6, atol=1e-6 * np.abs(start).max())
    seen = np.linalg.inv(P)
    assert np.trace(seen) > 10 * np.trace(start)


def test_clone_is_the_pose_itself() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(21, 21))
    x, P = random_nominal(rng), root @ root.T
    kernels.clone(x, P)
    np.testing.assert_array_equal(kernels.pose(x, 16, 19), kernels.pose(x, 0, 6))
    spread = np.zeros((6, 21))
    spread[:, :6], spread[:, 15:] = np.eye(6), -np.eye(6)
    np.testing.assert_array_equal(spread @ P @ spread.T, 0.0)  # pose minus clone is known exactly


def test_chi_square_limits() -> None:
    np.testing.assert_allclose([chi_square_limit(0.999, dof) for dof in (3, 5, 6)], [16.266, 20.515, 22.458], atol=1e-3)


def test_shared_error_does_not_average_out() -> None:
    """A hundred motions from one keyframe tell no more than its landmarks allow."""
    x = np.zeros(kernels.NOMINAL)
    x[6] = x[19] = 1.0
    x[0] = 1.0
    P = np.zeros((21, 21))
    P[:6, :6] = np.eye(6)
    covariance, shared = np.eye(6) * 1e-4, np.zeros((6, 6))
    T = transform(np.eye(3), np.array([1.0, 0.0, 0.0]))
    for _ in range(100):
        seen, _ = relative_motion(x, P, T, covariance, True, np.zeros(3))
        white = 0.5 * seen.noise
        more = shared_error(seen.H[:, 15:].copy(), 0.5 * seen.noise, shared)
        shared += more
        P[15:, 15:] += more
        _, K = kernels.innovation(P, seen.H, white, seen.residual)
        kernels.correct(x, P, K, seen.H, white, seen.residual)
    np.testing.assert_allclose(np.diag(P)[:6], 0.5e-4, rtol=0.05)


class Scene:
    """A noisy run: samples, truth and visual motions, and a filter set up on its first state."""

    def __init__(self, seed: int = 1, duration_s: float = 6.0, camera: Array | None = None) -> None:
        self.motion, rng = Motion.random(seed), np.random.default_rng(seed)
        self.samples, self.biases = self.motion.samples(
            duration_s, 200.0, EUROC_NOISE, rng, np.array([0.01, -0.02, 0.03]), np.array([0.1, -0.05, 0.08])
        )
        self.stamps = [T0_NS + 50_000_000 * k + 1_234_567 for k in range(int(duration_s * 20) - 1)]
        poses = [self.motion.pose((t - T0_NS) * 1e-9) for t in self.stamps]
        self.vision = SimulatedVision(T_body_camera=camera)
        self.motions = self.vision.motions(poses, self.stamps, rng)
        self.keyframes = range(0, len(self.stamps), self.vision.keyframe_every)

    def ekf(self, **config: float) -> Ekf:
        settings = EkfConfig(**{"vo_inflation": 1.0, **config})
        ekf = Ekf(settings, EUROC_NOISE, MACHINE)
        ekf.initialise(self.start())
        return ekf

    def start(self, bias_sigmas: tuple[float, float] = (0.05, 0.2)) -> NavState:
        T, v, *_ = self.motion.at(0.0)
        sigmas = np.repeat([0.02, 0.001, 0.05, *bias_sigmas], 3)
        return NavState(T0_NS, T, v, np.zeros(3), np.zeros(3), np.diag(sigmas**2))

    def measure(self, ekf: Ekf, i: int) -> None:
        if i > 0:
            ekf.update_vo(self.motions[i])
        if i in self.keyframes:
            ekf.add_keyframe(i // self.vision.keyframe_every, self.stamps[i])

    def run(self, ekf: Ekf, delay_s: float = 0.0) -> Ekf:
        """Feed samples, and each frame as soon as a sample `delay_s` after it is there."""
        i = 0
        for s in self.samples:
            ekf.predict(s)
            while i < len(self.stamps) and s.t_ns >= self.stamps[i] + delay_s * NS:
                self.measure(ekf, i)
                i += 1
        for k in range(i, len(self.stamps)):
            self.measure(ekf, k)
        return ekf


def assert_same(a: NavState, b: NavState) -> None:
    assert a.t_ns == b.t_ns
    for name in ("T_world_body", "velocity_world_m_s", "gyro_bias_rad_s", "accel_bias_m_s2", "covariance"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def test_tracks_truth(scene: Scene) -> None:
    ekf = scene.run(scene.ekf())
    state = ekf.state()
    T, v, *_ = scene.motion.at((state.t_ns - T0_NS) * 1e-9)
    assert np.linalg.norm(state.T_world_body[:3, 3] - T[:3, 3]) < 0.05
    assert np.linalg.norm(state.velocity_world_m_s - v) < 0.05
    assert np.linalg.norm(state.gyro_bias_rad_s - scene.biases[-1, :3]) < 2e-3
    assert ekf.counters["vo_accepted"] == len(scene.stamps) - 1
    assert ekf.counters["keyframes"] == len(scene.keyframes)
    assert np.linalg.eigvalsh(ekf.state().covariance)[0] > 0.0


@pytest.mark.parametrize("delay_s", [0.02, 0.1, 0.35])
def test_late_is_the_same_as_on_time(scene: Scene, delay_s: float) -> None:
    on_time, late = scene.run(scene.ekf()), scene.run(scene.ekf(), delay_s)
    assert_same(on_time.state(), late.state())
    assert late.counters["rewinds"] > 100
    for t_ns in scene.stamps[-40:]:
        a, b = on_time.pose_at(t_ns), late.pose_at(t_ns)
        assert a is not None
        assert b is not None
        np.testing.assert_array_equal(a, b)


def test_order_of_arrival_does_not_matter(scene: Scene) -> None:
    """Frames of the last seconds in any order, clones among them; ties in time keep motion before keyframe."""
    straight = scene.run(scene.ekf(history_s=20.0))
    shuffled = scene.ekf(history_s=20.0)
    for s in scene.samples:
        shuffled.predict(s)
    order = np.random.default_rng(0).permutation(len(scene.stamps))
    for i in order:
        scene.measure(shuffled, int(i))
    assert_same(straight.state(), shuffled.state())
    outcome = ("vo_accepted", "vo_gated", "vo_no_keyframe", "keyframes")
    assert [straight.counters[name] for name in outcome] == [shuffled.counters[name] for name in outcome]


def test_replay_is_deterministic(scene: Scene) -> None:
    assert_same(scene.run(scene.ekf()).state(), scene.run(scene.ekf()).state())


def test_measurement_ahead_of_the_imu_waits(scene: Scene) -> None:
    ahead, on_time = scene.ekf(), scene.ekf()
    for s in scene.samples[:10]:
        ahead.predict(s)
        on_time.predict(s)
    t_ns = scene.samples[12].t_ns + 1_000_000
    result = ahead.add_keyframe(0, t_ns)
    assert not result.accepted
    assert "waits" in result.reason
    for s in scene.samples[10:20]:
        ahead.predict(s)
        on_time.predict(s)
    on_time.add_keyframe(0, t_ns)
    assert ahead.counters["keyframes"] == 1
    assert_same(ahead.state(), on_time.state())


def test_start_in_the_past_runs_through_the_samples(scene: Scene) -> None:
    first, later = scene.ekf(), Ekf(EkfConfig(vo_inflation=1.0), EUROC_NOISE, MACHINE)
    for s in scene.samples[:200]:
        first.predict(s)
        later.predict(s)
    assert not later.initialised
    assert later.dead_reckoning_s == float("inf")
    later.initialise(scene.start())
    assert_same(first.state(), later.state())


def test_start_can_place_the_keyframe(scene: Scene) -> None:
    """A filter that starts between keyframes uses the next motions at once, relative to a keyframe it never saw."""
    i = 3 * scene.vision.keyframe_every + 4
    source = scene.run(scene.ekf())
    state = source.state_at(scene.stamps[i])
    assert state is not None
    ekf = Ekf(EkfConfig(), EUROC_NOISE, MACHINE)
    for s in scene.samples:
        ekf.predict(s)
    ekf.initialise(state, scene.motions[i])
    for k in (i + 1, i + 2):
        result = ekf.update_vo(scene.motions[k])
        assert result.accepted, result.reason
    blind = Ekf(EkfConfig(), EUROC_NOISE, MACHINE)
    blind.predict(scene.samples[-1])
    blind.initialise(state)
    assert not blind.update_vo(scene.motions[i + 1]).accepted
    assert blind.counters["vo_no_keyframe"] == 1


def test_without_vision_the_filter_knows_that_it_does_not_know(scene: Scene) -> None:
    ekf = scene.ekf()
    sigma, shown = [], []
    for k, s in enumerate(scene.samples):
        ekf.predict(s)
        if k % 200 == 0:
            sigma.append(np.trace(ekf.state().covariance[3:6, 3:6]))
            shown.append(ekf.dead_reckoning_s)
    assert (np.diff(sigma) > 0).all()
    np.testing.assert_allclose(shown, range(len(shown)), atol=1e-9)
    lost = replace(scene.motions[5], T_keyframe_body=None, tracking=Tracking.LOST)
    before = ekf.state()
    assert not ekf.update_vision(lost, Observations(np.arange(0), np.zeros((0, 2)))).accepted
    assert ekf.counters["vo_lost"] == 1
    assert_same(before, ekf.state())


def test_outage_of_vision_and_recovery(scene: Scene) -> None:
    """2 s without vision: a new keyframe afterwards, errors inside 4 sigma, no reset."""
    ekf = scene.ekf()
    i, gone, again = 0, 40, 80  # frames 40..79 never come; 80 starts keyframe 10
    for s in scene.samples:
        ekf.predict(s)
        while i < len(scene.stamps) and s.t_ns >= scene.stamps[i]:
            if i < gone or i > again:
                scene.measure(ekf, i)
            elif i == again:
                ekf.add_keyframe(i // scene.vision.keyframe_every, scene.stamps[i])
            i += 1
    state = ekf.state()
    T, *_ = scene.motion.at((state.t_ns - T0_NS) * 1e-9)
    error = T[:3, 3] - state.T_world_body[:3, 3]
    assert error @ np.linalg.solve(state.covariance[3:6, 3:6], error) < 3 * 16
    assert ekf.counters["soft_resets"] == 0
    assert ekf.counters["vo_gated"] <= 1


def test_hole_of_one_second_in_the_imu(scene: Scene) -> None:
    """Bridged with honest uncertainty, also when frames inside the hole cut it into small steps."""
    cut = [s for s in scene.samples if not 2.0 < (s.t_ns - T0_NS) / NS < 3.0]
    plain, split, whole = scene.ekf(), scene.ekf(), scene.ekf()
    for ekf in (plain, split, whole):
        ekf.initialise(replace(scene.start((1e-3, 1e-2)), gyro_bias_rad_s=scene.biases[0, :3]))
    for s in cut:
        plain.predict(s)
        split.predict(s)
    for k in range(42, 58, 4):
        split.add_keyframe(k, scene.stamps[k])  # a clone moves nothing, but stops the integration there
    assert plain.counters["imu_gaps"] == 1
    after = T0_NS + 3 * NS
    a, b = plain.state_at(after), split.state_at(after)
    for s in scene.samples:
        whole.predict(s)
    c = whole.state_at(after)
    assert a is not None
    assert b is not None
    assert c is not None
    sigma = [np.sqrt(np.trace(state.covariance[6:9, 6:9])) for state in (a, b, c)]
    assert sigma[0] == pytest.approx(sigma[1], rel=0.1)
    assert sigma[0] > 3.0
    assert sigma[2] < 1.0  # tilt of 0.02 rad for 3 s
    _, v, *_ = scene.motion.at(3.0)
    error = v - a.velocity_world_m_s
    assert error @ np.linalg.solve(a.covariance[6:9, 6:9], error) < 16.0


def test_what_a_hole_was_filled_with_is_taken_back_when_samples_come_late(scene: Scene) -> None:
    """Half a second without samples, in which frames go on: they hold the pose, and nothing is left of it."""
    known = [s for s in scene.samples if s.t_ns <= T0_NS + 2 * NS]
    late, on_time = scene.ekf(), scene.ekf()
    frames = [i for i, t_ns in enumerate(scene.stamps) if t_ns < T0_NS + 2.5 * NS]
    for s in known:
        late.predict(s)
    for i in frames:
        scene.measure(late, i)
        late.assume(scene.stamps[i])
    end = scene.stamps[frames[-1]]
    state = late.state()
    assert state.t_ns == end
    off_m = np.linalg.norm(state.T_world_body[:3, 3] - scene.motion.pose((end - T0_NS) / NS)[:3, 3])
    assert off_m < min(0.05, 3.0 * np.sqrt(np.trace(state.covariance[3:6, 3:6])))
    for s in scene.samples[:800]:
        on_time.predict(s)
    for i in frames:
        scene.measure(on_time, i)
    for s in scene.samples[len(known) : 800]:
        late.predict(s)
    assert_same(late.state(), on_time.state())


def test_a_filter_that_believes_samples_no_more_is_as_one_that_never_got_them(scene: Scene) -> None:
    """They are taken back to where they went wrong; frames since then count as if each had waited in vain."""
    good = [s for s in scene.samples if s.t_ns <= T0_NS + 2 * NS]
    bad = [ImuSample(s.t_ns, -s.gyro_rad_s, -s.accel_m_s2) for s in scene.samples[len(good) : 500]]
    misled, spared = scene.ekf(), scene.ekf()
    frames = [i for i, t_ns in enumerate(scene.stamps) if t_ns < bad[-1].t_ns]
    for s in [*good, *bad]:
        misled.predict(s)
    for s in good:
        spared.predict(s)
    for i in frames:
        scene.measure(misled, i)
        scene.measure(spared, i)
        spared.assume(scene.stamps[i])
    misled.believe(good[-1].t_ns)
    misled.assume(scene.stamps[frames[-1]])
    assert_same(misled.state(), spared.state())
    misled.predict(scene.samples[500])
    assert_same(misled.state(), spared.state())
    misled.believe(None)
    for s in scene.samples[501:600]:
        misled.predict(s)
    assert misled.state().t_ns == scene.samples[599].t_ns


def test_samples_older_than_what_is_remembered_do_not_come_between(scene: Scene) -> None:
    ekf = scene.ekf(history_s=0.5)
    known = [s for s in scene.samples if s.t_ns <= T0_NS + NS]
    for s in known:
        ekf.predict(s)
    for i in range(59):
        scene.measure(ekf, i)
        ekf.assume(scene.stamps[i])
    before = ekf.state()
    for s in scene.samples[len(known) : len(known) + 100]:  # half a second of them, more than a second late
        ekf.predict(s)
    assert_same(before, ekf.state())
    for s in scene.samples[-300:]:
        ekf.predict(s)
    assert ekf.state().t_ns == scene.samples[-1].t_ns
    assert np.linalg.eigvalsh(ekf.state().covariance)[0] > 0.0


def test_bad_samples_change_nothing_but_counters(scene: Scene) -> None:
    clean, dirty = scene.ekf(), scene.ekf()
    for k, s in enumerate(scene.samples[:400]):
        clean.predict(s)
        dirty.predict(s)
        if k == 100:
            dirty.predict(s)
            dirty.predict(scene.samples[50])
            dirty.predict(ImuSample(s.t_ns + 1, np.array([np.nan, 0, 0]), np.zeros(3)))
    assert_same(clean.state(), dirty.state())
    counters = dirty.counters
    assert (counters["imu_duplicate"], counters["imu_late"], counters["imu_unusable"]) == (1, 1, 1)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"T_keyframe_body": np.full((4, 4), np.nan)}, "rigid"),
        ({"T_keyframe_body": 2.0 * np.eye(4)}, "rigid"),
        ({"covariance": np.full((6, 6), np.inf)}, "finite"),
        ({"covariance": -np.eye(6)}, "positive"),
        ({"covariance": np.eye(3)}, "6x6"),
    ],
)
def test_unusable_motion_is_refused(scene: Scene, change: dict, reason: str) -> None:
    ekf = scene.run(scene.ekf())
    before = ekf.state()
    result = ekf.update_vo(replace(scene.motions[-1], **change))
    assert not result.accepted
    assert reason in result.reason
    assert ekf.counters["vo_invalid"] == 1
    assert_same(before, ekf.state())


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e4])
def test_what_is_a_covariance_is_what_its_eigenvalues_say(scale: float) -> None:
    rng = np.random.default_rng(12)
    for rank in range(7):
        Q = np.linalg.qr(rng.normal(size=(6, 6)))[0]
        values = scale * rng.uniform(0.1, 1.0, 6) * (np.arange(6) < rank)
        for lowest, reason in ((-0.5, ""), (-2.0, "the covariance is not positive semidefinite")):
            values[5] = lowest * 1e-9 * (1.0 + values[:5].sum())
            vo = VoMeasurement(0, 0, np.eye(4), (Q * values) @ Q.T, True, Tracking.OK, 50)
            assert why_unusable(vo) == reason


def test_no_layout_of_numbers_is_compiled_for(scene: Scene) -> None:
    """A compiler at work would keep the pose waiting for a second."""
    ekf = scene.run(scene.ekf())
    known = len(visual_motion.correct.signatures), len(kernels.update.signatures)
    vo = scene.motions[-1]
    T, covariance = np.asfortranarray(vo.T_keyframe_body, dtype=np.float32), np.asfortranarray(vo.covariance)
    accepted = ekf.counters["vo_accepted"]
    ekf.update_vo(replace(vo, T_keyframe_body=T, covariance=np.broadcast_to(covariance, (6, 6))))
    assert ekf.counters["vo_accepted"] == accepted + 1
    assert known == (len(visual_motion.correct.signatures), len(kernels.update.signatures))


def through_a_pipe(correction: Correction) -> Correction:
    hears, says = Pipe(duplex=False)
    with hears, says:
        says.send(correction)
        return hears.recv()


@pytest.mark.parametrize("at_rest", [False, True])
def test_all_that_a_late_frame_tells_is_replayed_once(scene: Scene, at_rest: bool) -> None:
    together, apart = scene.run(scene.ekf()), scene.run(scene.ekf())
    vo = replace(scene.motions[-2], t_ns=scene.stamps[-2] + 1)
    correction = Correction(vo.t_ns, vo, NOTHING_SEEN, at_rest, not at_rest, 77)
    before = together.counters["rewinds"]
    said = through_a_pipe(correction).apply(together)
    assert together.counters["rewinds"] == before + 1
    answer = apart.update_vo(vo)
    apart.update_zero_velocity(vo.t_ns) if at_rest else apart.update_nonholonomic(vo.t_ns)
    apart.add_keyframe(77, vo.t_ns)
    assert apart.counters["rewinds"] == before + 3
    assert said == answer and said.accepted
    assert_same(together.state(), apart.state())


@pytest.mark.parametrize("T", [None, np.eye(4), np.full((3, 2), np.nan)])
def test_a_correction_travels_as_it_is(T: Array | None) -> None:
    rng = np.random.default_rng(2)
    seen = Observations(np.arange(3), rng.normal(size=(3, 2)), depth_m=np.ones(3))
    vo = VoMeasurement(5, 2, T, rng.normal(size=(6, 6)).T, False, Tracking.DEGRADED, 7)
    for observations in (seen, NOTHING_SEEN):
        correction = Correction(6, vo, observations, True, False, None, shows_scale=False)
        np.testing.assert_equal(asdict(through_a_pipe(correction)), asdict(correction))


def test_too_late_and_too_early() -> None:
    scene = Scene(duration_s=3.0)
    ekf = scene.run(scene.ekf(history_s=0.5))
    result = ekf.add_keyframe(99, T0_NS + NS)
    assert not result.accepted
    assert "older than the history" in result.reason
    assert ekf.counters["too_late"] == 1
    assert ekf.pose_at(T0_NS + NS) is None
    assert ekf.pose_at(scene.samples[-1].t_ns + 1) is None
    fresh = Ekf(EkfConfig(), EUROC_NOISE, MACHINE)
    assert not fresh.update_zero_velocity(0).accepted
    assert fresh.pose_at(0) is None
    with pytest.raises(ValueError, match="initialise"):
        fresh.state()


def test_an_outlier_is_gated(scene: Scene) -> None:
    ekf = scene.run(scene.ekf())
    before, last = ekf.state(), scene.motions[-1]
    assert last.T_keyframe_body is not None
    wrong = replace(last, T_keyframe_body=last.T_keyframe_body @ se3_exp(np.array([0, 0, 0, 0.5, 0, 0])))
    result = ekf.update_vo(wrong)
    assert not result.accepted
    assert result.nis > 22.46
    assert "innovation" in result.reason
    assert_same(before, ekf.state())


def test_sustained_rejection_widens_the_covariance_without_a_jump() -> None:
    scene = Scene(duration_s=5.0)
    ekf = scene.run(scene.ekf())
    state = ekf.state()
    wrong = replace(
        state, velocity_world_m_s=state.velocity_world_m_s + np.array([1.5, 0.0, 0.0]), covariance=np.eye(15) * 1e-8
    )
    ekf.initialise(replace(wrong, t_ns=scene.stamps[40]))  # certain and wrong
    ekf.add_keyframe(5, scene.stamps[40])
    widened = None
    for i in range(41, len(scene.stamps)):
        before = ekf.state_at(scene.stamps[i])
        ekf.update_vo(replace(scene.motions[i], keyframe_id=5))
        after = ekf.state_at(scene.stamps[i])
        if ekf.counters["soft_resets"]:
            widened = (before, after)
            break
    assert widened is not None
    before, after = widened
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(before.T_world_body, after.T_world_body)
    assert np.trace(after.covariance) > np.trace(before.covariance) + 1.0


def test_zero_velocity_stops_the_drift_and_shows_the_gyro_bias() -> None:
    bias = np.array([0.01, -0.02, 0.03])
    ekf = Ekf(EkfConfig(), EUROC_NOISE, MACHINE)
    sigmas = np.repeat([0.01, 0.001, 0.05, 0.05, 0.1], 3)
    ekf.initialise(NavState(T0_NS, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.diag(sigmas**2)))
    for k in range(1, 2001):
        ekf.predict(ImuSample(T0_NS + k * 5_000_000, bias, np.array([0.05, 0.0, GRAVITY_M_S2])))
        if k % 10 == 0:
            assert ekf.update_zero_velocity(T0_NS + k * 5_000_000 - 1_000_000).accepted
    state = ekf.state()
    assert np.linalg.norm(state.T_world_body[:3, 3]) < 0.05
    np.testing.assert_allclose(state.gyro_bias_rad_s, bias, atol=1e-3)
    moving = ekf.state()
    ekf.initialise(replace(moving, velocity_world_m_s=np.array([1.0, 0, 0])))
    assert not ekf.update_zero_velocity(moving.t_ns).accepted
    assert ekf.counters["zero_velocity_gated"] == 1


def test_rest_holds_the_pose_at_which_it_began_through_keyframes_and_a_missed_frame() -> None:
    """A minute, 5 keyframes a second, vision relative to each with its own error; every 50th frame is not told."""
    rng = np.random.default_rng(21)
    ekf = Ekf(EkfConfig(), EUROC_NOISE, MACHINE)
    sigmas = np.repeat([0.01, 0.001, 0.05, 0.02, 0.1], 3)
    ekf.initialise(NavState(T0_NS, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.diag(sigmas**2)))
    per_sample = np.sqrt(EUROC_NOISE.rate_hz) * np.repeat([3.0, 1.0], 3)
    per_sample[:3] *= EUROC_NOISE.gyroscope_noise_density
    per_sample[3:] *= EUROC_NOISE.accelerometer_noise_density
    vo_sigmas = np.repeat([np.deg2rad(0.05), 0.004], 3)
    keyframe, at_begin = 0, None
    assert ekf.add_keyframe(0, T0_NS).accepted
    for k in range(1, 12001):
        t_ns = T0_NS + k * 5_000_000
        noise = rng.normal(0.0, per_sample)
        ekf.predict(ImuSample(t_ns, noise[:3], noise[3:] + np.array([0.0, 0.0, GRAVITY_M_S2])))
        if k % 20:
            continue
        if k % 40:
            shared = rng.normal(0.0, vo_sigmas)
        T = se3_exp(0.7 * (shared + rng.normal(0.0, vo_sigmas)))
        ekf.update_vo(VoMeasurement(t_ns, keyframe, T, np.diag(vo_sigmas**2), True, Tracking.OK, 100))
        if k % 1000 != 20:
            ekf.update_zero_velocity(t_ns)
        if k % 40 == 0:
            keyframe += 1
            ekf.add_keyframe(keyframe, t_ns)
        if k == 200:
            at_begin = ekf.state()
    state = ekf.state()
    assert at_begin is not None
    moved = np.linalg.inv(at_begin.T_world_body) @ state.T_world_body
    assert np.linalg.norm(moved[:3, 3]) < 0.004
    assert np.rad2deg(np.linalg.norm(so3_log(moved[:3, :3].copy()))) < 0.15
    assert state.covariance[2, 2] - 0.01**2 < np.deg2rad(0.15) ** 2


def test_rest_that_was_left_unseen_does_not_pull_back() -> None:
    ekf = Ekf(EkfConfig(), EUROC_NOISE, MACHINE)
    sigmas = np.repeat([0.01, 0.001, 0.05, 0.01, 0.1], 3)
    ekf.initialise(NavState(T0_NS, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.diag(sigmas**2)))
    ekf.add_keyframe(0, T0_NS)
    T = np.eye(4)
    for k in range(1, 801):
        t_ns, push = T0_NS + k * 5_000_000, 0.0
        if 400 < k <= 440:  # 0.2 s there and away: 5 cm
            push = 5.0 if k <= 420 else -5.0
            T[0, 3] += 0.5 * push * 0.005**2 + 0.005 * 5.0 * 0.005 * (k - 401 if k <= 420 else 441 - k)
        ekf.predict(ImuSample(t_ns, np.zeros(3), np.array([push, 0.0, GRAVITY_M_S2])))
        if k % 20 == 0:
            covariance = np.diag(np.repeat([1e-3, 2e-3], 3) ** 2)
            ekf.update_vo(VoMeasurement(t_ns, 0 if k <= 200 else 1, T.copy(), covariance, True, Tracking.OK, 100))
            if not 400 < k <= 440:
                ekf.update_zero_velocity(t_ns)
            if k == 200:
                ekf.add_keyframe(1, t_ns)
    assert ekf.state().T_world_body[0, 3] == pytest.approx(T[0, 3], abs=0.005)
    assert ekf.counters["zero_velocity_gated"] >= 1


def test_feedback_moves_biases_only(scene: Scene) -> None:
    ekf = scene.run(scene.ekf())
    before = ekf.state()
    result = ekf.feed_back(before.gyro_bias_rad_s + 5e-4, before.accel_bias_m_s2 + 0.02, 1e-3, np.full(3, 0.05))
    assert result.accepted
    after = ekf.state()
    np.testing.assert_array_equal(before.T_world_body, after.T_world_body)
    np.testing.assert_array_equal(before.velocity_world_m_s, after.velocity_world_m_s)
    assert (after.gyro_bias_rad_s > before.gyro_bias_rad_s).all()
    assert np.linalg.eigvalsh(after.covariance)[0] > 0.0
    gained = (before.covariance - after.covariance)[9:, 9:]  # the rest keeps its own and changes its correlations
    assert np.linalg.eigvalsh(gained)[0] > -1e-12
    np.testing.assert_allclose(after.covariance[:9, :9], before.covariance[:9, :9], atol=1e-15)
    assert not ekf.feed_back(before.gyro_bias_rad_s + 1.0, before.accel_bias_m_s2, 1e-3, 0.05).accepted
    assert not ekf.feed_back(np.full(3, np.nan), before.accel_bias_m_s2, 1e-3, 0.05).accepted
    assert (ekf.counters["bias_accepted"], ekf.counters["bias_gated"], ekf.counters["bias_invalid"]) == (1, 1, 1)


def test_pose_history_is_continuous(scene: Scene) -> None:
    ekf = scene.run(scene.ekf())
    t_ns = scene.stamps[-20] + np.arange(0, 400_000_000, 500_000)
    poses = [ekf.pose_at(int(t)) for t in t_ns]
    assert all(pose is not None for pose in poses)
    positions = np.array([pose[:3, 3] for pose in poses if pose is not None])
    truth = np.array([scene.motion.pose((t - T0_NS) * 1e-9)[:3, 3] for t in t_ns])
    assert np.abs(np.diff(positions, axis=0) - np.diff(truth, axis=0)).max() < 5e-3
    newest = ekf.pose_at(scene.samples[-1].t_ns)
    assert newest is not None
    np.testing.assert_allclose(newest, ekf.state().T_world_body, atol=1e-12)


CAMERA = transform(so3_exp(np.array([0.3, -0.2, 0.1])), np.array([0.1, -0.05, 0.2]))


def test_directions_alone_keep_attitude_and_slow_the_drift() -> None:
    scene = Scene(seed=3, camera=CAMERA)
    free, seen = scene.ekf(), scene.ekf()
    seen = Ekf(EkfConfig(vo_inflation=1.0), EUROC_NOISE, MACHINE, CAMERA)
    seen.initialise(scene.ekf().state())
    scene.run(seen)
    for s in scene.samples:
        free.predict(s)
    T, *_ = scene.motion.at((seen.state().t_ns - T0_NS) * 1e-9)
    drift = [np.linalg.norm(T[:3, 3] - ekf.state().T_world_body[:3, 3]) for ekf in (free, seen)]
    assert drift[1] < 0.2 * drift[0]
    assert seen.counters["vo_accepted"] > 0.95 * len(scene.stamps)


def test_direction_from_behind_is_refused_and_no_parallax_gives_rotation() -> None:
    scene = Scene(seed=3, camera=CAMERA)
    ekf = Ekf(EkfConfig(vo_inflation=1.0), EUROC_NOISE, MACHINE, CAMERA)
    ekf.initialise(scene.ekf().state())
    scene.run(ekf)
    last = scene.motions[-1]
    assert last.T_keyframe_body is not None
    backward, still = last.T_keyframe_body.copy(), last.T_keyframe_body.copy()
    backward[:3, 3] *= -1.0
    still[:3, 3] = 0.0
    result = ekf.update_vo(replace(last, T_keyframe_body=backward))
    assert not result.accepted
    assert ekf.counters["vo_opposed"] == 1
    before = ekf.state()
    assert ekf.update_vo(replace(last, T_keyframe_body=still)).accepted
    after = ekf.state()
    assert np.linalg.norm(after.T_world_body[:3, 3] - before.T_world_body[:3, 3]) < 0.02


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6))
def test_covariance_stays_positive(seed: int) -> None:
    """Random gates, clones, outliers and rests in random order never break it."""
    rng = np.random.default_rng(seed)
    scene = Scene(seed=1, duration_s=1.5)
    ekf = scene.ekf()
    for s in scene.samples:
        ekf.predict(s)
        if rng.random() < 0.1:
            ekf.add_keyframe(int(rng.integers(0, 3)), s.t_ns - int(rng.integers(0, 10**8)))
        if rng.random() < 0.2:
            T = se3_exp(rng.normal(size=6) * 0.05)
            covariance = np.diag(rng.uniform(1e-8, 1e-2, 6))
            t_ns = s.t_ns - int(rng.integers(0, 10**8))
            ekf.update_vo(VoMeasurement(t_ns, int(rng.integers(0, 3)), T, covariance, True, Tracking.OK, 9))
        if rng.random() < 0.02:
            ekf.update_zero_velocity(s.t_ns)
        P = mc.inside(ekf).P
        assert np.linalg.eigvalsh(P)[0] > -1e-12 * np.trace(P)
    np.testing.assert_array_equal(P, P.T)


def test_right_jacobian_of_one_step() -> None:
    J = np.empty((3, 3))
    write_right_jacobian(0.01, -0.02, 0.015, 0.005, J)
    np.testing.assert_allclose(J, 0.005 * so3_right_jacobian(np.array([0.01, -0.02, 0.015])), atol=1e-8)
