"""`vislam calibrate mag`: hard and soft iron, from one slow turn on the cart or from turns by hand to all sides."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vislam.calibration.inertial.field import IronFit, fit_iron
from vislam.calibration.inertial.tables import Table, read_field, read_inertial
from vislam.calibration.options import MagOptions
from vislam.calibration.outcome import Folder, Outcome, refuse
from vislam.core.angles import angles_between, directions
from vislam.core.errors import DataError
from vislam.core.geometry import level_rotation
from vislam.core.messages import Array
from vislam.datasets import survey
from vislam.datasets.imu_files import calibration_text, read_imu_calibration
from vislam.imu import MagCalibration

_FILES = ("mag.yaml", "mag.png", "mag.json")
_UP_S = 0.5  # over which force is averaged to find where up is
_MAX_TILT_DEG = 12.0  # from the usual attitude: more is no turn on the floor
_MAX_GAP_DEG = 40.0  # between neighbouring headings of a turn
_SPHERE_SECTORS = 50  # directions that a turn by hand has to come near to
_NEAR_COS = np.cos(np.deg2rad(30.0))
_MIN_SPHERE = 0.8  # share of them
_MAX_DIRECTION_SIGMA = np.deg2rad(2.0)
_MAX_MISFIT = 0.1  # of the radius: an ellipse that is none, because the field is not the same everywhere
_MAX_HEADING_DEG = 10.0  # rms between the calibrated heading and the gyroscope's


@dataclass(frozen=True, slots=True, eq=False)
class MagResult:
    """The fit and what it rests on."""

    mode: Literal["2d", "3d"]
    fit: IronFit
    R_level: Array  # [3, 3] from the sensor's axes to level ones, at the usual attitude
    points: Array  # [N, D] raw
    largest_gap_deg: float  # between neighbouring headings; 2d only
    covered: float  # share of the sphere; 3d only
    heading_rms_deg: float  # against the gyroscope; 2d only
    tilt_deg: float  # 95 % of the attitudes stay within

    @property
    def calibration(self) -> MagCalibration:
        """What the config takes; in 2d the vertical is left as it is."""
        if self.mode == "3d":
            return MagCalibration(self.fit.centre, self.fit.shape)
        matrix = np.eye(3)
        matrix[:2, :2] = self.fit.shape
        centre = np.array([*self.fit.centre, 0.0])
        return MagCalibration(self.R_level.T @ centre, self.R_level.T @ matrix @ self.R_level)


def calibrate_mag(options: MagOptions) -> Outcome:
    """Calibrate and write; raises DataError when the recording does not determine hard and soft iron."""
    folder = Folder(options.out, _FILES, options.overwrite)
    result = solve_mag(read_field(options.source), _inertial(options), options)
    report = _report(result)
    path = folder.write_text("mag.yaml", calibration_text(result.calibration, "; ".join(_statements(result))))
    folder.write_picture("mag.png", (9.0, 4.4), lambda figure, colors: draw(figure, colors, result))
    folder.write_report("mag.json", report)
    lines = (*_lines(result), f"next: vislam run ... --calibration.mag {path}, for recordings of raw fields")
    return Outcome(report, lines, tuple(folder.files))


def solve_mag(field: Table, inertial: Table, options: MagOptions) -> MagResult:
    """Return hard and soft iron, in 3-D when the sensor was tilted to all sides; raises DataError saying what lacks."""
    what = f"the magnetometer in {field.path}"
    up = _up_at(field, inertial)
    usual = np.median(up, axis=0)
    usual /= np.linalg.norm(usual)
    tilt_deg = float(np.rad2deg(np.quantile(angles_between(up, usual), 0.95)))
    stuck = [axis for axis, spread in zip("xyz", np.ptp(field.values, axis=0), strict=True) if spread == 0.0]
    refuse(what, [f"{', '.join(stuck)} never changes; it is stuck or saturated"] if stuck else [])
    mode = options.mode if options.mode != "auto" else ("2d" if tilt_deg < _MAX_TILT_DEG else "3d")
    if mode == "3d":
        return _solve_3d(what, field, tilt_deg, level_rotation(usual))
    refuse(
        what,
        [f"it was tilted by {tilt_deg:.0f} deg; for the flat fit turn the cart on the floor, or turn it by hand to all "
         "sides for --mode 3d"]
        if tilt_deg >= _MAX_TILT_DEG else [],
    )  # fmt: skip
    return _solve_2d(what, field, inertial, up, usual, tilt_deg)


def _solve_3d(what: str, field: Table, tilt_deg: float, R_level: Array) -> MagResult:
    fit = fit_iron(field.values)
    centre = field.values.mean(axis=0) if fit is None else fit.centre
    covered = float(np.mean(sphere_seen(field.values, centre)[1]))
    reasons = []
    if fit is None or covered < _MIN_SPHERE:
        reasons.append(f"only {covered:.0%} of all directions were seen; turn it about all axes, up to upside down")
    else:
        reasons += _doubts(fit)
    refuse(what, reasons)
    assert fit is not None
    return MagResult("3d", fit, R_level, field.values, 0.0, covered, 0.0, tilt_deg)


def sphere_seen(values: Array, centre: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return directions over the sphere [M, 3], and which of them [M] a field [N, 3] about a centre came near to."""
    ways = values - centre
    ways = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    sphere = directions(_SPHERE_SECTORS)
    return sphere, np.asarray((sphere @ ways.T).max(axis=1) > _NEAR_COS)


