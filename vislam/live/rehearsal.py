"""A few made-up frames through stages that are then thrown away: what is compiled is compiled before it counts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.clock import StageClock
from vislam.core.messages import Frame, ImuSample
from vislam.imu import ImuNoise
from vislam.pipeline.front import Front
from vislam.slam import Slam

_RESTING_FRAMES = 18  # enough for a first state
_FRAMES = 30
_FRAME_NS = 50_000_000
_SAMPLES = 5  # per frame
_STEP_PX = 12
_DEPTH_M = 2.0


def rehearse_front(config: Config, rig: Rig, noise: ImuNoise) -> None:
    """Run the front half once."""
    front = Front(config, rig, noise, StageClock())
    for value in _made_up(config, rig):
        if isinstance(value, Frame):
            front.process(value)
        else:
            front.add(value)


def rehearse(config: Config, rig: Rig, noise: ImuNoise) -> None:
    """Run the whole pipeline once, without the map; loops are looked for from the first keyframes on."""
    loop = replace(
        config.loop, odometry_skip_keyframes=0, appearance_skip_keyframes=0, appearance_skip_s=0.0, min_inliers=6,
        first_training=2, min_training_lag=1,
    )  # fmt: skip
    slam = Slam(replace(config, loop=loop, map=replace(config.map, enabled=False)), rig, noise)
    for value in _made_up(config, rig):
        slam.feed(value)
    slam.finish()


def _made_up(config: Config, rig: Rig) -> Iterator[ImuSample | Frame]:
    """Yield a body at rest, and a wall that slides by after a while: enough for keyframes and a loop between them."""
    rng = np.random.default_rng(0)
    camera = rig.cameras[0]
    width = camera.width + (_FRAMES - _RESTING_FRAMES) * _STEP_PX
    coarse = rng.integers(0, 255, (camera.height // 8 + 1, width // 8 + 2), np.uint8)
    wall = np.kron(coarse, np.ones((8, 8), np.uint8))
    depth = np.full((camera.height, camera.width), _DEPTH_M, np.float32) if rig.has_depth else None
    force = np.array([0.0, 0.0, config.imu.gravity_m_s2])
    for k in range(_FRAMES):
        for j in range(_SAMPLES):
            yield ImuSample((k * _SAMPLES + j) * _FRAME_NS // _SAMPLES, rng.normal(size=3) * 1e-3, force)
        shift = max(0, k - _RESTING_FRAMES) * _STEP_PX
        image = np.ascontiguousarray(wall[: camera.height, shift : shift + camera.width])
        yield Frame((k * _SAMPLES + _SAMPLES - 2) * _FRAME_NS // _SAMPLES, k, (image,) * len(rig.cameras), None, depth)
