"""The run folder: every file that one run leaves behind, each written whole or not at all."""

from __future__ import annotations

import hashlib
import math
import platform
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from vislam.config import Config, MachineConfig, dump, from_data, recorded
from vislam.core.errors import DataError, UsageError
from vislam.core.files import csv_text, refuse_links_out, storage, write_json, write_text
from vislam.core.log import FILE_NAME, is_written_to
from vislam.core.memory import FrameEntry, SlamMemory
from vislam.core.messages import (
    Array,
    ImuSpan,
    LoopCandidate,
    LoopDecision,
    LoopEdge,
    NavState,
    RetrievedKeyframe,
    Tracking,
)
from vislam.core.reading import read_json
from vislam.core.revision import code_revision
from vislam.loop import INJECTED, LoopRow, is_injected, loops_text, retrieved_text
from vislam.mapping.file_names import CLASSES_NAME as LABEL_CLASSES
from vislam.mapping.file_names import FILES as MAP_FILES
from vislam.runs.geodetic_outputs import LINES, TABLES
from vislam.runs.loop_shifts import LoopShifts
from vislam.runs.session import Session, has_frames
from vislam.runs.sources import recorded_path
from vislam.trajectory import Alignment, Trajectory, write_states_csv, write_tum
from vislam.trajectory.frames import LoggedFrames
from vislam.trajectory.motion_numbers import motion_of

if TYPE_CHECKING:
    from vislam.pipeline.steps import KeyframeStep, Step

_HASHED_FILE_BYTES = 32 * 2**20  # larger files count by name and size only: hashing video would take longer than a run
_HASHED_SUFFIXES = {".csv", ".txt", ".yaml", ".json"}
_PACKAGES = ("vislam", "numpy", "scipy", "gtsam", "opencv-python-headless", "numba", "open3d", "rerun-sdk")
_RUN_FILES = (
    "log.txt", "manifest.json", "config.json", "sensors.json", "metrics.json", "tracking.csv", "loops.csv",
    "retrieved.csv", "loops_eval.json", "loops_eval.csv", "loops_eval.svg", "session.db", "session.db-wal",
    "session.db-shm", "session.db-journal", "run.rrd",
    "report.html", "states_ekf.csv", "states_graph.csv", "trajectory_ekf.tum", "trajectory_live.tum",
    "trajectory_graph.tum", "trajectory_batch.tum", "trajectory_truth.tum", "states_batch.csv",
    *TABLES.values(), LINES, "map/grid.yaml",
    "saved/cloud.ply", "saved/trajectory.tum",
    "map/drive.yaml", "map/map.json", f"map/{LABEL_CLASSES}", *(f"map/{name}" for name in MAP_FILES.values()),
)  # fmt: skip
_CALIBRATIONS = "calibration"  # folder of those that were made before the run began
TRACKING_COLUMNS = ("t_ns", "tracking", "inliers", "keyframe_id", "localisation", "submap", "reason")


def prepare(out: Path, overwrite: bool, base: MapChoice | None = None) -> None:
    """Make the folder of a new run; raises UsageError when it holds something else, StorageError when it cannot be.

    What a run left that ended before its first frame is replaced without `overwrite`; calibrations made there stay.
    `base` is the map in which the run begins: it must not lie there.
    """
    if base is not None and base.session.resolve().parent == out.resolve():
        raise UsageError(f"--map {base.path} is in --out {out}, where it would be replaced; choose a new folder")
    if _is_taken(out):
        files = _files_of_run(out)
        is_empty = _holds_nothing(out, files)
        if not ((out / "manifest.json").is_file() or is_empty):
            raise UsageError(f"--out {out} exists and is not a run; choose a new folder")
        if not (overwrite or is_empty):
            raise UsageError(f"--out {out} already holds a run; add --overwrite or choose a new folder")
        refuse_links_out(out)
        if is_written_to(out):
            raise UsageError(f"another vislam is at work in --out {out}; wait for its end or choose a new folder")
        with storage(out):
            for path in files:
                path.unlink(missing_ok=True)
    with storage(out):
        out.mkdir(parents=True, exist_ok=True)


def _is_taken(out: Path) -> bool:
    """Return whether something stands where a run is to be made."""
    return out.exists() and (not out.is_dir() or any(path.name != _CALIBRATIONS for path in out.iterdir()))