def largest_gap_deg(values: Array, up: Array) -> float:
    """Return the largest gap between neighbouring headings of a field [N, 3] on a sensor that turns about `up` [3]."""
    level = values @ level_rotation(up)[:2].T
    centre = 0.5 * (level.min(axis=0) + level.max(axis=0))
    return _gap_deg(np.arctan2(*(level - centre).T[::-1]))


def _solve_2d(what: str, field: Table, inertial: Table, up: Array, usual: Array, tilt_deg: float) -> MagResult:
    R_level = level_rotation(usual)
    level = np.einsum("nij,nj->ni", _levelled(up, R_level, usual), field.values)[:, :2]
    yaw = _yaw_at(field, inertial, up)
    _refuse_gap(what, yaw)
    fit = fit_iron(level)
    if fit is None:
        raise DataError(
            f"{what} cannot be determined: the field does not turn with the cart; is it saturated or stuck?"
        )
    refuse(what, _doubts(fit))
    seen = (level - fit.centre) @ fit.shape
    magnetic = np.unwrap(-np.arctan2(seen[:, 1], seen[:, 0]))
    gap = _refuse_gap(what, magnetic)  # a gyroscope with its bias turns while the cart does not
    line = np.polyfit(field.t_s, magnetic - yaw, 1)  # offset, and the drift of the gyroscope
    rms = float(np.rad2deg(np.std(magnetic - yaw - np.polyval(line, field.t_s))))
    refuse(what, [f"its heading and the gyroscope's differ by {rms:.0f} deg rms: the field changes on the way (iron, "
                  "motors), or an axis is swapped; turn on the spot, elsewhere"]
           if rms > _MAX_HEADING_DEG else [])  # fmt: skip
    return MagResult("2d", fit, R_level, level, gap, 0.0, rms, tilt_deg)


def _refuse_gap(what: str, heading_rad: Array) -> float:
    """Return the largest gap between neighbouring headings in degrees; raises DataError when a sector is missing."""
    gap = _gap_deg(heading_rad)
    reason = f"a sector of {gap:.0f} deg was never faced; turn the cart once around, slowly"
    refuse(what, [reason] if gap > _MAX_GAP_DEG else [])
    return gap


def _gap_deg(heading_rad: Array) -> float:
    heading = np.sort(np.mod(heading_rad, 2.0 * np.pi))
    return float(np.rad2deg(np.max(np.diff(heading, append=heading[0] + 2.0 * np.pi))))


def _doubts(fit: IronFit) -> list[str]:
    misfit = float(np.std(fit.residual_ut)) / fit.radius
    doubts = []
    if misfit > _MAX_MISFIT:
        doubts.append(f"lengths scatter by {misfit:.0%}: the field is not the same everywhere; go away from iron")
    if not fit.direction_sigma_rad < _MAX_DIRECTION_SIGMA:
        doubts.append(f"directions would be known to {np.rad2deg(fit.direction_sigma_rad):.1f} deg only; turn longer")
    return doubts


def _inertial(options: MagOptions) -> Table:
    """Return inertial samples, calibrated by the file that is named or by the recording's own."""
    table = read_inertial(options.source)
    own = None if options.source.is_file() else survey(str(options.source)).imu_calibration
    calibration = own if options.imu is None else read_imu_calibration(options.imu)
    if calibration is None:
        return table
    values = calibration.apply_to(table.values)
    return Table(table.path, table.t_ns, values, table.problems)


