"""Whether a board that stands still measures what the world has: gravity, no rotation, the earth's field."""

from collections.abc import Callable

import numpy as np

from vislam.core.findings import Finding, Severity
from vislam.core.messages import ImuSample, MagSample
from vislam.hw.fifo_board import FifoBoard
from vislam.hw.gy85 import Gy85
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource
from vislam.hw.own_imu import OwnImu

Add = Callable[..., None]

_GRAVITY_M_S2, _GRAVITY_TOLERANCE_M_S2 = 9.81, 0.5
MAX_RATE_DEG_S = 40.0  # zero-rate output of an ITG3205 by the data sheet
_MAX_GYRO_STD_DEG_S, _MAX_ACCEL_STD_M_S2 = 1.0, 0.3  # three times the noise of the chips
_FIELD_UT = (22.0, 67.0)  # of the earth, anywhere
_TEMPERATURE_C = (-40.0, 85.0)
_MIN_SAMPLES = 50
_EXPLAINED = {
    "nack": "a chip did not acknowledge: short wires, pull-ups of 2 to 4.7 kOhm, 400 kHz at most",
    "timeout": "a line was held low: look for a loose or shorted wire",
    "rounds_missed": "the machine was too busy to ask in time: free it, or use the serial bridge",
    "accel_overrun": "the accelerometer's FIFO ran over: the machine was busy for more than 80 ms",
    "fifo_overrun": "the chip's FIFO ran over: the machine was busy for longer than it holds (docs/sensors.md)",
    "imu_silent": "the chip gave no samples and was set up again: check its supply and the plug",
    "settings_lost": "a chip lost its power for a moment: check the plug",
    "reopened": "a chip went away and came back: check the plug",
}


def _adding(where: str) -> tuple[list[Finding], Add]:
    """Return a list of findings about a place, and what adds one of a severity, what it is and the next step."""
    findings: list[Finding] = []

    def add(severity: Severity, what: str, next_step: str = "") -> None:
        findings.append(Finding(severity, what, where, next_step))

    return findings, add


def check_board(
    board: Gy85 | FifoBoard, inertial: list[ImuSample], magnetic: list[MagSample], where: str
) -> list[Finding]:
    """Return what the self-tests, the fault counters and some seconds of samples at rest say."""
    findings, add = _adding(where)
    for test in board.self_tests or board.run_self_tests():
        if test.passed is None:
            add("warning", f"{test.chip}: {test.what}", test.next_step)
        elif test.passed:
            add("ok", f"{test.chip} passes its self-test: {test.what}")
        else:
            add(
                "warning",
                f"{test.chip} fails its self-test: {test.what}",
                test.next_step or "check its supply (3.3 V); replace the board",
            )
    for name, count in sorted(board.counters().items()):
        add("warning", f"{name}: {count}", _EXPLAINED.get(name, "see docs/sensors.md"))
    word = board.health() & ~Health.MAG_FAULT
    if word:
        add("warning", f"health: {word.name}", "see docs/sensors.md")
    max_rate_deg_s = board.imu.max_zero_deg_s if isinstance(board, FifoBoard) and board.imu else MAX_RATE_DEG_S
    findings += check_rest(inertial, where, max_rate_deg_s)
    if board.temperature_c is not None:
        low, high = _TEMPERATURE_C
        is_possible = low < board.temperature_c < high
        add("ok" if is_possible else "warning", f"the gyro has {board.temperature_c:.1f} deg C")
    _check_field(board, magnetic, add)
    return findings


def _check_rest(inertial: list[ImuSample], max_rate_deg_s: float, add: Add) -> None:
    gyro = np.rad2deg([sample.gyro_rad_s for sample in inertial])
    accel = np.array([sample.accel_m_s2 for sample in inertial])
    gyro_std, accel_std = float(gyro.std(axis=0).max()), float(accel.std(axis=0).max())
    if gyro_std > _MAX_GYRO_STD_DEG_S or accel_std > _MAX_ACCEL_STD_M_S2:
        what = f"it moved: {gyro_std:.1f} deg/s and {accel_std:.2f} m/s^2 rms"
        add("warning", f"{what}; what is said about rest means nothing", "stand still and try again")
        return
    rate, force = gyro.mean(axis=0), accel.mean(axis=0)
    norm = float(np.linalg.norm(force))
    if abs(norm - _GRAVITY_M_S2) > _GRAVITY_TOLERANCE_M_S2:
        in_g = abs(norm - 1.0) < 0.1
        next_step = "it seems to be in g: the driver must give m/s^2" if in_g else "vislam calibrate imu"
        add("warning", f"gravity is measured as {norm:.2f} m/s^2", next_step)
    else:
        add("ok", f"gravity is measured as {norm:.2f} m/s^2, along {np.round(force, 1).tolist()}")
    axes = " ".join(f"{value:.2f}" for value in rate)
    if abs(rate).max() > max_rate_deg_s:
        add("warning", f"the gyro's zero is at {axes} deg/s, {max_rate_deg_s:g} allowed", "replace the board")
    else:
        add("ok", f"the gyro's zero is at {axes} deg/s, noise {gyro_std:.2f} deg/s rms")


def check_rest(inertial: list[ImuSample], where: str, max_rate_deg_s: float = MAX_RATE_DEG_S) -> list[Finding]:
    """Return what samples at rest say: gravity, the gyro's zero; nothing of less than 50 samples."""
    findings, add = _adding(where)
    if len(inertial) >= _MIN_SAMPLES:
        _check_rest(inertial, max_rate_deg_s, add)
    return findings


def check_stamps(source: InertialSource, where: str) -> list[Finding]:
    """Return where the stamps of an inertial source come from and, where that is known, how far they can be off."""
    if not source.stamped_by:
        return []
    bound_ms = getattr(source, "stamp_bound_ms", None)
    bound = "" if bound_ms is None else f", known to about {bound_ms:.2f} ms"
    findings, add = _adding(where)
    add("ok", f"stamped by {source.stamped_by}{bound}")
    for kind, stand_in, real in (
        (FifoBoard, "an emulator written from the data sheet", "chip"),
        (OwnImu, "a stand-in for its library", "device"),
    ):
        if isinstance(source, kind):
            what = f"this driver was tested against {stand_in} and has not met a real {real}"
            add("ok", what, "report what you see: docs/sensors.md")
    return findings


def _check_field(board: Gy85 | FifoBoard, magnetic: list[MagSample], add: Add) -> None:
    name = board.magnetometer_name
    if name is None:
        add("warning", "there is no magnetometer", "nothing to do: it is optional")
        return
    if not magnetic:
        add("warning", f"the {name} gives no samples", "keep magnets away; docs/sensors.md")
        return
    if isinstance(board, FifoBoard):
        add("ok", f"the magnetometer is a {name}: check its axes, docs/sensors.md")
    elif name != "HMC5883L":
        add("ok", f"the magnetometer is a {name}, sold as HMC5883L: check its axes, docs/sensors.md")
    norm = float(np.linalg.norm(np.mean([sample.field_ut for sample in magnetic], axis=0)))
    low, high = _FIELD_UT
    if low <= norm <= high:
        add("ok", f"the field is {norm:.0f} uT")
    else:
        add("warning", f"the field is {norm:.0f} uT, the earth's is {low:g} to {high:g}", "vislam calibrate mag")
