"""How soon a person who crossed is gone from the occupancy map, and what that costs of the things that stay.

    .venv/bin/python experiments/moving_person.py
    .venv/bin/python experiments/moving_person.py --world workshop-cart --seconds 20 --json out.json

A person crosses the view of a simulated RGB-D camera every few seconds, at 1 m/s and two metres ahead; every other time
they stand still for two seconds on the way. The map gets frames at several rates at their exact poses, depth noise
included. A voxel that the person was in counts as seen again from the first frame on whose true depth around it lies
behind it; the time from there to the frame after which it is no longer occupied is its time to clear, as long as
it stays in view. Voxels next to static ones are left out there, and counted as ghosts of their own (`beside`).
`kept` is the share of the voxels occupied in a map of the same frames without the person that are occupied in the map
with them too, `recall` that of the voxels which the true surfaces go through in three frames or more, `within` that of
those with an occupied voxel at most one voxel away.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from people.figure import figure_depth  # noqa: E402

from vislam.config import MapConfig  # noqa: E402
from vislam.core.camera import Camera  # noqa: E402
from vislam.core.geometry import invert  # noqa: E402
from vislam.core.messages import Array, ImageF32  # noqa: E402
from vislam.mapping.depth.image import DepthView, filter_depth, rgbd_view, scan_points  # noqa: E402
from vislam.mapping.octree.occupancy import Occupancy, Octree  # noqa: E402
from vislam.mapping.octree.query import nearest_obstacle  # noqa: E402
from vislam.sim import Simulation, open_world  # noqa: E402
from vislam.sim.scene.render import Renderer  # noqa: E402
from vislam.sim.sensing import DepthNoise, sense_depth  # noqa: E402

HZ = 10.0
STRIDES = {10.0: 1, 5.0: 2, 3.3: 3, 2.0: 5}  # rates of keyframes, as every n-th frame
EVERY_S, SPEED_M_S, AHEAD_M, HALF_WAY_M, STANDS_S = 6.0, 1.0, 2.0, 1.6, 2.0
BEHIND_M = 0.15  # the true depth must lie so far behind a voxel's centre for its place to be seen through ...
AROUND_PX = 11  # ... in a square of so many pixels: a voxel of 5 cm at 1 m and more
DEFAULTS = MapConfig()


@dataclass(frozen=True)
class Model:
    """What the map believes of one scan."""

    miss_probability: float
    clamp_max_probability: float
    miss_beside_probability: float | None = None  # beside what the same scan hit
    hit_probability: float = DEFAULTS.hit_probability


MODELS = {
    "OctoMap's": Model(0.4, 0.971),
    "miss 0.32, clamp 0.9": Model(0.32, 0.9),
    "the same, 0.46 beside a hit": Model(0.32, 0.9, 0.46),
    "the same, 0.499 beside a hit": Model(0.32, 0.9, 0.499),
}


@dataclass(frozen=True, eq=False)
class View:
    """One frame."""

    t_s: float
    T_world_body: Array
    T_world_cam: Array
    exact: ImageF32  # with the person
    depth: NDArray[np.uint16]  # filtered, with the person
    depth_without: NDArray[np.uint16]
    figure_points: Array  # [N, 3] of the person, in the map frame
    surface: NDArray[np.int64]  # [M, 3] voxels that the true static surfaces go through, within the range


def person_at(world: Simulation, t_s: float) -> tuple[Array, float, float] | None:
    """Return where the person's feet are, their heading and the metres walked, or None while there is no person."""
    crossing = int(t_s // EVERY_S)
    stands_s = STANDS_S if crossing % 2 else 0.0
    since_s = t_s - crossing * EVERY_S
    before_s = HALF_WAY_M / SPEED_M_S
    if since_s > 2.0 * before_s + stands_s:
        return None
    walked = SPEED_M_S * (min(since_s, before_s) + max(since_s - before_s - stands_s, 0.0))
    middle_s = min(crossing * EVERY_S + before_s + 0.5 * stands_s, world.duration_s - 0.1)
    T = world.spline.at(np.array([middle_s])).T_world_body[0]
    forward = T[:2, 0] / np.linalg.norm(T[:2, 0])
    left = np.array([-forward[1], forward[0]])
    place = T[:2, 3] + AHEAD_M * forward + (HALF_WAY_M - walked) * left
    return np.array([*place, 0.0]), float(np.arctan2(-left[1], -left[0])), walked


def views(world: Simulation, seconds: float, config: MapConfig, crossed: bool = True) -> tuple[list[View], DepthView]:
    """Return the frames of the world with and without the person, who never comes where it is not `crossed`."""
    camera: Camera = world.rig.cameras[0]
    renderer, view = Renderer(camera), rgbd_view(world.rig, config)
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float)).reshape(*u.shape, 3)
    out = []
    for k, t_s in enumerate(np.arange(0.1, seconds, 1.0 / HZ)):
        T_world_body = world.spline.at(np.array([t_s])).T_world_body[0]
        T_world_cam = T_world_body @ world.rig.T_body_cams[0]
        static = renderer.render(world.scene, T_world_cam)[1]
        person = person_at(world, float(t_s)) if crossed else None
        figure = np.full_like(static, np.inf) if person is None else figure_depth(rays, T_world_cam, *person)
        is_person = figure < np.where(static > 0.0, static, np.inf)
        exact = np.where(is_person, figure, static).astype(np.float32)
        depths = [
            filter_depth(sense_depth(image, DepthNoise(), np.random.default_rng([7, k])), 1, view, config)
            for image in (exact, static)
        ]
        near = (static > 0.5) & (np.linalg.norm(rays * static[..., None], axis=-1) < config.max_range_m)
        persons, surface = (
            (rays[mask] * depth[mask][:, None]) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
            for mask, depth in ((is_person, figure), (near, static))
        )
        voxels = np.unique(np.floor(surface / config.resolution_m).astype(np.int64), axis=0)
        out.append(View(float(t_s), T_world_body, T_world_cam, exact, depths[0], depths[1], persons, voxels))
    return out, view


