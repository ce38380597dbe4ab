"""Real recordings: no edge that is grossly wrong, and errors as large as the covariance says."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from vislam.config import FrontEndConfig, LoopConfig
from vislam.core.geometry import invert, se3_exp, se3_log
from vislam.core.messages import Array, Frame, Keyframe, LoopDecision
from vislam.datasets import open_dataset
from vislam.frontend import make_frontend
from vislam.loop.closer import LoopCloser

EVERY = 6  # frames from keyframe to keyframe


def every_nth(uri: str) -> tuple[LoopCloser, list[Keyframe], Array]:
    """Return a detector, every n-th frame as a keyframe (the first of its own front end), and the true poses."""
    recording = open_dataset(uri)
    truth = recording.truth()
    assert truth is not None
    keyframes: list[Keyframe] = []
    columns = {field.name: getattr(recording.frames, field.name)[::EVERY] for field in fields(recording.frames)}
    recording.frames = replace(recording.frames, **columns)  # the others are not decoded
    recording.frame_count = len(recording.frames.t_ns)
    for frame in (event for event in recording.events() if isinstance(event, Frame)):
        if not truth.t_ns[0] <= frame.t_ns <= truth.t_ns[-1]:
            continue
        first = make_frontend(FrontEndConfig(), recording.rig, 0).track(frame, None).keyframe
        assert first is not None
        keyframes.append(
            Keyframe(len(keyframes), first.t_ns, frame, first.keypoints_px, first.descriptors, first.points_body_m)
        )
    poses = truth.at(np.array([keyframe.t_ns for keyframe in keyframes]))
    return LoopCloser(LoopConfig(), recording.rig, 0), keyframes, poses


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("uri", "least_edges", "median_m", "median_deg"),
    [("tum:tum_fr1_desk", 60, 0.03, 1.5), ("euroc:euroc_mh01_17s", 60, 0.015, 0.4)],
)
def test_no_edge_is_grossly_wrong(
    data_root: Path, uri: str, least_edges: int, median_m: float, median_deg: float
) -> None:
    name, folder = uri.split(":")
    detector, keyframes, poses = every_nth(f"{name}:{data_root / folder}")
    rng, estimate, errors, chi2 = np.random.default_rng(0), poses[0], [], []
    for i, keyframe in enumerate(keyframes):
        if i:
            noise = np.concatenate([rng.normal(size=3) * 0.003, rng.normal(size=3) * 0.01])
            estimate = estimate @ invert(poses[i - 1]) @ poses[i] @ se3_exp(noise)
        edges, candidates = detector.detect(keyframe, estimate)
        assert all(c.reason for c in candidates)
        assert len(edges) == sum(c.decision is LoopDecision.ACCEPTED for c in candidates)
        for edge in edges:
            xi = se3_log(invert(edge.T_from_to) @ invert(poses[edge.from_id]) @ poses[edge.to_id])
            errors.append((np.linalg.norm(xi[3:]), np.rad2deg(np.linalg.norm(xi[:3]))))
            chi2.append(float(xi @ np.linalg.solve(edge.covariance, xi)) / 6.0)
    metres, degrees = np.array(errors).T
    assert len(errors) >= least_edges
    assert metres.max() < 0.5
    assert degrees.max() < 10.0
    assert np.median(metres) < median_m
    assert np.median(degrees) < median_deg
    assert np.median(chi2) < 1.5
