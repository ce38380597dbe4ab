"""What is in a run folder, read leniently: a file that is absent or damaged becomes a reason, not an error."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.files import leads_out
from vislam.core.messages import Array, NavState, Tracking
from vislam.core.reading import read_json
from vislam.loop import LoopRow, read_loops, read_rows
from vislam.runs.folder import TRACKING_COLUMNS
from vislam.trajectory import Trajectory, read_states_csv, read_tum

T = TypeVar("T")

ESTIMATES = ("ekf", "live", "graph", "batch")
_MAX_LOOP_PICTURES = 24
_MAX_JSON_BYTES = 64 * 2**20


@dataclass(frozen=True, slots=True, eq=False)
class TrackingRows:
    """The columns of tracking.csv, one entry per frame."""

    t_ns: NDArray[np.int64]
    tracking: list[str]
    inliers: Array
    reason: list[str]


@dataclass(slots=True, eq=False)
class RunFiles:
    """Everything the report needs of a run folder."""

    folder: Path
    metrics: dict[str, Any]
    config: dict[str, Any]
    manifest: dict[str, Any]
    truth: Trajectory | None
    estimates: dict[str, Trajectory]
    states: dict[str, list[NavState]]
    loops: list[LoopRow]
    loops_eval: dict[str, Any]
    tracking: TrackingRows | None
    pictures: list[Path]
    loop_pictures: list[Path]
    unread: dict[str, str] = field(default_factory=dict)  # file name: why it could not be used

    @property
    def has_camera(self) -> bool:
        """Whether the run had one."""
        return self.metrics.get("mode") != "none"

    def has(self, name: str) -> bool:
        """Return whether a file is in the folder; a link that leads out of it is none, and stands in `unread`."""
        return _belongs(self.folder / name, self.folder, self.unread)


def read_run(folder: Path) -> RunFiles:
    """Read a run folder. Raises DataError when it is no folder or holds nothing of a run."""
    if not folder.is_dir():
        raise DataError(f"{folder} is not a run folder; `vislam run SOURCE --out {folder}` makes one")
    unread: dict[str, str] = {}

    def attempt(name: str, read: Callable[[Path], T]) -> T | None:
        path = folder / name
        if not _belongs(path, folder, unread):
            return None
        try:
            return read(path)
        except DataError as error:
            unread[name] = str(error)
        except OSError as error:
            unread[name] = f"{path} cannot be read: {error.strerror or error}"
        return None

    found = {name: attempt(f"trajectory_{name}.tum", read_tum) for name in ESTIMATES}
    states = {name: attempt(f"states_{name}.csv", read_states_csv) for name in ("ekf", "graph")}
    loop_pictures, pictures = (
        [path for path in sorted((folder / place).glob(names)) if _belongs(path, folder, unread)]
        for place, names in (("loops", "*.jpg"), ("map", "picture*.png"))
    )
    run = RunFiles(
        folder=folder,
        metrics=attempt("metrics.json", _read_json) or {},
        config=attempt("config.json", _read_json) or {},
        manifest=attempt("manifest.json", _read_json) or {},
        truth=attempt("trajectory_truth.tum", read_tum),
        estimates={name: trajectory for name, trajectory in found.items() if trajectory is not None},
        states={name: pair[1] for name, pair in states.items() if pair is not None},
        loops_eval=attempt("loops_eval.json", _read_json) or {},
        loops=attempt("loops.csv", read_loops) or [],
        tracking=attempt("tracking.csv", _read_tracking),
        loop_pictures=loop_pictures[:_MAX_LOOP_PICTURES],
        pictures=pictures,
        unread=unread,
    )
    if not run.metrics and not run.estimates and not unread:
        raise DataError(f"{folder} holds neither metrics.json nor a trajectory; is it a run folder?")
    return run


def _belongs(path: Path, folder: Path, unread: dict[str, str]) -> bool:
    """Return whether a file is there and lies in the folder: a report is passed on with what it was made of."""
    if not path.is_file():
        return False
    if is_out := leads_out(path, folder):
        unread[str(path.relative_to(folder))] = f"{path} is a link that leads out of the run folder"
    return not is_out


def _read_json(path: Path) -> dict[str, Any]:
    try:
        data = read_json(path, _MAX_JSON_BYTES)
    except ValueError as error:
        raise DataError(f"{path} is not valid JSON: {error}") from error
    if not isinstance(data, dict):
        raise DataError(f"{path} holds a {type(data).__name__} instead of an object")
    return data


def _read_tracking(path: Path) -> TrackingRows | None:
    """Return what vision made of the frames; None where there was no camera."""
    rows = read_rows(path, TRACKING_COLUMNS)
    try:
        t_ns = np.array([int(row["t_ns"]) for _, row in rows], dtype=np.int64)
        inliers = np.array([float(row["inliers"] or "nan") for _, row in rows])
        tracking = [Tracking(row["tracking"]).value for _, row in rows]
    except (ValueError, OverflowError) as error:
        raise DataError(f"{path}: {error}") from error
    if tracking and all(word == Tracking.BLIND for word in tracking):
        return None
    return TrackingRows(t_ns, tracking, inliers, [row["reason"] for _, row in rows])


def as_dict(value: Any, *keys: str) -> dict[str, Any]:
    """Return a nested dictionary of damaged or partial data, or an empty one."""
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value if isinstance(value, dict) else {}


def as_list(value: Any) -> list[Any]:
    """Return a list of damaged or partial data, or an empty one."""
    return value if isinstance(value, list) else []
