"""Which sensors this machine has, what is wrong with them and what to do: `vislam doctor` without a recording."""

import os
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from vislam.config import SensorsConfig
from vislam.core.errors import HardwareError, install_line
from vislam.core.findings import Finding, Severity, worst
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.hw.board_check import MAX_RATE_DEG_S, check_board, check_rest, check_stamps
from vislam.hw.bridge.bridge import SerialBridge
from vislam.hw.cameras.library_camera import LibraryCamera
from vislam.hw.cameras.webcam import Capture, Webcam
from vislam.hw.chips import IMU_NAMES, I2cBus, identify, kernel_driver, unbind_command, use_clone
from vislam.hw.fifo_board import FifoBoard
from vislam.hw.gy85 import Gy85
from vislam.hw.imu_source import InertialSource
from vislam.hw.library_cameras import (
    WITH_IMU,
    gives_frames,
    is_library_camera,
    open_frame_camera,
    open_image_camera,
    open_with_imu,
    reads_own_imu,
)
from vislam.hw.link import BUS_TIMEOUT_S
from vislam.hw.sensors import open_inertial
from vislam.hw.source import CapturedImage
from vislam.hw.timing import Clock, HostClock

_NS = 1_000_000_000
_MIN_BUS_HZ = 350_000.0  # a bus of 400 kHz, its clock stretched
_SLOW_SHARE = 0.98  # of the rate that was asked for
_NO_BUS = "on a Raspberry Pi: sudo raspi-config nonint do_i2c 0; elsewhere plug in a USB adapter, or a serial bridge"
_MAX_JITTER_MS = 1.0  # of stamps; at 0.5 rad/s and 1 m/s it is worth 0.03 deg and 1 mm

Sample = TypeVar("Sample", ImuSample, MagSample, CapturedImage | Frame)
_AnyCamera = LibraryCamera[CapturedImage] | LibraryCamera[Frame]


@dataclass(frozen=True, slots=True)
class Device:
    """Something that was found: a bus, a port, a camera, a chip."""

    kind: str
    path: str
    name: str


@dataclass(frozen=True, slots=True)
class Timing:
    """How regularly samples came."""

    name: str
    count: int
    rate_hz: float | None = None  # None with fewer than two samples
    jitter_ms: float | None = None  # deviation of the steps between stamps
    longest_gap_ms: float | None = None


@dataclass(frozen=True, slots=True)
class Wanted:
    """What must be there; None: whatever is there is looked at."""

    i2c: str | None = None
    serial: str | None = None
    camera: str | None = None
    imu: str | None = None  # as a command line names it


@dataclass(frozen=True, slots=True)
class HardwareReport:
    """What was found."""

    devices: tuple[Device, ...]
    timings: tuple[Timing, ...]
    findings: tuple[Finding, ...]

    @property
    def worst(self) -> Severity:
        """The worst severity among the findings; error means that something asked for is missing or unfit."""
        return worst(self.findings)


@dataclass(slots=True)
class _Notes:
    """What piles up during an examination."""

    devices: list[Device] = field(default_factory=list)
    timings: list[Timing] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def add(self, severity: Severity, what: str, where: str, next_step: str = "") -> None:
        self.findings.append(Finding(severity, what, where, next_step))

    def failed(self, error: HardwareError, where: str, severity: Severity) -> None:
        what, _, next_step = str(error).partition("; ")
        self.add(severity, what, where, next_step)


def examine(
    wanted: Wanted,
    seconds: float,
    clock: Clock | None = None,
    root: Path = Path("/"),
    open_capture: Callable[[str], Capture] | None = None,
    sensors: SensorsConfig | None = None,
) -> HardwareReport:
    """Look for buses, chips, ports and cameras, and measure what answers for so long each.

    Only reads: chips at known addresses are asked for their ids and set up if they are what they should be; serial
    ports, cameras and an IMU are opened when they are asked for by name. `root` is where /dev and /sys are;
    `sensors` are the settings of all, but for the bus, port and device that are looked at.
    """
    sensors = SensorsConfig() if sensors is None else sensors
    clock = HostClock() if clock is None else clock
    notes = _Notes()
    camera = wanted.camera
    if wanted.imu is not None and wanted.imu.partition(":")[0] in WITH_IMU:
        camera = wanted.imu if camera is None else camera
        reads_own_imu(wanted.imu, camera)
        _examine_both(notes, wanted.imu, camera, seconds, clock, sensors)
        camera = None
    elif wanted.imu is not None:
        _examine_imu(notes, wanted.imu, partial(open_inertial, wanted.imu, sensors), seconds, clock)
    else:
        _examine_buses(notes, wanted.i2c, seconds, clock, root, sensors)
    _examine_ports(notes, wanted.serial, seconds, clock, root, sensors)
    _examine_cameras(notes, camera, seconds, clock, root, open_capture, sensors)
    return HardwareReport(tuple(notes.devices), tuple(notes.timings), tuple(notes.findings))


