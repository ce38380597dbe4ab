"""What the interactive view of a report is given of a map's labels."""

import base64
import json

import numpy as np
import pytest

from run_folder import make_run
from vislam.mapping.semantic.classes import LabelClasses
from vislam.mapping.semantic.layer import LabelLayer
from vislam.mapping.semantic.layer_files import write_layer
from vislam.mapping.semantic.votes import voxel_keys
from vislam.runs.report.run_files import read_run
from vislam.runs.report.scene import build_scene
from vislam.runs.report.view_data import label_data

CLASSES = LabelClasses.of({str(i): f"class {i}" for i in range(1, 31)}, "test")


def layer_of(count: int, classes: int = 30) -> LabelLayer:
    rng = np.random.default_rng(3)
    keys = np.unique(voxel_keys(rng.uniform([-8, -5, 0], [8, 5, 2], (count, 3)), 0.05))
    labels = (1 + np.arange(len(keys)) % classes).astype(np.uint16)
    ones = np.ones(len(keys), np.int32)
    return LabelLayer(0.05, CLASSES, keys, labels, ones, ones)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "cart")


def test_a_map_without_labels_has_none_in_its_report(run):
    files = read_run(run)
    assert label_data(files, build_scene(files)) == {}
    assert files.unread == {}


def test_voxels_stand_where_the_map_has_them_and_small_classes_share_a_switch(run):
    layer = layer_of(4000)
    write_layer(run / "map", layer)
    files = read_run(run)
    scene = build_scene(files)
    data = label_data(files, scene)
    assert (data["count"], data["of"]) == (len(layer), len(layer))
    assert len(data["classes"]) == 17
    assert data["classes"][-1]["name"] == "all other labels"
    cells = np.concatenate([np.frombuffer(base64.b64decode(one["xyz"]), "<u2") for one in data["classes"]])
    placed = np.array(data["low"]) + np.array(data["step"]) * cells.reshape(-1, 3)
    S = scene.S_scene_map
    expected = layer.points_m @ S[:3, :3].T + S[:3, 3]
    np.testing.assert_allclose(np.sort(placed[:, 0]), np.sort(expected[:, 0]), atol=0.001)
    assert json.dumps(data) == json.dumps(label_data(files, scene))
    thinned = label_data(files, scene, most=100)
    assert (thinned["count"], thinned["of"]) == (100, len(layer))


def test_damaged_labels_are_left_out_and_named(run):
    write_layer(run / "map", layer_of(100))
    (run / "map" / "labels.ply").write_bytes(b"ply\n")
    files = read_run(run)
    assert label_data(files, build_scene(files)) == {}
    assert "labels.ply" in files.unread["map/labels.json"]
