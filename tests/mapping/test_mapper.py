import hashlib
import sys
import threading
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from needs import missing
from vislam.core.camera import Rig
from vislam.core.errors import DataError, StorageError
from vislam.core.geometry import se3_exp, transform
from vislam.core.messages import Frame, GraphUpdate, Keyframe, Submaps
from vislam.mapping import _open3d
from vislam.mapping.formats.ply import read_ply
from vislam.mapping.mapper import Mapper
from vislam.mapping.octree.occupancy import Occupancy
from vislam.mapping.octree.octomap_io import encode_ot, read_octree
from worlds.box import CAMERA, CONFIG, RIG, ROOM_HIGH, ROOM_LOW, T_BODY_CAM0, depth_image, keyframe, pose


def mapper_at(poses, config=CONFIG):
    """A mapper whose keyframes saw the room from `pose(k)` and are believed to be at `poses[k]`."""
    mapper = Mapper(config, RIG)
    for k, T in enumerate(poses):
        mapper.add(SEEN[k], T)
    return mapper


def update(ids, poses):
    return GraphUpdate(1, np.array(ids, dtype=np.int64), np.array(poses).reshape(-1, 4, 4), np.eye(4), None)


def digest(mapper):
    return digest_of(mapper.occupancy)


def digest_of(occupancy):
    return hashlib.sha256(encode_ot(occupancy.leaves())).hexdigest()


SEEN = [keyframe(k) for k in range(10)]
TRUE = [pose(k) for k in range(10)]
DRIFTED = [T @ se3_exp(np.array([0.0, 0.0, 0.01 * k, 0.03 * k, -0.02 * k, 0.0])) for k, T in enumerate(TRUE)]


@cache
def from_scratch():
    """The digest of the map whose keyframes are all where they were."""
    return digest(mapper_at(TRUE))


def test_the_room_is_found_and_the_rest_is_unknown():
    mapper = mapper_at(TRUE)
    occupied = mapper.occupancy.leaves()
    centres = occupied.centres_m()[0][occupied.log_odds >= 0]
    to_wall = np.minimum(np.abs(centres - ROOM_LOW), np.abs(centres - ROOM_HIGH)).min(axis=1)
    assert np.percentile(to_wall, 99) < 0.05
    inside = np.array([[1.5, 1.0, 1.2], [-1.5, -1.0, 1.2], [2.3, 0.1, 1.2]])
    assert (mapper.occupancy.state_at(inside) == Occupancy.FREE).all()
    outside = np.array([[3.0, 0.0, 1.2], [0.0, -2.5, 1.2], [0.0, 0.0, -0.3]])
    assert (mapper.occupancy.state_at(outside) == Occupancy.UNKNOWN).all()
    cloud = mapper.cloud()
    assert len(cloud) > 3000
    to_wall = np.minimum(np.abs(cloud.points_m - ROOM_LOW), np.abs(cloud.points_m - ROOM_HIGH)).min(axis=1)
    assert np.percentile(to_wall, 95) < 0.01
    assert np.abs(np.median(cloud.colors, axis=0) - [200, 0, 0]).max() <= 3  # RGB


def test_a_corrected_map_is_the_map_made_from_scratch_at_the_final_poses():
    mapper, fresh = mapper_at(DRIFTED), mapper_at(TRUE)
    assert digest(mapper) != digest(fresh)
    mapper.move(update(range(10), TRUE))
    mapper.finish()
    assert digest(mapper) == digest(fresh)
    assert mapper.cloud().points_m.tobytes() == fresh.cloud().points_m.tobytes()


APART = Submaps((0, 6), (0, 1))
JOINED = replace(APART, groups=(0, 0))
ELSEWHERE = [transform(np.eye(3), np.array([1.0, 0.7, 0.3])) @ T for T in TRUE]  # as dead reckoning has it


def mapper_with_a_submap_apart(config=CONFIG):
    mapper = mapper_at(TRUE[:6], config)
    for k in range(6, 10):
        mapper.move(replace(update([], []), submaps=APART))
        mapper.add(SEEN[k], ELSEWHERE[k])
    return mapper


