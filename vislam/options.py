"""The options of every verb of the command line; their comments and docstrings are its --help."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from vislam.config import (
    BatchConfig,
    Config,
    GraphWorldConfig,
    LoopTruthConfig,
    MapConfig,
    PoseGraphConfig,
    RecordConfig,
    SensorsConfig,
)


@dataclass(frozen=True)
class RunOptions:
    """Options of `vislam run`."""

    source: Positional[str]
    """euroc:PATH, tum:PATH, kitti:PATH, video:PATH, sim:WORLD[,option=value], points:WORLD or
    points:PATH[,option=value], or a path, recognised by its contents"""
    out: Path
    """Folder to make for everything that the run leaves"""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    overwrite: bool = False
    """Replace the run that the folder holds"""
    map: Path | None = None
    """Session (RUN/session.db or RUN) of an earlier run in whose map this one begins; it is not written"""
    localize_only: bool = False
    """With --map: find the way in it, and leave its keyframes and clouds as they are"""
    dry_run: bool = False
    """Only print the resolved configuration as JSON"""
    json: bool = False
    """Print the metrics as JSON instead of the table"""


@dataclass(frozen=True)
class ResumeOptions:
    """Options of `vislam run --resume RUN`; source and settings are those that the run began with."""

    json: bool = False
    """Print the metrics as JSON instead of the table"""


@dataclass(frozen=True)
class DemoOptions:
    """Options of `vislam demo`."""

    out: Path = Path("demo")
    """Folder for the run; a run that it holds is replaced"""
    world: str = "workshop-cart"
    """Simulated world"""
    seed: int = 0
    """Of the world and of the pipeline"""


@dataclass(frozen=True)
class SimulateOptions:
    """Options of `vislam simulate`."""

    world: Positional[str]
    """Name of a simulated world; a wrong one lists them"""
    out: Path
    """Folder to make for the recording (ASL layout, with truth)"""
    rig: Literal["rgbd", "stereo", "mono"] | None = None
    """Cameras; None: what the world has"""
    duration_s: float | None = None
    """Only the first so many seconds"""
    camera_hz: float | None = None
    """Frames per second; None: what the world has"""
    image_width_px: int = 640
    """Width of the 4:3 images"""
    exposure_s: float | None = None
    """Motion blur of this exposure; 0: none, None: what the world has"""
    readout_s: float = 0.0
    """Rolling shutter: time from the first to the last row"""
    workers: int = 2
    """Threads that render; they change nothing but the time"""
    seed: int = 0
    """Of motion and sensors; same seed, same bytes"""
    world_seed: int = 0
    """Of the place: its textures, and where things stand"""


@dataclass(frozen=True)
class SimulateGraphOptions:
    """Options of `vislam simulate --graph SHAPE`: a pose graph with known truth, for `vislam optimize`."""

    graph: Literal["grid3d", "torus", "sphere", "manhattan"]
    """Shape of the path: in space, manhattan in the plane; steps of 1 m"""
    out: Path
    """g2o file to write; it starts from odometry"""
    settings: Annotated[GraphWorldConfig, tyro.conf.arg(name="")] = field(default_factory=GraphWorldConfig)
    truth: Path | None = None
    """Write the true poses here (TUM; the id as seconds)"""
    outliers: Path | None = None
    """Write which loops are false here (CSV: from_id, to_id)"""


@dataclass(frozen=True)
class EvalOptions:
    """Options of `vislam eval`."""

    estimate: Positional[Path]
    """A trajectory file (TUM, EuRoC csv) or a run folder"""
    reference: Path | None = None
    """True trajectory; a run folder brings its own"""
    align: Literal["se3", "sim3", "yaw", "first", "none"] = "se3"
    """How the estimate is moved onto the reference before errors are taken"""
    association: Literal["interpolate", "nearest"] = "interpolate"
    """Interpolate the reference at the estimate's times, or take the nearest pose within 10 ms"""
    min_coverage: float = 0.8
    """Below this share of the reference's time the evaluation fails with exit code 4"""
    loops: bool = False
    """Judge the loops of a run folder instead of its trajectories; writes loops_eval.json into it"""
    truth: LoopTruthConfig = field(default_factory=LoopTruthConfig)
    json: bool = False
    """Print JSON instead of the table"""


