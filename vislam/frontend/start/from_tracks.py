"""A start in motion of one camera: attempts from tracks and inertial data, of which one has to confirm another."""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import InitConfig, WindowConfig
from vislam.core.camera import Camera, Rig
from vislam.core.messages import Array, Observations, no_observations
from vislam.frontend.start.answer import Initialisation, moving
from vislam.frontend.start.closed_form import (
    InertialPath,
    Start,
    Tracks,
    epipolar_noise,
    inertial_path,
    median_parallax,
    solve_shape,
    solve_start,
)
from vislam.frontend.start.inertial_alignment import Window, up_to_z
from vislam.frontend.start.refusals import AGREE_SIGMAS, MIN_PARALLAX_PX, MOST_NOISE, Refusals, bias_m_s2
from vislam.frontend.start.solution import Solution, from_bundle
from vislam.frontend.start.views import Entry, gather_tracks
from vislam.imu import preintegrate
from vislam.window.bundle import BundleProblem, BundleSolution, solve

_SETTLED_SCALE_SIGMA = 0.03  # of a start that is final, unless the window has reached its length before
VO_INFLATION = 1.5  # on the sigmas of relative motion, which share the keyframe's landmark errors
_MAX_POINTS = 60  # monocular: points solved for; more cost time and hardly sharpen scale
_NS = 1_000_000_000
_AMPLE = 3.0  # times the least excitation or parallax; more of it is no longer what a start lacks
_FOREIGN_OFFSET_S = 0.002  # a time offset found in the window that is larger than this is applied before the start


@dataclass(frozen=True, slots=True, eq=False)
class Sighted:
    """What an attempt starts from."""

    chosen: list[Entry]  # frames that are solved for
    window: Window  # inertial data between them
    seen_s: float  # length of the window
    offset_sigma_s: float  # how well the camera's clock is known


