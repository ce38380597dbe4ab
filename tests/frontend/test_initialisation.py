"""The first state: from rest, in motion with and without scale, and the refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import ImuConfig, InitConfig, MachineConfig
from vislam.core.geometry import invert, level_rotation, so3_exp, so3_log, transform
from vislam.core.messages import Array, ImuSample, NavState, Tracking, VoMeasurement
from vislam.frontend.start import Initialisation, Initialiser
from vislam.imu import ImuBuffer, ImuNoise
from worlds.motion import EUROC_NOISE, NS, T0_NS, Motion, RealMotion, SimulatedVision, state_error
from worlds.parts import GRAVITY_M_S2

QUIET = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4, 200.0)
HONEST = InitConfig()
GYRO_BIAS, ACCEL_BIAS = np.array([0.08, -0.05, 0.03]), np.array([0.1, -0.05, 0.08])


class Feed:
    """Samples and visual motions for an initialiser, frame by frame."""

    def __init__(self, samples: list[ImuSample], stamps: list[int], motions: list[VoMeasurement]) -> None:
        self.buffer = ImuBuffer(ImuConfig(), MachineConfig())
        for sample in samples:
            self.buffer.add(sample)
        self.stamps, self.motions = stamps, motions

    @staticmethod
    def moving(seed: int, duration_s: float = 3.0) -> Feed:
        motion, rng = Motion.random(seed), np.random.default_rng(seed)
        samples, _ = motion.samples(duration_s, 200.0, QUIET, rng, GYRO_BIAS, ACCEL_BIAS)
        stamps = [T0_NS + 50_000_000 * k + 1_000_000 for k in range(int(duration_s * 20) - 1)]
        return Feed(
            samples, stamps, SimulatedVision().motions([motion.pose((t - T0_NS) / NS) for t in stamps], stamps, rng)
        )

    @staticmethod
    def still(duration_s: float = 2.0, gravity: float = GRAVITY_M_S2) -> Feed:
        rng, up = np.random.default_rng(2), RESTING[2, :3]
        white = np.repeat([QUIET.gyroscope_noise_density, QUIET.accelerometer_noise_density], 3) * np.sqrt(200.0)
        level = np.concatenate([GYRO_BIAS, gravity * up])
        samples = []
        for k in range(int(duration_s * 200) + 1):
            value = level + rng.normal(size=6) * white
            samples.append(ImuSample(T0_NS + 5_000_000 * k, value[:3], value[3:]))
        stamps = [T0_NS + 50_000_000 * k + 1_000_000 for k in range(int(duration_s * 20) - 1)]
        vision = SimulatedVision(np.deg2rad(0.01), 2e-4)
        return Feed(samples, stamps, vision.motions([np.eye(4)] * len(stamps), stamps, rng))

    def run(self, initialiser: Initialiser, still: bool = False, begin: int = 0) -> tuple[Initialisation, list[str]]:
        """Return the first answer with a state, or the last one, and all reasons until then."""
        reasons: list[str] = []
        answer = Initialisation("waiting", "")
        for i in range(begin, len(self.stamps)):
            span = None if i == begin else self.buffer.span(self.stamps[i - 1], self.stamps[i])
            answer = initialiser.add(span, self.motions[i], still and i > begin)
            if answer.first is not None:
                break
            reasons.append(answer.reason)
        return answer, reasons


RESTING = transform(so3_exp(np.array([0.3, -0.4, 0.0])), np.zeros(3))


def initialiser(config: InitConfig = HONEST, noise: ImuNoise = QUIET) -> Initialiser:
    return Initialiser(config, noise, GRAVITY_M_S2, np.eye(4))


def tilt_rad(state: NavState, T_true: Array) -> float:
    return float(np.arccos(np.clip(state.T_world_body[2, :3] @ T_true[2, :3], -1.0, 1.0)))


def in_odom(motion: Motion, origin_ns: int, t_ns: int) -> tuple[Array, Array]:
    """Return the true pose and velocity in the odom frame whose origin and heading are the body's at `origin_ns`."""
    T_origin = motion.pose((origin_ns - T0_NS) / NS)
    R = level_rotation(T_origin[2, :3]) @ T_origin[:3, :3].T
    T_odom_world = transform(R, -R @ T_origin[:3, 3])
    T, v, *_ = motion.at((t_ns - T0_NS) / NS)
    return T_odom_world @ T, R @ v