def test_a_submap_that_is_not_joined_stays_out_of_the_map_until_it_is():
    mapper = mapper_with_a_submap_apart(replace(CONFIG, rebuild_keyframes_per_call=1))
    without, whole = mapper_at(TRUE[:6]), mapper_at(TRUE)
    mapper.finish()
    assert digest(mapper) == digest(without) != digest(whole)
    assert mapper.cloud().points_m.tobytes() == without.cloud().points_m.tobytes()
    mapper.move(replace(update(range(6, 10), TRUE[6:]), submaps=JOINED))
    assert digest(mapper) == digest(without)  # it comes in as corrections do, little by little
    for _ in range(20):
        mapper.move(replace(update([], []), submaps=JOINED))
    assert digest(mapper) == digest(whole)
    assert mapper.cloud().points_m.tobytes() == whole.cloud().points_m.tobytes()
    mapper.move(replace(update(range(6, 10), ELSEWHERE[6:]), submaps=APART))  # the loop was false
    mapper.finish()
    assert digest(mapper) == digest(without)
    assert mapper.counters["marks_bytes"] == without.counters["marks_bytes"]
    assert len(mapper.surfels()) == len(without.surfels())


def test_the_oldest_submap_takes_a_joined_one_in_in_the_middle_of_a_correction():
    mapper = mapper_with_a_submap_apart()
    mapper.move(replace(update(range(6), DRIFTED[:6]), submaps=APART))
    mapper.move(replace(update(range(10), DRIFTED), submaps=JOINED))
    mapper.move(replace(update(range(8), TRUE[:8]), submaps=JOINED))
    mapper.move(replace(update([8, 9], TRUE[8:]), submaps=JOINED))
    mapper.finish()
    assert digest(mapper) == from_scratch()


def test_a_submap_apart_is_written_into_a_folder_of_its_own(tmp_path):
    mapper = mapper_with_a_submap_apart()
    written = mapper.export(tmp_path)
    own = Mapper(CONFIG, RIG)
    for k in range(6, 10):
        own.add(SEEN[k], ELSEWHERE[k])
    own.export(tmp_path / "own")
    assert written["submap_1_cloud"] == tmp_path / "submap_1" / "cloud.ply"
    for path in (tmp_path / "own").iterdir():
        assert path.read_bytes() == (tmp_path / "submap_1" / path.name).read_bytes(), path
    assert "4 keyframes" in mapper.notes["submap_1 in the map"]
    mapper.move(replace(update(range(6, 10), TRUE[6:]), submaps=JOINED))
    mapper.finish()
    mapper.export(tmp_path)
    assert not (tmp_path / "submap_1").exists() and "submap_1 in the map" not in mapper.notes


def test_a_correction_below_the_limit_is_still_exact_at_the_end():
    nearly = [T @ se3_exp(np.full(6, 1e-4)) for T in TRUE]
    mapper = mapper_at(nearly)
    mapper.move(update(range(10), TRUE))
    assert mapper.counters["keyframes_integrated_again"] == 0
    mapper.finish()
    assert digest(mapper) == from_scratch()


def test_a_correction_is_followed_in_bounded_slices_while_the_old_map_stays_in_use():
    config = replace(CONFIG, rebuild_keyframes_per_call=3)
    mapper = mapper_at([T @ se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0])) for T in TRUE], config)
    before = digest(mapper)
    nothing = update([], [])
    mapper.move(update(range(10), TRUE))
    done = [mapper.counters["keyframes_integrated_again"]]
    for _ in range(2):
        assert digest(mapper) == before
        mapper.move(nothing)
        done.append(mapper.counters["keyframes_integrated_again"])
    assert done == [3, 6, 9]
    mapper.move(nothing)
    assert mapper.counters["rebuilds"] == 1
    assert digest(mapper) == from_scratch()
    mapper.move(nothing)
    assert mapper.counters["keyframes_integrated_again"] == 10


def test_keyframes_and_corrections_that_arrive_during_a_rebuild_are_not_lost():
    config = replace(CONFIG, rebuild_keyframes_per_call=2)
    mapper = Mapper(config, RIG)
    for k in range(6):
        mapper.add(keyframe(k), DRIFTED[k])
    mapper.move(update([3, 4, 5], TRUE[3:6]))
    for k in range(6, 10):
        mapper.add(keyframe(k), TRUE[k])
        mapper.move(update([0, 1, 2], [T @ se3_exp(np.full(6, 0.02 * (9 - k))) for T in TRUE[:3]]))
    for _ in range(30):
        mapper.move(update([], []))
    assert digest(mapper) == from_scratch()
    mapper.finish()
    assert digest(mapper) == from_scratch()


