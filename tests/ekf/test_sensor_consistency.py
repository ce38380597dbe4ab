"""Monte-Carlo: with readings of any sensor the covariance of both filters, own variables included, is what errors are.

Runs are those of `worlds.sensed_paths`, without vision unless said; every value has its band of 99.9 %.
"""

import numpy as np
import pytest
from scipy.stats import chi2

from vislam.core.messages import Array
from vislam.core.readings import OwnStart
from vislam.sensors import Correlated, Sensor, Suite
from worlds import monte_carlo as mc
from worlds.sensed_paths import KINDS, Beacon, Fix, Height, SensedRun, Speed, made

RUNS, FIRST_SEED = 9, 7000


def normalised(error: Array, covariance: Array) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def assert_in_band(what: str, values: list[float], degrees: int) -> None:
    low, high = chi2.ppf([0.0005, 0.9995], degrees * len(values)) / len(values)
    print(f"{what}: {np.mean(values):.2f} of {degrees}, band {low:.2f} .. {high:.2f}, {len(values)} runs")
    assert low < np.mean(values) < high, what


def campaign(
    kind: str, sensors: dict[str, Sensor], every: dict[str, int], duration_s: float = 15.0
) -> tuple[dict[str, list[float]], list[dict[str, tuple[int, float, int]]]]:
    """Return the NEES at the end of each run, by group and sensor, and the statistics of innovations."""
    nees: dict[str, list[float]] = {group: [] for group in (*mc.GROUPS, *sensors)}
    statistics = []
    for i in range(RUNS):
        run = SensedRun.make(FIRST_SEED + i, duration_s, sensors, every)
        k, ekf = list(run.replay(made(kind, Suite(sensors))))[-1]
        state = ekf.state()
        error = run.way.error(k, state)
        for group, rows in mc.GROUPS.items():
            nees[group].append(normalised(error[rows], state.covariance[np.ix_(rows, rows)]))
        for name, sensor in sensors.items():
            if sensor.variables:
                nees[name].append(normalised(run.own[name] - ekf.own(name)[0], ekf.own_covariance(name)))
        statistics.append(ekf.nis_statistics)
        assert ekf.counters["soft_resets"] == 0
    return nees, statistics


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "sensors",
    [
        {"fix": Fix()},
        {"fix": Fix(), "speed": Speed()},
        {"fix": Fix(), "height": Height()},
        {"fix": Fix(), "beacon": Beacon()},
        {"fix": Correlated(Fix(), [0.3], 5.0)},
    ],
    ids="+".join,
)
def test_errors_are_what_the_covariance_says(kind: str, sensors: dict[str, Sensor]) -> None:
    every = {"fix": 100, "speed": 20, "height": 40, "beacon": 20}
    nees, statistics = campaign(kind, sensors, every)
    for group, rows in mc.GROUPS.items():
        assert_in_band(f"{kind} {group}", nees[group], len(rows))
    for name, sensor in sensors.items():
        if sensor.variables:
            assert_in_band(f"{kind} {name}", nees[name], len(sensor.variables))
        count, nis, degrees = np.array([run[name] for run in statistics]).sum(axis=0)
        print(f"{kind} {name}: NIS {nis / degrees:.3f} of {count:.0f} readings")
        assert abs(nis / degrees - 1.0) < 4.0 * np.sqrt(2.0 / degrees)


@pytest.mark.parametrize("kind", KINDS)
def test_own_variables_are_found(kind: str) -> None:
    sensors = {"fix": Fix(), "speed": Speed(), "beacon": Beacon()}
    run = SensedRun.make(FIRST_SEED, 15.0, sensors, {"fix": 40, "speed": 10, "beacon": 10})
    _, ekf = list(run.replay(made(kind, Suite(sensors))))[-1]
    for name, sigma in (("speed", 0.01), ("beacon", 0.1)):
        values, sigmas = ekf.own(name)
        print(name, values, sigmas, run.own[name])
        assert (sigmas < sigma).all()
        assert (np.abs(values - run.own[name]) < 4.0 * sigmas).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_scale_that_is_wrong_and_taken_for_known_is_inconsistent(kind: str) -> None:
    """Why own variables are part of the state: with the scale taken for exact the same readings mislead."""
    honest, sure = [], []
    for i in range(4):
        run = SensedRun.make(FIRST_SEED + i, 10.0, {"speed": Speed()}, {"speed": 20})
        for values, known in ((honest, run.starts), (sure, [OwnStart("speed", np.ones(1), np.zeros(1))])):
            run.starts = known
            k, ekf = list(run.replay(made(kind, Suite({"speed": Speed()}))))[-1]
            state = ekf.state()
            values.append(normalised(run.way.error(k, state)[3:9], state.covariance[3:9, 3:9]))
    print(f"{kind}: {np.mean(honest):.1f} with, {np.mean(sure):.1f} without the scale in the state, of 6")
    assert_in_band("position and velocity", honest, 6)
    assert np.mean(sure) > 3.0 * np.mean(honest)