# ---- I2C ----------------------------------------------------------------------------------------------------------


def _examine_buses(
    notes: _Notes, wanted: str | None, seconds: float, clock: Clock, root: Path, sensors: SensorsConfig
) -> None:
    paths = sorted(str(path) for path in (root / "dev").glob("i2c-*")) if wanted is None else [wanted]
    if not paths:
        has_adapter = any((root / "sys/bus/i2c/devices").glob("i2c-*"))
        notes.add(
            "warning",
            "there are I2C adapters, but no device files of them" if has_adapter else "there is no I2C bus",
            "/dev/i2c-*",
            "sudo modprobe i2c-dev" if has_adapter else _NO_BUS,
        )
    severity: Severity = "warning" if wanted is None else "error"
    for path in paths:
        try:
            with closing(I2cBus(path, BUS_TIMEOUT_S)) as bus:
                make = _examine_chips(notes, bus, clock, root, severity, sensors)
        except HardwareError as error:
            notes.failed(error, path, severity)
            continue
        if make is not None:
            _examine_imu(notes, path, make, seconds, clock, severity)


def _examine_chips(
    notes: _Notes, bus: I2cBus, clock: Clock, root: Path, severity: Severity, sensors: SensorsConfig
) -> Callable[[], Gy85 | FifoBoard] | None:
    """Note the chips of a bus; return what opens the board that they make up, if they are free."""
    notes.devices.append(Device("bus", bus.path, "I2C" if bus.is_combined else "SMBus only"))
    found: dict[str, int] = {}
    for chip in identify(bus):
        notes.devices.append(Device("chip", f"{bus.path} 0x{chip.address:02x}", chip.name))
        driver = kernel_driver(bus.path, chip.address, root / "sys")
        where = f"{bus.path} 0x{chip.address:02x}"
        if driver is not None:
            what = f"the kernel's driver {driver} owns the {chip.name}"
            release = unbind_command(bus.path, chip.address, driver)
            other = "; or leave it and ask for the IMU iio" if chip.name in IMU_NAMES else ""
            notes.add(severity, what, where, release + other)
        elif chip.is_elsewhere:
            next_step = "tie the chip's address pin (SDO or AD0) low, as on a GY-85"
            notes.add(severity, f"the {chip.name} is not at its usual address", where, next_step)
        elif chip.clone:
            notes.add(severity, f"the chip is {chip.name}", where, use_clone(chip.clone, bus.path))
            return None
        else:
            found[chip.name] = chip.address
    imu = next((address for name, address in found.items() if name in IMU_NAMES), None)
    if imu is not None:
        _note_speed(notes, bus, imu, clock)
        return lambda: FifoBoard(replace(sensors.board, bus=bus.path), clock)
    missing = [name for name in ("ITG3205", "ADXL345") if name not in found]
    if missing:
        what = f"no {' and no '.join(missing)} free to use"
        notes.add(severity, what, bus.path, "check power (3.3 V), ground, SDA and SCL; a GY-85 has both")
        return None
    _note_speed(notes, bus, 0x53, clock)
    return lambda: Gy85(replace(sensors.gy85, bus=bus.path), clock)


def _note_speed(notes: _Notes, bus: I2cBus, address: int, clock: Clock) -> None:
    speed_hz = bus.measure_hz(address, 0x00, clock)
    if speed_hz < _MIN_BUS_HZ:
        notes.add(
            "warning",
            f"the bus runs at {speed_hz / 1e3:.0f} kHz, 400 kHz are needed for 400 samples a second",
            bus.path,
            "on a Raspberry Pi: dtparam=i2c_arm_baudrate=400000 in /boot/firmware/config.txt, or ask for 100 Hz",
        )
    else:
        notes.add("ok", f"the bus runs at {min(speed_hz, 1e6) / 1e3:.0f} kHz or more", bus.path)


