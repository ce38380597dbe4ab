"""Readings that err together are noticed by what the filter finds them off by, with a value; others are not."""

import numpy as np
import pytest

from vislam.config import VerdictConfig
from vislam.core.readings import Reading
from vislam.runs.verdict import Evidence, judge
from vislam.sensors import Correlated, Sensor, Suite
from worlds.sensed_paths import KINDS, Beacon, Fix, Height, SensedRun, Speed, made

EVERY = {"fix": 40, "height": 40, "beacon": 20, "speed": 20}


@pytest.mark.parametrize("kind", KINDS)
def test_sensors_that_err_as_they_are_stated_are_not_suspected(kind: str) -> None:
    sensors: dict[str, Sensor] = {"fix": Fix(), "height": Height(), "beacon": Beacon(), "speed": Speed()}
    for seed in range(4 if kind == "loose" else 1):
        run = SensedRun.make(9100 + seed, 40.0, sensors, EVERY)
        _, ekf = list(run.replay(made(kind, Suite(sensors))))[-1]
        assert not {name: error for name, error in ekf.shared_errors.items() if error.excess > 2.0}


class Coarse(Fix):
    """Fixes by a sigma that is right of their whole error."""

    sigma_m = 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_fixes_that_err_together_are_found_with_their_sigma_and_time(kind: str) -> None:
    """The filter that is given both takes them for white."""
    truth: dict[str, Sensor] = {"fix": Correlated(Fix(), [0.5], 10.0), "speed": Speed()}
    sigmas, times = [], []
    for seed in range(4 if kind == "loose" else 1):
        run = SensedRun.make(9200 + seed, 60.0, truth, EVERY)
        _, ekf = list(run.replay(made(kind, Suite(truth))))[-1]
        assert all(error.excess < 2.0 for error in ekf.shared_errors.values())
        run.starts = [start for start in run.starts if start.sensor != "fix"]
        _, ekf = list(run.replay(made(kind, Suite({"fix": Coarse(), "speed": Speed()}))))[-1]
        nis = ekf.nis_statistics["fix"]
        assert nis[1] < 1.2 * nis[2], "its size does not show it"
        found = ekf.shared_errors["fix"]
        assert found.excess > 4.0 and set(ekf.shared_errors) == {"fix"}
        assert found == ekf.shared_errors["fix"], "asking changes nothing"
        sigmas.append(found.sigmas)
        times.append(found.correlation_s)
    print(np.round(sigmas, 2).tolist(), np.round(times, 1))
    assert np.all(np.abs(np.log(np.array(sigmas) / 0.5)) < np.log(1.5))
    assert 5.0 < np.mean(times) < 20.0


def test_too_few_readings_say_nothing() -> None:
    run = SensedRun.make(9300, 10.0, {"fix": Fix()}, {"fix": 40})
    run.readings = [Reading("fix", one.t_ns, one.values + 0.1) for one in run.readings]
    _, ekf = list(run.replay(made("loose", Suite({"fix": Fix()}))))[-1]
    assert ekf.shared_errors == {}


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            (31.97, (0.5, 0.5, 0.5), 17.2),
            "err together for 17 s|32.0 times|correlated_sigma = 0.5 and correlation_s = 17",
        ),
        ((4.0, (1.5, 1.45, 3.0), 60.0), "[sensors.gnss] correlated_sigma = [1.5, 1.4, 3] and correlation_s = 60"),
        ((1.9, (1.5,), 60.0), ""),
        ((4.0, (1.5,), 1.5), ""),
    ],
)
def test_the_verdict_names_the_sensor_and_what_to_give_it(error: tuple, words: str) -> None:
    reasons = "; ".join(judge(Evidence(shared_errors={"gnss": error}), VerdictConfig()).reasons)
    assert all(word in reasons for word in words.split("|")) and bool(reasons) == bool(words)
