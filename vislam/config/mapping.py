"""Defaults of dense maps and of maps to drive by."""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, slots=True)
class DriveConfig:
    """Where the cart can stand and drive, from the octree."""

    body_length_m: float = 0.60  # of the cart, whose middle is the body's origin
    body_width_m: float = 0.50
    max_step_m: float = 0.05  # between neighbouring cells; less than a voxel is taken for one, which is what is seen
    max_slope_deg: float = 10.0  # what a cart with small wheels and a load brakes on
    slope_window_m: float = 0.40  # slope is that of a plane through the ground within it: a voxel's step is no slope


MapProduct = Literal["cloud", "pcd", "octomap", "ot", "grid", "drive", "mesh", "glb", "obj", "poisson", "surfels"]


@dataclass(frozen=True, slots=True)
class MonoDepthConfig:
    """Dense depth from one camera: a filter per pixel of a keyframe, fed by the frames that follow it."""

    enabled: bool = False  # where the front end has one camera
    scale: float = 0.5  # of the images; the time goes with its square
    measure: Literal["sad", "ssd", "ncc", "zsad", "zssd", "zncc"] = "zncc"  # those with z do not mind exposure
    fusion: Literal["gaussian", "beta"] = "beta"  # gaussian: the slambook's; beta knows a share of false matches
    step_px: float = 0.7  # along the epipolar line; patches of 7 px change little over that
    reach_px: float = 100.0  # searched to both sides of where a pixel is expected; bounds its time
    search_sigmas: float = 3.0  # of inverse depth, to both sides
    least_score: float | None = None  # of a match; None: the measure's own, see mapping/monodepth/matching.py
    uniqueness: float = 0.8  # most that the best match's cost may be of the next one's; 1 asks for nothing
    sigma_px: float = 1.0  # of a match along the epipolar line
    min_gradient: float = 2.0  # grey levels per px, rms over the patch along the epipolar line; noise gives less
    max_sigma_ratio: float = 4.0  # of a measurement over what is known; beyond, it is not worth a search
    converged: float = 0.02  # sigma of inverse depth over its mean; on TUM fr1_desk 0.01 finds a quarter less
    min_matches: int = 3
    max_misses: int = 6  # more than matches by so many: hidden, moving or too alike, and not searched any more
    min_good: float = 0.6  # share of good measurements (REMODE); half of it, and the pixel has failed
    min_depth_m: float = 0.3  # nearer, frames share too little
    max_depth_m: float = 20.0
    derotate_deg: float = 1.5  # patches that are turned by more match worse than ones interpolated twice
    handover_sigma: float = 0.05  # of inverse depth that the next keyframe takes over; it measures anew
    smoothing: int = 10  # steps of smoothing inside surfaces; 0: none
    frames_per_keyframe: int = 6  # used between two keyframes, the newer one included; bounds the time
    keyframes: int = 3  # later ones that feed a keyframe before the next is begun; more parallax, fewer depth images
    min_overlap: float = 0.5  # of the image that later ones must still see; less, and the next is begun at once
    max_range_m: float = 8.0  # farther points only clear the way
    threads: int = 2  # the result does not depend on it


@dataclass(frozen=True, slots=True)
class MapConfig:
    """Clouds, the occupancy octree, the navigation grid and the mesh."""

    enabled: bool = True
    resolution_m: float = 0.05  # octree voxel and grid cell; fine enough for table edges, 8 ms per keyframe
    insertion: Literal["discretised", "full"] = "discretised"  # one ray per end voxel; full: one per pixel, 10x dearer
    hit_probability: float = 0.7  # OctoMap's
    miss_probability: float = 0.32  # OctoMap's 0.4 is for 10 scans a second; of keyframes, at 2 Hz and more, with the
    clamp_max_probability: float = 0.9  # clamping here, three clear a voxel: a person who left is gone within 1 s
    clamp_min_probability: float = 0.1192  # OctoMap's: what was free for long is occupied after three scans
    min_range_m: float = 0.3  # nearer, structured-light depth and stereo matching are not valid
    max_range_m: float = 4.0  # depth noise grows with the square; farther points only clear the way to here
    pixel_step: int = 2  # keep every n-th row and column of a depth image; at 4 m still 3 pixels per voxel
    edge_ratio: float = 0.03  # a step to a neighbour pixel of more than this share of depth is an object's border
    edge_px: int = 2  # pixels left out on both sides of such a border, where sensors mix near and far
    speckle_pixels: int = 40  # smaller connected surfaces, in kept pixels, are noise
    stereo_scale: float = 0.5  # image scale for dense stereo; 15 to 30 ms per keyframe, at 1.0 five times that
    stereo_disparity_sigma_px: float = 0.2  # of semi-global matching at that scale
    stereo_max_range_m: float = 10.0  # as max_range_m, for dense stereo
    stereo_max_sigma_m: float = 0.25  # farther stereo points, with a larger error of depth, only clear the way
    move_voxels: float = 1.0  # a keyframe corrected by more than this many voxels is integrated again
    move_deg: float = 1.0  # or turned by more than this: 7 cm at 4 m
    rebuild_keyframes_per_call: int = 8  # that cast rays again in one call while a correction is followed; 3 ms each
    cloud_voxel_m: float = 0.015  # one averaged point per voxel in cloud.ply
    cloud_max_points: int = 1_500_000  # a larger cloud gets larger voxels: 22 MB
    cloud_min_points: int = 4  # depth pixels that must lie in an octree voxel for its points to stay in the cloud
    cloud_neighbours: int = 12  # statistical outlier removal: mean distance to so many neighbours
    cloud_outlier_sigma: float = 2.5  # may exceed the average by so many standard deviations
    grid_floor_m: float | None = None  # height of the floor in map; None: the lowest large horizontal surface
    grid_low_m: float = 0.10  # above the floor: lower things are driven over or are the floor's own noise
    grid_high_m: float = 1.60  # above the floor: higher things are driven under
    drive: DriveConfig = field(default_factory=DriveConfig)
    mesh_voxel_m: float = 0.02  # about the noise of depth at 3 m
    mesh_min_views: int = 2  # keyframes that must have seen a surface; with depth from one camera one is enough
    surfel_m: float = 0.02  # between surfels
    surfel_min_views: int = 2  # keyframes that must have seen a surfel; what one alone saw may be noise
    poisson_depth: int = 9  # levels of Poisson's octree: cells of 2 cm in a room of 10 m
    # what is written into map/; mesh, glb, obj and poisson need Open3D and take seconds, surfels too
    products: tuple[MapProduct, ...] = ("cloud", "octomap", "grid", "drive")
    mono_depth: MonoDepthConfig = field(default_factory=MonoDepthConfig)
