"""The configuration that is written down is the one that ran: what sensors and modes imply is in it."""

import json
from dataclasses import asdict, replace

import pytest

from vislam.config import Config, load
from vislam.core.errors import UsageError
from vislam.core.messages import Frame
from vislam.ekf.filtering import Filtering
from vislam.graph import PoseGraph
from vislam.pipeline import back, front, inertial_stages
from vislam.pipeline.settings import derived
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.sources import open_source, without_idle_cameras
from worlds.mini_recording import write_asl

FLOOR = {"frontend.mode": "planar", "frontend.planar.height_m": 0.3}


def recording(rig="mono"):
    return open_source(f"points:stop-and-go,rig={rig},duration_s=4")


@pytest.mark.parametrize(("rig", "coupling"), [("mono", "tight"), ("stereo", "loose"), ("rgbd", "loose")])
def test_the_stages_get_what_config_json_says(tmp_path, monkeypatch, rig, coupling):
    got = {}

    class SpiedFilter(Filtering):
        def __init__(self, config, *rest):
            got["ekf"] = config
            super().__init__(config, *rest)

    class SpiedGraph(PoseGraph):
        def __init__(self, graph, noise, machine, rig, window, *rest):
            got["graph"], got["window"] = graph, window
            super().__init__(graph, noise, machine, rig, window, *rest)

    def spied_frontend(config, rig, seed):
        got["frontend"] = config
        return make_frontend(config, rig, seed)

    make_frontend = front.make_frontend
    monkeypatch.setattr(inertial_stages, "Filtering", SpiedFilter)
    monkeypatch.setattr(back, "PoseGraph", SpiedGraph)
    monkeypatch.setattr(front, "make_frontend", spied_frontend)
    out = tmp_path / "run"
    prepare(out, overwrite=False)
    config = load(None, {"view.enabled": False, "map.enabled": False, "frontend.readout_s": 0.001})
    execute(recording(rig), config, out, "test", [])
    written = json.loads((out / "config.json").read_text())
    assert written["ekf"]["coupling"] == coupling and written["frontend"]["mode"] == rig
    assert set(got) == {"ekf", "graph", "window", "frontend"}
    for section, settings in got.items():
        assert json.loads(json.dumps(asdict(settings))) == written[section], section


@pytest.mark.parametrize(("mode", "has_map", "cameras"), [("mono", False, 1), ("mono", True, 2), ("stereo", False, 2)])
def test_only_images_that_somebody_looks_at_are_read(tmp_path, mode, has_map, cameras):
    write_asl(tmp_path, frames=4)
    two = open_source(f"euroc:{tmp_path}")
    config = load(None, {"frontend.mode": mode, "map.enabled": has_map})
    frames = [value for value in without_idle_cameras(two, config).events() if isinstance(value, Frame)]
    assert [len(frame.images) for frame in frames] == [cameras] * 4
    assert [frame.index for frame in frames] == [0, 1, 2, 3] and not two.problems


@pytest.mark.parametrize("settings", [{}, {"ekf.coupling": "loose"}, {"ekf.scale_sigma": 0.02}, FLOOR])
@pytest.mark.parametrize("rig", ["mono", "stereo", "rgbd"])
def test_deriving_twice_changes_nothing(settings, rig):
    source = recording(rig)
    once = derived(load(None, settings), source.rig, source.imu_noise)
    assert derived(once, source.rig, source.imu_noise) == once


@pytest.mark.parametrize(("rate_hz", "gap_s"), [(0.0, 0.1), (1.0, 0.1), (5.0, 0.3), (20.0, 0.1), (200.0, 0.1)])
def test_the_time_between_two_samples_of_a_slow_imu_is_no_outage(rate_hz, gap_s):
    source = recording("stereo")
    config = derived(load(None, {}), source.rig, replace(source.imu_noise, rate_hz=rate_hz))
    assert config.machine.max_gap_s == pytest.approx(gap_s)
    wider = derived(load(None, {"machine.max_gap_s": 0.4}), source.rig, replace(source.imu_noise, rate_hz=rate_hz))
    assert wider.machine.max_gap_s == 0.4


def test_over_a_floor_the_height_says_how_sure_metres_are():
    source = recording()
    config = derived(load(None, FLOOR), source.rig, source.imu_noise)
    planar = config.frontend.planar
    assert config.ekf.vo_inflation == planar.vo_inflation
    assert config.ekf.scale_sigma == config.graph.scale_sigma == planar.height_sigma_m / 0.3
    assert config.ekf.coupling == "loose"


def test_what_is_told_is_not_made_surer():
    source = recording()
    noise = replace(source.imu_noise, accelerometer_scale_sigma=0.01)
    config = Config()
    assert derived(config, source.rig, noise).graph.scale_sigma == 0.01
    told = replace(config, graph=replace(config.graph, scale_sigma=0.05))
    assert derived(told, source.rig, noise).graph.scale_sigma == 0.05


def test_wheels_without_slip_need_the_loose_filter():
    source = recording()
    with pytest.raises(UsageError, match="slip"):
        derived(load(None, {"machine.slip_sigma_m_s": 0.02}), source.rig, source.imu_noise)


@pytest.mark.parametrize(("rig", "has_imu", "shares"), [("mono", 1, True), ("mono", 0, False), ("stereo", 1, False)])
def test_edges_share_the_scale_that_the_imu_gives_to_one_camera(rig, has_imu, shares):
    source = recording(rig)
    noise = source.imu_noise if has_imu else None
    assert derived(load(None, {}), source.rig, noise).graph.edges_share_scale is shares
