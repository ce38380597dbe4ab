from dataclasses import replace

import cv2
import numpy as np
import pytest

from vislam.config import LabelConfig
from vislam.core.camera import Camera
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import se3_exp
from vislam.core.messages import GraphUpdate
from vislam.mapping.formats.ply import read_ply, read_ply_rows
from vislam.mapping.mapper import Mapper
from vislam.mapping.semantic.classes import LabelClasses
from vislam.mapping.semantic.images import LabelFolder, checked
from vislam.mapping.semantic.layer import LabelLayer
from vislam.mapping.semantic.layer_files import read_layer, write_layer
from vislam.mapping.semantic.query import describe_nearest, label_at, nearest, things_of
from vislam.mapping.semantic.votes import VoxelVotes, voxel_centres, voxel_keys
from worlds.box import CAMERA, CONFIG, RIG, ROOM_HIGH, ROOM_LOW, T_BODY_CAM0, depth_image, keyframe, pose

SIDE, OTHER, WALL = 1, 2, 300
CLASSES = LabelClasses.of({"1": "side", "2": "other", "300": {"name": "wall", "color": [9, 8, 7]}}, "test")
DRIFT = [se3_exp(np.array([0.0, 0.0, 0.02 * k, 0.05 * k, -0.03 * k, 0.0])) for k in range(8)]


