"""`vislam record`: the cart's IMU and camera into a recording."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from vislam.cli.verbs.arguments import parse, take_path
from vislam.cli.verbs.brief import Brief
from vislam.cli.verbs.terminal import rewritten_line
from vislam.config import RecordConfig, SensorsConfig, load_cart
from vislam.config.ranges import Positive


@dataclass(frozen=True)
class RecordOptions:
    """Options of `vislam record`."""

    out: Path
    """Folder to make for the recording (ASL layout)"""
    imu: str = "gy85"
    """gy85[:/dev/i2c-1], board[:/dev/i2c-1] (whichever chip answers) or a chip's name, serial[:/dev/ttyUSB0] (without
    a path as in the settings), realsense or oak (the one inside the camera of that name), or none"""
    camera: str = "webcam"
    """Index, /dev/v4l/by-id/..., webcam (that of --webcam.device), picam[:0] (the Raspberry Pi's own),
    realsense or oak with :SERIAL, then ,depth behind it as wanted (stereo, or colour and depth), a video file in place
    of a camera, or none"""
    seconds: Positive | None = None
    """How long; None: until Ctrl-C"""
    settings: Annotated[RecordConfig, tyro.conf.arg(name="")] = field(default_factory=RecordConfig)
    sensors: Annotated[SensorsConfig, tyro.conf.arg(name="")] = field(default_factory=SensorsConfig)
    full_speed: bool = False
    """Read a video as fast as it can be written, not in its own time"""
    json: bool = False
    """Print JSON instead of lines"""


OPTIONS = (RecordOptions,)
TAKEN = {"--config FILE": "TOML file of sensors, with tables [sensors.NAME] of further ones; options go before it"}
BRIEF = Brief(
    "--out RECORDING [options]",
    (
        "vislam record --out recordings/ride",
        "vislam record --out recordings/ride --imu serial:/dev/ttyUSB0 --camera 0",
        "vislam record --out recordings/ride --imu realsense --camera realsense,depth",
        "vislam record --out recordings/still --camera none --seconds 3600",
    ),
    (
        "gy85.bus", "gy85.rate_hz", "board.bus", "board.chip", "board.rate_hz", "serial.port", "serial.baud",
        "webcam.device", "webcam.width_px", "webcam.exposure_s",
        "calibration.camera", "calibration.imu",
    ),
    TAKEN,
)  # fmt: skip


def main(arguments: list[str]) -> int:
    """Record until the time is over or a signal comes."""
    sensors, further = load_cart(take_path(arguments, "--config"))
    options = parse(RecordOptions, arguments, "record", RecordOptions(out=tyro.MISSING, sensors=sensors), BRIEF)
    from vislam.runs.record import record
    from vislam.runs.recorded_readings import further_ports

    ports = None if further.file is None else further_ports(Path(further.file))
    with rewritten_line() as show:
        recorded = record(
            options.out, options.imu, options.camera, options.sensors, options.settings, options.seconds,
            not options.full_speed, progress=lambda recorded: show(recorded.line()), further=ports,
        )  # fmt: skip
    if options.json:
        print((options.out / "recording.json").read_text(encoding="utf-8"), end="")
        return 0
    print(recorded.line())
    for note in (*recorded.notes, recorded.ended):
        print(note)
    print(f"next: vislam doctor {options.out}")
    return 0
