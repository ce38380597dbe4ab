"""The pictures that explain loop decisions: which are chosen, what is written, how much is kept."""

import math
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from vislam.core.memory import LoopPlace
from vislam.core.messages import Frame, GraphUpdate, Keyframe, LoopCandidate, LoopDecision, LoopEdge
from vislam.loop import LoopRow, as_candidate, caption
from vislam.loop.injection import FIRST_ID
from vislam.runs import loop_gallery
from vislam.runs.folder import RunLog
from vislam.runs.loop_gallery import LoopGallery, chosen


def row(from_id, to_id, decision="rejected", reason="9 inliers, needs 12", **changes):
    usual = LoopRow(
        from_id, to_id, 10, 20, "appearance", 0.5, 30.0, 41.0, 0.02, 0.0, math.nan, math.nan, math.nan, math.nan, None,
        decision, reason,
    )  # fmt: skip
    return replace(usual, **changes)


def step(identifier, candidates=(), image=None):
    if image is None:
        image = np.random.default_rng(identifier).integers(0, 256, (240, 320), dtype=np.uint8)
    frame = Frame(identifier, identifier, () if image is False else (image,))
    keyframe = Keyframe(identifier, identifier, frame, np.zeros((0, 2)), np.zeros((0, 32), np.uint8), None)
    return SimpleNamespace(
        odometry=SimpleNamespace(packet=SimpleNamespace(keyframe=keyframe)),
        candidates=list(candidates),
        record=SimpleNamespace(loops=()),
    )


def candidate(from_id, to_id, matches=True):
    pixels = np.array([[10.0, 20.0, 200.0, 100.0], [300.0, 30.0, math.nan, math.nan]]) if matches else None
    return LoopCandidate(from_id, to_id, "odometry", 0.5, 30, LoopDecision.REJECTED, "", matches_px=pixels)


def test_accepted_ones_that_moved_the_map_come_first_and_others_by_what_they_had():
    rows = [
        row(1, 30, "accepted", moved_max_m=0.1),
        row(2, 30, "accepted", moved_max_m=0.5),  # the same keyframe: only the one that moved more
        row(3, 31, "accepted", moved_max_m=0.3),
        row(3, 31, "pending"),  # is told with its acceptance
        row(4, 32, supporters=10.0),
        row(5, 33, supporters=99.0, reason="only 20% agree in depth, needs 50%"),
        row(6, 34, supporters=50.0),
        row(7, 35, "pending", supporters=70.0, reason="5 neighbours disagree"),
    ]
    assert chosen(rows, range(len(rows))) == [1, 2, 5, 7, 6, 4]
    assert chosen(rows, [0, 4]) == [0, 4]  # only what there are pictures of


def test_numbers_are_bounded_and_reasons_mixed():
    rows = [row(k, 100 + k, supporters=float(k), reason=f"{k} inliers of 50") for k in range(40)]
    rows += [row(k, 200 + k, "accepted", moved_max_m=float(k)) for k in range(40)]
    picked = chosen(rows, range(len(rows)))
    assert [rows[k].decision for k in picked].count("accepted") == 12
    assert sum("inliers of 50" in rows[k].reason for k in picked) == 4


def test_pairs_are_written_with_their_matches(tmp_path):
    gallery = LoopGallery()
    white = np.full((240, 320), 255, np.uint8)
    gallery.add(step(0, image=white))
    gallery.add(step(1, image=False))  # a frame that brought tracks only
    gallery.add(step(2, [candidate(0, 2), candidate(0, 2, matches=False), candidate(1, 2)], white))
    rows = [row(0, 2, "accepted"), row(0, 2), row(1, 2)]
    ((told, path),) = gallery.write(tmp_path, rows)
    assert told is rows[0]
    assert path == tmp_path / "loops" / "00_0_2_accepted.jpg"
    picture = cv2.imread(str(path)).astype(int)
    assert picture.shape == (225, 600, 3)
    green = (picture[..., 1] - picture[..., 2] > 40).sum(axis=0)  # the one match that both images have
    assert green[9:12].all()
    assert green[300 + 185 : 300 + 188].all()
    assert not green[300 + 195 :].any()
    again = gallery.write(tmp_path / "loops" / "..", rows)
    assert again[0][1].read_bytes() == path.read_bytes()


def test_memory_is_bounded_and_the_oldest_are_forgotten(monkeypatch, tmp_path):
    monkeypatch.setattr(loop_gallery, "_MAX_THUMBNAIL_BYTES", 150_000)
    gallery = LoopGallery()
    for k in range(12):
        gallery.add(step(k, [candidate(k - 1, k)] if k else []))
    shown = sorted(pair.to_id for pair, _ in gallery.write(tmp_path, [row(k - 1, k, "accepted") for k in range(1, 12)]))
    assert 0 < len(shown) < 11
    assert shown == list(range(12 - len(shown), 12))


