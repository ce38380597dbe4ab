"""The first window of one camera: from the closed form of `initialisation_linear` to the window's own least squares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.config import WindowConfig
from vislam.core.camera import Rig
from vislam.core.messages import Array, Observations, no_observations
from vislam.frontend.start.closed_form import InertialPath, Tracks
from vislam.frontend.start.inertial_alignment import Window, up_to_z
from vislam.frontend.start.views import Entry
from vislam.imu import preintegrate
from vislam.window.bundle import BundleProblem, BundleSolution, solve


def refine_tracks(
    window: Window,
    chosen: list[Entry],
    tracks: Tracks,
    path: InertialPath,
    y: Array,
    config: WindowConfig,
    rig: Rig,
    offset_sigma_s: float,
    inflation: float,
) -> BundleSolution:
    """Return the maximum a posteriori over poses, velocities, biases, time offset and points, from the closed form.

    `y` [10] are first velocity, gravity, accelerometer bias and the factor of what the path knows, of which only the
    shape counts; `inflation` is that of the pixels' sigma, which is measured. Look at `converged`.
    """
    x, known = y[:9], y[9]
    R_world = up_to_z(x[3:6], np.eye(3))
    T = np.tile(np.eye(4), (len(path.rotations), 1, 1))
    T[:, :3, :3] = R_world @ path.rotations
    T[:, :3, 3] = (known * path.known_m + path.unknown @ x) @ R_world.T
    rates = np.array([*(span.gyro_rad_s[0] for span in window.spans), window.spans[-1].gyro_rad_s[-1]])
    problem = BundleProblem(
        T_world_body=T,
        velocity_world_m_s=(known * path.known_m_s + path.unknown_m_s @ x) @ R_world.T,
        gyro_bias_rad_s=path.gyro_bias_rad_s,
        accel_bias_m_s2=np.zeros(3),
        observations=[_only(entry.observations, tracks.track_ids) for entry in chosen],
        spans=[preintegrate(span, path.gyro_bias_rad_s, noise=window.noise) for span in window.spans],
        gyro_bias_sigma_rad_s=window.gyro_bias_sigma_rad_s,
        accel_bias_sigma_m_s2=window.accel_bias_sigma_m_s2,
        rate_rad_s=rates - path.gyro_bias_rad_s,
        time_offset_sigma_s=max(offset_sigma_s, 1e-6),
        inflation=inflation,
    )
    return solve(problem, config, rig, window.noise, window.gravity_m_s2)


def _only(seen: Observations | None, kept: NDArray[np.int64]) -> Observations:
    """Return the observations of some tracks."""
    if seen is None:
        return no_observations()
    rows = np.isin(seen.track_ids, kept)
    instant = None if seen.instant_px is None else seen.instant_px[rows]
    return Observations(seen.track_ids[rows], seen.pixels_px[rows], instant_px=instant)
