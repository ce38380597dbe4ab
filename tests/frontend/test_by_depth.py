"""Frames of a depth camera in the dark: what depth places, what it does not, and that vision takes over again."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import FrontEndConfig
from vislam.core.geometry import invert, se3_log
from vislam.core.messages import Tracking
from vislam.frontend import make_frontend
from worlds.corner import World, path

CONFIG = FrontEndConfig(track_sigma_px=0.1, readout_s=0.0, keyframe_parallax_px=12.0, described_features=300)
DARK = range(6, 16)


@pytest.fixture(scope="module")
def seen():
    poses = path(22)
    return World("rgbd"), tuple(World("rgbd").frames(poses)), poses


def darkened(frames, change_depth=lambda depth_m: depth_m):
    return [
        replace(f, images=tuple(np.full_like(i, 4) for i in f.images), depth_m=change_depth(f.depth_m))
        if f.index in DARK
        else f
        for f in frames
    ]


def tracked(world, frames, config=CONFIG):
    front_end = make_frontend(config, world.rig, seed=3)
    return [front_end.track(frame, None) for frame in frames]


def test_dark_frames_are_placed_by_depth_and_vision_goes_on(seen):
    world, frames, poses = seen
    results = tracked(world, darkened(frames))
    key = {}
    for result, T in zip(results, poses, strict=True):
        vo = result.vo
        assert vo.tracking is not Tracking.LOST, result.reason
        if key:
            error = se3_log(invert(invert(key[vo.keyframe_id]) @ T) @ vo.T_keyframe_body)
            assert np.linalg.norm(error[3:]) < 0.03
            assert np.linalg.norm(error[:3]) < np.deg2rad(1.0)
            if result.by_depth:
                assert error @ np.linalg.solve(vo.covariance, error) < 16.8  # chi2 of six, 99 %
        if result.keyframe is not None:
            key[result.keyframe.id] = T
    dark = [results[k] for k in DARK]
    assert all(r.by_depth and r.vo.tracking is Tracking.DEGRADED for r in dark)
    assert all("by depth alone" in r.reason or r.keyframe is not None for r in dark)
    assert not any(r.by_depth for r in results[: DARK.start])
    assert not results[-1].by_depth


@pytest.mark.parametrize("value", [0.0, np.nan, 1.0])
def test_dark_frames_whose_depth_tells_nothing_are_lost(seen, value):
    world, frames, _ = seen
    results = tracked(world, darkened(frames, lambda depth_m: np.full_like(depth_m, value)))
    assert all(results[k].vo.tracking is Tracking.LOST and not results[k].by_depth for k in DARK)


def test_where_vision_never_fails_depth_alone_changes_nothing(seen):
    world, frames, _ = seen
    with_it, without = (tracked(world, frames, replace(CONFIG, depth_alone=on)) for on in (True, False))
    for one, other in zip(with_it, without, strict=True):
        assert one.vo.T_keyframe_body.tobytes() == other.vo.T_keyframe_body.tobytes()
        assert one.vo.covariance.tobytes() == other.vo.covariance.tobytes()
        assert one.reason == other.reason


def test_the_same_frames_are_placed_the_same(seen):
    world, frames, _ = seen
    first, second = (tracked(world, darkened(frames)) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        assert one.vo.covariance.tobytes() == other.vo.covariance.tobytes()
        assert one.reason == other.reason
