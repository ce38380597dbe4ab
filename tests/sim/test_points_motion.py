"""Simulated vision rests on the motion of a real body: it must agree with the real IMU far better than its noise."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.needs import missing
from vislam.core import DataError
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array
from vislam.runs.sources import measured_inertial
from vislam.sim import MeasuredInertial
from vislam.sim.motion.measured import MeasuredMotion
from vislam.sim.motion.motions import cart_laps, laps, straight, turn_in_place
from vislam.trajectory import Trajectory
from worlds.recordings import angles_rad, real

FX_PX = 458.0


def recorded(data_root: Path, name: str) -> MeasuredInertial:
    folder = data_root / f"euroc_{name}_imu"
    if not folder.is_dir():
        missing(f"{folder}")
    return measured_inertial(real(data_root, name).removeprefix("points:"))


def motion_of(data: MeasuredInertial, every: int = 1) -> MeasuredMotion:
    truth = Trajectory(data.truth.t_ns[::every], data.truth.T_world_body[::every])
    return MeasuredMotion(data.t_ns, data.gyro_rad_s, data.accel_m_s2, truth)


@pytest.mark.data
@pytest.mark.parametrize(("name", "every"), [("v101", 2), ("v201", 20)])
def test_motion_from_a_tenth_of_a_second_of_truth_hits_the_poses_between(
    data_root: Path, name: str, every: int
) -> None:
    data = recorded(data_root, name)
    motion = motion_of(data, every)
    t_s = (data.truth.t_ns - motion.zero_ns) * 1e-9
    known = motion.covers(t_s)
    assert known.mean() > 0.99
    T = motion.at(t_s[known]).T_world_body
    T[:, :3] = motion.R_level_world.T @ T[:, :3]
    error_m = np.linalg.norm(T[:, :3, 3] - data.truth.positions_m[known], axis=1)
    R = T[:, :3, :3].transpose(0, 2, 1) @ data.truth.T_world_body[known, :3, :3]
    error_rad = angles_rad(R[::7])
    print(f"{name}: {np.sqrt(np.mean(error_m**2)) * 1e6:.0f} um, {np.sqrt(np.mean(error_rad**2)) * 1e6:.0f} urad rms")
    # in rotation it is the gyroscope that is believed over seconds, and motion capture that errs
    assert np.sqrt(np.mean(error_rad**2)) < np.deg2rad(0.4) and error_rad.max() < np.deg2rad(2.0)
    assert np.sqrt(np.mean(error_m**2)) < 1e-4 and error_m.max() < 1e-3


def turned_by_gyro(data: MeasuredInertial, begin_ns: int, end_ns: int, bias: Array) -> Array:
    """Integrate the gyroscope between two stamps, its samples interpolated at both."""
    inside = (data.t_ns > begin_ns) & (data.t_ns < end_ns)
    stamps = np.concatenate([[begin_ns], data.t_ns[inside], [end_ns]])
    rates = np.column_stack([np.interp(stamps, data.t_ns, data.gyro_rad_s[:, k]) for k in range(3)]) - bias
    R = np.eye(3)
    for k, dt_s in enumerate(np.diff(stamps) * 1e-9):
        R = R @ so3_exp(0.5 * (rates[k] + rates[k + 1]) * dt_s)
    return R


@pytest.mark.data
@pytest.mark.parametrize("name", ["v101", "v201"])
def test_gyroscope_and_motion_agree_over_seconds(data_root: Path, name: str) -> None:
    """Where they did not, simulated vision would contradict the inertial data, as the true rotations do by 0.4 deg."""
    data = recorded(data_root, name)
    motion = motion_of(data)
    apart = {"motion": [], "truth": []}
    for begin_s in np.arange(2.0, motion.end_s - 8.0, 2.0):
        ends_ns = motion.zero_ns + (np.array([begin_s, begin_s + 5.0]) * 1e9).astype(np.int64)
        gyro = turned_by_gyro(data, *ends_ns.tolist(), motion.gyro_bias_rad_s)
        for name_of, T in (
            ("motion", motion.at((ends_ns - motion.zero_ns) * 1e-9).T_world_body),
            ("truth", data.truth.at(ends_ns)),
        ):
            apart[name_of].append(gyro.T @ T[0, :3, :3].T @ T[1, :3, :3])
    rms_deg = {k: np.rad2deg(np.sqrt(np.mean(angles_rad(np.array(v)) ** 2))) for k, v in apart.items()}
    print(f"{name}: over 5 s the gyroscope parts from the motion by {rms_deg['motion']:.3f} deg, the truth {rms_deg}")
    assert rms_deg["motion"] < 0.25  # the rest: its bias is taken as constant here
    assert rms_deg["truth"] > 1.5 * rms_deg["motion"]  # also with what the truth is turned undone


@pytest.mark.data
@pytest.mark.parametrize("name", ["v101", "v201"])
def test_gyroscope_and_motion_agree_over_a_frame(data_root: Path, name: str) -> None:
    """Also at 3 ms off the truth's stamps; a time shift of 5 ms would show up three times as large."""
    data = recorded(data_root, name)
    motion = motion_of(data)
    begin_s = np.arange(5.0, 95.0, 0.65) + 0.003
    step_s = 0.05
    begin, end = motion.at(begin_s).T_world_body[:, :3, :3], motion.at(begin_s + step_s).T_world_body[:, :3, :3]
    stamps = np.round(begin_s * 1e9).astype(np.int64) + motion.zero_ns
    turns = np.array([turned_by_gyro(data, t, t + 50_000_000, motion.gyro_bias_rad_s) for t in stamps.tolist()])
    error_rad = angles_rad(turns.transpose(0, 2, 1) @ begin.transpose(0, 2, 1) @ end)
    late = motion.at(begin_s + 0.005).T_world_body[:, :3, :3].transpose(0, 2, 1)
    late_rad = angles_rad(turns.transpose(0, 2, 1) @ late @ motion.at(begin_s + step_s + 0.005).T_world_body[:, :3, :3])
    rms, rms_late = np.sqrt(np.mean(error_rad**2)), np.sqrt(np.mean(late_rad**2))
    noise_rad = np.sqrt(3 * step_s) * data.noise.gyroscope_noise_density
    print(f"{name}: {rms * 1e6:.0f} urad rms over 50 ms, white noise explains {noise_rad * 1e6:.0f}, late {rms_late}")
    assert rms < 3.0 * noise_rad  # the rest: the bias wanders, and the truth has noise of its own
    assert rms * FX_PX < 0.1
    assert rms_late > 2.0 * rms


