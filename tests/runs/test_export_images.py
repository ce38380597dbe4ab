"""A run's images, cameras, poses and points for COLMAP and nerfstudio: COLMAP itself says what they are."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from needs import missing
from vislam.cli import run_verb
from vislam.config import Config, FrontEndConfig, ImuConfig, MapConfig, ViewConfig
from vislam.core.camera import Camera
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import invert
from vislam.core.messages import Frame, Submaps
from vislam.core.recording import WrappedRecording
from vislam.datasets.recorder import record
from vislam.mapping.formats.ply import read_ply
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.offline import export_images as exporting
from vislam.runs.offline import posed_images as posing
from vislam.runs.offline import rebuild as rebuilding
from vislam.runs.offline.export_images import export_images
from vislam.runs.offline.posed_images import posed_images
from vislam.runs.session import Session
from vislam.runs.sources import open_source
from vislam.sim import open_world
from vislam.trajectory import read_tum

LENSES = {
    "none": (),
    "radtan": (-0.28, 0.07, 2e-4, -3e-4),
    "radtan of five": (-0.28, 0.07, 2e-4, -3e-4, 0.01),
    "equidistant": (-0.01, 0.02, -0.003, 0.001),
    "rational": (0.3, -0.1, 1e-4, 2e-4, 0.02, 0.5, -0.05, 0.01),
}


HEIGHT = 240


def made(folder: Path, rig: str) -> Path:
    world = open_world("handheld-room", rig=rig, duration_s=5.0, camera_hz=10.0, image_width_px=320)
    record(world, folder / "recording")
    source, out = str(folder / "recording"), folder / "run"
    masks = folder / "masks"
    masks.mkdir()
    cv2.imwrite(
        str(masks / "cam0.png"), np.repeat([255, 0], (HEIGHT - 40, 40)).astype(np.uint8)[:, None].repeat(320, 1)
    )
    config = Config(
        frontend=FrontEndConfig(masks=str(masks)),
        imu=ImuConfig(enabled=False),
        map=MapConfig(enabled=False),
        view=ViewConfig(enabled=False),
    )
    prepare(out, False)
    execute(open_source(source, 0), config, out, source=source, command=["test"])
    return out


@pytest.fixture(scope="module", params=["rgbd", "stereo"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of a recording that is there."""
    return made(tmp_path_factory.mktemp("posed"), request.param)


@pytest.fixture
def pycolmap():
    try:
        import pycolmap
    except ImportError:
        missing("pycolmap is not installed")
    return pycolmap


@pytest.mark.parametrize("undistort", [False, True])
def test_colmap_reads_the_poses_cameras_and_errors_of_the_run(run: Path, tmp_path: Path, pycolmap, undistort) -> None:
    exported = export_images(run, colmap=tmp_path / "out", undistort=undistort)
    read = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    read.update_point_3d_errors()
    assert read.num_images() == exported.images
    assert read.num_points3D() == exported.points > 200
    assert read.compute_mean_reprojection_error() == pytest.approx(exported.mean_error_px, abs=0.01)
    found = posed_images(run)
    assert len(found.cameras) == len(read.cameras)
    by_name = {image.name: image for image in read.images.values()}
    for i, T in enumerate(found.T_map_cam):
        image = by_name[exporting.image_name(found, i)]
        np.testing.assert_allclose(image.cam_from_world().matrix(), invert(T)[:3], atol=1e-9)
        pixels = cv2.imread(str(tmp_path / "out" / "images" / image.name))
        assert (tmp_path / "out" / "masks" / f"{image.name}.png").is_file() == (found.camera[i] == 0)
        assert pixels.shape[1::-1] == (found.cameras[0].width, found.cameras[0].height)
    assert not list(tmp_path.glob(".*"))


def test_no_point_can_be_placed_better_at_these_poses(run: Path, tmp_path: Path, pycolmap) -> None:
    exported = export_images(run, colmap=tmp_path / "out")
    read = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    found = posed_images(run)
    if len(found.cameras) == 1:
        return  # depth has its say in where a point is, of which COLMAP knows nothing
    before = np.sum(found.errors_px() ** 2)
    config, options = pycolmap.BundleAdjustmentConfig(), pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.print_summary = False
    for image in read.images:
        config.add_image(image)
    for frame in read.frames:
        config.set_constant_rig_from_world_pose(frame)
    pycolmap.create_default_bundle_adjuster(options, config, read).solve()
    read.update_point_3d_errors()
    moved = np.array([read.points3D[p + 1].xyz for p in range(exported.points)])
    after = np.sum(replace(found, points_m=moved).errors_px() ** 2)
    assert before == pytest.approx(after, rel=1e-6)


@pytest.mark.parametrize("lens", LENSES)
def test_colmap_projects_as_we_do(lens: str, pycolmap) -> None:
    ours = Camera(640, 480, 400.0, 410.0, 310.0, 250.0, 0.0, lens.partition(" ")[0], LENSES[lens])
    _, model, width, height, *numbers = exporting.colmap_camera(1, ours).split()
    theirs = pycolmap.Camera(model=model, width=int(width), height=int(height), params=[float(n) for n in numbers])
    points = np.random.default_rng(4).uniform((-0.5, -0.4, 1.0), (0.5, 0.4, 1.5), (50, 3))
    seen = np.array([theirs.img_from_cam(point) for point in points])
    np.testing.assert_allclose(seen - 0.5, ours.project(points), atol=1e-6)


