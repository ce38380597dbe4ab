"""Truth against the IMU: what the body of a true trajectory is turned, displaced and late is found, and no more."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from tests.needs import missing
from vislam.core import Array, DataError, NavState, transform
from vislam.runs.sources import measured_inertial
from vislam.sim.motion.path import wander
from vislam.sim.motion.spline import BodySpline
from vislam.trajectory import Trajectory, anees
from vislam.trajectory.truth_fit import TruthFit, fit_truth
from worlds.recordings import real

TURN_RAD = np.deg2rad([0.2, -0.1, 0.2])  # 0.3 deg
LEVER_M = np.array([0.006, -0.004, 0.007])  # 1 cm
LATE_S = 0.005
GYRO_NOISE, ACCEL_NOISE, IMU_HZ = 1.7e-4, 2e-3, 200.0  # of a good MEMS IMU


def recorded(
    seed: int,
    turn_rad: Array = TURN_RAD,
    lever_m: Array = LEVER_M,
    late_s: float = LATE_S,
    truth_hz: float = 100.0,
    duration_s: float = 60.0,
    brisk: float = 1.0,
    noise: tuple[float, float] = (2e-4, 1e-3),
) -> tuple[np.ndarray, Array, Array, Trajectory]:
    """Return stamps, gyro, accel and truth of a flight; the truth is motion capture of another body frame.

    Its `noise` is of positions in m and of attitudes in rad, white, 1 sigma per axis.
    """
    rng = np.random.default_rng(seed)

    def design(t: Array) -> tuple[Array, Array]:
        sway = wander(t, rng, 1.0, (0.1, 0.8), 6) * brisk
        return sway[:, :3] * [1.0, 1.0, 0.4], sway[:, 3:] * [0.25, 0.25, 0.8]

    motion = BodySpline.from_design(design, duration_s, 0.05)
    imu_s = np.arange(0.0, duration_s, 1.0 / IMU_HZ)
    moved = motion.at(imu_s)
    force = moved.acceleration_world_m_s2 + np.array([0.0, 0.0, 9.81])
    white = rng.normal(0.0, 1.0, (len(imu_s), 6)) * np.sqrt(IMU_HZ)
    gyro = moved.rate_body_rad_s + white[:, :3] * GYRO_NOISE + [0.02, -0.01, 0.03]
    accel = (
        np.einsum("nji,nj->ni", moved.T_world_body[:, :3, :3], force) + white[:, 3:] * ACCEL_NOISE + [0.1, 0.0, -0.1]
    )
    true_s = np.arange(0.5, duration_s - 0.5, 1.0 / truth_hz)
    T_imu_truth = np.linalg.inv(transform(Rotation.from_rotvec(turn_rad).as_matrix(), lever_m))
    T = motion.at(true_s).T_world_body @ T_imu_truth
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0.0, noise[1], (len(T), 3))).as_matrix()
    T[:, :3, 3] += rng.normal(0.0, noise[0], (len(T), 3))
    stamps = (np.round(imu_s * 1e9) + 5e9).astype(np.int64)
    return stamps, gyro, accel, Trajectory((np.round((true_s - late_s) * 1e9) + 5e9).astype(np.int64), T)


def nees(fit: TruthFit, turn_rad: Array = TURN_RAD, lever_m: Array = LEVER_M, late_s: float = LATE_S) -> list[float]:
    """Return the squared errors in sigmas: of turn and lever (3 degrees of freedom each) and of time (1)."""
    turn, lever = fit.turn_rad - turn_rad, fit.lever_m - lever_m
    return [
        float(turn @ np.linalg.solve(fit.turn_covariance, turn)),
        float(lever @ np.linalg.solve(fit.lever_covariance, lever)),
        ((fit.time_offset_s - late_s) / fit.time_offset_sigma_s) ** 2,
    ]


@pytest.mark.parametrize(("seed", "truth_hz"), [(0, 100.0), (1, 20.0), (2, 200.0)])
def test_a_turn_a_lever_and_a_clock_are_found_within_their_sigmas(seed: int, truth_hz: float) -> None:
    fit = fit_truth(*recorded(seed, truth_hz=truth_hz))
    print(np.rad2deg(fit.turn_rad), fit.lever_m * 1e3, fit.time_offset_s * 1e3, nees(fit), fit.summary)
    assert fit.is_turned and fit.is_displaced and fit.is_late
    assert max(nees(fit)[:2]) < 21.1 and nees(fit)[2] < 10.8  # 99.99 and 99.9 %
    assert np.linalg.norm(fit.turn_rad - TURN_RAD) < np.deg2rad(0.03)
    assert np.linalg.norm(fit.lever_m - LEVER_M) < 0.002
    assert abs(fit.time_offset_s - LATE_S) < 2e-4


@given(
    st.integers(0, 1000),
    st.tuples(*[st.floats(-0.03, 0.03)] * 3),
    st.tuples(*[st.floats(-0.04, 0.04)] * 3),
    st.floats(-0.02, 0.02),
)
@settings(max_examples=8)
def test_any_mount_is_found(seed: int, turn: tuple[float, ...], lever: tuple[float, ...], late_s: float) -> None:
    fit = fit_truth(*recorded(seed, np.array(turn), np.array(lever), late_s, duration_s=40.0))
    assert np.linalg.norm(fit.turn_rad - turn) < np.deg2rad(0.2)
    assert np.linalg.norm(fit.lever_m - lever) < 0.004
    assert abs(fit.time_offset_s - late_s) < 5e-4


def test_a_truth_that_fits_is_left_as_it_is() -> None:
    changed = []
    for seed in range(8):
        fit = fit_truth(*recorded(seed, np.zeros(3), np.zeros(3), 0.0, duration_s=40.0))
        changed.append((fit.is_turned, fit.is_displaced, fit.is_late))
        if not fit.summary:
            truth = recorded(seed, np.zeros(3), np.zeros(3), 0.0, duration_s=40.0)[3]
            assert np.array_equal(fit.of_imu(truth).T_world_body, truth.T_world_body)
            assert np.array_equal(fit.of_imu(truth).t_ns, truth.t_ns)
    print(changed)
    assert np.sum(changed) <= 1  # of 24


def test_what_is_found_is_undone() -> None:
    stamps, gyro, accel, truth = recorded(3)
    fit = fit_truth(stamps, gyro, accel, truth)
    again = fit_truth(stamps, gyro, accel, fit.of_imu(truth))
    print(fit.summary, "then", again.summary)
    assert "turned by 0.3" in fit.summary and "mm" in fit.summary and "+5.0" in fit.summary
    assert again.summary == ""


def test_gaps_in_truth_and_in_samples_do_no_harm() -> None:
    stamps, gyro, accel, truth = recorded(4, truth_hz=200.0)
    since_s = (truth.t_ns - truth.t_ns[0]) * 1e-9
    kept = (since_s % 13.0 > 0.6) & ((since_s < 30.0) | (since_s > 33.0))
    imu_kept = np.abs((stamps - stamps[0]) * 1e-9 - 20.0) > 0.05
    holed = Trajectory(truth.t_ns[kept], truth.T_world_body[kept])
    fit = fit_truth(stamps[imu_kept], gyro[imu_kept], accel[imu_kept], holed)
    print(fit.summary)
    assert np.linalg.norm(fit.turn_rad - TURN_RAD) < np.deg2rad(0.05)
    assert np.linalg.norm(fit.lever_m - LEVER_M) < 0.003
    assert abs(fit.time_offset_s - LATE_S) < 4e-4


def test_a_body_that_does_not_move_tells_nothing_and_nothing_is_claimed() -> None:
    stamps, gyro, accel, truth = recorded(5, brisk=0.0)
    fit = fit_truth(stamps, gyro, accel, truth)
    assert fit.summary == ""
    assert np.sqrt(np.linalg.eigvalsh(fit.lever_covariance)[-1]) > 0.02 and fit.time_offset_sigma_s > 0.005
    short = Trajectory(truth.t_ns[:30], truth.T_world_body[:30])
    for nothing in (short, Trajectory(truth.t_ns[:0], truth.T_world_body[:0])):
        fit = fit_truth(stamps, gyro, accel, nothing)
        assert fit.summary == "" and np.array_equal(fit.of_imu(nothing).t_ns, nothing.t_ns)
    assert fit_truth(stamps[:0], gyro[:0], accel[:0], truth).summary == ""


def test_the_same_data_give_the_same_fit() -> None:
    one, other = fit_truth(*recorded(6)), fit_truth(*recorded(6))
    assert one.turn_rad.tobytes() == other.turn_rad.tobytes() and one.lever_m.tobytes() == other.lever_m.tobytes()
    assert one.noise_m == other.noise_m and one.noise_rad == other.noise_rad


@pytest.mark.parametrize(
    ("truth_hz", "late_s"), [(20.0, 0.0), (20.0, 0.006), (50.0, 0.006), (200.0, 0.0), (200.0, 0.006)]
)
@pytest.mark.parametrize(("noise_mm", "noise_deg"), [(0.2, 0.3), (1.0, 0.05), (5.0, 0.3)])
def test_the_noise_of_a_truth_is_found(truth_hz: float, late_s: float, noise_mm: float, noise_deg: float) -> None:
    noise = (1e-3 * noise_mm, np.deg2rad(noise_deg))
    fit = fit_truth(*recorded(7, late_s=late_s, truth_hz=truth_hz, duration_s=40.0, noise=noise))
    print(fit.noise)
    assert fit.noise_m == pytest.approx(noise[0], rel=0.2) and fit.noise_rad == pytest.approx(noise[1], rel=0.2)
    assert fit.jump_m == 0.0


def test_noise_below_that_of_the_imu_is_told_to_be_below() -> None:
    fit = fit_truth(*recorded(8, duration_s=40.0, noise=(0.0, 0.0)))
    print(fit.noise)
    assert fit.noise_m < fit.unseen_m < 5e-5 and fit.noise_rad < fit.unseen_rad < np.deg2rad(0.01)
    assert fit.noise.count("below") == 2


def test_a_truth_that_jumps_is_told_and_is_not_called_noisy() -> None:
    stamps, gyro, accel, truth = recorded(9, truth_hz=200.0, duration_s=40.0)
    truth.T_world_body[len(truth) // 2 :, :3, 3] += [0.004, -0.004, 0.002]  # 6 mm
    fit = fit_truth(stamps, gyro, accel, truth)
    print(fit.noise)
    assert fit.jump_m == pytest.approx(0.006, rel=0.3) and fit.noise_m == pytest.approx(2e-4, rel=0.2)


def test_positions_may_be_late_while_attitudes_are_in_time() -> None:
    """As where a tracker's positions were fused with the gyroscope: each is undone by its own offset."""
    stamps, gyro, accel, exact = recorded(10, np.zeros(3), np.zeros(3), 0.0, 200.0, noise=(0.0, 0.0))
    t_ns = exact.t_ns[10:-10]
    T = exact.at(t_ns)
    T[:, :3, 3] = exact.at(t_ns + 6_000_000)[:, :3, 3]
    fit = fit_truth(stamps, gyro, accel, Trajectory(t_ns, T))
    of_imu = fit.of_imu(Trajectory(t_ns, T))
    true = exact.at(of_imu.t_ns)
    turned = Rotation.from_matrix(true[:, :3, :3].transpose(0, 2, 1) @ of_imu.T_world_body[:, :3, :3]).magnitude()
    print(fit.summary, fit.turn_offset_s)
    assert fit.time_offset_s == pytest.approx(0.006, abs=3e-4) and abs(fit.turn_offset_s) < 3e-4
    assert "off in position by +6.0" in fit.summary
    assert np.abs(true[:, :3, 3] - of_imu.positions_m).max() < 5e-4 and np.rad2deg(turned).max() < 0.02


