"""Defaults of dense maps and of maps to drive by."""

from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from vislam.config.ranges import (
    Cell,
    Count,
    Few,
    Finite,
    NonNegative,
    Positive,
    PositiveShare,
    Probability,
    Range,
    Share,
    Whole,
)
from vislam.core.kinds import check_name


@dataclass(frozen=True, slots=True)
class DriveConfig:
    """Where the cart can stand and drive, from the octree."""

    body_length_m: Annotated[float, Range(0.01, 50.0)] = 0.60  # of the cart, whose middle is the body's origin
    body_width_m: Annotated[float, Range(0.01, 50.0)] = 0.50  # of the cart
    # between neighbouring cells; less than a voxel is taken for one, which is what is seen
    max_step_m: NonNegative = 0.05
    max_slope_deg: NonNegative = 10.0  # what a cart with small wheels and a load brakes on
    # slope is that of a plane through the ground within it: a voxel's step is no slope
    slope_window_m: Annotated[float, Range(0.0, 10.0)] = 0.40


_OwnProduct = Literal[
    "cloud", "pcd", "octomap", "ot", "grid", "drive", "mesh", "glb", "obj", "poisson", "surfels", "splats"
]
MapProduct = _OwnProduct | str  # or what a package brings: docs/extend.md


@dataclass(frozen=True, slots=True)
class MonoDepthConfig:
    """Dense depth from one camera: a filter per pixel of a keyframe, fed by the frames that follow it."""

    enabled: bool = False  # on, where the front end has one camera
    scale: PositiveShare = 0.5  # of the images; the time goes with its square
    measure: Literal["sad", "ssd", "ncc", "zsad", "zssd", "zncc"] = "zncc"  # those with z do not mind exposure
    fusion: Literal["gaussian", "beta"] = "beta"  # gaussian: the slambook's; beta knows a share of false matches
    step_px: Positive = 0.7  # along the epipolar line; patches of 7 px change little over that
    reach_px: Positive = 100.0  # searched to both sides of where a pixel is expected; bounds its time
    search_sigmas: NonNegative = 3.0  # of inverse depth, to both sides
    uniqueness: Share = 0.8  # most that the best match's cost may be of the next one's; 1 asks for nothing
    sigma_px: Positive = 1.0  # of a match along the epipolar line
    # of a match, from poses and lens, beside the error by noise and gradient (SVO, REMODE); None: `sigma_px` is all of
    # it, whatever the texture
    model_sigma_px: NonNegative | None = None
    # a reference patch whose corners turn and zoom move by more than this is warped into the image; None: never
    warp_px: NonNegative | None = 0.3
    min_gradient: NonNegative = 2.0  # grey levels per px, rms over the patch along the epipolar line; noise gives less
    max_sigma_ratio: NonNegative = 4.0  # of a measurement over what is known; beyond, it is not worth a search
    converged: Share = 0.02  # sigma of inverse depth over its mean; on TUM fr1_desk 0.01 finds a quarter less
    min_matches: Whole = 3
    max_misses: Whole = 6  # more than matches: hidden, moving or too alike, and not searched any more
    min_depth_m: NonNegative = 0.3  # nearer, frames share too little
    max_depth_m: NonNegative = 20.0
    # an image turned by more is turned back, which leaves out what does not fit; without warped patches 1.5 is good
    derotate_deg: NonNegative = 180.0
    handover_sigma: NonNegative = 0.05  # of inverse depth that the next keyframe takes over; it measures again
    keyframes: Few = 3  # later ones that feed a keyframe before the next is begun; more parallax, fewer depth images
    max_range_m: NonNegative = 8.0  # farther points only clear the way
    threads: Few = 2  # the result does not depend on it


@dataclass(frozen=True, slots=True)
class LabelConfig:
    """What things are, from label images; docs/mapping.md."""

    # label images, named by the stamps of the colour images, beside labels.toml; None: no labels
    folder: str | None = None
    thing_voxels: Count = 8  # connected voxels of one class that are a thing; fewer are stray
    cloud_colors: bool = False  # the cloud and surfels have the colours of labels, not of images


