"""A camera that gives no images for a minute: filter and graph go on by wheels and IMU."""

import itertools
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from vislam.config import load
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.messages import Array, Frame, ImuSample, Observations
from vislam.pipeline.dark import SilentCamera, dark
from vislam.runs.further_sensors import FurtherReadings
from vislam.runs.run_input import RunInput
from vislam.runs.sources import open_source
from vislam.sensors.toml import sensor_setup
from vislam.slam import Slam

SECOND_NS = 10**9
BEFORE_S = 12.0
QUIET = {"map.enabled": False, "view.enabled": False, "loop.enabled": False}
WHEELS = {"sensors": {"wheels": {"kind": "wheels", "simulated_hz": 10.0}}}


class Silent:
    """A cart whose camera is silent for so long, with wheels."""

    def __init__(self, silent_s: float, rig: str = "stereo", after_s: float = 4.0) -> None:
        source = f"points:cart-drive,rig={rig},duration_s={BEFORE_S + silent_s + after_s:g},camera_hz=10,tracks=100"
        recording = open_source(source)
        setup = sensor_setup(WHEELS, "here", Path())
        self.slam = Slam(load(None, QUIET), recording.rig, recording.imu_noise, setup.suite)
        self.truth = recording.truth()
        self.first_ns = int(self.truth.t_ns[0])
        self.end_s = BEFORE_S + silent_s
        steps = []
        for value in FurtherReadings(recording, setup, 0).among(recording.events()):
            if not (isinstance(value, Frame) and BEFORE_S <= self.since_s(value.t_ns) < self.end_s):
                steps += self.slam.feed(value)
        steps += self.slam.finish().steps
        self.filter = [
            (step.front.frame.t_ns, step.front.estimate.T_odom_body)
            for step in steps
            if step.front.estimate is not None
        ]

    def since_s(self, t_ns: int) -> float:
        return (t_ns - self.first_ns) * 1e-9

    def true_pose(self, t_ns: int) -> Array:
        return self.truth.T_world_body[int(np.argmin(np.abs(self.truth.t_ns - t_ns)))]

    def error_m(self, path: list[tuple[int, Array]]) -> float:
        """Return how far a path is off once the camera sees again, its first pose put on the truth."""
        T = self.true_pose(path[0][0]) @ invert(path[0][1])
        t_ns, pose = next((t_ns, pose) for t_ns, pose in path if self.since_s(t_ns) >= self.end_s)
        return float(np.linalg.norm((T @ pose)[:3, 3] - self.true_pose(t_ns)[:3, 3]))


@pytest.mark.slow
def test_what_is_seen_after_a_minute_without_sight_is_judged_by_a_speed_that_is_known() -> None:
    """The window's own speed is off by more than a metre per second then: steps were 10 % off, and as sure as ever."""
    run = Silent(60.0, "mono", after_s=8.0)
    graph = run.slam.back.graph
    states = [state for state in graph.states() if run.since_s(state.t_ns) >= run.end_s]
    assert len(states) > 5
    way_m = error_m = 0.0
    for a, b in itertools.pairwise(states):
        step = invert(a.T_world_body) @ b.T_world_body
        true = invert(run.true_pose(a.t_ns)) @ run.true_pose(b.t_ns)
        way_m += float(np.linalg.norm(true[:3, 3]))
        error_m += float(np.linalg.norm(step[:3, 3] - true[:3, 3]))
    values, sigmas = graph.own("wheels")
    print(f"steps of {way_m:.2f} m in all, off by {error_m:.3f} m; wheels {values} +- {sigmas}")
    assert error_m < 0.025 * way_m


