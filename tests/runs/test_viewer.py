"""The Rerun recording: clouds once, poses only when they moved, one file and no port."""

import sys

import numpy as np
import pytest

from vislam.config import ViewConfig
from vislam.core.camera import Camera, Rig
from vislam.core.errors import StorageError
from vislam.core.geometry import se3_exp, transform_points
from vislam.core.messages import Frame, GraphUpdate, Keyframe, LoopCandidate, LoopDecision, Observations, Tracking
from vislam.runs.viewer import NullViewer, open_viewer

RrdReader = pytest.importorskip("rerun.chunk").RrdReader

CAMERA = Camera(160, 120, 100.0, 100.0, 79.5, 59.5)
T_BODY_CAM = se3_exp(np.array([0.1, -0.3, 0.2, 0.05, 0.0, -0.02]))
RIG = Rig((CAMERA,), (T_BODY_CAM,), has_depth=True)
PERIOD_NS = 50_000_000


def frame(index, depth=True):
    rng = np.random.default_rng(index)
    color = rng.integers(0, 255, (120, 160, 3), dtype=np.uint8)
    depth_m = np.full((120, 160), 2.0, np.float32) if depth else None
    return Frame(5_000_000_000 + index * PERIOD_NS, index, (color[..., 0],), color, depth_m)


def keyframe(number, depth=True, points=None):
    pixels = np.array([[10.0, 20.0], [80.0, 60.0], [150.0, 100.0]])
    return Keyframe(number, frame(number).t_ns, frame(number, depth), pixels, np.zeros((3, 32), np.uint8), points)


def pose(step):
    return se3_exp(np.array([0.0, 0.0, 0.01 * step, 0.1 * step, 0.0, 0.0]))


def columns(path, entity):
    """All rows logged at an entity: {column: list of values} in the order of logging."""
    batches = [chunk.to_record_batch() for chunk in RrdReader(path).stream() if chunk.entity_path == entity]
    rows = {}
    # chunks with other columns may be written in any order; row ids ascend with time
    for batch in sorted(batches, key=lambda batch: batch.column("rerun.controls.RowId")[0].as_py()):
        for name in batch.schema.names:
            rows.setdefault(name, []).extend(batch.column(name).to_pylist())
    return rows


def entities(path):
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def test_a_run_is_recorded_in_its_own_time(tmp_path):
    with open_viewer(tmp_path / "run.rrd", rig=RIG, config=ViewConfig(every_frames=2)) as viewer:
        for k in range(10):
            seen = Observations(np.arange(k, k + 5), np.tile([[10.0, 10.0]], (5, 1)))
            viewer.log_frame(frame(k), seen, Tracking.LOST if 3 <= k < 6 else Tracking.OK)
            viewer.log_pose("live", frame(k).t_ns, pose(k))
            viewer.log_scalars(frame(k).t_ns, {"tracking/inliers": 100.0 + k, "time/front end": 9.0})
        viewer.log_path("truth", np.array([[0.0, 0, 0], [1, 0, 0]]))
        viewer.log_note(frame(9).t_ns, "IMU outage of 1.0 s")
    states = columns(tmp_path / "run.rrd", "/status/tracking")
    assert [value for (value,) in filter(None, states["StateChange:state"])] == ["ok", "lost", "ok"]  # only changes
    images = columns(tmp_path / "run.rrd", "/world/live/cam0/image")
    assert len(images["EncodedImage:blob"]) == 5  # every second frame
    assert bytes(images["EncodedImage:blob"][0][0])[:3] == b"\xff\xd8\xff"
    assert [t.total_seconds() for t in images["t"]] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    inliers = columns(tmp_path / "run.rrd", "/plots/tracking/inliers")
    assert [value for (value,) in inliers["Scalars:scalars"]] == [100.0 + k for k in range(10)]
    paths = [e for e in entities(tmp_path / "run.rrd") if e.startswith("/world/paths/live/")]
    assert paths == ["/world/paths/live/0"]
    strip = columns(tmp_path / "run.rrd", paths[0])["LineStrips3D:strips"][-1][0]
    np.testing.assert_allclose(strip, [pose(k)[:3, 3] for k in range(10)], atol=1e-6)


