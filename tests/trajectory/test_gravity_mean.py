"""Up from an accelerometer without a gyroscope, on motions of a hand with a sensor that is biased."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.core.angles import angle_deg
from vislam.core.trajectory import Trajectory
from vislam.trajectory.gravity_mean import up_of_forces

UP = np.array([0.2, -0.6, 0.77])
UP = UP / np.linalg.norm(UP)
RATE_HZ = 100


def hand(length_s: float, seed: int = 0, bias_m_s2: float = 0.3) -> tuple[Trajectory, np.ndarray, np.ndarray]:
    """A trajectory of turns by up to 50 degrees, with the stamps and forces (m/s^2) of what is held."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, length_s, 1.0 / RATE_HZ)
    waves = rng.uniform(0.1, 0.6, (3, 1)), rng.uniform(0.0, 6.0, (3, 1))
    angles = 0.6 * np.sin(2.0 * np.pi * waves[0] * t_s + waves[1])
    R = Rotation.from_rotvec(angles.T).as_matrix()
    shake = 1.5 * np.sin(2.0 * np.pi * np.array([1.3, 0.9, 1.7])[:, None] * t_s + waves[1])  # in the map
    noise = rng.normal(0.0, 0.3, (len(t_s), 3))
    bias = bias_m_s2 * np.array([0.6, -0.5, 0.62])
    forces = np.einsum("nji,nj->ni", R, 9.81 * UP + shake.T) + bias + noise
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    T = np.tile(np.eye(4), (len(t_s), 1, 1))
    T[:, :3, :3] = R
    return Trajectory(t_ns, T), t_ns, forces


@pytest.mark.parametrize("seed", range(5))
def test_motion_averages_out_and_the_bias_is_found(seed):
    up = up_of_forces(*hand(20.0, seed))
    assert up.source == "accelerometer"
    assert angle_deg(up.direction, UP) < min(3.5 * up.sigma_deg, 2.0)


@pytest.mark.parametrize(("factor", "unit"), [(1.0, "m/s^2"), (1.0 / 9.81, "g"), (100.0, "cm/s^2")])
def test_the_unit_is_seen_from_the_size(factor, unit):
    path, t_ns, forces = hand(20.0)
    up = up_of_forces(path, t_ns, factor * forces)
    assert f"in {unit}," in up.reason
    assert angle_deg(up.direction, up_of_forces(path, t_ns, forces).direction) < 1e-6


@pytest.mark.parametrize(
    ("spoilt", "says"),
    [
        (lambda path, t, f: (path, t, 3.0 * f), "gravity in none of"),
        (lambda path, t, f: (path, t[:150], f[:150]), "too short"),
        (lambda path, t, f: (path, t + 10**12, f), "0 of its"),
        (lambda path, t, f: (path, t, f[:, [0, 2, 1]] * [1.0, -1.0, -1.0]), "scatters|leaves"),
        (lambda path, t, f: (Trajectory(t[:0], np.zeros((0, 4, 4))), t, f), "no trajectory"),
    ],
)
def test_what_cannot_be_gravity_is_refused_with_the_reason(spoilt, says):
    path, t_ns, _ = hand(20.0)
    turned = Rotation.from_rotvec(np.linspace(0.0, 9.0, len(t_ns))[:, None] * [0.6, 0.0, 0.8]).as_matrix()
    T = path.T_world_body.copy()
    T[:, :3, :3] = turned @ T[:, :3, :3]  # a spin, so that wrong axes show
    spun = np.einsum("nji,nj->ni", T[:, :3, :3], np.tile(9.81 * UP, (len(t_ns), 1)))
    up = up_of_forces(*spoilt(Trajectory(t_ns, T), t_ns, spun))
    assert not up.is_known
    assert any(part in up.reason for part in says.split("|")), up.reason


def test_the_same_samples_give_the_same_bytes():
    assert up_of_forces(*hand(10.0)).entry() == up_of_forces(*hand(10.0)).entry()
