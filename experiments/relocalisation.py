"""Relocalisation in a saved map: how often a camera that knows nothing finds its place, how well, and how soon.

    .venv/bin/python experiments/relocalisation.py [--world NAME ...] [--every SECONDS] [--out results/relocalisation]
    .venv/bin/python experiments/relocalisation.py --recording tum:FOLDER ... [--step FRAMES]

One simulated recording is the map. The second one goes the same way with other motion, noise and exposure, and the
light goes off and on every five seconds (two stops). Each query begins at another time of the second recording with a
new visual odometry and a new submap, and lasts one second; what it knows is its images and which way is
up, as an IMU would tell. The answer is the pose at the keyframe with which the graph joins the submap to the map; right
is one within 5 cm and 2 degrees of the truth, wrong one off by more than 0.5 m or 10 degrees. Map and truth are aligned
on the map's own keyframes (SE(3)).

Of a recording with depth and truth the first half is the map, and each frame of the second half alone is a query: it
knows nothing but its image and depth. Its answer is the pose that most matches support, given when a second keyframe
of the map says the same, or when its sigma is as small as a loop without a witness needs; right is one within 25 cm and
5 degrees, wrong as above. What a frame could find is asked of the truth: whether a keyframe of the map is near it
(`LoopTruthConfig`). A frame that sees nothing of the map and is answered is counted, and judged by its pose.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vislam.config import Config, LoopTruthConfig, load
from vislam.core.clock import StageClock
from vislam.core.files import write_text
from vislam.core.geometry import align_points, invert, level_rotation, so3_log, transform
from vislam.core.memory import GraphMemory, PlacesMemory
from vislam.core.messages import (
    Array,
    Frame,
    ImuSample,
    Keyframe,
    KeyframePacket,
    LoopCandidate,
    LoopDecision,
    MagSample,
    Tracking,
    VoMeasurement,
    no_observations,
)
from vislam.core.recording import Recording, WrappedRecording
from vislam.datasets import open_dataset
from vislam.frontend import make_frontend
from vislam.graph import PoseGraph
from vislam.loop import LoopCloser, true_places
from vislam.pipeline.front import Front
from vislam.sim import open_world
from vislam.sim.worlds.simulation import Simulation
from vislam.slam import Slam

WORLDS = ("handheld-room", "workshop-cart", "corridor-loop")
LIGHT = {"light_every_s": 5.0, "light_stops": 2.0}
QUERY_S = 1.0
RIGHT_M, RIGHT_DEG = 0.05, 2.0
WRONG_M, WRONG_DEG = 0.5, 10.0
RIGHT_FRAME_M, RIGHT_FRAME_DEG = 0.25, 5.0  # truth and map of a recording are good to centimetres
SURE_SIGMA_M = 0.03  # of a single frame's answer that no other candidate confirms
AGREEMENT_M, AGREEMENT_DEG = 0.15, 8.0  # two candidates of one frame that differ by less say the same
MAP_SIGMAS = np.repeat([np.deg2rad(0.05), 0.002], 3)  # between keyframes of the map, which is held fixed anyway


@dataclass(frozen=True)
class SavedMap:
    """What a run leaves: keyframes that loop detection knows, and where they are."""

    places: PlacesMemory
    T_map_body: Array  # [M, 4, 4]
    T_truth_map: Array  # [4, 4]
    ate_m: float


@dataclass(frozen=True)
class Answer:
    """What became of one query."""

    begin_ns: int
    answered_after_s: float | None  # None: no answer
    keyframes: int
    error_m: float | None
    error_deg: float | None
    cpu_ms: list[float]  # of loop detection, per keyframe


def make_map(recording: Recording, config: Config) -> SavedMap:
    """Run the whole pipeline over a recording."""
    slam = Slam(config, recording.rig, recording.imu_noise)
    steps = [k for value in recording.events() for step in slam.feed(value) for k in step.keyframes]
    slam.finish()
    keyframes = [k.odometry.packet.keyframe for k in steps]
    assert slam.back is not None and slam.back.loops is not None
    poses = slam.back.graph.poses()
    true = recording.truth()
    assert true is not None
    truth = true.at(np.array([k.t_ns for k in keyframes], dtype=np.int64))
    T_truth_map = align_points(poses[:, :3, 3], truth[:, :3, 3])
    moved = np.array([T_truth_map @ T for T in poses])
    ate_m = float(np.sqrt(np.mean(np.sum((moved[:, :3, 3] - truth[:, :3, 3]) ** 2, axis=1))))
    tags = {k.id: step.tags for k, step in zip(keyframes, steps, strict=True)}
    places = PlacesMemory(keyframes, poses, slam.back.loops.words(), tags, 0)
    return SavedMap(places, poses, T_truth_map, ate_m)


def graph_of(known: SavedMap, config: Config, recording: Simulation) -> PoseGraph:
    """Return a graph with the map's keyframes, held where they are."""
    graph = PoseGraph(replace(config.graph, coupling="loose"), None, config.machine, recording.rig, config.window)
    graph.initialise(None, known.T_map_body[0])
    packets = []
    for k, T in enumerate(known.T_map_body):
        moved = np.eye(4) if k == 0 else invert(known.T_map_body[k - 1]) @ T
        t_ns = k * 1_000_000_000
        vo = VoMeasurement(t_ns, max(k - 1, 0), moved, np.diag(MAP_SIGMAS**2), True, Tracking.OK, 0)
        frame = Frame(t_ns, k, ())
        bare = Keyframe(k, t_ns, frame, np.empty((0, 2)), np.empty((0, 32), np.uint8), None)
        packets.append(KeyframePacket(bare, vo, no_observations(), None))
    newest = known.T_map_body[-1]
    graph.restore(GraphMemory(packets, known.T_map_body, newest, [], {}, [], [], vo_scale=1.0, revision=0))
    graph.hold()
    return graph


