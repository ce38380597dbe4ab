"""A cart's wheels over 500 m, with a webcam and a cheap IMU beside them, and a minute in which the webcam sees nothing.

The cart is simulated, `points:cart-laps`: tracks of landmarks with noise and outliers, biases of a consumer IMU, and
the speeds of two wheels, 20 times a second, with the noise that kind `wheels` says. What the wheels are told to be and
what they are differs: both radii by 3 %, or one of them. All else is as in `vislam run`, but that inertial data are
kept for 90 s, so that the graph has them for all of a minute without keyframes.

    python experiments/cart_wheels.py --out runs/cart_wheels
"""

from __future__ import annotations

import heapq
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from vislam import Slam, open_source
from vislam.config import load
from vislam.core.messages import Array, Frame, ImuSample, MagSample
from vislam.core.readings import Reading
from vislam.sensors import Suite
from vislam.sensors.kinds import Wheels
from vislam.sensors.simulated import bodies_on, drawn_readings
from vislam.trajectory import Trajectory, align, associate

Radii = Literal["as told", "both 3 % larger", "left 3 % larger", "no wheels"]
_TRUE = {"as told": (1.0, 1.0), "both 3 % larger": (1.03, 1.03), "left 3 % larger": (1.03, 1.0)}
_TRACK_M = 0.5
_PERIOD_NS = 50_000_000
_EDGE_NS = 100_000_000  # of the truth, at which its rates are not known well
_BLIND_S = 60.0
_SETTINGS = {"imu.buffer_s": 90.0, "map.enabled": False, "view.enabled": False}


def source(duration_s: float, blind_at_s: float | None) -> str:
    """Return the recording's name: blind from a time on, or never."""
    blind = "" if blind_at_s is None else f",outage_begin_s={blind_at_s},outage_length_s={_BLIND_S}"
    return f"points:cart-laps,rig=mono,camera_hz=10,tracks=100,duration_s={duration_s}{blind}"


def run(uri: str, radii: Radii, seed: int) -> tuple[dict[str, Trajectory], Trajectory, dict[str, Any]]:
    """Return the paths of filter and graph, the truth, and what is known of the wheels and of the cost."""
    recording = open_source(uri, seed)
    truth = recording.truth()
    assert truth is not None
    wheels = Wheels()
    suite = Suite({} if radii == "no wheels" else {"wheels": wheels})
    values: Iterator[ImuSample | MagSample | Frame | Reading] = iter(recording.events())
    if radii != "no wheels":
        t_ns = np.arange(int(truth.t_ns[0]) + _EDGE_NS, int(truth.t_ns[-1]) - _EDGE_NS, _PERIOD_NS)
        own = np.array([*_TRUE[radii], _TRACK_M])
        said = drawn_readings("wheels", wheels, bodies_on(truth, t_ns), own, seed)
        values = heapq.merge(values, said, key=lambda value: value.t_ns)
    slam = Slam(load(None, _SETTINGS), recording.rig, recording.imu_noise, suite)
    begun_s = time.process_time()
    by_filter: list[tuple[int, Array]] = []
    causal: list[tuple[int, Array]] = []
    stamps: list[int] = []
    for value in values:
        for step in slam.feed(value):
            front = step.front
            stamps += [one.odometry.packet.keyframe.t_ns for one in step.keyframes]
            if front.state is not None:
                by_filter.append((front.state.t_ns, front.state.T_world_body))
            if step.T_map_body is not None:
                causal.append((front.frame.t_ns, step.T_map_body))
    slam.finish()
    back = slam.back
    assert back is not None
    paths = {name: _trajectory(poses) for name, poses in (("filter", by_filter), ("in map", causal))}
    paths["graph"] = Trajectory(np.array(stamps), back.graph.poses())
    told: dict[str, Any] = {"cpu_s": time.process_time() - begun_s}
    if radii != "no wheels":
        told["filter"] = slam.front.report().sensors["wheels"].get("filter", {})
        told["graph"] = _own(back.graph.own("wheels"))
    return paths, truth, told


