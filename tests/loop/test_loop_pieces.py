"""Loop detection where odometry was lost: no help from poses that mean nothing."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import LoopConfig
from vislam.core.geometry import invert, se3_log
from vislam.core.messages import Array, GraphUpdate, Keyframe, LoopCandidate, LoopDecision, LoopEdge, Submaps
from vislam.loop.closer import LoopCloser
from worlds.landmarks import LandmarkWorld, body_pose, lap_poses, room

Laps = tuple[LandmarkWorld, list[Array], list[Keyframe]]
PER_LAP = 40
LOST = PER_LAP + 6  # the keyframe after the loss, of the second lap
CONFIG = LoopConfig()
AWAY = body_pose((40.0, 5.0, 0.0), 70.0)


@pytest.fixture(scope="module")
def laps() -> Laps:
    world, rng, poses = room(1), np.random.default_rng(0), lap_poses(1.5, PER_LAP)
    return world, poses, [world.see(i, pose, rng) for i, pose in enumerate(poses)]


def begin(world: LandmarkWorld, keyframes: list[Keyframe], poses: list[Array], config: LoopConfig) -> LoopCloser:
    detector = LoopCloser(config, world.rig, 0, gravity_aligned=True)
    for keyframe, pose in zip(keyframes[:LOST], poses, strict=False):
        detector.detect(keyframe, pose)
    return detector


def go_on(
    detector: LoopCloser, keyframes: list[Keyframe], estimates: list[Array]
) -> list[tuple[list[LoopEdge], list[LoopCandidate]]]:
    return [
        detector.detect(keyframe, pose, begins_submap=n == 0)
        for n, (keyframe, pose) in enumerate(zip(keyframes, estimates, strict=True))
    ]


def test_a_new_submap_offers_what_looks_alike_from_its_first_keyframe_on(laps: Laps) -> None:
    world, poses, keyframes = laps
    detector = begin(world, keyframes, poses, CONFIG)
    found = go_on(detector, keyframes[LOST : LOST + 2], [AWAY @ pose for pose in poses[LOST : LOST + 2]])
    for n, (edges, candidates) in enumerate(found):
        assert {edge.to_id for edge in edges} == {LOST + n}
        assert {c.source for c in candidates} == {"appearance"}  # poses mean nothing yet
        for edge in edges:
            error = se3_log(invert(edge.T_from_to) @ invert(poses[edge.from_id]) @ poses[edge.to_id])
            assert np.linalg.norm(error[3:]) < 0.05 and np.linalg.norm(error[:3]) < np.deg2rad(1.0)


def test_poses_count_again_once_the_graph_has_joined(laps: Laps) -> None:
    world, poses, keyframes = laps
    detector = begin(world, keyframes, poses, replace(CONFIG, island_gap=0))  # odometry's are not left out for others
    go_on(detector, keyframes[LOST : LOST + 2], [AWAY @ pose for pose in poses[LOST : LOST + 2]])
    ids = np.arange(LOST + 2)
    detector.move(GraphUpdate(1, ids, np.stack(poses[: LOST + 2]), np.eye(4), None, submaps=Submaps((0, LOST), (0, 0))))
    edges, candidates = detector.detect(keyframes[LOST + 2], poses[LOST + 2])
    assert edges
    assert "odometry" in {c.source for c in candidates if c.decision is LoopDecision.ACCEPTED}


def test_a_loss_right_at_the_start_needs_no_words_of_the_run(laps: Laps) -> None:
    world, poses, keyframes = laps
    detector = LoopCloser(CONFIG, world.rig, 0)
    for k in range(4):
        detector.detect(keyframes[k], poses[k])
    again = [replace(keyframes[k], id=k + 3) for k in (1, 2)]
    found = go_on(detector, again, [AWAY @ poses[k] for k in (1, 2)])
    assert [{edge.to_id for edge in edges} for edges, _ in found] == [{4}, {5}]


def test_the_wrong_place_is_never_found() -> None:
    """The camera comes back in another room of the same shape."""
    world, other, rng, poses = room(1), room(2), np.random.default_rng(0), lap_poses(1.5, PER_LAP)
    keyframes = [(world if i < LOST else other).see(i, pose, rng) for i, pose in enumerate(poses)]
    detector = begin(world, keyframes, poses, CONFIG)
    found = go_on(detector, keyframes[LOST:], poses[LOST:])
    assert not [e for edges, _ in found for e in edges if e.from_id < LOST]