@pytest.mark.data
@pytest.mark.parametrize("name", ["v101", "v201"])
def test_accelerometer_and_motion_agree_over_half_a_second(data_root: Path, name: str) -> None:
    """The change of velocity, with gravity and one constant bias [3] fitted over the recording."""
    data = recorded(data_root, name)
    motion = motion_of(data)
    starts, length = np.searchsorted(data.t_ns, motion.zero_ns + 5_000_000_000) + np.arange(0, 18000, 150), 100
    rows, sides = [], []
    for k in starts.tolist():
        part = slice(k, k + length + 1)
        t_s = (data.t_ns[part] - motion.zero_ns) * 1e-9
        moved = motion.at(t_s)
        R, h = moved.T_world_body[:, :3, :3], np.diff(t_s)[:, None]
        force = np.einsum("nij,nj->ni", R, data.accel_m_s2[part]) - [0.0, 0.0, 9.81]
        velocity = (0.5 * h * (force[:-1] + force[1:])).sum(axis=0)
        rows.append((0.5 * h[..., None] * (R[:-1] + R[1:])).sum(axis=0))
        sides.append(velocity - (moved.velocity_world_m_s[-1] - moved.velocity_world_m_s[0]))
    bias = np.linalg.lstsq(np.concatenate(rows), np.concatenate(sides), rcond=None)[0]
    left = np.array(sides) - np.einsum("nij,j->ni", np.array(rows), bias)
    print(f"{name}: bias {bias.round(3)} m/s^2, left {left.std(axis=0)} m/s over 0.5 s")
    assert np.linalg.norm(bias) < 0.4
    # 0.05 m/s^2, and neither a lever arm nor a time shift explains it; the white noise alone would give 0.0014
    assert left.std(axis=0).max() < 0.025
    tilt = np.rad2deg(np.arccos(motion.R_level_world[2, 2]))
    assert 0.05 < tilt < 1.0


def test_a_tilted_world_is_turned_upright() -> None:
    spline = laps(np.random.default_rng(3), 40.0)
    imu_s = np.arange(0.0, 40.0, 0.005)
    motion = spline.at(imu_s)
    swing = Rotation.from_rotvec(np.column_stack([0.6 * np.sin(0.5 * imu_s), 0.5 * np.cos(0.7 * imu_s), 0.0 * imu_s]))
    T = motion.T_world_body.copy()
    T[:, :3, :3] = T[:, :3, :3] @ swing.as_matrix()  # a body that never leans cannot tell its bias from a tilt
    force = motion.acceleration_world_m_s2 + np.array([0.0, 0.0, 9.81])
    accel = np.einsum("nji,nj->ni", T[:, :3, :3], force) + np.array([0.1, -0.05, 0.0])
    between = Rotation.from_matrix(T[:-1, :3, :3].transpose(0, 2, 1) @ T[1:, :3, :3]).as_rotvec() / 0.005
    gyro = np.vstack([between, between[-1:]])
    gyro[1:-1] = 0.5 * (between[:-1] + between[1:])
    tilted = np.eye(4)
    tilted[:3, :3] = Rotation.from_rotvec([0.008, -0.006, 0.0]).as_matrix()
    stamps = np.round(imu_s * 1e9).astype(np.int64)
    found = MeasuredMotion(stamps, gyro, accel, Trajectory(stamps[::10], (tilted @ T)[::10]))
    lean = np.rad2deg(np.arccos((found.R_level_world @ tilted[:3, :3])[2, 2]))
    print(f"of 0.57 deg, {lean:.3f} deg are left")
    assert lean < 0.06
    velocity = found.at(imu_s[1000:-1000]).velocity_world_m_s @ (tilted[:3, :3].T @ found.R_level_world.T).T
    assert np.abs(velocity - motion.velocity_world_m_s[1000:-1000]).max() < 0.01


