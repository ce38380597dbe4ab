"""Cases that break most systems, end to end on simulated vision; experiments/degenerate.toml has longer ones."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.config import load
from vislam.core.geometry import so3_exp, transform
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.sources import open_source
from vislam.trajectory import anees, associate, evaluate, read_trajectory
from vislam.trajectory.states import read_states_csv
from vislam.vision.two_view import from_epipolar_segment

SEED = 0
QUICK = {"map.enabled": False, "view.enabled": False, "loop.enabled": False, "seed": SEED}
CAMERA = "camera_hz=10,tracks=80"


def run(tmp_path, uri, **settings):
    """Return the run's metrics, and the true errors of its trajectories by name."""
    config = load(None, QUICK | {name.replace("__", "."): value for name, value in settings.items()})
    out = tmp_path / "run"
    prepare(out, False)
    metrics = execute(open_source(uri, SEED), config, out, uri, [])
    assert json.loads((out / "metrics.json").read_text())["frames"] == metrics["frames"]
    truth = read_trajectory(out / "trajectory_truth.tum")
    found = {name: read_trajectory(out / f"trajectory_{name}.tum") for name in ("ekf", "graph")}
    print(f"{uri}, seed {SEED}:", {n: evaluate(t, truth, "yaw")["ate_max_m"] for n, t in found.items()})
    return metrics, {n: evaluate(t, truth, "yaw") for n, t in found.items()}, found


@pytest.mark.parametrize(("rig", "coupling"), [("mono", "tight"), ("stereo", "loose")])
def test_long_rest(tmp_path, rig, coupling):
    metrics, _, found = run(tmp_path, f"points:still,rig={rig},duration_s=15,{CAMERA}", ekf__coupling=coupling)
    assert metrics["initialisation"]["status"] == "static"
    assert metrics["counters"]["front"]["frames_at_rest"] > 140
    # a frame's own noise is no drift: four seconds are averaged; what the first frame did not know has come in by then
    for name, trajectory in found.items():
        first, last = trajectory.T_world_body[40:80], trajectory.T_world_body[-40:]
        drift_m = np.linalg.norm(last[:, :3, 3].mean(axis=0) - first[:, :3, 3].mean(axis=0))
        turned = Rotation.from_matrix(first[:, :3, :3]).mean().inv() * Rotation.from_matrix(last[:, :3, :3]).mean()
        drift_deg = np.rad2deg(turned.magnitude())
        print(f"{name}: {1e3 * drift_m:.1f} mm, {drift_deg:.3f} deg")
        assert drift_m < 0.0025, name
        # tilt that rest cannot tell from the accelerometer's bias wanders within its sigma
        assert drift_deg < 0.35, name


@pytest.mark.parametrize("coupling", ["loose", "tight"])
def test_a_slow_start_is_not_held_back(tmp_path, coupling):
    uri = f"points:slow-start,rig=stereo,duration_s=12,{CAMERA}"
    _, errors, found = run(tmp_path, uri, ekf__coupling=coupling)
    for name, trajectory in found.items():
        assert trajectory.path_m > 1.8, name  # 2 m
        assert errors[name]["ate_rmse_m"] < 0.03, name


def test_no_texture_for_three_seconds(tmp_path):
    uri = f"points:laps,rig=stereo,duration_s=11,outage_begin_s=5,outage_length_s=3,{CAMERA}"
    metrics, errors, _ = run(tmp_path, uri)
    assert metrics["counters"]["front"]["frames_lost"] > 20
    assert errors["ekf"]["ate_rmse_m"] < 0.15
    assert errors["graph"]["ate_rmse_m"] < 0.15


@pytest.mark.parametrize("coupling", ["loose", "tight"])
def test_somebody_fills_half_of_the_image(tmp_path, coupling):
    uri = f"points:laps,rig=stereo,duration_s=11,moving_share=0.5,moving_begin_s=5,{CAMERA}"
    _, errors, _ = run(tmp_path, uri, ekf__coupling=coupling, graph__coupling=coupling)
    assert errors["ekf"]["ate_rmse_m"] < 0.1
    assert errors["graph"]["ate_rmse_m"] < 0.15


def test_somebody_fills_half_of_the_image_of_one_camera(tmp_path):
    """Whenever tracking starts anew, nearly all tracks that are known by name are on the person."""
    uri = f"points:laps,rig=mono,duration_s=15,moving_share=0.5,moving_begin_s=8,{CAMERA}"
    _, errors, _ = run(tmp_path, uri)
    assert errors["ekf"]["ate_rmse_m"] < 0.3
    assert errors["graph"]["ate_rmse_m"] < 0.3


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_noise_model_ten_times_off(tmp_path, factor):
    uri = f"points:laps,rig=stereo,duration_s=10,imu_noise_factor={factor},{CAMERA}"
    metrics, errors, _ = run(tmp_path, uri)
    for sensor in metrics["imu_noise"].values():
        assert sensor["used_last"] == pytest.approx(max(sensor["told"], sensor["typical"]), rel=0.5)
        assert (sensor["used_last"] > 5.0 * sensor["told"]) == (factor < 1.0)
    assert sum("noise" in warning for warning in metrics["warnings"]) == (2 if factor > 1.0 else 0)
    assert errors["ekf"]["ate_rmse_m"] < 0.05
    assert errors["graph"]["ate_rmse_m"] < 0.05