def _examine_imu(
    notes: _Notes,
    where: str,
    make: Callable[[], InertialSource],
    seconds: float,
    clock: Clock,
    severity: Severity = "error",
) -> None:
    """Open an IMU and measure what comes."""
    try:
        source = make()
    except HardwareError as error:
        notes.failed(error, where, severity)
        return
    with closing(source):
        _look_at_imu(notes, source, where, seconds, clock, severity)


def _examine_both(notes: _Notes, imu: str, camera: str, seconds: float, clock: Clock, sensors: SensorsConfig) -> None:
    """Open a camera with the IMU inside it, once, and measure what each gives."""
    try:
        images, inertial = open_with_imu(camera, sensors)
    except HardwareError as error:
        notes.failed(error, camera, "error")
        return
    with closing(images):
        _look_at_imu(notes, inertial, imu, seconds, clock)
        _look_at_camera(notes, images, seconds, clock)


def _look_at_imu(
    notes: _Notes, source: InertialSource, name: str, seconds: float, clock: Clock, severity: Severity = "error"
) -> None:
    """Measure what an IMU gives, and note what it reports of itself."""
    inertial, magnetic = _listen(source, seconds, clock)
    if isinstance(source, SerialBridge):
        notes.devices.append(Device("chips", name, source.board_name))
    notes.findings += check_stamps(source, name)
    if isinstance(source, Gy85 | FifoBoard):
        notes.findings += check_board(source, inertial, magnetic, name)
    else:
        notes.findings += check_rest(inertial, name, getattr(source, "max_zero_deg_s", MAX_RATE_DEG_S))
        if word := source.health():
            what = f"health: {word.name}; {_counted(source.counters())}"
            notes.add("warning", what, name, "see docs/sensors.md")
    _note_timing(notes, f"{name}: inertial", inertial, source.rate_hz, severity)
    if magnetic:
        notes.timings.append(_timing(f"{name}: magnetic", [sample.t_ns for sample in magnetic]))


def _listen(source: InertialSource, seconds: float, clock: Clock) -> tuple[list[ImuSample], list[MagSample]]:
    inertial: list[ImuSample] = []
    magnetic: list[MagSample] = []
    end_ns = clock.now_ns() + round(seconds * _NS)
    while clock.now_ns() < end_ns:
        for sample in source.read(0.1):
            if isinstance(sample, ImuSample):
                inertial.append(sample)
            else:
                magnetic.append(sample)
    return inertial, magnetic


def _timing(name: str, t_ns: list[int]) -> Timing:
    if len(t_ns) < 2:
        return Timing(name, len(t_ns))
    steps_ms = np.diff(np.array(t_ns, dtype=np.int64)) * 1e-6
    return Timing(name, len(t_ns), 1e3 / float(steps_ms.mean()), float(steps_ms.std()), float(steps_ms.max()))


def _note_timing(notes: _Notes, name: str, samples: list[Sample], asked_hz: float, severity: Severity) -> None:
    """Keep the timing of a stream and say whether it is good enough."""
    timing = _timing(name, [sample.t_ns for sample in samples])
    notes.timings.append(timing)
    if timing.rate_hz is None or timing.jitter_ms is None:
        notes.add(severity, "no samples came", name, "look at the other findings, then replug it")
    elif timing.rate_hz < _SLOW_SHARE * asked_hz:
        what = f"{timing.rate_hz:.1f} samples a second, {asked_hz:g} asked"
        notes.add("warning", what, name, "ask for less, or free the machine; the serial bridge needs no host in time")
    elif timing.jitter_ms > _MAX_JITTER_MS and asked_hz > 100.0:
        what = f"stamps jitter by {timing.jitter_ms:.1f} ms"
        notes.add("warning", what, name, "free the machine, or use the serial bridge")
    else:
        what = f"{timing.rate_hz:.1f} samples a second, jitter {timing.jitter_ms:.2f} ms"
        notes.add("ok", what, name)


# ---- serial ports -------------------------------------------------------------------------------------------------


