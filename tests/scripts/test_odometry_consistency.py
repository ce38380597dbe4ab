"""The arithmetic of experiments/odometry_consistency.py, on motions whose errors and clocks are known."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.core.geometry import invert, se3_exp
from vislam.core.messages import Array
from vislam.trajectory import Trajectory

SIGMAS = np.repeat([0.002, 0.003], 3)
LATE_S = (0.004, -0.007)  # of turns and of ways
COUNT = 400


def script() -> Any:
    path = Path(__file__).parents[2] / "experiments" / "odometry_consistency.py"
    spec = importlib.util.spec_from_file_location("odometry_consistency", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def pose(turn_s: float, way_s: float) -> Array:
    """Swaying at 0.5 Hz by 0.3 m, turning by half a radian."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(0.5 * np.sin(np.array([1.0, 1.3, 0.7]) * 3.0 * turn_s)).as_matrix()
    T[:3, 3] = 0.3 * np.cos(np.array([1.0, 0.8, 1.2]) * 3.0 * way_s)
    return T


@pytest.fixture(scope="module")
def known() -> tuple[Any, Any, Trajectory]:
    module, rng = script(), np.random.default_rng(4)
    true_s = np.arange(0.0, 22.0, 0.005)
    truth = Trajectory(
        np.round(true_s * 1e9).astype(np.int64), np.array([pose(s - LATE_S[0], s - LATE_S[1]) for s in true_s])
    )
    t_s = 0.5 + 0.05 * np.arange(COUNT)
    key_s = 0.5 + 0.4 * np.floor((t_s - 0.5 - 1e-6) / 0.4).clip(0)
    moved = [
        invert(pose(a, a)) @ pose(b, b) @ se3_exp(rng.normal(0.0, SIGMAS)) for a, b in zip(key_s, t_s, strict=True)
    ]
    stamps = [np.round(s * 1e9).astype(np.int64) for s in (key_s, t_s)]
    motions = module.Motions(*stamps, np.array(moved), np.tile(np.diag(SIGMAS**2), (COUNT, 1, 1)))
    return module, module.within(motions, truth), truth


def test_both_clocks_of_a_truth_are_found(known: tuple[Any, Any, Trajectory]) -> None:
    module, motions, truth = known
    assert module.lateness(motions, truth) == pytest.approx(LATE_S, abs=0.001)


def test_nees_is_one_for_honest_motions_and_counts_the_noise_of_truth(known: tuple[Any, Any, Trajectory]) -> None:
    module, motions, truth = known
    off = module.errors(motions, truth, *LATE_S)
    values = module.nees(off, motions.covariance, 0.0, 0.0)
    assert values.mean(axis=0) == pytest.approx([1.0, 1.0], abs=0.15)
    both = module.nees(off, 0.5 * motions.covariance, SIGMAS[0] / 2.0, SIGMAS[3] / 2.0)
    assert np.allclose(both, values)  # half of the variance is said to be that of truth, a quarter at either end
    assert module.nees(off, 0.25 * motions.covariance, 0.0, 0.0) == pytest.approx(4.0 * values)
    counts = [int(row.split("|")[2]) for row in module.table(motions, off, values).splitlines()[2:]]
    assert sum(counts[:-1]) == counts[-1] == len(off) - int(np.sum(motions.t_ns == motions.key_ns))
