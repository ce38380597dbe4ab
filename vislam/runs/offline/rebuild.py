"""The maps of a finished run made again: finer or coarser, other products, or at the poses of another estimate.

A session keeps the depth of each keyframe as the map used it, so no recording is needed and no image is decoded but
the keyframes' own. Settings that decide what is kept of an image (range limits, filters, subsampling, stereo matching)
need the images: then the recording is read again, and only its keyframes are looked at.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.config import Config, MapConfig
from vislam.core.camera import Rig
from vislam.core.errors import DataError, UsageError
from vislam.core.files import write_json
from vislam.core.memory import LoopPlace, PackedScan
from vislam.core.messages import Array, Frame, GraphUpdate, Keyframe, Submaps
from vislam.core.progress import Progress, silent
from vislam.core.up import Up
from vislam.frontend import knows_scale, mode_for
from vislam.mapping.cloud.store import packed_labels
from vislam.mapping.depth.extract import ScanExtractor
from vislam.mapping.mapper import Mapper
from vislam.mapping.pictures.of_map import write_pictures
from vislam.mapping.semantic.classes import LabelClasses
from vislam.mapping.semantic.images import LabelFolder, camera_t_ns
from vislam.mapping.upright import surest_up
from vislam.runs.folder import read_setup
from vislam.runs.levelled import Levelled, stored_level
from vislam.runs.session import Session
from vislam.runs.sources import open_source
from vislam.trajectory import read_trajectory

# what is left of a depth image or stereo pair after these is all that a session keeps
_EXTRACTION = (
    "min_range_m", "pixel_step", "edge_px", "speckle_pixels", "stereo_scale",
)  # fmt: skip


def map_settings(run: Path) -> Config:
    """Return the settings of a run; raises DataError when its session cannot be read."""
    with Session(run / "session.db") as session:
        return session.config()


def rebuild(run: Path, config: MapConfig, out: Path | None, poses: str, progress: Progress = silent) -> dict[str, Any]:
    """Make the maps of a run again into `out` (None: in the run's place); return what was written and what was not.

    `poses` is "graph" for the run's own, or names a `trajectory_NAME.tum` in its folder. Raises UsageError for a
    trajectory that is not there, DataError when the session or the recording cannot be used.
    """
    with Session(run / "session.db") as session:
        info = session.info()
        ran = session.config()
        rig = session.rig()
        if rig.is_blind:
            raise DataError(f"{run} was run without a camera: there is nothing to make a map of")
        level = stored_level(info)
        placed = keyframe_poses(session, run, poses, level.T_level_map)
        # depth from one camera was made of frames between keyframes: what the session keeps of it is all there is
        one_camera = ran.map.mono_depth.enabled and not knows_scale(mode_for(ran.frontend, rig))
        config = replace(config, mono_depth=ran.map.mono_depth) if one_camera else config
        labels = _Labels(ran.map, config, info, ScanExtractor(config, rig, one_camera))
        mapper = Mapper(config, rig, one_camera, labels.classes)
        from_session = ran.map.enabled and (one_camera or _same_extraction(ran.map, config, rig))
        nothing = GraphUpdate(
            0, np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.eye(4), None, submaps=stored_submaps(session)
        )
        mapper.move(nothing)
        total = len(placed) + len(config.products)

        def report(done: int, note: str) -> None:
            progress(done, total, note)

        if from_session:
            scans = {i: scan for i, scan in session.scans().items() if i in placed}
            mapper.restore(labels.given(scans, session), placed)
            for done in range(0, len(scans), config.rebuild_keyframes_per_call):
                report(done, "octree")
                mapper.move(nothing)
        else:
            _from_recording(session, mapper, placed, read_setup(run)[0], ran, labels, report)
    mapper.finish()
    if info.get("first_state") is None:
        level, mapper, placed = _levelled(level, mapper, placed, ran)
    mapper = mapper.refined()
    folder = run / "map" if out is None else out
    steps = iter(range(len(placed), total))
    written = mapper.export(folder, lambda product: report(next(steps), product), level.not_level)
    path_m = np.array([T[:3, 3] for T in placed.values()]).reshape(-1, 3)
    pictures = write_pictures(mapper, folder, path_m, level.is_level)
    answer: dict[str, Any] = {
        "keyframes": len(placed),
        "depth": "session" if from_session else "recording",
        "poses": poses,
        "written": {name: str(path) for name, path in written.items()},
        "pictures": [str(path) for path in pictures],
        "left_out": mapper.notes,
    }
    if labels.folder is not None:
        answer["labels"] = {"keyframes labelled": labels.used, **labels.folder.problems}
    if mapper.refinement:
        answer["refined"] = mapper.refinement
    if level.up is not None:
        answer["up"] = level.up.entry()
    write_json(folder / "map.json", {**answer, "settings": asdict(config)})
    return answer


def _levelled(
    level: Levelled, mapper: Mapper, placed: dict[int, Array], ran: Config
) -> tuple[Levelled, Mapper, dict[int, Array]]:
    """Return up, map and poses of a run without gravity; where the run did not know up, its surfaces are asked."""
    if level.up is not None:
        return level, mapper, placed  # it is level already
    is_asked = ran.up == "auto"
    level = Levelled(surest_up(mapper.views) if is_asked else Up.unknown(f"the run had --up {ran.up}"))
    T = level.T_level_map
    return level, mapper.turned(T), {i: T @ pose for i, pose in placed.items()}


def _same_extraction(ran: MapConfig, config: MapConfig, rig: Rig) -> bool:
    """Return whether what the run kept is what these settings would keep."""
    if any(getattr(ran, name) != getattr(config, name) for name in _EXTRACTION):
        return False
    # a longer range stores depth in coarser units
    return ScanExtractor(ran, rig).view.unit_m == ScanExtractor(config, rig).view.unit_m


def keyframe_poses(session: Session, run: Path, poses: str, T_level_map: Array) -> dict[int, Array]:
    """Return T_map_body of the keyframes by id, in order; those before and after the trajectory are left out.

    Session and causal trajectories are in the axes of the first image where the run had no gravity: they are turned.
    """
    stored = [(i, t_ns, T) for i, t_ns, T in ((k.id, k.t_ns, k.T_map_body) for k in session.keyframes())]
    if not stored:
        raise DataError(f"{session.path} holds no keyframe; run the recording again")
    if poses == "graph":
        return {i: T_level_map @ T for i, _, T in stored} if _is_turn(T_level_map) else {i: T for i, _, T in stored}
    path = run / f"trajectory_{poses}.tum"
    if not path.is_file():
        names = sorted(p.stem.removeprefix("trajectory_") for p in run.glob("trajectory_*.tum"))
        raise UsageError(f"{run} has no trajectory '{poses}'; there are: {', '.join(names)}")
    trajectory = read_trajectory(path)
    inside = [(i, t_ns) for i, t_ns, _ in stored if trajectory.t_ns[0] <= t_ns <= trajectory.t_ns[-1]]
    T = trajectory.at(np.array([t_ns for _, t_ns in inside], dtype=np.int64))
    if poses in ("ekf", "live") and _is_turn(T_level_map):
        T = T_level_map @ T
    return {i: T[k] for k, (i, _) in enumerate(inside)}


def _is_turn(T: Array) -> bool:
    return not np.array_equal(T, np.eye(4))


def stored_submaps(session: Session) -> Submaps:
    """Return the submaps, and which of them the loops that the graph held at the end have joined."""
    submaps = Submaps()
    for packet in session.packets(light=True):
        if packet.begins_submap and packet.keyframe.id > 0:
            submaps = submaps.begun(packet.keyframe.id)
    held = [loop.edge for loop in session.loops() if loop.state.place in (LoopPlace.GRAPH, LoopPlace.SPARE)]
    return submaps.joined_by((edge.from_id, edge.to_id) for edge in held)


class _Labels:
    """Where the labels of a run's keyframes are: in its session, or in a folder that is given now."""

    def __init__(self, ran: MapConfig, config: MapConfig, info: dict[str, Any], extractor: ScanExtractor) -> None:
        """Choose. Raises DataError when label images or the session cannot be used."""
        self._extractor = extractor
        path = config.labels.folder
        self.folder = None if path is None else LabelFolder(Path(path), extractor.camera)
        self.is_new = path is not None and path != ran.labels.folder
        self.classes = LabelClasses.of(info.get("labels") or {}, "the session")
        if self.folder is not None:
            self.classes = self.folder.classes
        self.used = 0

    def of(self, camera_t_ns: int) -> NDArray[np.uint16] | None:
        """Return the labels of the image with a stamp, None where there are none."""
        labels = None if self.folder is None else self.folder(None, camera_t_ns)
        self.used += labels is not None
        return labels

    def given(self, scans: dict[int, PackedScan], session: Session) -> dict[int, PackedScan]:
        """Return the scans of a session, where the folder is new with its labels; points alone get none."""
        if not self.is_new:
            self.used = sum(bool(scan.labels_png) for scan in scans.values())
            return scans
        stamps_ns = _camera_stamps_ns(session)
        out = {}
        for i, scan in scans.items():
            labels = self.of(stamps_ns[i]) if scan.depth_png else None
            on_rays = None if labels is None else self._extractor.on_rays(labels)
            out[i] = replace(scan, labels_png=packed_labels(on_rays))
        return out


def _camera_stamps_ns(session: Session) -> dict[int, int]:
    """Return the stamps of keyframes by the camera's own clock, by id."""
    offsets_s = {packet.keyframe.id: packet.time_offset_s for packet in session.packets(light=True)}
    return {k.id: camera_t_ns(k.t_ns, offsets_s[k.id]) for k in session.keyframes()}


def _from_recording(
    session: Session,
    mapper: Mapper,
    placed: dict[int, Array],
    source: str,
    ran: Config,
    labels: _Labels,
    report: Callable[[int, str], None],
) -> None:
    recording = open_source(source, ran.seed, ran.calibration)
    stamps_ns = _camera_stamps_ns(session)
    stored = {stamps_ns[k.id]: k for k in session.keyframes() if k.id in placed}
    count = 0
    for value in recording.events():
        if not isinstance(value, Frame) or value.t_ns not in stored:
            continue
        k = stored.pop(value.t_ns)
        frame = replace(value, t_ns=k.t_ns)
        keyframe = Keyframe(k.id, k.t_ns, frame, k.keypoints_px, k.descriptors, k.points_body_m)
        mapper.add(keyframe, placed[k.id], labels.of(value.t_ns))
        count += 1
        report(count, "recording")
        if not stored:
            return
    first = next(iter(stored.values()))
    raise DataError(
        f"{source} has no frame for keyframe {first.id} at {first.t_ns} ns, nor for {len(stored) - 1} others; "
        "give the recording that the run began with"
    )
