"""Visual odometry alone on the first seconds of the real recordings, against their truth."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from vislam.config import FrontEndConfig
from vislam.core.geometry import align_points, invert
from vislam.core.messages import Array, Frame, Tracking
from vislam.core.recording import Recording
from vislam.datasets import open_dataset
from vislam.frontend import make_frontend

pytestmark = pytest.mark.data


def odometry(recording: Recording, count: int, skip: int = 0) -> tuple[Array, Array, int, float]:
    """Chain the odometry of `count` frames: (times, body poses, keyframes, fraction of frames that are ok)."""
    front_end = make_frontend(FrontEndConfig(described_features=100), recording.rig, seed=0)
    frames = islice((e for e in recording.events() if isinstance(e, Frame)), skip, skip + count)
    T_odom_key, keyframes, ok = np.eye(4), 0, 0
    times, poses = [], []
    for frame in frames:
        result = front_end.track(frame, None)
        if result.vo.T_keyframe_body is not None:
            times.append(frame.t_ns)
            poses.append(T_odom_key @ result.vo.T_keyframe_body)
            ok += result.vo.tracking is Tracking.OK
        if result.keyframe is not None:
            keyframes += 1
            T_odom_key = poses[-1]
    return np.array(times), np.array(poses), keyframes, ok / count


def errors(recording: Recording, times: Array, poses: Array) -> tuple[float, float]:
    """Return the position RMSE after rigid alignment and the RMSE of the motion over one second, in metres."""
    truth = recording.truth()
    assert truth is not None
    true = truth.at(times)
    inside = np.isfinite(true[:, 0, 3])
    poses, true, times = poses[inside], true[inside], times[inside]
    S = align_points(poses[:, :3, 3], true[:, :3, 3])
    ate = poses[:, :3, 3] @ S[:3, :3].T + S[:3, 3] - true[:, :3, 3]
    later = np.searchsorted(times, times + 1_000_000_000)
    start = np.flatnonzero(later < len(times))
    end = later[start]
    drift = [
        (invert(invert(true[i]) @ true[j]) @ invert(poses[i]) @ poses[j])[:3, 3]
        for i, j in zip(start, end, strict=True)
    ]
    return float(np.sqrt(np.mean(np.sum(ate**2, axis=1)))), float(
        np.sqrt(np.mean(np.sum(np.array(drift) ** 2, axis=1)))
    )


def test_stereo_on_mh01(data_root: Path) -> None:
    recording = open_dataset(f"euroc:{data_root / 'euroc_mh01_17s'}")
    times, poses, keyframes, ok = odometry(recording, 120)
    ate, rpe = errors(recording, times, poses)
    assert ok == 1.0 and 10 < keyframes < 40
    assert ate < 0.015 and rpe < 0.02


def test_rgbd_on_fr1_desk(data_root: Path) -> None:
    recording = open_dataset(f"tum:{data_root / 'tum_fr1_desk'}")
    times, poses, keyframes, ok = odometry(recording, 150, skip=20)
    ate, rpe = errors(recording, times, poses)
    assert ok > 0.9 and 10 < keyframes < 45
    assert ate < 0.03 and rpe < 0.05


def test_a_recording_that_starts_without_depth_is_placed_by_the_first_depth(data_root: Path) -> None:
    recording = open_dataset(f"tum:{data_root / 'tum_fr1_desk'}")
    times, poses, _, _ = odometry(recording, 40)
    assert len(times) > 20
    ate, _ = errors(recording, times, poses)
    assert ate < 0.03


def test_mono_rotation_on_mh01(data_root: Path) -> None:
    recording = open_dataset(f"euroc:{data_root / 'euroc_mh01_17s'}")
    truth = recording.truth()
    assert truth is not None
    front_end = make_frontend(FrontEndConfig(mode="mono", described_features=100), recording.rig, seed=0)
    lever = recording.rig.T_body_cams[0][:3, 3]
    keys: dict[int, Array] = {}
    turned, pointed = [], []
    for frame in islice((e for e in recording.events() if isinstance(e, Frame)), 100):
        result = front_end.track(frame, None)
        T = truth.at(np.array([frame.t_ns]))[0]
        if keys and result.vo.T_keyframe_body is not None:
            true, measured = invert(keys[result.vo.keyframe_id]) @ T, result.vo.T_keyframe_body
            cosine = (np.trace(true[:3, :3].T @ measured[:3, :3]) - 1.0) / 2.0
            turned.append(np.rad2deg(np.arccos(min(1.0, cosine))))
            moved = true[:3, 3] + true[:3, :3] @ lever - lever
            if np.linalg.norm(moved) > 0.05 and measured[:3, 3].any():
                pointed.append(np.rad2deg(np.arccos(moved @ measured[:3, 3] / np.linalg.norm(moved))))
        if result.keyframe is not None:
            keys[result.keyframe.id] = T
    assert np.median(turned) < 0.15
    assert len(pointed) > 20 and np.median(pointed) < 3.0
