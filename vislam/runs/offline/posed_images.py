"""What the images of a run saw: their cameras at its poses, and points by triangulation of the tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.batch.bundle.rays import Tracks, angle_per_px, summed, triangulate
from vislam.config import FrontEndConfig
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.messages import Array, KeyframePacket
from vislam.mapping.semantic.images import camera_t_ns
from vislam.runs.levelled import stored_level
from vislam.runs.offline.rebuild import keyframe_poses, stored_submaps
from vislam.runs.session import Session

Ints = NDArray[np.int64]

_STEPS = 8
_ROUNDS = 3  # of triangulation without what the round before has shown to be no image of the point
_MAX_ERROR_PX = 4.0  # COLMAP's own (filter_max_reproj_error)
_MAX_RELATIVE_SIGMA = 0.1  # of distance: beyond it the rays do not say where the point is


@dataclass(frozen=True, slots=True, eq=False)
class PosedImages:
    """Images [V] of keyframes, and points [P] that at least two of them saw, by observations [N] sorted by image."""

    cameras: tuple[Camera, ...]
    keyframe: Ints  # [V] ids
    camera: Ints  # [V] which camera of the rig took it
    camera_t_ns: Ints  # [V] stamps by the camera's own clock
    T_map_cam: Array  # [V, 4, 4]
    image: Ints  # [N]
    point: Ints  # [N]
    pixels_px: Array  # [N, 2]
    points_m: Array  # [P, 3] in map
    apart: int  # keyframes of submaps that no loop has joined, which are left out

    def errors_px(self) -> Array:
        """Return how far from its pixel each point is seen [N]."""
        seen, _, _ = self.seen()
        return np.asarray(np.linalg.norm(seen - self.pixels_px, axis=1))

    def mean_errors_px(self) -> Array:
        """Return the mean of these of each point [P]."""
        counts = np.bincount(self.point, None, len(self.points_m))
        return np.asarray(np.bincount(self.point, self.errors_px(), len(self.points_m)) / counts)

    def seen(self) -> tuple[Array, Array, Array]:
        """Return where points are seen [N, 2], NaN behind the camera, the derivatives [N, 2, 3], and z in it [N]."""
        R, centre = self.T_map_cam[self.image, :3, :3], self.T_map_cam[self.image, :3, 3]
        points = np.einsum("nji,nj->ni", R, self.points_m[self.point] - centre)
        pixels, J = np.empty((len(points), 2)), np.empty((len(points), 2, 3))
        for i, camera in enumerate(self.cameras):
            mine = self.camera[self.image] == i
            pixels[mine], J[mine] = camera.project(points[mine]), camera.project_jacobian(points[mine])
        return pixels, J @ R.transpose(0, 2, 1), points[:, 2]

    def undistorted(self) -> PosedImages:
        """Return the same for pinhole cameras of the same size, focal lengths and centre."""
        cameras = tuple(replace(c, skew_px=0.0, distortion="none", coefficients=()) for c in self.cameras)
        pixels = self.pixels_px.copy()
        for i, (camera, plain) in enumerate(zip(self.cameras, cameras, strict=True)):
            mine = self.camera[self.image] == i
            pixels[mine] = plain.project(camera.unproject(pixels[mine]))
        return replace(self, cameras=cameras, pixels_px=pixels)


def posed_images(run: Path, poses: str = "graph") -> PosedImages:
    """Return the images of the keyframes of a run, at the poses of its graph or of `trajectory_NAME.tum`.

    Raises UsageError for a trajectory that is not there, DataError when the session cannot be used.
    """
    with Session(run / "session.db") as session:
        info = session.info()
        rig, config = session.rig(), session.config().frontend
        if rig.is_blind:
            raise DataError(f"{run} was run without a camera: it has no images")
        placed = keyframe_poses(session, run, poses, stored_level(info).T_level_map)
        packets = [p for p in session.packets() if p.keyframe.id in placed and len(p.observations.track_ids)]
        submaps = stored_submaps(session)
    groups = [submaps.group(p.keyframe.id) for p in packets]
    largest = max(groups, key=groups.count, default=0)
    joined = [p for p, group in zip(packets, groups, strict=True) if group == largest]
    if not joined:
        raise DataError(f"{run} has no keyframe that saw anything; run the recording again")
    return _triangulated(joined, rig, config, placed, len(packets) - len(joined))


def _triangulated(
    packets: list[KeyframePacket], rig: Rig, config: FrontEndConfig, placed: dict[int, Array], apart: int
) -> PosedImages:
    count = len(rig.cameras)
    keyframe = np.repeat([p.keyframe.id for p in packets], count).astype(np.int64)
    stamps = np.repeat([camera_t_ns(p.keyframe.t_ns, p.time_offset_s) for p in packets], count)
    T_map_cam = np.array([placed[p.keyframe.id] @ T for p in packets for T in rig.T_body_cams])
    tracks, pixels = _tracks(packets, rig, config)
    images = rig.cameras, keyframe, np.tile(np.arange(count), len(packets)), stamps, T_map_cam
    keep = np.ones(len(tracks), dtype=bool)
    for _ in range(_ROUNDS):
        places = triangulate(tracks, keep, T_map_cam, config.track_sigma_px)
        keep &= (places.relative_sigma <= _MAX_RELATIVE_SIGMA)[tracks.point]
        found = PosedImages(*images, tracks.keyframe[keep], tracks.point[keep], pixels[keep], places.points_m, apart)
        found = _refined(found, tracks.rho[keep], config)
        good = np.zeros(len(tracks), dtype=bool)
        good[keep] = found.errors_px() <= _MAX_ERROR_PX
        keep = good & (np.bincount(tracks.point[good], minlength=tracks.points) >= 2)[tracks.point]
    used, point = np.unique(tracks.point[keep], return_inverse=True)
    found = PosedImages(
        *images, tracks.keyframe[keep], point.astype(np.int64), pixels[keep], found.points_m[used], apart
    )
    return _refined(found, tracks.rho[keep], config)


def _refined(found: PosedImages, rho: Array, config: FrontEndConfig) -> PosedImages:
    """Return the same with points where the squares of pixels and measured inverse depths are least: Levenberg's steps.

    Each point takes its own steps, for the poses stay as they are.
    """
    count, point = len(found.points_m), found.point
    weight = np.where(np.isfinite(rho), config.track_sigma_px / config.depth_sigma_rho, 0.0)  # px m
    damping = np.full(count, 1e-8)

    def squares(at: PosedImages) -> tuple[Array, Array, Array]:
        pixels, J, z = at.seen()
        r = np.column_stack([pixels - at.pixels_px, weight * (1.0 / z - np.nan_to_num(rho))])
        by_rho = -(weight / z**2)[:, None] * at.T_map_cam[at.image, :3, 2]
        J = np.concatenate([J, by_rho[:, None, :]], axis=1)
        return np.asarray(np.bincount(point, np.einsum("ni,ni->n", r, r), count), np.float64), r, J

    cost, r, J = squares(found)
    for _ in range(_STEPS):
        H = summed(np.einsum("nij,nik->njk", J, J).reshape(-1, 9), point, count).reshape(-1, 3, 3)
        g = summed(np.einsum("nij,ni->nj", J, r), point, count)
        ridge = damping * np.trace(H, axis1=1, axis2=2) + 1e-12
        step = np.linalg.solve(H + ridge[:, None, None] * np.eye(3), g[:, :, None])[:, :, 0]
        tried = replace(found, points_m=found.points_m - step)
        better = squares(tried)[0] < cost  # nor where it is NaN, behind a camera
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        found = replace(found, points_m=np.where(better[:, None], tried.points_m, found.points_m))
        cost, r, J = squares(found)
    return found


def _tracks(packets: list[KeyframePacket], rig: Rig, config: FrontEndConfig) -> tuple[Tracks, Array]:
    """Return what each image saw, where `keyframe` counts images, and the pixels [N, 2]."""
    image: list[Ints] = []
    ids: list[Ints] = []
    pixels: list[Array] = []
    rho: list[Array] = []
    for i, packet in enumerate(packets):
        seen = packet.observations
        sides = [seen.pixels_px] if seen.right_px is None or not rig.is_stereo else [seen.pixels_px, seen.right_px]
        of_cameras = [(side, seen.track_ids, px) for side, px in enumerate(sides)]
        of_cameras += [(further.camera, further.track_ids, further.pixels_px) for further in seen.further]
        for side, track_ids, px in of_cameras:  # depth of a stereo pair is what its pixels say
            is_deep = len(sides) == 1 and side == 0
            depth = seen.depth_m if is_deep and seen.depth_m is not None else np.full(len(px), np.nan)
            image.append(np.full(len(px), i * len(rig.cameras) + side))
            ids.append(track_ids.astype(np.int64))
            pixels.append(px.astype(np.float64))
            rho.append(1.0 / np.where(depth > 0.0, depth, np.nan))
    of_image, of_pixels, inverse = np.concatenate(image), np.concatenate(pixels), np.concatenate(rho)
    xy, sigma = np.full_like(of_pixels, np.nan), np.full(len(of_image), np.nan)
    for side, camera in enumerate(rig.cameras):
        mine = of_image % len(rig.cameras) == side
        xy[mine] = camera.normalise(of_pixels[mine])
        sigma[mine] = angle_per_px(camera, xy[mine])
    there = np.isfinite(xy).all(axis=1) & np.isfinite(sigma)
    unique, point = np.unique(np.concatenate(ids)[there], return_inverse=True)
    tracks = Tracks(
        of_image[there], of_image[there], point.astype(np.int64), xy[there], sigma[there], inverse[there],
        np.where(np.isfinite(inverse[there]), config.depth_sigma_rho, np.nan), np.zeros(there.sum()),
        np.zeros((there.sum(), 3)), len(unique),
    )  # fmt: skip
    return tracks, of_pixels[there]