def test_depth_becomes_a_cloud_in_the_body_frame_once(tmp_path):
    with open_viewer(tmp_path / "run.rrd", rig=RIG, config=ViewConfig(cloud_points=300)) as viewer:
        viewer.log_keyframe(keyframe(0), np.eye(4))
        viewer.log_keyframe(keyframe(1), pose(1))
        for revision in range(4):
            shift = pose(0.5 * revision)
            update = GraphUpdate(revision, np.array([0, 1]), np.array([np.eye(4), shift @ pose(1)]), np.eye(4), None)
            viewer.move(update)
    first = columns(tmp_path / "run.rrd", "/world/map/kf_0")
    second = columns(tmp_path / "run.rrd", "/world/map/kf_1")
    assert sum(cloud is not None for cloud in second["Points3D:positions"]) == 1
    cloud = np.array(second["Points3D:positions"][0])
    in_camera = transform_points(np.linalg.inv(T_BODY_CAM), cloud)
    assert 200 < len(cloud) < 500
    np.testing.assert_allclose(in_camera[:, 2], 2.0, atol=1e-5)
    assert CAMERA.contains(CAMERA.project(in_camera)).all()
    # the pose that stays is written once; the other when it is new and for each of the three real moves
    assert len([t for t in first["Transform3D:translation"] if t is not None]) == 1
    assert len([t for t in second["Transform3D:translation"] if t is not None]) == 4


def test_a_move_too_small_to_see_is_not_written(tmp_path):
    with open_viewer(tmp_path / "run.rrd", rig=RIG) as viewer:
        viewer.log_keyframe(keyframe(0), np.eye(4))
        for xi in ([0, 0, 0, 1e-3, 0, 0], [1e-3, 0, 0, 0, 0, 0]):
            T = se3_exp(np.array(xi, dtype=float))
            viewer.move(GraphUpdate(1, np.array([0]), T[None], np.eye(4), None))
        viewer.move(GraphUpdate(2, np.array([0]), se3_exp(np.array([0.01, 0, 0, 0, 0, 0]))[None], np.eye(4), None))
    assert len(columns(tmp_path / "run.rrd", "/world/map/kf_0")["Transform3D:translation"]) >= 2
    written = [t for t in columns(tmp_path / "run.rrd", "/world/map/kf_0")["Transform3D:translation"] if t is not None]
    assert len(written) == 2


def test_features_with_unknown_depth_are_left_out(tmp_path):
    points = np.array([[1.0, 0, 0], [np.nan] * 3, [2.0, 0, 0]])
    with open_viewer(tmp_path / "run.rrd") as viewer:  # without a rig
        viewer.log_keyframe(keyframe(0, depth=False, points=points), np.eye(4))
        viewer.log_keyframe(keyframe(1, depth=False, points=None), np.eye(4))
    cloud = columns(tmp_path / "run.rrd", "/world/map/kf_0")["Points3D:positions"][0]
    np.testing.assert_allclose(cloud, points[[0, 2]])
    assert "Points3D:positions" not in columns(tmp_path / "run.rrd", "/world/map/kf_1")