@dataclass(frozen=True)
class CompareOptions:
    """Options of `vislam compare`."""

    plan: Positional[Path]
    """TOML file that says what to compare on what; docs/experiments.md"""
    out: Path | None = None
    """Folder for report, tables and manifest; None: results/NAME of the plan"""
    workers: int = 2
    """Jobs at the same time on this machine; 1 for undisturbed timings"""
    engine: Literal["local", "dask"] = "local"
    """Processes of this machine, or the workers of a Dask cluster"""
    scheduler: str | None = None
    """Address of the Dask scheduler"""
    store: Path = Path("results/results.db")
    """Keeps every result by the hash of all it depends on; nothing in it runs again"""
    cache: Path = Path("results/recordings")
    """Keeps the recordings of simulated worlds"""
    keep_runs: Path | None = None
    """Keep the run folder of every job in here"""
    retry_failed: bool = False
    """Run the jobs again that failed before"""
    verify: Path | None = None
    """Run jobs of this comparison (folder or manifest) again: do the numbers come out? Exit code 4 if not"""
    sample: int = 3
    """How many jobs --verify runs; 0: all"""
    dry_run: bool = False
    """Only list the jobs and which of them are done"""
    json: bool = False
    """Print JSON instead of lines"""


@dataclass(frozen=True)
class DoctorOptions:
    """Options of `vislam doctor`."""

    source: Positional[str] = ""
    """Recording to examine, as for `run`; without one, the sensors of this machine are examined"""
    i2c: str | None = None
    """A GY-85 must be on this bus, such as /dev/i2c-1; without, every bus is looked at"""
    serial: str | None = None
    """A serial bridge must be on this port, such as /dev/ttyUSB0; ports that nobody names are not opened"""
    camera: str | None = None
    """This camera must give images: its index or device file"""
    seconds: float = 3.0
    """How long each is measured; stand still"""
    json: bool = False
    """Print JSON instead of lines"""


@dataclass(frozen=True)
class OptimizeOptions:
    """Options of `vislam optimize RUN`; a pose-graph FILE and several RUNs have their own."""

    run: Positional[Path]
    """Run folder, whether its run came to the end or not; give several, or a pose-graph file, before --help for their
    options"""
    settings: Annotated[BatchConfig, tyro.conf.arg(name="")] = field(default_factory=BatchConfig)
    out_name: str = "batch"
    """Names the files: trajectory_NAME.tum, states_NAME.csv"""
    json: bool = False
    """Print the entry of metrics.json instead of the summary"""


@dataclass(frozen=True)
class OptimizeGraphOptions:
    """Options of `vislam optimize FILE`: a pose graph in g2o, TORO or iSAM format."""

    file: Positional[Path]
    """Pose graph; what is no format's ending .g2o, .toro or .isam is told by its contents"""
    settings: Annotated[PoseGraphConfig, tyro.conf.arg(name="")] = field(default_factory=PoseGraphConfig)
    out: Path | None = None
    """Folder for optimized.g2o, trajectory.tum, trajectory_kitti.txt, poses.csv, edges.csv, summary.json and
    report.html; None: NAME_optimized in the working folder"""
    report: bool = True
    """Write report.html, with pictures of before and after"""
    json: bool = False
    """Print summary.json instead of the summary"""


@dataclass(frozen=True)
class JoinOptions:
    """Options of `vislam optimize RUN RUN [...]`: sessions joined into one pose graph by loops between them."""

    out: Path
    """Folder for trajectory_NAME.tum of each session, joined.g2o, loops.csv, summary.json and report.html"""
    sessions: Positional[tuple[Path, ...]] = ()
    """Run folders or session.db files, two or more, which are only read; the map is that of the first"""
    report: bool = True
    """Write report.html, with pictures of before and after"""
    json: bool = False
    """Print summary.json instead of the summary"""


