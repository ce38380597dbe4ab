"""The tight filter as a whole: accuracy, calibration, replay, faults, rest, and a real recording."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import EkfConfig, load
from vislam.core.camera import Rig
from vislam.core.clock import StageClock
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Frame, ImuSample, NavState, Observations
from vislam.datasets import open_dataset
from vislam.ekf import Ekf, MsckfEkf, make_ekf
from vislam.pipeline.front import Front, odometry
from vislam.sim.points.points import open_points
from vislam.trajectory import Trajectory, align, associate, ate
from worlds.flight import CHEAP, MONO, RGBD, SIGMAS, STEREO, Flight, motion_of
from worlds.motion import EUROC_NOISE, NS, T0_NS
from worlds.parts import GRAVITY_M_S2, MACHINE, with_slips

NOTHING = Observations(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))


def end_error_m(flight: Flight, ekf: MsckfEkf, **fly: object) -> float:
    errors = [np.linalg.norm(error[3:6]) for k, error, _ in flight.fly(ekf, **fly) if k > 600]  # type: ignore[arg-type]
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize("rig", [MONO, STEREO, RGBD], ids=["mono", "stereo", "rgbd"])
def test_follows_a_flight_with_outliers(rig: Rig) -> None:
    """10 s, 1 px of noise, every twentieth pixel up to 40 px off; seed 2."""
    flight = Flight.make(2, 10.0, rig, outliers=0.05)
    ekf = flight.filter()
    error_m = end_error_m(flight, ekf)
    statistics = ekf.nis_statistics
    print(f"position error {error_m:.4f} m, {statistics}")
    assert error_m < 0.06
    for kind in ("tracks", "points"):
        number, nis, dof = statistics[kind]
        assert number > 500
        assert 0.85 < nis / dof < 1.15
    assert ekf.counters["soft_resets"] == 0
    assert ekf.dead_reckoning_s < 0.2
    assert np.linalg.eigvalsh(ekf.state().covariance)[0] > 0.0


def test_slips_that_the_stated_noise_would_cover_are_left_out() -> None:
    """A pixel is stated, a fifth of one is true, and a fifth of the corners slip by as much per frame; seeds 1, 3."""
    errors_m = []
    for share in (0.0, 0.2):
        for seed in (1, 3):
            flight = Flight.make(seed, 10.0, sigma_px=0.2, tracks=60)
            t_ns, seen = zip(*flight.frames, strict=True)
            slipped = with_slips(seen, share, 0.2, np.random.default_rng(seed))
            errors_m.append(end_error_m(replace(flight, frames=list(zip(t_ns, slipped, strict=True))), flight.filter()))
    print(f"position errors {np.round(errors_m, 4)} m")
    assert sum(errors_m[2:]) < 2.0 * sum(errors_m[:2])


def test_rolling_shutter_is_accounted_for() -> None:
    """30 ms of readout; taken for a global shutter, the same images mislead. Seed 0."""
    flight = Flight.make(0, 8.0, readout_s=0.03, tracks=100)
    known = end_error_m(flight, flight.filter(tight_readout_s=0.03))
    ignored = end_error_m(flight, flight.filter())
    frames = [(t_ns, replace(seen, readout_s=0.03)) for t_ns, seen in flight.frames]
    learned = end_error_m(replace(flight, frames=frames), flight.filter())
    print(f"known {known:.4f} m, ignored {ignored:.4f} m")
    assert learned == known < 0.05
    assert ignored > 1.5 * known


@pytest.mark.parametrize("offset_s", [-0.03, 0.03])
def test_time_offset_is_found(offset_s: float) -> None:
    flight = Flight.make(1, 12.0, offset_s=offset_s)
    ekf = flight.filter(tight_time_offset_sigma_s=0.02)
    for _ in flight.fly(ekf):
        pass
    found = ekf.calibration
    print(f"time offset {1e3 * found.time_offset_s:.2f} of {1e3 * offset_s:.0f} ms")
    assert abs(found.time_offset_s - offset_s) < 0.002
    assert found.time_offset_sigma_s < 0.001


def test_extrinsic_rotation_is_found() -> None:
    """The filter is told a camera turned by 1 deg; seed 3."""
    flight = Flight.make(3, 15.0)
    wrong = np.deg2rad([0.6, -0.6, 0.53])
    T = MONO.T_body_cams[0]
    rig = replace(MONO, T_body_cams=(transform(T[:3, :3] @ so3_exp(wrong), T[:3, 3]),))
    ekf = flight.filter(rig=rig, tight_extrinsic_sigma_deg=1.0)
    for _ in flight.fly(ekf):
        pass
    left_deg = np.rad2deg(np.linalg.norm(ekf.calibration.rotation_rad + wrong))
    print(f"1 deg of rotation, {left_deg:.3f} deg left, sigmas {np.rad2deg(ekf.calibration.rotation_sigma_rad)} deg")
    assert left_deg < 0.2


def test_calibration_can_be_switched_off() -> None:
    flight = Flight.make(1, 4.0)
    ekf = flight.filter(tight_time_offset_sigma_s=0.0, tight_extrinsic_sigma_deg=0.0)
    for _ in flight.fly(ekf):
        pass
    found = ekf.calibration
    assert found.time_offset_s == 0.0 and found.time_offset_sigma_s == 0.0
    assert not found.rotation_rad.any() and not found.rotation_sigma_rad.any()


def test_any_order_of_arrival_gives_the_same_answer() -> None:
    """In time, late by 100 ms, or shuffled within 0.4 s: bit for bit the same state."""
    flight = Flight.make(4, 3.0)
    rng = np.random.default_rng(5)
    shuffled = np.concatenate(
        [i + rng.permutation(min(8, len(flight.frames) - i)) for i in range(0, len(flight.frames), 8)]
    )
    states = []
    for delay_s, order in ((0.0, None), (0.1, None), (0.0, shuffled), (0.1, shuffled)):
        ekf = flight.filter()
        for _ in flight.fly(ekf, delay_s, order=order):
            pass
        states.append((ekf.state(), ekf.counters, ekf.nis_statistics))
    first, counters, statistics = states[0]
    for state, counts, tests in states[1:]:
        np.testing.assert_array_equal(state.T_world_body, first.T_world_body)
        np.testing.assert_array_equal(state.covariance, first.covariance)
        for name in ("tracks_used", "points_used", "vision_used"):
            assert counts[name] == counters[name]
        assert tests.keys() == statistics.keys()
        np.testing.assert_allclose([tests[k] for k in tests], [statistics[k] for k in tests], rtol=1e-9)


def test_a_start_in_the_past_catches_up() -> None:
    flight = Flight.make(4, 2.0)
    usual, late = (
        flight.filter(),
        MsckfEkf(EkfConfig(tight_point_inflation=1.0), CHEAP, MACHINE, MONO),
    )
    for sample in flight.samples:
        late.predict(sample)
        usual.predict(sample)
    assert not late.initialised and late.pose_at(T0_NS) is None
    assert late.update_vision(motion_of(T0_NS), flight.frames[0][1]).reason.startswith("the filter has no state")
    late.initialise(flight.start)
    np.testing.assert_allclose(late.state().T_world_body, usual.state().T_world_body, atol=1e-12)
    np.testing.assert_allclose(late.state().covariance, usual.state().covariance, rtol=1e-9, atol=1e-15)
    t_ns = flight.samples[-20].t_ns + 1_000_000
    at, pose = late.state_at(t_ns), late.pose_at(t_ns)
    assert at is not None and pose is not None
    np.testing.assert_allclose(at.T_world_body, pose, atol=2e-4)


def test_bad_input_is_counted_and_changes_nothing() -> None:
    flight = Flight.make(6, 2.0)
    ekf = flight.filter()
    for _ in flight.fly(ekf):
        pass
    before, now = ekf.state(), flight.samples[-1].t_ns
    ekf.predict(ImuSample(now + 5_000_000, np.full(3, np.nan), np.zeros(3)))
    ekf.predict(ImuSample(now - 5_000_000, np.zeros(3), np.zeros(3)))
    ekf.predict(ImuSample(now + 5_000_000, np.zeros(3), np.array([0.0, 1e200, 0.0])))
    nan = Observations(np.arange(3), np.full((3, 2), np.nan))
    assert not ekf.update_vision(motion_of(now), nan).accepted
    assert not ekf.update_vision(motion_of(now), NOTHING).accepted
    assert not ekf.update_vision(motion_of(now, lost=True), flight.frames[-1][1]).accepted
    assert not ekf.update_vision(motion_of(flight.frames[-1][0]), flight.frames[-1][1]).accepted
    assert not ekf.update_vision(motion_of(now - 10 * NS), flight.frames[-1][1]).accepted
    assert not ekf.feed_back(np.full(3, np.nan), np.zeros(3), 1.0, 1.0).accepted
    after, counters = ekf.state(), ekf.counters
    np.testing.assert_array_equal(after.T_world_body, before.T_world_body)
    assert [counters[name] for name in ("imu_unusable", "imu_late")] == [2, 1]
    names = ("vision_invalid", "vision_lost", "vision_duplicate", "too_late", "bias_invalid")
    assert [counters[name] for name in names] == [2, 1, 1, 1, 1]
    with pytest.raises(ValueError, match="not finite"):
        ekf.initialise(replace(flight.start, velocity_world_m_s=np.full(3, np.nan)))


@pytest.mark.parametrize("gap_s", [0.5, 3600.0, 3.15e7])
def test_holes_of_any_length_end(gap_s: float) -> None:
    """A stopped sensor, or a clock that leaps by a year: a state that says how little it knows. Seed 6."""
    flight = Flight.make(6, 2.0)
    ekf = flight.filter()
    for _ in flight.fly(ekf):
        pass
    before, last = ekf.state(), flight.samples[-1]
    for k in range(1, 101):
        ekf.predict(replace(last, t_ns=last.t_ns + round(gap_s * NS) + k * 5_000_000))
    state = ekf.state()
    assert ekf.counters["imu_gaps"] == 1
    assert np.isfinite(state.T_world_body).all()
    assert np.isfinite(state.covariance).all()
    sigmas_m = [np.sqrt(np.trace(s.covariance[3:6, 3:6])) for s in (before, state)]
    assert sigmas_m[1] > sigmas_m[0] + 0.5 * gap_s**2


def test_a_wild_frame_and_swapped_tracks_do_no_harm() -> None:
    """One frame is random, and for a second every id belongs to another corner; seed 7."""
    flight = Flight.make(7, 9.0)
    rng = np.random.default_rng(8)
    for i in (80, *range(100, 120)):
        t_ns, seen = flight.frames[i]
        wrong = rng.uniform(0.0, 450.0, seen.pixels_px.shape) if i == 80 else rng.permutation(seen.pixels_px)
        flight.frames[i] = (t_ns, replace(seen, pixels_px=wrong))
    ekf = flight.filter()
    error_m = end_error_m(flight, ekf)
    print(f"position error {error_m:.3f} m, {ekf.counters}")
    assert error_m < 0.15
    assert ekf.counters["tracks_gated"] + ekf.counters["tracks_few"] > 50


def test_an_outage_is_bridged() -> None:
    """No vision for 5 s: uncertainty grows, the error stays within it, and afterwards vision goes on. Seed 9."""
    flight = Flight.make(9, 14.0)
    flight.frames = [f for f in flight.frames if not 6.0 < (f[0] - T0_NS) * 1e-9 < 11.0]
    ekf = flight.filter()
    for k, error, state in flight.fly(ekf):
        if k == 2180:
            assert ekf.dead_reckoning_s > 4.5
            assert np.sqrt(np.diag(state.covariance)[3:6]).max() > 0.1
        if k > 1200:
            assert error[3:6] @ np.linalg.solve(state.covariance[3:6, 3:6], error[3:6]) < 30.0
    assert ekf.dead_reckoning_s < 0.2


def test_known_biases_move_only_the_biases() -> None:
    flight = Flight.make(4, 2.0)
    ekf = flight.filter()
    for _ in flight.fly(ekf):
        pass
    before = ekf.state()
    assert ekf.feed_back(flight.biases[-1][:3], flight.biases[-1][3:], 0.002, 0.01).accepted
    after = ekf.state()
    np.testing.assert_allclose(after.T_world_body, before.T_world_body, atol=1e-14)
    assert np.linalg.norm(after.gyro_bias_rad_s - flight.biases[-1][:3]) < 0.003
    assert np.linalg.eigvalsh(after.covariance)[0] > 0.0


@pytest.mark.slow
def test_standing_still_does_not_drift() -> None:
    """30 s at rest from the first moment, with unknown biases; noise of 0.3 px and of a cheap IMU go on. Seed 11."""
    flight = Flight.make(10, 4.0)
    ekf = flight.filter()
    rng = np.random.default_rng(11)
    T, *_ = flight.motion.at(4.0)
    bias, begin = flight.biases[-1], flight.samples[-1].t_ns
    ekf.initialise(NavState(begin, T, np.zeros(3), np.zeros(3), np.zeros(3), np.diag(SIGMAS**2)))
    landmarks_px = rng.uniform([10, 10], [740, 470], (150, 2))
    force = T[:3, :3].T @ np.array([0.0, 0.0, GRAVITY_M_S2])
    white = np.repeat([CHEAP.gyroscope_noise_density, CHEAP.accelerometer_noise_density], 3) * np.sqrt(CHEAP.rate_hz)
    first = None
    for k in range(1, 6001):
        values = np.concatenate((np.zeros(3), force)) + bias + rng.normal(size=6) * white
        t_ns = begin + 5_000_000 * k
        ekf.predict(ImuSample(t_ns, values[:3], values[3:]))
        if k % 10 == 0:
            stamp = t_ns - 1_000_000
            seen = Observations(np.arange(150), landmarks_px + rng.normal(size=(150, 2)) * 0.3)
            ekf.update_vision(motion_of(stamp), seen)
            ekf.update_zero_velocity(stamp)
        if k == 400:
            first = ekf.state()
    assert first is not None
    last = ekf.state()
    moved_m = np.linalg.norm(last.T_world_body[:3, 3] - first.T_world_body[:3, 3])
    print(f"moved {1e3 * moved_m:.2f} mm")
    assert moved_m < 0.005
    turned = first.T_world_body[:3, :3].T @ last.T_world_body[:3, :3]
    assert np.arccos(min((np.trace(turned) - 1.0) / 2.0, 1.0)) < np.deg2rad(0.2)
    assert np.linalg.norm(last.velocity_world_m_s) < 0.02
    assert ekf.counters["hold_accepted"] > 500


def test_motion_after_rest_is_followed() -> None:
    """2.8 s of known rest, then laps at walking speed with nobody saying more; 1 px of noise, 5 % outliers. Seed 4."""
    recording = open_points("laps", seed=4, rig="mono", duration_s=10.0)
    noise = recording.imu_noise
    assert noise is not None
    ekf = MsckfEkf(EkfConfig(coupling="tight"), noise, MACHINE, recording.rig)
    truth = recording.motion.at(np.arange(0.0, 10.0, 0.01))
    errors_m = []
    for value in recording.events():
        seconds = (value.t_ns - recording.zero_ns) / NS
        if isinstance(value, ImuSample):
            ekf.predict(value)
            continue
        if not ekf.initialised:
            start = truth.T_world_body[round(seconds * 100.0)]
            ekf.initialise(NavState(value.t_ns, start, *np.zeros((3, 3)), np.diag(SIGMAS**2)))
        assert isinstance(value, Frame) and value.tracks is not None
        ekf.update_vision(motion_of(value.t_ns), value.tracks)
        if seconds < 2.8:
            ekf.update_zero_velocity(value.t_ns)
        true_p = truth.T_world_body[min(round(seconds * 100.0), 999), :3, 3]
        errors_m.append(float(np.linalg.norm(ekf.state().T_world_body[:3, 3] - true_p)))
    print(f"largest position error {max(errors_m):.3f} m, {ekf.counters['tracks_used']} tracks used")
    assert ekf.counters["hold_accepted"] > 40
    assert ekf.counters["tracks_used"] > 500
    assert max(errors_m) < 0.25


def test_the_configuration_chooses_the_filter() -> None:
    loose = make_ekf(EkfConfig(), EUROC_NOISE, MACHINE, MONO)
    tight = make_ekf(EkfConfig(coupling="tight"), EUROC_NOISE, MACHINE, STEREO)
    assert isinstance(loose, Ekf) and isinstance(tight, MsckfEkf)


def test_one_camera_goes_on_while_no_inertial_sample_comes() -> None:
    """A second without samples: frames wait for them as long as they may, then the pose follows the image alone."""
    world = open_points("laps", 3, rig="mono", duration_s=10.0)
    config = load(None, {"map.enabled": False})
    front = Front(config, world.rig, world.imu_noise, StageClock())
    begin_ns = next(value.t_ns for value in world.events() if isinstance(value, Frame)) + 7 * NS
    heard = (v for v in world.events() if isinstance(v, Frame) or not begin_ns < v.t_ns < begin_ns + NS)
    truth, published_m, true_m = world.truth(), [], []
    for step in odometry(front, heard):
        if step.estimate is not None and step.frame.t_ns >= begin_ns - NS:
            published_m.append(step.estimate.T_odom_body[:3, 3])
            true_m.append(truth.at(step.frame.t_ns)[:3, 3])
    steps_m = np.abs(np.subtract(*(np.linalg.norm(np.diff(p, axis=0), axis=1) for p in (published_m, true_m))))
    print(f"seed 3, largest error of a step {max(steps_m):.3f} m")
    assert len(steps_m) > 55
    assert max(steps_m) < 0.04  # where samples come again, all tracks correct what is off by then in one step


@pytest.mark.data
def test_real_recording_with_one_camera(data_root) -> None:  # type: ignore[no-untyped-def]
    """8 s of EuRoC MH_01 after its start from rest or motion, one camera: causal poses against motion capture."""
    config = load(None, {"ekf.coupling": "tight", "frontend.mode": "mono"})
    recording = open_dataset(str(data_root / "euroc_mh01_17s"))
    recording.cameras_read = 1
    front = Front(config, recording.rig, recording.imu_noise, StageClock())
    stamps, poses = [], []
    for step in odometry(front, recording.events()):
        if step.T_odom_body is not None:
            stamps.append(step.frame.t_ns)
            poses.append(step.T_odom_body)
        if len(stamps) >= 160:
            break
    assert len(stamps) >= 160, front.begun.refusal
    truth = recording.truth()
    assert truth is not None
    pairs = associate(Trajectory(np.array(stamps), np.array(poses)), truth)
    error = ate(pairs.aligned(align(pairs, "yaw")))
    print(f"causal ATE {error['rmse_m']:.4f} m over {len(stamps)} frames")
    assert error["rmse_m"] < 0.05
