"""`vislam doctor`: what is wrong with a recording, or with the sensors of this machine."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse, take_path
from vislam.cli.verbs.brief import Brief
from vislam.cli.verbs.terminal import number, print_table, progress_bar
from vislam.config import SensorsConfig, load_sensors
from vislam.config.ranges import Range
from vislam.core.errors import DataError, HardwareError, UsageError, printable

if TYPE_CHECKING:
    from vislam.core.findings import Finding
    from vislam.datasets.inspect import Inspection
    from vislam.hw.doctor import HardwareReport


@dataclass(frozen=True)
class DoctorOptions:
    """Options of `vislam doctor`."""

    source: Positional[str] = ""
    """Recording to examine, as for `run`; without one, the sensors of this machine are examined"""
    i2c: str | None = None
    """A GY-85 or another known board must be on this bus, such as /dev/i2c-1; without, every bus is looked at"""
    imu: str | None = None
    """This IMU must give samples, as `vislam live` names it: board, lsm6dsox:/dev/i2c-1, realsense ..."""
    serial: str | None = None
    """A serial bridge must be on this port, such as /dev/ttyUSB0; ports that are not named are not opened"""
    camera: str | None = None
    """This camera must give images: its index or device file, picam, realsense, oak"""
    masks: str | None = None
    """Folder of masks to examine with the recording, as --frontend.masks of `run`"""
    seconds: Annotated[float, Range(0.5, 60.0)] = 3.0
    """How long each is measured; stand still"""
    sensors: Annotated[SensorsConfig, tyro.conf.arg(name="")] = field(default_factory=SensorsConfig)
    json: bool = False
    """Print JSON instead of lines"""


OPTIONS = (DoctorOptions,)
TAKEN = {"--config FILE": "TOML file of sensors, as for record; options go before it"}
BRIEF = Brief(
    "[SOURCE] [options]",
    (
        "vislam doctor euroc:PATH",
        "vislam doctor",
        "vislam doctor --i2c /dev/i2c-1 --camera 0",
        "vislam doctor --serial /dev/ttyUSB0",
    ),
    ("gy85.bus", "board.bus", "board.chip", "serial.baud", "webcam.device", "webcam.width_px"),
    TAKEN,
)


def main(arguments: list[str]) -> int:
    """Examine a recording, or without one the sensors of this machine."""
    default = DoctorOptions(sensors=load_sensors(take_path(arguments, "--config")))
    options = parse(DoctorOptions, arguments, "doctor", default, BRIEF)
    return _examine_recording(options) if options.source else _examine_hardware(options)


def _examine_recording(options: DoctorOptions) -> int:
    if options.i2c or options.serial or options.camera or options.imu:
        raise UsageError(f"doctor examines {options.source} or the sensors of this machine, not both; leave one out")
    from vislam.datasets.inspect import inspect

    with progress_bar("examined", "images") as bar:
        inspection = inspect(options.source, bar)
    if options.masks is not None:
        inspection = replace(inspection, findings=(*inspection.findings, *_masks(options.source, options.masks)))
    if options.json:
        fields = asdict(inspection)
        if not inspection.topics:
            del fields["topics"]  # only bags have any
        print(json.dumps(fields))
    else:
        _print_inspection(inspection)
    return DataError.exit_code if inspection.worst == "error" else 0


def _masks(source: str, folder: str) -> list[Finding]:
    from vislam.core.findings import Finding
    from vislam.frontend.masks import Masks
    from vislam.runs.sources import open_source

    try:
        masks = Masks(folder, open_source(source).rig)
    except DataError as error:
        return [Finding("error", str(error), folder)]
    masks.examine()
    found = [Finding("warning", f"{count} {kind}", folder) for kind, count in masks.problems.items()]
    return found or [Finding("ok", "masks fit the images", folder)]


def _examine_hardware(options: DoctorOptions) -> int:
    from vislam.hw.doctor import Wanted, examine

    wanted = Wanted(options.i2c, options.serial, options.camera, options.imu)
    report = examine(wanted, options.seconds, sensors=options.sensors)
    if options.json:
        print(json.dumps(asdict(report)))
    else:
        _print_hardware(report)
    return HardwareError.exit_code if report.worst == "error" else 0


def _print_hardware(report: HardwareReport) -> None:
    found = [(device.kind, device.path, device.name) for device in report.devices]
    if found:
        columns = ("what", "where", "name")
        print_table(columns, found, "found", words=columns)
    measured = [
        (t.name, str(t.count), number(t.rate_hz, 1), number(t.jitter_ms, 2), number(t.longest_gap_ms, 1))
        for t in report.timings
    ]
    if measured:
        print_table(("stream", "samples", "rate [Hz]", "jitter [ms]", "longest gap [ms]"), measured, "measured")
    _print_findings(report.findings)


def _print_inspection(inspection: Inspection) -> None:
    size = f"{inspection.duration_s:.1f} s, {inspection.size_bytes / 1e6:.1f} MB"
    Console().print(f"{printable(inspection.source)}: {inspection.format}, {size}", soft_wrap=True)
    topics = [
        (t.name, t.type.replace("/msg/", "/"), str(t.count), number(t.rate_hz, 1).replace("nan", ""), t.taken_for)
        for t in inspection.topics
    ]
    if topics:
        words = ("topic", "type", "taken for")
        print_table(("topic", "type", "count", "rate [Hz]", "taken for"), topics, "topics", words=words)
    rows = [(s.name, str(s.count), f"{s.rate_hz:.1f}", f"{s.longest_gap_s:.3f}") for s in inspection.streams]
    print_table(("stream", "count", "rate [Hz]", "longest gap [s]"), rows)
    _print_findings(inspection.findings)


def _print_findings(findings: Sequence[Finding]) -> None:
    console = Console()
    styles = {"ok": "green", "warning": "yellow", "error": "red"}
    for finding in findings:
        console.print(f"{finding.severity:<8}", style=styles[finding.severity], end="")
        console.print(printable(f"{finding.what} ({finding.where})"), soft_wrap=True, highlight=False, markup=False)
        if finding.next_step:
            console.print(printable(f"        -> {finding.next_step}"), soft_wrap=True, highlight=False, markup=False)