@pytest.mark.parametrize("moved", [[0], [8, 9], [0, 3, 6], list(range(10))])
def test_only_keyframes_that_moved_cast_rays_again_and_the_map_is_that_from_scratch(moved):
    poses = [DRIFTED[k] if k in moved else TRUE[k] for k in range(10)]
    mapper = mapper_at(poses)
    held = mapper.occupancy
    before = digest(mapper)
    mapper.drive()  # which is kept up to date from here on
    away = [TRUE[k] @ se3_exp(np.array([0.0, 0.0, 0.05, 0.1, 0.0, 0.0])) for k in moved]
    for target in (away, [TRUE[k] for k in moved]):
        done = mapper.counters["keyframes_integrated_again"]
        for k, T in zip(moved, target, strict=True):
            poses[k] = T
        mapper.move(update(moved, target))
        mapper.finish()
        fresh = mapper_at(poses)
        assert digest(mapper) == digest(fresh)
        assert mapper.drive().states.tobytes() == fresh.drive().states.tobytes()
        assert sorted(mapper.occupancy.pool.keys) == sorted(fresh.occupancy.pool.keys[: fresh.occupancy.pool.count])
        assert mapper.counters["keyframes_integrated_again"] == done + len(moved)
    assert digest_of(held) == before


@settings(max_examples=15)
@given(st.lists(st.tuples(st.sampled_from(["add", "move", "advance", "finish"]), st.integers(0, 9)), max_size=25))
def test_any_sequence_of_keyframes_and_corrections_ends_in_the_map_from_scratch(steps):
    config = replace(CONFIG, rebuild_keyframes_per_call=2)
    mapper, poses = Mapper(config, RIG), []
    for number, (step, k) in enumerate(steps):
        if step == "add" and len(poses) < 8:
            mapper.add(SEEN[len(poses)], DRIFTED[len(poses)])
            poses.append(DRIFTED[len(poses)])
        elif step == "move" and k < len(poses):
            poses[k] = TRUE[k] @ se3_exp(np.array([0.0, 0.0, 0.0, 0.06 * (number % 3), 0.0, 0.0]))
            mapper.move(update([k], [poses[k]]))
        elif step == "finish":
            mapper.finish()
            assert digest(mapper) == digest(mapper_at(poses))
        else:
            mapper.move(update([], []))
    mapper.finish()
    assert digest(mapper) == digest(mapper_at(poses))


def test_a_reader_keeps_the_map_it_holds():
    mapper = mapper_at(DRIFTED)
    held = mapper.occupancy
    before = encode_ot(held.leaves())
    mapper.move(update(range(10), TRUE))
    mapper.finish()
    assert encode_ot(held.leaves()) == before
    assert mapper.occupancy is not held


def test_a_reader_in_another_thread_keeps_its_map_while_corrections_go_on():
    """The thread that feeds the mapper hands out copies; who reads them waits for nobody and sees whole states only."""
    mapper = Mapper(replace(CONFIG, rebuild_keyframes_per_call=1), RIG)
    published: list = [mapper.snapshot()]
    states, seen, stop = {digest_of(published[0])}, [], threading.Event()

    def read() -> None:
        while not stop.is_set():
            held = published[0]
            first = digest_of(held)
            seen.append((first, first == digest_of(held)))

    reader = threading.Thread(target=read)
    reader.start()
    try:
        for k in range(10):
            mapper.add(SEEN[k], DRIFTED[k])
            mapper.move(update(range(k), TRUE[:k]) if k % 3 == 0 else update([], []))
            published[0] = mapper.snapshot()
            states.add(digest_of(published[0]))
    finally:
        stop.set()
        reader.join()
    assert mapper.counters["rebuilds"] > 0
    assert seen
    assert {first for first, _ in seen} <= states
    assert all(is_same for _, is_same in seen)


