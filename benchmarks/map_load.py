"""How long a saved map takes until a recording can be found in it: read, graph built, features indexed, one query.

`python benchmarks/map_load.py [KEYFRAMES] [FEATURES]` writes a synthetic session and loads it: laps on a circle with
tracks, inertial data of none, a loop to the lap before with every fifth keyframe, no clouds.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

import numpy as np

from vislam.config import Config
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert, se3_exp, so3_exp, transform
from vislam.core.memory import EdgeRecord, GraphRecord, KeyframeEntry, LoopPlace, LoopState, WindowRecord, WordsMemory
from vislam.core.messages import (
    Frame,
    GraphUpdate,
    Keyframe,
    KeyframePacket,
    LoopDecision,
    LoopEdge,
    Observations,
    Tracking,
    VoMeasurement,
)
from vislam.loop import LoopCloser, train
from vislam.runs.session import Session, SessionWriter, recall
from vislam.slam import Slam

LAP = 200  # keyframes
RADIUS_M = 15.0
PERIOD_NS = 300_000_000
RIG = Rig((Camera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.0, "radtan", (-0.2, 0.05, 0.0, 0.0)),), (np.eye(4),), True)
COVARIANCE = np.diag([1e-6] * 3 + [1e-5] * 3)


def pose(k: int) -> np.ndarray:
    """Return where keyframe k is [4, 4]."""
    angle = 2.0 * np.pi * k / LAP
    return transform(
        so3_exp(np.array([0.0, 0.0, angle])), RADIUS_M * np.array([np.cos(angle), np.sin(angle), 0.01 * k])
    )


def keyframe_of(k: int, features: int, rng: np.random.Generator, places: np.ndarray) -> Keyframe:
    """Return a keyframe whose descriptors are those of its place on the circle, with some bits flipped."""
    flips = rng.random((features, 256)) < 20 / 256
    descriptors = places[k % LAP] ^ np.packbits(flips, axis=1)
    pixels = rng.uniform([0, 0], [640, 480], (features, 2))
    points = np.column_stack([(pixels - [320, 240]) / 400.0, np.ones(features)]) * rng.uniform(1, 8, (features, 1))
    return Keyframe(k, k * PERIOD_NS, Frame(k * PERIOD_NS, k, ()), pixels, descriptors, points)


def write(path: Path, keyframes: int, features: int) -> Keyframe:
    """Write the session; return a view of a place on the way."""
    rng = np.random.default_rng(0)
    places = rng.integers(0, 256, (LAP, features, 32), np.uint8)
    info = {"config": {}, "source": "synthetic"}
    with_words = 3 * keyframes // 4  # the next training is not due while it is measured
    writer = SessionWriter.create(path, info, RIG, None, 9.81)
    seen = []
    for k in range(keyframes):
        keyframe = keyframe_of(k, features, rng, places)
        seen.append(keyframe.descriptors)
        T = np.eye(4) if k == 0 else invert(pose(k - 1)) @ pose(k)
        vo = VoMeasurement(keyframe.t_ns, max(k - 1, 0), T, COVARIANCE, True, Tracking.OK, 200)
        tracks = np.arange(k * 50, k * 50 + 300)
        packet = KeyframePacket(keyframe, vo, Observations(tracks, rng.uniform(0, 480, (300, 2))), None)
        edges, states = [], []
        if k > LAP and k % 5 == 0:
            T_loop = invert(pose(k - LAP)) @ pose(k) @ se3_exp(1e-3 * rng.normal(size=6))
            edges.append(LoopEdge(k, k - LAP, k, T_loop, 4 * COVARIANCE, True, 80, 0.4))
            states.append(LoopState(k, LoopDecision.ACCEPTED, "inside the gate", 3.0, LoopPlace.GRAPH, None))
        said = WindowRecord(k, keyframe.t_ns, (EdgeRecord(k, T, COVARIANCE, True),) if k else (), (), "")
        words = None
        if k == with_words:
            config = Config().loop
            tree = train(seen, config.vocabulary_branching, config.vocabulary_depth, 0, config.training_descriptors)
            words = WordsMemory(tree.to_bytes(), k, 3)
        change = GraphUpdate(k + 1, np.array([k]), pose(k)[None], np.eye(4), None)
        record = GraphRecord(window=said, loops=tuple(states))
        writer.add(KeyframeEntry(packet, pose(k), change, record, edges, words=words))
    writer.close(finished=True)
    return keyframe_of(keyframes, features, rng, places)


def load(path: Path, query: Keyframe) -> dict[str, float]:
    """Load the map and look for one keyframe in it; return seconds of CPU per step, and of the clock in all."""
    spent, last, began = {}, time.process_time(), time.perf_counter()

    def step(name: str) -> None:
        nonlocal last
        spent[name], last = time.process_time() - last, time.process_time()

    with closing(Session(path)) as session:
        memory = recall(session)
    assert memory is not None
    step("read")
    slam = Slam(Config(), RIG)
    slam.begin_in_map(memory)
    step("graph and index")
    assert slam.back is not None and isinstance(slam.back.loops, LoopCloser)
    _, candidates = slam.back.loops.detect(query, np.eye(4), begins_submap=True)
    step("first query")
    spent["by the clock"] = time.perf_counter() - began
    spent["candidates"] = float(len(candidates))
    slam.back.loops.close()  # or a training that begins now would go on beside the next measurement
    return spent


def main() -> None:
    """Write a session and load it three times."""
    keyframes = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    features = int(sys.argv[2]) if len(sys.argv) > 2 else 1000
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.db"
        small = Path(folder) / "small.db"
        load(small, write(small, 260, 100))  # compiles
        query = write(path, keyframes, features)
        print(f"{keyframes} keyframes of {features} features, {path.stat().st_size / 1e6:.0f} MB")
        for _ in range(3):
            print({name: round(value, 3) for name, value in load(path, query).items()})


if __name__ == "__main__":
    main()
