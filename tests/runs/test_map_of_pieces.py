"""Maps from images where the way between two submaps is not known: in a run, and in yesterday's map."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from vislam.config import load
from vislam.mapping.formats.ply import read_ply
from vislam.mapping.octree.octomap_io import read_octree
from vislam.runs import execute
from vislam.runs.folder import MapChoice, prepare
from vislam.runs.offline.rebuild import map_settings, rebuild
from vislam.runs.session import Session
from vislam.sim import open_world

PRODUCTS = {"cloud.ply", "octomap.bt"}
SETTINGS = {"view.enabled": False, "imu.enabled": False, "map.products": ("cloud", "octomap")}


def run(out, base=None, localize_only=False, settings=None, **options):
    prepare(out, overwrite=False)
    recording = open_world("handheld-room", camera_hz=10.0, image_width_px=240, **options)
    choice = None if base is None else MapChoice(base / "session.db", localize_only)
    return execute(recording, load(None, SETTINGS | (settings or {})), out, "test", [], base=choice)


def occupied_m(path):
    octree = read_octree(path / "map" / "octomap.bt")
    return octree.centres_m()[0][octree.log_odds >= 0]


@pytest.fixture(scope="module")
def yesterday(tmp_path_factory):
    out = tmp_path_factory.mktemp("submaps") / "yesterday"
    run(out, duration_s=6.0)
    return out


def test_what_is_found_in_yesterdays_map_extends_it(yesterday, tmp_path):
    out = tmp_path / "today"
    # another motion in the same room; products and the like do not change clouds
    metrics = run(out, yesterday, settings={"map.cloud_outlier_sigma": 2.4}, seed=1, duration_s=6.0)
    assert metrics["map"]["found_t_s"] is not None
    assert not (out / "map" / "submap_1").exists()
    old, new = occupied_m(yesterday), occupied_m(out)
    assert np.mean(cKDTree(new).query(old)[0] < 0.06) > 0.95
    assert len(new) > 1.1 * len(old)


def test_who_only_looks_for_the_way_leaves_yesterdays_map_as_it_is(yesterday, tmp_path):
    out = tmp_path / "today"
    metrics = run(out, yesterday, localize_only=True, seed=1, duration_s=3.0)
    assert metrics["map"]["found_t_s"] is not None
    assert not (out / "map" / "submap_1").exists()
    points, before = (read_ply(path / "map" / "cloud.ply")[0] for path in (out, yesterday))
    there, back = cKDTree(before).query(points)[0], cKDTree(points).query(before)[0]
    print(
        f"{len(before)} points before, {len(points)} now; 99.9 % apart by {np.quantile([*there, *back], 0.999):.4f} m"
    )
    assert abs(len(points) - len(before)) < 0.002 * len(before)
    voxel_m = (
        0.015  # held poses move by micrometres, and one point in a thousand across a border, where others average it
    )
    assert np.mean(there < voxel_m) > 0.998
    assert np.mean(back < voxel_m) > 0.998


def test_clouds_of_another_shape_are_not_taken_over(yesterday, tmp_path):
    out = tmp_path / "today"
    metrics = run(out, yesterday, settings={"map.pixel_step": 3}, seed=1, duration_s=3.0)
    assert metrics["map"]["found_t_s"] is not None
    assert any("brings no clouds, or of another shape" in warning for warning in metrics["warnings"])
    stored = Session(out / "session.db")
    try:
        new = [i for (i,) in stored.rows("SELECT id FROM scans")]
    finally:
        stored.close()
    assert new
    assert min(new) >= metrics["map"]["keyframes"]


def test_what_is_not_found_in_yesterdays_map_leaves_it_as_it_is(yesterday, tmp_path):
    out = tmp_path / "today"
    metrics = run(out, yesterday, settings={"loop.enabled": False}, seed=1, duration_s=2.0)
    assert metrics["map"]["found_t_s"] is None
    octrees, clouds = ([folder / "map" / name for folder in (yesterday, out)] for name in ("octomap.bt", "cloud.ply"))
    assert octrees[0].read_bytes() == octrees[1].read_bytes()
    (before, colors), (now, colors_now) = map(read_ply, clouds)
    np.testing.assert_allclose(now, before, rtol=0.0, atol=1e-6)  # the last bit of a pose is the processor's
    np.testing.assert_array_equal(colors_now, colors)
    points, _ = read_ply(out / "map" / "submap_1" / "cloud.ply")
    assert len(points) > 1000
    assert any("submap_1" in warning for warning in metrics["warnings"])


def test_a_submap_that_no_loop_joined_has_a_map_of_its_own_also_when_maps_are_made_again(tmp_path):
    out = tmp_path / "run"
    metrics = run(out, settings={"loop.enabled": False}, duration_s=5.0, blank_begin_s=2.0, blank_length_s=1.0)
    assert metrics["counters"]["front"]["submaps"] == 2
    assert {path.name for path in (out / "map" / "submap_1").iterdir()} == PRODUCTS
    answer = rebuild(out, map_settings(out).map, tmp_path / "again", "graph")
    assert json.dumps(answer["left_out"]).count("submap_1") > 0
    for name in [*PRODUCTS, *(f"submap_1/{name}" for name in PRODUCTS)]:
        assert (out / "map" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