def drawn_states(exact: Trajectory) -> list[NavState]:
    """Return states of 2 mm, 0.1 deg and 5 mm/s, five a second."""
    rng, sigmas = np.random.default_rng(0), np.repeat([np.deg2rad(0.1), 0.002, 0.005, 1e-3, 1e-3], 3)
    path = CubicSpline((exact.t_ns - exact.t_ns[0]) * 1e-9, exact.positions_m)
    states = []
    for i in range(100, len(exact) - 100, 40):
        error, T = rng.normal(0.0, sigmas), exact.T_world_body[i].copy()
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(error[:3]).as_matrix()
        T[:3, 3] += error[3:6]
        velocity = path((exact.t_ns[i] - exact.t_ns[0]) * 1e-9, 1) + error[6:9]
        states.append(NavState(int(exact.t_ns[i]), T, velocity, np.zeros(3), np.zeros(3), np.diag(sigmas**2)))
    return states


def test_nees_is_that_of_the_states_where_the_truth_is_late_and_noisy() -> None:
    stamps, gyro, accel, truth = recorded(11, TURN_RAD, LEVER_M, 0.006, 200.0, noise=(0.003, np.deg2rad(0.2)))
    states = drawn_states(recorded(11, np.zeros(3), np.zeros(3), 0.0, 200.0, noise=(0.0, 0.0))[3])
    fit = fit_truth(stamps, gyro, accel, truth)
    before, after = (anees(states, truth, judge) for judge in (None, fit))
    print(fit.summary, fit.noise, *({name: round(v.mean, 2) for name, v in found.items()} for found in (before, after)))
    assert all(value.mean > 3.0 for value in before.values())
    assert all(0.7 < value.mean < 1.4 for value in after.values())


