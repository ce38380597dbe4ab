import numpy as np
import pytest

from vislam.factors.loop_evidence import SOUND, entering, innovation, log_volume


def test_the_volume_is_that_of_the_box_and_of_all_rotations() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [2.0, 4.0, 0.0]])  # no side is below a tenth of the longest
    assert log_volume(corners) == pytest.approx(np.log(2.0 * 4.0 * 0.4 * 8.0 * np.pi**2))
    assert log_volume(corners[:, :2]) == pytest.approx(np.log(2.0 * 4.0 * 2.0 * np.pi))


def test_an_innovation_is_gaussian() -> None:
    S, r = np.array([[[2.0, 0.5], [0.5, 1.0]]]), np.array([[0.3, -0.7]])
    (chi2,), (log_density,) = innovation(r, S)
    density = np.exp(-0.5 * r[0] @ np.linalg.inv(S[0]) @ r[0]) / np.sqrt(np.linalg.det(2.0 * np.pi * S[0]))
    assert np.exp(log_density - 0.5 * chi2) == pytest.approx(density)


def test_lower_rungs_come_once_there_is_nothing_above() -> None:
    assert [entering(np.array(e), 0)[0].tolist() for e in ([20.0, 9.0], [3.0, 9.0])] == [[True, False], [False, True]]
    assert entering(np.array([3.0]), 0)[0].any()
    assert not entering(np.array([3.0]), 0, SOUND)[0].any()
