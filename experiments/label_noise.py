"""How many voxels have the right label, with exact label images and with wrong ones, and what labels cost.

    python experiments/label_noise.py [WORLD] [--hz 2] [--width 320]

Exact poses, noisy depth. A voxel is right when its label is that of the surface nearest to its middle, of samples every
1 cm. "pixels": a share of all pixels has a label drawn at random; "images": a share of the images has its classes
exchanged, each in its own way. Beside fused labels stand those of a vote per pixel, and of counters without bound.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from vislam.config import MapConfig
from vislam.core.messages import Frame, Keyframe
from vislam.mapping.depth.image import surface_points
from vislam.mapping.mapper import Mapper
from vislam.mapping.semantic.votes import majority, voxel_keys
from vislam.sim import open_world
from vislam.sim.scene import NAMES
from vislam.sim.scene.names import labels_of
from vislam.sim.worlds.table import WORLDS

SAMPLE_M = 0.01


def surface_samples(name: str, world_seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points [N, 3] on all surfaces of a world, and their labels [N]."""
    layout = np.random.SeedSequence(world_seed).spawn(2)[0]
    surfaces = WORLDS[name].build(np.random.default_rng(layout)).surfaces
    labels, hung = labels_of(surfaces)
    points, ids = [], []
    for p, surface in enumerate(surfaces):
        steps = [max(1, round(size / SAMPLE_M)) for size in surface.size_m]
        u, v = np.meshgrid(*((np.arange(n) + 0.5) / n for n in steps))
        points.append(surface.point(u.ravel(), v.ravel())[0])
        own = np.full(u.size, labels[p])
        a, b = u.ravel() * surface.size_m[0], v.ravel() * surface.size_m[1]
        for _, u0, v0, u1, v1, label in hung[hung[:, 0] == p]:
            own[(a >= u0) & (a < u1) & (b >= v0) & (b < v1)] = label
        ids.append(own)
    return np.concatenate(points), np.concatenate(ids)


def spoiled(labels: np.ndarray, kind: str, share: float, rng: np.random.Generator) -> np.ndarray:
    """Return a label image with wrong labels."""
    if kind == "pixels":
        return np.where(rng.random(labels.shape) < share, rng.integers(1, len(NAMES) + 1, labels.shape), labels)
    if kind == "images" and rng.random() < share:
        return np.r_[0, 1 + rng.permutation(len(NAMES))][labels]
    return labels


def unbounded(mapper: Mapper, keys: np.ndarray, is_pixel: bool) -> np.ndarray:
    """Return the label [N] of voxels by counters for every label: one vote per pixel, or per keyframe."""
    counts: dict[int, Counter[int]] = defaultdict(Counter)
    for i, T in mapper._occupancy.poses.items():
        depth, labels = mapper._store.geometry(i).depth, mapper._store.labels(i)
        points, pixels = surface_points(depth, mapper._extractor.view, T)
        there, said = voxel_keys(points, mapper._config.resolution_m), labels.reshape(-1)[pixels]
        if not is_pixel:
            there, said = majority(there, said)
        for key, label in zip(there.tolist(), said.tolist(), strict=True):
            counts[key][label] += 1
    return np.array([min(counts[k].items(), key=lambda item: (-item[1], item[0]))[0] for k in keys.tolist()])


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("world", nargs="?", default="handheld-room")
    parser.add_argument("--hz", type=float, default=2.0)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--world-seed", type=int, default=0)
    options = parser.parse_args()
    world = open_world(
        options.world, camera_hz=options.hz, image_width_px=options.width, world_seed=options.world_seed, rig="rgbd"
    )
    poses = world.truth().T_world_body
    frames: list[Frame] = [world.render(k) for k in range(world.frame_count)]
    exact = [world.labels(k)[1] for k in range(world.frame_count)]
    nothing = np.zeros((0, 2)), np.zeros((0, 32), np.uint8)
    keyframes = [Keyframe(k, frame.t_ns, replace(frame, index=k), *nothing, None) for k, frame in enumerate(frames)]
    points, ids = surface_samples(options.world, options.world_seed)
    tree = cKDTree(points)
    print(f"{options.world}, seed {options.world_seed}: {len(frames)} keyframes at {options.width} px")
    plain = Mapper(MapConfig(), world.rig)
    start = time.process_time()
    for keyframe, T in zip(keyframes, poses, strict=True):
        plain.add(keyframe, T)
    print(f"without labels: {1e3 * (time.process_time() - start) / len(frames):.1f} ms of CPU per keyframe")
    for kind, share in (("exact", 0.0), ("pixels", 0.2), ("pixels", 0.4), ("images", 0.2), ("images", 0.4)):
        rng = np.random.default_rng(1)
        mapper = Mapper(MapConfig(), world.rig)
        start = time.process_time()
        for keyframe, T, labels in zip(keyframes, poses, exact, strict=True):
            mapper.add(keyframe, T, spoiled(labels, kind, share, rng))
        adding_ms = 1e3 * (time.process_time() - start) / len(frames)
        start = time.process_time()
        layer = mapper.labels()
        assert layer is not None
        fusing_ms = 1e3 * (time.process_time() - start) / len(frames)
        truth = ids[tree.query(layer.points_m.astype(float))[1]]
        by_pixel, by_keyframe = (unbounded(mapper, layer.keys, is_pixel) for is_pixel in (True, False))
        shares = ", ".join(
            f"{name} {100.0 * float((found == truth).mean()):.1f} %"
            for name, found in (("fused", layer.labels), ("every pixel", by_pixel), ("no bound", by_keyframe))
        )
        often = (layer.labels == truth)[layer.total >= 3]
        stored = sum(len(mapper.packed(k).labels_png) for k in range(len(frames))) / len(frames) / 1024
        print(
            f"{kind} {share:.0%}: {len(layer)} voxels, right: {shares}; "
            f"seen by 3 or more {f'{100.0 * often.mean():.1f} %' if often.size else 'none'}; "
            f"{len(layer.things)} things; {adding_ms:.1f} + {fusing_ms:.1f} ms of CPU, {stored:.1f} KiB per keyframe"
        )


if __name__ == "__main__":
    main()
