"""Loop detection where odometry was lost: no help from poses that mean nothing, and never one image alone."""

from dataclasses import replace

import numpy as np
import pytest
from landmark_world import LandmarkWorld, body_pose, lap_poses, room

from vislam.config import LoopConfig
from vislam.geometry import invert, se3_log
from vislam.loop.detector import LoopDetector
from vislam.messages import Array, GraphUpdate, Keyframe, LoopCandidate, LoopDecision, LoopEdge, Pieces

PER_LAP = 40
LOST = PER_LAP + 6  # the keyframe after the loss, of the second lap
CONFIG = LoopConfig()
AWAY = body_pose((40.0, 5.0, 0.0), 70.0)


@pytest.fixture(scope="module")
def laps() -> tuple[LandmarkWorld, list[Array], list[Keyframe]]:
    world, rng, poses = room(1), np.random.default_rng(0), lap_poses(1.5, PER_LAP)
    return world, poses, [world.see(i, pose, rng) for i, pose in enumerate(poses)]


def begin(world: LandmarkWorld, keyframes: list[Keyframe], poses: list[Array], config: LoopConfig) -> LoopDetector:
    detector = LoopDetector(config, world.rig, 0, gravity_aligned=True)
    for keyframe, pose in zip(keyframes[:LOST], poses, strict=False):
        detector.detect(keyframe, pose)
    return detector


def go_on(
    detector: LoopDetector, keyframes: list[Keyframe], estimates: list[Array]
) -> list[tuple[list[LoopEdge], list[LoopCandidate]]]:
    return [
        detector.detect(keyframe, pose, begins_piece=n == 0)
        for n, (keyframe, pose) in enumerate(zip(keyframes, estimates, strict=True))
    ]


def test_a_new_piece_is_placed_by_its_second_keyframe(
    laps: tuple[LandmarkWorld, list[Array], list[Keyframe]],
) -> None:
    world, poses, keyframes = laps
    detector = begin(world, keyframes, poses, CONFIG)
    first, second = go_on(detector, keyframes[LOST : LOST + 2], [AWAY @ pose for pose in poses[LOST : LOST + 2]])
    assert first[0] == []
    waiting = [c for c in first[1] if c.decision is LoopDecision.PARKED]
    assert waiting and all("no other frame agrees yet" in c.reason for c in waiting)
    assert {edge.to_id for edge in second[0]} == {LOST, LOST + 1}
    for edge in second[0]:
        error = se3_log(invert(edge.T_from_to) @ invert(poses[edge.from_id]) @ poses[edge.to_id])
        assert np.linalg.norm(error[3:]) < 0.05 and np.linalg.norm(error[:3]) < np.deg2rad(1.0)
    assert {c.source for c in first[1] + second[1]} == {"appearance"}  # poses mean nothing yet


def test_poses_count_again_once_the_graph_has_joined(
    laps: tuple[LandmarkWorld, list[Array], list[Keyframe]],
) -> None:
    world, poses, keyframes = laps
    detector = begin(world, keyframes, poses, replace(CONFIG, island_gap=0))  # odometry's are not left out for others
    go_on(detector, keyframes[LOST : LOST + 2], [AWAY @ pose for pose in poses[LOST : LOST + 2]])
    ids = np.arange(LOST + 2)
    detector.move(GraphUpdate(1, ids, np.stack(poses[: LOST + 2]), np.eye(4), None, pieces=Pieces((0, LOST), (0, 0))))
    edges, candidates = detector.detect(keyframes[LOST + 2], poses[LOST + 2])
    assert edges
    assert "odometry" in {c.source for c in candidates if c.decision is LoopDecision.ACCEPTED}


def test_the_same_image_again_is_no_second_witness(laps: tuple[LandmarkWorld, list[Array], list[Keyframe]]) -> None:
    """One frame that resembles several old keyframes waits, however sure it is."""
    world, poses, keyframes = laps
    detector = begin(world, keyframes, poses, CONFIG)
    edges, candidates = go_on(detector, keyframes[LOST : LOST + 1], [AWAY @ poses[LOST]])[0]
    parked = [c for c in candidates if c.decision is LoopDecision.PARKED]
    assert len({c.from_id for c in parked}) >= 2
    assert edges == []


def test_frames_that_disagree_through_odometry_wait(laps: tuple[LandmarkWorld, list[Array], list[Keyframe]]) -> None:
    """The odometry of the new piece says that it moved 2 m between two frames that old keyframes place 0.4 m apart."""
    world, poses, keyframes = laps
    detector = begin(world, keyframes, poses, CONFIG)
    estimates = [AWAY @ poses[LOST], AWAY @ poses[LOST + 1] @ body_pose((2.0, 0.0, 0.0), 0.0)]
    found = go_on(detector, keyframes[LOST : LOST + 2], estimates)
    assert [edges for edges, _ in found] == [[], []]
    assert [c for c in found[1][1] if "disagree" in c.reason]


def test_a_loss_right_at_the_start_needs_no_words_of_the_run(
    laps: tuple[LandmarkWorld, list[Array], list[Keyframe]],
) -> None:
    world, poses, keyframes = laps
    detector = LoopDetector(CONFIG, world.rig, 0)
    for k in range(4):
        detector.detect(keyframes[k], poses[k])
    again = [replace(keyframes[k], id=k + 3) for k in (1, 2)]
    found = go_on(detector, again, [AWAY @ poses[k] for k in (1, 2)])
    assert {edge.to_id for edge in found[1][0]} == {4, 5}


def test_the_wrong_place_is_never_found() -> None:
    """The camera comes back in another room of the same shape."""
    world, other, rng, poses = room(1), room(2), np.random.default_rng(0), lap_poses(1.5, PER_LAP)
    keyframes = [(world if i < LOST else other).see(i, pose, rng) for i, pose in enumerate(poses)]
    detector = begin(world, keyframes, poses, CONFIG)
    found = go_on(detector, keyframes[LOST:], poses[LOST:])
    assert not [e for edges, _ in found for e in edges if e.from_id < LOST]
