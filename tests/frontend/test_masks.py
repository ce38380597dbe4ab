"""Masks: pixels that are not to be used are used nowhere, wherever the masks come from."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from vislam import Config, Slam
from vislam.cli import run_verb
from vislam.config import load
from vislam.core import DataError, Frame, MaskedRecording, Observations
from vislam.frontend.masks import Masks
from vislam.mapping.depth.extract import DenseStereo
from vislam.sim import open_world
from vislam.trajectory import Trajectory, evaluate
from vislam.vision.features import FlowSettings, are_used, describe, detect_corners, detect_harris, follow
from worlds.box import CAMERA, RIG

SIZE = (CAMERA.height, CAMERA.width)
IMAGE = np.random.default_rng(0).integers(0, 255, SIZE).astype(np.uint8)
LEFT = np.full(SIZE, 255, np.uint8)
LEFT[:, CAMERA.width // 2 :] = 0
NONE = np.empty((0, 2))
WALK = {
    "duration_s": 6.0,
    "camera_hz": 10.0,
    "image_width_px": 320,
    "moving_share": 0.4,
    "moving_begin_s": 1.5,
    "seed": 1,
}


def write(path, mask):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), mask)


def frame(**fields):
    return Frame(1_000_000_000, 3, (IMAGE,), **fields)


def in_left(pixels):
    assert len(pixels) > 20
    return bool((pixels[:, 0] < CAMERA.width // 2).all())


def test_what_is_found_and_followed_lies_in_what_may_be_used():
    boxes = np.array([[0.0, 0.0, CAMERA.width, CAMERA.height]])
    smooth = cv2.GaussianBlur(IMAGE, (0, 0), 2.0)
    assert in_left(detect_corners(smooth, 300, 24, 4.0, NONE, 1.0, LEFT))
    assert in_left(detect_harris(smooth, boxes, 300, 4.0, NONE, LEFT))
    assert in_left(describe(smooth, 300, mask=LEFT)[0])
    corners = detect_corners(smooth, 300, 24, 4.0, NONE, 1.0)
    found, _ = follow(smooth, smooth, corners, corners, FlowSettings(), LEFT)
    np.testing.assert_array_equal(np.isfinite(found[:, 0]), are_used(LEFT, corners))


def test_a_mask_file_of_a_camera_counts_for_all_its_images_with_a_margin(tmp_path):
    write(tmp_path / "cam0.png", LEFT)
    depth, tracks = np.ones(SIZE, np.float32), Observations(np.arange(2), np.array([[5.0, 9.0], [CAMERA.width - 5, 9]]))
    seen = Masks(str(tmp_path), RIG).onto(frame(depth_m=depth, tracks=tracks))
    half = CAMERA.width // 2
    assert (seen.masks[0][:, : half - 8] == 255).all()
    assert (seen.masks[0][:, half - 8 :] == 0).all()
    np.testing.assert_array_equal(seen.depth_m > 0.0, seen.masks[0] > 0)
    assert seen.tracks.track_ids.tolist() == [0]


def test_a_mask_of_one_image_is_found_by_its_stamp_and_joins_the_others(tmp_path):
    write(tmp_path / "cam0" / "1.001500.png", LEFT)
    top = np.full(SIZE, 200, np.uint8)
    top[CAMERA.height // 2 :] = 127
    masks = Masks(str(tmp_path), RIG)
    seen = masks.onto(frame(masks=(top,)))
    assert seen.masks[0][0, 0] == 255
    assert seen.masks[0][-1, 0] == seen.masks[0][0, -1] == 0
    assert masks.problems == {}
    other = replace(frame(), t_ns=2_000_000_000)
    assert masks.onto(other) is other
    assert masks.problems == {"images without a mask of their own": 1}


def test_a_frame_without_masks_is_itself():
    whole = frame(depth_m=np.ones(SIZE, np.float32))
    assert Masks(None, RIG).onto(whole) is whole


@pytest.mark.parametrize(
    ("name", "mask", "said"),
    [
        ("cam0.png", LEFT[:-2], f"it is {SIZE[1]}x{SIZE[0] - 2}, the camera's images {SIZE[1]}x{SIZE[0]}"),
        ("cam0/1.5.png", LEFT[:-2], "as large as the images"),
        ("cam0.png", np.zeros(SIZE, np.uint8), "leaves no pixel to use"),
        ("cam0.png", LEFT.astype(np.uint16), "no grey PNG of 1 or 8 bits"),
        ("cam0.png", np.dstack([LEFT] * 3), "no grey PNG of 1 or 8 bits"),
        ("cam1.png", LEFT, "holds no masks of this recording's 1 cameras; name them cam0.png"),
        ("cam0/last.png", LEFT, "has no masks; name them by the stamps of the images"),
        ("mask.png", LEFT, "holds no masks"),
    ],
)
def test_masks_that_cannot_be_used_are_said_in_one_line(tmp_path, name, mask, said):
    write(tmp_path / name, mask)
    with pytest.raises(DataError, match=said) as refused:
        Masks(str(tmp_path), RIG)
    assert "\n" not in str(refused.value)
    with pytest.raises(DataError, match="holds no masks"):
        Masks(str(tmp_path / "absent"), RIG)


def test_later_masks_that_are_bad_are_counted(tmp_path):
    for t_ns, mask in ((1, LEFT), (2, LEFT[:-2]), (3, np.zeros(SIZE, np.uint8))):
        write(tmp_path / "cam0" / f"{t_ns}000000000.png", mask)
    masks = Masks(str(tmp_path), RIG)
    masks.examine()
    assert masks.problems == {"masks that cannot be used": 1, "images that a mask leaves nothing of": 1}


@pytest.mark.parametrize("mask", [LEFT[:-2], LEFT > 0, np.dstack([LEFT] * 3)])
def test_a_given_mask_of_another_size_or_type_is_refused(mask):
    with pytest.raises(DataError, match=r"mask of cam0 in frame 3 is .* 8 bits and as large as the images"):
        Masks(None, RIG).onto(frame(masks=(mask,)))


def test_dense_stereo_knows_where_its_view_is_masked():
    world = open_world("handheld-room", rig="stereo", image_width_px=320)
    stereo = DenseStereo(world.rig, Config().map)
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, 160:] = 0
    used = stereo.uses(mask)
    assert used[:, : used.shape[1] // 2 - 4].mean() > 0.9
    assert not used[:, used.shape[1] // 2 + 4 :].any()


def driven(recording, **settings):
    slam = Slam(load(overrides={"map.resolution_m": 0.1, **settings}), recording.rig, recording.imu_noise)
    steps = [step for value in recording.events() for step in slam.feed(value)]
    placed = [step for step in [*steps, *slam.finish().steps] if step.T_map_body is not None]
    path = Trajectory(np.array([s.front.frame.t_ns for s in placed]), np.array([s.T_map_body for s in placed]))
    return slam, path, evaluate(path, recording.truth(), "yaw")["ate_rmse_m"]


def strays(slam, empty):
    """How many occupied voxels of a map have none of the empty room's within two voxels."""
    here, there = (one.back.mapper.occupancy.max_likelihood_leaves().occupied_voxels() for one in (slam, empty))
    return int((KDTree(there).query(here)[0] > 2.0).sum())