def ask(known: SavedMap, recording: Simulation, first: int, config: Config) -> Answer:
    """Begin at a frame of the second recording and go on until the place is found, or the time is up."""
    detector, graph = LoopCloser(config.loop, recording.rig, config.seed, True), graph_of(known, config, recording)
    detector.restore(known.places)
    front = Front(config, recording.rig, None, StageClock())
    count, T_map_odom, T_up, cpu_ms = len(known.T_map_body), np.eye(4), None, []
    begin_ns = recording.render(first).t_ns
    for index in range(first, recording.frame_count):
        frame = recording.render(index)
        after_s = (frame.t_ns - begin_ns) * 1e-9
        if after_s > QUERY_S:
            break
        for found in front.process(frame).keyframes:
            T_truth = recording.truth().at(np.array([frame.t_ns]))[0]
            if T_up is None:  # nothing but which way is up
                T_up = transform(level_rotation(T_truth[2, :3]), np.zeros(3)) @ invert(found.T_odom_body)
            packet, T_odom_body = renumbered(found.packet, count), T_up @ found.T_odom_body
            start = time.process_time()
            edges = detector.detect(packet.keyframe, T_map_odom @ T_odom_body, packet.begins_submap)[0]
            cpu_ms.append(1e3 * (time.process_time() - start))
            update = graph.add(packet, edges, T_odom_body)
            detector.move(update)
            T_map_odom = update.T_map_odom
            if update.submaps.are_joined(0, packet.keyframe.id):
                error = invert(T_truth) @ known.T_truth_map @ T_map_odom @ T_odom_body
                turn = so3_log(np.ascontiguousarray(error[:3, :3]))
                metres, degrees = float(np.linalg.norm(error[:3, 3])), float(np.rad2deg(np.linalg.norm(turn)))
                return Answer(begin_ns, after_s, len(cpu_ms), metres, degrees, cpu_ms)
    return Answer(begin_ns, None, len(cpu_ms), None, None, cpu_ms)


