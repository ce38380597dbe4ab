"""What the viewer is shown of a run."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from vislam.core.errors import DataError, VislamError
from vislam.core.messages import Localisation, Tracking
from vislam.mapping.mapper import Mapper
from vislam.pipeline.steps import KeyframeStep, Step
from vislam.runs.viewer import NullViewer
from vislam.trajectory import Alignment, Trajectory, align, associate

if TYPE_CHECKING:
    from vislam.runs.viewer.recording import RunViewer

    Viewer = RunViewer | NullViewer


def show_step(viewer: Viewer, step: Step, mapper: Mapper | None, is_level: bool) -> None:
    """Log a step: the image with its tracks, the poses, what the back end did; `is_level` when gravity is known."""
    frame, track = step.front.frame, step.front.track
    viewer.log_frame(frame, track.observations, track.vo.tracking)
    if step.T_map_body is not None:
        viewer.log_pose("live", frame.t_ns, step.T_map_body)
    if step.front.T_odom_body is not None:
        viewer.log_pose("ekf", frame.t_ns, step.front.T_odom_body)
    viewer.log_scalars(frame.t_ns, _plotted(step))
    if step.localisation is Localisation.RELOCALISED:
        viewer.log_note(frame.t_ns, f"relocalised: submap {step.submap} of the trajectory is joined with the map")
    if track.vo.tracking in (Tracking.DEGRADED, Tracking.LOST):
        viewer.log_note(frame.t_ns, f"{track.vo.tracking}: {track.reason}")
    for keyframe in step.keyframes:
        T_map_body = keyframe.update.T_map_odom @ keyframe.odometry.T_odom_body
        viewer.log_keyframe(keyframe.odometry.packet.keyframe, T_map_body)
        viewer.move(keyframe.update)
        for candidate in keyframe.candidates:
            viewer.log_loop(candidate)
        if mapper is not None:
            _show_depth(viewer, keyframe, mapper)
    if step.keyframes and mapper is not None:
        show_map(viewer, frame.t_ns, mapper, is_level)


def show_map(viewer: Viewer, t_ns: int, mapper: Mapper, is_level: bool, is_last: bool = False) -> None:
    """Log octree and grid as they are now, if it is time for that."""
    if not viewer.wants_map(t_ns, is_last):
        return
    with suppress(DataError):  # too many voxels, or too large a grid: said where they are exported
        octree = mapper.occupancy.max_likelihood_leaves()
        viewer.log_octree(t_ns, octree.occupied_voxels(), octree.resolution_m)
        if is_level:
            grid = mapper.grid()
            viewer.log_grid(t_ns, grid.cells, grid.resolution_m, grid.origin_m, grid.floor_m)


def show_paths(viewer: Viewer, final: Trajectory, truth: Trajectory | None, alignment: Alignment) -> None:
    """Log where the run went in the end, and the truth moved onto it."""
    viewer.log_path("graph", final.positions_m)
    if truth is not None and len(final):
        with suppress(VislamError):  # too little in common: metrics say so
            pairs = associate(truth, final)
            viewer.log_path("truth", pairs.aligned(align(pairs, alignment)).estimate[:, :3, 3])


def _show_depth(viewer: Viewer, step: KeyframeStep, mapper: Mapper) -> None:
    """Log the points of keyframes whose depth did not come with the image: from two images, or from one, late."""
    if isinstance(viewer, NullViewer) or step.odometry.packet.keyframe.frame.depth_m is not None:
        return
    for keyframe_id, scan in step.scans.items():
        if scan.depth_png:
            cloud = mapper.keyframe_cloud(keyframe_id)
            viewer.log_cloud(keyframe_id, cloud.points_m, cloud.colors)


def _plotted(step: Step) -> dict[str, float]:
    """Return the numbers of a step that the viewer draws over time."""
    track, state = step.front.track, step.front.state
    values = {"tracking/inliers": float(track.vo.inliers), "tracking/parallax_px": track.median_parallax_px}
    if state is not None:
        for name, bias in (("gyro_bias_rad_s", state.gyro_bias_rad_s), ("accel_bias_m_s2", state.accel_bias_m_s2)):
            values |= {f"{name}/{axis}": float(value) for axis, value in zip("xyz", bias, strict=True)}
    return values