def voxels_of(points: Array, resolution_m: float) -> NDArray[np.int64]:
    """Return the voxels [M, 3] that points fall into, once each."""
    return np.unique(np.floor(points / resolution_m).astype(np.int64), axis=0)


def seen_through(view: View, camera: Camera, centres: Array, max_range_m: float) -> NDArray[np.bool_]:
    """Return whether each place [N, 3] lies in the view, in range, with the true depth behind it."""
    T = invert(view.T_world_cam)
    points = centres @ T[:3, :3].T + T[:3, 3]
    pixels = np.full((len(points), 2), -1.0)
    ahead = points[:, 2] > 0.3
    pixels[ahead] = camera.project(points[ahead])
    inside = ahead & (pixels >= 1).all(axis=1) & (pixels < np.array([camera.width, camera.height]) - 2).all(axis=1)
    inside &= np.linalg.norm(points, axis=1) < max_range_m
    at = np.round(pixels[inside]).astype(int)
    out = inside.copy()
    nearest = cv2.erode(np.where(view.exact > 0.0, view.exact, np.inf), np.ones((AROUND_PX, AROUND_PX)))
    out[inside] = nearest[at[:, 1], at[:, 0]] > points[inside, 2] + BEHIND_M
    return out


def new_map(config: MapConfig, model: Model) -> Octree:
    """Return an empty map that believes as the model says."""
    return Octree(
        config.resolution_m,
        model.hit_probability,
        model.miss_probability,
        config.clamp_min_probability,
        model.clamp_max_probability,
        model.miss_beside_probability,
    )


def build(frames: list[View], view: DepthView, config: MapConfig, model: Model) -> Octree:
    """Return the map of the frames without the person."""
    grid = new_map(config, model)
    for frame in frames:
        points, origin = scan_points(frame.depth_without, view, frame.T_world_body, config.resolution_m)
        grid.insert(points, origin, view.max_range_m, config.insertion)
    return grid


def person_places(frames: list[View], static: Octree) -> tuple[Array, Array]:
    """Return the centres [N, 3] of the voxels that the person was seen in, and of those beside static ones [M, 3]."""
    r = static.resolution_m
    voxels = np.unique(np.floor(np.vstack([f.figure_points for f in frames]) / r).astype(np.int64), axis=0)
    beside = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    near = static.state_at(((voxels[:, None] + beside + 0.5) * r).reshape(-1, 3)).reshape(len(voxels), -1)
    centres, apart = (voxels + 0.5) * r, (near != Occupancy.OCCUPIED).all(axis=1)
    return centres[apart], centres[~apart & (static.state_at(centres) != Occupancy.OCCUPIED)]


