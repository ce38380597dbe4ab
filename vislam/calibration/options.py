"""The options of every kind of `vislam calibrate`; their comments and docstrings are its --help."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from vislam.config import CalibrationConfig
from vislam.config.ranges import Count, NonNegative, Positive, Range, Share


@dataclass(frozen=True)
class BoardOptions:
    """The calibration board."""

    kind: Literal["charuco", "chessboard"] = "charuco"
    """charuco may be seen in part, up to the corners of the image; a chessboard only whole"""
    columns: Count = 9
    """Squares along the longer side"""
    rows: Count = 6
    """Squares along the shorter side"""
    square_mm: Positive = 30.0
    """Side of a square, as measured on the print"""
    marker_share: Share = 0.75
    """Side of a marker over that of a square"""
    dictionary: str = "5X5_100"
    """Of the markers: OpenCV's DICT_..., such as 4X4_50, 5X5_100, 6X6_250, APRILTAG_36h11"""


@dataclass(frozen=True, kw_only=True)
class ToFolder:
    """What every calibration that writes files is asked for."""

    overwrite: bool = False
    """Replace what an earlier calibration wrote"""
    json: bool = False
    """Print JSON instead of lines"""


@dataclass(frozen=True)
class BoardFile(ToFolder):
    """Options of `vislam calibrate board`."""

    board: Annotated[BoardOptions, tyro.conf.arg(name="")] = field(default_factory=BoardOptions)
    paper: Literal["a4", "a3", "a2", "letter"] | None = None
    """Paper, lying; None: the smallest that holds the board"""
    out: Path = Path("calibration")
    """Folder for board.png, board.pdf and board.json"""


@dataclass(frozen=True)
class CameraOptions(ToFolder):
    """Options of `vislam calibrate camera`."""

    source: Positional[str]
    """Folder of images, video file, recording (its cam0), or webcam:DEVICE for a live one"""
    board: Annotated[BoardOptions, tyro.conf.arg(name="")] = field(default_factory=BoardOptions)
    model: Literal["auto", "radtan", "radtan5", "equidistant", "ucm", "eucm", "ds", "omni"] = "auto"
    """radtan: k1 k2 p1 p2; radtan5: and k3, which Kalibr does not know; equidistant: lenses of over 100 degrees; ucm,
    eucm, ds (double sphere), omni (Mei with radtan): up to 200 degrees and more, not for ROS; auto: what the views
    speak for"""
    skew: bool = False
    """Estimate the skew s of K as well: 0 for nearly every sensor, not so for a film that was scanned aslant"""
    max_images: Count = 300
    """Images, evenly spaced, that are searched for the board"""
    max_views: Count = 40
    """Images that show it and are used, as different as possible"""
    live_s: Positive = 60.0
    """How long a live camera is looked at; move the board slowly, hold it still now and then"""
    out: Path = Path("calibration")
    """Folder for camchain.yaml (Kalibr), camera.yaml (ASL), camera_info.yaml (ROS), camera.png and camera.json"""


@dataclass(frozen=True)
class NoiseOptions(ToFolder):
    """Options of `vislam calibrate noise`."""

    source: Positional[Path]
    """Recording (folder, or csv like imu0/data.csv) of the sensor standing still, an hour or more"""
    out: Path = Path("calibration")
    """Folder for noise.yaml, noise.png and noise.json"""
    driving: Path | None = None
    """Recording of a usual drive: white noise is raised to what its quietest half second shows"""


@dataclass(frozen=True)
class FloorOptions(ToFolder):
    """Options of `vislam calibrate floor`."""

    source: Positional[str]
    """Recording (or sim:WORLD) in which the cart drives 3 m or more over a level floor with texture"""
    distance_m: Positive | None = None
    """How far the cart is from where it began, by tape, at the end of the recording; driven straight"""
    distance_sigma_m: NonNegative = 0.005
    """How well that was measured: 5 mm for a tape between two marks under the cart"""
    height_m: Positive | None = None
    """Height of the lens above the floor, by tape, where no distance was measured"""
    height_sigma_m: NonNegative = 0.003
    """How well that was measured; the middle of a lens is hard to find"""
    begin_s: NonNegative = 0.0
    """Leave out so much of the recording at its beginning"""
    duration_s: Positive | None = None
    """Take so much of it; None: all"""
    out: Path = Path("calibration")
    """Folder for floor.toml, floor.png and floor.json"""


