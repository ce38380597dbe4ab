"""Uniform motion of one camera: scale is forgotten, and the window says so; what the first turn then tells."""

from dataclasses import replace

import numpy as np

from vislam.config import WindowConfig
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Array
from vislam.sim.sensing import CONSUMER_IMU
from vislam.window import SlidingWindow
from vislam.window.keyframes import at_first_scale
from worlds.motion import NS, T0_NS, Motion, levelled, state_error, still
from worlds.parts import GRAVITY_M_S2, MACHINE
from worlds.room import MONO, World, start_state

_SPEED_UP_S = 2.0
_TURN_S, _SLALOM_1_S, _SLALOM_M = 15.0, 0.8, 1.5


class Ahead(Motion):
    """Speeds up along x to 1 m/s within 2 s and keeps that velocity; never turns."""

    def at(self, t_s: float) -> tuple[Array, Array, Array, Array]:
        u = min(t_s / _SPEED_UP_S, 1.0)
        x = _SPEED_UP_S * (u**6 - 3.0 * u**5 + 2.5 * u**4) + max(t_s - _SPEED_UP_S, 0.0)
        v = 6.0 * u**5 - 15.0 * u**4 + 10.0 * u**3
        a = (30.0 * u**4 - 60.0 * u**3 + 30.0 * u**2) / _SPEED_UP_S
        way, force = np.array([x, 0.0, 0.0]), np.array([a, 0.0, GRAVITY_M_S2])
        return transform(np.eye(3), way), np.array([v, 0.0, 0.0]), np.zeros(3), force


class Corner(Ahead):
    """The same, and from 15 s on in a slalom, looking ahead."""

    def at(self, t_s: float) -> tuple[Array, Array, Array, Array]:
        T, v, _, force = super().at(t_s)
        if t_s <= _TURN_S:
            return T, v, np.zeros(3), force
        phase = _SLALOM_1_S * (t_s - _TURN_S)
        side = _SLALOM_M * np.array([phase - np.sin(phase), 1.0 - np.cos(phase), np.sin(phase)])
        side *= _SLALOM_1_S ** np.arange(3)
        v, a = np.array([v[0], side[1], 0.0]), np.array([0.0, side[2], GRAVITY_M_S2])
        R = so3_exp(np.array([0.0, 0.0, np.arctan2(v[1], v[0])]))
        turning = np.array([0.0, 0.0, a[1] * v[0] / (v @ v)])
        return transform(R, T[:3, 3] + np.array([0.0, side[0], 0.0])), v, turning, R.T @ a


def test_the_first_turn_after_a_long_straight_way_is_believed_as_far_as_it_tells() -> None:
    """Four runs: there tilt, bias and scale come apart within a second; none may be known too well. Seeds 0 to 3."""
    tests, worst_m_s = [], 0.0
    for seed in range(4):
        motion = Corner(np.zeros((2, 3, 3)), np.zeros((2, 3, 3)))
        world = World(motion, MONO, seed, duration_s=25.0, room_m=(40.0, 12.0, 2.5))
        packets, truths = world.packets()
        window = SlidingWindow(WindowConfig(), world.rig, world.noise, MACHINE)
        T, _, bias = truths[0]
        start = levelled(np.random.default_rng(seed + 1000), T, bias[:3], bias[3:])
        window.initialise(replace(start, t_ns=packets[0].keyframe.t_ns))
        for packet, truth in zip(packets, truths, strict=True):
            state = window.add(packet).newest
            if packet.keyframe.t_ns > T0_NS + round(_TURN_S * NS):
                error, P = state_error(truth, state)[6:9], state.covariance[6:9, 6:9]
                tests.append(error @ np.linalg.solve(P, error) / 3.0)
                worst_m_s = max(worst_m_s, float(np.linalg.norm(error)))
    print(f"NEES per degree of freedom of velocity {np.mean(tests):.2f}, worst error {worst_m_s:.3f} m/s")
    assert np.mean(tests) < 2.0


