"""The verbs of the command line: a module each, with its options, what it does and what it prints.

`vislam NAME ...` calls `main` of `vislam.cli.verbs.NAME` with the arguments after the name; it returns the exit code.
What takes long to import is imported after the arguments are understood, so that --help and complaints come at once.
"""

from collections.abc import Callable
from dataclasses import dataclass

from vislam.core.kinds import Kinds, lacking

__all__ = ["VERBS", "Verb"]


@dataclass(frozen=True, slots=True)
class Verb:
    """What --help shows of a verb."""

    summary: str
    example: str
    compiles: tuple[str, ...] = ()  # jobs of `precompile` that are done first where they never were
    # of a verb that a package brings: takes the arguments and returns the exit code
    main: Callable[[list[str]], int] | None = None


_DEMO = ("motion", "cart")
_RUNS = (*_DEMO, "one camera")
_VERBS = {
    "demo": Verb("simulate a cart in a workshop and run everything on it", "vislam demo", _DEMO),
    "run": Verb(
        "run the pipeline on a recording; --resume RUN goes on with one", "vislam run tum:PATH --out runs/desk", _RUNS
    ),
    "simulate": Verb(
        "record a simulated world, or with --graph make a pose graph",
        "vislam simulate corridor-loop --out recordings/corridor",
    ),
    "eval": Verb("compare a trajectory with the truth", "vislam eval runs/desk"),
    "compare": Verb("compare estimators by a plan", "vislam compare experiments/ekf_vs_graph.toml"),
    "doctor": Verb(
        "say what is wrong with a recording, or with the sensors of this machine",
        "vislam doctor euroc:PATH; vislam doctor --i2c /dev/i2c-1 --camera 0",
    ),
    "optimize": Verb("estimate a run again in batch, or join several", "vislam optimize runs/desk"),
    "posegraph": Verb("optimise a pose graph from a file", "vislam posegraph FILE.g2o --out results/graph"),
    "map": Verb(
        "make the maps of a run again, or say what an OctoMap file holds",
        "vislam map runs/desk --resolution-m 0.02 --products cloud octomap mesh",
    ),
    "loops": Verb("list the loop edges of a run, or undo some", "vislam loops runs/desk --undo 7"),
    "vocabulary": Verb(
        "train the words of loop closing on images, or convert ORB-SLAM's",
        "vislam vocabulary images/ tum:PATH --out words.npz",
    ),
    "calibrate": Verb(
        "find what camera, IMU, magnetometer and floor are like; each WHAT has its --help",
        "vislam calibrate noise recordings/still --out calibration",
    ),
    "record": Verb(
        "record the cart's IMU and camera", "vislam record --out recordings/ride --imu serial:/dev/ttyUSB0 --camera 0"
    ),
    "live": Verb(
        "run the pipeline on live sensors and publish the pose; --resume RUN goes on with a run",
        "vislam live --source virtual-cart --out runs/cart",
        (*_RUNS, "live"),
    ),
    "drive": Verb(
        "drive the virtual cart to goals, on the published pose and the map as it grows",
        "vislam drive --goal 2 0 90 --goal 0.5 0.2 180 --out runs/hall",
        (*_DEMO, "live"),
    ),
    "report": Verb("write report.html of a run again", "vislam report runs/desk"),
    "export": Verb(
        "write the results of a run for ROS 2, Foxglove, COLMAP, nerfstudio and splats",
        "vislam export runs/desk --colmap desk",
    ),
    "completion": Verb("print what makes bash or zsh complete all this", "vislam completion bash >> ~/.bashrc"),
}

VERBS = Kinds[Verb]("vislam.verbs", _VERBS, lacking("summary", "example", "main"))
