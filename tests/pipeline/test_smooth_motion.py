"""The pose that vision alone publishes: it steps as the body does, and its covariance is what its errors are."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import GraphConfig, PublishConfig
from vislam.core import Array, NavState, Tracking, VoMeasurement, so3_exp, so3_log, transform
from vislam.frontend.result import lost_motion
from vislam.pipeline.coasting import LEAST_DENSITY
from vislam.pipeline.smooth_motion import SmoothMotion
from vislam.sim.motion.motions import world_motion
from vislam.trajectory.continuity import Continuity

NS = 1_000_000_000
HZ = 30
PERIOD_NS = NS // HZ
# of a depth camera by hand: 3 mm and 2 mrad, and what looks like a turn may be a shift
_SIGMAS = np.repeat([0.002, 0.003], 3)
_MIXED = np.eye(6) + 0.8 * np.eye(6, k=4) + 0.8 * np.eye(6, k=-4)
COVARIANCE = _SIGMAS[:, None] * _MIXED * _SIGMAS
EXACT = replace(GraphConfig(), vo_floor_deg=0.0, vo_floor_m=0.0)  # simulated vision errs as it states


def measured(k: int, T: Array) -> VoMeasurement:
    """Return what vision has of frame k, at a pose [4, 4] of the keyframe's frame."""
    return VoMeasurement(k * PERIOD_NS, 0, T, COVARIANCE, True, Tracking.OK, 100)


def seen(T: Array, rng: np.random.Generator) -> Array:
    """Return a true pose [4, 4] as vision measures it."""
    error = np.linalg.cholesky(COVARIANCE) @ rng.standard_normal(6)
    return transform(T[:3, :3] @ so3_exp(error[:3]), T[:3, 3] + T[:3, :3] @ error[3:])