def _new_run(out: Path) -> str:
    """Return how to get a run where there is none, as `prepare` allows it."""
    if not _is_taken(out) or _holds_nothing(out, _files_of_run(out)):
        return f"start one with --out {out}"
    if (out / "manifest.json").is_file():
        return f"start one with --out {out} --overwrite"
    return "name the folder of a run, or start one with --out and a new folder"


def _files_of_run(out: Path) -> list[Path]:
    """Return what runs write into their folder, as far as it is there, with what a killed one had not finished."""
    # batch estimates choose their names, and the pictures of loops are named after them
    patterns = (
        *_RUN_FILES, "trajectory_*.tum", "states_*.csv", "loops/*.jpg", "run_*.rrd", "map/picture_*.png",
        "session.db.part", ".*.partial", "map/.*.partial", "loops/.*.partial",
    )  # fmt: skip
    found = {path for pattern in patterns for path in out.glob(pattern)}
    # what marks it as a run comes last: removing them may be interrupted
    return sorted(found, key=lambda path: (path.name in ("manifest.json", FILE_NAME), path))


def _holds_nothing(out: Path, files: list[Path]) -> bool:
    """Return whether a folder is that of a run that ended before its first frame, as where a sensor was missing.

    It may be replaced without asking: a run begins with its log, and no foreign file is there.
    """
    if not out.is_dir() or not (out / FILE_NAME).is_file() or has_frames(out / "session.db"):
        return False
    try:
        frames = read_metrics(out).get("frames", 0)
    except DataError:
        return False
    held = {path for path in out.rglob("*") if not path.is_dir() and path.relative_to(out).parts[0] != _CALIBRATIONS}
    return frames == 0 and {*files} >= held


def read_setup(out: Path) -> tuple[str, Config, MapChoice | None]:
    """Return source, settings and map of the run in a folder.

    Raises UsageError when there is no run, DataError when its recording is not what it was.
    """
    manifest, settings = (_read_json(out / name) for name in ("manifest.json", "config.json"))
    source = manifest.get("source")
    if not isinstance(source, str):
        raise UsageError(f"{out / 'manifest.json'} names no source; start the run again with --overwrite")
    if _fingerprint_of(source) != manifest.get("data_sha256"):
        raise DataError(f"{source} is not the recording that {out} began with; start a new run")
    base = manifest.get("map")
    try:
        choice = None if base is None else MapChoice(Path(base["path"]), bool(base["localize_only"]))
    except (KeyError, TypeError) as error:
        raise DataError(f"{out / 'manifest.json'} names no sound map; start the run again with --overwrite") from error
    where = str(out / "config.json")
    return source, from_data(recorded(settings, where), where), choice


