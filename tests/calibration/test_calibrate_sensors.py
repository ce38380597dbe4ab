"""What a run found of its further sensors is what the next run begins with."""

import json
from pathlib import Path

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.core.errors import UsageError
from vislam.sensors.toml import load_sensor_setup
from worlds.calibration import refusal
from worlds.sensed_drive import OF
from worlds.sensed_drive import driven as sensed


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sensed(tmp_path_factory, "levered").sensors.parent


@pytest.fixture(scope="module")
def known(driven: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("known") / "calibration"
    assert run_verb(["calibrate", "sensors", str(driven / "run"), "--out", str(out)]) == 0
    return out


def test_the_next_run_begins_with_what_this_one_found(driven: Path, known: Path, tmp_path: Path) -> None:
    before = load_sensor_setup(driven / "cart.toml").suite
    (tmp_path / "cart.toml").write_text(OF["levered"] + (known / "sensors.toml").read_text())
    after = load_sensor_setup(tmp_path / "cart.toml").suite
    metrics = json.loads((driven / "run" / "metrics.json").read_text())["sensors"]
    report = json.loads((known / "sensors.json").read_text())
    taken = 0
    for name in before.names:
        entry = metrics[name]["graph"]
        found = zip(before[name].variables, after[name].variables, entry["values"], entry["sigmas"], strict=True)
        for old, new, value, sigma in found:
            if report[name][old.name]["left_out"]:
                assert new == old
            else:
                assert (new.start, new.sigma) == (value, sigma)
                assert sigma < 0.5 * old.sigma
                taken += 1
    assert taken >= 4, "both wheels, and the lever arm in the plane; on a level floor nothing tells its height"
    assert report["gnss"]["lever_z_m"]["left_out"] == "not learnt in this run"
    assert report["height"]["offset_m"]["left_out"] == "of that run's world"
    assert all(report["gnss"][name]["left_out"] for name in ("yaw_rad", "x_m", "y_m", "z_m"))


def test_what_is_known_is_within_four_sigmas_of_the_truth(driven: Path, known: Path) -> None:
    setup, report = load_sensor_setup(driven / "cart.toml"), json.loads((known / "sensors.json").read_text())
    for number, name in enumerate(setup.simulated_hz):  # own variables are drawn with the run's seed, 0
        variables = setup.suite[name].variables
        draws = np.random.default_rng([0, number]).normal(size=len(variables))
        for variable, draw in zip(variables, draws, strict=True):
            entry = report[name][variable.name]
            if not entry["left_out"]:
                print(name, variable.name, variable.start + variable.sigma * draw, entry)
                assert abs(entry["value"] - variable.start - variable.sigma * draw) < 4.0 * entry["sigma"]


def metrics_of(folder: Path, sensors: object, file: Path | None) -> Path:
    """A finished run that says so of its sensors."""
    folder.mkdir()
    (folder / "metrics.json").write_text(json.dumps({"sensors": sensors}))
    (folder / "config.json").write_text(json.dumps({"sensors": {"file": None if file is None else str(file)}}))
    return folder


WHEELS = ["scale_left", "scale_right", "track_width_m"]
UNLEARNT = {"begun": True, "variables": WHEELS, "graph": {"values": [1.0, 1.0, 0.5], "sigmas": [1.0, 1.0, 1.0]}}


@pytest.mark.parametrize(
    ("sensors", "code", "message"),
    [
        ({}, 3, "was that file changed"),
        ({"other": {}}, 3, "was that file changed"),
        ({"wheels": {**UNLEARNT, "variables": ["a", "b", "c"]}}, 3, "other variables"),
        ({"wheels": {**UNLEARNT, "graph": {"values": [1.0], "sigmas": [None]}}}, 3, "estimates that are none"),
        ({"wheels": UNLEARNT}, 3, "wheels: track_width_m is not learnt in this run"),
        ({"wheels": {"begun": False, "variables": WHEELS}}, 3, "none of them has variables"),
    ],
)
def test_runs_that_say_nothing_are_refused_in_one_line(
    sensors: object, code: int, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "cart.toml"
    file.write_text('[sensors.wheels]\nkind = "wheels"\nsimulated_hz = 20.0\n')
    run = metrics_of(tmp_path / "run", sensors, file)
    assert message in refusal(capsys, "sensors", run, "--out", tmp_path / "calibration", code=code)
    assert not (tmp_path / "calibration").exists()


def test_a_folder_without_a_run_or_without_sensors_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "is no finished run" in refusal(capsys, "sensors", tmp_path, "--out", tmp_path / "calibration", code=2)
    run = metrics_of(tmp_path / "run", {}, None)
    assert "had no further sensors" in refusal(capsys, "sensors", run, "--out", tmp_path / "calibration", code=2)


def test_what_is_called_known_must_be_there(tmp_path: Path) -> None:
    file = tmp_path / "cart.toml"
    file.write_text('[sensors.wheels]\nkind = "wheels"\n[sensors.wheels.known]\nradius_m = [0.1, 0.01]\n')
    with pytest.raises(UsageError, match="no own variable 'radius_m' with these settings; there are: scale_left"):
        load_sensor_setup(file)