def test_loops_follow_their_keyframes(tmp_path):
    with open_viewer(tmp_path / "run.rrd", rig=RIG) as viewer:
        for k in range(3):
            viewer.log_keyframe(keyframe(k), pose(10 * k))
        viewer.log_loop(LoopCandidate(0, 2, "appearance", 0.4, 50, LoopDecision.ACCEPTED, "verified"))
        viewer.log_loop(LoopCandidate(0, 1, "appearance", 0.1, 5, LoopDecision.REJECTED, "5 inliers of 20"))
        moved = np.array([pose(10 * k) @ se3_exp(np.array([0, 0, 0, 0, 1.0, 0])) for k in range(3)])
        viewer.move(GraphUpdate(1, np.arange(3), moved, np.eye(4), None))
    strips = columns(tmp_path / "run.rrd", "/world/loops/accepted")["LineStrips3D:strips"]
    assert len(strips) == 2
    np.testing.assert_allclose(strips[-1][0], moved[[0, 2], :3, 3], atol=1e-5)
    notes = columns(tmp_path / "run.rrd", "/notes")["TextLog:text"]
    assert notes[1] == ["loop 0 - 1 rejected: 5 inliers of 20"]


def test_loops_are_shown_in_the_end_as_they_were_decided_in_the_end(tmp_path):
    with open_viewer(tmp_path / "run.rrd", rig=RIG) as viewer:
        for k in range(3):
            viewer.log_keyframe(keyframe(k), pose(10 * k))
        viewer.log_loop(LoopCandidate(0, 2, "appearance", 0.4, 50, LoopDecision.ACCEPTED, "verified"))
        viewer.log_loop_picture(5_000_000_000, b"jpeg bytes", "0 - 2 rejected: out of the graph again")
        viewer.settle_loops(9_000_000_000, {(0, 2): LoopDecision.REJECTED})
    rejected = columns(tmp_path / "run.rrd", "/world/loops/rejected")["LineStrips3D:strips"]
    np.testing.assert_allclose(rejected[-1][0], [pose(0)[:3, 3], pose(20)[:3, 3]], atol=1e-5)
    assert columns(tmp_path / "run.rrd", "/world/loops/accepted")["LineStrips3D:strips"][-1] == []
    assert columns(tmp_path / "run.rrd", "/loop/pair")["EncodedImage:media_type"] == [["image/jpeg"]]
    assert columns(tmp_path / "run.rrd", "/loop/why")["TextDocument:text"] == [
        ["0 - 2 rejected: out of the graph again"]
    ]


def voxels_of(path, entity):
    rows = columns(path, entity)
    return [np.array(indices) for indices in rows["VoxelGridMap:voxel_indices"]], rows


def test_the_map_is_shown_at_times_when_it_changed_and_coarser_when_it_is_large(tmp_path):
    view = ViewConfig(map_every_s=2.0, map_voxels=500)
    small = np.array([[3, -2, 1], [4, -2, 1], [3, -2, 9]])
    large = np.stack(np.meshgrid(*[np.arange(-8, 8)] * 3), axis=-1).reshape(-1, 3)
    with open_viewer(tmp_path / "run.rrd", rig=RIG, config=view) as viewer:
        assert viewer.wants_map(5_000_000_000)
        viewer.log_octree(5_000_000_000, small, 0.05)
        assert not viewer.wants_map(6_900_000_000)
        assert viewer.wants_map(6_900_000_000, is_last=True)
        assert viewer.wants_map(7_000_000_000)
        viewer.log_octree(7_000_000_000, small, 0.05)  # the same: not written again
        viewer.log_octree(9_000_000_000, large, 0.05)
        viewer.log_octree(11_000_000_000, np.zeros((0, 3), np.int64), 0.05)
    shown, rows = voxels_of(tmp_path / "run.rrd", "/world/octree")
    assert [len(indices) for indices in shown] == [3, 64, 0]
    np.testing.assert_array_equal(shown[0], small)
    sizes = [np.ravel(size)[0] for size in rows["VoxelGridMap:voxel_size"]]
    assert sizes == pytest.approx([0.05, 0.2, 0.05])
    heights = np.array(rows["VoxelGridMap:values"][0])
    np.testing.assert_allclose(heights, (small[:, 2] + 0.5) * 0.05, atol=1e-6)


