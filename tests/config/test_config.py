import json
import re
from pathlib import Path

import pytest

from vislam.cli import run_verb
from vislam.config import Config, dump, from_data, load, recorded
from vislam.config.profiles import PROFILES
from vislam.config.ranges import settings_of
from vislam.core.errors import UsageError

ROOT = Path(__file__).resolve().parents[2]


def test_defaults_survive_a_round_trip_through_json():
    plain = json.loads(json.dumps(dump(Config())))
    assert from_data(plain, "config.json") == Config()


def test_file_and_overrides_are_layered(tmp_path):
    path = tmp_path / "vislam.toml"
    path.write_text("seed = 3\n[machine]\ngravity_m_s2 = 9.79\n[loop]\nenabled = false\n", encoding="utf-8")
    config = load(path, {"machine.gravity_m_s2": 9.83, "frontend.mode": "mono"})
    assert config.seed == 3
    assert config.machine.gravity_m_s2 == 9.83
    assert config.loop.enabled is False
    assert config.frontend.mode == "mono"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[graph]\nno_such_setting = 1\n", "no setting 'graph.no_such_setting'"),
        ("[frontend]\nmode = 'lidar'\n", "frontend.mode"),
        ("seed = 'three'\n", "seed"),
        ("seed = \n", "cannot be read"),
        ("\x00", "cannot be read"),
    ],
)
def test_wrong_settings_name_the_field_and_the_file(tmp_path, text, message):
    path = tmp_path / "vislam.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=message) as error:
        load(path)
    assert str(path) in str(error.value)


def test_missing_file_is_a_usage_error(tmp_path):
    with pytest.raises(UsageError, match="cannot be read"):
        load(tmp_path / "absent.toml")


def test_a_profile_lies_below_file_and_options(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text("[frontend]\nmax_tracks = 250\n")
    plain, small = load(), load(profile_name="pi")
    assert small.frontend.max_tracks < plain.frontend.max_tracks and not small.view.enabled
    assert small.loop == plain.loop
    both = load(file, profile_name="pi")
    assert both.frontend.max_tracks == 250 and both.frontend.described_features == small.frontend.described_features
    assert load(file, {"view.enabled": True}, "pi").view.enabled
    with pytest.raises(UsageError, match="no profile 'tiny'; there are: pi"):
        load(profile_name="tiny")


@pytest.mark.parametrize("name", PROFILES)
def test_loading_a_profile_twice_gives_the_same(name):
    assert load(profile_name=name) == load(profile_name=name)


def test_names_of_earlier_versions_are_understood_in_files(tmp_path, caplog):
    path = tmp_path / "old.toml"
    path.write_text("[imu]\ngravity_m_s2 = 9.79\n[ekf]\nnonholonomic = true\naxle_m = [-0.3, 0, 0]\n", encoding="utf-8")
    machine = load(path).machine
    assert (machine.gravity_m_s2, machine.slip_sigma_m_s, machine.axle_m) == (9.79, 0.02, (-0.3, 0.0, 0.0))
    assert "imu.gravity_m_s2 is now machine.gravity_m_s2" in caplog.text
    path.write_text("[ekf]\nfloor_sigma_m = 0.01\n[graph]\nfloor_sigma_m = 0.02\n", encoding="utf-8")
    with pytest.raises(UsageError, match=r"both are now machine\.floor_sigma_m"):
        load(path)


def test_settings_recorded_by_an_earlier_version_are_read():
    stored = json.loads(json.dumps(dump(Config())))
    del stored["machine"]
    stored["imu"] |= {"gravity_m_s2": 9.8, "max_gap_s": 0.1}
    stored["graph"] |= {"imu_max_outage_s": 2.0, "no_longer_a_setting": 3}
    stored["window"] |= {"imu_max_outage_s": 1.0}
    config = from_data(recorded(stored, "config.json"), "config.json")
    assert (config.machine.gravity_m_s2, config.machine.max_outage_s) == (9.8, 2.0)


def test_an_option_that_moved_says_where(capsys):
    assert run_verb(["run", "tum:X", "--out", "OUT", "--ekf.no-nonholonomic"]) == 2
    assert "--ekf.no-nonholonomic is now --machine.slip-sigma-m-s" in capsys.readouterr().err


def test_settings_that_docs_and_docstrings_name_exist():
    known = {".".join(setting.path) for setting in settings_of(Config)}
    sections = {path.split(".")[0] for path in known if "." in path}
    elsewhere = {"live.power_up"}  # a counter of metrics.json
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "vislam").rglob("*.py")]
    missing = []
    for page in pages:
        for name in re.findall(r"`(?:--)?([a-z_]+(?:\.[a-z0-9_-]+)+)(?:[ =][^`]*)?`", page.read_text(encoding="utf-8")):
            plain = name.replace("-", "_").replace(".no_", ".")
            module = (ROOT / "vislam").joinpath(*plain.split(".")[:2])
            is_file = (
                name.endswith((".yaml", ".toml", ".json")) or module.is_dir() or module.with_suffix(".py").exists()
            )
            if plain.split(".")[0] in sections and plain not in known | elsewhere and not is_file:
                missing.append(f"{page.relative_to(ROOT)}: {name}")
    assert missing == []
