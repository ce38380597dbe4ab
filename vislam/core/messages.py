"""The values that flow between the rooms: frozen, numpy only, and nothing else crosses a room's wall.

Conventions: `T_a_b` maps points of frame b into frame a (`p_a = T_a_b @ p_b`). Frames: `map` (gravity-aligned, z up,
corrected by loops), `odom` (gravity-aligned, continuous), `body` (the IMU), `cam0`, `cam1` (x right, y down, z
forward).
Tangents and 6x6 covariances are ordered rotation, then translation, with the perturbation on the body side:
`T_perturbed = T @ se3_exp(xi)`. Time is integer nanoseconds.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from vislam.core.readings import MotionReadings, OwnStart, PlacedReading

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
ImageU8 = NDArray[np.uint8]
ImageF32 = NDArray[np.float32]
NO_IMAGE: ImageU8 = np.zeros((0, 0), dtype=np.uint8)


class Tracking(StrEnum):
    """How far a front end trusts the motion it reports."""

    OK = "ok"
    DEGRADED = "degraded"
    LOST = "lost"
    BLIND = "blind"  # there is no camera, which could lose anything

    @property
    def sees(self) -> bool:
        """Whether vision measured a motion."""
        return self in (Tracking.OK, Tracking.DEGRADED)


class Localisation(StrEnum):
    """Whether the place in the map is known."""

    TRACKING = "tracking"
    LOST = "lost"  # vision is lost, or what it follows is a submap that is not joined with the map
    RELOCALISED = "relocalised"  # just now the submap was joined


class LoopDecision(StrEnum):
    """What became of a loop candidate."""

    ACCEPTED = "accepted"
    PENDING = "pending"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """One inertial sample: calibrated angular rate and specific force in the body frame (+g up at rest)."""

    t_ns: int
    gyro_rad_s: Array  # [3]
    accel_m_s2: Array  # [3]


@dataclass(frozen=True, slots=True, eq=False)
class MagSample:
    """One magnetometer sample in the body frame."""

    t_ns: int
    field_ut: Array  # [3]


class NoiseScale(NamedTuple):
    """White noise densities over those of the IMU's noise model."""

    gyro: float
    accel: float