def test_the_grid_lies_on_the_floor_and_obstacles_survive_coarsening(tmp_path):
    cells = np.full((30, 41), -1, np.int8)
    cells[10:30, :] = 0
    cells[20, 40] = 1
    with open_viewer(tmp_path / "run.rrd", rig=RIG, config=ViewConfig(map_voxels=300)) as viewer:
        viewer.log_grid(5_000_000_000, cells, 0.1, (-1.0, 2.0), 0.25)
    (indices,), rows = voxels_of(tmp_path / "run.rrd", "/world/grid")
    assert len(indices) == 10 * 21  # two cells to one, unknown ones left out
    colors = np.array(rows["VoxelGridMap:colors"][0])
    (obstacle,) = indices[colors == colors[np.all(indices == [20, 10, 0], axis=1)]]
    np.testing.assert_array_equal(obstacle, [20, 10, 0])
    np.testing.assert_allclose(np.ravel(rows["VoxelGridMap:translation"][0]), [-1.0, 2.0, 0.25])
    np.testing.assert_allclose(np.ravel(rows["VoxelGridMap:voxel_size"][0])[:2], 0.2)


def test_depth_that_comes_late_takes_the_place_of_features(tmp_path):
    points = np.arange(30.0).reshape(-1, 3)
    with open_viewer(tmp_path / "run.rrd", rig=RIG, config=ViewConfig(cloud_points=8)) as viewer:
        viewer.log_keyframe(keyframe(0, depth=False, points=points[:3]), pose(0))
        viewer.log_cloud(0, points, np.full((10, 3), 200, np.uint8))
    rows = columns(tmp_path / "run.rrd", "/world/map/kf_0")
    clouds = [np.array(cloud) for cloud in rows["Points3D:positions"] if cloud]
    assert [len(cloud) for cloud in clouds] == [3, 5]
    np.testing.assert_array_equal(clouds[1], points[::2])


def test_long_paths_grow_linearly(tmp_path):
    sizes = []
    for count in (500, 2000):
        path = tmp_path / f"{count}.rrd"
        with open_viewer(path) as viewer:
            for k in range(count):
                viewer.log_pose("ekf", k * PERIOD_NS, pose(k))
        sizes.append(path.stat().st_size)
    assert sizes[1] < 5 * sizes[0]


def test_without_rerun_or_when_off_nothing_is_written(tmp_path, monkeypatch):
    off = open_viewer(tmp_path / "run.rrd", enabled=False)
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.delitem(sys.modules, "vislam.runs.viewer.recording", raising=False)
    absent = open_viewer(tmp_path / "run.rrd")
    assert isinstance(absent, NullViewer)
    said = absent.close()
    assert said is not None and "run.rrd is left out" in said and ".[view]" in said
    assert absent.close() is None
    for viewer in (off, absent):
        with viewer:
            viewer.log_frame(frame(0), Observations(np.arange(1), np.zeros((1, 2))), Tracking.OK)
            viewer.log_keyframe(keyframe(0), np.eye(4))
            viewer.log_pose("live", 0, np.eye(4))
            viewer.move(GraphUpdate(0, np.array([0]), np.eye(4)[None], np.eye(4), None))
            viewer.log_loop(LoopCandidate(0, 1, "appearance", 0.1, 5, LoopDecision.REJECTED, ""))
            viewer.log_scalars(0, {"a/b": 1.0})
            viewer.log_path("truth", np.zeros((2, 3)))
            viewer.log_note(0, "")
    assert list(tmp_path.iterdir()) == []


def test_null_viewer_has_every_method_of_the_real_one():
    from vislam.runs.viewer.recording import RunViewer

    assert all(callable(getattr(NullViewer(), name)) for name in vars(RunViewer) if not name.startswith("_"))
    assert not hasattr(NullViewer(), "_set_time")


def test_a_folder_that_is_not_there_is_one_clear_error(tmp_path):
    with pytest.raises(StorageError, match="cannot be written"):
        open_viewer(tmp_path / "missing" / "run.rrd")