@dataclass(frozen=True, slots=True)
class MapConfig:
    """Clouds, the occupancy octree, the navigation grid and the mesh."""

    enabled: bool = True  # off: no cloud, octree or grid
    resolution_m: Cell = 0.05  # octree voxel and grid cell; fine enough for table edges, 8 ms per keyframe
    insertion: Literal["discretised", "full"] = "discretised"  # one ray per end voxel; full: one per pixel, 10x dearer
    hit_probability: Probability = 0.7  # OctoMap's
    # OctoMap's 0.4 is for 10 scans a second; of keyframes, at 2 Hz and more, with the
    miss_probability: Probability = 0.32
    # of an occupied voxel that touches what the same scan hit: the ray grazes a surface; OctoMap's is the one above
    miss_beside_probability: Probability = 0.46
    clears_at_range: bool = False  # a ray cut off at max_range_m clears the voxel that it ends in; OctoMap's does not
    clamp_max_probability: Probability = 0.9  # clamping here, three clear a voxel: a person who left is gone within 1 s
    clamp_min_probability: Probability = 0.1192  # OctoMap's: what was free for long is occupied after three scans
    min_range_m: NonNegative = 0.3  # nearer, structured-light depth and stereo matching are not valid
    max_range_m: NonNegative = 4.0  # of depth, whose noise grows with the square; farther points clear the way to here
    pixel_step: Count = 2  # keep every n-th row and column of a depth image; at 4 m still 3 pixels per voxel
    edge_px: Whole = 2  # pixels left out on both sides of such a border, where sensors mix near and far
    speckle_pixels: Whole = 40  # smaller connected surfaces, in kept pixels, are noise
    stereo_scale: PositiveShare = 0.5  # image scale for dense stereo; 15 to 30 ms per keyframe, at 1.0 five times that
    stereo_disparity_sigma_px: Positive = 0.2  # of semi-global matching at that scale
    stereo_max_range_m: NonNegative = 10.0  # as max_range_m, for dense stereo
    stereo_max_sigma_m: NonNegative = 0.25  # farther stereo points, with a larger error of depth, only clear the way
    move_voxels: NonNegative = 1.0  # a keyframe corrected by more than this many voxels is integrated again
    move_deg: NonNegative = 1.0  # or turned by more than this: 7 cm at 4 m
    rebuild_keyframes_per_call: Whole = 8  # that cast rays again in one call while a correction is followed; 3 ms each
    cloud_voxel_m: Cell = 0.015  # one averaged point per voxel in cloud.ply
    cloud_min_points: Whole = 4  # depth pixels that must lie in an octree voxel for its points to stay in the cloud
    # statistical outlier removal: standard deviations by which a mean distance to neighbours may exceed the average
    cloud_outlier_sigma: NonNegative = 2.5
    # radius of moving least squares, three voxels or more; 0: points as measured
    cloud_smooth_m: Annotated[float, Range(0.0, 10.0)] = 0.0
    grid_floor_m: Finite | None = None  # height of the floor in map; None: the lowest large horizontal surface
    grid_low_m: Finite = 0.10  # above the floor: lower things are driven over or are the floor's own noise
    grid_high_m: Finite = 1.60  # above the floor: higher things are driven under
    drive: DriveConfig = field(default_factory=DriveConfig)
    # where a surface is asked for, its map is made at poses that fit the depth of keyframes to each other: 0.1 s each
    refine_poses: bool = True
    mesh_voxel_m: Cell = 0.01  # about the noise of depth at 2 m; farther views count less, by that noise
    mesh_max_blocks: Count = 40_000  # of 8 x 8 x 8 voxels, 12 kB each; a mesh that takes more gets larger voxels
    mesh_min_views: Count = 2  # a surface that fewer keyframes saw is left out where other rays passed through it
    mesh_atlas_px: Annotated[int, Range(0, 16384)] = 4096  # edge of the picture on mesh.glb; 0: colours of vertices
    surfel_m: Cell = 0.02  # between surfels
    surfel_min_views: Count = 2  # keyframes that must have seen a surfel; what one alone saw may be noise
    poisson_depth: Annotated[int, Range(1, 16)] = 9  # levels of Poisson's octree: cells of 2 cm in a room of 10 m
    # what is written into map/; mesh, glb, obj and poisson need Open3D and take seconds, surfels too
    products: tuple[MapProduct, ...] = ("cloud", "octomap", "grid", "drive")
    labels: LabelConfig = field(default_factory=LabelConfig)
    mono_depth: MonoDepthConfig = field(default_factory=MonoDepthConfig)

    def __post_init__(self) -> None:
        """Refuse a product that there is not."""
        for product in self.products:
            check_name("map.products", product, get_args(_OwnProduct), "vislam.map_products")
