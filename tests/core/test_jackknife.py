"""The jackknife: of a mean it is the variance of a mean, and it sees what measurements of one group share."""

import numpy as np
import pytest

from vislam.core.jackknife import jackknife_variances, moves_without


def test_of_a_mean_it_is_the_sample_variance_over_the_count():
    values = np.random.default_rng(3).normal(5.0, 2.0, (40, 2))
    left_out = (values.sum(axis=0) - values) / (len(values) - 1)
    np.testing.assert_allclose(jackknife_variances(left_out), values.var(axis=0, ddof=1) / len(values))


def test_errors_that_a_group_shares_widen_it_and_independent_ones_do_not():
    rng, groups, rows = np.random.default_rng(4), 60, 50
    A = rng.normal(size=(groups, rows, 3))
    informations = np.einsum("gni,gnj->gij", A, A)
    H = informations.sum(axis=0)
    for shared, ratio in ((0.0, 1.0), (1.0, 1.0 + rows)):  # with it each group has an answer of its own, 1 off
        r = rng.normal(size=(groups, rows)) + shared * np.einsum("gni,gi->gn", A, rng.normal(size=(groups, 3)))
        moves = moves_without(H, informations, np.einsum("gni,gn->gi", A, r))
        widened = jackknife_variances(moves) / np.diag(np.linalg.inv(H))
        print(shared, widened)
        assert np.mean(widened) == pytest.approx(ratio, rel=0.25)


def test_one_step_is_exact_where_the_problem_is_linear():
    rng = np.random.default_rng(5)
    A, b = rng.normal(size=(4, 10, 3)), rng.normal(size=(4, 10))
    x = np.linalg.lstsq(A.reshape(-1, 3), b.ravel(), rcond=None)[0]
    informations = np.einsum("gni,gnj->gij", A, A)
    moves = moves_without(informations.sum(axis=0), informations, np.einsum("gni,gn->gi", A, A @ x - b))
    for k in range(4):
        others = np.arange(4) != k
        without = np.linalg.lstsq(A[others].reshape(-1, 3), b[others].ravel(), rcond=None)[0]
        np.testing.assert_allclose(x + moves[k], without)
