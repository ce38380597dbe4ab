"""The filter among broken sensors and clocks: everything wrong is refused with a reason and counted, nothing breaks."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import EkfConfig
from vislam.core.messages import Array, ImuSample, NavState, VoMeasurement
from vislam.ekf import Ekf, UpdateResult
from worlds import monte_carlo as mc
from worlds.motion import NS
from worlds.parts import MACHINE

SCENARIO = mc.Scenario("3 s", duration_s=3.0)
SEED = 77


def sample(way: mc.Drive, k: int) -> ImuSample:
    return ImuSample(int(way.t_ns[k]), way.samples[k, :3], way.samples[k, 3:])


class Bench:
    """A filter that has run for two seconds, and what comes next."""

    def __init__(self, config: EkfConfig | None = None) -> None:
        self.way = mc.drive("hand", SEED, 3.0)
        rng = np.random.default_rng(SEED)
        self.ekf = Ekf(config or mc.honest(), mc.IMU, MACHINE)
        self.ekf.initialise(mc.start(self.way, mc.START_SIGMAS, rng))
        self.frames = [(vo, begins) for _, vo, begins in mc.vision(SCENARIO, self.way, rng)]
        self.k, self.i = -1, 0
        self.go(400)

    def go(self, k: int) -> None:
        """Run to sample k."""
        while self.k < k:
            self.k += 1
            self.ekf.predict(sample(self.way, self.k))
            while self.i < len(self.frames) and self.frames[self.i][0].t_ns <= self.way.t_ns[self.k]:
                mc.deliver(self.ekf, *self.frames[self.i])
                self.i += 1

    @property
    def next(self) -> VoMeasurement:
        """The motion at the frame to come, as if it had come now."""
        return replace(self.frames[self.i][0], t_ns=int(self.way.t_ns[self.k]))

    def assert_well(self) -> None:
        """Go on to the end: the filter still tracks."""
        self.go(600)
        state = self.ekf.state()
        assert state.t_ns == self.way.t_ns[600]
        error = self.way.error(600, state)
        assert error @ np.linalg.solve(state.covariance, error) < 15 * 4
        assert is_covariance(state.covariance)


def is_covariance(P: Array) -> bool:
    return bool(np.isfinite(P).all() and (P == P.T).all() and np.linalg.eigvalsh(P)[0] > -1e-12 * np.trace(P))


def same(a: NavState, b: NavState) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("T_world_body", "velocity_world_m_s", "gyro_bias_rad_s", "accel_bias_m_s2", "covariance")
    )


def refused(bench: Bench, counter: str, result: UpdateResult | None, before: NavState, count: int = 1) -> None:
    """One refusal, with a reason where there is a result, and a state as it was."""
    assert bench.ekf.counters[counter] == count
    assert same(before, bench.ekf.state())
    if result is not None:
        assert not result.accepted
        assert result.reason


def test_motions_that_are_no_motions() -> None:
    bench = Bench()
    before, good = bench.ekf.state(), bench.next
    assert good.T_keyframe_body is not None
    mirrored = good.T_keyframe_body.copy()
    mirrored[:3, 0] *= -1.0
    indefinite = np.diag([1e-4, 1e-4, 1e-4, 1e-4, 1e-4, -1e-4])
    wrong = [
        {"T_keyframe_body": None},
        {"T_keyframe_body": np.full((4, 4), np.nan)},
        {"T_keyframe_body": np.eye(3)},
        {"T_keyframe_body": mirrored},
        {"T_keyframe_body": np.zeros((4, 4))},
        {"covariance": np.full((6, 6), np.nan)},
        {"covariance": indefinite},
        {"covariance": np.zeros((0, 0))},
    ]
    for n, change in enumerate(wrong, start=1):
        refused(bench, "vo_invalid", bench.ekf.update_vo(replace(good, **change)), before, n)
    bench.assert_well()


def test_clocks_that_leap() -> None:
    """Measurements from before the history and from beyond the samples; samples that go back."""
    bench = Bench(mc.honest(history_s=1.0))
    before, now = bench.ekf.state(), int(bench.way.t_ns[bench.k])
    refused(bench, "too_late", bench.ekf.update_vo(replace(bench.next, t_ns=now - 2 * NS)), before, 1)
    refused(bench, "too_late", bench.ekf.add_keyframe(9, 0), before, 2)
    refused(bench, "too_late", bench.ekf.update_zero_velocity(-(1 << 60)), before, 3)
    refused(bench, "too_early", bench.ekf.update_vo(replace(bench.next, t_ns=now + 3600 * NS)), before, 1)
    refused(bench, "too_early", bench.ekf.add_keyframe(9, 1 << 62), before, 2)
    bench.ekf.predict(replace(sample(bench.way, bench.k), t_ns=now - NS))
    refused(bench, "imu_late", None, before)
    assert bench.ekf.state_at(now + NS) is None
    assert bench.ekf.pose_at(now - 100 * NS) is None
    bench.assert_well()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
def test_samples_that_no_sensor_gives(value: float) -> None:
    bench = Bench()
    before, good = bench.ekf.state(), sample(bench.way, bench.k + 1)
    bench.ekf.predict(replace(good, gyro_rad_s=np.array([0.0, value, 0.0]), t_ns=good.t_ns - 1))
    bench.ekf.predict(replace(good, accel_m_s2=np.array([value, 0.0, 9.81]), t_ns=good.t_ns - 1))
    refused(bench, "imu_unusable", None, before, 2)
    bench.assert_well()


@pytest.mark.parametrize("gap_s", [0.5, 60.0, 3600.0, 3.15e7])
def test_holes_of_any_length_end(gap_s: float) -> None:
    """A stopped sensor, or a clock that leaps by a year: a state that says how little it knows, and goes on."""
    bench = Bench()
    leap = round(gap_s * NS)
    sigma = np.sqrt(np.trace(bench.ekf.state().covariance[3:6, 3:6]))
    for k in range(401, 601):
        good = sample(bench.way, k)
        bench.ekf.predict(replace(good, t_ns=good.t_ns + leap))
    assert bench.ekf.counters["imu_gaps"] == 1
    state = bench.ekf.state()
    assert np.isfinite(state.T_world_body).all()
    assert is_covariance(state.covariance)
    assert np.sqrt(np.trace(state.covariance[3:6, 3:6])) > sigma + 0.5 * gap_s**2
    begun = bench.ekf.add_keyframe(50, state.t_ns)
    assert begun.accepted, begun.reason


def test_a_start_that_is_no_state() -> None:
    bench = Bench()
    state = bench.ekf.state()
    indefinite = state.covariance.copy()
    indefinite[4, 4] = -1.0
    for wrong in (replace(state, covariance=indefinite), replace(state, velocity_world_m_s=np.full(3, np.nan))):
        with pytest.raises(ValueError, match="cannot start"):
            bench.ekf.initialise(wrong)
    assert same(state, bench.ekf.state())
    bench.assert_well()


def test_covariances_of_any_size() -> None:
    """Vision that claims to know all or nothing leaves a covariance a covariance."""
    for scale in (0.0, 1e-30, 1e-12, 1e12, 1e100):
        bench = Bench()
        good = bench.next
        for _ in range(5):
            bench.ekf.update_vo(replace(good, covariance=scale * mc.COVARIANCE))
            assert is_covariance(bench.ekf.state().covariance), scale


@pytest.mark.parametrize("odom", ["continuous", "corrected"])
def test_covariance_stays_one_for_minutes(odom: str) -> None:
    smallest, counters = mc.soak(120.0, mc.honest(odom=odom))
    assert smallest > -1e-9
    assert counters["vo_accepted"] > 0.9 * 10 * 120
    assert counters["soft_resets"] == 0