class StartFromTracks:
    """Owns the last attempts: structure from motion with inertial data, for which scale is to be found.

    Attributes:
        taken_back: how often a provisional start did not survive its test.
    """

    def __init__(
        self, config: InitConfig, refusals: Refusals, camera: Camera, T_body_cam: Array, track_sigma_px: float,
        window: WindowConfig,
    ) -> None:  # fmt: skip
        """Take the camera, the noise assumed of its tracks, and the settings of the window's least squares."""
        self.taken_back = 0
        self._config, self._refusals = config, refusals
        self._camera, self._T_body_cam = camera, T_body_cam
        self._track_sigma_px = track_sigma_px
        self._bundle_config = replace(window, sigma_px=track_sigma_px)
        self._before: Solution | None = None  # the attempt before
        self._offset_s: float | None = None  # of the camera's clock, by the last attempt that could be believed
        self._provisional: Solution | None = None  # given out, under test

    def forget(self) -> None:
        """Forget the attempt before, as its window no longer holds."""
        self._before = self._offset_s = None

    def solve(self, sighted: Sighted) -> Initialisation:
        """Return a start, provisional or settled, or why there is none.

        Raises:
            numpy.linalg.LinAlgError: the motion does not determine it.
        """
        fx = self._camera.fx
        chosen, window = sighted.chosen, sighted.window
        every = gather_tracks(chosen, self._camera, self._T_body_cam, self._track_sigma_px, _MAX_POINTS)
        path = inertial_path(window)
        sigma_xy, good = epipolar_noise(every, path.rotations)
        tracks = replace(every, sigma_xy=min(sigma_xy, MOST_NOISE * every.sigma_xy)).only(good)
        refusal = self._refusals.sight(tracks, path, fx)
        if refusal is not None:
            return refusal
        start, bundle = self._solved(sighted, tracks, path)
        if not bundle.converged:
            unsettled = "the window's least squares does not settle"
            return self._refusals.start(start) or self._refusals.refuse("geometry", unsettled)
        solution = from_bundle(tuple(entry.t_ns for entry in chosen), bundle)
        before, self._before = self._before, solution
        refusal = (
            self._refusals.bundle(bundle, start)
            or self._refusals.quality(solution, self._lacking(tracks, path, sighted.seen_s))
            or self._clock_refusal(bundle)
            or self._repetition_refusal(before, solution)
        )
        if refusal is not None:
            return refusal
        found = moving(chosen[0].T_vo_body, solution, metric=False, excitation_m_s2=path.excitation_m_s2)
        offset_s, offset_sigma_s = bundle.time_offset_s, bundle.time_offset_sigma_s
        found = replace(found, time_offset_s=offset_s, time_offset_sigma_s=offset_sigma_s)
        return self._tested(found, solution, sighted.seen_s)

    def _solved(self, sighted: Sighted, tracks: Tracks, path: InertialPath) -> tuple[Start, BundleSolution]:
        """Return the window's least squares and the closed form that led to it.

        The closed form over points fails where few points last; the shape by epipolar constraints is then the start.
        """
        window, rig = sighted.window, Rig((self._camera,), (self._T_body_cam,))
        start = solve_start(window, path, tracks)
        y = np.concatenate([start.velocity_m_s, start.gravity_m_s2, start.accel_bias_m_s2, [1.0]])
        found: BundleSolution | None = None
        for first in (lambda: y, lambda: solve_shape(window, path, tracks)):
            with suppress(np.linalg.LinAlgError):
                bundle = refine_tracks(
                    window, sighted.chosen, tracks, path, first(), self._bundle_config, rig, sighted.offset_sigma_s,
                    VO_INFLATION,
                )  # fmt: skip
                if bundle.converged and bias_m_s2(bundle) <= self._refusals.most_bias_m_s2:
                    return start, bundle
                found = found or bundle
        if found is None:
            raise np.linalg.LinAlgError("neither start leads anywhere")
        return start, found

    def _tested(self, found: Initialisation, solution: Solution, seen_s: float) -> Initialisation:
        """Return a first solution as provisional, and a later one as what the seconds since then made of it."""
        config, earlier = self._config, self._provisional
        if earlier is None:
            self._provisional = solution
            return replace(found, is_settled=False)
        tested_s = (solution.t_ns[-1] - earlier.t_ns[-1]) / _NS
        if tested_s < config.test_s:
            reason = f"the start is tested for {tested_s:.1f} s of {config.test_s:.1f} s"
            return self._refusals.refuse("test", reason)
        contradiction = solution.contradiction(earlier, AGREE_SIGMAS)
        if contradiction is None:
            self._provisional = solution
            return replace(found, is_settled=False, reason=f"{found.reason}; one before could not be tested")
        if contradiction:
            self._provisional = solution
            self.taken_back += 1
            return replace(
                found,
                is_settled=False,
                takes_back=True,
                reason=f"{found.reason}; the start before was taken back: {contradiction}",
            )
        if found.scale_sigma > _SETTLED_SCALE_SIGMA and seen_s < 0.95 * config.mono_window_s:
            reason = f"scale sigma {100.0 * found.scale_sigma:.1f} % while the window grows"
            return self._refusals.refuse("test", reason)
        return found

    def _clock_refusal(self, bundle: BundleSolution) -> Initialisation | None:
        """Refuse, with the offset of the camera's clock, where it shows and the attempt before showed it, too."""
        offset_s, sigma_s = bundle.time_offset_s, bundle.time_offset_sigma_s
        before_s, self._offset_s = self._offset_s, offset_s
        if abs(offset_s) <= max(_FOREIGN_OFFSET_S, AGREE_SIGMAS * sigma_s):
            return None
        reason = f"camera clock found off by {1e3 * offset_s:.1f} +- {1e3 * sigma_s:.1f} ms"
        refusal = self._refusals.refuse("time offset", reason)
        if before_s is None or abs(offset_s - before_s) > max(_FOREIGN_OFFSET_S, AGREE_SIGMAS * sigma_s):
            return refusal
        return replace(refusal, time_offset_s=offset_s, time_offset_sigma_s=sigma_s)

    def _repetition_refusal(self, before: Solution | None, now: Solution) -> Initialisation | None:
        """Refuse what the attempt before does not confirm: a wrong minimum does not come twice at the same scale."""
        if self._provisional is not None:
            return None
        if before is None:
            return self._refusals.refuse("confirmation", "one more look needed to confirm the scale")
        contradiction = now.contradiction(before, AGREE_SIGMAS)
        if contradiction is None:
            contradiction = "no frame in common"
        if not contradiction:
            return None
        return self._refusals.refuse("confirmation", f"against the attempt before: {contradiction}")

    def _lacking(self, tracks: Tracks, path: InertialPath, seen_s: float) -> str:
        """Return what would make the window show more, as far as that can be computed."""
        config = self._config
        if path.excitation_m_s2 < _AMPLE * config.min_excitation_m_s2:
            return f"acceleration changes by {path.excitation_m_s2:.2f} m/s2 only: speed up, brake or turn"
        parallax_px = median_parallax(tracks, path.rotations) * self._camera.fx
        if parallax_px < _AMPLE * MIN_PARALLAX_PX:
            return f"parallax is {parallax_px:.0f} px only: move sideways, or nearer to what is seen"
        if seen_s < 0.95 * config.mono_window_s:
            return f"{seen_s:.1f} s seen, more come"
        return "the IMU's noise, with what the ride shakes, hides the scale"


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
    return Observations(seen.track_ids[rows], seen.pixels_px[rows], instant_px=instant, readout_s=seen.readout_s)
