"""A table with things on it, seen by a camera that moves sideways and keeps looking at it; images, exact depth, poses.

The same scene as in the notes of the depth filter's measurements, drawn by the simulator's renderer: what the depth
filter's tests and its benchmark look at.
"""

from functools import cache

import cv2
import numpy as np

from vislam.core.camera import Camera
from vislam.core.geometry import transform
from vislam.sim.scene.bake import bake
from vislam.sim.scene.paint import noise, tinted
from vislam.sim.scene.render import Renderer
from vislam.sim.scene.scene import SceneBuilder

NOISE_GREY = 1.5  # standard deviation of a pixel
_GREY = (150.0, 150.0, 150.0)


def _rough(rng, height, width, ppm):
    return tinted(noise(rng, height, width, (ppm / 8, ppm / 25, ppm / 70), (0.25, 0.22, 0.25)), _GREY)


def _blank(rng, height, width, ppm):
    return np.full((height, width, 3), 150, np.uint8)


def camera(width):
    """The pinhole camera of the notes (640x480, f 481 px), scaled."""
    return Camera(640, 480, 481.2, 480.0, 319.5, 239.5).scaled(width / 640)


@cache
def scene(blank_table=False, extra=None):
    """The baked scene; `blank_table` takes the texture off the table top, `extra` is (x, y) of one more box on it."""
    world = SceneBuilder(ambient=1.0)
    world.rectangle((-4.0, 4.0, 0.0), (8.0, 0.0, 0.0), (0.0, -8.0, 0.0), _rough, 260.0)
    world.box((0.0, 0.0), 0.66, (1.4, 0.8, 0.06), 0.0, _rough, top=_blank if blank_table else None, texels_per_m=400.0)
    world.box((-0.175, -0.05), 0.72, (0.25, 0.3, 0.23), 0.0, _rough, texels_per_m=400.0)
    world.box((0.35, 0.075), 0.72, (0.3, 0.35, 0.10), 0.0, _rough, texels_per_m=400.0)
    world.box((-1.3, 0.85), 0.0, (0.6, 0.5, 0.5), 0.0, _rough, texels_per_m=400.0)
    world.cylinder((0.05, 0.25), 0.72, 0.1, 0.2, _rough, texels_per_m=400.0)
    if extra is not None:
        world.box(extra, 0.72, (0.2, 0.2, 0.25), 0.3, _rough, texels_per_m=400.0)
    return bake(world, np.random.SeedSequence(3))


def pose(i):
    """T_world_cam of frame i: 12 mm further along, looking at the table."""
    position = np.array([-0.45 + 0.012 * i, -0.9 + 0.1 * np.sin(0.08 * i), 2.0 + 0.05 * np.sin(0.1 * i)])
    z = np.array([0.1 * np.sin(0.05 * i), 0.05, 0.4]) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return transform(np.column_stack([x, np.cross(z, x), z]), position)


@cache
def _renderer(width):
    return Renderer(camera(width))


def view(T_world_cam, width, seed, world=None):
    """Grey image [h, w] with noise, and exact z-depth [h, w]."""
    color, depth = _renderer(width).render(scene() if world is None else world, T_world_cam)
    grey = cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
    noisy = grey + np.random.default_rng(seed).normal(0.0, NOISE_GREY, grey.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), depth


@cache
def frame(i, width):
    """The i-th frame of the motion."""
    return view(pose(i), width, i)


def motion(i, j=0):
    """T_ref_cur of frame i against frame j."""
    return np.linalg.inv(pose(j)) @ pose(i)
