"""2. The filter alone: what an IMU knows of its own motion, and for how long.

    python examples/02_filter.py

Integrated twice, a small error of acceleration grows with the square of time. The filter cannot prevent that; what it
owes is a covariance that says so. Rest is information: somebody who knows that he stands still stops drifting.
"""

import numpy as np

from vislam import Ekf, ImuSample, NavState
from vislam.sim import open_points

world = open_points("laps", seed=3, duration_s=14.0)  # 3 s of rest, then a walk
samples = [value for value in world.events() if isinstance(value, ImuSample)]
truth = world.true_states(np.array([sample.t_ns for sample in samples[:-1]]))

# the filter starts from a state with a sigma for each of its parts; `Ekf.at_rest(samples, noise)` finds one itself
start = NavState.with_sigmas(
    samples[0].t_ns, truth.T_world_body[0], (2e-3, 1e-4),
    velocity_world_m_s=truth.velocity_world_m_s[0], sigma_m_s=1e-3,
    gyro_bias_rad_s=truth.gyro_bias_rad_s[0],
    accel_bias_m_s2=truth.accel_bias_m_s2[0] + [0.02, -0.02, 0.0],  # one sigma wrong, as in real life
    bias_sigmas=(1e-4, 2e-2),
)  # fmt: skip


def dead_reckoned(rest_until_s: float) -> list[tuple[float, float]]:
    """Return error and sigma of the position after each second of motion, told of the rest before it or not."""
    ekf = Ekf.from_state(start, world.imu_noise)
    out = []
    for k, sample in enumerate(samples[:-1]):
        ekf.predict(sample)
        t_s = (sample.t_ns - start.t_ns) * 1e-9
        if t_s < rest_until_s and k % 20 == 0:
            ekf.update_zero_velocity(sample.t_ns)
        if k % 200 == 0:
            error = ekf.state().T_world_body[:3, 3] - truth.T_world_body[k, :3, 3]
            out.append((float(np.linalg.norm(error)), float(np.sqrt(ekf.position_variance_m2))))
    return out


alone, told = dead_reckoned(0.0), dead_reckoned(2.5)
print("after   IMU alone        told that it rested for 2.5 s")
for second in (1, 2, 3, 5, 8, 12):
    (error, sigma), (error_told, sigma_told) = alone[second], told[second]
    print(f"{second:3d} s   {error:5.2f} ± {sigma:4.2f} m   {error_told:5.2f} ± {sigma_told:4.2f} m")

# errors within three sigmas, and rest has paid: that is what consistent means
assert all(error < 3.0 * sigma + 1e-3 for error, sigma in alone + told)
assert told[12][0] < alone[12][0]
