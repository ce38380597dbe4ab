"""Maps from images where the way between two pieces of trajectory is not known: in a run, and in yesterday's map."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from vislam.config import load
from vislam.mapping.octomap_io import read_octree
from vislam.mapping.ply import read_ply
from vislam.offline.rebuild import map_settings, rebuild
from vislam.run import execute
from vislam.runfolder import MapChoice, prepare
from vislam.sim import open_world

PRODUCTS = {"cloud.ply", "octomap.bt"}
SETTINGS = {"view.enabled": False, "imu.enabled": False, "map.products": ("cloud", "octomap")}


def run(out, base=None, loops=True, **options):
    prepare(out, overwrite=False)
    recording = open_world("handheld-room", camera_hz=10.0, image_width_px=320, **options)
    choice = None if base is None else MapChoice(base / "session.db", False)
    return execute(recording, load(None, {**SETTINGS, "loop.enabled": loops}), out, "test", [], None, choice)


def occupied_m(path):
    octree = read_octree(path / "map" / "octomap.bt")
    return octree.centres_m()[0][octree.log_odds >= 0]


@pytest.fixture(scope="module")
def yesterday(tmp_path_factory):
    out = tmp_path_factory.mktemp("pieces") / "yesterday"
    run(out, duration_s=6.0)
    return out


def test_what_is_found_in_yesterdays_map_extends_it(yesterday, tmp_path):
    out = tmp_path / "today"
    metrics = run(out, yesterday, seed=1, duration_s=6.0)  # another motion in the same room
    assert metrics["map"]["found_t_s"] is not None
    assert not (out / "map" / "piece_1").exists()
    old, new = occupied_m(yesterday), occupied_m(out)
    assert np.mean(cKDTree(new).query(old)[0] < 0.06) > 0.95
    assert len(new) > 1.1 * len(old)


def test_what_is_not_found_in_yesterdays_map_leaves_it_as_it_is(yesterday, tmp_path):
    out = tmp_path / "today"
    metrics = run(out, yesterday, loops=False, seed=1, duration_s=2.0)
    assert metrics["map"]["found_t_s"] is None
    for name in PRODUCTS:
        assert (out / "map" / name).read_bytes() == (yesterday / "map" / name).read_bytes(), name
    points, _ = read_ply(out / "map" / "piece_1" / "cloud.ply")
    assert len(points) > 1000
    assert any("piece_1" in warning for warning in metrics["warnings"])


def test_a_piece_that_no_loop_joined_has_a_map_of_its_own_also_when_maps_are_made_again(tmp_path):
    out = tmp_path / "run"
    metrics = run(out, loops=False, duration_s=5.0, blank_begin_s=2.0, blank_length_s=1.0)
    assert metrics["counters"]["front"]["pieces"] == 2
    assert {path.name for path in (out / "map" / "piece_1").iterdir()} == PRODUCTS
    answer = rebuild(out, map_settings(out).map, tmp_path / "again", "graph", None)
    assert json.dumps(answer["left_out"]).count("piece_1") > 0
    for name in [*PRODUCTS, *(f"piece_1/{name}" for name in PRODUCTS)]:
        assert (out / "map" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
