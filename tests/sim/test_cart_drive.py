"""The world of a cart with one webcam and a GY-85: its way, its mounting, its late camera."""

from collections.abc import Callable

import numpy as np
import pytest

from vislam.config import PlanarConfig
from vislam.core.errors import UsageError
from vislam.frontend.planar.floor import make_mount
from vislam.sim import Simulation, open_world
from vislam.sim.sensing import GY85_IMU


def test_a_hundred_metres_with_stops_and_turns() -> None:
    world = open_world("cart-drive")
    t_s = np.arange(0.0, world.duration_s, 0.05)
    motion = world.spline.at(t_s)
    speed = np.linalg.norm(motion.velocity_world_m_s, axis=1)
    assert 100.0 < 0.05 * speed.sum() < 115.0 and speed.max() < 1.0
    rests = np.flatnonzero((speed[1:] < 0.005) & (speed[:-1] >= 0.005))
    assert len(rests) >= 8  # stops, the last one included
    assert np.abs(motion.rate_body_rad_s[:, 2]).max() > 0.7
    body = np.einsum("nji,nj->ni", motion.T_world_body[:, :3, :3], motion.velocity_world_m_s)
    assert np.abs(body[:, 1]).max() < 0.05 and np.abs(body[:, 2]).max() < 0.03  # wheels do not slip
    assert world.imu_noise == GY85_IMU and not world.rig.has_depth and not world.rig.is_stereo


def test_the_camera_is_where_the_front_end_takes_it_to_be() -> None:
    world = open_world("cart-drive")
    T_body_cam = world.rig.T_body_cams[0]
    mount = make_mount(PlanarConfig(height_m=0.6), T_body_cam[:3, :3].copy())
    assert 17.0 < mount.tilt_deg < 18.0 and 0.5 < mount.roll_deg < 1.0  # never quite as drawn
    heights = (world.truth().T_world_body @ T_body_cam)[:, 2, 3]
    assert np.mean(heights) == pytest.approx(0.6, abs=0.001) and 1e-4 < heights.std() < 3e-3


def test_frames_are_stamped_late(painted: Callable[..., Simulation]) -> None:
    small = {"image_width_px": 64, "duration_s": 4.0, "exposure_s": 0.0}
    late = painted("cart-drive", **small)
    punctual = painted("cart-drive", camera_delay_s=0.0, camera_jitter_s=0.0, **small)
    drifting = painted("cart-drive", camera_delay_s=0.0, camera_jitter_s=0.0, camera_drift=0.02, **small)
    indices = range(0, late.frame_count, 6)
    delay_s = np.array([late.render(i).t_ns - punctual.render(i).t_ns for i in indices]) * 1e-9
    assert delay_s.mean() == pytest.approx(0.03, abs=0.002) and 2e-4 < delay_s.std() < 5e-3
    assert np.array_equal(punctual.truth().t_ns[:: len(indices)], late.truth().t_ns[:: len(indices)])
    span = [world.render(late.frame_count - 1).t_ns - world.render(0).t_ns for world in (drifting, punctual)]
    assert span[0] / span[1] == pytest.approx(1.02, abs=1e-6)
    again = painted("cart-drive", **small)
    assert all(again.render(i).t_ns == late.render(i).t_ns for i in (0, 5, 9))
    assert np.array_equal(again.render(3).images[0], late.render(3).images[0])


def test_an_absurd_clock_is_refused() -> None:
    with pytest.raises(UsageError, match="camera_drift"):
        open_world("cart-drive", camera_drift=0.5)