def label_image(T_map_body):
    """What each pixel of the box-shaped room shows: a wall across x, a side across y, or another surface."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    T = T_map_body @ T_BODY_CAM0
    points = (rays * depth_image(T_map_body).reshape(-1, 1)) @ T[:3, :3].T + T[:3, 3]
    return LABEL_OF_AXIS[across(points)].reshape(CAMERA.height, CAMERA.width)


LABEL_OF_AXIS = np.array([WALL, SIDE, OTHER], np.uint16)


def across(points):
    """The axis [N] that the nearest surface of the room lies across."""
    return np.minimum(np.abs(points - ROOM_LOW), np.abs(points - ROOM_HIGH)).argmin(axis=1)


def away_from_edges(points):
    to_surface = np.minimum(np.abs(points - ROOM_LOW), np.abs(points - ROOM_HIGH))
    return np.sort(to_surface, axis=1)[:, 1] > 0.1


def mapped(poses, labels=label_image, config=CONFIG, true=True):
    mapper = Mapper(config, RIG, names=CLASSES)
    for k, T in enumerate(poses):
        seen = labels(pose(k))
        mapper.add(keyframe(k, T if true else pose(k), None if true else depth_image(pose(k))), T, seen)
    return mapper


def same(first, second):
    for name in ("keys", "labels", "votes", "total"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@pytest.fixture(scope="module")
def room():
    return mapped([pose(k) for k in range(8)])


@pytest.fixture(scope="module")
def layer(room):
    return room.labels()


def test_voxels_have_the_label_of_the_surface_in_them(layer):
    assert len(layer) > 2000
    flat = away_from_edges(layer.points_m)
    assert flat.mean() > 0.8
    assert (layer.labels[flat] == LABEL_OF_AXIS[across(layer.points_m[flat])]).all()
    assert set(layer.labels[flat].tolist()) == {SIDE, OTHER, WALL}
    assert (layer.votes <= layer.total).all()
    assert layer.total.max() <= 8
    assert layer.total.max() == 3
    assert (np.diff(layer.keys) > 0).all()


def test_each_keyframe_has_one_vote_per_voxel():
    votes = VoxelVotes(0.1, 100)
    points = np.array([[0.05, 0.05, 0.05]] * 5 + [[0.35, 0.05, 0.05]], np.float32)
    votes.add(points, np.array([7, 7, 3, 3, 0, 0], np.uint16))  # equal: the lower id; 0 says nothing
    votes.add(points, np.array([7, 3, 7, 7, 7, 0], np.uint16))
    votes.add(points[:1], np.array([7], np.uint16))
    keys, counted = votes.voxels()
    np.testing.assert_allclose(voxel_centres(keys, 0.1), [[0.05, 0.05, 0.05]])
    ids, counts = counted.winners()
    assert (ids.tolist(), counts.tolist(), counted.total.tolist()) == ([7], [2], [3])


def test_what_a_fifth_of_the_votes_are_for_is_never_lost():
    rng = np.random.default_rng(2)
    votes = VoxelVotes(0.1, 10)
    said = np.r_[np.full(45, 9), rng.integers(10, 60000, 55)]
    for label in rng.permutation(said):
        votes.add(np.zeros((1, 3), np.float32), np.array([label], np.uint16))
    _, counted = votes.voxels()
    ids, counts = counted.winners()
    assert ids[0] == 9
    assert 45 - 20 <= counts[0] <= 45
    assert counted.total[0] == 100


def test_memory_is_bounded_and_what_found_no_room_is_counted():
    votes = VoxelVotes(0.1, 50)
    points = np.stack([0.1 * np.arange(80) + 0.05, np.zeros(80), np.zeros(80)], axis=1).astype(np.float32)
    votes.add(points, np.ones(80, np.uint16))
    votes.add(points, np.ones(80, np.uint16))
    keys, counted = votes.voxels()
    assert (len(keys), votes.refused) == (50, 60)
    assert (counted.total == 2).all()


def test_points_that_are_nowhere_have_no_voxel():
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e30, 0, 0], [-1700.0, 0, 0], [-0.01, 0, 0]], np.float32)
    assert (voxel_keys(points, 0.05) >= 0).tolist() == [False, False, False, False, True]


def test_labels_move_with_keyframes_as_if_made_from_scratch(room):
    true, drifted = [pose(k) for k in range(8)], [pose(k) @ D for k, D in enumerate(DRIFT)]
    moved = mapped(drifted, true=False)
    before = moved.labels()
    moved.move(GraphUpdate(1, np.arange(8), np.array(true), np.eye(4), None))
    moved.finish()
    same(moved.labels(), room.labels())
    assert len(before) != len(room.labels())
    surfels = [mapper.surfels() for mapper in (moved, room)]
    for name in ("labels", "label_votes", "label_total"):
        np.testing.assert_array_equal(*(getattr(one, name) for one in surfels))


def test_labels_asked_for_in_between_change_nothing(room):
    mapper = Mapper(CONFIG, RIG, names=CLASSES)
    for k in range(8):
        mapper.add(keyframe(k), pose(k), label_image(pose(k)))
        mapper.labels()
    same(mapper.labels(), room.labels())


def test_surfels_have_the_label_of_their_surface(room):
    surfels = room.surfels()
    flat = away_from_edges(surfels.points_m)
    assert flat.sum() > 1000
    assert (surfels.labels[flat] == LABEL_OF_AXIS[across(surfels.points_m[flat])]).all()
    assert (surfels.label_votes <= surfels.label_total).all()
    assert (surfels.label_total <= surfels.views).all()


def test_wrong_images_are_outvoted():
    def wrong_first(T):
        labels = label_image(T)
        return np.full_like(labels, OTHER) if np.array_equal(T, pose(0)) else labels

    poses = [pose(0.2 * k) for k in range(6)]
    mapper = Mapper(CONFIG, RIG, names=CLASSES)
    for k, T in enumerate(poses):
        mapper.add(keyframe(k, T), T, wrong_first(T))
    layer = mapper.labels()
    often = (layer.total >= 4) & (layer.points_m[:, 2] > 0.2) & (layer.points_m[:, 2] < ROOM_HIGH[2] - 0.2)
    assert often.sum() > 200
    assert (layer.labels[often] != OTHER).all()


def test_smaller_label_images_are_taken(layer):
    small = mapped([pose(k) for k in range(8)], lambda T: label_image(T)[::2, ::2]).labels()
    at = small.rows_of(layer.keys)
    assert (at >= 0).mean() > 0.99
    assert (small.labels[at[at >= 0]] == layer.labels[at >= 0]).mean() > 0.98


def test_without_labels_all_products_are_as_before(tmp_path, room):
    plain = Mapper(CONFIG, RIG)
    for k in range(8):
        plain.add(keyframe(k), pose(k))
    assert plain.labels() is None
    plain.export(tmp_path / "plain")
    assert {path.name for path in (tmp_path / "plain").iterdir()} == {
        "cloud.ply", "octomap.bt", "grid.pgm", "grid.yaml", "drive.pgm", "drive.yaml"
    }  # fmt: skip
    room.export(tmp_path / "labels")
    for name in ("octomap.bt", "grid.pgm", "drive.pgm"):
        assert (tmp_path / "plain" / name).read_bytes() == (tmp_path / "labels" / name).read_bytes()
    for one, other in zip(*(read_ply(tmp_path / name / "cloud.ply") for name in ("plain", "labels")), strict=True):
        np.testing.assert_array_equal(one, other)


def test_products_carry_labels_and_are_read_again(tmp_path, room, layer):
    config = replace(CONFIG, products=("cloud", "surfels"), labels=LabelConfig(cloud_colors=True))
    mapper = mapped([pose(k) for k in range(8)], config=config)
    written = mapper.export(tmp_path)
    assert set(written) == {"cloud", "surfels", "labels"}
    cloud = read_ply_rows(written["cloud"])
    assert cloud.dtype["label"] == np.uint16
    walls = cloud["label"] == WALL
    assert walls.mean() > 0.3
    assert (cloud["red"][walls] == 9).all()
    assert {"label", "votes", "total"} <= set(read_ply_rows(written["surfels"]).dtype.names)
    again = read_layer(tmp_path)
    same(again, layer)
    assert again.classes[WALL].name == "wall"
    assert [thing.voxels for thing in again.things] == [thing.voxels for thing in layer.things]
    first = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    mapper.export(tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == first


def toy(columns, least=2):
    """Two doors and a stray voxel along x, 10 cm voxels."""
    points = np.array([[0.1 * x + 0.05, 0.05, 0.05] for x, _ in columns]).reshape(-1, 3)
    keys = voxel_keys(points, 0.1)
    labels = np.array([label for _, label in columns], np.uint16)
    n = len(columns)
    return LabelLayer(0.1, CLASSES, keys, labels, np.full(n, 2, np.int32), np.full(n, 4, np.int32), least)


TOY = toy([(-9, 1), (-8, 1), (-7, 300), (0, 1), (5, 1), (6, 1), (7, 1), (8, 300), (9, 300)])


def test_connected_voxels_of_a_class_are_a_thing():
    assert [(thing.label, thing.voxels) for thing in TOY.things] == [(1, 3), (1, 2), (300, 2)]
    assert TOY.thing_of.tolist() == [1, 1, -1, -1, 0, 0, 0, 2, 2]
    thing = TOY.things[0]
    np.testing.assert_allclose(thing.from_m, [0.5, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(thing.to_m, [0.8, 0.1, 0.1], atol=1e-6)
    assert thing.share == 0.5
    assert len(toy([], 1).things) == 0


def test_the_nearest_thing_is_found_and_stray_voxels_are_not():
    found = nearest(TOY, [[0.05, 0.05, 0.05], [-1.0, 0.05, 0.05]], "side")
    np.testing.assert_allclose(found.distance_m, [0.5, 0.15], atol=1e-6)
    assert found.thing.tolist() == [0, 1]
    assert found.votes.tolist() == [2, 2]
    assert found.share.tolist() == [0.5, 0.5]
    none = nearest(TOY, [[5.0, 0.0, 0.0]], "side", window_m=1.0)
    assert np.isinf(none.distance_m[0])
    assert np.isnan(none.voxel_m).all()
    assert [thing.voxels for thing in things_of(TOY, "side")] == [3, 2]
    assert label_at(TOY, [[-0.65, 0.01, 0.01], [3.0, 3.0, 3.0]]) == ["wall", ""]
    assert describe_nearest(toy([(0, 1)]), (0.0, 0.0, 0.0), "side")["nearest_m"] is None


def test_questions_that_have_no_answer_say_so():
    with pytest.raises(UsageError, match=r"no voxel of the map is labelled 'door'; there are: side, wall"):
        nearest(TOY, [[0.0, 0.0, 0.0]], "door")
    with pytest.raises(DataError, match="finite"):
        nearest(TOY, [[np.nan, 0.0, 0.0]], "side")
    with pytest.raises(DataError, match="positive"):
        nearest(TOY, [[0.0, 0.0, 0.0]], "side", window_m=0.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0 = 'nothing'", "'0' is no id"),
        ("65536 = 'much'", "no id"),
        ("door = 3", "'door' is no id"),
        ("1 = ''", "needs a name"),
        ("1 = 4", "needs a name"),
        ("1 = 'a'\n2 = 'a'", "both called 'a'"),
        ("1 = {name = 'a', color = [1, 2, 256]}", "color of label 1"),
        ("1 = {name = 'a', color = 'red'}", "color of label 1"),
        ("1 = ", "no TOML"),
        ("\n".join(f"{i} = 'c{i}'" for i in range(1, 5000)), "at most 4096"),
    ],
)
def test_names_that_cannot_be_used_are_refused(tmp_path, text, said):
    path = tmp_path / "labels.toml"
    path.write_text(text)
    with pytest.raises(DataError, match=said):
        LabelClasses.read(path)


def test_ids_without_names_are_called_by_their_number():
    assert LabelClasses()[7].name == "label 7"
    assert LabelClasses().known.all()
    assert CLASSES.known.sum() == 4


SMALL = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)


def png(array):
    return bytes(cv2.imencode(".png", array)[1])


def folder_of(tmp_path, content, name="1000000000.png"):
    (tmp_path / "labels.toml").write_text("1 = 'floor'\n2 = 'door'\n")
    (tmp_path / name).write_bytes(content)
    return LabelFolder(tmp_path, SMALL)


@pytest.mark.parametrize("name", ["1000000000.png", "1.000000.png", "1.png", "1000400000.png"])
def test_label_images_are_found_by_the_stamps_of_images(tmp_path, name):
    folder = folder_of(tmp_path, png(np.full((24, 32), 2, np.uint8)), name)
    found = folder(None, 1_000_000_000)
    if name == "1.png":  # one nanosecond
        assert found is None
        assert folder.problems == {"keyframes without a label image": 1}
    else:
        assert (found == 2).all()
        assert folder(None, 1_100_000_000) is None


_TALL = png(np.zeros((24, 32), np.uint8))
_HUGE = _TALL[:16] + (2**31 - 1).to_bytes(4, "big") * 2 + _TALL[24:]


@pytest.mark.parametrize(
    "content",
    [
        b"", b"no image", png(np.ones((24, 32), np.uint8))[:60], png(np.ones((24, 32, 3), np.uint8)),
        png(np.ones((20, 32), np.uint8)), png(np.ones((48, 64), np.uint8)), png(np.ones((12, 32), np.uint8)), _HUGE,
        bytes(cv2.imencode(".jpg", np.ones((24, 32), np.uint8))[1]),
    ],
)  # fmt: skip
def test_label_images_that_cannot_be_used_are_counted_and_named(tmp_path, caplog, content):
    folder = folder_of(tmp_path, content)
    assert folder(None, 1_000_000_000) is None
    assert folder(None, 1_000_000_000) is None
    assert folder.problems == {"label images that cannot be used": 2}
    assert caplog.text.count("1000000000.png") == 1


def test_ids_that_have_no_name_say_nothing(tmp_path):
    labels = np.ones((24, 32), np.uint16)
    labels[3, 4] = 900
    folder = folder_of(tmp_path, png(labels))
    found = folder(None, 1_000_000_000)
    assert found[3, 4] == 0
    assert (found == 1).sum() == 24 * 32 - 1
    assert folder.problems == {"label images with ids that have no name": 1}


def test_a_folder_without_label_images_or_names_is_refused(tmp_path):
    with pytest.raises(DataError, match="write what the ids in the label images mean"):
        LabelFolder(tmp_path, SMALL)
    (tmp_path / "labels.toml").write_text("1 = 'floor'\n")
    (tmp_path / "picture.png").write_bytes(png(np.ones((24, 32), np.uint8)))
    with pytest.raises(DataError, match="name them by the stamps"):
        LabelFolder(tmp_path, SMALL)


@pytest.mark.parametrize(
    "labels",
    [np.ones((24, 32)), np.ones((24, 32, 3), np.uint8), np.full((24, 32), -1), np.full((24, 32), 70000),
     np.ones((0, 0), np.uint8), np.ones((25, 32), np.uint8)],
)  # fmt: skip
def test_labels_of_a_network_are_checked(labels):
    with pytest.raises(DataError, match="labels"):
        checked(labels, SMALL)


def test_a_damaged_layer_is_refused(tmp_path, layer):
    with pytest.raises(DataError, match="the map has no labels"):
        read_layer(tmp_path)
    write_layer(tmp_path, layer)
    ply, said = (tmp_path / "labels.ply").read_bytes(), (tmp_path / "labels.json").read_text()
    for bad in (ply[:-7], ply.replace(b"property int votes", b"property int floats"), ply[:-18] + ply[-36:-18], b""):
        (tmp_path / "labels.ply").write_bytes(bad)
        with pytest.raises(DataError, match=r"labels\.ply"):
            read_layer(tmp_path)
    (tmp_path / "labels.ply").write_bytes(ply)
    for bad in (
        "",
        "[]",
        "{}",
        said.replace('"resolution_m": 0.05', '"resolution_m": -1'),
        said.replace('"wall"', "3"),
    ):
        (tmp_path / "labels.json").write_text(bad)
        with pytest.raises(DataError, match=r"labels\.json"):
            read_layer(tmp_path)