def test_from_rest() -> None:
    answer, reasons = Feed.still().run(initialiser(), still=True)
    assert answer.status == "static"
    assert answer.first is not None
    assert answer.last is not None
    assert answer.T_odom_vo is not None
    assert all("needed" in reason or reason == "no frame yet" for reason in reasons)
    assert 0.75 <= (answer.last.t_ns - answer.first.t_ns) / NS < 0.85
    assert answer.first.t_ns == T0_NS + 1_000_000  # the very first frame
    assert tilt_rad(answer.last, RESTING) < np.deg2rad(0.3)  # white noise over 0.75 s alone: 0.1 deg
    np.testing.assert_allclose(answer.T_odom_vo[:3, 3], 0.0)
    assert abs(np.arctan2(answer.T_odom_vo[1, 0], answer.T_odom_vo[0, 0])) < 1e-12  # heading zero
    np.testing.assert_allclose(answer.last.gyro_bias_rad_s, GYRO_BIAS, atol=3e-3)
    np.testing.assert_array_equal(answer.last.velocity_world_m_s, 0.0)
    assert np.linalg.eigvalsh(answer.last.covariance)[0] > 0.0


def test_a_direction_without_length_is_no_motion_at_rest() -> None:
    """One camera reports which way the image moves, however little: a unit vector, which must not become a metre."""
    feed = Feed.still()
    sideways = transform(np.eye(3), np.array([0.0, 1.0, 0.0]))
    feed.motions = [replace(vo, T_keyframe_body=sideways, has_scale=False) for vo in feed.motions]
    answer, _ = feed.run(initialiser(), still=True)
    assert answer.status == "static" and answer.first is not None and answer.last is not None
    np.testing.assert_allclose(answer.first.T_world_body[:3, 3], 0.0)
    np.testing.assert_allclose(answer.last.T_world_body[:3, 3], 0.0)
    assert answer.T_odom_body is not None
    np.testing.assert_allclose(answer.T_odom_body[:, :3, 3], 0.0)


def test_rest_covariance_ties_tilt_to_the_accelerometer_bias() -> None:
    """Tilt is known to bias over gravity, 1.2 deg, but tilt and bias together far better: the mean force is exact."""
    answer, _ = Feed.still().run(initialiser(), still=True)
    assert answer.last is not None
    P, R = answer.last.covariance, answer.last.T_world_body[:3, :3]
    tilt = np.rad2deg(np.sqrt(np.linalg.eigvalsh((R @ P[:3, :3] @ R.T)[:2, :2])))
    np.testing.assert_allclose(tilt, np.rad2deg(0.2 / GRAVITY_M_S2), rtol=0.05)
    up = R[2] * GRAVITY_M_S2
    J = np.zeros((3, 15))
    J[:, :3] = np.array([[0, -up[2], up[1]], [up[2], 0, -up[0]], [-up[1], up[0], 0]])
    J[:, 12:] = np.eye(3)
    assert np.sqrt(np.linalg.eigvalsh(J @ P @ J.T)[-1]) < 0.05


def test_rest_with_the_wrong_gravity_fails_loudly() -> None:
    answer, _ = Feed.still(gravity=4.8).run(initialiser(), still=True)
    assert answer.status == "failed"
    assert answer.first is None
    assert float(answer.reason.split()[2]) == pytest.approx(4.8, abs=0.05), answer.reason
    assert "expected 9.81" in answer.reason


def test_uniform_motion_is_not_rest() -> None:
    """The IMU is still but the image moves: the answer may come from motion, never from rest."""
    answer, _ = Feed.still().run(initialiser(), still=False)
    assert answer.status == "moving"


