"""The mapper: keyframes in, corrections followed, maps out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.config import MapConfig
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.geometry import are_rigid
from vislam.core.memory import PackedScan
from vislam.core.messages import Array, GraphUpdate, Keyframe, Submaps
from vislam.mapping.cloud.cloud import Cloud, VoxelAverage, voxel_filter, without_outliers
from vislam.mapping.cloud.mesh import Mesh, fuse_mesh
from vislam.mapping.cloud.smooth import smoothed
from vislam.mapping.cloud.store import KeyframeStore, Scan
from vislam.mapping.cloud.surfels import SurfelMap, Surfels
from vislam.mapping.dense.refine import refined_poses
from vislam.mapping.depth.extract import ScanExtractor
from vislam.mapping.depth.image import DepthView, surface_points
from vislam.mapping.depth.mono import LateDepth
from vislam.mapping.drive.drive_grid import DriveGrid, DriveMap
from vislam.mapping.drive.grid import Grid, floor_height_m, navigation_grid
from vislam.mapping.file_names import LEVEL, SURFACES, NotLevel
from vislam.mapping.mesh.posed import PosedView, posed_views
from vislam.mapping.mesh.volume import Volume
from vislam.mapping.octree import CorrectedOccupancy, Occupancy, Octree, OctreeLeaves
from vislam.mapping.products import remove_products, write_products
from vislam.mapping.semantic.classes import LabelClasses
from vislam.mapping.semantic.fusion import LabelFusion
from vislam.mapping.semantic.layer import LabelLayer
from vislam.mapping.upright import View, view_of

_RIGID_TOLERANCE = 1e-4
_MAX_COLOURED_VOXELS = 1 << 22  # of the octree; more, and neighbours share a colour
_MOST_CLOUD_POINTS = 1_500_000  # a larger cloud gets larger voxels: 22 MB
_MOST_VIEWS = 200  # keyframes that are asked for the directions of surfaces; 10 ms each


class Mapper:
    """Keeps every keyframe's geometry in its own frame, and the maps made of it at the poses the graph gives."""

    def __init__(
        self, config: MapConfig, rig: Rig, one_camera: bool = False, names: LabelClasses | None = None
    ) -> None:
        """Prepare for a rig; with `one_camera` only cam0 counts, and depth comes by `add_depth`.

        `names` say what the labels of keyframes mean, where they have some. Raises DataError when the settings or the
        rig cannot make a map.
        """
        self._config = config
        self._rig = rig
        self._one_camera = one_camera
        self._extractor = ScanExtractor(config, rig, one_camera)
        self._store = KeyframeStore(self._extractor.view.size)
        self._occupancy = CorrectedOccupancy(config, self._store, self._extractor.view)
        self._drive = DriveMap(config)
        self._surfels = SurfelMap(config.surfel_m)
        self._labels = LabelFusion(config.resolution_m, config.labels, names or LabelClasses())
        self._submaps = Submaps()
        self._apart: dict[int, Array] = {}  # newest poses of keyframes in submaps that no loop has joined with the map
        self.refinement: dict[str, Any] = {}  # what `refined` found; empty where it was not asked
        self.notes: dict[str, str] = {}  # what was left out of an export, and why

    @property
    def counters(self) -> dict[str, int]:
        """What went in, what had no depth, and how often the map was rebuilt."""
        return {**self._extractor.counters, **self._occupancy.counters, "store_bytes": self._store.nbytes}

    @property
    def occupancy(self) -> Octree:
        """The occupancy map as it is now, for the thread that feeds the mapper.

        A new keyframe goes into it; a correction leaves it alone, and puts another in its place when complete.
        """
        return self._occupancy.occupancy

    def snapshot(self) -> Octree:
        """Return a copy of the occupancy map for other threads, which nothing changes and for which no thread waits.

        The thread that feeds the mapper calls this and hands the copy on.
        """
        return self._occupancy.occupancy.copy()

    def add(self, keyframe: Keyframe, T_map_body: Array, labels: NDArray[np.integer] | None = None) -> None:
        """Integrate a keyframe at its pose [4, 4], after the `move` that knows its submap.

        `labels` [H, W] are ids of what its first image shows, 0: unknown; they may be coarser by a whole factor.

        Where no loop has joined that submap with the oldest one, it waits outside of the map, for its pose there means
        nothing. Raises DataError on a pose that is not rigid, an id seen before, or images or labels of another size
        than the camera's.
        """
        T = _rigid(T_map_body, keyframe.id)
        scan = self._extractor.extract(keyframe, labels)
        if self._one_camera and labels is not None:
            self._labels.wait(keyframe.id, self._extractor.on_rays(labels))
        if scan is None:
            return
        self._store.add(keyframe.id, keyframe.t_ns, scan)
        self._place(keyframe.id, scan, T)

    def add_depth(self, late: LateDepth) -> None:
        """Integrate depth that became known after its keyframe.

        Raises DataError on a pose that is not rigid, a keyframe that has depth already, or depth of another size than
        the mapper's rays.
        """
        T = _rigid(late.T_map_body, late.keyframe_id)
        scan = self._extractor.late(late.depth_m, late.image, self._labels.waited_for(late.keyframe_id))
        self._store.add(late.keyframe_id, late.t_ns, scan)
        self._place(late.keyframe_id, scan, T)

    def packed(self, keyframe_id: int) -> PackedScan | None:
        """Return what is kept of a keyframe's geometry, None if there was none."""
        return self._store.packed(keyframe_id)

    def restore(self, scans: dict[int, PackedScan], T_map_body: dict[int, Array]) -> None:
        """Take over keyframes of an earlier run at their poses; they come into the map little by little, with `move`.

        Raises DataError when one has no pose, or one that is not rigid.
        """
        ids = sorted(scans)
        unplaced = [i for i in ids if i not in T_map_body]
        if unplaced:
            raise DataError(f"keyframe {unplaced[0]} has a scan, but no pose; run the recording again")
        _check_rigid(np.array([T_map_body[i] for i in ids]), np.array(ids))
        for i in ids:
            self._store.put(i, scans[i])
        self._apart |= {i: np.array(T_map_body[i], dtype=np.float64) for i in ids}
        self._sort()

    def move(self, update: GraphUpdate) -> None:
        """Take over corrected poses, and re-integrate a bounded number of keyframes if some moved by a voxel.

        Keyframes of submaps that were joined come into the map so, and those of submaps that came apart leave it.
        Raises DataError, and changes nothing, when a pose is not rigid.
        """
        _check_rigid(np.asarray(update.T_map_body, dtype=np.float64), update.ids)
        self._occupancy.move(update.ids, update.T_map_body)
        for keyframe_id, T in zip(update.ids.tolist(), update.T_map_body, strict=True):
            if keyframe_id in self._apart:
                self._apart[keyframe_id] = np.array(T, dtype=np.float64)
        if update.submaps != self._submaps:
            self._submaps = update.submaps
            self._sort()
        self._occupancy.advance(self._config.rebuild_keyframes_per_call)

    def finish(self) -> None:
        """Bring the map to exactly the newest poses, whatever it takes."""
        self._occupancy.finish()

    def keyframe_cloud(self, keyframe_id: int, voxel_m: float = 0.04) -> Cloud:
        """Return one keyframe's points in its body frame, one per voxel; empty if it has none."""
        if keyframe_id not in self._store:
            return Cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
        return voxel_filter(_points(self._store.scan(keyframe_id), self._extractor.view, np.eye(4)), voxel_m)

    def cloud(self) -> Cloud:
        """Return all keyframes' points fused in the map frame, without what lies in free space and without outliers."""
        config, view = self._config, self._extractor.view
        average, sparse_only = _averaged(
            self._scans(), view, config.min_range_m, config.cloud_voxel_m, _MOST_CLOUD_POINTS
        )
        fused = average.cloud() if sparse_only else average.cloud(config.cloud_min_points, config.resolution_m)
        del average  # it is many times as large
        # what later rays passed through was a moving thing or a false match
        fused = fused.select(self.occupancy.state_at(fused.points_m) != Occupancy.FREE)
        kept = without_outliers(fused, config.cloud_outlier_sigma, config.resolution_m)
        return smoothed(kept, config.cloud_smooth_m)

    def coloured_octree(self) -> OctreeLeaves:
        """Return the octree of log-odds; occupied leaves have the mean colour of what keyframes saw in them."""
        octree = self.occupancy.leaves()
        view, config = self._extractor.view, self._config
        average, _ = _averaged(self._scans(), view, config.min_range_m, config.resolution_m, _MAX_COLOURED_VOXELS)
        points = average.cloud()
        points = points.select(octree.log_odds_at(points.points_m) >= 0.0)
        return octree.with_colors(points.points_m, points.colors)

    def grid(self) -> Grid:
        """Return the navigation grid of the occupancy map."""
        octree = self.occupancy.max_likelihood_leaves()
        floor_m = self._config.grid_floor_m
        floor_m = floor_height_m(octree) if floor_m is None else floor_m
        return navigation_grid(octree, floor_m, self._config.grid_low_m, self._config.grid_high_m)

    def drive(self) -> DriveGrid:
        """Return where a cart can drive; only columns of the map that changed since the last call are read again."""
        return self._drive.update(self.occupancy)

    def mesh(self) -> tuple[Mesh | None, str]:
        """Return the mesh of all keyframes with dense depth, or None and the reason there is none."""
        config = self._config
        # depth from one camera is what several frames agree on: one keyframe is enough
        is_false = None if self._one_camera else self._is_seen_through
        return fuse_mesh(self.posed_views, config.mesh_voxel_m, config.mesh_max_blocks, is_false)

    def posed_views(self) -> Iterator[PosedView]:
        """Return what keyframes with dense depth saw, at their poses."""
        return posed_views(self._scans(), self._extractor.view)

    def surfels(self) -> Surfels:
        """Return the surfels that enough keyframes saw, without what lies in free space.

        Only keyframes that are new since the last call are looked at; those that were moved take their surfels along.
        """
        for keyframe_id in self._occupancy.poses:
            if keyframe_id not in self._surfels:
                self._surfels.add(keyframe_id, self._store.labelled(keyframe_id), self._extractor.view)
        surfels = self._surfels.surfels(self._occupancy.poses)
        surfels = surfels.select(surfels.views >= self._config.surfel_min_views)
        return surfels.select(self.occupancy.state_at(surfels.points_m) != Occupancy.FREE)

    def labels(self) -> LabelLayer | None:
        """Return the labels of the occupied voxels at the newest poses; None where no keyframe has labels."""
        if not self._store.has_labels:
            return None
        return self._labels.layer(self._occupancy.poses, self._store, self._extractor.view, self.occupancy)

    def turned(self, T: Array) -> Mapper:
        """Return a map of the same keyframes with all poses moved by T [4, 4], rebuilt: voxels cannot be turned."""
        if np.array_equal(T, np.eye(4)):
            return self
        poses = {i: T @ pose for i, pose in sorted((self._occupancy.poses | self._apart).items())}
        return self._made_again(poses, self._submaps)

    def refined(self) -> Mapper:
        """Return the map at poses that fit depth images to each other, itself where that is no gain or not asked for.

        It is where a surface is among the products. What was found is in `refinement`. Keyframes of submaps that are
        not joined with the map stay where they are.
        """
        # the noise of depth that it assumes is that of a depth sensor
        is_asked = self._config.refine_poses and not set(SURFACES).isdisjoint(self._config.products)
        if not is_asked or not self._rig.has_depth or self._one_camera:
            return self
        poses, self.refinement = refined_poses(self._store, self._occupancy.poses, self._extractor.view)
        if not poses:
            return self
        other = self._made_again(poses | self._apart, self._submaps)
        other.refinement = self.refinement
        return other

    def views(self, reach: int) -> list[View]:
        """Return the directions of surfaces that keyframes with depth saw, evenly over a long run, by `view_of`."""
        poses, view = self._occupancy.poses, self._extractor.view
        R_body_cam = self._rig.T_body_cams[0][:3, :3]
        scans = ((poses[i], self._store.geometry(i).depth) for i in sorted(poses)[:: 1 + len(poses) // _MOST_VIEWS])
        return [view_of(depth, view, T[:3, :3], R_body_cam, reach) for T, depth in scans if depth is not None]

    def export(
        self, folder: Path, step: Callable[[str], None] | None = None, not_level: NotLevel = LEVEL
    ) -> dict[str, Path]:
        """Write the configured products of the map; return what was written, and note what could not be.

        Keyframes of submaps that are not joined with the map get one of their own, in a folder `submap_N`. Each file is
        replaced whole. Where z may not be up, `not_level` is the reason, and grids are left out. `step` is called
        with the name of each product before it is made. Raises StorageError when one cannot be written.
        """
        written, self.notes = write_products(self, folder, self._config, step, not_level.map)
        layers = self._layers()
        for old in sorted(folder.glob("submap_*")):
            if old.name not in layers:
                remove_products(old)
        for name, layer in layers.items():
            files, _ = write_products(layer, folder / name, self._config, not_level=not_level.submaps)
            written |= {f"{name}_{product}": path for product, path in files.items()}
            self.notes[f"{name} in the map"] = (
                f"no loop joined these {len(layer._store.ids)} keyframes with it; {folder.name}/{name} is their own"
            )
        self.notes |= self._labels.notes
        if left_out := self._occupancy.left_out:
            self.notes[f"occupancy of {len(left_out)} keyframes"] = next(iter(left_out.values()))
        return written

    def _place(self, keyframe_id: int, scan: Scan, T_map_body: Array) -> None:
        if self._submaps.group(keyframe_id) == 0:
            self._occupancy.add(keyframe_id, scan, T_map_body)
        else:
            self._apart[keyframe_id] = T_map_body

    def _sort(self) -> None:
        """Take keyframes in and out of the map by what is joined with the oldest submap now."""
        submaps = self._submaps
        joined = {i: T for i, T in self._apart.items() if submaps.group(i) == 0}
        apart = {i: T for i, T in self._occupancy.poses.items() if submaps.group(i) != 0}
        self._apart = {i: T for i, T in self._apart.items() if i not in joined} | apart
        if joined:
            self._occupancy.enter(joined)
        if apart:
            self._occupancy.leave(apart)

    def _layers(self) -> dict[str, Mapper]:
        """Return the maps of the submaps that are not joined with the map, complete, by name."""
        groups = _by_group(self._apart, self._submaps)
        return {f"submap_{number}": self._made_again(poses, Submaps()) for number, poses in groups.items()}

    def _made_again(self, poses: dict[int, Array], submaps: Submaps) -> Mapper:
        """Return the complete map of some keyframes at other poses."""
        other = Mapper(self._config, self._rig, self._one_camera, self._labels.classes)
        other._submaps = submaps
        other.restore({i: scan for i in poses if (scan := self._store.packed(i)) is not None}, poses)
        other.finish()
        return other

    def _is_seen_through(self, volume: Volume, points_m: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return which vertices of a mesh [N, 3] few keyframes saw and rays passed through: moving, or noise."""
        few = volume.views_of(points_m) < self._config.mesh_min_views
        few[few] = self.occupancy.state_at(points_m[few]) == Occupancy.FREE
        return few

    def _scans(self) -> Iterator[tuple[Scan, Array]]:
        for keyframe_id, T_map_body in self._occupancy.poses.items():
            yield self._store.scan(keyframe_id), T_map_body


def _averaged(
    scans: Iterable[tuple[Scan, Array]], view: DepthView, min_range_m: float, voxel_m: float, max_points: int
) -> tuple[VoxelAverage, bool]:
    """Return the average of all keyframes' points in each voxel, and whether none of them has dense depth."""
    average = VoxelAverage(voxel_m, max_points)
    sparse_only = True
    for scan, T in scans:
        sparse_only = sparse_only and scan.depth is None
        points = _points(scan, view, T)
        seen_from = (T @ view.T_body_view)[:3, 3].astype(np.float32)
        squared_m2 = np.maximum(np.sum((points.points_m - seen_from) ** 2, axis=1), min_range_m**2)
        # depth from disparity, structured light included, errs with the square of range: weight 1 / sigma^2
        average.add(points, (1.0 / squared_m2**2).astype(np.float32))
    return average, sparse_only


def _points(scan: Scan, view: DepthView, T_frame_body: Array) -> Cloud:
    if scan.depth is not None:
        points, pixels = surface_points(scan.depth, view, T_frame_body)
        return Cloud(points, scan.colors.reshape(-1, 3)[pixels])
    if scan.points_body_m is None:
        return Cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    points_body = scan.points_body_m.astype(np.float64)
    return Cloud((points_body @ T_frame_body[:3, :3].T + T_frame_body[:3, 3]).astype(np.float32), scan.colors)


def _by_group(poses: dict[int, Array], submaps: Submaps) -> dict[int, dict[int, Array]]:
    """Return the poses of each group of submaps, by its number."""
    groups = sorted({submaps.group(i) for i in poses})
    return {number: {i: T for i, T in poses.items() if submaps.group(i) == number} for number in groups}


def _rigid(T_map_body: Array, keyframe_id: int) -> Array:
    """Return a copy of a keyframe's pose [4, 4]; raises DataError when it is not a rigid transform."""
    T = np.array(T_map_body, dtype=np.float64)
    _check_rigid(T[None], np.array([keyframe_id]))
    return T


def _check_rigid(T: Array, keyframe_ids: NDArray[np.int64]) -> None:
    """Raise DataError when one of the poses [M, 4, 4] is not a rigid transform."""
    if len(keyframe_ids) == 0:
        return
    if T.shape != (len(keyframe_ids), 4, 4):
        raise DataError(
            f"the map pose of keyframe {keyframe_ids[0]} is not a rigid transform: its shape is {T.shape[1:]}"
        )
    rigid = are_rigid(T, _RIGID_TOLERANCE)
    if not rigid.all():
        first = int(np.flatnonzero(~rigid)[0])
        raise DataError(f"the map pose of keyframe {keyframe_ids[first]} is not a rigid transform: {T[first].tolist()}")
