"""Combined IMU preintegration between keyframes, honest across outages.

Uses gtsam's Galilean preintegration: at 200 Hz and brisk motion it errs by 0.02 mm per second where the default, which
is first order, errs by 7 mm. Forster et al., "On-manifold preintegration", TRO 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from vislam.config import GraphConfig, MachineConfig
from vislam.core.messages import Array, ImuSpan
from vislam.factors.keys import B, V, X
from vislam.imu import ImuNoise

# rad/s^2/sqrt(Hz); gtsam 4.3.0 throws when prior sigma / step sigma > 4096
GYRO_BIAS_WALK_FLOOR = 2e-5
ACCEL_BIAS_WALK_FLOOR = 3e-4  # m/s^3/sqrt(Hz)
_BRIDGE_STEP_S = 0.005  # outages are integrated in steps of this length


@dataclass(frozen=True, slots=True, eq=False)
class Preintegrated:
    """A preintegrated span; `outage_s` is how much of it has no samples."""

    pim: gtsam.PreintegratedCombinedMeasurementsG
    duration_s: float
    outage_s: float


class Preintegrator:
    """Turns IMU spans into combined factors."""

    def __init__(self, config: GraphConfig, noise: ImuNoise, machine: MachineConfig) -> None:
        """Set up the noise of the IMU, its walks at least the floors above; spans scale the white part."""
        self._config = config
        self._machine = machine
        self._max_gap_s = noise.gap_s(machine.max_gap_s)
        self._gyro_density = noise.gyroscope_noise_density
        self._accel_density = noise.accelerometer_noise_density
        self.gyroscope_random_walk = max(noise.gyroscope_random_walk, GYRO_BIAS_WALK_FLOOR)
        self.accelerometer_random_walk = max(noise.accelerometer_random_walk, ACCEL_BIAS_WALK_FLOOR)

    def integrate(
        self, span: ImuSpan | None, t0_ns: int, t1_ns: int, bias: gtsam.imuBias.ConstantBias
    ) -> Preintegrated | None:
        """Return the span integrated over [t0_ns, t1_ns] at `bias`; None when it is missing or has too long an outage.

        Between samples the mean of both ends is integrated. Where samples are more than `machine.max_gap_s` apart, or
        more than is usual for a slow IMU, or an end is not covered, the missing motion is interpolated and carries the
        outage sigmas of `machine`.
        """
        if span is None or len(span.t_ns) == 0:
            return None
        t_s, gyro, accel = self._covering(span, t0_ns, t1_ns)
        dt = np.diff(t_s)
        outage = dt > self._max_gap_s
        outage_s = float(dt[outage].sum())
        if len(dt) == 0 or outage_s > self._machine.max_outage_s:
            return None
        white = self._gyro_density * span.noise.gyro, self._accel_density * span.noise.accel
        params = self._params(white)
        pim = gtsam.PreintegratedCombinedMeasurementsG(params, bias)
        mean_gyro = 0.5 * (gyro[1:] + gyro[:-1])
        mean_accel = 0.5 * (accel[1:] + accel[:-1])
        for i, step_s in enumerate(dt.tolist()):
            if outage[i]:
                self._bridge(pim, params, gyro[i : i + 2], accel[i : i + 2], step_s)
                self._set_white_noise(params, *white)
            else:
                pim.integrateMeasurement(mean_accel[i], mean_gyro[i], step_s)
        return Preintegrated(pim, float(t_s[-1] - t_s[0]), outage_s)

    def factor(self, i: int, j: int, integrated: Preintegrated) -> gtsam.GalileanCombinedImuFactor:
        """Return the factor between two keyframes."""
        return gtsam.GalileanCombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), integrated.pim)

    def bias_walk_sigmas(self, duration_s: float) -> Array:
        """Return the sigmas [6] of the bias change over a time, accelerometer first as in gtsam."""
        root = np.sqrt(duration_s)
        return np.repeat([self.accelerometer_random_walk * root, self.gyroscope_random_walk * root], 3)

    def _params(self, white: tuple[float, float]) -> gtsam.PreintegrationCombinedParams:
        params = gtsam.PreintegrationCombinedParams.MakeSharedU(self._machine.gravity_m_s2)
        self._set_white_noise(params, *white)
        params.setIntegrationCovariance(np.eye(3) * self._config.imu_integration_sigma**2)
        params.setBiasOmegaCovariance(np.eye(3) * self.gyroscope_random_walk**2)
        params.setBiasAccCovariance(np.eye(3) * self.accelerometer_random_walk**2)
        return params

    @staticmethod
    def _set_white_noise(params: gtsam.PreintegrationCombinedParams, gyro: float, accel: float) -> None:
        params.setGyroscopeCovariance(np.eye(3) * gyro**2)
        params.setAccelerometerCovariance(np.eye(3) * accel**2)

    def _covering(self, span: ImuSpan, t0_ns: int, t1_ns: int) -> tuple[Array, Array, Array]:
        """Return times in seconds since t0 and samples that cover [t0, t1]; missing ends hold the nearest sample."""
        inside = (span.t_ns >= t0_ns) & (span.t_ns <= t1_ns)
        t_ns, gyro, accel = span.t_ns[inside], span.gyro_rad_s[inside], span.accel_m_s2[inside]
        if len(t_ns) == 0:
            return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))
        first, last = int(t_ns[0] > t0_ns), int(t_ns[-1] < t1_ns)
        ends = [np.full(first, t0_ns, dtype=np.int64), t_ns, np.full(last, t1_ns, dtype=np.int64)]
        t_ns = np.concatenate(ends)  # integers throughout: a float loses 256 ns of the time of day
        gyro = np.concatenate([gyro[:first], gyro, gyro[len(gyro) - last :]])
        accel = np.concatenate([accel[:first], accel, accel[len(accel) - last :]])
        return (t_ns - t0_ns).astype(np.float64) * 1e-9, gyro, accel

    def _bridge(
        self,
        pim: gtsam.PreintegratedCombinedMeasurementsG,
        params: gtsam.PreintegrationCombinedParams,
        gyro: Array,
        accel: Array,
        duration_s: float,
    ) -> None:
        """Integrate across an outage between two samples [2, 3], with the noise of an unmeasured motion.

        A density s * sqrt(duration) makes velocity uncertain by s * duration in the end, as an unknown constant would.
        """
        machine, root = self._machine, np.sqrt(duration_s)
        self._set_white_noise(params, machine.outage_gyro_sigma_rad_s * root, machine.outage_accel_sigma_m_s2 * root)
        steps = max(1, int(np.ceil(duration_s / _BRIDGE_STEP_S)))
        for alpha in (np.arange(steps) + 0.5) / steps:
            pim.integrateMeasurement(
                (1.0 - alpha) * accel[0] + alpha * accel[1], (1.0 - alpha) * gyro[0] + alpha * gyro[1],
                duration_s / steps,
            )  # fmt: skip