@dataclass(frozen=True)
class ImuOptions(ToFolder):
    """Options of `vislam calibrate imu`."""

    source: Positional[Path]
    """Raw recording (folder, or csv like imu0/data.csv) in which the sensor is held still in twelve poses or more"""
    out: Path = Path("calibration")
    """Folder for imu.yaml, imu.png and imu.json"""
    model: Literal["full", "scale"] = "full"
    """full: scale, axes, bias; scale: axes as they are, for which seven poses do"""
    rest_s: Positive = 2.0
    """A pose counts when it was held so long"""
    gravity_m_s2: Annotated[float, Range(0.1, 100.0)] = 9.81
    """Where it was recorded: 9.780 at the equator to 9.832 at the poles; as machine.gravity_m_s2 of the config"""


@dataclass(frozen=True)
class CameraImuOptions(ToFolder):
    """Options of `vislam calibrate camera-imu`."""

    source: Positional[str]
    """Recording as for `vislam run`: camera and IMU turn briskly to and fro about all axes before a textured scene"""
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    max_s: Positive = 120.0
    """Seconds from the beginning that are used"""
    out: Path = Path("calibration")
    """Folder for camera-imu.yaml (Kalibr's camchain), camera-imu.png and camera-imu.json"""


@dataclass(frozen=True)
class MagOptions(ToFolder):
    """Options of `vislam calibrate mag`."""

    source: Positional[Path]
    """Raw recording with mag0 and imu0 in which the cart turns once on the spot, slowly, or is turned by hand"""
    mode: Literal["auto", "2d", "3d"] = "auto"
    """2d: on the floor, level part only; 3d: by hand, to all sides; auto: by how far it was tilted"""
    imu: Path | None = None
    """imu.yaml of `vislam calibrate imu`, for gravity and turns; None: the recording's own"""
    out: Path = Path("calibration")
    """Folder for mag.yaml, mag.png and mag.json"""


@dataclass(frozen=True)
class RgbdOptions(ToFolder):
    """Options of `vislam calibrate rgbd`."""

    source: Positional[str]
    """Recording with depth, as for `vislam run`: turned to all sides, before things that stand one behind the other"""
    out: Path = Path("calibration")
    """Folder for sensor.yaml (ASL, with our keys of depth), rgbd.png and rgbd.json"""


@dataclass(frozen=True)
class SelfOptions(ToFolder):
    """Options of `vislam calibrate self`."""

    source: Positional[str]
    """Recording as for `vislam run`: 60 s of a camera waved about before a textured scene, turned to all sides"""
    fov_deg: Annotated[float, Range(20.0, 200.0)] = 65.0
    """Horizontal field of view, roughly: focal lengths from 0.6 to 1.6 times what it gives are tried"""
    model: Literal["auto", "radtan", "radtan5", "equidistant"] = "auto"
    """radtan5: k1 k2 p1 p2 k3; radtan: without k3, which Kalibr does not know; equidistant: lenses of over 100 degrees;
    auto: radtan5 or equidistant by the field of view"""
    max_s: Positive = 120.0
    """Seconds from the beginning that are used"""
    max_stretches: Count = 20
    """Stretches of some 20 keyframes, spread over the recording; more cost time and memory"""
    out: Path = Path("calibration")
    """Folder for camchain.yaml (Kalibr), self.png and self.json"""


@dataclass(frozen=True)
class SensorsOptions(ToFolder):
    """Options of `vislam calibrate sensors`."""

    run: Positional[Path]
    """Finished run with further sensors (--sensors.file): a drive with turns both ways, loops or fixes"""
    out: Path = Path("calibration")
    """Folder for sensors.toml and sensors.json"""