@pytest.mark.parametrize(
    ("tangent", "followed"),
    [
        ([0.0, 0.0, 0.0, 0.049, 0.0, 0.0], False),
        ([0.0, 0.0, 0.0, 0.0, 0.051, 0.0], True),
        ([0.0, np.deg2rad(0.95), 0.0, 0.0, 0.0, 0.0], False),
        ([0.0, 0.0, np.deg2rad(-1.05), 0.0, 0.0, 0.0], True),
    ],
)
def test_one_voxel_or_one_degree_decides(tangent, followed):
    mapper = mapper_at(TRUE[:3])
    mapper.move(update([1], [TRUE[1] @ se3_exp(np.array(tangent))]))
    assert mapper.counters["rebuilds"] == int(followed)


def test_poses_of_unknown_keyframes_are_ignored():
    mapper = mapper_at(TRUE[:3])
    before = digest(mapper)
    mapper.move(update([7, 100], [pose(7), pose(9)]))
    mapper.finish()
    assert digest(mapper) == before


def test_what_moved_away_is_not_in_the_cloud():
    def with_person(k):
        depth = depth_image(pose(0))
        if k < 2:
            depth[30:90, 60:100] = 1.0
        return keyframe(k, pose(0), depth)

    mapper = Mapper(CONFIG, RIG)
    for k in range(8):
        mapper.add(with_person(k), pose(0))
    camera = (pose(0) @ T_BODY_CAM0)[:3, 3]
    assert np.linalg.norm(mapper.cloud().points_m - camera, axis=1).min() > 1.4
    seen_once = Mapper(CONFIG, RIG)
    seen_once.add(with_person(0), pose(0))
    assert np.linalg.norm(seen_once.cloud().points_m - camera, axis=1).min() < 1.3


@pytest.mark.parametrize("depth_m", [0.0, np.nan, np.inf, -1.0])
def test_scans_without_a_point_change_nothing_and_may_be_moved(depth_m):
    mapper = mapper_at(TRUE[:3])
    before = digest(mapper)
    mapper.add(keyframe(3, depth_m=np.full((CAMERA.height, CAMERA.width), depth_m, np.float32)), TRUE[3])
    mapper.move(update([3], [TRUE[5]]))
    mapper.finish()
    assert digest(mapper) == before
    assert len(mapper.cloud()) > 0


def test_a_keyframe_beyond_the_reach_of_keys_is_left_out_and_named(tmp_path):
    mapper = mapper_at(TRUE[:3], replace(CONFIG, products=("octomap",)))
    before = digest(mapper)
    wild = TRUE[3] @ se3_exp(np.array([0.0, 0.0, 0.0, 1e6, 0.0, 0.0]))
    mapper.add(SEEN[3], wild)
    assert digest(mapper) == before
    mapper.export(tmp_path)
    assert "16-bit keys" in mapper.notes["occupancy of 1 keyframes"]
    mapper.move(update([1, 3], [wild, TRUE[3]]))
    mapper.finish()
    assert digest(mapper) == digest(mapper_at([TRUE[0], wild, *TRUE[2:4]]))
    mapper.move(update([1], [TRUE[1]]))
    mapper.finish()
    assert digest(mapper) == digest(mapper_at(TRUE[:4]))
    assert set(mapper.export(tmp_path)) == {"octomap"}
    assert mapper.notes == {}


@pytest.mark.parametrize(
    "bad",
    [
        np.full((4, 4), np.nan),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([2.0, 2.0, 2.0, 1.0]),
        np.eye(3),
        np.vstack([np.eye(4)[:3], [[0.0, 0.0, 1.0, 1.0]]]),
    ],
)
def test_poses_that_are_not_rigid_are_refused(bad):
    mapper = mapper_at(TRUE[:2])
    before = digest(mapper)
    with pytest.raises(DataError, match="keyframe 2 is not a rigid"):
        mapper.add(keyframe(2), bad)
    if bad.shape == (4, 4):
        with pytest.raises(DataError, match="keyframe 1 is not a rigid"):
            mapper.move(update([0, 1], [TRUE[5], bad]))
    mapper.finish()
    assert digest(mapper) == before


def test_wrong_image_sizes_and_repeated_ids_are_refused():
    mapper = mapper_at(TRUE[:2])
    with pytest.raises(DataError, match="already"):
        mapper.add(keyframe(1), TRUE[1])
    with pytest.raises(DataError, match="register depth"):
        mapper.add(keyframe(2, depth_m=np.ones((50, 50), np.float32)), TRUE[2])
    frame = Frame(0, 3, (np.zeros((60, 80), np.uint8),), None, depth_image(pose(3)))
    with pytest.raises(DataError, match="80x60"):
        mapper.add(Keyframe(3, 0, frame, np.zeros((0, 2)), np.zeros((0, 32), np.uint8), None), TRUE[3])