def _trajectory(poses: list[tuple[int, Array]]) -> Trajectory:
    return Trajectory(np.array([t for t, _ in poses]), np.array([T for _, T in poses]))


def _own(found: tuple[Array, Array] | None) -> dict[str, list[float]]:
    return {} if found is None else dict(zip(("values", "sigmas"), (part.tolist() for part in found), strict=True))


def of_way(path: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Return RMSE and maximum of positions, turned about up and moved to fit best, and RMSE as a share of the way."""
    pairs = associate(path, truth)
    errors = pairs.aligned(align(pairs, "yaw")).position_errors_m()
    rmse = float(np.sqrt((errors**2).mean()))
    return {"rmse_m": rmse, "max_m": float(errors.max()), "rmse_share": rmse / truth.path_m}


def gone_on(path: Trajectory, truth: Trajectory, begin_ns: int, end_ns: int) -> dict[str, float]:
    """Return how far a path errs at the end of a stretch whose beginning is put on the truth, and that of the way.

    Heading and place are the truth's at the last pose before it. Its end is the first pose from then on, for a graph
    may have none within.
    """
    pairs = associate(path, truth)
    first = int(np.searchsorted(pairs.t_ns, begin_ns, side="right")) - 1
    last = min(int(np.searchsorted(pairs.t_ns, end_ns)), len(pairs) - 1)
    moved = (np.linalg.inv(T[first]) @ T[last] for T in (pairs.estimate, pairs.reference))
    estimated, true = (T[:3, 3] for T in moved)
    between = (truth.t_ns >= pairs.t_ns[first]) & (truth.t_ns <= pairs.t_ns[last])
    way = Trajectory(truth.t_ns[between], truth.T_world_body[between]).path_m
    error = float(np.linalg.norm(estimated - true))
    return {"way_m": way, "error_m": error, "share": error / way}


def main(
    out: Path | None = None,
    seeds: tuple[int, ...] = (0, 1),
    duration_s: float = 580.0,
    blind_at_s: float | None = 420.0,
    radii: tuple[Radii, ...] = ("as told", "both 3 % larger", "left 3 % larger"),
) -> None:
    """Run the cart.

    Args:
        out: folder for results.json.
        seeds: of motion and noise.
        duration_s: 580 s are 506 m.
        blind_at_s: when the camera sees nothing for a minute; None: it always sees.
        radii: of the wheels, against those told.
    """
    answer: list[dict[str, Any]] = []
    print("errors in % of the way: RMSE over all of it, and at the end of the blind minute over the way in that")
    print(f"{'wheels':16} seed  way [m]   filter    graph   blind: filter   in map    graph")
    for seed in seeds:
        for wheels in radii:
            paths, truth, told = run(source(duration_s, blind_at_s), wheels, seed)
            entry: dict[str, Any] = {"wheels": wheels, "seed": seed, "way_m": truth.path_m, "told": told}
            entry["whole"] = {name: of_way(path, truth) for name, path in paths.items()}
            row = f"{wheels:16} {seed:4} {truth.path_m:8.1f}"
            row += "".join(f"{100.0 * entry['whole'][name]['rmse_share']:9.3f}" for name in ("filter", "graph"))
            if blind_at_s is not None:
                begin_ns = int(truth.t_ns[0]) + round(blind_at_s * 1e9)
                end_ns = begin_ns + round(_BLIND_S * 1e9)
                entry["blind"] = {name: gone_on(path, truth, begin_ns, end_ns) for name, path in paths.items()}
                shares = (entry["blind"][name]["share"] for name in ("filter", "in map", "graph"))
                row += " " * 7 + "".join(f"{100.0 * share:9.3f}" for share in shares)
            print(row, flush=True)
            answer.append(entry)
            if out is not None:
                out.mkdir(parents=True, exist_ok=True)
                (out / "results.json").write_text(json.dumps(answer, indent=2))


if __name__ == "__main__":
    tyro.cli(main)
