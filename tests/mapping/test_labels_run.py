"""Labels through a whole run: from images in a folder into the session, the map's files, the report and answers."""

import json
import shutil

import cv2
import numpy as np
import pytest

from session_entries import editing
from vislam.cli import run_verb
from vislam.config import Config, ImuConfig, LabelConfig, MapConfig, ViewConfig
from vislam.core.errors import DataError
from vislam.mapping.formats.ply import read_ply_rows
from vislam.mapping.semantic.classes import LabelClasses
from vislam.mapping.semantic.layer_files import read_layer
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.offline.rebuild import map_settings, rebuild
from vislam.runs.session import Session
from vislam.runs.sources import open_source
from vislam.sim import open_world
from vislam.sim.scene import NAMES
from vislam.sim.worlds.simulation import write_labels
from vislam.slam import Slam

WORLD = {"duration_s": 4.0, "camera_hz": 5.0, "image_width_px": 160}
SOURCE = "sim:handheld-room," + ",".join(f"{name}={value}" for name, value in WORLD.items())


@pytest.fixture(scope="module")
def labels(tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    write_labels(open_world("handheld-room", **WORLD), folder)
    return folder


def run_with(out, folder):
    config = Config(
        imu=ImuConfig(enabled=False),
        map=MapConfig(products=("cloud", "octomap"), labels=LabelConfig(None if folder is None else str(folder))),
        view=ViewConfig(enabled=False),
    )
    prepare(out, False)
    metrics = execute(open_source(SOURCE, 0), config, out, source=SOURCE, command=["test"])
    return out, metrics


@pytest.fixture(scope="module")
def run(tmp_path_factory, labels):
    return run_with(tmp_path_factory.mktemp("run") / "run", labels)[0]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return run_with(tmp_path_factory.mktemp("run") / "plain", None)[0]


def contents(folder, names):
    return {name: (folder / name).read_bytes() for name in names}


def test_simulated_label_images_are_exact_and_named(labels):
    world = open_world("handheld-room", **WORLD)
    frame = world.render(7)
    seen = cv2.imread(str(labels / f"{frame.t_ns}.png"), cv2.IMREAD_UNCHANGED)
    assert seen.shape == frame.images[0].shape
    np.testing.assert_array_equal(seen, world.labels(7)[1])
    assert (seen > 0).all()
    names = LabelClasses.read(labels / "labels.toml")
    assert [names[i].name for i in range(1, 1 + len(NAMES))] == list(NAMES)
    assert len(list(labels.glob("*.png"))) == world.frame_count


def test_a_run_with_label_images_has_a_labelled_map_and_all_else_is_as_without(run, plain):
    layer = read_layer(run / "map")
    there = {layer.classes[i].name for i in np.unique(layer.labels).tolist()}
    assert {"door", "wall", "poster"} <= there
    data = json.loads((run / "map" / "labels.json").read_text())
    assert sum(one["voxels"] for one in data["classes"]) == len(layer)
    assert (read_ply_rows(run / "map" / "cloud.ply")["label"] > 0).mean() > 0.8
    assert contents(run / "map", ["octomap.bt"]) == contents(plain / "map", ["octomap.bt"])
    assert not (plain / "map" / "labels.json").exists()
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["warnings"] == json.loads((plain / "metrics.json").read_text())["warnings"]


def test_a_session_keeps_labels_and_the_map_is_made_of_it_again(run, labels, tmp_path):
    answer = rebuild(run, map_settings(run).map, tmp_path, "graph")
    assert answer["depth"] == "session"
    assert answer["labels"]["keyframes labelled"] == answer["keyframes"]
    names = ["labels.ply", "labels.json", "cloud.ply"]
    assert contents(tmp_path, names) == contents(run / "map", names)
    session = Session(run / "session.db")
    assert all(scan.labels_png for scan in session.scans().values())
    session.close()


def test_a_run_without_labels_gets_them_later(run, plain, labels, tmp_path, capsys):
    copy = shutil.copytree(plain, tmp_path / "run")
    assert run_verb(["map", str(copy), "--labels.folder", str(labels)]) == 0
    assert "keyframes labelled: " in capsys.readouterr().out
    names = ["labels.ply", "labels.json", "cloud.ply"]
    assert contents(copy / "map", names) == contents(run / "map", names)
    assert run_verb(["map", str(copy), "--edge-px", "3", "--labels.folder", str(labels)]) == 0  # by the recording
    assert len(read_layer(copy / "map")) > 1000
    assert run_verb(["map", str(copy)]) == 0  # with the run's own settings
    assert not (copy / "map" / "labels.ply").exists()


def test_some_keyframes_without_labels_are_said(plain, labels, tmp_path):
    some = tmp_path / "some"
    some.mkdir()
    shutil.copy(labels / "labels.toml", some)
    images = sorted(labels.glob("*.png"))
    for image in images[: len(images) // 2]:
        shutil.copy(image, some)
    (some / image.name).write_bytes(b"cut")
    _, metrics = run_with(tmp_path / "run", some)
    assert any("keyframes without a label image; log.txt names the first" in text for text in metrics["warnings"])
    assert len(read_layer(tmp_path / "run" / "map")) > 100


def test_labels_that_are_no_folder_end_a_run_at_its_beginning(tmp_path):
    with pytest.raises(DataError, match=r"labels\.toml is not there"):
        run_with(tmp_path / "run", tmp_path / "absent")


def test_the_nearest_thing_is_asked_on_the_command_line(run, plain, capsys):
    assert run_verb(["map", str(run), "--nearest", "door", "--from", "0.5", "0", "0", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["from_m"] == [0.5, 0.0, 0.0]
    assert 0.0 < answer["nearest_m"] < 5.0
    assert answer["thing"]["voxels"] > 100
    assert run_verb(["map", str(run), "--nearest", "door"]) == 0
    assert "nearest_at_m: [" in capsys.readouterr().out
    assert run_verb(["map", str(run), "--nearest", "dragon"]) == 2
    assert "no voxel of the map is labelled 'dragon'; there are: " in capsys.readouterr().err
    assert run_verb(["map", str(run), "--nearest", "door", "--from", "nan", "0", "0"]) == 2
    assert run_verb(["map", str(plain), "--nearest", "door"]) == 3
    assert "the map has no labels" in capsys.readouterr().err


def test_damaged_labels_of_a_session_are_refused(run, tmp_path):
    copy = shutil.copytree(run, tmp_path / "run")
    with editing(copy / "session.db") as db:
        db.execute("UPDATE labels SET png = ? WHERE id = 1", (bytes(cv2.imencode(".png", np.ones((3, 3)))[1]),))
    with pytest.raises(DataError, match="labels are no image of the size of its depth"):
        rebuild(copy, map_settings(copy).map, tmp_path / "out", "graph")


def test_a_network_in_the_pipeline_labels_keyframes(run, labels):
    world = open_world("handheld-room", **WORLD)

    class Network:
        classes = LabelClasses.of({"1": "thing"}, "test")

        def __init__(self):
            self.stamps = []

        def __call__(self, frame, camera_t_ns):
            self.stamps.append(camera_t_ns)
            return np.ones(frame.images[0].shape, np.uint8) if len(self.stamps) % 2 else None

    network, config = Network(), Config(imu=ImuConfig(enabled=False))
    slam = Slam(config, world.rig, labeller=network)
    for value in world.events():
        slam.feed(value)
    slam.finish()
    mapper = slam.back.mapper
    layer = mapper.labels()
    assert (layer.labels == 1).all()
    assert len(layer) > 500
    assert set(network.stamps) <= set(world.truth().t_ns.tolist())
    assert slam.back.counters["map"]["keyframes_labelled"] == (len(network.stamps) + 1) // 2
