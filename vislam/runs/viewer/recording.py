"""The Rerun recording of a run: the only place that knows rerun. It writes a file and never opens a port.

A keyframe's cloud is stored once, relative to the keyframe; when the graph moves, only poses are written again. Paths
are written in short pieces, so that the file grows with the length of a run and not with its square.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np

os.environ.setdefault("RUST_LOG", "off")  # what fails is said here, in one line
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from vislam.config import ViewConfig
from vislam.core.camera import Rig
from vislam.core.errors import StorageError
from vislam.core.geometry import quaternion_xyzw_from_rotation
from vislam.core.messages import (
    Array,
    Frame,
    GraphUpdate,
    ImageU8,
    Keyframe,
    LoopCandidate,
    LoopDecision,
    Observations,
    Tracking,
)
from vislam.runs.viewer.layout import layout
from vislam.runs.viewer.map_view import grid_cells, octree_voxels

_JPEG_QUALITY = 75
_MAX_RANGE_M = 8.0  # farther depth is noise that hides the scene


rr.unregister_shutdown()  # at exit it waits without a limit; who opens a recording closes it

_PAPER_GREY = 60
_COLORS = {
    "ekf": (230, 126, 34),
    "live": (125, 175, 225),
    "graph": (31, 119, 180),
    "truth": (120, 120, 120),
    "accepted": (39, 160, 90),
    "rejected": (200, 70, 70),
    "pending": (200, 170, 60),
}
_OTHER_COLOR = (150, 110, 190)
_TRACKING_COLORS = {Tracking.OK: 0x27A05AFF, Tracking.DEGRADED: 0xE0A030FF, Tracking.LOST: 0xC84646FF}
_CAMERA = "world/live/cam0"
_PIECE = 64  # poses per line piece
_PIECE_STEP = 4  # poses after which a growing piece is written again
_MOVED_M = 2e-3  # smaller moves cannot be seen
_MOVED_RAD = np.deg2rad(0.1)
_STILL_S = 3.0  # without progress, until the file is given up
_LOOK_S = 0.1
_OLD_TRACK_FRAMES = 60.0  # a track this old has its final colour


class RunViewer:
    """Writes one run as a Rerun recording, in the order in which things happen."""

    def __init__(self, path: Path, rig: Rig | None = None, config: ViewConfig | None = None) -> None:
        """Create the file; the rig gives the camera its place and shape in the picture. Raises StorageError."""
        self.path = path
        self._config = config or ViewConfig()
        self._rig = None if rig is None or rig.is_blind else rig
        self._stream = rr.RecordingStream("vislam", recording_id=path.parent.name or "run")
        self._stream.set_log_time_enabled(False)  # clocks would make two runs differ
        self._stream.set_log_tick_enabled(False)
        try:
            path.touch()
            self._stream.save(path)
        except (OSError, RuntimeError) as error:
            said = f"{path} cannot be written: {error}; choose another folder or --view.no-enabled"
            raise StorageError(said) from error
        self._zero_ns: int | None = None
        self._frames, self._is_closed = 0, False
        self._tracking: Tracking | None = None
        self._first_seen: dict[int, int] = {}
        self._groups: dict[str, None] = {}
        self._poses: dict[int, Array] = {}  # of keyframes, as last written
        self._paths: dict[str, list[Array]] = {}
        self._loops: dict[LoopDecision, list[tuple[int, int]]] = {}
        self._has_loop_pictures = False
        self._map_t_ns = -(1 << 62)  # when the map was shown last
        self._voxels: NDArray[np.int64] | None = None
        self._log_static()

    def go_on(self, zero_ns: int, T_map_body: Mapping[int, Array]) -> None:
        """Begin where an earlier recording of the same run ended: its time zero, and its keyframes [4, 4] by id.

        Opened together with it, the two are shown as one.
        """
        self._zero_ns = zero_ns
        self._set_time(zero_ns)
        for keyframe_id, T in T_map_body.items():
            self._write_pose(keyframe_id, T)
        if self._poses:
            self._log_keyframe_path(list(self._poses))

    def log_frame(self, frame: Frame, observations: Observations, tracking: Tracking) -> None:
        """Log the tracking state, and for one frame in `every_frames` the picture with its tracks coloured by age."""
        self._set_time(frame.t_ns)
        if tracking is not self._tracking and tracking in _TRACKING_COLORS:
            self._stream.log("status/tracking", rr.StateChange(state=tracking.value))
            self._tracking = tracking
        ids = observations.track_ids.tolist()
        self._first_seen = {track: self._first_seen.get(track, self._frames) for track in ids}
        self._frames += 1
        if (self._frames - 1) % self._config.every_frames:
            return
        image = _picture(frame, self._rig)
        if image is None:
            return
        jpeg, scale = self._jpeg(image)
        self._stream.log(_CAMERA + "/image", jpeg)
        ages = np.array([self._frames - self._first_seen[track] for track in ids], dtype=np.float64)
        points = rr.Points2D((observations.pixels_px + 0.5) * scale - 0.5, colors=_age_colors(ages), radii=1.5)
        self._stream.log(_CAMERA + "/image/tracks", points)

    def log_pose(self, name: str, t_ns: int, T_world_body: Array) -> None:
        """Log one pose [4, 4] of a growing trajectory; "live" also carries the camera."""
        self._set_time(t_ns)
        self._stream.log(f"world/{name}", _transform(T_world_body))
        path = self._paths.setdefault(name, [])
        path.append(T_world_body[:3, 3].copy())
        if len(path) % _PIECE_STEP == 0:
            self._log_piece(name, path, (len(path) - 2) // _PIECE)

    def log_keyframe(self, keyframe: Keyframe, T_map_body: Array) -> None:
        """Log a keyframe once: its pose, its picture and its cloud in its own frame."""
        self._set_time(keyframe.t_ns)
        entity = _keyframe_entity(keyframe.id)
        points, colors = self._cloud(keyframe)
        if len(points):
            self._stream.log(entity, rr.Points3D(points.astype(np.float32), colors=colors, radii=0.012))
        image = _picture(keyframe.frame, self._rig)
        if image is not None:
            self._stream.log("keyframe/image", self._jpeg(image)[0])
        self._write_pose(keyframe.id, T_map_body)
        self._log_keyframe_path([keyframe.id])

    def move(self, update: GraphUpdate) -> None:
        """Write again the keyframe poses that visibly moved, and the lines that hang on them."""
        moved = []
        for keyframe_id, T in zip(update.ids.tolist(), update.T_map_body, strict=True):
            old = self._poses.get(keyframe_id)
            if old is not None and _visibly_moved(old, T):
                self._write_pose(keyframe_id, T)
                moved.append(keyframe_id)
        if moved:
            self._log_keyframe_path(moved)
            self._log_loops(LoopDecision.ACCEPTED)
        if update.note:
            self._stream.log("notes", rr.TextLog(f"graph revision {update.revision}: {update.note}", level="WARN"))

    def log_cloud(self, keyframe_id: int, points_body_m: NDArray[np.floating], colors: ImageU8) -> None:
        """Show a keyframe's points [N, 3] with RGB [N, 3] in place of those it had; it moves with the keyframe."""
        step = 1 + len(points_body_m) // self._config.cloud_points
        points = rr.Points3D(points_body_m[::step].astype(np.float32), colors=colors[::step], radii=0.012)
        self._stream.log(_keyframe_entity(keyframe_id), points)

    def wants_map(self, t_ns: int, is_last: bool = False) -> bool:
        """Return whether it is time to show the map again."""
        return is_last or t_ns - self._map_t_ns >= 1e9 * self._config.map_every_s

    def log_octree(self, t_ns: int, voxels: NDArray[np.int64], resolution_m: float) -> None:
        """Show the occupied voxels [N, 3] of the map, 0 at its origin, coloured by height, in place of those before."""
        self._set_time(t_ns)
        self._map_t_ns = t_ns
        if self._voxels is None or not np.array_equal(voxels, self._voxels):
            self._voxels = voxels
            boxes = octree_voxels(voxels, resolution_m, self._axes()[0], self._config.map_voxels)
            self._stream.log("world/octree", boxes)

    def log_grid(
        self, t_ns: int, cells: NDArray[np.int8], resolution_m: float, origin_m: tuple[float, float], floor_m: float
    ) -> None:
        """Show the navigation grid: cells [rows, columns] 1 occupied, 0 free, -1 unknown, row 0 at the lowest y."""
        self._set_time(t_ns)
        self._stream.log("world/grid", grid_cells(cells, resolution_m, origin_m, floor_m, self._config.map_voxels))

    def log_loop(self, candidate: LoopCandidate) -> None:
        """Draw a loop candidate in the colour of its decision and note its reason."""
        self._loops.setdefault(candidate.decision, []).append((candidate.from_id, candidate.to_id))
        self._log_loops(candidate.decision)
        text = f"loop {candidate.from_id} - {candidate.to_id} {candidate.decision.value}: {candidate.reason}"
        self._stream.log("notes", rr.TextLog(text, level="INFO"))

    def log_loop_picture(self, t_ns: int, jpeg: bytes, text: str) -> None:
        """Show both images of a loop candidate with their matches, at the time when it was found."""
        self._set_time(t_ns)
        self._stream.log("loop/pair", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        self._stream.log("loop/why", rr.TextDocument(text))
        if not self._has_loop_pictures:
            self._has_loop_pictures = True
            self._stream.send_blueprint(self._blueprint())

    def settle_loops(self, t_ns: int, decided: Mapping[tuple[int, int], LoopDecision]) -> None:
        """Draw all loop candidates, by their keyframes, as they were decided in the end, from a time on."""
        self._set_time(t_ns)
        for decision in LoopDecision:
            pairs = [pair for pair, final in decided.items() if final is decision]
            had_some = bool(self._loops.get(decision))
            self._loops[decision] = pairs
            if pairs:
                self._log_loops(decision)
            elif had_some:
                self._stream.log(f"world/loops/{decision.value}", rr.LineStrips3D([]))

    def log_scalars(self, t_ns: int, values: Mapping[str, float]) -> None:
        """Log numbers named `group/name`; each group becomes one plot."""
        self._set_time(t_ns)
        known = len(self._groups)
        for name, value in values.items():
            self._groups.setdefault(name.partition("/")[0])
            self._stream.log(["plots", *name.split("/")], rr.Scalars(float(value)))
        if len(self._groups) > known:
            self._stream.send_blueprint(self._blueprint())

    def log_path(self, name: str, positions_m: Array) -> None:
        """Log a whole path [N, 3] in the map frame that is valid for all times, such as the aligned truth."""
        self._stream.log(f"world/paths/{name}", _line(positions_m, name), static=True)

    def log_note(self, t_ns: int, text: str) -> None:
        """Log a line of text, such as an outage."""
        self._set_time(t_ns)
        self._stream.log("notes", rr.TextLog(text, level="INFO"))

    def close(self) -> str | None:
        """Write what is still pending and finish the file, once; return why it is cut short, None when it is whole."""
        if self._is_closed:
            return None
        self._is_closed = True
        for name, path in self._paths.items():
            self._log_piece(name, path, max(len(path) - 2, 0) // _PIECE)
        self._stream.send_blueprint(self._blueprint())
        return finished(self._stream, self.path)

    def __enter__(self) -> RunViewer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def _set_time(self, t_ns: int) -> None:
        if self._zero_ns is None:
            self._zero_ns = t_ns
        self._stream.set_time("t", duration=np.timedelta64(t_ns - self._zero_ns, "ns"))

    def _log_static(self) -> None:
        self._stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._stream.log(
            "status/tracking",
            rr.StateConfiguration(
                values=[state.value for state in _TRACKING_COLORS],
                colors=np.array(list(_TRACKING_COLORS.values()), np.uint32),
            ),
            static=True,
        )
        if self._rig is not None:
            camera = self._rig.cameras[0]
            small = camera.scaled(self._config.image_width_px / camera.width)
            pinhole = rr.Pinhole(
                image_from_camera=small.K,
                resolution=[small.width, small.height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.3,
            )
            self._stream.log(_CAMERA, _transform(self._rig.T_body_cams[0]), pinhole, static=True)
        self._stream.send_blueprint(self._blueprint())

    def _jpeg(self, image: ImageU8) -> tuple[Any, float]:
        scale = self._config.image_width_px / image.shape[1]
        size = (self._config.image_width_px, max(round(image.shape[0] * scale), 1))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        return rr.EncodedImage(contents=encoded.tobytes(), media_type="image/jpeg"), scale

    def _cloud(self, keyframe: Keyframe) -> tuple[Array, ImageU8]:
        """Return points [N, 3] in the body frame with RGB [N, 3]: a grid over the depth image, or the features."""
        frame = keyframe.frame
        image = _picture(frame, self._rig)
        if image is None:
            return np.empty((0, 3)), np.empty((0, 3), np.uint8)
        if frame.depth_m is not None and self._rig is not None:
            pixels, depth = _depth_grid(frame.depth_m, self._config.cloud_points, _MAX_RANGE_M)
            T_body_cam = self._rig.T_body_cams[0]
            points = self._rig.cameras[0].unproject(pixels) * depth[:, None] @ T_body_cam[:3, :3].T + T_body_cam[:3, 3]
        elif keyframe.points_body_m is not None:
            pixels, points = keyframe.keypoints_px, keyframe.points_body_m
        else:
            return np.empty((0, 3)), np.empty((0, 3), np.uint8)
        near = np.linalg.norm(points, axis=1) <= 2.0 * _MAX_RANGE_M  # NaN is not near
        points, pixels = points[near], pixels[near]
        rows = np.clip(np.rint(pixels[:, 1]).astype(int), 0, image.shape[0] - 1)
        columns = np.clip(np.rint(pixels[:, 0]).astype(int), 0, image.shape[1] - 1)
        colors = image[rows, columns]
        return points, colors[:, ::-1] if colors.ndim == 2 else np.repeat(colors[:, None], 3, axis=1)

    def _write_pose(self, keyframe_id: int, T_map_body: Array) -> None:
        self._poses[keyframe_id] = T_map_body.copy()
        self._stream.log(_keyframe_entity(keyframe_id), _transform(T_map_body))

    def _log_keyframe_path(self, changed: list[int]) -> None:
        ids = list(self._poses)  # in order of arrival
        index = {keyframe_id: k for k, keyframe_id in enumerate(ids)}
        positions = [self._poses[keyframe_id][:3, 3] for keyframe_id in ids]
        pieces = {max(index[keyframe_id] - back, 0) // _PIECE for keyframe_id in changed for back in (0, 1)}
        for piece in sorted(pieces):
            self._log_piece("graph", positions, piece)

    def _log_piece(self, name: str, path: list[Array], piece: int) -> None:
        points = path[piece * _PIECE : (piece + 1) * _PIECE + 1]  # one more, so that the pieces join
        if len(points) > 1:
            self._stream.log(f"world/paths/{name}/{piece}", _line(np.array(points), name))

    def _log_loops(self, decision: LoopDecision) -> None:
        pairs = [(a, b) for a, b in self._loops.get(decision, []) if a in self._poses and b in self._poses]
        if pairs:
            strips = np.array([[self._poses[a][:3, 3], self._poses[b][:3, 3]] for a, b in pairs])
            lines = rr.LineStrips3D(
                strips.astype(np.float32), colors=_COLORS[decision.value], radii=rr.Radius.ui_points(1)
            )
            self._stream.log(f"world/loops/{decision.value}", lines)

    def _blueprint(self) -> Any:
        return layout(_CAMERA, list(self._groups), self._has_loop_pictures, self._eye())

    def _eye(self) -> Any:
        """Return a point of view from which everything travelled so far is seen."""
        if not self._poses:
            return None
        positions = np.array([T[:3, 3] for T in self._poses.values()])
        centre = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
        extent = max(float(np.linalg.norm(np.ptp(positions, axis=0))), 2.0)
        up, back = self._axes()
        return rrb.EyeControls3D(position=centre + extent * (1.4 * back + 1.2 * up), look_target=centre, eye_up=up)

    def _axes(self) -> tuple[Array, Array]:
        """Return where up is in the map, and from which side to look at it."""
        up, back = np.array([0.0, 0.0, 1.0]), np.array([-0.6, -0.8, 0.0])
        if self._rig is None or not self._poses:
            return up, back
        first = next(iter(self._poses.values()))[:3, :3] @ self._rig.T_body_cams[0][:3, :3]
        if -first[2, 1] < 0.3:  # without an IMU the map lies as the first camera did: look from behind it
            return -first[:, 1], -first[:, 2]
        return up, back


def finished(stream: Any, path: Path) -> str | None:
    """Finish a recording; return why it is cut short, None when it is whole.

    Rerun may wait for ever where the disk is full: it is left alone where the file has not grown for a while.
    """
    said: list[str] = []

    def finish() -> None:
        try:
            stream.flush()
        except RuntimeError as error:
            said.append(str(error))
        stream.disconnect()

    thread = threading.Thread(target=finish, name="rerun", daemon=True)
    thread.start()
    size, still_s = -1, 0.0
    while thread.is_alive() and still_s < _STILL_S:
        thread.join(_LOOK_S)
        now = path.stat().st_size if path.exists() else 0
        size, still_s = now, still_s + _LOOK_S if now == size else 0.0
    if thread.is_alive():
        said.append(f"nothing was written for {_STILL_S:g} s")
    return f"{path.name} is cut short: {said[0]}; free disk space" if said else None


def _picture(frame: Frame, rig: Rig | None) -> ImageU8 | None:
    """Return the image to show; grey paper for a frame that brought tracks only, None when its size is not known."""
    if frame.color is not None or frame.images:
        return frame.color if frame.color is not None else frame.images[0]
    if rig is None:
        return None
    return np.full((rig.cameras[0].height, rig.cameras[0].width), _PAPER_GREY, dtype=np.uint8)


def _keyframe_entity(keyframe_id: int) -> str:
    return f"world/map/kf_{keyframe_id}"


def _transform(T: Array) -> Any:
    return rr.Transform3D(translation=T[:3, 3], quaternion=quaternion_xyzw_from_rotation(T[:3, :3]))


def _line(positions: Array, name: str) -> Any:
    color = _COLORS.get(name, _OTHER_COLOR)
    return rr.LineStrips3D([positions.astype(np.float32)], colors=color, radii=rr.Radius.ui_points(1.5))


def _visibly_moved(old: Array, new: Array) -> bool:
    if np.linalg.norm(new[:3, 3] - old[:3, 3]) > _MOVED_M:
        return True
    # trace of a rotation: 1 + 2 cos(angle)
    return bool(np.sum(old[:3, :3] * new[:3, :3]) < 1.0 + 2.0 * np.cos(_MOVED_RAD))


def _age_colors(ages: Array) -> ImageU8:
    """Return RGB [N, 3] from orange (new track) to green (old track)."""
    share = np.clip(ages / _OLD_TRACK_FRAMES, 0.0, 1.0)[:, None]
    colors: ImageU8 = ((1 - share) * (230, 126, 34) + share * (60, 200, 110)).astype(np.uint8)
    return colors


def _depth_grid(depth_m: Any, wanted: int, max_range_m: float) -> tuple[Array, Array]:
    """Return about `wanted` pixels [N, 2] of a regular grid with valid depths [N]."""
    step = max(int(np.sqrt(depth_m.size / wanted)), 1)
    rows, columns = np.mgrid[step // 2 : depth_m.shape[0] : step, step // 2 : depth_m.shape[1] : step]
    depth = depth_m[rows, columns].astype(np.float64)
    valid = (depth > 0.0) & (depth <= max_range_m)  # NaN is neither
    return np.stack([columns[valid], rows[valid]], axis=1).astype(np.float64), depth[valid]
