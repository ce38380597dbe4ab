import json

import pytest

from vislam.config import Config, dump, from_data, load
from vislam.config.profiles import PROFILES
from vislam.core.errors import UsageError


def test_defaults_survive_a_round_trip_through_json():
    plain = json.loads(json.dumps(dump(Config())))
    assert from_data(plain, "config.json") == Config()


def test_file_and_overrides_are_layered(tmp_path):
    path = tmp_path / "vislam.toml"
    path.write_text("seed = 3\n[imu]\ngravity_m_s2 = 9.79\n[loop]\nenabled = false\n", encoding="utf-8")
    config = load(path, {"imu.gravity_m_s2": 9.83, "frontend.mode": "mono"})
    assert config.seed == 3
    assert config.imu.gravity_m_s2 == 9.83
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