def sparse_keyframe(k, points):
    frame = Frame(0, k, (np.full((120, 160), 77, np.uint8),))
    pixels = np.tile([[80.0, 60.0]], (0 if points is None else len(points), 1))
    return Keyframe(k, 0, frame, pixels, np.zeros((len(pixels), 32), np.uint8), points)


def test_without_depth_sparse_points_are_mapped_and_nothing_is_counted():
    mapper = Mapper(CONFIG, Rig((CAMERA,), (T_BODY_CAM0,)))
    points = np.array([[2.01, 0.11, 0.21], [np.nan, 0.0, 0.0], [2.01, -0.33, 0.21], [300.0, 0.0, 0.0]])
    mapper.add(sparse_keyframe(0, points), np.eye(4))
    mapper.add(sparse_keyframe(1, None), np.eye(4))
    mapper.add(sparse_keyframe(2, np.full((4, 3), np.nan)), np.eye(4))
    counters = mapper.counters
    assert (counters["keyframes_dense"], counters["keyframes_sparse"]) == (0, 1)
    assert counters["keyframes_without_depth"] == 2
    assert (mapper.occupancy.state_at(points[[0, 2]]) == Occupancy.OCCUPIED).all()
    assert mapper.occupancy.state_at(np.array([[1.01, 0.07, 0.16]])) == Occupancy.FREE
    assert mapper.occupancy.state_at(points[3:]) == Occupancy.UNKNOWN
    assert 77 in mapper.cloud().colors


def test_a_stereo_frame_without_its_partner_falls_back():
    rig = Rig((CAMERA, CAMERA), (T_BODY_CAM0, T_BODY_CAM0 @ transform(np.eye(3), np.array([0.1, 0.0, 0.0]))))
    mapper = Mapper(CONFIG, rig)
    mapper.add(sparse_keyframe(0, np.array([[2.0, 0.0, 0.0]])), np.eye(4))
    mapper.add(sparse_keyframe(1, None), np.eye(4))
    assert mapper.counters["keyframes_sparse"] == 1
    assert mapper.counters["keyframes_without_depth"] == 1


def test_stereo_images_of_another_size_are_refused():
    rig = Rig((CAMERA, CAMERA), (T_BODY_CAM0, T_BODY_CAM0 @ transform(np.eye(3), np.array([0.1, 0.0, 0.0]))))
    frame = Frame(0, 0, (np.zeros((120, 160), np.uint8), np.zeros((240, 320), np.uint8)))
    with pytest.raises(DataError, match="320x240"):
        Mapper(CONFIG, rig).add(Keyframe(0, 0, frame, np.zeros((0, 2)), np.zeros((0, 32), np.uint8), None), np.eye(4))


def test_export_is_whole_and_the_same_every_time(tmp_path):
    digests = []
    for name in ("a", "b"):
        written = mapper_at(TRUE).export(tmp_path / name)
        assert sorted(p.name for p in (tmp_path / name).iterdir()) == sorted(p.name for p in written.values())
        digests.append({k: hashlib.sha256(p.read_bytes()).hexdigest() for k, p in written.items()})
    assert digests[0] == digests[1]
    assert set(digests[0]) == {"cloud", "octomap", "grid", "grid_yaml", "drive", "drive_yaml"}
    octree = read_octree(tmp_path / "a" / "octomap.bt")
    assert octree.resolution_m == CONFIG.resolution_m
    assert len(read_ply(tmp_path / "a" / "cloud.ply")[0]) == len(mapper_at(TRUE).cloud())


def test_an_empty_map_exports_valid_files(tmp_path):
    written = Mapper(replace(CONFIG, products=(*CONFIG.products, "mesh")), RIG).export(tmp_path / "map")
    assert len(read_ply(written["cloud"])[0]) == 0
    assert len(read_octree(written["octomap"])) == 0
    assert "mesh" not in written


