"""`vislam calibrate imu`: scale, axes and bias of accelerometer and gyroscope, from a dozen poses held by hand."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vislam.calibration.inertial.many_poses import (
    AccelFit,
    GyroFit,
    Rest,
    fit_accelerometer,
    fit_gyroscope,
    rest_of,
    sphere_through,
)
from vislam.calibration.inertial.stillness import Movement, movement
from vislam.calibration.inertial.tables import Table, read_inertial
from vislam.calibration.options import ImuOptions
from vislam.calibration.outcome import Folder, Outcome, refuse
from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.datasets.imu_files import calibration_text
from vislam.imu import ImuCalibration

_FILES = ("imu.yaml", "imu.png", "imu.json")
_NAMES = ("gyro x", "gyro y", "gyro z", "accel x", "accel y", "accel z")
_QUIET_SHARE = 0.1  # of the time, at least, in which the sensor is held still
_FACTORS = (2.0, 3.0, 4.0, 6.0, 10.0)  # times the quiet spread that still is rest; the best one is chosen
_APART_COS = np.cos(np.deg2rad(20.0))  # nearer directions are one pose
_MIN_DIRECTIONS = {"full": 10, "scale": 7}  # one more than the unknowns: without redundancy nothing can be checked
_FLAT = 0.25  # spread across the flattest direction over the mean spread: less is a plane
_FACING = 0.7  # component along an axis of a pose that has it up or down
_MAX_TILT_RAD = np.deg2rad(0.5)  # the sigma of a calibration worth the name
_MAX_GYRO_SIGMA = 0.02  # of an entry of the gyroscope's matrix
_LOST_RAD = 0.1  # no cheap gyroscope loses so much over a turn of seconds
_UNITS = (0.5, 2.0)  # scale factors outside mean another unit


@dataclass(frozen=True, slots=True, eq=False)
class ImuResult:
    """Both fits and what they rest on."""

    rests: list[Rest]
    directions: int  # distinct ones
    accel: AccelFit
    gyro: GyroFit

    @property
    def calibration(self) -> ImuCalibration:
        """What the config takes."""
        return ImuCalibration(self.gyro.bias, self.accel.bias, self.gyro.matrix, self.accel.matrix)


def calibrate_imu(options: ImuOptions) -> Outcome:
    """Calibrate and write; raises DataError when the recording does not determine the calibration."""
    folder = Folder(options.out, _FILES, options.overwrite)
    table = read_inertial(options.source)
    stuck = [name for name, spread in zip(_NAMES, np.ptp(table.values, axis=0), strict=True) if spread == 0.0]
    refuse(f"the IMU in {table.path}", [f"{', '.join(stuck)} never changes; it is stuck"] if stuck else [])
    moved = movement(table, _QUIET_SHARE)
    result = solve_imu(table, moved, options)
    report = _report(result, table)
    path = folder.write_text("imu.yaml", calibration_text(result.calibration, _comment(result)))
    folder.write_picture("imu.png", (11.0, 7.0), lambda figure, colors: draw(figure, colors, result, table, moved))
    folder.write_report("imu.json", report)
    lines = (*_lines(result), f"next: vislam run ... --calibration.imu {path}, for recordings of raw samples")
    return Outcome(report, lines, tuple(folder.files))


def solve_imu(table: Table, moved: Movement, options: ImuOptions) -> ImuResult:
    """Return the calibration from the choice of rests that determines it best; raises DataError saying what lacks."""
    least = round(options.rest_s / table.period_s)
    tried: list[tuple[float, list[Rest], AccelFit]] = []
    trouble: list[str] = []
    seen: set[int] = set()
    for factor in _FACTORS:
        rests = [rest_of(table, span) for span in moved.rests(factor, least)]
        missing = _lacking(rests, options)
        if missing:
            if len(rests) >= max(seen, default=0):
                trouble = missing
            seen.add(len(rests))
            continue
        accel = fit_accelerometer(rests, options.gravity_m_s2, options.model == "scale")
        tried.append((accel.tilt_sigma_rad, rests, accel))
    if not tried:
        refuse(f"the accelerometer in {table.path}", trouble)
    _, rests, accel = min(tried, key=lambda each: each[0])
    _check_accelerometer(accel, table)
    gyro = fit_gyroscope(table, rests, accel, options.gravity_m_s2)
    if gyro is None:
        raise DataError(f"{table.path}: holes between most poses, so that turns cannot be integrated; record again")
    _check_gyroscope(gyro, table)
    return ImuResult(rests, _distinct(rests), accel, gyro)


@dataclass(frozen=True, slots=True, eq=False)
class ImuPoses:
    """What a recording that still goes on has of poses."""

    directions: int  # distinct ones
    up: Array  # [M, 3] roughly, in raw axes, at every rest
    lacking: list[str]  # for a calibration
    unseen: str  # sides that were never up; empty while there are few poses
    is_still: bool  # now
    held_s: float  # since when
    rest_s: float  # that a pose has to be held


def poses_so_far(table: Table, options: ImuOptions) -> ImuPoses:
    """Return which poses the samples up to now show; `solve_imu` has the last word on them."""
    moved = movement(table, _QUIET_SHARE)
    least = round(options.rest_s / table.period_s)
    rests = [rest_of(table, span) for span in moved.rests(_FACTORS[2], max(least, 3))]
    known = np.flatnonzero(np.isfinite(moved.spread[:, 0]))  # the window looks ahead: the newest are not known yet
    still = np.all(moved.spread[known] <= _FACTORS[2] * moved.usual, axis=1)
    moving = np.flatnonzero(~still)
    held = len(still) if not len(moving) else len(still) - 1 - int(moving[-1])
    directions = _distinct(rests)
    unseen = _unseen(rests) if directions > 3 else ""
    up = _raw_directions(rests)
    lacking = _lacking(rests, options)
    return ImuPoses(directions, up, lacking, unseen, held > 0, held * table.period_s, options.rest_s)


def _lacking(rests: list[Rest], options: ImuOptions) -> list[str]:
    """Return what lacks for a fit: directions, or that they leave a plane."""
    wanted = _MIN_DIRECTIONS[options.model]
    found = _distinct(rests)
    hint = "" if found < 4 else f" ({_unseen(rests)})"
    if found < wanted:
        return [
            f"{len(rests)} rests of {options.rest_s:g} s in {found} directions were found, {wanted} directions are the "
            f"least and 12 are good{hint}; hold it still in more, up to upside down"
        ]
    means = np.array([rest.accel for rest in rests])
    spread = np.linalg.svd(means - means.mean(axis=0), compute_uv=False)
    if spread[2] < _FLAT * spread.mean():
        return [f"all {found} directions lie nearly in a plane{hint}; tilt it out of that"]
    return []


def _distinct(rests: list[Rest]) -> int:
    """Count directions that are more than 20 degrees from each other."""
    kept: list[Array] = []
    for direction in _raw_directions(rests):
        if all(direction @ other < _APART_COS for other in kept):
            kept.append(direction)
    return len(kept)


def _raw_directions(rests: list[Rest]) -> Array:
    """Return roughly where up is at every rest [M, 3], in raw axes."""
    if not rests:
        return np.zeros((0, 3))
    means = np.array([rest.accel for rest in rests])
    centre, radius = sphere_through(means) if len(means) > 5 else (np.zeros(3), 0.0)
    length = np.median(np.linalg.norm(means, axis=1))
    if not 0.7 * length < radius < 1.4 * length:  # no sphere can be fitted to so few or so flat
        centre = np.zeros(3)
    return np.asarray((means - centre) / np.linalg.norm(means - centre, axis=1, keepdims=True))


def _unseen(rests: list[Rest]) -> str:
    up = _raw_directions(rests)
    names = [
        f"{'xyz'[axis]} {way}"
        for axis in range(3)
        for way, sign in (("up", 1.0), ("down", -1.0))
        if not np.any(sign * up[:, axis] > _FACING)
    ]
    return f"never with {', '.join(names)}" if names else "all six sides were up once"


def _check_accelerometer(accel: AccelFit, table: Table) -> None:
    scale = np.diag(accel.matrix)
    reasons = []
    if not np.all((scale > _UNITS[0]) & (scale < _UNITS[1])):
        reasons.append(f"the scale factors are {np.round(scale, 3).tolist()}; forces must be in m/s^2")
    if not accel.tilt_sigma_rad < _MAX_TILT_RAD:
        reasons.append(
            f"the direction of gravity would be known to {np.rad2deg(accel.tilt_sigma_rad):.2f} deg only; the poses "
            "contradict each other or are too alike"
        )
    refuse(f"the accelerometer in {table.path}", reasons)


def _check_gyroscope(gyro: GyroFit, table: Table) -> None:
    sigmas = np.sqrt(np.diag(gyro.covariance)[:9]).reshape(3, 3)
    scale = np.linalg.norm(gyro.matrix, axis=0)
    missed = float(np.sqrt(np.mean(gyro.residual_rad**2)))
    reasons = []
    if missed > _LOST_RAD:
        reasons.append(f"integrated turns miss gravity by {np.rad2deg(missed):.0f} deg rms; are rates in rad/s?")
    elif np.any(sigmas > _MAX_GYRO_SIGMA) or not np.isfinite(sigmas).all():
        turned = ", ".join(f"{a} {np.rad2deg(t):.0f}" for a, t in zip("xyz", gyro.turned_rad, strict=True))
        reasons.append(
            f"the scale of axis {'xyz'[int(np.argmax(sigmas.max(axis=0)))]} would be known to {sigmas.max():.1%} only "
            f"(turned about each axis, in degrees: {turned}); turn by a quarter and more about every axis between poses"
        )
    elif not np.all((scale > _UNITS[0]) & (scale < _UNITS[1])):
        reasons.append(f"the scale factors are {np.round(scale, 3).tolist()}; rates must be in rad/s")
    refuse(f"the gyroscope in {table.path}", reasons)


def _comment(result: ImuResult) -> str:
    return (
        f"{len(result.rests)} rests in {result.directions} directions; "
        f"tilt {np.rad2deg(result.accel.tilt_sigma_rad):.3f} deg, gyro scale {_gyro_sigmas(result.gyro).max():.2%} "
        "(1 sigma), at the temperature of that day"
    )


def _gyro_sigmas(gyro: GyroFit) -> Array:
    return np.sqrt(np.diag(gyro.covariance)[:9]).reshape(3, 3)


def _report(result: ImuResult, table: Table) -> dict[str, Any]:
    accel, gyro = result.accel, result.gyro
    triangle = np.zeros((3, 3))
    triangle[np.triu_indices(3)] = np.sqrt(np.diag(accel.covariance)[:6])
    return {
        "kind": "imu",
        "rests": len(result.rests),
        "directions": result.directions,
        "accel": {
            "matrix": accel.matrix.tolist(),
            "matrix_sigma": triangle.tolist(),
            "bias_m_s2": accel.bias.tolist(),
            "bias_sigma_m_s2": np.sqrt(np.diag(accel.covariance)[6:]).tolist(),
            "residual_rms_m_s2": float(np.sqrt(np.mean(accel.residual_m_s2**2))),
            "misfit": accel.misfit,
            "tilt_sigma_deg": float(np.rad2deg(accel.tilt_sigma_rad)),
        },
        "gyro": {
            "matrix": gyro.matrix.tolist(),
            "matrix_sigma": _gyro_sigmas(gyro).tolist(),
            "bias_rad_s": gyro.bias.tolist(),
            "bias_sigma_rad_s": np.sqrt(np.diag(gyro.covariance)[9:]).tolist(),
            "residual_rms_deg": float(np.rad2deg(np.sqrt(np.mean(gyro.residual_rad**2)))),
            "misfit": gyro.misfit,
            "turned_deg": np.rad2deg(gyro.turned_rad).tolist(),
        },
        "problems": table.problems,
        "statements": _statements(result),
    }


def _statements(result: ImuResult) -> list[str]:
    said = [
        "biases are those of the day and its temperature; let the sensor warm up, and expect them to move",
        "matrices turn raw axes into those of the accelerometer's chip, not of the cart that it sits on",
    ]
    for name, misfit in (("accelerometer", result.accel.misfit), ("gyroscope", result.gyro.misfit)):
        if misfit > 2.0:
            said.append(
                f"{name}: residuals are {np.sqrt(misfit):.1f} times what the noise at rest explains (a hand that "
                "moved, or a chip that is not linear); sigmas are widened by that"
            )
    return said


def _lines(result: ImuResult) -> list[str]:
    accel, gyro = result.accel, result.gyro
    sigma = np.sqrt(np.diag(accel.covariance))
    scale_sigma = sigma[[0, 3, 5]]
    gyro_sigma = _gyro_sigmas(gyro)
    bias_sigma = np.sqrt(np.diag(gyro.covariance)[9:])
    lines = [f"{len(result.rests)} rests in {result.directions} directions"]
    for k, axis in enumerate("xyz"):
        lines.append(
            f"accel {axis}: scale {accel.matrix[k, k]:.5f} ± {scale_sigma[k]:.5f}, "
            f"bias {accel.bias[k]:+.4f} ± {sigma[6 + k]:.4f} m/s²; "
            f"gyro {axis}: scale {np.linalg.norm(gyro.matrix[:, k]):.5f} ± {gyro_sigma[:, k].max():.5f}, "
            f"bias {np.rad2deg(gyro.bias[k]):+.4f} ± {np.rad2deg(bias_sigma[k]):.4f} deg/s"
        )
    lines.append(
        f"gravity then points right to {np.rad2deg(accel.tilt_sigma_rad):.3f} deg (1 sigma, mean over directions); its "
        f"length is met to {np.sqrt(np.mean(accel.residual_m_s2**2)):.4f} m/s², a turn to "
        f"{np.rad2deg(np.sqrt(np.mean(gyro.residual_rad**2))):.3f} deg rms"
    )
    return [*lines, *_statements(result)]


def draw(figure: Figure, colors: Mapping[str, str], result: ImuResult, table: Table, moved: Movement) -> None:
    """Draw when the sensor rested, which ways were up, and what is left of the residuals."""
    upper, lower = np.asarray(figure.subfigures(2, 1)).tolist()
    time = upper.subplots()
    step = max(len(table.t_ns) // 4000, 1)
    for column, (name, color) in enumerate((("rate [rad/s]", "ekf"), ("force [m/s²]", "graph"))):
        spread = np.where(np.isfinite(moved.spread[::step, column]), moved.spread[::step, column], np.nan)
        time.plot(table.t_s[::step], spread, linewidth=0.9, color=colors[color], label=f"spread of {name}")
    for rest in result.rests:
        time.axvspan(table.t_s[rest.span.start], table.t_s[rest.span.stop - 1], color=colors["good"], alpha=0.2, lw=0)
    time.set(yscale="log", xlabel="time [s]", title=f"{len(result.rests)} rests (green)")
    time.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    sphere = lower.add_subplot(1, 3, 1, projection="hammer")
    up = result.accel.directions(result.rests)
    sphere.scatter(np.arctan2(up[:, 1], up[:, 0]), np.arcsin(np.clip(up[:, 2], -1.0, 1.0)), s=22, color=colors["graph"])
    sphere.set_title("where up was")
    sphere.tick_params(labelbottom=False, labelleft=False)
    _draw_residuals(lower, colors, result)


def _draw_residuals(figure: Any, colors: Mapping[str, str], result: ImuResult) -> None:
    length = figure.add_subplot(1, 3, 2)
    numbers = np.arange(1, len(result.rests) + 1)
    sigma = [rest.accel_sigma for rest in result.rests]
    length.errorbar(numbers, result.accel.residual_m_s2, sigma, fmt="o", markersize=4, color=colors["graph"], capsize=2)
    length.axhline(0.0, color=colors["muted"], linewidth=0.8)
    length.set(xlabel="rest", title="length of force minus gravity [m/s²]")
    turns = figure.add_subplot(1, 3, 3)
    missed = np.rad2deg(result.gyro.residual_rad)
    turns.bar(np.arange(1, len(missed) + 1), missed, color=colors["ekf"])
    turns.set(xlabel="turn", title="gravity missed by the gyroscope [deg]")