def driven(frames: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return poses [N, 4, 4], velocities and rates [N, 3] of a body that white acceleration drives."""
    dt = PERIOD_NS / NS
    root = np.linalg.cholesky(np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]))
    R, p = np.eye(3), np.zeros(3)
    rate, velocity = 0.5 * rng.standard_normal(3), 0.5 * rng.standard_normal(3)
    found: list[tuple[Array, Array, Array]] = []
    for _ in range(frames):
        found.append((transform(R, p), velocity, rate))
        shaken = [np.sqrt(density) * root @ rng.standard_normal((2, 3)) for density in LEAST_DENSITY]
        R, p = R @ so3_exp(rate * dt + shaken[0][0]), p + velocity * dt + shaken[1][0]
        rate, velocity = rate + shaken[0][1], velocity + shaken[1][1]
    return tuple(np.array(part) for part in zip(*found, strict=True))  # type: ignore[return-value]


def misfit(state: NavState, T: Array, velocity: Array) -> Array:
    """Return the normalised squared errors of rotation, position and velocity, per degree of freedom."""
    errors = so3_log(state.T_world_body[:3, :3].T @ T[:3, :3]), T[:3, 3] - state.T_world_body[:3, 3]
    parts = [*errors, velocity - state.velocity_world_m_s]
    spread = [state.covariance[n : n + 3, n : n + 3] for n in (0, 3, 6)]
    return np.array([e @ np.linalg.solve(P, e) / 3.0 for e, P in zip(parts, spread, strict=True)])


def test_errors_of_a_body_that_moves_as_assumed_are_those_stated() -> None:
    """Sixteen runs of 3 s; every half second is taken for independent."""
    found = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        motion = SmoothMotion(EXACT, PublishConfig())
        for k, (T, velocity, _) in enumerate(zip(*driven(90, rng), strict=True)):
            estimate = motion.follow(measured(k, T), seen(T, rng) if k else T, False)
            if k % 15 == 14:
                assert estimate.moving is not None
                found.append(misfit(estimate.moving, T, velocity))
    mean = np.mean(found, axis=0)  # of 288 degrees of freedom: 0.84 to 1.17 in 95 of 100
    print(mean)
    assert (mean > 0.7).all() and (mean < 1.17).all()  # less: outliers are expected, and there are none


@pytest.fixture(scope="module")
def by_hand() -> dict[str, Array]:
    """A walk in laps: truth, what vision measured, what is estimated, what is published, and velocities."""
    rng = np.random.default_rng(3)
    spline = world_motion("laps", rng, 20.0)
    t_s = 3.0 + np.arange(12 * HZ) / HZ  # it rests before
    state = spline.at(t_s)
    motion, published = SmoothMotion(GraphConfig(), PublishConfig()), Continuity(PublishConfig())
    rows = []
    for k, T in enumerate(state.T_world_body):
        vision = seen(T, rng) if k else T
        estimate = motion.follow(measured(k, vision), vision, False)
        assert estimate.moving is not None
        rows.append((T, vision, estimate.shown(k * PERIOD_NS, published), estimate.moving.velocity_world_m_s))
    names = ("truth", "vision", "published", "velocity")
    return dict(zip(names, (np.array(part) for part in zip(*rows, strict=True)), strict=True))


def step_error_m(poses: Array, truth: Array) -> float:
    """Return the rms error of steps from frame to frame, after the first second."""
    wrong = np.diff(poses[HZ:, :3, 3], axis=0) - np.diff(truth[HZ:, :3, 3], axis=0)
    return float(np.sqrt(np.mean(np.sum(wrong**2, axis=1))))


def test_what_is_published_steps_as_the_body_does_and_is_no_worse(by_hand: dict[str, Array]) -> None:
    truth, vision, published = by_hand["truth"], by_hand["vision"], by_hand["published"]
    assert step_error_m(published, truth) < 0.4 * step_error_m(vision, truth)
    off = [np.sqrt(np.mean(np.sum((poses - truth)[2 * HZ :, :3, 3] ** 2, axis=1))) for poses in (vision, published)]
    print(step_error_m(vision, truth), step_error_m(published, truth), off)
    assert off[1] < off[0]
    late = [step_error_m(published[n:], truth[: len(truth) - n]) for n in range(4)]
    assert np.argmin(late) <= 1  # frames; one is 33 ms


def test_its_velocity_is_better_than_that_of_differences(by_hand: dict[str, Array]) -> None:
    truth, vision = by_hand["truth"], by_hand["vision"]
    true = np.gradient(truth[:, :3, 3], 1.0 / HZ, axis=0)[HZ:-1]
    crude = HZ * np.diff(vision[:, :3, 3], axis=0)[HZ - 1 : -1]
    errors = [np.sqrt(np.mean(np.sum((v - true) ** 2, axis=1))) for v in (by_hand["velocity"][HZ:-1], crude)]
    assert errors[0] < 0.5 * errors[1]


def test_over_a_gap_it_goes_on_and_states_how_unsure_it_is() -> None:
    """A tenth of a second without a pose, and half a second in which frames do not come."""
    rng = np.random.default_rng(7)
    poses, velocities, _ = driven(150, rng)
    motion, published, before, found = SmoothMotion(EXACT, PublishConfig()), Continuity(PublishConfig()), None, []
    for k, T in enumerate(poses):
        if 100 <= k < 115:
            continue
        vision = seen(T, rng) if k else T
        vo = lost_motion(k * PERIOD_NS, 0, True) if 60 <= k < 63 else measured(k, vision)
        estimate = motion.follow(vo, np.eye(4) if 60 <= k < 63 else vision, False)
        shown = estimate.shown(k * PERIOD_NS, published)
        assert estimate.moving is not None
        if k in (62, 115):
            assert (misfit(estimate.moving, T, velocities[k]) < 5.4).all()  # 0.999 of three
        if before is not None:
            step = np.linalg.norm(shown[:3, 3] - before[1])
            found.append(step - np.linalg.norm(T[:3, 3] - before[0]))
        before = T[:3, 3], shown[:3, 3]
    assert np.abs(found).max() < 0.02  # nothing jumps, neither while it is lost nor when it is found again


@pytest.mark.parametrize("jump_m", [0.1, 0.6, 5.0])
def test_a_jump_of_the_front_end_is_no_motion(jump_m: float) -> None:
    """A new submap, or a keyframe that was wrong: the estimate follows at once, and its velocity is not thrown."""
    rng = np.random.default_rng(11)
    poses, velocities, _ = driven(90, rng)
    shift = np.array([jump_m, 0.0, 0.0])
    motion, published, shown, fastest = (
        SmoothMotion(GraphConfig(), PublishConfig()),
        Continuity(PublishConfig()),
        [],
        0.0,
    )
    for k, T in enumerate(poses):
        vision = seen(T, rng) if k else T.copy()
        vision[:3, 3] += shift * (k >= 60)
        estimate = motion.follow(measured(k, vision), vision, False)
        shown.append(estimate.shown(k * PERIOD_NS, published))
        assert estimate.moving is not None
        if k >= 60:
            fastest = max(fastest, float(np.linalg.norm(estimate.moving.velocity_world_m_s - velocities[k])))
    assert np.linalg.norm(estimate.T_odom_body[:3, 3] - T[:3, 3] - shift) < 0.02  # at the end
    assert fastest < 1.0
    step = np.diff(np.array(shown)[:, :3, 3], axis=0) - np.diff(poses[:, :3, 3], axis=0)
    if jump_m < 1.0:  # else another belief about the place, which comes at once
        assert np.linalg.norm(step, axis=1).max() < 0.4 * jump_m


def test_what_is_torn_begins_again_where_it_is() -> None:
    motion = SmoothMotion(GraphConfig(), PublishConfig())
    for k in range(20):
        estimate = motion.follow(measured(k, np.eye(4)), transform(np.eye(3), np.array([0.02 * k, 0.0, 0.0])), False)
    place = transform(np.eye(3), np.array([3.0, 0.0, 0.0]))
    estimate = motion.follow(measured(2, place), place, True)  # its clock stepped back
    assert np.array_equal(estimate.T_odom_body, place) and np.array_equal(estimate.T_odom_before, place)
    assert estimate.moving is not None and not estimate.moving.velocity_world_m_s.any()
    assert np.isnan(estimate.moving.gyro_bias_rad_s).all()


def test_where_it_is_not_wanted_poses_are_those_of_vision() -> None:
    rng = np.random.default_rng(13)
    motion = SmoothMotion(GraphConfig(), PublishConfig(enabled=False))
    for k, T in enumerate(driven(20, rng)[0]):
        vision = seen(T, rng) if k else T
        estimate = motion.follow(measured(k, vision), vision, False)
        assert np.array_equal(estimate.T_odom_body, vision) and np.array_equal(estimate.T_odom_before, vision)
    assert estimate.moving is not None and estimate.moving.velocity_world_m_s.any()