def test_a_lens_that_the_format_lacks_is_named() -> None:
    skewed = Camera(640, 480, 400.0, 410.0, 310.0, 250.0, 2.0)
    with pytest.raises(UsageError, match="COLMAP has no camera with skewed pixels; add --undistort"):
        exporting.colmap_camera(1, skewed)


def test_nerfstudio_gets_cameras_depth_and_points(run: Path, tmp_path: Path) -> None:
    export_images(run, nerfstudio=tmp_path / "out")
    whole = json.loads((tmp_path / "out" / "transforms.json").read_text())
    found = posed_images(run)
    truth = {f.t_ns: f for f in open_source(str(run.parent / "recording"), 0).events() if isinstance(f, Frame)}
    assert whole["camera_model"] == "OPENCV"
    assert len(read_ply(tmp_path / "out" / whole["ply_file_path"])[0]) == len(found.points_m)
    assert len(whole["frames"]) == len(found.keyframe)
    for i, frame in enumerate(whole["frames"]):
        T = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(T[:3, 2], -found.T_map_cam[i, :3, 2])  # it looks along -z
        np.testing.assert_allclose(T[:3, 1], -found.T_map_cam[i, :3, 1])  # with y up
        np.testing.assert_allclose(T[:3, 3], found.T_map_cam[i, :3, 3])
        assert (tmp_path / "out" / frame["file_path"]).is_file()
        depth_m = truth[found.camera_t_ns[i]].depth_m
        assert ("mask_path" in frame) == (found.camera[i] == 0)
        if found.camera[i] == 0:
            mask = cv2.imread(str(tmp_path / "out" / frame["mask_path"]), cv2.IMREAD_GRAYSCALE)
            assert mask[-40:].max() == 0 < mask[:-60].min()
        assert ("depth_file_path" in frame) == (depth_m is not None)
        if depth_m is not None:
            written = cv2.imread(str(tmp_path / "out" / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
            shown = np.where(mask > 0, np.nan_to_num(depth_m), 0.0)
            np.testing.assert_allclose(written * whole["depth_unit_scale_factor"], shown, atol=6e-4)


def test_points_lie_where_depth_is(run: Path) -> None:
    found = posed_images(run)
    frames = {f.t_ns: f for f in open_source(str(run.parent / "recording"), 0).events() if isinstance(f, Frame)}
    seen, _, z = found.seen()
    off = []
    for row in range(0, len(seen), 7):
        depth_m = frames[found.camera_t_ns[found.image[row]]].depth_m
        if depth_m is None:
            return  # a stereo rig has none to compare with
        x, y = np.rint(seen[row]).astype(int)
        off.append(depth_m[y, x] / z[row] - 1.0)  # -1 where there is no depth
    assert np.median(np.abs(off)) < 0.02


def test_the_poses_of_another_trajectory_are_taken(run: Path) -> None:
    live, found = read_tum(run / "trajectory_live.tum"), posed_images(run, "live")
    graph = posed_images(run)
    T_body_cam = Session(run / "session.db").factor_log().rig.T_body_cam0
    first = found.camera == 0
    np.testing.assert_allclose(found.T_map_cam[first], live.at(found.camera_t_ns[first]) @ T_body_cam, atol=1e-6)
    assert set(found.keyframe) <= set(graph.keyframe)
    with pytest.raises(UsageError, match="no trajectory 'mine'"):
        posed_images(run, "mine")


def test_parts_that_no_loop_has_joined_are_left_out(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ids = np.unique(posed_images(run).keyframe)
    monkeypatch.setattr(posing, "stored_submaps", lambda _: Submaps().begun(int(ids[-2])))
    found = posed_images(run)
    assert found.apart == 2
    assert found.keyframe.max() < ids[-2]


def test_what_is_wrong_is_said_in_one_line_and_leaves_nothing(run: Path, tmp_path: Path, capsys) -> None:
    assert run_verb(["export", str(run)]) == 2
    assert "nothing to write; give --mcap FILE" in capsys.readouterr().err
    assert run_verb(["export", str(run), "--colmap", str(tmp_path)]) == 2
    assert f"{tmp_path} exists" in capsys.readouterr().err
    other = tmp_path / "other"
    shutil.copytree(run, other)
    (other / "session.db").write_bytes(b"no session")
    assert run_verb(["export", str(other), "--colmap", str(tmp_path / "out")]) == 3
    assert "session.db" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other"]


def test_splats_are_those_of_the_map(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    path = tmp_path / "desk.ply"
    assert run_verb(["export", str(run), "--splats", str(path)]) == 0
    assert len(read_ply(path)[0]) > 1000
    assert list(tmp_path.iterdir()) == [path]
    assert run_verb(["export", str(run), "--splats", str(path)]) == 2
    assert f"{path} exists" in capsys.readouterr().err
    nothing = {"written": {}, "left_out": {"splats": "no surface was seen"}}
    monkeypatch.setattr(rebuilding, "rebuild", lambda *_: nothing)
    assert run_verb(["export", str(run), "--splats", str(tmp_path / "other.ply")]) == 3
    assert "no splats: no surface was seen" in capsys.readouterr().err


def test_a_recording_without_the_keyframes_is_named(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Empty(WrappedRecording):
        def events(self, from_ns=None):
            return iter(())

    whole = Empty(open_source(str(run.parent / "recording"), 0))
    monkeypatch.setattr(exporting, "open_source", lambda *_: whole)
    with pytest.raises(DataError, match=r"has no image at \d+ ns"):
        export_images(run, colmap=tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