def test_motion_knows_its_gaps_and_refuses_too_little_truth() -> None:
    t_ns = np.arange(0, 4_000_000_000, 5_000_000, dtype=np.int64)
    still, up = np.zeros((len(t_ns), 3)), np.tile([0.0, 0.0, 9.81], (len(t_ns), 1))
    poses = Trajectory(t_ns[::10], np.tile(np.eye(4), (len(t_ns[::10]), 1, 1)))
    kept = (poses.t_ns < 1_000_000_000) | (poses.t_ns > 1_600_000_000)
    motion = MeasuredMotion(t_ns, still, up, Trajectory(poses.t_ns[kept], poses.T_world_body[kept]))
    known = motion.covers(np.array([0.5, 0.94, 1.0, 1.5, 1.66, 3.9, 5.0, -1.0]))
    assert known.tolist() == [True, True, False, False, True, True, False, False]
    assert np.allclose(motion.at(np.array([0.3, 2.5])).velocity_world_m_s, 0.0, atol=1e-9)
    lacking = np.delete(np.arange(len(t_ns)), np.arange(300, 320))
    torn = MeasuredMotion(t_ns[lacking], still[lacking], up[lacking], poses)
    assert torn.covers(np.array([1.49, 1.55, 1.62])).tolist() == [True, False, True]
    with pytest.raises(DataError, match="only 3 true poses"):
        MeasuredMotion(t_ns, still, up, Trajectory(poses.t_ns[:3], poses.T_world_body[:3]))
    with pytest.raises(DataError, match="true poses, got 0 samples"):
        MeasuredMotion(t_ns[:0], still[:0], up[:0], poses)


def test_straight_keeps_its_velocity_and_a_turn_keeps_its_place() -> None:
    rng = np.random.default_rng(0)
    moving = straight(rng, 20.0).at(np.linspace(6.0, 20.0, 50))
    assert np.abs(moving.velocity_world_m_s - [1.0, 0.0, 0.0]).max() < 1e-9
    assert np.abs(moving.acceleration_world_m_s2).max() < 1e-9
    turning = turn_in_place(rng, 30.0).at(np.linspace(0.0, 30.0, 300))
    assert np.abs(turning.T_world_body[:, :3, 3] - [0.0, 0.0, 1.0]).max() < 1e-12
    assert 0.8 < np.abs(turning.rate_body_rad_s[:, 2]).max() < 1.5 and np.abs(turning.rate_body_rad_s[:20]).max() < 1e-9


def test_laps_come_back_to_the_same_place() -> None:
    spline = laps(np.random.default_rng(1), 200.0)
    motion = spline.at(np.arange(10.0, 190.0, 0.1))
    speed = np.linalg.norm(motion.velocity_world_m_s, axis=1)
    assert speed.min() > 0.5 and speed.max() < 1.6
    xy = motion.T_world_body[:, :2, 3]
    gaps = np.linalg.norm(xy[600:] - xy[0], axis=1)
    assert gaps.min() < 0.3 and np.ptp(xy, axis=0) == pytest.approx([12.0, 7.0], abs=0.6)
    assert np.linalg.norm(spline.at(np.array([1.0])).velocity_world_m_s) < 1e-9


def test_a_cart_in_laps_goes_where_it_looks_and_stops() -> None:
    motion = cart_laps(np.random.default_rng(0), 120.0).at(np.arange(0.0, 120.0, 0.02))
    R, velocity = motion.T_world_body[:, :3, :3], motion.velocity_world_m_s
    forward, left, up = np.einsum("nji,nj->ni", R, velocity).T
    assert np.abs(left).max() < 0.005 and np.abs(up).max() < 0.03
    assert 0.99 < forward.max() < 1.01 and forward.min() > -1e-6
    begins = np.flatnonzero(np.diff((np.linalg.norm(velocity, axis=1) < 1e-3).astype(int)) == 1)
    assert len(begins) == 4  # every 25 m
    assert 90.0 < 0.02 * forward.sum() < 115.0
