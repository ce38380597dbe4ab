"""Runs without a camera, on a simulated cart whose truth is exact."""

from pathlib import Path

import numpy as np
import pytest

from vislam.config import load
from vislam.core.camera import Rig
from vislam.core.errors import UsageError
from vislam.core.geometry import invert
from vislam.core.messages import ImuSpan
from vislam.core.readings import Reading
from vislam.frontend.result import lost_motion
from vislam.pipeline.blind_start import BlindStart, Said, said_of
from vislam.pipeline.dark import SilentCamera
from vislam.pipeline.settings import derived
from vislam.runs.further_sensors import FurtherReadings
from vislam.runs.sources import open_source
from vislam.sensors import Suite, kind_class
from vislam.sensors.toml import sensor_setup
from vislam.slam import Slam

WHEELS = {"wheels": {"kind": "wheels", "simulated_hz": 20.0}}
FIXES = {"gnss": {"kind": "position", "simulated_hz": 5.0, "sigma_m": 0.5, "sigma_up_m": 1.0}}
SECOND_NS = 10**9


class Drive:
    """The cart of `points:cart-drive`, without its camera."""

    def __init__(self, sensors: dict[str, dict[str, object]], start_s: float = 0.0, seed: int = 0) -> None:
        recording = open_source(f"points:cart-drive,rig=none,start_s={start_s:g},duration_s=30", seed)
        setup = sensor_setup({"sensors": sensors}, "here", Path()) if sensors else None
        self.slam = Slam(load(None, {}), recording.rig, recording.imu_noise, None if setup is None else setup.suite)
        values = recording.events()
        steps = []
        for value in values if setup is None else FurtherReadings(recording, setup, seed).among(values):
            steps += self.slam.feed(value)
        self.keyframes = [keyframe for step in steps for keyframe in step.keyframes]
        self.slam.finish()
        self.truth = recording.truth()
        self.t_ns = [step.front.frame.t_ns for step in steps if step.front.estimate is not None]

    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Return, for each keyframe of the graph, how far it is off (m) and the sigma that it admits (m)."""
        states = self.slam.back.graph.states()
        true = {state.t_ns: self.truth.at(state.t_ns) for state in states}
        T = true[states[0].t_ns] @ invert(states[0].T_world_body)
        off = [np.linalg.norm((T @ s.T_world_body)[:3, 3] - true[s.t_ns][:3, 3]) for s in states]
        return np.array(off), np.array([np.sqrt(np.trace(s.covariance[3:6, 3:6])) for s in states])

    def tilts_deg(self) -> np.ndarray:
        """Return by how much up is off at each keyframe of the graph."""
        states = self.slam.back.graph.states()
        up = [s.T_world_body[2, :3] @ self.truth.at(s.t_ns)[2, :3] for s in states]
        return np.rad2deg(np.arccos(np.clip(up, -1.0, 1.0)))


@pytest.fixture(scope="module")
def by_wheels() -> Drive:
    return Drive(WHEELS)


def test_a_cart_finds_its_way_by_wheels_and_imu(by_wheels: Drive) -> None:
    off_m, sigma_m = by_wheels.errors()
    print(off_m.max(), sigma_m.max(), by_wheels.tilts_deg().max())
    assert off_m.max() < min(0.3, 4.0 * sigma_m.max())
    assert by_wheels.slam.front.start.status == "static"
    assert np.diff([k.odometry.packet.keyframe.t_ns for k in by_wheels.keyframes]).max() < 1.2 * SECOND_NS
    assert np.diff(by_wheels.t_ns).max() < 0.11 * SECOND_NS


def test_nothing_counts_as_lost_where_no_camera_could_see(by_wheels: Drive) -> None:
    counters = by_wheels.slam.front.report().counters
    assert counters["front"]["frames_lost"] == counters["front"]["longest_loss_ms"] == 0
    assert counters["front"]["submaps"] == 1
    assert by_wheels.slam.counters["frames_lost"] == 0


def test_a_cart_finds_its_way_by_fixes_and_imu() -> None:
    off_m, sigma_m = Drive(FIXES).errors()
    print(off_m.max(), sigma_m.max())
    assert off_m.max() < min(1.5, 4.0 * sigma_m.max())


@pytest.mark.parametrize("start_s", [6.0, 10.0])
def test_a_glide_that_fixes_see_is_not_taken_for_rest(start_s: float) -> None:
    drive = Drive(FIXES, start_s)
    assert drive.slam.front.start is None and not drive.keyframes
    assert drive.slam.front.report().counters["initialisation refused"]["fixes"] > 0


def test_fixes_too_rough_to_show_a_glide_are_not_waited_for() -> None:
    rough = {"gnss": {"kind": "position", "simulated_hz": 1.0, "sigma_m": 1.5, "sigma_up_m": 3.0}}
    start = Drive(rough).slam.front.start
    assert start.status == "static" and start.reason == "at rest for 0.80 s"


def test_fixes_that_fall_silent_are_not_waited_for() -> None:
    suite = Suite({"gnss": kind_class("position")()})
    assert said_of([], suite, 0) == Said()
    early = [Reading("gnss", k * SECOND_NS // 5, np.zeros(3)) for k in range(4)]
    said = said_of(early, suite, 0)
    assert said.doubt and not said.is_sure
    recording = open_source("points:cart-drive,rig=none,duration_s=1")
    start = BlindStart(load(None, {}).init, recording.imu_noise, 9.81, lambda _: said)
    level = np.tile([0.0, 0.0, 9.81], (21, 1))
    for k in range(60):
        t_ns = k * SECOND_NS // 10 + np.arange(21, dtype=np.int64) * (SECOND_NS // 200)
        found = start.add(ImuSpan(t_ns, np.zeros((21, 3)), level), lost_motion(int(t_ns[-1]), -1, True), True)
    assert found.status == "static" and 40 < start.refusals["fixes"] < 50


def test_a_cart_in_motion_begins_by_the_speed_of_its_wheels() -> None:
    drive = Drive(WHEELS, start_s=15.0)
    states = drive.slam.back.graph.states()
    true_m_s = np.linalg.norm(drive.truth.at(states[5].t_ns + SECOND_NS // 10)[:3, 3]
                              - drive.truth.at(states[5].t_ns)[:3, 3]) / 0.1  # fmt: skip
    assert drive.slam.front.start.status == "moving"
    assert np.linalg.norm(states[5].velocity_world_m_s) == pytest.approx(true_m_s, abs=0.1)
    assert drive.tilts_deg()[10:].max() < 3.0


def test_an_imu_alone_knows_what_is_level_and_that_it_does_not_know_where() -> None:
    drive = Drive({})
    off_m, sigma_m = drive.errors()
    print(off_m[-1], sigma_m[[5, -1]], drive.tilts_deg().max())
    assert drive.tilts_deg().max() < 2.0
    assert (off_m < 4.0 * sigma_m + 0.05).all()
    assert sigma_m[-1] > 20.0 * sigma_m[5]


def test_frames_come_with_the_imu_where_there_is_no_camera() -> None:
    silence = SilentCamera(Rig((), ()))
    came = [frame for k in range(101) for frame in silence.stand_in(k * SECOND_NS // 100, False)]
    assert [frame.t_ns for frame in came[:2]] == [SECOND_NS // 10 - 1, 2 * SECOND_NS // 10 - 1]
    assert len(came) == 10


def test_settings_that_need_a_camera_are_refused_or_off() -> None:
    recording = open_source("points:cart-drive,rig=none,duration_s=1")
    config = derived(load(None, {}), recording.rig, recording.imu_noise)
    assert (config.frontend.mode, config.graph.coupling) == ("none", "loose")
    assert not config.loop.enabled and not config.map.enabled
    with pytest.raises(UsageError, match=r"--frontend\.mode mono needs a camera"):
        derived(load(None, {"frontend.mode": "mono"}), recording.rig, recording.imu_noise)
    with pytest.raises(UsageError, match="needs its IMU"):
        derived(load(None, {}), recording.rig, None)