@dataclass(frozen=True)
class MapOptions:
    """Options of `vislam map`."""

    source: Positional[Path]
    """Run folder, to make its maps again with these settings; or OctoMap file (.bt, .ot), to ask it"""
    settings: Annotated[MapConfig, tyro.conf.arg(name="")] = field(default_factory=MapConfig)
    out: Path | None = None
    """Folder for the maps of a run; None: in the place of those it has"""
    poses: str = "graph"
    """Where the keyframes of a run are: graph, or the NAME of a trajectory_NAME.tum in it, such as batch"""
    info: bool = False
    """Say how large the map is and what it holds; done too when nothing else is asked"""
    query: tuple[float, float, float] | None = None
    """Say what is at X Y Z (metres, map frame): occupied, free or unknown, and what is nearest"""
    level: int = 0
    """Query cubes of 2**level voxels"""
    window_m: float = 5.0
    """Look so far for the nearest obstacle and frontier"""
    json: bool = False
    """Print JSON instead of lines"""


@dataclass(frozen=True)
class LoopsOptions:
    """Options of `vislam loops`."""

    run: Positional[Path]
    """Run folder"""
    undo: tyro.conf.UseAppendAction[tuple[int, ...]] = ()
    """Id of an edge to optimise the run again without; may be given several times"""
    redo: tyro.conf.UseAppendAction[tuple[int, ...]] = ()
    """Id of an edge that was undone and is to come back; may be given several times"""
    json: bool = False
    """Print JSON instead of lines"""


@dataclass(frozen=True)
class VocabularyOptions:
    """Options of `vislam vocabulary`."""

    out: Path
    """File to write, for --loop.vocabulary"""
    sources: Positional[tuple[str, ...]] = ()
    """Folders of PNG or JPEG images, and recordings as for `run`"""
    from_orbslam: Path | None = None
    """Convert this text vocabulary of ORB-SLAM instead of training one"""
    every: int = 1
    """Use every n-th image"""
    features: int = 1000
    """ORB descriptors per image"""
    branching: int = 10
    """Children of a node"""
    depth: int | None = None
    """Levels; None: as many as leave each word some descriptors"""
    max_descriptors: int = 1_000_000
    """That the tree grows on, taken evenly"""
    seed: int = 0
    """Same seed, same bytes"""


@dataclass(frozen=True)
class RecordOptions:
    """Options of `vislam record`."""

    out: Path
    """Folder to make for the recording (ASL layout)"""
    imu: str = "gy85"
    """gy85[:/dev/i2c-1], serial[:/dev/ttyUSB0] (without a path as the settings say), or none"""
    camera: str = "webcam"
    """Index, /dev/v4l/by-id/..., webcam (as --webcam.device says), a video file in place of a camera, or none"""
    seconds: float | None = None
    """How long; None: until Ctrl-C"""
    settings: Annotated[RecordConfig, tyro.conf.arg(name="")] = field(default_factory=RecordConfig)
    sensors: Annotated[SensorsConfig, tyro.conf.arg(name="")] = field(default_factory=SensorsConfig)
    full_speed: bool = False
    """Read a video as fast as it can be written, not in its own time"""
    json: bool = False
    """Print JSON instead of lines"""


def record_options(base: SensorsConfig) -> RecordOptions:
    """Return the options of `vislam record` to parse into, with `base` for every setting that is not given."""
    return RecordOptions(out=tyro.MISSING, sensors=base)


@dataclass(frozen=True)
class LiveOptions:
    """Options of `vislam live`."""

    out: Path
    """Folder to make for everything that the run leaves"""
    source: str = "virtual-cart"
    """virtual-cart[,option=value], replay:SOURCE, or IMU and camera: gy85+webcam, serial:PORT+webcam"""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    seconds: float | None = None
    """How long; None: until Ctrl-C, or the end of a replay"""
    overwrite: bool = False
    """Replace the run that the folder holds"""
    json: bool = False
    """Print the metrics as JSON instead of the table"""


def live_options(base: Config, sensors: SensorsConfig) -> LiveOptions:
    """Return the options of `vislam live` to parse into, with given values for every setting that is not given."""
    return LiveOptions(out=tyro.MISSING, settings=base, sensors=sensors)


@dataclass(frozen=True)
class ReportOptions:
    """Options of `vislam report`."""

    run: Positional[Path]
    """Run folder"""


def map_options(base: MapConfig) -> MapOptions:
    """Return the options of `vislam map` to parse into, with `base` for every setting that is not given."""
    return MapOptions(source=tyro.MISSING, settings=base)


def run_options(base: Config) -> RunOptions:
    """Return the options of `vislam run` to parse into, with `base` for every setting that is not given."""
    return RunOptions(source=tyro.MISSING, out=tyro.MISSING, settings=base)
