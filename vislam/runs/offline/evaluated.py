"""The trajectories that a run left, with what its own report judged them by."""

from dataclasses import dataclass
from pathlib import Path

from vislam.core.errors import DataError
from vislam.core.trajectory import Trajectory
from vislam.loop import read_rows
from vislam.runs.folder import TRACKING_COLUMNS, read_metrics, recorded_alignment
from vislam.trajectory import Alignment, read_tum


@dataclass(frozen=True, slots=True, eq=False)
class EvaluatedRun:
    """Estimates by their name, the truth if there is one, the time of the frames, and how all were aligned."""

    estimates: dict[str, Trajectory]
    truth: Trajectory | None
    span_ns: tuple[int, int] | None
    alignment: Alignment


def is_run(folder: Path) -> bool:
    """Return whether a path is a folder with trajectories of a run."""
    return folder.is_dir() and any(folder.glob("trajectory_*.tum"))


def read_evaluated(run: Path) -> EvaluatedRun:
    """Read what is evaluated of a run. Raises DataError, with the file, for damage."""
    paths = {p.stem.removeprefix("trajectory_"): p for p in sorted(run.glob("trajectory_*.tum"))}
    truth = paths.pop("truth", None)
    if not paths:
        raise DataError(f"{run} holds no trajectory_*.tum but the truth's; give a run folder or a trajectory file")
    tracking = run / "tracking.csv"
    stamps = [row["t_ns"] for _, row in read_rows(tracking, TRACKING_COLUMNS)] if tracking.is_file() else []
    try:
        span_ns = (int(stamps[0]), int(stamps[-1])) if stamps else None
    except ValueError as error:
        raise DataError(f"{tracking}: {error}; remove the file, or run the recording again") from error
    estimates = {name: read_tum(path) for name, path in paths.items()}
    alignment = recorded_alignment(read_metrics(run))
    return EvaluatedRun(estimates, None if truth is None else read_tum(truth), span_ns, alignment)
