"""Calibration of a cart's floor: tilt and roll from the flow, height from a measured drive, and refusals."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.calibration.cameras import floor
from vislam.calibration.cameras.floor import calibrate_floor, fit_floor
from vislam.calibration.options import FloorOptions
from vislam.config import PlanarConfig, load
from vislam.core.camera import Rig
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.frontend.planar.floor import make_mount
from vislam.imu import ImuNoise
from vislam.sim import open_world
from vislam.trajectory import Trajectory
from worlds.floor import Drive, FloorWorld, rig, stamp_ns

BIAS = np.array([0.01, -0.02, 0.015])


@dataclass
class Driven:
    """A drive as a recording: the camera really sits at another tilt than its extrinsics say."""

    drive: Drive
    contrast: float = 45.0
    imu: bool = True

    def __post_init__(self) -> None:
        self.name, self.problems = "drive", dict[str, int]()
        self.rig: Rig = rig(15.0)  # what somebody wrote down
        self.imu_noise = ImuNoise(5e-4, 6e-3, 3e-5, 4e-4, 200.0) if self.imu else None
        self._frames = FloorWorld(rig(18.0, 1.0), self.contrast).frames(self.drive)
        self.frame_count = len(self._frames)

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | Frame]:
        for i, frame in enumerate(self._frames):
            span = self.drive.gyro(i, BIAS) if self.imu else None
            if span is not None:
                for t_ns, rate, force in zip(
                    span.t_ns[1:].tolist(), span.gyro_rad_s[1:], span.accel_m_s2[1:], strict=True
                ):
                    yield ImuSample(t_ns, rate, force)
            yield frame

    def truth(self) -> Trajectory | None:
        return Trajectory(stamp_ns(self.drive.times_s), self.drive.poses)


STRAIGHT = Drive(seconds=4.5, speed_m_s=0.9, turn_rad_s=0.0, rest_s=0.4, start=(-2.0, -1.0, 0.2))


@cache
def straight() -> Driven:
    return Driven(STRAIGHT)


def options(**changes: object) -> FloorOptions:
    way = STRAIGHT.poses[-1] - STRAIGHT.poses[0]
    return replace(FloorOptions("drive", distance_m=float(np.linalg.norm(way[:2, 3]))), **changes)  # type: ignore[arg-type]


def test_three_metres_tell_the_tilt_and_a_tape_the_height() -> None:
    found = fit_floor(straight(), options())
    assert abs(found.tilt_deg - 18.0) < min(3.0 * found.tilt_sigma_deg, 0.15)
    assert abs(found.roll_deg - 1.0) < 0.2
    assert abs(found.height_m - 0.6) < min(3.0 * found.height_sigma_m, 0.006)
    assert found.by_distance and found.tilt_sigma_deg < 0.1 and found.height_sigma_m < 0.006
    assert found.drive.gyro_bias_rad_s is None or found.drive.gyro_bias_rad_s == pytest.approx(BIAS, abs=0.02)


def test_it_ends_with_a_file_a_picture_and_what_is_known_how_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(floor, "open_source", lambda _: straight())
    outcome = calibrate_floor(options(out=tmp_path, distance_m=None, height_m=0.6))
    config = load(tmp_path / "floor.toml").frontend
    assert config.mode == "planar" and config.planar.height_m == pytest.approx(0.6)
    assert config.planar.tilt_deg == pytest.approx(outcome.report["tilt_deg"], abs=1e-3)
    picture = cv2.imread(str(tmp_path / "floor.png"))
    assert picture is not None and picture.std() > 5.0
    assert any("tape" in line for line in outcome.lines) and any(
        "lengths are right to" in line for line in outcome.lines
    )
    with pytest.raises(UsageError, match="already holds"):
        calibrate_floor(options(out=tmp_path))


@pytest.mark.parametrize("both", [True, False])
def test_the_height_has_to_come_from_somewhere(tmp_path: Path, both: bool) -> None:
    with pytest.raises(UsageError, match="does not show the height"):
        calibrate_floor(FloorOptions("drive", 3.0 if both else None, height_m=0.6 if both else None, out=tmp_path))


def test_what_cannot_be_determined_is_refused() -> None:
    with pytest.raises(DataError, match=r"the way is .* camera heights long"):
        fit_floor(straight(), options(duration_s=1.2))
    with pytest.raises(DataError, match="no frames"):
        fit_floor(straight(), options(begin_s=100.0))
    blank = Driven(replace(STRAIGHT, seconds=1.0), contrast=0.0)
    with pytest.raises(DataError, match=r"frames are lost.*texture"):
        fit_floor(blank, options())
    curve = Driven(replace(STRAIGHT, turn_rad_s=0.3), imu=False)
    with pytest.raises(DataError, match=r"ends turned by"):
        fit_floor(curve, options())
    without = fit_floor(curve, options(distance_m=None, height_m=0.6))  # the tilt does not mind
    assert abs(without.tilt_deg - 18.0) < 0.3


class CartRecording:
    """The first drive of `sim:cart-drive` as a recording whose extrinsics are off by degrees; rendered once."""

    def __init__(self) -> None:
        self._world = open_world("cart-drive", image_width_px=320, camera_hz=10.0, exposure_s=0.0, duration_s=13.0)
        self._values = list(self._world.events(int(self._world.truth().t_ns[0]) + 3_000_000_000))
        T = self._world.rig.T_body_cams[0].copy()
        self.mount = make_mount(PlanarConfig(height_m=0.6), T[:3, :3].copy())
        T[:3, :3] = Rotation.from_euler("xyz", [1.5, -2.5, 0.0], degrees=True).as_matrix() @ T[:3, :3]
        self.rig = replace(self._world.rig, T_body_cams=(T,))
        self.name, self.problems, self.imu_noise = "cart", dict[str, int](), self._world.imu_noise
        self.frame_count = sum(isinstance(value, Frame) for value in self._values)

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        yield from self._values

    def truth(self) -> Trajectory:
        return self._world.truth()

    def distance_m(self, end_s: float) -> float:
        """Return how far it is from where it rests at the start, as a tape would say."""
        first, last = self._world.spline.at(np.array([3.0, end_s])).T_world_body
        return float(np.linalg.norm((last - first)[:2, 3]))


@pytest.fixture(scope="module")
def simulated_cart() -> CartRecording:
    return CartRecording()


@pytest.mark.parametrize("end_s", [8.45, 9.45])  # when the last frame is taken
def test_the_simulated_cart_is_calibrated_within_what_it_says(simulated_cart: CartRecording, end_s: float) -> None:
    """Springs, a GY-85, a camera whose clock is 30 ms late, and extrinsics that are wrong by degrees."""
    told = FloorOptions("cart", distance_m=simulated_cart.distance_m(end_s), duration_s=end_s + 0.08)
    found, true = fit_floor(simulated_cart, told), simulated_cart.mount
    assert abs(found.tilt_deg - true.tilt_deg) < 2.5 * found.tilt_sigma_deg
    assert abs(found.roll_deg - true.roll_deg) < 2.5 * found.roll_sigma_deg
    assert abs(found.height_m - true.height_m) < 2.5 * found.height_sigma_m
    assert found.tilt_sigma_deg < 0.15 and found.height_sigma_m < 0.009


def test_a_part_of_its_drive_that_does_not_tell_is_refused(simulated_cart: CartRecording) -> None:
    with pytest.raises(DataError, match=r"the way is .* camera heights long"):  # it still rests
        fit_floor(simulated_cart, FloorOptions("cart", distance_m=3.0, duration_s=4.5))
    with pytest.raises(DataError, match="ends turned by"):  # a corner
        fit_floor(simulated_cart, FloorOptions("cart", distance_m=simulated_cart.distance_m(12.9)))
