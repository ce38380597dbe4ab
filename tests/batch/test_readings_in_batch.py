"""Readings of further sensors in `vislam optimize RUN`: what they add, what is told of them, and without their file."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from session_entries import editing
from vislam.config import BatchConfig
from vislam.runs.offline.optimize_run import optimize
from vislam.sensors.toml import load_sensor_setup
from worlds.sensed_drive import driven as sensed

CONFIG = BatchConfig()


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, for a batch writes into its run."""
    levered = sensed(tmp_path_factory, "levered")
    folder = tmp_path_factory.mktemp("driven") / "levered"
    shutil.copytree(levered.sensors.parent, folder)
    return folder


@pytest.fixture(scope="module")
def entry(driven: Path) -> dict[str, Any]:
    return optimize(driven / "run", CONFIG)


def test_readings_are_factors_and_own_variables_are_found(driven: Path, entry: dict[str, Any]) -> None:
    setup = load_sensor_setup(driven / "cart.toml")
    assert not [warning for warning in entry["warnings"] if "readings" in warning]
    for number, name in enumerate(setup.simulated_hz):  # own variables are drawn with the run's seed, 0
        found, variables = entry["sensors"][name], setup.suite[name].variables
        counts = found["readings"]
        assert counts["used"] > 20 and counts["failed"] == counts["early"] == 0
        assert counts["outliers"] < 0.1 * counts["used"]
        assert found["variables"] == [variable.name for variable in variables]
        draws = np.random.default_rng([0, number]).normal(size=len(variables))
        for variable, draw, value, sigma in zip(variables, draws, found["values"], found["sigmas"], strict=True):
            assert 0.0 < sigma < variable.sigma
            if variable.of_machine:  # the rest hangs on where the estimate's world is
                print(name, variable.name, value, sigma, variable.start + variable.sigma * draw)
                assert abs(value - variable.start - variable.sigma * draw) < 4.0 * sigma


def test_without_their_file_the_batch_says_so_and_goes_by_the_rest(
    driven: Path, entry: dict[str, Any], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(driven / "run", run)
    with editing(run / "session.db") as database:
        moved = "UPDATE info SET value = replace(value, 'cart.toml', 'moved.toml') WHERE key = 'config'"
        assert database.execute(moved).rowcount == 1
    without = optimize(run, CONFIG)
    assert [
        w for w in without["warnings"] if "goes without the readings of gnss, height, wheels" in w and "moved.toml" in w
    ]
    assert without["sensors"] == {}
    rmse_m = [found["accuracy"]["se3"]["ate_rmse_m"] for found in (entry, without)]
    print("ATE with and without [m]:", rmse_m)
    assert rmse_m[0] < rmse_m[1] + 0.003
    assert rmse_m[0] != rmse_m[1]


def test_two_batches_give_identical_bytes(driven: Path, entry: dict[str, Any]) -> None:
    optimize(driven / "run", CONFIG, "again")
    for name in ("trajectory_{}.tum", "states_{}.csv"):
        first, second = ((driven / "run" / name.format(which)).read_bytes() for which in ("batch", "again"))
        assert first == second
    again = json.loads((driven / "run" / "metrics.json").read_text())["batch"]["again"]
    assert again["sensors"] == entry["sensors"]