def test_keyframe_clouds_are_in_the_body_frame():
    mapper = mapper_at([pose(0)])
    points = mapper.keyframe_cloud(0).points_m.astype(np.float64)
    in_map = points @ pose(0)[:3, :3].T + pose(0)[:3, 3]
    assert np.minimum(np.abs(in_map - ROOM_LOW), np.abs(in_map - ROOM_HIGH)).min(axis=1).max() < 0.02
    assert 0 < len(points) < 5000
    assert len(mapper.keyframe_cloud(99)) == 0


def test_an_unusable_folder_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="cannot be written"):
        mapper_at(TRUE[:1]).export(tmp_path / "file")


def test_mesh_of_the_room(tmp_path):
    if _open3d.load_open3d()[0] is None:
        missing("no open3d; pip install '.[map]'")
    contents = []
    for name in ("a", "b"):
        mapper = mapper_at(TRUE, replace(CONFIG, products=("mesh",), mesh_voxel_m=0.04, pixel_step=1))
        written = mapper.export(tmp_path / name)
        assert "mesh" not in mapper.notes
        contents.append(written["mesh"].read_bytes())
    assert contents[0] == contents[1]
    points, colors = read_ply(tmp_path / "a" / "mesh.ply")
    assert len(points) > 1000
    to_wall = np.minimum(np.abs(points - ROOM_LOW), np.abs(points - ROOM_HIGH)).min(axis=1)
    assert np.percentile(to_wall, 95) < 0.02
    assert np.abs(np.median(colors, axis=0) - [200, 0, 0]).max() <= 4


def test_what_one_keyframe_saw_is_in_the_mesh_unless_later_rays_passed_through_it():
    if _open3d.load_open3d()[0] is None:
        missing("no open3d; pip install '.[map]'")
    depth_m = depth_image(TRUE[0])
    depth_m[40:80, 60:100] = 1.0  # a board that is gone in later keyframes
    config = replace(CONFIG, products=("mesh",), mesh_voxel_m=0.04, pixel_step=1)

    def near_the_board(later):
        mapper = Mapper(config, RIG)
        mapper.add(keyframe(0, TRUE[0], depth_m), TRUE[0])
        for k in range(1, 1 + later):
            mapper.add(keyframe(k, TRUE[0]), TRUE[0])
        mesh, reason = mapper.mesh()
        assert mesh is not None, reason
        assert mesh.triangles.max() == len(mesh.points_m) - 1
        at_m = ((mesh.points_m - TRUE[0][:3, 3]) @ TRUE[0][:3, :3] - T_BODY_CAM0[:3, 3]) @ T_BODY_CAM0[:3, :3]
        return np.count_nonzero(np.abs(at_m[:, 2] - 1.0) < 0.1), np.count_nonzero(at_m[:, 2] > 1.5)

    board, walls = near_the_board(0)
    assert board > 30
    assert walls > 500
    board, walls = near_the_board(4)
    assert board == 0
    assert walls > 500


def test_without_open3d_the_mesh_is_left_out_with_a_reason(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    mapper = mapper_at(TRUE[:2], replace(CONFIG, products=(*CONFIG.products, "mesh")))
    written = mapper.export(tmp_path)
    assert "mesh" not in written
    assert "open3d" in mapper.notes["mesh"]


def test_open3d_gets_libusb_from_its_wheel(monkeypatch):
    loaded, attempts = [], []

    class FakeOpen3d:
        class utility:
            class VerbosityLevel:
                Error = "error"

            set_verbosity_level = staticmethod(lambda level: None)

    class FakePackage:
        get_library_path = staticmethod(lambda: "/wheel/libusb-1.0.so")

    def fake_import(name):
        if name == "libusb_package":
            return FakePackage
        attempts.append(name)
        if not loaded:
            raise OSError("libusb-1.0.so.0: cannot open shared object file")
        return FakeOpen3d

    monkeypatch.setattr(_open3d.importlib, "import_module", fake_import)
    monkeypatch.setattr(_open3d.ctypes, "CDLL", lambda path, mode: loaded.append((path, mode)))
    module, reason = _open3d.load_open3d()
    assert (module, reason) == (FakeOpen3d, "")
    assert loaded == [("/wheel/libusb-1.0.so", _open3d.ctypes.RTLD_GLOBAL)]
    assert attempts == ["open3d", "open3d"]