def test_a_lost_filter_is_told(tmp_path):
    """One camera that only turns sees no way: loosely coupled, the filter dead-reckons, and says so."""
    uri = f"points:turn-in-place,rig=mono,duration_s=25,{CAMERA}"
    metrics, errors, _ = run(tmp_path, uri, ekf__coupling="loose", graph__coupling="loose")
    assert errors["ekf"]["ate_max_m"] > 1.0, "no longer degenerate; take a harder case"
    assert any("uncertain" in reason for reason in metrics["verdict"]["reasons"])
    assert not any("visual measurements as impossible" in reason for reason in metrics["verdict"]["reasons"])


def test_uniform_motion_of_one_camera_is_stated_and_its_sigmas_grow(tmp_path):
    """Without a change of acceleration nothing shows scale any more, and noise must not pass for it in the filter."""
    metrics, errors, _ = run(tmp_path, f"points:straight,rig=mono,duration_s=28,{CAMERA}")
    assert any("uniform motion for" in reason for reason in metrics["verdict"]["reasons"])
    assert metrics["counters"]["front"]["frames_without_excitation"] > 150
    assert errors["ekf"]["ate_max_m"] < 2.0
    truth = read_trajectory(tmp_path / "run" / "trajectory_truth.tum")
    for name in ("ekf", "graph"):
        states = read_states_csv(tmp_path / "run" / f"states_{name}.csv")[1]
        sigmas_m = [np.sqrt(np.trace(s.covariance[3:6, 3:6])) for s in states]
        found = anees(states, truth)
        print(f"{name}: {found['position'].mean:.2f}, sigma at the end {sigmas_m[-1]:.2f} m")
        assert 0.05 < found["position"].mean < 4.0, name  # one run of 28 s is little: its errors are one draw
        assert 0.3 < sigmas_m[-1] < 3.0, name
        assert sigmas_m[len(states) // 3] < 0.5 * sigmas_m[-1], name


def test_laps_of_one_camera_are_no_uniform_motion(tmp_path):
    metrics, errors, _ = run(tmp_path, f"points:laps,rig=mono,duration_s=12,{CAMERA}", graph__coupling="loose")
    assert not any("uniform motion for" in reason for reason in metrics["verdict"]["reasons"])
    assert metrics["counters"]["front"]["frames_without_excitation"] < 75
    assert errors["ekf"]["ate_max_m"] < 0.2


@pytest.mark.parametrize(
    "world",
    [
        "straight,start_s=2.5,duration_s=8",
        pytest.param("euroc_v101_imu,start_s=12,duration_s=8", marks=pytest.mark.data),
    ],
)
def test_what_came_before_a_start_in_motion_has_its_scale(tmp_path, world, request):
    """Every piece of 2 s of the final path is as long as it was; what has no pose is not counted as covered."""
    folder = f"{request.getfixturevalue('data_root')}/" if world.startswith("euroc") else ""
    metrics, _, found = run(tmp_path, f"points:{folder}{world},rig=mono,{CAMERA}")
    truth = read_trajectory(tmp_path / "run" / "trajectory_truth.tum")
    pairs = associate(found["graph"], truth)
    assert metrics["initialisation"]["status"] == "moving"
    assert metrics["initialisation"]["t_s"] > 1.0, "no longer a late start"
    assert metrics["accuracy"]["graph"]["coverage"] == pytest.approx(len(found["graph"]) / metrics["frames"], abs=0.02)
    scales = []
    for t_ns in np.arange(pairs.t_ns[0], pairs.t_ns[-1] - 1_900_000_000, 500_000_000):
        inside = (pairs.t_ns >= t_ns) & (pairs.t_ns < t_ns + 2_000_000_000)
        shape, true = pairs.estimate[inside, :3, 3], pairs.reference[inside, :3, 3]
        if len(true) >= 10 and np.linalg.norm(np.ptp(true, axis=0)) > 0.1:
            scales.append(np.linalg.norm(np.std(shape, axis=0)) / np.linalg.norm(np.std(true, axis=0)))
    print("local scales:", np.round(scales, 3))
    assert len(scales) >= 8
    assert 0.9 < min(scales) <= max(scales) < 1.1


def test_a_point_is_on_its_epipolar_segment_and_a_walker_is_not():
    rng = np.random.default_rng(SEED)
    T_key_cam = transform(so3_exp(np.array([0.02, -0.1, 0.03])), np.array([0.2, 0.05, 0.1]))
    points = np.column_stack([rng.uniform(-1, 1, (50, 2)), rng.uniform(1.0, 8.0, 50)])  # in the keyframe's camera
    now = (points - T_key_cam[:3, 3]) @ T_key_cam[:3, :3]
    key_xy, xy = points[:, :2] / points[:, 2:], now[:, :2] / now[:, 2:]
    assert from_epipolar_segment(T_key_cam, key_xy, xy, 1.0 / 0.3).max() < 1e-9
    walked = points + np.array([0.0, 0.5, 0.0])
    now = (walked - T_key_cam[:3, 3]) @ T_key_cam[:3, :3]
    assert np.median(from_epipolar_segment(T_key_cam, key_xy, now[:, :2] / now[:, 2:], 1.0 / 0.3)) > 0.02
    xy[3] = np.nan
    assert np.isnan(from_epipolar_segment(T_key_cam, key_xy, xy, 1.0 / 0.3)[3])