@pytest.fixture(scope="module")
def masked():
    world = open_world("handheld-room", **WALK, moving_masks=True)
    values = list(world.events())  # drawn once, with masks and without
    world.events = lambda *_: iter(values)
    plain = open_world("handheld-room", **WALK)
    plain.events = lambda *_: (replace(v, masks=()) if isinstance(v, Frame) else v for v in values)
    return world, plain, *driven(world)


def test_a_person_in_masks_leads_neither_the_motion_nor_the_map_astray(masked):
    _, plain, slam, _, error_m = masked
    often = {"frontend.keyframe_parallax_px": 8.0, "frontend.keyframe_max_interval_s": 0.2}  # all that is to be seen
    empty, _, _ = driven(open_world("handheld-room", **{**WALK, "moving_share": 0.0}), **often)
    unmasked, _, lost_m = driven(plain)
    assert error_m < 0.02
    assert lost_m > 1.5 * error_m
    assert strays(slam, empty) == 0
    assert strays(unmasked, empty) > 1000


def test_two_runs_with_masks_are_the_same_and_a_function_gives_them_as_well(masked):
    world, plain, _, path, _ = masked
    masks = {value.index: value.masks for value in world.events() if isinstance(value, Frame)}
    _, again, _ = driven(MaskedRecording(plain, lambda seen: masks[seen.index]))
    np.testing.assert_array_equal(plain.render(30).images, world.render(30).images)
    np.testing.assert_array_equal(path.T_world_body, again.T_world_body)


def test_a_run_and_the_doctor_take_a_folder_of_masks(tmp_path, capsys):
    assert run_verb(["simulate", "handheld-room", "--out", str(tmp_path / "walk"), "--duration-s", "2",
                     "--camera-hz", "5", "--image-width-px", "160"]) == 0  # fmt: skip
    mask = np.full((120, 160), 255, np.uint8)
    mask[90:] = 0  # the robot's own hood
    write(tmp_path / "masks" / "cam0.png", mask)
    write(tmp_path / "bad" / "cam0.png", mask[:50])
    source = f"euroc:{tmp_path / 'walk'}"
    capsys.readouterr()
    assert run_verb(["doctor", source, "--masks", str(tmp_path / "masks")]) == 0
    assert "masks fit the images" in capsys.readouterr().out
    assert run_verb(["doctor", source, "--masks", str(tmp_path / "bad")]) == 3
    assert "it is 160x50, the camera's images 160x120" in capsys.readouterr().out
    common = ["run", source, "--imu.no-enabled", "--view.no-enabled", "--map.no-enabled", "--frontend.masks"]
    assert run_verb([*common, str(tmp_path / "bad"), "--out", str(tmp_path / "none")]) == 3
    assert "cam0.png: it is 160x50" in capsys.readouterr().err
    assert run_verb([*common, str(tmp_path / "masks"), "--out", str(tmp_path / "run")]) == 0