def renumbered(packet: KeyframePacket, by: int) -> KeyframePacket:
    """Return a packet whose keyframe comes after those of the map."""
    first = packet.keyframe.id == 0
    keyframe = replace(packet.keyframe, id=packet.keyframe.id + by)
    vo = replace(packet.vo, keyframe_id=packet.vo.keyframe_id + by)
    return replace(packet, keyframe=keyframe, vo=vo, begins_submap=first or packet.begins_submap)


def measure(world: str, every_s: float, width_px: int) -> dict[str, Any]:
    """Return what a world gave: its map, its answers and their summary."""
    config = load(None, {"map.enabled": False, "view.enabled": False})
    # a query begins as a submap does after a loss: keyframes come as soon as they may
    quick = replace(config.frontend, keyframe_max_interval_s=config.frontend.keyframe_min_interval_s)
    known = make_map(open_world(world, 1, image_width_px=width_px), config)
    print(f"{world}: a map of {len(known.T_map_body)} keyframes, ATE {1e3 * known.ate_m:.0f} mm", flush=True)
    again = open_world(world, 2, image_width_px=width_px, **LIGHT)
    hz = (again.frame_count - 1) / again.duration_s
    firsts = range(0, round(again.frame_count - QUERY_S * hz), round(every_s * hz))
    answers = [ask(known, again, first, replace(config, frontend=quick)) for first in firsts]
    found = [a for a in answers if a.error_m is not None and a.error_deg is not None]
    right = [a for a in found if a.error_m <= RIGHT_M and a.error_deg <= RIGHT_DEG]
    wrong = [a for a in found if a.error_m > WRONG_M or a.error_deg > WRONG_DEG]
    summary = {
        "world": world,
        "keyframes": len(known.T_map_body),
        "map_ate_mm": 1e3 * known.ate_m,
        "queries": len(answers),
        "answered": len(found),
        "right": len(right),
        "right_share": len(right) / len(answers),
        "wrong": len(wrong),
        "error_mm": _percentiles([1e3 * a.error_m for a in found]),
        "error_deg": _percentiles([a.error_deg for a in found]),
        "answered_after_s": _percentiles([a.answered_after_s for a in found]),
        "cpu_ms_per_keyframe": _percentiles([ms for a in answers for ms in a.cpu_ms]),
    }
    return {"summary": summary, "answers": [asdict(a) for a in answers]}


