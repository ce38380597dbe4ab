"""A few made-up frames through stages that are then thrown away: what is compiled is compiled before it counts."""

from collections.abc import Iterator
from dataclasses import replace
from math import sin

import numpy as np

from vislam.config import Config
from vislam.core.camera import Camera, Rig
from vislam.core.clock import StageClock
from vislam.core.geometry import transform
from vislam.core.messages import Frame, ImuSample
from vislam.imu import ImuNoise
from vislam.live.processes.fast import warm_up
from vislam.pipeline.front import Front
from vislam.vision.two_view import epipolar_distances, refine_two_view

_RESTING_FRAMES = 18  # enough for a first state
_FRAMES = 60
_TRACKS, _FEATURES = 80, 300  # enough to be located and to verify loops; more cost time before sensors are read
_FRAME_NS = 50_000_000
_WINDOW = 6  # keyframes
_SPACING = 0.25  # of the usual distance between keyframes
_POINTS = 40
_SAMPLES = 5  # per frame
_SPEED_M_S, _SWAY_RAD_S = 0.8, 3.0
_DEPTH_M = 2.0
_WIDTH_PX = 320  # of images, at most: the same kernels, in half of the time
_NOBODYS = Camera(8, 8, 8.0, 8.0, 4.0, 4.0)  # without one, frames have no image


def rehearse_front(config: Config, rig: Rig, noise: ImuNoise) -> None:
    """Run the front half once, and its filter through a longer rest."""
    warm_up(config, noise, rig.T_body_cam0)
    rig = _small(rig)
    _see_direction()
    front = Front(_patient(config), rig, noise, StageClock())
    for value in made_up(config, rig):
        if isinstance(value, Frame):
            front.process(value)
        else:
            front.add(value)


def rehearse(config: Config, rig: Rig, noise: ImuNoise) -> None:
    """Run the whole pipeline once, without the map; loops are looked for from the first keyframes on.

    The window is small, so that keyframes leave it. What is seldom called is called by itself.
    """
    from vislam.slam import Slam  # brings gtsam, which the front process need not load

    loop = replace(
        config.loop, odometry_skip_keyframes=0, appearance_skip_keyframes=0, appearance_skip_s=0.0, min_inliers=6,
        first_training=2, min_training_lag=1,
    )  # fmt: skip
    rig = _small(rig)
    window = replace(config.window, keyframes=min(config.window.keyframes, _WINDOW))
    config = replace(_patient(config), loop=loop, window=window, map=replace(config.map, enabled=False))
    slam = Slam(config, rig, noise)
    slam.front.frontend.keyframe_spacing = _SPACING
    for value in made_up(config, rig):
        slam.feed(value)
    slam.finish()
    _see_direction()


def _small(rig: Rig) -> Rig:
    """Return the rig with small images."""
    return replace(rig, cameras=tuple(camera.scaled(min(1.0, _WIDTH_PX / camera.width)) for camera in rig.cameras))


def _patient(config: Config) -> Config:
    """Return settings by which what is made up is never given up for want of a start, and of which little is seen."""
    init = replace(config.init, give_up_s=_FRAMES * _FRAME_NS * 1e-9 + 1.0)
    tracks = min(config.frontend.max_tracks, _TRACKS)
    features = min(config.frontend.described_features, _FEATURES)
    frontend = replace(config.frontend, max_tracks=tracks, described_features=features)
    return replace(config, init=init, frontend=frontend)


def _see_direction() -> None:
    """Find a direction from two views, as between keyframes of which neither has depth."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1.0, 1.0, (_POINTS, 2)), rng.uniform(2.0, 4.0, _POINTS)])
    moved = points - [0.2, 0.0, 0.0]
    first, second = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    found = refine_two_view(np.eye(3), np.array([1.0, 0.1, 0.0]), first, second, 1e-3, 2.0)
    epipolar_distances(transform(found.R_key_cam, found.direction_key), first, second)


def made_up(config: Config, rig: Rig) -> Iterator[ImuSample | Frame]:
    """Yield a body at rest, then going along a wall by fits and starts, as true to the IMU: keyframes, and loops."""
    rng = np.random.default_rng(0)
    camera = rig.cameras[0] if rig.cameras else _NOBODYS
    px_per_m = camera.fx / _DEPTH_M
    width = camera.width + round(_gone(_FRAMES * _FRAME_NS)[0] * px_per_m) + 1
    coarse = rng.integers(0, 255, (camera.height // 8 + 1, width // 8 + 2), np.uint8)
    wall = np.kron(coarse, np.ones((8, 8), np.uint8))
    depth = np.full((camera.height, camera.width), _DEPTH_M, np.float32) if rig.has_depth else None
    aside, gravity = rig.T_body_cam0[:3, 0], np.array([0.0, 0.0, config.machine.gravity_m_s2])
    for k in range(_FRAMES):
        for j in range(_SAMPLES):
            t_ns = (k * _SAMPLES + j) * _FRAME_NS // _SAMPLES
            _, accel = _gone(t_ns)
            yield ImuSample(t_ns, rng.normal(size=3) * 1e-3, gravity + accel * aside)
        t_ns = (k * _SAMPLES + _SAMPLES - 2) * _FRAME_NS // _SAMPLES
        shift = round(_gone(t_ns)[0] * px_per_m)
        image = np.ascontiguousarray(wall[: camera.height, shift : shift + camera.width])
        yield Frame(t_ns, k, (image,) * len(rig.cameras), None, depth)


def _gone(t_ns: int) -> tuple[float, float]:
    """Return how far aside the body is at a time, m, and its acceleration, m/s^2."""
    angle = max(t_ns - _RESTING_FRAMES * _FRAME_NS, 0) * 1e-9 * _SWAY_RAD_S
    return _SPEED_M_S * (angle - sin(angle)) / _SWAY_RAD_S, _SPEED_M_S * _SWAY_RAD_S * sin(angle)
