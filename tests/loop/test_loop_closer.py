"""The detector end to end on two laps through landmarks: what it offers, what it rejects, and why."""

import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from vislam.config import LoopConfig
from vislam.core.geometry import invert, se3_exp, se3_log, transform
from vislam.core.messages import Array, GraphUpdate, Keyframe, LoopCandidate, LoopDecision, LoopEdge
from vislam.loop.closer import LoopCloser
from worlds.landmarks import LandmarkWorld, body_pose, lap_poses, make_rig, room

Laps = tuple[LandmarkWorld, list[Array], list[Keyframe]]
PER_LAP = 40
AWAY = transform(np.eye(3), np.array([40.0, 0.0, 0.0]))
CONFIG = replace(LoopConfig(), appearance_skip_keyframes=12, appearance_skip_s=1.0)


def drifting(poses: list[Array], seed: int, sigma_m: float, sigma_deg: float) -> list[Array]:
    """Return the poses as an odometry with this noise per step would see them."""
    rng, out = np.random.default_rng(seed), [poses[0]]
    for before, after in itertools.pairwise(poses):
        noise = np.concatenate([rng.normal(size=3) * np.deg2rad(sigma_deg), rng.normal(size=3) * sigma_m])
        out.append(out[-1] @ invert(before) @ after @ se3_exp(noise))
    return out


def run(
    detector: LoopCloser, keyframes: list[Keyframe], estimates: list[Array]
) -> tuple[list[LoopEdge], list[LoopCandidate]]:
    edges: list[LoopEdge] = []
    candidates: list[LoopCandidate] = []
    for keyframe, estimate in zip(keyframes, estimates, strict=True):
        found, tried = detector.detect(keyframe, estimate)
        edges += found
        candidates += tried
    return edges, candidates


def worst_error(edges: list[LoopEdge], poses: list[Array]) -> tuple[float, float]:
    """Return the largest errors of edges with scale, in metres and degrees."""
    xi = [se3_log(invert(edge.T_from_to) @ invert(poses[edge.from_id]) @ poses[edge.to_id]) for edge in edges]
    metres = max(float(np.linalg.norm(x[3:])) for x in xi)
    return metres, max(float(np.rad2deg(np.linalg.norm(x[:3]))) for x in xi)


@pytest.fixture(scope="module")
def laps() -> Laps:
    world, rng, poses = room(1), np.random.default_rng(0), lap_poses(2.0, PER_LAP)
    return world, poses, [world.see(i, pose, rng) for i, pose in enumerate(poses)]


