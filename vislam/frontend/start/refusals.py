"""Why a window gives no first state: what it lacks, or what contradicts physics; counted by cause."""

import numpy as np

from vislam.config import InitConfig
from vislam.frontend.start.answer import Initialisation
from vislam.frontend.start.closed_form import InertialPath, Start, Tracks, median_parallax
from vislam.frontend.start.solution import Solution
from vislam.imu.resting import GRAVITY_TOLERANCE_M_S2
from vislam.window.bundle import BundleSolution

_MIN_POINTS = 10  # monocular: two numbers a sighting leave some redundancy; how much, the sigmas say
MIN_PARALLAX_PX = 12.0  # monocular: median over the points; below, depth and so scale drown in noise
_MAX_TILT_SIGMA_DEG = 2.0  # 0.2 m/s^2 of unknown accelerometer bias alone is 1.2 deg
_MAX_VELOCITY_SIGMA_M_S = 0.2
_MAX_GYRO_BIAS_SIGMA_RAD_S = 0.02
# chi-square per degree of freedom; above it the model does not explain the window
_MAX_RESIDUAL_RATIO = 3.0
AGREE_SIGMAS = 3.0
_MAX_OUTLIERS = 0.3  # of the observations
_MAX_BIAS_SIGMAS = 3.5  # of the accelerometer's bias
MOST_NOISE = 3.0  # times the track noise of the settings; more is disagreement


class Refusals:
    """Refuses what cannot be believed; each check returns the refusal, or None.

    Attributes:
        counts: how often it was refused, by cause.
    """

    def __init__(self, config: InitConfig, gravity_m_s2: float, track_sigma_px: float) -> None:
        """Take the limits, and what gravity and the noise of tracks should be."""
        self.counts: dict[str, int] = {}
        self._config, self._gravity, self._track_sigma_px = config, gravity_m_s2, track_sigma_px

    def refuse(self, cause: str, reason: str, status: str = "waiting") -> Initialisation:
        """Return a refusal, and count it under its cause."""
        self.counts[cause] = self.counts.get(cause, 0) + 1
        return Initialisation(status, reason, cause=cause)

    def contradiction(self, norm: float) -> Initialisation:
        """Refuse a norm of gravity that no noise explains."""
        reason = (
            f"gravity norm {norm:.2f} m/s2, expected {self._gravity:.2f}: check the accelerometer's unit and "
            "calibration and the camera-IMU extrinsics"
        )
        return self.refuse("gravity", reason, "failed")

    def gravity(self, norm: float, sigma: float) -> Initialisation | None:
        """Refuse a norm of gravity that is not known well enough, or is not that of gravity."""
        allowed = GRAVITY_TOLERANCE_M_S2
        if sigma > 2.0 * allowed:
            reason = f"gravity norm {norm:.1f} +- {sigma:.1f} m/s2: too little acceleration or turning"
            return self.refuse("gravity", reason)
        if abs(norm - self._gravity) > allowed + AGREE_SIGMAS * sigma:
            return self.contradiction(norm)
        return None

    def sight(self, tracks: Tracks, path: InertialPath, fx: float) -> Initialisation | None:
        """Refuse a window in which there is too little to see."""
        config = self._config
        if tracks.points < _MIN_POINTS:
            return self.refuse("points", f"{tracks.points} points of {_MIN_POINTS} needed followed long enough")
        parallax_px = median_parallax(tracks, path.rotations) * fx
        if parallax_px < MIN_PARALLAX_PX:
            return self.refuse("parallax", f"parallax {parallax_px:.0f} px of {MIN_PARALLAX_PX:.0f} needed")
        if path.excitation_m_s2 < config.min_excitation_m_s2:
            return self.refuse(
                "excitation",
                f"acceleration changes by {path.excitation_m_s2:.2f} m/s2 of {config.min_excitation_m_s2:.2f} needed: "
                "scale cannot be seen in uniform motion, speed up, brake or turn",
            )
        return None

    def start(self, start: Start) -> Initialisation | None:
        """Refuse where the linear solution, gravity left free, is far from what gravity can be."""
        # in a short window this norm errs by more than its sigma: twice the room
        allowed = 2.0 * (GRAVITY_TOLERANCE_M_S2 + AGREE_SIGMAS * start.free_norm_sigma_m_s2)
        is_foreign = abs(start.free_norm_m_s2 - self._gravity) > allowed
        return self.contradiction(start.free_norm_m_s2) if is_foreign else None

    @property
    def most_bias_m_s2(self) -> float:
        """The largest bias of an accelerometer that is believed."""
        return _MAX_BIAS_SIGMAS * self._config.accel_bias_sigma_m_s2

    def bundle(self, bundle: BundleSolution, start: Start) -> Initialisation | None:
        """Refuse a window in which sightings and inertial data contradict each other."""
        bias, limit = bias_m_s2(bundle), self.most_bias_m_s2
        if bias > limit:  # a motion that is not understood hides in it
            refusal = self.start(start)
            reason = f"accelerometer bias {bias:.2f} m/s2 of {limit:.2f}: check its calibration and the extrinsics"
            return refusal or self.refuse("accel bias", reason)
        if bundle.outliers > _MAX_OUTLIERS:
            reason = f"{bundle.outliers:.0%} of the sightings contradict the inertial data"
            return self.refuse("disagreement", reason, "failed")
        if bundle.sigma_px > MOST_NOISE * self._track_sigma_px:
            reason = f"sightings scatter by {bundle.sigma_px:.1f} px about what the inertial data allow"
            return self.refuse("disagreement", reason, "failed")
        return None

    def quality(self, solution: Solution, lacking: str) -> Initialisation | None:
        """Refuse a solution that is not known well enough; `lacking` is what the window lacks."""
        config = self._config
        if solution.residual_ratio > _MAX_RESIDUAL_RATIO:
            reason = f"vision and IMU disagree: chi2 {solution.residual_ratio:.1f} of {_MAX_RESIDUAL_RATIO:.1f}"
            advice = "per degree of freedom; check time stamps and extrinsics"
            return self.refuse("disagreement", f"{reason} {advice}", "failed")
        P = solution.last_covariance
        velocity = np.sqrt(np.linalg.eigvalsh(P[6:9, 6:9])[-1])
        gyro = np.sqrt(np.linalg.eigvalsh(P[9:12, 9:12])[-1])
        for name, value, limit, unit in (
            ("scale", solution.scale_sigma * 100.0, config.max_scale_sigma * 100.0, "%"),
            ("tilt", np.rad2deg(solution.tilt_sigma_rad), _MAX_TILT_SIGMA_DEG, "deg"),
            ("velocity", velocity, _MAX_VELOCITY_SIGMA_M_S, "m/s"),
            ("gyro bias", gyro, _MAX_GYRO_BIAS_SIGMA_RAD_S, "rad/s"),
        ):
            if not value <= limit:
                return self.refuse(name, f"{name} sigma {value:.3g} {unit} of {limit:.3g} needed: {lacking}")
        return None


def bias_m_s2(bundle: BundleSolution) -> float:
    """Return the norm of the accelerometer's bias in a solved window."""
    return float(np.linalg.norm(bundle.accel_bias_m_s2[-1]))