def test_scale_that_nothing_shows_is_not_learnt_from_noise() -> None:
    """Four runs of 25 s: errors of position and velocity stay within their sigmas, and these grow. Seeds 0 to 3."""
    total, grown = np.zeros(2), []
    for seed in range(4):
        world = World(
            Ahead(np.zeros((2, 3, 3)), np.zeros((2, 3, 3))), MONO, seed, duration_s=25.0, room_m=(40.0, 4.0, 2.5)
        )
        packets, truths = world.packets()
        window = SlidingWindow(WindowConfig(), world.rig, world.noise, MACHINE)
        window.initialise(start_state(truths[0], packets[0].keyframe.t_ns, np.random.default_rng(seed + 1000)))
        states = [window.add(p).newest for p in packets]
        for k in (60, 80, 100, len(states) - 1):
            error, P = state_error(truths[k], states[k]), states[k].covariance
            for i, part in enumerate((slice(3, 6), slice(6, 9))):
                total[i] += error[part] @ np.linalg.solve(P[part, part], error[part]) / 3.0
        sigmas = [np.sqrt(states[k].covariance[6, 6]) for k in (30, 70, len(states) - 1)]
        grown.append(sigmas)
        print(f"seed {seed}: end {states[-1].velocity_world_m_s}, sigma of its speed {np.round(sigmas, 3)} m/s")
    print("NEES per degree of freedom of position and velocity:", total / 16.0)
    assert (total / 16.0 < 2.5).all()
    assert (total / 16.0 > 0.1).all()
    assert (np.diff(np.mean(grown, axis=0)) > 0.0).all()


def test_new_states_are_linearised_as_if_estimated_with_the_held_ones() -> None:
    """A similarity between the first and the present estimates of the held states carries the others over exactly."""
    rng = np.random.default_rng(0)
    X = rng.normal(size=(6, 21))
    X[:, :9] = [so3_exp(w).ravel() for w in rng.normal(size=(6, 3))]
    turn, factor, shift = so3_exp(np.array([0.02, -0.03, 0.5])), 1.3, np.array([2.0, -1.0, 0.5])
    whole = X.copy()
    whole[:, :9] = (turn @ X[:, :9].reshape(-1, 3, 3)).reshape(-1, 9)
    held = np.array([True, True, True, False, False, False])
    whole[:, 9:12], whole[:, 12:15] = factor * X[:, 9:12] @ turn.T + shift, factor * X[:, 12:15] @ turn.T
    first = np.where(held[:, None], whole, np.nan)
    np.testing.assert_allclose(at_first_scale(X, first, held), whole, atol=1e-12)


def test_a_minute_and_a_half_at_rest_tells_nothing_of_tilt() -> None:
    """Tilt and the bias of force are one there: which is which was told before, and stays as unsure as it was."""
    motion = still(0.1, -0.15)
    world = World(
        motion, MONO, 1, duration_s=90.0, keyframe_hz=0.5, tracks=60, sigma_px=0.5, noise=CONSUMER_IMU, rest_until_s=1e9
    )
    packets, truths = world.packets()
    T, _, bias = truths[0]
    start = levelled(np.random.default_rng(1), T, bias[:3], bias[3:])
    window = SlidingWindow(WindowConfig(), world.rig, world.noise, MACHINE)
    window.initialise(replace(start, t_ns=packets[0].keyframe.t_ns))
    tilts, sigmas, tests = [], [], []
    for packet, truth in zip(packets, truths, strict=True):
        state = window.add(packet).newest
        R = state.T_world_body[:3, :3]
        tilt, P = (R @ state_error(truth, state)[:3])[:2], (R @ state.covariance[:3, :3] @ R.T)[:2, :2]
        tilts.append(np.rad2deg(tilt))
        sigmas.append(np.rad2deg(np.sqrt(0.5 * np.trace(P))))
        tests.append(tilt @ np.linalg.solve(P, tilt))
    wander_deg = np.linalg.norm(np.array(tilts) - tilts[0], axis=1)
    print(f"wander {wander_deg.max():.3f} deg, sigma {sigmas[0]:.3f} to {sigmas[-1]:.3f}, NEES up to {max(tests):.2f}")
    assert sigmas[-1] > 0.95 * sigmas[0]
    assert wander_deg.max() < 0.4
    assert max(tests) < 13.8  # 99.9 % of chi-square with 2 degrees of freedom
