"""`vislam calibrate noise`: white noise and bias walk of an IMU that stood still, and what driving adds to them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import nnls

from vislam.calibration.inertial.stillness import movement
from vislam.calibration.inertial.tables import Table, read_inertial
from vislam.calibration.options import NoiseOptions
from vislam.calibration.outcome import Folder, Outcome, refuse
from vislam.core.chi_square import chi_square_tail
from vislam.core.messages import Array, ImuSample
from vislam.datasets.imu_files import imu_noise_text
from vislam.imu import ImuNoise, NoiseFloor, NoiseRatios

_FLICKER = 2.0 * np.log(2.0) / np.pi
_LEAST_CLUSTERS = 9  # the longest averaging time goes so often into the recording
_ROUNDS = 6  # of reweighting by the fitted curve
_FREQUENCIES = 3000  # of the integrals for the covariance
_LOWEST = 30.0  # the lowest frequency is so much below the longest averaging time's
_JITTER = 1e-6  # keeps a covariance of rounding errors regular
_LEAST_POINTS = 5  # a fit of two or three numbers must be testable
_PROBABLE = 0.01  # a fit worse than by this chance means that the model does not hold
_UPPER_SIGMAS = 2.0  # of an upper limit
_FILES = ("noise.yaml", "noise.png", "noise.json")
_MOVED = 4.0  # times the usual spread: it was touched
LEAST_STILL_S = 300.0  # shorter, the bias walk of no sensor shows
_MIN_SHARE = 0.5  # of the recording that must be still in one piece
ENOUGH_STILL_S = 3600.0
_WHITE_SIGMA = 0.05  # relative: larger is no calibration
_COLORS = ("axis-x", "axis-y", "axis-z")
_NAMES = ("gyro x", "gyro y", "gyro z", "accel x", "accel y", "accel z")
_UNITS = (("rad/s/√Hz", "rad/s²/√Hz"), ("m/s²/√Hz", "m/s³/√Hz"))
_MIN_SAMPLES = 2000


@dataclass(frozen=True, slots=True, eq=False)
class AllanCurve:
    """Overlapping Allan deviation [M] at averaging times [M] in octaves, of `count` samples at `rate_hz`."""

    tau_s: Array
    deviation: Array
    count: int
    rate_hz: float


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """White noise and random walk of one axis, each with its sigma; units of the samples per (or times) root Hz."""

    white: float
    white_sigma: float
    walk: float
    walk_sigma: float  # of `walk` where that is determined
    walk_limit: float  # two sigmas above
    flicker: float  # 0: the curve needs none
    tau_min_s: float  # shorter averaging times are not those of white noise: the sensor filters or rounds
    misfit: float  # chi-square per degree of freedom

    @property
    def walk_determined(self) -> bool:
        """Whether the random walk stands out from zero by two sigmas."""
        return self.walk > 0.0 and self.walk > 2.0 * self.walk_sigma

    def deviation(self, tau_s: Array) -> Array:
        """Return the fitted Allan deviation at averaging times."""
        return np.sqrt(self.white**2 / tau_s + _FLICKER * self.flicker**2 + self.walk**2 * tau_s / 3.0)


def allan_curve(values: Array, rate_hz: float) -> AllanCurve:
    """Return the overlapping Allan deviation of evenly spaced samples [N]; N must be 32 at least."""
    angle = np.concatenate([[0.0], np.cumsum(values - values.mean())]) / rate_hz
    lengths = 2 ** np.arange(int(np.log2(len(values) / _LEAST_CLUSTERS)) + 1)
    deviations = [
        np.sqrt(0.5 * np.mean((angle[2 * m :] - 2.0 * angle[m:-m] + angle[: -2 * m]) ** 2)) * rate_hz / m
        for m in lengths
    ]
    return AllanCurve(lengths / rate_hz, np.array(deviations), len(values), rate_hz)


def fit_noise(curve: AllanCurve) -> NoiseFit:
    """Fit the fewest terms over the longest range of averaging times that explain a curve.

    IEEE Std 952-1997, annex C: the Allan variance of a rate with white noise of density N, flicker of level B and
    random walk of density K is `N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3`. Degrees of freedom after Stable32
    (Riley, NIST SP 1065, section 5.4).

    Where nothing explains it, the best fit is taken and its sigmas are widened by the misfit.
    """
    tries = []
    for terms in (2, 3):
        for first in range(max(len(curve.tau_s) - _LEAST_POINTS - 1, 1)):
            fit, probability = _fit(curve, first, terms)
            if probability > _PROBABLE:
                return fit
            tries.append(fit)
    return min(tries, key=lambda fit: fit.misfit)


def _fit(curve: AllanCurve, first: int, terms: int) -> tuple[NoiseFit, float]:
    """Fit from averaging time `first` on; return the fit and the chance of one that is worse."""
    tau = curve.tau_s[first:]
    variance = curve.deviation[first:] ** 2
    columns = np.column_stack([1.0 / tau, tau / 3.0, np.full(len(tau), _FLICKER)])[:, :terms]
    filters = _filters(curve, first)
    found = np.array([variance[0] * tau[0], 0.0, 0.0])[:terms]
    for _ in range(_ROUNDS):
        whiten = np.linalg.inv(np.linalg.cholesky(_covariance(curve, filters, found)))
        found = nnls(whiten @ columns, whiten @ variance)[0]
        if not found.any():
            break  # nothing but zeros was measured
    whitened = whiten @ columns
    freedom = max(len(tau) - terms, 1)
    chi2 = float(np.sum((whiten @ variance - whitened @ found) ** 2))
    widened = max(1.0, np.sqrt(chi2 / freedom))
    spread = np.sqrt(np.diag(np.linalg.pinv(whitened.T @ whitened))) * widened
    white, walk = np.sqrt(found[:2])
    return NoiseFit(
        white=float(white),
        white_sigma=float(spread[0] / (2.0 * white)) if white > 0.0 else float(np.sqrt(spread[0])),
        walk=float(walk),
        walk_sigma=float(spread[1] / (2.0 * walk)) if walk > 0.0 else float(np.sqrt(spread[1])),
        walk_limit=float(np.sqrt(found[1] + _UPPER_SIGMAS * spread[1])),
        flicker=float(np.sqrt(found[2])) if terms == 3 else 0.0,
        tau_min_s=float(tau[0]),
        misfit=chi2 / freedom,
    ), chi_square_tail(chi2, freedom)


@dataclass(frozen=True, slots=True, eq=False)
class _Filters:
    """Averaging times as filters of the samples, over a grid of frequencies."""

    lengths: Array  # [M] samples
    gain: Array  # [M, F] squared
    sine: Array  # [F] of pi times the frequency in cycles per sample
    step: Array  # [F] of the integral over frequency, both signs


def _filters(curve: AllanCurve, first: int) -> _Filters:
    m = np.round(curve.tau_s[first:] * curve.rate_hz)
    edges = np.geomspace(1.0 / (_LOWEST * m[-1]), 0.5, _FREQUENCIES + 1)
    f = np.sqrt(edges[1:] * edges[:-1])
    sine = np.sin(np.pi * f)
    return _Filters(m, 2.0 * np.sin(np.pi * np.outer(m, f)) ** 4 / (m[:, None] * sine) ** 2, sine, 2.0 * np.diff(edges))


def _covariance(curve: AllanCurve, filters: _Filters, found: Array) -> Array:
    """Return the covariance [M, M] of the Allan variances of Gaussian noise with fitted squared densities [2 or 3].

    Two means of squares of Gaussian series have the covariance 2 / length times the integral of both squared gains and
    the squared spectrum. Flicker is taken as `B^2 / (2 pi f)`.
    """
    per_sample = found[0] * curve.rate_hz + found[1] / curve.rate_hz / (4.0 * filters.sine**2)
    if len(found) == 3:
        per_sample = per_sample + found[2] / (2.0 * filters.sine)
    through = filters.gain * per_sample
    root_used = np.sqrt(curve.count + 1.0 - 2.0 * filters.lengths)
    covariance = 2.0 * ((through * filters.step) @ through.T) / np.outer(root_used, root_used)
    return np.asarray(covariance + np.diag(_JITTER * np.diag(covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class NoiseCalibration:
    """What a still recording shows of noise, per axis (gyro x y z, accel x y z) and as one model."""

    curves: tuple[AllanCurve, ...]
    fits: tuple[NoiseFit, ...]
    model: ImuNoise  # rms over the axes; a bias walk that does not show counts with its upper limit
    still_s: float
    driving: NoiseRatios | None  # white noise while driving over that of the model


def calibrate_noise(options: NoiseOptions) -> Outcome:
    """Fit the noise model to a still recording and write it; raises DataError when it does not determine the model."""
    folder = Folder(options.out, _FILES, options.overwrite)
    found = fit_still(read_inertial(options.source))
    written = found.model
    if options.driving is not None:
        floor = driving_floor(read_inertial(options.driving), found.model)
        found = NoiseCalibration(found.curves, found.fits, found.model, found.still_s, floor.ratios)
        written = floor.at_least_seen()
    report = _report(found, written)
    path = folder.write_text("noise.yaml", imu_noise_text(written, "; ".join(_statements(found))))
    folder.write_picture("noise.png", (10.0, 4.6), lambda figure, colors: draw(figure, colors, found))
    folder.write_report("noise.json", report)
    lines = (*_lines(found, written), f"next: vislam run ... --calibration.imu-noise {path}")
    return Outcome(report, lines, tuple(folder.files))


def fit_still(table: Table) -> NoiseCalibration:
    """Return the noise of the longest still piece of a recording; raises DataError when that is too short."""
    still = _longest_still(table)
    span_s = (len(still.t_ns) - 1) * still.period_s
    refuse(
        f"the noise in {table.path}",
        [f"only {span_s:.0f} s in a row are still and without holes, {LEAST_STILL_S:.0f} s are the least and an hour "
         "is good; put the sensor on something heavy, away from traffic, and record again"]
        if span_s < LEAST_STILL_S or len(still.t_ns) < _MIN_SAMPLES else [],
    )  # fmt: skip
    refuse(
        f"the noise in {table.path}",
        [f"only {span_s:.0f} s of {table.duration_s:.0f} s are still; it was moved or touched in between"]
        if span_s < _MIN_SHARE * table.duration_s else [],
    )  # fmt: skip
    rate_hz = (len(still.t_ns) - 1) / still.duration_s
    curves = tuple(allan_curve(still.values[:, axis], rate_hz) for axis in range(6))
    dead = [name for name, curve in zip(_NAMES, curves, strict=True) if not curve.deviation.all()]
    refuse(f"the noise in {table.path}", [f"{', '.join(dead)} never changes; it is stuck"] if dead else [])
    fits = tuple(fit_noise(curve) for curve in curves)
    loose = [
        f"{name}: white noise only to {fit.white_sigma / max(fit.white, 1e-30):.0%}"
        for name, fit in zip(_NAMES, fits, strict=True)
        if not fit.white_sigma < _WHITE_SIGMA * fit.white
    ]
    reasons = [*loose, "the curve is not that of white noise; record longer"]
    refuse(f"the noise in {table.path}", reasons if loose else [])
    return NoiseCalibration(curves, fits, _model(fits, rate_hz), span_s, None)


def driving_floor(table: Table, model: ImuNoise) -> NoiseFloor:
    """Return the noise levels of a driving recording against a model."""
    floor = NoiseFloor(model)
    for t_ns, row in zip(table.t_ns.tolist(), table.values, strict=True):
        floor.add(ImuSample(t_ns, row[:3], row[3:]))
    return floor


def longest_still_s(table: Table) -> float:
    """Return how long a sensor stood still in one piece."""
    still = _longest_still(table)
    return (len(still.t_ns) - 1) * table.period_s


def _longest_still(table: Table) -> Table:
    rests = movement(table, 0.5).rests(_MOVED, 2)
    longest = max(rests, key=lambda rest: rest.stop - rest.start, default=slice(0, 0))
    return table.between(longest.start, max(longest.stop, longest.start + 2))


def _model(fits: tuple[NoiseFit, ...], rate_hz: float) -> ImuNoise:
    def rms(values: list[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    white = [fit.white for fit in fits]
    walk = [fit.walk if fit.walk_determined else fit.walk_limit for fit in fits]
    return ImuNoise(rms(white[:3]), rms(white[3:]), rms(walk[:3]), rms(walk[3:]), rate_hz)


def _statements(found: NoiseCalibration) -> list[str]:
    """Return what a user must know of how far the numbers can be trusted."""
    said = [f"{found.still_s:.0f} s still at {found.model.rate_hz:.1f} Hz; white noise to {_worst_white(found):.1%}"]
    limits = [name for name, fit in zip(_NAMES, found.fits, strict=True) if not fit.walk_determined]
    if limits:
        advice = "" if found.still_s > ENOUGH_STILL_S else f"; {ENOUGH_STILL_S / 3600.0:.0f} h or more would show it"
        said.append(f"bias walk of {', '.join(limits)} does not stand out and counts with its upper limit{advice}")
    misfits = [name for name, fit in zip(_NAMES, found.fits, strict=True) if fit.misfit > 5.0]
    if misfits:
        said.append(f"{', '.join(misfits)}: no sum of white noise, flicker and walk fits; vibration or temperature")
    if found.driving is None:
        said.append("vibration of driving is not in it; add --driving RECORDING")
    return said


def _worst_white(found: NoiseCalibration) -> float:
    return max(fit.white_sigma / fit.white for fit in found.fits)


def _report(found: NoiseCalibration, written: ImuNoise) -> dict[str, Any]:
    axes = {
        name: {**asdict(fit), "walk_determined": fit.walk_determined}
        for name, fit in zip(_NAMES, found.fits, strict=True)
    }
    return {
        "kind": "noise",
        "still_s": found.still_s,
        "model": asdict(found.model),
        "written": asdict(written),
        "driving": None if found.driving is None else asdict(found.driving),
        "axes": axes,
        "statements": _statements(found),
    }


def _lines(found: NoiseCalibration, written: ImuNoise) -> list[str]:
    lines = []
    for k, (name, fit) in enumerate(zip(_NAMES, found.fits, strict=True)):
        white_unit, walk_unit = _UNITS[k // 3]
        walk = f"{fit.walk:.2e} ± {fit.walk_sigma:.0e}" if fit.walk_determined else f"below {fit.walk_limit:.1e}"
        lines.append(
            f"{name}: white {fit.white:.3e} ± {fit.white_sigma:.0e} {white_unit}, walk {walk} {walk_unit}"
        )  # fmt: skip
    if found.driving is not None:
        r = found.driving
        lines.append(
            f"driving: white noise {r.gyro_quiet:.1f} (gyro), {r.accel_quiet:.1f} (accel) times that in the quietest "
            f"half second, {r.gyro_typical:.1f} and {r.accel_typical:.1f} in the usual one; written: "
            f"{written.gyroscope_noise_density:.2e} and {written.accelerometer_noise_density:.2e}"
        )
    return [*lines, *_statements(found)]


def draw(figure: Figure, colors: Mapping[str, str], found: NoiseCalibration) -> None:
    """Draw measured and fitted Allan deviations of both sensors."""
    titles = ("gyroscope [rad/s]", "accelerometer [m/s²]")
    for sensor, axes in enumerate(figure.subplots(1, 2)):
        for k in range(3):
            curve, fit = found.curves[3 * sensor + k], found.fits[3 * sensor + k]
            color = colors[_COLORS[k]]
            axes.plot(curve.tau_s, curve.deviation, "o", markersize=3, color=color)
            smooth: Array = np.geomspace(curve.tau_s[0], curve.tau_s[-1], 100)
            style = "-" if fit.walk_determined else "--"
            axes.plot(smooth, fit.deviation(smooth), style, linewidth=1.2, color=color, label=_label(fit, "xyz"[k]))
        if found.driving is not None:
            ratio = (found.driving.gyro_typical, found.driving.accel_typical)[sensor]
            density = (found.model.gyroscope_noise_density, found.model.accelerometer_noise_density)[sensor]
            axes.axhline(
                ratio * density * np.sqrt(found.model.rate_hz), color=colors["warn"], linestyle=":",
                label="one sample while driving, usual",
            )  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="averaging time [s]", title=f"Allan deviation, {titles[sensor]}")
        axes.legend(loc="lower left")


def _label(fit: NoiseFit, axis: str) -> str:
    walk = f"{fit.walk:.1e}" if fit.walk_determined else f"< {fit.walk_limit:.1e}"
    return f"{axis}: white {fit.white:.2e}, walk {walk}"
