"""Medians and quantiles are numpy's, to the last bit; chi-square is that of tables."""

import numpy as np
import pytest

from vislam.core.chi_square import chi_square_limit, chi_square_limits, chi_square_tail
from vislam.core.quantiles import median, quantile

SEED = 3


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 30, 101, 300])
def test_they_are_those_of_numpy(count):
    rng = np.random.default_rng(SEED)
    print(f"seed {SEED}")
    for power in range(-6, 7):
        values = rng.normal(size=count) * 10.0**power
        values[rng.integers(count)] = values[0]
        before = values.copy()
        assert median(values) == np.median(values)
        np.testing.assert_array_equal(values, before)
        for share in (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0):
            assert quantile(np.sort(values), share) == np.quantile(values, share)


def test_limits_and_tails_of_chi_square_are_those_of_tables():
    for degrees, limit in ((1, 3.841459), (3, 7.814728), (6, 12.591587)):
        assert chi_square_limit(0.95, degrees) == pytest.approx(limit, rel=1e-6)
        assert chi_square_limits(0.95, np.array([degrees])) == pytest.approx([limit], rel=1e-6)
        assert chi_square_tail(limit, degrees) == pytest.approx(0.05, rel=1e-6)