def judge(frames: list[View], view: DepthView, camera: Camera, config: MapConfig, model: Model) -> dict[str, Any]:
    """Return how soon the person's voxels were cleared, and the share of the static map that is there."""
    static = build(frames, view, config, model)
    places, beside = person_places(frames, static)
    grid = new_map(config, model)
    since_s = np.full(len(places), np.nan)  # first frame that saw through a voxel which is still occupied
    times_s: list[float] = []
    for frame in frames:
        before = grid.state_at(places) == Occupancy.OCCUPIED
        points, origin = scan_points(frame.depth, view, frame.T_world_body, config.resolution_m)
        grid.insert(points, origin, view.max_range_m, config.insertion)
        after = grid.state_at(places) == Occupancy.OCCUPIED
        through = seen_through(frame, camera, places, view.max_range_m)
        interrupted = ~through & (frame.t_s - since_s > 1.0)  # out of view again, and late already
        times_s += (frame.t_s - since_s[interrupted]).tolist()
        since_s[~through] = np.nan
        since_s[through & before & np.isnan(since_s)] = frame.t_s
        cleared = ~after & ~np.isnan(since_s)
        times_s += (frame.t_s - since_s[cleared]).tolist()
        since_s[cleared] = np.nan
    times_s += [frames[-1].t_s - t for t in since_s[frames[-1].t_s - since_s > 1.0]]
    surface, seen = np.unique(np.vstack([f.surface for f in frames]), axis=0, return_counts=True)
    true = (surface[seen >= 3] + 0.5) * config.resolution_m
    occupied = (static.max_likelihood_leaves().occupied_voxels() + 0.5) * config.resolution_m
    return {
        "voxels": len(times_s),
        "cleared_in_1s": float(np.mean(np.array(times_s) < 1.0 + 1e-6)) if times_s else None,
        "p95_s": float(np.percentile(times_s, 95)) if times_s else None,
        "worst_s": max(times_s, default=None),
        "ghosts": int((grid.state_at(places) == Occupancy.OCCUPIED).sum()),
        "beside": len(beside),
        "ghosts_beside": int((grid.state_at(beside) == Occupancy.OCCUPIED).sum()),
        "static": len(occupied),
        "kept": float((grid.state_at(occupied) == Occupancy.OCCUPIED).mean()),
        "recall": float((grid.state_at(true) == Occupancy.OCCUPIED).mean()),
        "within": float((nearest_obstacle(grid, true, config.resolution_m).distance_m < np.inf).mean()),
    }


def main() -> None:
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", default="handheld-room")
    parser.add_argument("--seconds", type=float, default=24.0)
    parser.add_argument("--width", type=int, default=320, help="of the depth images")
    parser.add_argument("--json", type=Path, help="write the numbers here too")
    args = parser.parse_args()
    config = replace(DEFAULTS, pixel_step=1, edge_px=1)  # of images half as wide: the same rays as of 640 px
    world = open_world(args.world, rig="rgbd", image_width_px=args.width)
    frames, view = views(world, min(args.seconds, world.duration_s - 0.2), config)
    rows = []
    columns = "model Hz voxels cleared_in_1_s 95%_after worst ghosts beside static kept recall within"
    print(f"| {columns.replace(' ', ' | ')} |")
    for name, model in MODELS.items():
        for rate, stride in STRIDES.items():
            row = {"model": name, "hz": rate, **judge(frames[::stride], view, world.rig.cameras[0], config, model)}
            rows.append(row)
            print(
                f"| {name} | {rate:g} | {row['voxels']} | {row['cleared_in_1s']:.2%} | {row['p95_s']:.1f} s | "
                f"{row['worst_s']:.1f} s | {row['ghosts']} | {row['ghosts_beside']} of "
                f"{row['beside']} | {row['static']} | {row['kept']:.2%} | "
                f"{row['recall']:.2%} | {row['within']:.2%} |",
                flush=True,
            )
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