def _up_at(field: Table, inertial: Table) -> Array:
    """Return where up is [N, 3] at the times of the field, from force averaged over half a second."""
    width = max(1, round(_UP_S / inertial.period_s))
    sums = np.cumsum(np.vstack([np.zeros((1, 3)), inertial.values[:, 3:]]), axis=0)
    centre = np.clip(np.searchsorted(inertial.t_ns, field.t_ns), 0, len(inertial.t_ns) - 1)
    first = np.clip(centre - width // 2, 0, len(inertial.t_ns) - 1)
    last = np.clip(first + width, 1, len(inertial.t_ns))
    mean = (sums[last] - sums[first]) / (last - first)[:, None]
    return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True))


def _yaw_at(field: Table, inertial: Table, up: Array) -> Array:
    """Return the heading [N] by the gyroscope alone, about the vertical."""
    index = np.clip(np.searchsorted(field.t_ns, inertial.t_ns), 0, len(up) - 1)
    rate = np.einsum("ni,ni->n", inertial.values[:, :3], up[index])
    steps = np.diff(inertial.t_ns) * 1e-9
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * steps)])
    return np.interp(field.t_ns.astype(np.float64), inertial.t_ns.astype(np.float64), yaw)


def _levelled(up: Array, R_level: Array, usual: Array) -> Array:
    """Return rotations [N, 3, 3] into level axes: that of the usual attitude after the small one back to it."""
    axis = np.cross(up, usual)
    K = np.zeros((len(up), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    K -= K.transpose(0, 2, 1)
    cosine = np.clip(up @ usual, -0.99, 1.0)[:, None, None]
    return np.asarray(R_level @ (np.eye(3) + K + K @ K / (1.0 + cosine)))


def _statements(result: MagResult) -> list[str]:
    if result.mode == "3d":
        return [
            f"3-D from {result.covered:.0%} of all directions; the soft iron is taken as symmetric: a common turn of "
            "all directions against the IMU is not determined",
        ]
    return [
        "2-D: only the level part is calibrated, at the attitude of the cart on the floor; the vertical offset is not "
        "determined by turning about the vertical and stays as it is",
        f"headings agree with the gyroscope to {result.heading_rms_deg:.1f} deg rms over the turn",
    ]


def _report(result: MagResult) -> dict[str, Any]:
    fit, calibration = result.fit, result.calibration
    return {
        "kind": "mag",
        "mode": result.mode,
        "bias_ut": calibration.bias_ut.tolist(),
        "matrix": calibration.matrix.tolist(),
        "centre_sigma_ut": fit.centre_sigma.tolist(),
        "radius_ut": fit.radius,
        "direction_sigma_deg": float(np.rad2deg(fit.direction_sigma_rad)),
        "residual_rms_ut": float(np.std(fit.residual_ut)),
        "joined_samples": fit.joined,
        "largest_gap_deg": result.largest_gap_deg if result.mode == "2d" else None,
        "heading_rms_deg": result.heading_rms_deg if result.mode == "2d" else None,
        "covered": result.covered if result.mode == "3d" else None,
        "tilt_deg": result.tilt_deg,
        "statements": _statements(result),
    }


def _lines(result: MagResult) -> list[str]:
    fit = result.fit
    centre = ", ".join(f"{c:+.2f} ± {s:.2f}" for c, s in zip(fit.centre, fit.centre_sigma, strict=True))
    shape = "; ".join(", ".join(f"{x:+.4f}" for x in row) for row in fit.shape)
    return [
        f"{result.mode} fit to {len(result.points)} samples: centre {centre} µT, field {fit.radius:.1f} µT, "
        f"soft iron [{shape}]",
        f"directions to {np.rad2deg(fit.direction_sigma_rad):.2f} deg (1 sigma), residual "
        f"{np.std(fit.residual_ut):.2f} µT rms",
        *_statements(result),
    ]


def draw(figure: Figure, colors: Mapping[str, str], result: MagResult) -> None:
    """Draw the field before and after, and the residual of its strength."""
    left, right = figure.subplots(1, 2)
    after = (result.points - result.fit.centre) @ result.fit.shape
    left.plot(result.points[:, 0], result.points[:, 1], ".", markersize=2, color=colors["muted"], label="raw")
    left.plot(after[:, 0], after[:, 1], ".", markersize=2, color=colors["graph"], label="calibrated")
    around = np.linspace(0.0, 2.0 * np.pi, 200)
    r = result.fit.radius
    left.plot(r * np.cos(around), r * np.sin(around), color=colors["ekf"], linewidth=0.8)
    left.set(title=f"field, y over x [µT] ({result.mode})", aspect="equal", xlabel="x", ylabel="y")
    left.legend(loc="upper right")
    right.plot(result.fit.residual_ut, ".", markersize=2, color=colors["graph"])
    right.set(xlabel="sample", title="strength minus the mean [µT]")
