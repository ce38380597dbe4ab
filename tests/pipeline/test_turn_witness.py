"""Turns by wheels against the gyroscope's, of a motion whose rates are known exactly."""

import numpy as np
import pytest

from vislam.core import Reading
from vislam.core.messages import ImuSample
from vislam.pipeline.turn_witness import turn_witnesses
from vislam.sensors import Suite, kind_class

HZ = 100


def summary(track_m: float = 0.5, delay_s: float = 0.0, swaps: bool = False, turns: float = 0.6) -> dict[str, float]:
    """Of 60 s with wheels stated 0.5 m apart; the gyroscope has a bias, and one wheel is 2 % larger."""
    [watch], rng = turn_witnesses(Suite({"wheels": kind_class("wheels")()})), np.random.default_rng(1)
    for k in range(60 * HZ):
        t_ns, at_s = 10**18 + k * 10**9 // HZ, k / HZ - delay_s
        rate, forward = turns * np.sin(0.7 * k / HZ), 0.8 + 0.2 * np.sin(0.3 * at_s)
        watch.hear(ImuSample(t_ns, np.array([0.0, 0.0, rate + 0.01]), np.array([0.0, 0.0, 9.81])))
        if k % 5 == 0:
            half = 0.5 * track_m * turns * np.sin(0.7 * at_s)
            speeds = np.array([forward - half, (forward + half) * 1.02]) + rng.normal(0.0, 0.01, 2)
            watch.hear(Reading("wheels", t_ns, speeds[::-1] if swaps else speeds))
    return watch.report().get("turns", {})


@pytest.mark.parametrize(
    ("track_m", "delay_s", "swaps", "factor"),
    [(0.5, 0.0, False, 1.01), (0.6, 0.13, False, 1.21), (0.5, -0.2, True, -1.01)],
)
def test_factor_and_delay_are_those_of_the_motion(track_m: float, delay_s: float, swaps: bool, factor: float) -> None:
    found = summary(track_m, delay_s, swaps)
    print(found)
    assert found["factor"] == pytest.approx(factor, abs=max(4.0 * found["factor_sigma"], 0.01))
    assert found["delay_s"] == pytest.approx(delay_s, abs=max(4.0 * found["delay_sigma_s"], 0.01))
    assert found["factor_sigma"] < 0.02 and found["delay_sigma_s"] < 0.02


def test_a_drive_without_turns_shows_nothing() -> None:
    assert summary(turns=0.01) == {}
