"""Drive the virtual cart to random goals in three worlds, without a map and in yesterday's: errors and contacts.

    python experiments/drive_goals.py [--worlds workshop room corridor] [--goals 4] [--seeds 1] [--out results/goals]

Of each world and seed, one drive without a map is yesterday's; a second one begins elsewhere in its map. Goals are
drawn where the true world leaves room to turn. The simulated truth alone decides: where the cart stood when it said
that it was there, against the goal in axes of yesterday's start, and whether its body ever touched anything. All is in
lock-step: the same seeds give the same numbers on every machine. Writes goals.jsonl, a line per goal, and a summary.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from vislam.config import MapConfig, load
from vislam.core.errors import VislamError
from vislam.live.driving import Driver, Goal, Limits, LockStepCart, drive
from vislam.live.virtual.motion import locate
from vislam.live.virtual.place import WORLDS_BUILT, PlaceOptions
from vislam.mapping.drive.drive_grid import DriveGrid, distance_cells
from vislam.mapping.drive.route import plan
from vislam.runs.folder import map_choice, prepare
from vislam.sim.scene.scene import DISC

_SPACING_M, _CELL_M = 0.02, 0.05
_LOW_M = 0.06  # lower things are driven over
_GRAVITY = 9.81
_STEP_S = 0.04  # between looks for a contact
_ROOM_M = 0.15  # that goals leave beyond the turning circle
_FARTHEST_M = 9.0  # of a goal from the one before, along the way


@dataclass(frozen=True)
class TrueWorld:
    """What stands in a world, as the cart could touch it."""

    points_m: np.ndarray  # [N, 2] of surfaces between floor and the cart's height
    grid: DriveGrid

    @classmethod
    def of(cls, world: str, seed: int) -> TrueWorld:
        """Sample the surfaces of a world; as `painted` lays it out."""
        layout, _ = np.random.SeedSequence(seed).spawn(2)
        builder, config, found = WORLDS_BUILT[world](np.random.default_rng(layout)), MapConfig(), []
        for surface in builder.surfaces:
            u, v = (np.linspace(0.0, 1.0, math.ceil(size / _SPACING_M) + 2) for size in surface.size_m)
            u, v = (part.ravel() for part in np.meshgrid(u, v))
            if surface.kind == DISC:
                inside = (u - 0.5) ** 2 + (v - 0.5) ** 2 <= 0.25
                u, v = u[inside], v[inside]
            points = surface.point(u, v)[0]
            found.append(points[(points[:, 2] > _LOW_M) & (points[:, 2] < config.grid_high_m), :2])
        points = np.unique(np.round(np.vstack(found) / 0.01).astype(np.int64), axis=0) * 0.01
        low = points.min(axis=0) - 0.5
        cells = np.floor((points - low) / _CELL_M).astype(int)
        states = np.zeros((cells[:, 1].max() + 11, cells[:, 0].max() + 11), np.int8)
        states[cells[:, 1], cells[:, 0]] = 1
        clearance = (distance_cells(states > 0) * _CELL_M).astype(np.float32)
        empty = np.zeros(states.shape, np.float32)
        body = config.drive.body_length_m, config.drive.body_width_m
        return cls(points, DriveGrid(states, empty, empty, clearance, _CELL_M, tuple(low.tolist()), 0.0, body))

    def goals(self, start: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw goals [N, 3] (x, y, heading) in the world, each reachable from the one before."""
        grid, drawn, here = self.grid, [], start[:2]
        room = grid.turning_radius_m + _ROOM_M
        while len(drawn) < count:
            row, column = (int(rng.integers(n)) for n in grid.states.shape)
            place = (np.array([column, row]) + 0.5) * _CELL_M + grid.origin_m
            if grid.states[row, column] or grid.clearance_m[row, column] < room:
                continue
            route = plan(grid, here, place)
            if isinstance(route, str) or not 1.0 < route.length_m < _FARTHEST_M:
                continue
            drawn.append([*place, rng.uniform(-math.pi, math.pi)])
            here = place
        return np.array(drawn)

    def nearest_m(self, cart: LockStepCart) -> float:
        """Return how near anything came to the body, on all of the way driven; 0 for a contact."""
        tree, half = cKDTree(self.points_m), 0.5 * np.array(self.grid.body_m)
        nearest = math.inf
        for t_s in np.arange(0.0, cart.segments[-1].t_s, _STEP_S):
            here = locate(cart.segments, float(t_s))
            near = self.points_m[tree.query_ball_point([here.x_m, here.y_m], 1.0)] - [here.x_m, here.y_m]
            if len(near) == 0:
                continue
            c, s = math.cos(here.yaw_rad), math.sin(here.yaw_rad)
            beyond = np.maximum(np.abs(near @ np.array([[c, -s], [s, c]])) - half, 0.0)
            nearest = min(nearest, float(np.hypot(*beyond.T).min()))
        return nearest