def chi2_of(answer: Initialisation, motion: Motion, which: str) -> float:
    state = getattr(answer, which)
    T, v = in_odom(motion, T0_NS + 1_000_000, state.t_ns)
    error = state_error((T, v, np.concatenate([GYRO_BIAS, ACCEL_BIAS])), state)
    # Heading and position are chosen at the first frame; their tiny sigmas there are not under test.
    P = state.covariance + np.diag(np.repeat([0.0, 1e-6, 0.0, 0.0, 0.0], 3)) + 1e-6 * np.eye(15)
    return float(error @ np.linalg.solve(P, error))


def test_in_motion_with_scale() -> None:
    """Twenty windows: gravity, velocity and gyro bias to what the accelerometer bias allows, honestly."""
    tilt, speed, gyro, nees = [], [], [], []
    for seed in range(20):
        answer, _ = Feed.moving(seed).run(initialiser())
        assert answer.status == "moving", answer.reason
        assert answer.last is not None
        motion = Motion.random(seed)
        T, v = in_odom(motion, T0_NS + 1_000_000, answer.last.t_ns)
        tilt.append(np.rad2deg(tilt_rad(answer.last, T)))
        speed.append(np.linalg.norm(answer.last.velocity_world_m_s - v))
        gyro.append(np.linalg.norm(answer.last.gyro_bias_rad_s - GYRO_BIAS))
        nees.append([chi2_of(answer, motion, "first"), chi2_of(answer, motion, "last")])
    rms = [float(np.sqrt(np.mean(np.square(values)))) for values in (tilt, speed, gyro)]
    print(f"tilt {rms[0]:.2f} deg, velocity {rms[1]:.3f} m/s, gyro bias {rms[2]:.4f} rad/s, NEES {np.mean(nees, 0)}")
    assert rms[0] < 1.0
    assert rms[1] < 0.03
    assert rms[2] < 8e-3
    assert np.mean(nees, axis=0).max() < 20.0  # of 15, at most a little overconfident; inflation makes it smaller


def test_answer_fits_the_visual_chain() -> None:
    feed = Feed.moving(3)
    answer, _ = feed.run(initialiser())
    assert answer.last is not None
    assert answer.T_odom_vo is not None
    assert answer.T_odom_body is not None
    assert answer.t_ns[-1] == answer.last.t_ns
    T_vo_keyframe, T_vo_body, keyframe = np.eye(4), np.eye(4), 0
    for vo in feed.motions[: feed.stamps.index(answer.last.t_ns) + 1]:
        assert vo.T_keyframe_body is not None
        if vo.keyframe_id != keyframe:
            T_vo_keyframe, keyframe = T_vo_body, vo.keyframe_id
        T_vo_body = T_vo_keyframe @ vo.T_keyframe_body
    chained = answer.T_odom_vo @ T_vo_body
    assert np.linalg.norm(chained[:3, 3] - answer.last.T_world_body[:3, 3]) < 0.02
    assert np.linalg.norm(so3_log(chained[:3, :3].T @ answer.last.T_world_body[:3, :3])) < np.deg2rad(1.0)
    np.testing.assert_array_equal(answer.T_odom_body[-1], answer.last.T_world_body)


def test_wrong_unit_of_the_accelerometer_fails() -> None:
    feed, wrong = Feed.moving(4), ImuBuffer(ImuConfig(), MachineConfig())
    for sample in Motion.random(4).samples(3.0, 200.0)[0]:
        wrong.add(ImuSample(sample.t_ns, sample.gyro_rad_s, sample.accel_m_s2 / GRAVITY_M_S2))  # in g
    feed.buffer = wrong
    answer, reasons = feed.run(initialiser())
    assert answer.first is None
    assert "gravity norm" in reasons[-1]
    assert "expected 9.81" in reasons[-1]


def test_wrong_extrinsics_are_not_believed() -> None:
    """Camera and IMU axes swapped: rotations disagree with the gyro, so no answer comes out."""
    feed = Feed.moving(5)
    swap = transform(so3_exp(np.array([0.0, 0.0, 0.5 * np.pi])), np.zeros(3))
    feed.motions = [
        replace(vo, T_keyframe_body=swap @ vo.T_keyframe_body @ invert(swap))
        for vo in feed.motions
        if vo.T_keyframe_body is not None
    ]
    answer, reasons = feed.run(initialiser())
    assert answer.first is None
    assert any("disagree" in reason or "gravity norm" in reason for reason in reasons)


