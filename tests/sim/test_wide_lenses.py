"""A run whose images are those of a double sphere, tracked as they are."""

import numpy as np

import vislam
from vislam.config import Config, MapConfig
from vislam.core import Camera, Rig


def ate_m(painted, model: str, coefficients: tuple[float, ...]) -> float:
    """Return the error of a stereo run through a room, by cameras of a model that see 120 degrees across."""
    world = painted("handheld-room", seed=3, rig="stereo", image_width_px=320, duration_s=6.0, camera_hz=10.0)
    sigmas = world.rig.cameras[0].sigmas
    camera = Camera(320, 240, 145.0, 145.0, 159.0, 121.0, 0.0, model, coefficients, sigmas)
    world.rig = Rig((camera, camera), world.rig.T_body_cams)
    slam = vislam.Slam(Config(map=MapConfig(enabled=False)), world.rig, world.imu_noise)
    steps = [step for value in world.events() for step in slam.feed(value) if step.T_map_body is not None]
    slam.finish()
    stamps = np.array([step.front.frame.t_ns for step in steps])
    live = vislam.Trajectory(stamps, np.array([step.T_map_body for step in steps]))
    assert len(live) > 50
    return vislam.evaluate(live, world.truth(), "yaw")["ate_rmse_m"]


def test_a_double_sphere_is_tracked_about_as_well_as_an_equidistant_lens(painted) -> None:
    usual = ate_m(painted, "equidistant", (-0.02, 0.004, -0.003, 0.0005))
    assert ate_m(painted, "ds", (-0.2, 0.58)) < 1.5 * usual + 0.005 < 0.03