def _read_json(path: Path) -> dict[str, Any]:
    """Return an object of a run folder."""
    try:
        data = read_json(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        out = path.parent
        raise UsageError(f"{out} holds no run to resume ({path.name} is missing); {_new_run(out)}") from error
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read: {error}; start the run again with --overwrite") from error
    if not isinstance(data, dict):
        raise DataError(f"{path} holds no object; start the run again with --overwrite")
    return data


def read_metrics(run: Path) -> dict[str, Any]:
    """Return metrics.json of a run, empty where it was killed; raises DataError when the file cannot be used."""
    path = run / "metrics.json"
    if not path.exists():
        return {}
    try:
        metrics = read_json(path)
        sections = [metrics.get(name, {}) for name in ("accuracy", "batch", "sensors")]  # each by names
        if not all(isinstance(s, dict) and all(isinstance(entry, dict) for entry in s.values()) for s in sections):
            raise ValueError("it holds something else than metrics")
    except (OSError, ValueError, AttributeError) as error:
        raise DataError(f"{path} cannot be used: {error}; remove it, or run the recording again") from error
    return metrics


def recorded_alignment(metrics: dict[str, Any]) -> Alignment:
    """Return how a run's own trajectories were aligned to the truth; "se3" where its metrics do not say it soundly."""
    accuracy = metrics.get("accuracy")
    entry = accuracy.get("graph") if isinstance(accuracy, dict) else None
    asked = entry.get("alignment") if isinstance(entry, dict) else None
    known: tuple[Alignment, ...] = get_args(Alignment)
    return next((alignment for alignment in known if alignment == asked), "se3")


def manifest(source: str, command: list[str], config: Config) -> dict[str, Any]:
    """Return what identifies a run: code, packages, data, seed, command, machine."""
    return {
        "source": source,
        "data_sha256": _fingerprint_of(source),
        "command": command,
        "seed": config.seed,
        "code_revision": code_revision(),
        "packages": {name: version for name in _PACKAGES if (version := _version(name))},
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }


def _fingerprint_of(source: str) -> str | None:
    try:
        path = recorded_path(source)
        return None if path is None else fingerprint(path)
    except (OSError, ValueError) as error:  # a name that can be no file's
        why = getattr(error, "strerror", error)
        raise DataError(f"the recording {source[:200]} cannot be looked at: {why}") from error


def fingerprint(path: Path) -> str | None:
    """Return the SHA-256 of a recording: names and sizes of its files, and the contents of its tables."""
    if not path.exists():
        return None
    digest = hashlib.sha256()
    for file in sorted(p for p in ([path] if path.is_file() else path.rglob("*")) if p.is_file()):
        size = file.stat().st_size
        digest.update(f"{file.relative_to(path.parent)} {size}\n".encode())
        if file.suffix in _HASHED_SUFFIXES and size <= _HASHED_FILE_BYTES:
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@dataclass(frozen=True, slots=True)
class MapChoice:
    """The session in whose map a run begins."""

    path: Path
    localize_only: bool  # the map stays as it is

    @property
    def session(self) -> Path:
        """Its file."""
        return self.path / "session.db" if self.path.is_dir() else self.path


def map_choice(path: Path | None, localize_only: bool, settings: Config) -> MapChoice | None:
    """Return the map that a run begins in; raises UsageError where an option needs one that is not given."""
    if path is not None:
        return MapChoice(path, localize_only)
    if localize_only:
        raise UsageError("--localize-only needs a map; give --map OLD/session.db")
    if settings.loop.start_in_map is not None:
        raise UsageError("--loop.start-in-map is a place in a map; give --map OLD/session.db")
    return None


class RunLog:
    """Remembers of every frame what the trajectories and tables need, and writes them."""

    def __init__(self) -> None:
        """Start empty."""
        self._frames: list[FrameEntry] = []
        self._ekf_states: dict[int, NavState] = {}
        self._keyframe_t_ns: dict[int, int] = {}
        self._map_t_ns: dict[int, int] = {}  # of the keyframes of a map, by the clock of its own recording
        self._spans: dict[int, ImuSpan] = {}  # between a keyframe and the one before
        self._candidates: list[LoopCandidate] = []
        self._edge_ids: dict[tuple[int, int, bool], int] = {}  # by ends, and whether it was made up on purpose
        self._retrieved: list[RetrievedKeyframe] = []
        self._shifts = LoopShifts()
        self.revisions = 0
        self._first_id = 0  # of the keyframes of this recording; those before are a map's

    def __len__(self) -> int:
        return len(self._frames)

    def frames_up_to(self, keyframe_id: int) -> int:
        """Return how many frames hang on this keyframe or an earlier one."""
        return sum(frame.keyframe_id <= keyframe_id for frame in self._frames)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Times [N] of the frames so far."""
        return np.array([frame.t_ns for frame in self._frames], dtype=np.int64)

    @property
    def zero_ns(self) -> int:
        """Time of the first frame, from which seconds count; there has to be one."""
        return self._frames[0].t_ns

    @property
    def newest_tracking(self) -> Tracking | None:
        """How far the front end trusted the newest frame; None before there was one."""
        return self._frames[-1].tracking if self._frames else None

    @property
    def worst_position_sigma_m(self) -> float:
        """Largest sigma of the filter's position at a keyframe, in metres; 0 without a filter."""
        variances = [np.trace(state.covariance[3:6, 3:6]) for state in self._ekf_states.values()]
        return float(np.sqrt(max(variances, default=0.0)))

    def filter_state(self, keyframe_id: int) -> NavState | None:
        """Return the filter's state at a keyframe, None where it had none."""
        return self._ekf_states.get(keyframe_id)

    @property
    def candidates(self) -> int:
        """How many loop candidates there were."""
        return len(self._candidates)

    def shifts(self, edge_ids: Iterable[int]) -> dict[int, tuple[float, float]]:
        """Return the rms and largest shift in metres that is each loop edge's own, of those that were taken in."""
        return self._shifts.of(edge_ids)

    @property
    def keyframes(self) -> int:
        """How many keyframes reached the back end."""
        return len(self._keyframe_t_ns)

    def restore(self, session: Session, memory: SlamMemory) -> None:
        """Take over what a run remembered up to its last keyframe; those of a map in which it began are not its own."""
        self._first_id = session.first_id
        self._frames = session.frames()
        self._ekf_states = session.states("filter")
        self._take_map(memory)
        for packet in memory.graph.packets[self._first_id :]:
            self._keyframe_t_ns[packet.keyframe.id] = packet.keyframe.t_ns
            if packet.imu is not None:
                self._spans[packet.keyframe.id] = packet.imu
        self._candidates, self._retrieved = session.candidates(), session.retrieved()
        self._shifts.restore(memory, session.shifts())
        for loop in memory.graph.loops:
            self._name(loop.edge)
        self.revisions = memory.graph.revision

    def begin_in_map(self, memory: SlamMemory) -> None:
        """Number keyframes on from those of a map."""
        self._first_id = len(memory.graph.packets)
        self._take_map(memory)
        self._shifts.place(memory)

    def _take_map(self, memory: SlamMemory) -> None:
        stamps = (packet.keyframe for packet in memory.graph.packets[: self._first_id])
        self._map_t_ns = {keyframe.id: keyframe.t_ns for keyframe in stamps}

    def add(self, step: Step) -> FrameEntry:
        """Remember one step; return what is remembered of its frame."""
        front, vo = step.front, step.front.track.vo
        entry = FrameEntry(
            front.frame.t_ns, front.keyframe_id, front.T_keyframe_body, front.T_odom_body, step.T_map_body,
            vo.tracking, vo.inliers, vo.keyframe_id, front.track.reason, step.localisation, step.submap,
            None if front.moving is None else motion_of(front.moving),
        )  # fmt: skip
        self._frames.append(entry)
        if front.state is not None and front.track.keyframe is not None:
            self._ekf_states[front.track.keyframe.id] = front.state
        for keyframe in step.keyframes:
            self.add_keyframe(keyframe)
        return entry

    def add_keyframe(self, step: KeyframeStep) -> None:
        """Remember what the back end did with a keyframe."""
        keyframe = step.odometry.packet.keyframe
        self._keyframe_t_ns[keyframe.id] = keyframe.t_ns
        if step.odometry.packet.imu is not None:
            self._spans[keyframe.id] = step.odometry.packet.imu
        self._candidates += [replace(candidate, matches_px=None) for candidate in step.candidates]
        self._retrieved += step.retrieved
        for edge in step.edges:
            self._name(edge)
        self._shifts.follow(step)
        self.revisions = step.update.revision

    def _name(self, edge: LoopEdge) -> None:
        self._edge_ids[edge.from_id, edge.to_id, is_injected(edge.id)] = edge.id

    def final_trajectory(
        self, ids: list[int], T_map_body: Array, states: list[NavState], machine: MachineConfig
    ) -> Trajectory:
        """Return the pose of every frame from the final poses of the keyframes that they were tracked against.

        Frames whose motion since their keyframe is unknown are carried by the IMU between `states` (of the keyframes,
        empty without an IMU), or interpolated between those that are known.
        """
        keyframe_ids = np.array([frame.keyframe_id for frame in self._frames], dtype=np.int64)
        frames = LoggedFrames(self.stamps_ns, keyframe_ids, [frame.T_keyframe_body for frame in self._frames])
        frames = frames.carried_by_imu(states, self._spans, machine.gravity_m_s2, machine.max_gap_s)
        poses = dict(zip(ids, T_map_body, strict=True))
        return frames.placed(self._keyframe_t_ns, {i: poses[i] for i in ids if i in self._keyframe_t_ns})

    def inertial_spans(self) -> list[ImuSpan]:
        """Return the inertial samples between keyframes, in order."""
        return [span for _, span in sorted(self._spans.items())]

    def odometry_trajectory(self) -> Trajectory:
        """Return the causal poses in odom: those of the filter, or of visual odometry without an IMU."""
        return self._causal([frame.T_odom_body for frame in self._frames])

    def live_trajectory(self) -> Trajectory:
        """Return the causal best estimates in map."""
        return self._causal([frame.T_map_body for frame in self._frames])

    def _causal(self, poses: list[Array | None]) -> Trajectory:
        known = [(frame.t_ns, T) for frame, T in zip(self._frames, poses, strict=True) if T is not None]
        t_ns = np.array([t for t, _ in known], dtype=np.int64)
        return Trajectory(t_ns, np.array([T for _, T in known]).reshape(-1, 4, 4))

    def write_trajectories(self, out: Path, final: Trajectory, truth: Trajectory | None) -> None:
        """Write the TUM files of a run."""
        write_tum(self.odometry_trajectory(), out / "trajectory_ekf.tum")
        live = self.live_trajectory()
        if len(live):  # a run that is not found in the map of another was nowhere in it
            write_tum(live, out / "trajectory_live.tum")
        write_tum(final, out / "trajectory_graph.tum")
        if truth is not None:
            write_tum(truth, out / "trajectory_truth.tum")

    def write_states(self, out: Path, ids: list[int], states: list[NavState]) -> None:
        """Write keyframe states with covariances, of the filter and of the graph."""
        if states[self._first_id :]:
            write_states_csv(out / "states_graph.csv", ids[self._first_id :], states[self._first_id :])
        if self._ekf_states:
            write_states_csv(out / "states_ekf.csv", list(self._ekf_states), list(self._ekf_states.values()))

    def loop_rows(self, loop_reports: dict[int, Any]) -> list[LoopRow]:
        """Return every candidate, in the order of its recording, with what became of it.

        `loop_reports` maps edge ids to what the graph decided (chi2, weight, decision, reason).
        """
        return [self._loop_row(candidate, loop_reports) for candidate in self._candidates]

    def _loop_row(self, candidate: LoopCandidate, loop_reports: dict[int, Any]) -> LoopRow:
        decision, reason, report, edge_id = candidate.decision, candidate.reason, None, -1
        if decision == LoopDecision.ACCEPTED:  # offered to the graph, which has the last word
            edge_id = self._edge_ids.get((candidate.from_id, candidate.to_id, candidate.source == INJECTED), -1)
            report = loop_reports.get(edge_id)
        if report is not None:
            decision, reason = report.decision, f"{candidate.reason}; {report.reason}"
        rms_m, max_m = self._shifts[edge_id]
        return LoopRow(
            from_id=candidate.from_id,
            to_id=candidate.to_id,
            from_t_ns=self._keyframe_t_ns.get(candidate.from_id, self._map_t_ns.get(candidate.from_id, -1)),
            to_t_ns=self._keyframe_t_ns.get(candidate.to_id, -1),
            source=candidate.source,
            score=candidate.score,
            inliers=candidate.inliers,
            supporters=candidate.supporters,
            sigma_m=candidate.sigma_m,
            consistency=candidate.consistency,
            chi2=math.nan if report is None else report.chi2,
            weight=math.nan if report is None else report.weight,
            moved_rms_m=rms_m,
            moved_max_m=max_m,
            T_from_to=candidate.T_from_to,
            decision=str(decision),
            reason=reason,
        )

    def write_tables(self, out: Path, loops: list[LoopRow]) -> dict[str, int]:
        """Write the tables of tracking and loops; return how many candidates were accepted, pending and rejected."""
        tracking = [
            (f.t_ns, str(f.tracking), f.inliers, f.vo_keyframe_id, str(f.localisation), f.submap, f.reason)
            for f in self._frames
        ]
        write_text(out / "tracking.csv", csv_text(TRACKING_COLUMNS, tracking))
        write_text(out / "retrieved.csv", retrieved_text(self._retrieved))
        write_text(out / "loops.csv", loops_text(loops))
        decisions = Counter(row.decision for row in loops)
        counts = {"candidates": len(loops), **{str(decision): decisions[str(decision)] for decision in LoopDecision}}
        injected = [row.decision == LoopDecision.ACCEPTED for row in loops if row.source == INJECTED]
        return counts | ({"injected": len(injected), "injected_kept": sum(injected)} if injected else {})


def write_setup(out: Path, config: Config, source: str, command: list[str], base: MapChoice | None = None) -> None:
    """Write manifest.json and config.json, before anything is computed."""
    data = manifest(source, command, config)
    if base is not None:
        data["map"] = {"path": str(base.path.resolve()), "localize_only": base.localize_only}
    write_json(out / "manifest.json", data)
    write_json(out / "config.json", dump(config))