def test_losing_vision_starts_the_window_again() -> None:
    feed = Feed.moving(6, 4.0)
    feed.motions[15] = replace(feed.motions[15], T_keyframe_body=None, tracking=Tracking.LOST)
    answer, reasons = feed.run(initialiser())
    assert "vision is lost" in reasons
    assert answer.status == "moving"
    assert answer.first is not None
    assert answer.last is not None
    assert answer.first.t_ns > feed.stamps[15]
    assert answer.last.t_ns - feed.stamps[16] >= 0.99 * NS
    T, _ = in_odom(Motion.random(6), T0_NS + 1_000_000, answer.last.t_ns)
    assert tilt_rad(answer.last, T) < np.deg2rad(1.5)


def test_a_hole_in_the_imu_starts_the_window_again() -> None:
    feed = Feed.moving(7, 4.0)
    start = initialiser()
    for i in range(15):
        start.add(None if i == 0 else feed.buffer.span(feed.stamps[i - 1], feed.stamps[i]), feed.motions[i], False)
    start.add(None, feed.motions[15], False)
    answer, _ = feed.run(start, begin=16)
    assert answer.status == "moving"
    assert answer.first is not None
    assert answer.first.t_ns >= feed.stamps[15]


def test_same_input_same_answer() -> None:
    a, _ = Feed.moving(8).run(initialiser())
    b, _ = Feed.moving(8).run(initialiser())
    assert a.last is not None
    assert b.last is not None
    np.testing.assert_array_equal(a.last.covariance, b.last.covariance)
    np.testing.assert_array_equal(a.last.T_world_body, b.last.T_world_body)


@pytest.mark.data
@pytest.mark.parametrize("name", ["euroc_mh01_17s", "euroc_v101_imu", "euroc_v201_imu"])
def test_real_inertial_data_in_flight(data_root, name: str) -> None:
    """Windows all over the flight, vision made from truth (2 mm, 0.1 deg): all are answered, none is far off."""
    real, rng = RealMotion.euroc(data_root / name), np.random.default_rng(7)
    begin = max(real.samples[0].t_ns, int(real.truth_t_ns[0])) + NS // 10
    end = min(real.samples[-1].t_ns, int(real.truth_t_ns[-1])) - 3 * NS
    tilt, speed, gyro = [], [], []
    for start_ns in np.linspace(begin, end, 8).astype(np.int64).tolist():
        stamps = list(range(start_ns, start_ns + 2_500_000_000, 50_000_000))
        near = [s for s in real.samples if start_ns - NS < s.t_ns < stamps[-1] + NS]
        motions = SimulatedVision().motions([real.pose(t) for t in stamps], stamps, rng)
        answer, _ = Feed(near, stamps, motions).run(initialiser(InitConfig(), noise=EUROC_NOISE))
        assert answer.last is not None, answer.reason
        T = real.pose(answer.last.t_ns)
        tilt.append(np.rad2deg(tilt_rad(answer.last, T)))
        seen = answer.last.T_world_body[:3, :3].T @ answer.last.velocity_world_m_s
        speed.append(np.linalg.norm(seen - T[:3, :3].T @ real.velocity(answer.last.t_ns)))
        gyro.append(answer.last.gyro_bias_rad_s)
    print(f"{name}: tilt {np.max(tilt):.2f} deg, velocity {np.max(speed):.3f} m/s, gyro bias {np.median(gyro, axis=0)}")
    assert np.max(tilt) < 2.0  # real accelerometer bias is 0.14 m/s^2: 0.8 deg
    assert np.max(speed) < 0.06
    assert np.linalg.norm(np.std(gyro, axis=0)) < 8e-3
    np.testing.assert_allclose(np.median(gyro, axis=0), [-0.0022, 0.0225, 0.079], atol=6e-3)