def test_a_caption_says_what_is_known_and_leaves_out_the_rest():
    assert caption(row(3, 9)) == "3 – 9 rejected: 9 inliers, needs 12"
    known = row(
        3, 9, "accepted", "30 inliers; chi2 4.2 within 22.5", chi2=4.24, weight=0.5, moved_rms_m=0.012, moved_max_m=0.1
    )
    assert caption(known) == (
        "3 – 9 accepted: 30 inliers; chi2 4.2 within 22.5, weight 0.50, moved the map by 1.2 cm rms, 10.0 cm at most"
    )


def test_a_picture_that_cannot_be_written_says_so(tmp_path):
    gallery = LoopGallery()
    gallery.add(step(0))
    gallery.add(step(2, [candidate(0, 2)]))
    (tmp_path / "loops").write_text("in the way")
    with pytest.raises(Exception, match="cannot be written"):
        gallery.write(tmp_path, [row(0, 2)])


def keyframe_step(k, x_m, moved, accepted=(), edges=(), candidates=(), states=()):
    """A keyframe along x, what its update moved where to, and the loops that this took in."""
    pose = np.eye(4)
    pose[0, 3] = x_m
    poses = np.tile(np.eye(4), (len(moved), 1, 1))
    poses[:, 0, 3] = list(moved.values())
    update = GraphUpdate(k, np.array(list(moved), np.int64), poses, np.eye(4), None, accepted)
    told = step(k, candidates)
    told.odometry.packet.imu, told.odometry.T_odom_body = None, pose
    told.update, told.edges, told.retrieved, told.record = update, list(edges), [], SimpleNamespace(loops=states)
    return told


def test_of_loops_that_one_update_took_in_each_has_its_own_share_and_redundant_ones_none():
    def edge(i, a, b, variance):
        return LoopEdge(i, a, b, np.eye(4), variance * np.eye(6), True, 30, 0.5)

    spare = SimpleNamespace(id=9, place=LoopPlace.SPARE)
    log = RunLog()
    for k in range(3):
        log.add_keyframe(keyframe_step(k, float(k), {k: float(k)}))
    edges = [edge(6, 0, 3, 1.0), edge(7, 1, 3, 0.5), edge(8, 0, 1, 0.1), edge(9, 2, 3, 0.01)]
    log.add_keyframe(keyframe_step(3, 3.0, {2: 2.2, 3: 3.4}, (6, 7, 8, 9), edges, states=[spare]))
    largest = {i: shift[1] for i, shift in log.shifts([6, 7, 8, 9]).items()}
    assert sum(largest.values()) == pytest.approx(0.2)  # of keyframe 2, which was in the map
    assert largest[7] == pytest.approx(2.0 * largest[6])  # it is twice as certain, and the motion is the same
    assert largest[8] == largest[9] == 0.0  # its ends did not move against each other; and one is redundant


def test_what_an_accepted_loop_moved_is_told_with_it():
    accepted = replace(candidate(0, 2), decision=LoopDecision.ACCEPTED)
    edge = LoopEdge(7, 0, 2, np.eye(4), np.eye(6), True, 30, 0.5)
    log = RunLog()
    log.add_keyframe(keyframe_step(0, 0.0, {0: 0.0}))
    log.add_keyframe(keyframe_step(1, 1.0, {}))  # where odometry put it
    log.add_keyframe(keyframe_step(2, 2.0, {1: 1.3, 2: 2.5}, (7,), [edge], [accepted, candidate(1, 2)]))
    report = SimpleNamespace(chi2=3.0, weight=0.9, decision=LoopDecision.ACCEPTED, reason="inside the gate")
    taken, other = log.loop_rows({7: report})
    assert taken.moved_max_m == pytest.approx(0.3)
    assert taken.moved_rms_m == pytest.approx(np.sqrt(0.3**2 / 2))  # of the two that were there before
    assert (taken.chi2, taken.weight, taken.was_offered) == (3.0, 0.9, True)
    assert math.isnan(other.moved_max_m) and not other.was_offered


def test_a_false_loop_made_up_between_the_ends_of_a_true_one_is_told_apart():
    ends = (0, 2, np.eye(4), np.eye(6), True, 30, 0.5)
    true, false = LoopEdge(7, *ends), LoopEdge(FIRST_ID, *ends)
    told = step(2, [replace(candidate(0, 2), decision=LoopDecision.ACCEPTED), as_candidate(false)])
    told.odometry.packet.imu, told.odometry.T_odom_body = None, np.eye(4)
    told.update = GraphUpdate(0, np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.eye(4), None)
    told.edges, told.retrieved = [true, false], []
    log = RunLog()
    log.add_keyframe(told)
    reports = {
        7: SimpleNamespace(chi2=3.0, weight=0.9, decision=LoopDecision.ACCEPTED, reason="inside the gate"),
        FIRST_ID: SimpleNamespace(chi2=99.0, weight=0.0, decision=LoopDecision.PENDING, reason="beyond the gate"),
    }
    assert [(row.source, row.decision) for row in log.loop_rows(reports)] == [
        (candidate(0, 2).source, "accepted"),
        ("injected", "pending"),
    ]
