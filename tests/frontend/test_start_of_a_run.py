"""The front half at the start: poses at once where vision measures metres, and keyframes only from a settled start."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from vislam.config import Config
from vislam.core.clock import StageClock
from vislam.core.geometry import invert
from vislam.pipeline.front import Front, odometry
from vislam.pipeline.steps import FrontStep
from vislam.sim import PointRecording, open_points
from vislam.trajectory import Trajectory


@dataclass
class Begun:
    """A front half after some seconds."""

    front: Front
    steps: list[FrontStep]
    recording: PointRecording

    @staticmethod
    def of(rig: str, start_s: float, duration_s: float) -> Begun:
        recording = open_points("laps", rig=rig, start_s=start_s, duration_s=duration_s, descriptors=False)
        front = Front(Config(), recording.rig, recording.imu_noise, StageClock())
        return Begun(front, list(odometry(front, recording.events())), recording)

    def tilts_in_sigmas(self) -> np.ndarray:
        """Return the error of the vertical of every frame over what the filter states."""
        truth = self.recording.truth()
        assert isinstance(truth, Trajectory)
        out = []
        for step in self.steps:
            assert step.state is not None
            k = int(np.argmin(np.abs(truth.t_ns - step.frame.t_ns)))
            R = step.state.T_world_body[:3, :3]
            error = np.arccos(np.clip(R[2] @ truth.T_world_body[k, 2, :3], -1.0, 1.0))
            P = (R @ step.state.covariance[:3, :3] @ R.T)[:2, :2]
            out.append(float(error / np.sqrt(np.linalg.eigvalsh(P)[-1])))
        return np.array(out)


@pytest.mark.parametrize("start_s", [0.0, 6.0, 9.0])
def test_two_cameras_have_a_pose_from_the_first_frame_with_an_honest_tilt(start_s: float) -> None:
    """At rest and in the middle of a walk."""
    begun = Begun.of("stereo", start_s, 3.0)
    assert all(step.T_odom_body is not None for step in begun.steps)
    ratios = begun.tilts_in_sigmas()
    print(f"tilt error in sigmas: {ratios.mean():.2f} in the mean, {ratios.max():.2f} at most")
    assert ratios.max() < 3.5
    assert begun.front.begun.settled is not None and begun.front.begun.settled.status in ("static", "moving")
    facts = begun.front.start
    assert facts is not None and facts.begun_t_ns == begun.steps[0].frame.t_ns < facts.last.t_ns


def test_the_graph_hears_nothing_of_a_start_that_is_not_settled() -> None:
    begun = Begun.of("stereo", 6.0, 3.0)
    front = begun.front
    assert front.start is not None
    for step in begun.steps:
        assert not step.keyframes or step.frame.t_ns >= front.start.last.t_ns
    released = [keyframe for step in begun.steps for keyframe in step.keyframes]
    assert [keyframe.packet.keyframe.id for keyframe in released] == list(range(len(released)))


def test_one_camera_has_a_pose_in_motion_soon_and_it_does_not_jump_when_the_start_is_settled() -> None:
    begun = Begun.of("mono", 6.0, 6.0)
    front = begun.front
    assert front.begun.settled is not None and front.begun.settled.status == "moving", front.begun.refusal
    facts = front.start
    assert facts is not None
    first_ns = begun.steps[0].frame.t_ns
    assert (facts.begun_t_ns - first_ns) * 1e-9 <= 3.0
    assert (facts.last.t_ns - facts.begun_t_ns) * 1e-9 >= Config().init.test_s
    given = [step for step in begun.steps if step.T_odom_body is not None]
    assert given[0].frame.t_ns == facts.begun_t_ns
    truth = begun.recording.truth()
    assert truth is not None
    for before, after in pairwise(given):
        assert before.T_odom_body is not None and after.T_odom_body is not None
        moved = np.linalg.norm((invert(before.T_odom_body) @ after.T_odom_body)[:3, 3])
        assert moved < 0.2  # 50 ms of a walk
    k = [int(np.argmin(np.abs(truth.t_ns - step.frame.t_ns))) for step in given]
    way = np.linalg.norm(truth.T_world_body[k[-1], :3, 3] - truth.T_world_body[k[0], :3, 3])
    assert given[-1].T_odom_body is not None and given[0].T_odom_body is not None
    found = np.linalg.norm(given[-1].T_odom_body[:3, 3] - given[0].T_odom_body[:3, 3])
    assert abs(found / way - 1.0) < 0.1
    untold = [step for step in given if step.frame.t_ns < facts.last.t_ns and step.track.keyframe is None]
    assert untold and all(step.T_keyframe_body is None for step in untold)


def test_one_camera_whose_recording_ends_during_the_test_is_placed_and_says_that_nothing_confirmed_it() -> None:
    begun = Begun.of("mono", 6.0, 1.9)
    front = begun.front
    assert front.begun.settled is None and front.begun.newest is not None, front.begun.refusal
    released = front.give_up_waiting()
    assert released and front.start is not None
    assert "not confirmed" in front.start.reason