def test_the_second_lap_closes_on_the_first(laps: Laps) -> None:
    world, poses, keyframes = laps
    edges, candidates = run(
        LoopCloser(CONFIG, world.rig, 0, gravity_aligned=True), keyframes, drifting(poses, 1, 0.01, 0.2)
    )
    closing = [edge for edge in edges if edge.to_id - edge.from_id > PER_LAP // 2]
    assert len({edge.to_id for edge in closing}) >= 0.9 * PER_LAP
    metres, degrees = worst_error(edges, poses)
    assert metres < 0.08
    assert degrees < 1.0
    assert [edge.id for edge in edges] == list(range(len(edges)))
    assert all(edge.from_id < edge.to_id for edge in edges)
    accepted = [c for c in candidates if c.decision is LoopDecision.ACCEPTED]
    assert [(c.from_id, c.to_id) for c in accepted] == [(e.from_id, e.to_id) for e in edges]


def test_appearance_closes_loops_where_odometry_is_lost(laps: Laps) -> None:
    """The second lap's estimate is off by 40 m, so the map's poses suggest nothing; appearance alone must do it."""
    world, poses, keyframes = laps
    estimates = poses[:PER_LAP] + [AWAY @ pose for pose in poses[PER_LAP:]]
    edges, candidates = run(LoopCloser(CONFIG, world.rig, 0), keyframes, estimates)
    # not the last two of the first lap, which are neighbours of what odometry finds at the end of the second
    closing = [edge for edge in edges if edge.from_id < PER_LAP - 2 and edge.to_id >= PER_LAP]
    sources = {(c.from_id, c.to_id): c.source for c in candidates}
    assert {sources[edge.from_id, edge.to_id] for edge in closing} == {"appearance"}
    assert len({edge.to_id for edge in closing}) >= 0.8 * PER_LAP
    assert worst_error(closing, poses)[0] < 0.06
    persistent = [c for c in candidates if c.source == "appearance" and c.consistency > 3]
    assert len(persistent) > PER_LAP // 2


def test_every_candidate_has_a_decision_and_a_reason(laps: Laps) -> None:
    world, poses, keyframes = laps
    detector = LoopCloser(replace(CONFIG, min_rigid=0), world.rig, 0)  # what is not alike is verified, too
    _, candidates = run(detector, keyframes, poses)
    assert all(c.reason and c.source in ("appearance", "odometry") and c.from_id < c.to_id for c in candidates)
    rejected = [c for c in candidates if c.decision is LoopDecision.REJECTED]
    assert rejected
    assert all(any(word in c.reason for word in ("needs", "limit", "not verified")) for c in rejected)
    decisions = Counter(c.decision.value for c in candidates)
    assert {k: detector.counters[k] for k in ("accepted", "rejected")} == dict(decisions)
    per_keyframe = Counter(c.to_id for c in candidates if "not verified" not in c.reason)
    assert max(per_keyframe.values()) <= CONFIG.max_verifications


def test_two_runs_give_the_same_bytes(laps: Laps) -> None:
    world, poses, keyframes = laps
    runs = []
    for _ in range(2):
        detector = LoopCloser(CONFIG, world.rig, 3)
        edges, candidates = run(detector, keyframes[: PER_LAP + 15], poses[: PER_LAP + 15])
        runs.append((
            detector.vocabulary.hash,
            [(e.id, e.from_id, e.to_id, e.T_from_to.tobytes(), e.covariance.tobytes()) for e in edges],
            [(c.from_id, c.to_id, c.score, c.reason) for c in candidates],
        ))  # fmt: skip
    assert runs[0][1]
    assert runs[0] == runs[1]


def test_the_vocabulary_is_trained_again_as_the_run_grows(laps: Laps) -> None:
    world, poses, keyframes = laps
    detector, changes, last = LoopCloser(CONFIG, world.rig, 0), [], None
    for keyframe, pose in zip(keyframes, poses, strict=True):
        detector.detect(keyframe, pose)
        now = detector.vocabulary.hash
        if now != last:
            changes.append(keyframe.id + 1)
        last = now
    assert changes == [1, 22, 27, 33, 40, 49, 60, 75]  # the seed, then what was trained at 20, 25, 31, ...


def test_another_place_gives_no_edge() -> None:
    """The second lap is in a room of the same shape with other landmarks, where the map says it is the same room."""
    first, second, poses, rng = room(1), room(2), lap_poses(2.0, PER_LAP), np.random.default_rng(0)
    keyframes = [(first if i < PER_LAP else second).see(i, pose, rng) for i, pose in enumerate(poses)]
    edges, candidates = run(LoopCloser(CONFIG, first.rig, 0), keyframes, poses)
    across = [c for c in candidates if c.from_id < PER_LAP <= c.to_id]
    assert len(across) > PER_LAP
    assert all(c.decision is LoopDecision.REJECTED for c in across)
    assert not [e for e in edges if e.from_id < PER_LAP <= e.to_id]


def test_a_tilted_copy_of_a_place_contradicts_gravity() -> None:
    """An alias that geometry cannot tell: the same landmarks, all tilted by 20 degrees. Only gravity knows."""
    world, poses, rng = room(1), lap_poses(1.25, PER_LAP), np.random.default_rng(0)
    tilt = body_pose((0.0, 0.0, 0.0), 0.0, 0.0, 20.0)
    copy = LandmarkWorld(world.points @ tilt[:3, :3].T, world.descriptors, world.rig)
    away = np.eye(4)
    away[:3, 3] = [30.0, 0.0, 0.0]
    seen = [(world if i < PER_LAP else copy).see(i, pose, rng) for i, pose in enumerate(poses)]
    estimates = [pose if i < PER_LAP else away @ pose for i, pose in enumerate(poses)]
    blind, _ = run(LoopCloser(CONFIG, world.rig, 0), seen, estimates)
    assert [e for e in blind if e.from_id < PER_LAP <= e.to_id]  # it does fool everything else
    edges, candidates = run(LoopCloser(CONFIG, world.rig, 0, gravity_aligned=True), seen, estimates)
    assert not [e for e in edges if e.from_id < PER_LAP <= e.to_id]
    assert [c for c in candidates if "off gravity" in c.reason]


def test_what_nothing_speaks_against_is_offered_at_once(laps: Laps) -> None:
    """The first keyframe that sees an old place offers its loops, however far off odometry is: the graph decides."""
    world, poses, keyframes = laps
    detector = LoopCloser(replace(CONFIG, max_odometry=0), world.rig, 0)
    run(detector, keyframes[:PER_LAP], poses[:PER_LAP])
    edges, candidates = detector.detect(keyframes[PER_LAP], AWAY @ poses[PER_LAP])
    sound = [c for c in candidates if c.decision is not LoopDecision.REJECTED]
    assert edges
    assert {c.decision for c in sound} == {LoopDecision.ACCEPTED}
    assert [(c.from_id, c.to_id) for c in sound] == [(e.from_id, e.to_id) for e in edges]


def test_a_map_that_moves_is_followed(laps: Laps) -> None:
    """The old keyframes were 40 m off; once the graph has moved them, odometry finds them again."""
    world, poses, keyframes = laps
    still = replace(CONFIG, max_appearance=0)
    for moves in (False, True):
        detector = LoopCloser(still, world.rig, 0)
        run(detector, keyframes[:PER_LAP], [AWAY @ pose for pose in poses[:PER_LAP]])
        if moves:
            ids = np.arange(PER_LAP + 3)  # some that the detector has not met yet
            detector.move(GraphUpdate(1, ids, np.stack(poses[: PER_LAP + 3]), np.eye(4), None))
        edges, _ = run(detector, keyframes[PER_LAP : PER_LAP + 5], poses[PER_LAP : PER_LAP + 5])
        assert bool(edges) == moves


def test_without_depth_edges_have_no_scale() -> None:
    world, rng, poses = room(1), np.random.default_rng(0), lap_poses(1.5, PER_LAP)
    # a second lap half a metre further in, so that there is a direction
    inner = lap_poses(1.5, PER_LAP, 2.0)
    mixed = poses[:PER_LAP] + inner[PER_LAP:]
    keyframes = [world.see(i, pose, rng, depth=False) for i, pose in enumerate(mixed)]
    edges, candidates = run(LoopCloser(CONFIG, world.rig, 0), keyframes, drifting(mixed, 2, 0.005, 0.1))
    assert [e for e in edges if e.from_id < PER_LAP <= e.to_id]
    assert not any(edge.has_scale for edge in edges)
    for edge in edges:
        truth = invert(mixed[edge.from_id]) @ mixed[edge.to_id]
        assert np.linalg.norm(edge.T_from_to[:3, 3]) == pytest.approx(1.0)
        assert np.rad2deg(np.linalg.norm(se3_log(invert(edge.T_from_to) @ truth)[:3])) < 2.0
    accepted = [c.reason for c in candidates if c.decision is LoopDecision.ACCEPTED]
    assert all("direction good to" in reason for reason in accepted)


def test_poor_keyframes_do_no_harm(laps: Laps) -> None:
    """Without features, with NaN everywhere, without any point: recorded at most, never a traceback."""
    world, poses, keyframes = laps
    bad = keyframes[5]
    nothing = replace(
        bad, keypoints_px=np.empty((0, 2)), descriptors=np.empty((0, 32), np.uint8), points_body_m=np.empty((0, 3))
    )
    blind = replace(bad, keypoints_px=np.full_like(bad.keypoints_px, np.nan))
    assert bad.points_body_m is not None
    pointless = replace(bad, points_body_m=np.full_like(bad.points_body_m, np.nan))
    detector = LoopCloser(replace(CONFIG, first_training=3), world.rig, 0)
    sequence = [nothing, blind, nothing, pointless, nothing, blind, *keyframes[:8], nothing, blind, pointless]
    edges, _ = run(detector, [replace(k, id=i) for i, k in enumerate(sequence)], [poses[0]] * len(sequence))
    assert all(np.all(np.isfinite(edge.T_from_to)) for edge in edges)


def test_switched_off_it_does_nothing(laps: Laps) -> None:
    world, poses, keyframes = laps
    edges, candidates = run(LoopCloser(replace(CONFIG, enabled=False), world.rig, 0), keyframes[:12], poses[:12])
    assert edges == []
    assert candidates == []


def test_it_keeps_no_images() -> None:
    rig, world, rng = make_rig(), room(1), np.random.default_rng(0)
    detector = LoopCloser(CONFIG, rig, 0)
    keyframe = world.see(0, body_pose((0.0, 0.0, 0.0), 0.0), rng)
    detector.detect(keyframe, np.eye(4))
    view = detector._views[0]
    held = [view.descriptors, view.xy, view.points_cam_m]
    assert sum(array.nbytes for array in held if array is not None) <= 60 * len(keyframe.descriptors)