def into(start: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return places [N, 3] of the world in axes of a start [3]."""
    c, s = math.cos(start[2]), math.sin(start[2])
    moved = (places[:, :2] - start[:2]) @ np.array([[c, -s], [s, c]])
    return np.column_stack([moved, places[:, 2] - start[2]])


def driven(
    cart: LockStepCart, goals_world: np.ndarray, zero: np.ndarray, out: Path, base: Path | None, world: TrueWorld
) -> list[dict]:
    """Drive to goals [N, 3] of the world, in a map whose zero [3] is there; return an entry of each."""
    config = load(None, {"view.enabled": False, "seed": cart.options.seed})
    driver = Driver([Goal(*goal) for goal in into(zero, goals_world).tolist()], Limits())
    choice = None if base is None else map_choice(base, False, config)
    prepare(out, True, choice)
    failure = ""
    try:
        drive(cart, driver, config, out, "virtual-cart", ["drive_goals"], choice)
    except VislamError as error:
        failure = str(error)
    entries = []
    for goal, arrival in zip(goals_world, driver.arrivals, strict=False):
        there = locate(cart.segments, (arrival.ended_ns - cart.begin_ns) * 1e-9)
        entries.append({
            "reached": arrival.is_reached, "reason": arrival.reason, "took_s": arrival.took_s,
            "driven_m": arrival.driven_m, "by_pose_m": arrival.off_m,
            "off_m": math.hypot(there.x_m - goal[0], there.y_m - goal[1]),
            "off_deg": math.degrees(abs(math.remainder(there.yaw_rad - goal[2], 2.0 * math.pi))),
        })  # fmt: skip
    missing = {"reached": False, "reason": f"the drive ended before: {failure}", "off_m": None, "off_deg": None}
    entries += [missing] * (len(goals_world) - len(entries))
    return [{**entry, "nearest_m": world.nearest_m(cart)} for entry in entries]


def main() -> None:
    """Drive, and sum up."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=sorted(WORLDS_BUILT))
    parser.add_argument("--goals", type=int, default=4, help="of each drive")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--camera-hz", type=float, default=10.0)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--out", type=Path, default=Path("results/drive_goals"))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    entries: list[dict] = []
    for seed in asked.seeds:
        for name in asked.worlds:
            world, rng = TrueWorld.of(name, seed), np.random.default_rng([seed, len(name)])
            options = PlaceOptions(
                world=name, rig="rgbd", image_width_px=asked.width, camera_hz=asked.camera_hz, seed=seed
            )
            zero, base = np.array(options.start), None
            for begins in ("without a map", "in yesterday's map"):
                start = zero if base is None else world.goals(zero, 1, rng)[0]
                placed = replace(
                    options, start_x_m=start[0], start_y_m=start[1], start_yaw_deg=math.degrees(start[2])
                )  # fmt: skip
                out = asked.out / f"{name}-{seed}{'' if base is None else '-next'}"
                goals = world.goals(start, asked.goals, rng)
                for entry in driven(LockStepCart(placed, _GRAVITY), goals, zero, out, base, world):
                    entries.append({"world": name, "seed": seed, "begins": begins, **entry})
                    print(json.dumps(entries[-1]), flush=True)
                base = out
    (asked.out / "goals.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    summarise(entries)


def summarise(entries: list[dict]) -> None:
    """Print a line per world and beginning."""
    for key in sorted({(entry["world"], entry["begins"]) for entry in entries}):
        of = [entry for entry in entries if (entry["world"], entry["begins"]) == key]
        reached = [entry for entry in of if entry["reached"]]
        good = [entry for entry in reached if entry["off_m"] < 0.05 and entry["off_deg"] < 3.0]
        off = [entry["off_m"] for entry in reached] or [math.nan]
        deg = [entry["off_deg"] for entry in reached] or [math.nan]
        print(
            f"{key[0]}, {key[1]}: {len(of)} goals, {len(reached)} reached, {len(good)} within 5 cm and 3 deg; off by "
            f"{100.0 * float(np.median(off)):.1f} cm (most {100.0 * max(off):.1f}), {float(np.median(deg)):.1f} deg "
            f"(most {max(deg):.1f}); nearest {100.0 * min(entry['nearest_m'] for entry in of):.0f} cm"
        )


if __name__ == "__main__":
    main()