def _examine_ports(
    notes: _Notes, wanted: str | None, seconds: float, clock: Clock, root: Path, sensors: SensorsConfig
) -> None:
    paths = _files(root, ("ttyUSB*", "ttyACM*", "ttyAMA*"))
    if not paths and wanted is None:
        notes.add("warning", "there is no serial port of a bridge", "/dev/ttyUSB*", "plug it in, if the cart has one")
    for path in paths:
        notes.devices.append(Device("serial port", path, _port_name(path)))
        _check_permission(notes, path, "error" if path == wanted else "warning")
    if wanted is None:
        return
    make = partial(SerialBridge, replace(sensors.serial, port=wanted))
    _examine_imu(notes, wanted, make, seconds, clock)


def _port_name(path: str) -> str:
    try:
        from serial.tools import list_ports
    except ImportError:
        return f"install pyserial for its name: {install_line('hw')}"
    return next((str(port.description) for port in list_ports.comports() if port.device == path), "unknown")


# ---- cameras ------------------------------------------------------------------------------------------------------


def _examine_cameras(
    notes: _Notes,
    wanted: str | None,
    seconds: float,
    clock: Clock,
    root: Path,
    open_capture: Callable[[str], Capture] | None,
    sensors: SensorsConfig,
) -> None:
    paths = _files(root, ("video*",))
    if not paths and wanted is None:
        notes.add("warning", "there is no camera", "/dev/video*", "plug it in; in a container, hand the device in")
    for path in paths:
        try:
            name = (root / "sys/class/video4linux" / Path(path).name / "name").read_text(encoding="utf-8").strip()
        except OSError:
            name = "unknown"
        notes.devices.append(Device("camera", path, name))
        _check_permission(notes, path, "error" if path == wanted else "warning")
    if wanted is None:
        return
    try:
        camera = _opened(wanted, open_capture, sensors)
    except HardwareError as error:
        notes.failed(error, wanted, "error")
        return
    with closing(camera):
        _look_at_camera(notes, camera, seconds, clock)


def _look_at_camera(notes: _Notes, camera: _AnyCamera, seconds: float, clock: Clock) -> None:
    """Measure what a camera gives, and note what it reports of itself."""
    images = list(_captured(camera, seconds, clock))
    _note_timing(notes, f"{camera.path}: images", images, camera.rate_hz, "error")
    for setting in camera.settings:
        if setting.differs:
            got = "does not offer it" if setting.got is None else f"does {setting.got}"
            what = f"{setting.name}: asked {setting.asked}, the camera {got}"
            notes.add("warning", what, camera.path, "ask for what it does, or use another camera")
    if camera.stamped_by == "arrival":
        what = "images carry no time of capture: stamps are those of arrival"
        notes.add("warning", what, camera.path, "let the time offset be estimated, or use another camera")
    elif images:
        notes.add("ok", f"stamped by {camera.stamped_by}", camera.path)
    if isinstance(camera, LibraryCamera) and not isinstance(camera, Webcam):
        what = "this driver was tested against a stand-in for its library and has not met a real camera"
        notes.add("ok", what, camera.path, "report what you see: docs/sensors.md")


def _opened(wanted: str, open_capture: Callable[[str], Capture] | None, sensors: SensorsConfig) -> _AnyCamera:
    if gives_frames(wanted):
        return open_frame_camera(wanted, sensors)
    if is_library_camera(wanted):
        return open_image_camera(wanted, sensors)
    webcam = sensors.webcam if wanted == "webcam" else replace(sensors.webcam, device=wanted)
    return Webcam(webcam, open_capture=open_capture)


def _captured(camera: _AnyCamera, seconds: float, clock: Clock) -> Iterator[CapturedImage | Frame]:
    end_ns = clock.now_ns() + round(seconds * _NS)
    while clock.now_ns() < end_ns:
        image = camera.read(0.1)
        if image is not None:
            yield image


# ---- files --------------------------------------------------------------------------------------------------------


def _files(root: Path, patterns: tuple[str, ...]) -> list[str]:
    return sorted(str(path) for pattern in patterns for path in (root / "dev").glob(pattern))


def _check_permission(notes: _Notes, path: str, severity: Severity) -> None:
    if os.access(path, os.R_OK | os.W_OK):
        return
    try:
        group = Path(path).group()
    except (OSError, KeyError):
        group = "the group that owns it"
    next_step = f"sudo usermod -aG {group} $USER, then log in again"
    notes.add(severity, "you may not open it", path, next_step)


def _counted(counters: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counters.items()) if count) or "nothing counted"