AS_MODELLED = NoiseScale(1.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class ImuSpan:
    """IMU samples that cover `[t_ns[0], t_ns[-1]]` exactly: the first and last are interpolated to the asked times."""

    t_ns: NDArray[np.int64]  # [N], strictly increasing
    gyro_rad_s: Array  # [N, 3]
    accel_m_s2: Array  # [N, 3]
    noise: NoiseScale = AS_MODELLED  # what the samples around it show

    def __repr__(self) -> str:
        length_s = float(self.t_ns[-1] - self.t_ns[0]) * 1e-9 if len(self.t_ns) else 0.0
        return f"ImuSpan({len(self.t_ns)} samples over {length_s:.3f} s)"


@dataclass(frozen=True, slots=True, eq=False)
class FurtherTracks:
    """Tracked features of a camera beyond the first (pair), which no other camera is asked for; pixels are raw."""

    camera: int  # its number in the rig
    track_ids: NDArray[np.int64]  # [N], none of another camera's
    pixels_px: Array  # [N, 2]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Tracked features seen in one frame; pixels are raw (distorted) image coordinates."""

    track_ids: NDArray[np.int64]  # [N]
    pixels_px: Array  # [N, 2] in cam0
    right_px: Array | None = None  # [N, 2] in cam1, NaN where not matched
    depth_m: Array | None = None  # [N] z-depth in cam0, NaN where unknown
    instant_px: Array | None = None  # [N, 2] at the frame's own time, rolling shutter undone; None: as above
    right_instant_px: Array | None = None  # [N, 2] the same in cam1; with `instant_px` where there is `right_px`
    descriptors: NDArray[np.uint8] | None = None  # [N, 32] for loop closing, only of tracks that came without images
    noise: float = 1.0  # standard deviations of pixels and depths over those that estimators are given
    further: tuple[FurtherTracks, ...] = ()  # of the rig's further cameras
    readout_s: float | None = None  # learned, of rows that are not undone; None: not known but to who was given it

    def __repr__(self) -> str:
        right = "" if self.right_px is None else f", {int(np.isfinite(self.right_px[:, 0]).sum())} in cam1"
        depth = "" if self.depth_m is None else f", {int(np.isfinite(self.depth_m).sum())} with depth"
        further = "".join(f", {len(seen.track_ids)} of cam{seen.camera}" for seen in self.further)
        return f"Observations({len(self.track_ids)} tracks{right}{depth}{further})"

    @property
    def are_none(self) -> bool:
        """Whether no camera sees anything."""
        return not len(self.track_ids) and not any(len(seen.track_ids) for seen in self.further)


def chosen(given: Observations, which: Bools) -> Observations:
    """Return those of tracks [N] that are chosen [N]."""
    parts = (given.right_px, given.depth_m, given.instant_px, given.right_instant_px)
    right, depth, instant, right_instant = (None if part is None else part[which] for part in parts)
    return replace(
        given, track_ids=given.track_ids[which], pixels_px=given.pixels_px[which], right_px=right, depth_m=depth,
        instant_px=instant, right_instant_px=right_instant,
        descriptors=None if given.descriptors is None else given.descriptors[which],
    )  # fmt: skip


def no_observations() -> Observations:
    """Return observations of nothing."""
    return Observations(np.empty(0, dtype=np.int64), np.empty((0, 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Images taken at one instant: a grey image per camera of the rig, with colour and registered depth if any."""

    t_ns: int
    index: int
    images: tuple[ImageU8, ...]  # [H, W] each, cam0 first; NO_IMAGE where a further camera gave none
    color: ImageU8 | None = None  # [H, W, 3] BGR of cam0
    depth_m: ImageF32 | None = None  # [H, W] z-depth registered to cam0; 0 or NaN where invalid
    tracks: Observations | None = None  # points already followed elsewhere (simulated vision); `images` is then empty
    depth_lag_s: float = 0.0  # how much later than the images depth was taken, by its own stamp
    follows_step: bool = False  # of the clock: how long after the frame before it was taken is not known
    masks: tuple[ImageU8 | None, ...] = ()  # [H, W] per camera, None or left out: all of it; below 128: not to be used

    def mask(self, camera: int) -> ImageU8 | None:
        """Return the mask [H, W] of a camera; None where all of its image is to be used."""
        return self.masks[camera] if camera < len(self.masks) else None

    def __repr__(self) -> str:
        has = [f"{image.shape[1]} x {image.shape[0]} px" for image in self.images if image.size]
        has += [name for name, image in (("colour", self.color), ("depth", self.depth_m)) if image is not None]
        has += [] if self.tracks is None else [f"{len(self.tracks.track_ids)} tracks"]
        return f"Frame({self.index} at {self.t_ns * 1e-9:.3f} s: {', '.join(has) or 'no images'})"


@dataclass(frozen=True, slots=True, eq=False)
class VoMeasurement:
    """Motion of the body since a keyframe. Without scale the translation is a unit direction, or zero: no parallax."""

    t_ns: int
    keyframe_id: int
    T_keyframe_body: Array | None  # [4, 4]; None when lost or blind
    covariance: Array  # [6, 6]; unscaled translation: covariance of the unit direction, singular along it
    has_scale: bool
    tracking: Tracking
    inliers: int
    by_surfaces: bool = False  # depth images of the last keyframes had a say, of which tracks know nothing


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame that stays: its features for loop closing and its geometry for mapping."""

    id: int
    t_ns: int
    frame: Frame
    keypoints_px: Array  # [N, 2] raw pixels of the described features in cam0, as of the middle row's time
    descriptors: NDArray[np.uint8]  # [N, 32] ORB
    points_body_m: Array | None  # [N, 3] of the described features in the body frame, NaN where unknown; None: no depth
    T_image_depth: Array | None = None  # [4, 4] where cam0 was when depth was taken, as the image sees it; None: there
    depth_sweep: Array | None = None  # [6] twist of cam0 from the first to the last row of depth; None: taken at once
    image_sweep: Array | None = None  # [6] the same of its image

    def __repr__(self) -> str:
        return f"Keyframe({self.id} at {self.t_ns * 1e-9:.3f} s: {len(self.keypoints_px)} features)"


@dataclass(frozen=True, slots=True, eq=False)
class KeyframePacket:
    """Everything the back end needs of one keyframe, so that its answer cannot depend on timing."""

    keyframe: Keyframe
    vo: VoMeasurement  # relative to the previous keyframe; for keyframe 0, identity
    observations: Observations
    imu: ImuSpan | None  # since the previous keyframe; None for keyframe 0 or without an IMU
    mag: MagSample | None = None
    at_rest: bool = False  # zero velocity held over the span, decided by IMU and image together
    time_offset_s: float = 0.0  # what has been added to the camera's own stamp to get the IMU's time
    begins_submap: bool = False  # nothing measured the motion since the previous keyframe: a new submap
    readings: tuple[PlacedReading, ...] = ()  # of other sensors since the previous keyframe
    own_starts: tuple[OwnStart, ...] = ()  # of sensors that have begun since then
    motions: tuple[MotionReadings, ...] = ()  # the same where vision was lost: for a window, and not in `readings`
    filter_state: NavState | None = None  # where a further sensor sees motion: a window that contradicts it is wrong
    state_at_sight: NavState | None = None  # the filter's, at the first keyframe with sight after some without

    @property
    def is_tied(self) -> bool:
        """Whether it begins a submap that habit ties to the one before: `vo` has the motion, though vision lost it."""
        return self.begins_submap and self.vo.tracking is Tracking.LOST and self.vo.T_keyframe_body is not None


@dataclass(frozen=True, slots=True, eq=False)
class LoopCandidate:
    """One candidate and what was decided about it; every candidate is recorded, with its reason."""

    from_id: int  # the older keyframe
    to_id: int  # the newer keyframe
    source: str  # "appearance", "odometry", "tag" or "depth"
    score: float
    inliers: int
    decision: LoopDecision
    reason: str
    sigma_m: float = float("nan")
    consistency: int = 0  # by appearance and depth: how many keyframes before this one said the same place in a row
    supporters: int = 0  # matches that agree with the refined pose
    T_from_to: Array | None = None  # [4, 4] that verification found; None: no pose. A unit direction without scale
    matches_px: Array | None = None  # [M, 4] some of the matches: x, y in the older keyframe, x, y in the newer


@dataclass(frozen=True, slots=True, eq=False)
class RetrievedKeyframe:
    """An old keyframe that the index found to look like a new one, before anything else was asked of it."""

    from_id: int  # the older keyframe
    to_id: int  # the newer keyframe
    score: float  # 0..1
    island_score: float  # sum over the retrieved keyframes around it
    consistency: int  # how many keyframes before the newer one pointed at that place in a row


@dataclass(frozen=True, slots=True, eq=False)
class LoopEdge:
    """A verified relative pose from an older to a newer keyframe."""

    id: int
    from_id: int
    to_id: int
    T_from_to: Array  # [4, 4] body to body
    covariance: Array  # [6, 6]
    has_scale: bool
    inliers: int
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class NavState:
    """Full inertial state; error order of the covariance: rotation, position, velocity, gyro bias, accel bias."""

    t_ns: int
    T_world_body: Array  # [4, 4]; world is odom (EKF) or map (graph)
    velocity_world_m_s: Array  # [3]
    gyro_bias_rad_s: Array  # [3]
    accel_bias_m_s2: Array  # [3]
    covariance: Array  # [15, 15]; rotation perturbed on the body side, position and velocity in world axes

    @classmethod
    def with_sigmas(
        cls, t_ns: int, T_world_body: Array, pose_sigmas: tuple[float, float], *,
        velocity_world_m_s: Sequence[float] | Array = (0.0, 0.0, 0.0), sigma_m_s: float = 0.1,
        gyro_bias_rad_s: Sequence[float] | Array = (0.0, 0.0, 0.0),
        accel_bias_m_s2: Sequence[float] | Array = (0.0, 0.0, 0.0), bias_sigmas: tuple[float, float] = (0.01, 0.2),
    ) -> NavState:  # fmt: skip
        """Return a state whose errors are independent, all axes of a part alike.

        Args:
            t_ns: its time.
            T_world_body: [4, 4].
            pose_sigmas: of rotation (rad) and position (m).
            velocity_world_m_s: [3].
            sigma_m_s: of the velocity.
            gyro_bias_rad_s: [3].
            accel_bias_m_s2: [3].
            bias_sigmas: of the gyroscope (rad/s) and of the accelerometer (m/s^2).
        """
        T, velocity, gyro_bias, accel_bias = (
            np.array(v, dtype=np.float64) for v in (T_world_body, velocity_world_m_s, gyro_bias_rad_s, accel_bias_m_s2)
        )
        variances = np.square([*pose_sigmas, sigma_m_s, *bias_sigmas])
        return cls(t_ns, T, velocity, gyro_bias, accel_bias, np.diag(np.repeat(variances, 3)))

    def __repr__(self) -> str:
        x, y, z = self.T_world_body[:3, 3]
        turn, place = (float(np.sqrt(np.trace(self.covariance[k : k + 3, k : k + 3]))) for k in (0, 3))
        return (
            f"NavState(t {self.t_ns * 1e-9:.3f} s: at ({x:.3f}, {y:.3f}, {z:.3f}) m, sigma {place:.2g} m and "
            f"{np.rad2deg(turn):.2g} deg, speed {float(np.linalg.norm(self.velocity_world_m_s)):.3g} m/s)"
        )


@dataclass(frozen=True, slots=True)
class Submaps:
    """Submaps: stretches of consecutive keyframes that odometry ties, and which of them loops have joined.

    Poses of keyframes in submaps that are not joined mean nothing to each other.
    """

    first_ids: tuple[int, ...] = (0,)  # the keyframe with which each submap begins
    groups: tuple[int, ...] = (0,)  # of each submap: the oldest submap that it is joined with, itself when with none
    tied_ids: tuple[int, ...] = ()  # those of `first_ids` that habit ties to the keyframe before

    @property
    def is_joined(self) -> bool:
        """Whether the newest submap is joined with the first, which is the map."""
        return self.groups[-1] == 0

    def begun(self, keyframe_id: int, is_tied: bool = False) -> Submaps:
        """Return these submaps and a new one that begins with a keyframe; `is_tied` as in KeyframePacket."""
        ties = (*self.tied_ids, keyframe_id) if is_tied else self.tied_ids
        return Submaps((*self.first_ids, keyframe_id), (*self.groups, len(self.groups)), ties)

    def joined_by(self, pairs: Iterable[tuple[int, int]]) -> Submaps:
        """Return these submaps joined by exactly these pairs of keyframes."""
        groups = list(range(len(self.first_ids)))
        for one, other in pairs:
            low, high = sorted((groups[self.of(one)], groups[self.of(other)]))
            if low != high:
                groups = [low if group == high else group for group in groups]
        return replace(self, groups=tuple(groups))

    def of(self, keyframe_id: int) -> int:
        """Return the submap of a keyframe."""
        return bisect_right(self.first_ids, keyframe_id) - 1

    def group(self, keyframe_id: int) -> int:
        """Return the group of a keyframe: the oldest submap that its own is joined with."""
        return self.groups[self.of(keyframe_id)]

    def are_joined(self, one: int, other: int) -> bool:
        """Return whether two keyframes are in one submap, or in submaps that are joined."""
        return self.group(one) == self.group(other)

    def are_tied(self, one: int, other: int) -> bool:
        """Return whether odometry and habit lead from one keyframe to another."""
        first, last = sorted((self.of(one), self.of(other)))
        return set(self.first_ids[first + 1 : last + 1]) <= set(self.tied_ids)

    def groups_of(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the groups [N] of keyframes [N]."""
        places = np.searchsorted(np.array(self.first_ids), ids, side="right") - 1
        return np.array(self.groups, dtype=np.int64)[places]


@dataclass(frozen=True, slots=True, eq=False)
class GraphUpdate:
    """What one graph update changed; consumers keep the newest revision."""

    revision: int
    ids: NDArray[np.int64]  # [M] keyframes that moved
    T_map_body: Array  # [M, 4, 4]
    T_map_odom: Array  # [4, 4]
    newest: NavState | None  # state of the newest keyframe (biases for the EKF); None without IMU
    accepted_loop_ids: tuple[int, ...] = ()
    rejected_loop_ids: tuple[int, ...] = ()
    note: str = ""  # what happened when a plain update was not possible
    details: dict[str, Any] | None = None
    submaps: Submaps = Submaps()
