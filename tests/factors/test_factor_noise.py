import gtsam
import numpy as np
import pytest

from vislam.config import GraphConfig
from vislam.core import DataError
from vislam.factors.builder import of_vision
from vislam.factors.journal import KeyframeRecord
from vislam.factors.noise_models import cauchy, checked_covariance, conditioned, gaussian, huber, inflated


@pytest.mark.parametrize(
    "bad",
    [
        np.full((6, 6), np.nan),
        np.eye(5),
        np.zeros((6, 6)),
        -np.eye(6),
        np.eye(6) + np.triu(np.ones((6, 6)), 1),
        np.diag([1.0, 1, 1, 1, 1, np.inf]),
    ],
)
def test_covariance_that_is_none_is_refused_with_its_place(bad: np.ndarray) -> None:
    with pytest.raises(DataError, match="keyframe 7"):
        checked_covariance(bad, 6, "keyframe 7")


def test_singular_covariance_is_allowed_and_conditioned() -> None:
    singular = checked_covariance(np.diag([1.0, 1, 1, 1, 1, 0]), 6, "x")
    values = np.linalg.eigvalsh(conditioned(singular, 1e6))
    assert values[0] == pytest.approx(1e-6, rel=1e-6)
    assert values[-1] == pytest.approx(1.0)


def test_conditioning_leaves_good_covariance_untouched() -> None:
    good = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4])
    assert conditioned(good, 1e6) is good


def test_gaussian_whitens_as_its_covariance_says() -> None:
    rng = np.random.default_rng(3)
    A = rng.normal(size=(6, 6))
    covariance = A @ A.T + np.eye(6)
    e = rng.normal(size=6)
    whitened = gaussian(covariance, 1e6).whiten(e)
    assert whitened @ whitened == pytest.approx(e @ np.linalg.solve(covariance, e))


def test_inflation_adds_floor_to_the_right_blocks() -> None:
    out = inflated(np.diag([1.0, 1, 1, 4, 4, 4]), 2.0, 3.0, 5.0)
    np.testing.assert_allclose(np.diag(out), [13, 13, 13, 41, 41, 41])


def test_robust_kernels_weigh_as_their_formulas() -> None:
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([5.0, 0, 0]))
    values = gtsam.Values()
    values.insert(0, pose)
    unit = gaussian(np.eye(6), 1e6)
    r = 5.0
    factor = gtsam.PriorFactorPose3(0, gtsam.Pose3(), cauchy(unit, 2.0))
    assert factor.error(values) == pytest.approx(0.5 * 4.0 * np.log1p(r**2 / 4.0))
    factor = gtsam.PriorFactorPose3(0, gtsam.Pose3(), huber(unit, 3.0))
    assert factor.error(values) == pytest.approx(3.0 * (r - 1.5))


@pytest.mark.parametrize(
    ("has_scale", "degraded", "factor"), [(True, False, 1.0), (True, True, 3.0), (False, False, 4.0)]
)
def test_a_metric_motion_is_as_sure_as_it_says_and_one_camera_less(
    has_scale: bool, degraded: bool, factor: float
) -> None:
    config = GraphConfig(vo_inflation=4.0, vo_degraded_inflation=3.0, vo_floor_deg=0.0, vo_floor_m=0.0)
    record = KeyframeRecord(1, 0, np.eye(4), 1e-4 * np.eye(6), has_scale, degraded, None, None)
    np.testing.assert_allclose(of_vision(record, config), factor**2 * 1e-4 * np.eye(6))
    np.testing.assert_allclose(of_vision(record, config, 2.0), 4.0 * factor**2 * 1e-4 * np.eye(6))
