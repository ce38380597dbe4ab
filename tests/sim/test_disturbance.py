"""Rendered worlds in which vision is spoilt: each option does what it says, when it says, and nothing else."""

import numpy as np
import pytest

from vislam.core.errors import UsageError
from vislam.sim import open_world
from vislam.sim.faults.disturbance import in_window, person_box
from vislam.vision.features import FlowSettings, detect_corners, follow

SMALL = {"duration_s": 6.0, "camera_hz": 10.0, "image_width_px": 160}


def test_a_blank_view_has_no_corners_and_no_depth(painted) -> None:
    world = painted("handheld-room", blank_begin_s=1.0, blank_length_s=0.5, blank_every_s=2.0, **SMALL)
    plain = painted("handheld-room", **SMALL)
    for index in (0, 9, 15, 29, 35):
        ours, theirs = world.render(index), plain.render(index)
        assert np.array_equal(ours.images[0], theirs.images[0]) and np.array_equal(ours.depth_m, theirs.depth_m)
    for index in (10, 14, 30, 34):
        frame = world.render(index)
        assert frame.depth_m is not None and frame.depth_m.max() == 0.0
        assert len(detect_corners(frame.images[0], 50, 20, 4.0, np.empty((0, 2)), 1.0)) < 5
        assert 60 < frame.images[0].mean() < 150


def test_light_goes_off_and_on(painted) -> None:
    options = {"exposure_changes": False, "image_noise": False, **SMALL}
    world = painted("handheld-room", light_every_s=2.0, light_stops=2.0, **options)
    plain = painted("handheld-room", **options)
    ratios = []
    for index in (19, 20, 30, 40, 50):
        ours, theirs = world.render(index).images[0].astype(float), plain.render(index).images[0].astype(float)
        usable = (theirs > 40) & (theirs < 120) & (ours < 250)
        ratios.append((np.median(ours[usable] / theirs[usable])) ** 2.2)
    # off: two stops darker, of which the exposure control leaves 0.35; on: what it had added is then too much
    assert ratios == pytest.approx([1.0, 2.0**-2.0, 2.0**-0.7, 2.0**1.3, 1.0], rel=0.1)


def test_person_covers_its_part_at_two_metres_in_both_views_and_moves(painted) -> None:
    options = {"rig": "stereo", "image_noise": False, "exposure_changes": False, **SMALL}
    world = painted("handheld-room", moving_share=0.5, moving_begin_s=1.0, moving_length_s=2.0, **options)
    plain = painted("handheld-room", **options)
    assert np.array_equal(world.render(5).images[0], plain.render(5).images[0])
    assert np.array_equal(world.render(35).images[1], plain.render(35).images[1])
    ours, theirs = world.render(18), plain.render(18)
    pairs = zip(ours.images, theirs.images, strict=True)
    changed = [np.mean(np.abs(a.astype(int) - b.astype(int)) > 2) for a, b in pairs]
    assert 0.45 < changed[0] < 0.52 and 0.4 < changed[1] < 0.52
    camera = world.rig.cameras[0]
    box = person_box(camera, 0.5, 1.8)
    left = detect_corners(ours.images[0], 60, 20, 4.0, np.empty((0, 2)), 1.0)
    left = left[(np.abs(left - box[0]) < box[1] - 12.0).all(axis=1)]
    expected = camera.fx * world.rig.T_cam0_cam1[0, 3] / 2.0
    right = follow(*ours.images, left, left - [expected, 0.0], FlowSettings(window_px=11))[0]
    found = np.isfinite(right[:, 0])
    assert found.sum() > 8 and np.median((left - right)[found, 0]) == pytest.approx(expected, abs=1.2)
    deep = painted("handheld-room", moving_share=0.5, depth_noise=False, **{**options, "rig": "rgbd"}).render(18)
    assert deep.depth_m is not None and np.mean(deep.depth_m == np.float32(2.0)) == pytest.approx(0.5, abs=0.02)


def test_windows_and_wrong_options() -> None:
    assert [in_window(t, 1.0, 0.5) for t in (0.9, 1.0, 1.4, 1.5, 3.0)] == [False, True, True, False, False]
    assert [in_window(t, 1.0, 0.5, 2.0) for t in (0.9, 1.4, 1.6, 3.2, 3.6)] == [False, True, False, True, False]
    for wrong in ({"moving_share": 1.2}, {"blank_length_s": -1}, {"light_stops": 9}):
        with pytest.raises(UsageError, match=next(iter(wrong))):
            open_world("handheld-room", **wrong)