@pytest.mark.slow
def test_filter_and_graph_go_on_by_wheels_while_the_camera_is_silent() -> None:
    silent_s = 30.0
    run = Silent(silent_s)
    graph = run.slam.back.graph
    states = graph.states()
    by_graph = [(state.t_ns, state.T_world_body) for state in states]
    last = next(state for state in states if run.since_s(state.t_ns) >= run.end_s)
    sigma_m = float(np.sqrt(np.trace(last.covariance[3:6, 3:6])))
    filter_m, graph_m = run.error_m(run.filter), run.error_m(by_graph)
    said = graph.sensed("wheels")
    print(f"{silent_s:g} s: filter {filter_m:.3f} m, graph {graph_m:.3f} m, its sigma {sigma_m:.3f} m; {said}")
    assert run.slam.front.watch.counters["submaps"] == 1
    assert run.slam.front.watch.counters["waypoints"] >= silent_s - 10.0
    assert run.slam.front.report().counters["sensor wheels"]["unplaced"] == 0
    assert np.diff([t_ns for t_ns, _ in by_graph]).max() < 7 * SECOND_NS
    assert said["in_window"] + said["used"] > 8.0 * silent_s
    assert filter_m < 0.01 * silent_s
    assert graph_m < min(0.01 * silent_s, 4.0 * sigma_m)


def test_a_camera_is_stood_in_for_once_a_second_after_five() -> None:
    silence = SilentCamera(open_source("points:cart-drive,duration_s=1").rig)
    assert silence.stand_in(100 * SECOND_NS) == []  # no frame yet
    nothing = Observations(np.arange(3), np.zeros((3, 2)), np.zeros((3, 2)))
    silence.see(Frame(0, 7, (), tracks=nothing))
    came = [frame for k in range(200) for frame in silence.stand_in(k * SECOND_NS // 10)]
    assert [frame.t_ns for frame in came] == [k * SECOND_NS - 1 for k in range(5, 20)]
    assert silence.frames == 15
    tracks = came[0].tracks
    assert tracks is not None
    assert len(tracks.track_ids) == len(tracks.pixels_px) == len(tracks.right_px) == 0
    silence.see(Frame(20 * SECOND_NS, 8, (), tracks=nothing))
    assert silence.stand_in(24 * SECOND_NS) == []


def test_a_dark_frame_has_the_shape_of_the_one_before() -> None:
    image = np.full((4, 6), 9, np.uint8)
    frame = Frame(5, 3, (image, image), np.full((4, 6, 3), 9, np.uint8), np.ones((4, 6), np.float32))
    night = dark(frame, 77)
    assert (night.t_ns, night.index, night.tracks) == (77, 3, None)
    assert [one.shape for one in (*night.images, night.color, night.depth_m)] == [(4, 6), (4, 6), (4, 6, 3), (4, 6)]
    assert not any(one.any() for one in (*night.images, night.color, night.depth_m))


def test_a_run_is_resumed_where_the_camera_was_silent(tmp_path: Path) -> None:
    """Its last keyframe has no frame in the recording then; a dark one comes before what is newer."""
    image = np.full((4, 6), 9, np.uint8)
    frames = [Frame(k * SECOND_NS, k, (image,)) for k in (0, 1, 9)]
    samples = [ImuSample(k * SECOND_NS // 2, np.zeros(3), np.zeros(3)) for k in range(20)]
    values = sorted([*frames, *samples], key=lambda value: value.t_ns)
    recording = SimpleNamespace(
        events=lambda from_ns=None: iter(values), name="a cart", problems={}, rig=SimpleNamespace(is_blind=False)
    )
    further = SimpleNamespace(among=lambda events: events, suite=None, problems={})
    memory = SimpleNamespace(camera_t_ns=6 * SECOND_NS - 1, t_ns=6 * SECOND_NS - 1)
    came = list(RunInput(recording, further, tmp_path).values(memory))
    assert [value.t_ns for value in came if isinstance(value, Frame)] == [6 * SECOND_NS - 1, 9 * SECOND_NS]
    assert [value.t_ns / SECOND_NS for value in came[:4]] == pytest.approx([5.0, 5.5, 6.0, 6.0])
    assert isinstance(came[2], Frame) and not came[2].images[0].any()
    with pytest.raises(DataError, match="no frame at"):
        list(RunInput(recording, None, tmp_path).values(memory))