def test_velocities_of_a_truth_that_sways_are_judged_by_how_it_does() -> None:
    """One millimetre at 1.5 Hz, as a tracker's filter leaves it, is 7 mm/s; a tenth of a second shows most of it."""
    stamps, gyro, accel, exact = recorded(13, np.zeros(3), np.zeros(3), 0.0, 200.0, noise=(0.0, 0.0))
    truth = Trajectory(exact.t_ns, exact.T_world_body.copy())
    truth.T_world_body[:, :3, 3] += 0.001 * np.sin(9.4e-9 * (truth.t_ns - truth.t_ns[0])[:, None] + [0.0, 2.0, 4.0])
    fit = fit_truth(stamps, gyro, accel, truth)
    before, after = (anees(drawn_states(exact), truth, judge)["velocity"].mean for judge in (None, fit))
    print(fit.noise, before, after)
    assert 0.003 < fit.velocity_m_s < 0.007
    assert before > 2.0 and 0.8 < after < 1.5


def test_a_fit_is_kept_as_plain_data() -> None:
    stamps, gyro, accel, truth = recorded(12, truth_hz=20.0, duration_s=40.0)
    fit = fit_truth(stamps, gyro, accel, truth)
    entry = json.loads(json.dumps(fit.entry(truth, "yaw")))
    back = TruthFit.read(entry)
    assert back is not None and back.summary == fit.summary and back.noise == fit.noise
    assert np.array_equal(back.of_imu(truth).T_world_body, fit.of_imu(truth).T_world_body)
    print(entry["summary"])
    assert fit.summary in entry["summary"] and fit.noise in entry["summary"]
    moved = np.linalg.norm(LEVER_M) + 0.02  # at 4 m/s at the most for 5 ms
    assert 0.002 < entry["error_m"] < moved
    for nothing in ({}, None):
        assert TruthFit.read(nothing) is None
    singular = entry | {"turn_covariance": np.zeros((3, 3)).tolist()}
    for damaged in (
        [1],
        "text",
        {"turn_rad": [0.0] * 3},
        entry | {"lever_m": [1.0]},
        entry | {"noise_m": None},
        singular,
    ):
        with pytest.raises(DataError, match="run it again"):
            TruthFit.read(damaged)


@pytest.mark.data
def test_on_a_real_flight_the_turn_is_found_and_undone(data_root: Path) -> None:
    """V2_02: the gyroscope alone finds the turn, and with it undone nothing more is found."""
    folder = data_root / "euroc_v202_imu"
    if not folder.is_dir():
        missing(f"{folder}")
    data = measured_inertial(real(data_root, "v202").removeprefix("points:"))
    print(data.truth_fit.summary)
    assert data.truth_fit.is_turned and not data.truth_fit.is_displaced
    assert 0.4 < np.rad2deg(np.linalg.norm(data.truth_fit.turn_rad)) < 0.8
    assert fit_truth(data.t_ns, data.gyro_rad_s, data.accel_m_s2, data.truth).summary == ""