class FirstHalf(WrappedRecording):
    """The first half of a recording's frames, and what was measured until then."""

    def __init__(self, recording: Recording) -> None:
        """Take the recording."""
        super().__init__(recording)
        self.frame_count = recording.frame_count // 2

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Yield samples and frames until the middle."""
        left = self.frame_count
        for value in self._recording.events(from_ns):
            left -= isinstance(value, Frame)
            if left < 0:
                return
            yield value


@dataclass(frozen=True)
class FrameAnswer:
    """What one frame alone found in a map."""

    t_ns: int
    sees: bool  # whether something of the map is truly near
    error_m: float | None  # None: no answer
    error_deg: float | None
    cpu_ms: float


def measure_recording(uri: str, step: int) -> dict[str, Any]:
    """Return what single frames of the second half of a recording found in a map of the first."""
    config = load(None, {"map.enabled": False, "view.enabled": False})
    recording = open_dataset(uri)
    known, true = make_map(FirstHalf(recording), config), recording.truth()
    assert true is not None
    print(f"{uri}: a map of {len(known.T_map_body)} keyframes, ATE {1e3 * known.ate_m:.0f} mm", flush=True)
    frames = [value for value in recording.events() if isinstance(value, Frame)][recording.frame_count // 2 :: step]
    queries = [
        _query(frame, len(known.T_map_body), recording, config)
        for frame in frames
        if true.t_ns[0] <= frame.t_ns <= true.t_ns[-1]
    ]
    everything = [*known.places.keyframes, *queries]
    t_ns = np.array([k.t_ns for k in everything], dtype=np.int64)
    points = [np.zeros((0, 3)) if k.points_body_m is None else k.points_body_m for k in everything]
    seen = [p[np.isfinite(p).all(axis=1)] for p in points]
    order = np.arange(len(everything))
    with_depth = np.array([len(p) > 0 for p in seen])
    places = true_places(order, t_ns, true.at(t_ns), seen, with_depth, recording.rig, LoopTruthConfig())
    count = len(known.T_map_body)
    answers = [
        _ask_frame(known, query, places.T_world_body[count + i], bool(places.near[count + i, :count].any()), recording,
                   config)
        for i, query in enumerate(queries)
    ]  # fmt: skip
    found = [a for a in answers if a.error_m is not None and a.error_deg is not None]
    right = [a for a in found if a.error_m <= RIGHT_FRAME_M and a.error_deg <= RIGHT_FRAME_DEG]
    seeing = [a for a in answers if a.sees]
    summary = {
        "recording": uri,
        "keyframes": count,
        "map_ate_mm": 1e3 * known.ate_m,
        "frames": len(answers),
        "see": len(seeing),
        "see_and_answered": sum(a.error_m is not None for a in seeing),
        "see_and_right": sum(a.sees for a in right),
        "answered": len(found),
        "right": len(right),
        "wrong": sum(a.error_m > WRONG_M or a.error_deg > WRONG_DEG for a in found),
        "error_mm": _percentiles([1e3 * a.error_m for a in found]),
        "error_deg": _percentiles([a.error_deg for a in found]),
        "cpu_ms": _percentiles([a.cpu_ms for a in answers]),
    }
    return {"summary": summary, "answers": [asdict(a) for a in answers]}


def _query(frame: Frame, number: int, recording: Recording, config: Config) -> Keyframe:
    """Return a frame as a keyframe with a number, without its image."""
    keyframe = make_frontend(config.frontend, recording.rig, 0).track(frame, None).keyframe
    assert keyframe is not None
    return replace(keyframe, id=number, frame=Frame(frame.t_ns, number, ()))


def _ask_frame(
    known: SavedMap, query: Keyframe, T_truth_body: Array, sees: bool, recording: Recording, config: Config
) -> FrameAnswer:  # fmt: skip
    """Ask the map where one frame is."""
    detector = LoopCloser(config.loop, recording.rig, config.seed)
    detector.restore(known.places)
    start = time.thread_time()
    candidates = detector.detect(query, np.eye(4), begins_submap=True, tags=())[1]
    cpu_ms = 1e3 * (time.thread_time() - start)
    detector.close()
    T_map_body = _answer(candidates, known)
    if T_map_body is None:
        return FrameAnswer(query.t_ns, sees, None, None, cpu_ms)
    error = _error(T_truth_body, known.T_truth_map @ T_map_body)
    return FrameAnswer(query.t_ns, sees, *error, cpu_ms)


def _answer(candidates: list[LoopCandidate], known: SavedMap) -> Array | None:
    """Return T_map_body [4, 4] of the candidate with most support, if another one or its own sigma speaks for it."""
    told = [(c, known.T_map_body[c.from_id] @ c.T_from_to) for c in candidates if c.T_from_to is not None]
    sound = [(c, T) for c, T in told if c.decision is not LoopDecision.REJECTED]
    if not sound:
        return None
    best, T_best = max(sound, key=lambda answer: answer[0].supporters)
    agreeing = {c.from_id: _agree(T_best, T) for c, T in told if c is not best}
    if not all(agreeing[c.from_id] for c, _ in sound if c is not best):
        return None  # the place may exist twice
    return T_best if any(agreeing.values()) or best.sigma_m <= SURE_SIGMA_M else None


def _agree(T: Array, other: Array) -> bool:
    metres, degrees = _error(T, other)
    return metres <= AGREEMENT_M and degrees <= AGREEMENT_DEG


def _error(T: Array, other: Array) -> tuple[float, float]:
    """Return by how many metres and degrees two poses differ."""
    difference = invert(T) @ other
    turn = so3_log(np.ascontiguousarray(difference[:3, :3]))
    return float(np.linalg.norm(difference[:3, 3])), float(np.rad2deg(np.linalg.norm(turn)))


def _each(values: dict[str, float], digits: int) -> str:
    return " / ".join(f"{v:.{digits}f}" for v in values.values()) or "-"


def _frames_row(s: dict[str, Any]) -> str:
    return (
        f"| {s['recording']} | {s['keyframes']} ({s['map_ate_mm']:.0f} mm) | {s['frames']} | {s['see']} "
        f"| {s['see_and_answered']} | {s['see_and_right']} | {s['answered'] - s['see_and_answered']} | {s['wrong']} "
        f"| {_each(s['error_mm'], 0)} | {_each(s['error_deg'], 2)} | {_each(s['cpu_ms'], 0)} |"
    )


def _measure_recordings(uris: list[str], step: int, out: Path) -> None:
    rows = []
    for uri in uris:
        result = measure_recording(uri, step)
        write_text(out / f"{Path(uri.partition(':')[2]).name}.json", json.dumps(result, indent=1))
        rows.append(_frames_row(result["summary"]))
    titles = (
        "recording", "map", "frames", "see the map", "of them answered", "right", "others answered", "wrong",
        "error p50 / p95 / max [mm]", "[deg]", "CPU of loop detection per frame [ms]",
    )  # fmt: skip
    print("\n".join([f"| {' | '.join(titles)} |", "|---" * len(titles) + "|", *rows]))


def _percentiles(values: list[float]) -> dict[str, float]:
    if not values:
        return {}
    return {f"p{q}": float(np.percentile(values, q)) for q in (50, 95, 100)}


def _row(s: dict[str, Any]) -> str:
    return (
        f"| {s['world']} | {s['keyframes']} ({s['map_ate_mm']:.0f} mm) | {s['queries']} | {s['answered']} "
        f"| {s['right']} ({s['right_share']:.1%}) | {s['wrong']} "
        f"| {_each(s['error_mm'], 0)} | {_each(s['error_deg'], 2)} "
        f"| {_each(s['answered_after_s'], 2)} | {_each(s['cpu_ms_per_keyframe'], 0)} |"
    )


def main() -> None:
    """Measure the worlds that the command line names and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--world", nargs="+", default=list(WORLDS))
    parser.add_argument("--recording", nargs="+", help="with depth and truth, instead of worlds")
    parser.add_argument("--step", type=int, default=1, help="every how many frames of a recording are asked")
    parser.add_argument("--every", type=float, default=0.5, help="seconds between the begins of queries")
    parser.add_argument("--width", type=int, default=640, help="of the images, in pixels")
    parser.add_argument("--out", type=Path, default=Path("results/relocalisation"))
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    asked.out.mkdir(parents=True, exist_ok=True)
    if asked.recording:
        _measure_recordings(asked.recording, asked.step, asked.out)
        return
    rows = []
    for world in asked.world:
        result = measure(world, asked.every, asked.width)
        write_text(asked.out / f"{world}.json", json.dumps(result, indent=1))
        rows.append(_row(result["summary"]))
    titles = (
        "world", "map", "queries", "answered", "right", "wrong", "error p50 / p95 / max [mm]", "[deg]",
        "answered after [s]", "CPU of loop detection per keyframe [ms]",
    )  # fmt: skip
    print("\n".join([f"| {' | '.join(titles)} |", "|---" * len(titles) + "|", *rows]))


if __name__ == "__main__":
    main()
