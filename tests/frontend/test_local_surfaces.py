"""New keyframes of a depth camera are fitted to the surfaces of the last ones: what that wins, and what it leaves."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import FrontEndConfig
from vislam.core.geometry import invert, se3_exp, se3_log
from vislam.core.messages import Keyframe, Tracking, VoMeasurement
from vislam.frontend import make_frontend
from vislam.frontend.exposures import DepthLag
from vislam.frontend.local_surfaces import LocalSurfaces
from vislam.vision.shutter import Shutter
from worlds.corner import World, path

CONFIG = FrontEndConfig(readout_s=0.0, keyframe_parallax_px=8.0, described_features=50, max_tracks=60)


@pytest.fixture(scope="module")
def seen():
    """A dim room, in which tracks tell less than surfaces."""
    poses = path(40)
    world = World("rgbd", noise_grey=30.0)
    return world, tuple(world.frames(poses)), poses


def keyframe_errors(world, frames, poses, config=CONFIG):
    """Return errors [N, 6] of motions between keyframes, their NEES [N] of six, and whether surfaces had a say [N]."""
    front_end, key, rows = make_frontend(config, world.rig, seed=3), {}, []
    for frame, T in zip(frames, poses, strict=True):
        result = front_end.track(frame, None)
        if result.keyframe is None:
            continue
        vo = result.vo
        if vo.keyframe_id in key:
            error = se3_log(invert(invert(key[vo.keyframe_id]) @ T) @ vo.T_keyframe_body)
            rows.append((error, error @ np.linalg.solve(vo.covariance, error), vo.by_surfaces))
        key[result.keyframe.id] = T
    errors, nees, by_surfaces = zip(*rows, strict=True)
    return np.array(errors), np.array(nees), np.array(by_surfaces)


def test_surfaces_make_the_motion_between_keyframes_truer_and_know_how_true(seen):
    world, frames, poses = seen
    with_them, nees, by_surfaces = keyframe_errors(world, frames, poses)
    without, _, by_none = keyframe_errors(world, frames, poses, replace(CONFIG, local_surfaces=0))
    ways = [1e3 * np.sqrt(np.mean(np.sum(e[:, 3:] ** 2, axis=1))) for e in (without, with_them)]
    turns = [np.rad2deg(np.sqrt(np.mean(np.sum(e[:, :3] ** 2, axis=1)))) for e in (without, with_them)]
    print(f"{len(nees)} keyframes: {ways[0]:.2f}, now {ways[1]:.2f} mm; {turns[0]:.3f}, now {turns[1]:.3f} deg")
    print(f"NEES {nees.mean():.2f} of 6")
    assert by_surfaces.all() and not by_none.any()
    assert ways[1] < 0.7 * ways[0] and turns[1] < 0.7 * turns[0]
    assert nees.mean() < 6.0


def test_frames_between_keyframes_are_placed_by_tracks_alone(seen):
    world, frames, _ = seen
    front_end = make_frontend(CONFIG, world.rig, seed=3)
    results = [front_end.track(frame, None) for frame in frames[:20]]
    assert not any(result.vo.by_surfaces for result in results if result.keyframe is None)


@pytest.fixture
def local(seen):
    """Surfaces of a first keyframe, and the frame that is to be the next, at T_key_body [4, 4]."""
    world, frames, poses = seen
    return surfaces_of(world, frames[0]), world, frames[8], np.asarray(invert(poses[0]) @ poses[8])


def surfaces_of(world, frame):
    surfaces = LocalSurfaces(CONFIG, world.rig.cameras[0], world.rig.T_body_cams[0])
    keyframe = Keyframe(0, frame.t_ns, frame, np.empty((0, 2)), np.empty((0, 32), np.uint8), None)
    surfaces.add(keyframe, None)
    return surfaces


def fitted(surfaces, world, frame, T_key_body, sigma_rad, sigma_m):
    """Return what tracks said of the motion of a frame, and what surfaces make of it."""
    covariance = np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)
    vo = VoMeasurement(frame.t_ns, 0, T_key_body, covariance, True, Tracking.OK, 50)
    T_body_cam = world.rig.T_body_cams[0]
    T_key_cam = np.asarray(invert(T_body_cam) @ T_key_body @ T_body_cam)
    camera = world.rig.cameras[0]
    lag = DepthLag(camera, Shutter(camera, 0.0), 0.0, 0.0)
    found, T_found = surfaces.fitted(frame, vo, T_key_cam, lag, np.zeros(6))
    np.testing.assert_allclose(T_body_cam @ T_found @ invert(T_body_cam), found.T_keyframe_body, atol=1e-9)
    return vo, found


def test_what_tracks_err_by_within_their_sigmas_is_mended(local):
    surfaces, world, frame, T = local
    off = T @ se3_exp(np.array([0.004, -0.003, 0.004, 0.01, -0.02, 0.01]))
    vo, found = fitted(surfaces, world, frame, off, 0.005, 0.02)
    before, after = (np.linalg.norm(se3_log(invert(T) @ pose)[3:]) for pose in (off, found.T_keyframe_body))
    assert found.by_surfaces and after < 0.3 * before
    assert np.trace(found.covariance) < 0.5 * np.trace(vo.covariance)


def test_surfaces_that_contradict_sure_tracks_neither_move_them_nor_make_them_surer(local):
    surfaces, world, frame, T = local
    off = T @ se3_exp(np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0]))
    vo, found = fitted(surfaces, world, frame, off, 0.001, 0.004)
    assert np.linalg.norm(se3_log(invert(off) @ found.T_keyframe_body)) < 0.001
    assert np.trace(found.covariance) > 0.9 * np.trace(vo.covariance)


@pytest.mark.parametrize("value", [0.0, np.nan, 1.0])
def test_depth_that_tells_nothing_leaves_tracks_alone(local, value):
    surfaces, world, frame, T = local
    frame = replace(frame, depth_m=np.full_like(frame.depth_m, value))
    vo, found = fitted(surfaces, world, frame, T, 0.002, 0.01)
    assert found is vo


def test_the_way_along_a_bare_wall_stays_as_unsure_as_tracks_are(local):
    _, world, frame, _ = local
    wall = replace(frame, depth_m=np.full_like(frame.depth_m, 2.0))
    _, found = fitted(surfaces_of(world, replace(wall, t_ns=0)), world, wall, np.eye(4), 0.005, 0.02)
    R = world.rig.T_body_cams[0][:3, :3]
    ways = (R.T @ found.covariance[3:, 3:] @ R).diagonal()
    assert found.by_surfaces
    assert (ways[:2] > 0.8 * 0.02**2).all() and ways[2] < 0.3 * 0.02**2
