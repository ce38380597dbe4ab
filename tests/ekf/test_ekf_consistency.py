"""Monte-Carlo: the filter's covariance is what its errors are, also on real inertial data.

The full campaign, 100 runs a scenario, is `benchmarks/ekf.py nees`; here are fewer runs, in bands as wide as that asks.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from vislam.config import EkfConfig
from vislam.core.geometry import align_points, so3_exp, transform_points
from vislam.core.messages import NavState, Tracking
from vislam.ekf import Ekf
from vislam.imu import NoiseFloor
from worlds import monte_carlo as mc
from worlds.motion import EUROC_NOISE, RealMotion, SimulatedVision
from worlds.parts import MACHINE

RUNS, FIRST_SEED = 10, 5000
SCENARIOS = {scenario.name: scenario for scenario in mc.SCENARIOS}


@cache
def measured(name: str, config: EkfConfig, runs: int = RUNS, duration_s: float = 30.0) -> mc.Consistency:
    scenario = mc.shortened(SCENARIOS[name], duration_s)
    result = mc.campaign(scenario, runs, config, FIRST_SEED)
    print(f"seeds {FIRST_SEED}..{FIRST_SEED + runs - 1}")
    print("\n".join(mc.table([(name, result)])))
    return result


def assert_consistent(result: mc.Consistency, slack: float = 1.0) -> None:
    """Every group's average lies in the 99.9 % band of so many runs: it is many comparisons that have to hold."""
    for group in (*mc.GROUPS, "yaw"):
        degrees, runs = result.degrees(group), len(result.runs)
        low, high = chi2.ppf([0.0005, 0.9995], degrees * runs) / runs
        assert low < result.average(group) < slack * high, group
    assert 0.97 < result.nis() < 1.03


@pytest.mark.slow
@pytest.mark.parametrize("name", ["250 ms late", "everything", "cart, everything", "directions, 5 s outage"])
def test_errors_are_what_the_covariance_says(name: str) -> None:
    assert_consistent(measured(name, mc.honest()))


@pytest.mark.slow
def test_so_they_are_where_the_past_is_corrected_too() -> None:
    kept, corrected = (measured("cart, on time", mc.honest(odom=odom), 8) for odom in ("continuous", "corrected"))
    assert_consistent(corrected)
    assert corrected.rmse(slice(3, 6)) < 1.02 * kept.rmse(slice(3, 6))  # more is learned


@pytest.mark.slow
def test_late_vision_costs_little() -> None:
    """Rewound to its own time, vision 250 ms late leaves the same state, a quarter of a second of inertia later."""
    on_time, late = (measured(name, mc.honest(), 6, 20.0) for name in ("on time", "250 ms late"))
    assert late.rmse(slice(3, 6)) < on_time.rmse(slice(3, 6)) + 0.02


@pytest.mark.slow
def test_a_shared_error_taken_for_independent_ones_is_inconsistent() -> None:
    """Why the filter needs `vo_shared_fraction`: without it the same runs are overconfident, and look cautious."""
    right, wrong = (measured("on time", mc.honest(vo_shared_fraction=fraction), 8) for fraction in (mc.SHARED, 0.0))
    assert wrong.average("all") > 1.15 * right.average("all")
    assert wrong.average("position") > 1.4 * right.average("position")
    assert wrong.nis() < 0.85
    assert right.nis() > 0.97


@pytest.mark.slow
def test_a_tilt_that_comes_to_light_does_not_lift_the_cart() -> None:
    """It shows at the first turn, metres away from the origin: a continuous odom takes that in millimetres."""
    scenario = mc.shortened(SCENARIOS["cart, on time"], 20.0)
    steps = {}
    for odom in ("continuous", "corrected"):
        heights = [
            [ekf.state().T_world_body[2, 3] for ekf, _, _ in mc.replay(scenario, mc.honest(odom=odom), FIRST_SEED + i)]
            for i in range(6)
        ]
        steps[odom] = np.abs(np.diff(np.array(heights), axis=1)).max(axis=1)
    print({odom: (values * 1e3).round(1).tolist() for odom, values in steps.items()}, "mm")
    assert steps["continuous"].max() < 0.015
    assert np.median(steps["corrected"]) > 3.0 * np.median(steps["continuous"])


@pytest.mark.slow
def test_vision_taken_for_a_pose_is_certain_of_its_own_drift() -> None:
    """The filter of Karpov et al. 2026 tracks easy motion, and its covariance is beside the point."""
    relative, accumulated = (measured("on time", mc.honest(vision=vision), 8) for vision in ("relative", "accumulated"))
    assert accumulated.rmse(slice(3, 6)) < 0.15
    assert accumulated.rmse(slice(0, 3)) < np.deg2rad(3.0)
    assert relative.rmse(slice(3, 6)) < accumulated.rmse(slice(3, 6))
    for group, ratio in (("all", 50.0), ("yaw", 30.0), ("position", 2.0)):
        assert accumulated.average(group) > ratio * relative.average(group), group


def test_accumulated_vision_starts_over_where_it_was_lost() -> None:
    """After an outage the chain goes on from the filter's pose, so that it fits at once."""
    scenario = mc.shortened(SCENARIOS["5 s outage"], 40.0)
    ekf, way, k = list(mc.replay(scenario, mc.honest(vision="accumulated"), FIRST_SEED))[-1]
    assert ekf.counters["vo_accepted"] > 0.95 * 10 * 35 - 2
    assert ekf.dead_reckoning_s < 0.2
    assert np.linalg.norm(way.error(k, ekf.state())[3:6]) < 1.0
    assert not mc.inside(ekf).P[15:].any()  # no clone


