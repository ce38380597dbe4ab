"""What happens when gtsam does not like a system."""

import gtsam
import numpy as np
import pytest

from vislam.batch import optimize_run
from vislam.batch.bundle import adjust
from vislam.batch.bundle.adjust import solve
from vislam.config import BatchConfig, Config
from vislam.core.errors import DataError
from vislam.factors.keys import X
from worlds.session import simulate

QUICK = Config(batch=BatchConfig(rounds=2, covariances=False))


class _Fussy:
    """Levenberg-Marquardt that rejects healthy systems under Cholesky, as gtsam 4.3.0 does now and then."""

    def __init__(self, graph, values, params):
        if "CHOLESKY" in params.getLinearSolverType():
            raise RuntimeError("\nIndeterminant linear system detected while working near variable")
        self._real = REAL(graph, values, params)

    def __getattr__(self, name):
        return getattr(self._real, name)


REAL = gtsam.LevenbergMarquardtOptimizer


def test_a_system_that_cholesky_rejects_is_solved_by_qr(monkeypatch):
    run = simulate("rgbd", imu=False, duration_s=3.0, true_loops=0)
    usual = optimize_run(run.log, QUICK)
    monkeypatch.setattr(adjust.gtsam, "LevenbergMarquardtOptimizer", _Fussy)
    other = optimize_run(run.log, QUICK)
    assert "CHOLESKY failed" in other.note
    assert np.abs(other.T_map_body - usual.T_map_body).max() < 1e-3


def test_a_system_without_solution_is_a_data_error():
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    graph = gtsam.NonlinearFactorGraph()
    model = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
    bad = gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0.0, 0.0]))
    graph.add(gtsam.PriorFactorPose3(X(0), bad, model))
    with pytest.raises(DataError, match="cannot be optimised"):
        solve(graph, values, [X(0)])


def test_covariances_that_gtsam_cannot_give_are_nan():
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    marginals = adjust.marginals_at(gtsam.NonlinearFactorGraph(), values)
    assert np.isnan(adjust.covariances(marginals, values, 1, False)).all()
    assert adjust.variances(marginals, [X(0)]) is None