def test_accumulated_vision_needs_scale() -> None:
    scenario = mc.shortened(SCENARIOS["directions, on time"], 3.0)
    ekf, *_ = list(mc.replay(scenario, mc.honest(vision="accumulated"), FIRST_SEED))[-1]
    assert ekf.counters["vo_no_scale"] == 30
    assert ekf.counters["vo_accepted"] == 0
    _, vo, _ = next(
        frame
        for frame in mc.vision(scenario, mc.drive("hand", FIRST_SEED, 3.0), np.random.default_rng(0))
        if frame[1].tracking is Tracking.OK
    )
    newest = ekf.state().t_ns
    ekf.add_keyframe(0, newest)
    result = ekf.update_vo(replace(vo, t_ns=newest, keyframe_id=0))
    assert not result.accepted
    assert "metric" in result.reason


@pytest.mark.parametrize("vision", ["relative", "accumulated"])
def test_statistics_of_innovations_do_not_depend_on_the_order(vision: str) -> None:
    """Replayed or not, forgotten or not: the same sums, and as many as were accepted."""
    seen = []
    for delay_s, history_s in ((0.0, 1.0), (0.0, 60.0), (0.3, 1.0), (0.3, 60.0)):
        scenario = mc.Scenario("", delay_s=delay_s, jitter_s=delay_s, duration_s=12.0)
        ekf, way, _ = list(mc.replay(scenario, mc.honest(vision=vision, history_s=history_s), FIRST_SEED))[-1]
        rng = np.random.default_rng([FIRST_SEED, 1])
        mc.start(way, scenario.start_sigmas, rng)
        for arrives, vo, begins in sorted(mc.vision(scenario, way, rng), key=lambda frame: frame[0]):
            if arrives > way.t_ns[-1]:
                mc.deliver(ekf, vo, begins)  # what was still under way
        assert ekf.nis_statistics["vo"][0] == ekf.counters["vo_accepted"]
        assert ekf.nis_statistics["vo"][2] == 6 * ekf.counters["vo_accepted"]
        seen.append(ekf.nis_statistics)
    assert seen[0] == seen[1]
    assert seen[2] == seen[3]
    count, nis, degrees = seen[2]["vo"]
    assert count == pytest.approx(119, abs=2)
    assert nis / degrees < 1.3


@pytest.mark.data
@pytest.mark.parametrize(("name", "ate_m"), [("euroc_v101_imu", 0.03), ("euroc_v201_imu", 0.05)])
def test_real_inertial_data_with_vision_made_from_truth(data_root, name: str, ate_m: float) -> None:
    """30 s of flight with 2 mm and 0.1 deg per motion; default settings, started with 2 deg of tilt error."""
    real, rng = RealMotion.euroc(data_root / name), np.random.default_rng(3)
    start_ns = real.samples[0].t_ns + 10_000_000_000
    stamps = list(range(start_ns, start_ns + 30_000_000_000, 50_000_000))
    vision = SimulatedVision()
    motions = vision.motions([real.pose(t) for t in stamps], stamps, rng)
    T = real.pose(start_ns)
    T[:3, :3] = T[:3, :3] @ so3_exp(np.deg2rad([2.0, 0.0, 0.0]))
    sigmas = np.repeat([0.04, 0.001, 0.1, 0.1, 0.2], 3)
    ekf = Ekf(EkfConfig(), EUROC_NOISE, MACHINE)
    ekf.initialise(NavState(start_ns, T, real.velocity(start_ns), np.zeros(3), np.zeros(3), np.diag(sigmas**2)))
    i, nis, speed_chi2, seen, true = 0, [], [], [], []
    floor = NoiseFloor(replace(EUROC_NOISE, gyroscope_scale_sigma=0.003, accelerometer_scale_sigma=0.01))
    for sample in real.samples:
        ekf.predict(sample)
        if floor.add(sample):
            ekf.follow_noise(max(floor.now.t_ns, start_ns), floor.now.scale)
        while i < len(stamps) and sample.t_ns > stamps[i]:
            if i > 0:
                nis.append(ekf.update_vo(motions[i]).nis / 6)
            if i % vision.keyframe_every == 0:
                ekf.add_keyframe(i // vision.keyframe_every, stamps[i])
            state = ekf.state_at(stamps[i])
            assert state is not None
            T = real.pose(stamps[i])
            seen.append(state.T_world_body[:3, 3])
            true.append(T[:3, 3])
            if i > 40:
                R, P = state.T_world_body[:3, :3], state.covariance
                error = T[:3, :3].T @ real.velocity(stamps[i]) - R.T @ state.velocity_world_m_s
                speed_chi2.append(error @ np.linalg.solve(R.T @ P[6:9, 6:9] @ R, error) / 3)
            i += 1
    estimate, truth = np.array(seen), np.array(true)
    error = transform_points(align_points(estimate, truth), estimate) - truth
    ate = np.sqrt(np.mean(np.sum(error**2, axis=1)))
    print(f"{name}: ATE {ate:.4f} m, NIS {np.mean(nis):.2f} per degree, body velocity {np.mean(speed_chi2):.2f}")
    assert ate < ate_m
    assert 0.2 < np.mean(nis) < 1.5
    assert np.median(speed_chi2) < 3.0  # the truth's own velocity, from 10 Hz differences, is not free of error
    assert ekf.counters["vo_gated"] < 0.03 * len(stamps)
    assert ekf.counters["soft_resets"] == 0
