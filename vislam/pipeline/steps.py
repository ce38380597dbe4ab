"""What the halves of the pipeline answer: a step for every frame, one for every keyframe, and the end."""

from dataclasses import dataclass

from vislam.core.memory import GraphRecord, PackedScan, TagSighting, WordsMemory
from vislam.core.messages import (
    Array,
    Frame,
    GraphUpdate,
    Localisation,
    LoopCandidate,
    LoopEdge,
    NavState,
    RetrievedKeyframe,
    Tracking,
)
from vislam.ekf import Correction
from vislam.frontend import TrackResult
from vislam.mapping.depth.mono import SeenFrame
from vislam.trajectory.continuity import Continuity
from vislam.trajectory.odometry_keyframe import OdometryKeyframe


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Where odometry has the body at a frame."""

    T_odom_before: Array  # [4, 4] by inertial data or habit, from where it was at the last frame
    T_odom_body: Array  # [4, 4] with all that is known
    rate_sigma_rad_s: float  # of the gyroscope's bias; infinite without an IMU
    moving: NavState | None = None  # without an IMU: pose and velocity with covariance; NaN for biases

    def shown(self, t_ns: int, published: Continuity) -> Array:
        """Return the pose in `odom` [4, 4] as it is published at a time: continuous where that is wanted."""
        return published.follow(t_ns, self.T_odom_before, self.T_odom_body, self.rate_sigma_rad_s)


@dataclass(frozen=True, slots=True, eq=False)
class FrontStep:
    """What the front half made of one frame."""

    frame: Frame
    track: TrackResult
    T_odom_body: Array | None  # as it is published, without jumps; None before initialisation
    estimate: Estimate | None  # behind it; None before initialisation
    state: NavState | None  # of the filter; None before initialisation or without an IMU
    keyframe_id: int  # the newest keyframe
    T_keyframe_body: Array | None  # relative to it; None: only known by interpolation between keyframes
    keyframes: list[OdometryKeyframe]  # usually none or one; those that waited for gravity come together
    corrections: list[Correction]  # that the filter got with it, usually one; none before it has a state

    @property
    def moving(self) -> NavState | None:
        """Pose and velocity with covariance: by the filter, or by vision alone; None before initialisation."""
        return self.state if self.state is not None or self.estimate is None else self.estimate.moving


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeStep:
    """What the back end did with one keyframe."""

    odometry: OdometryKeyframe
    update: GraphUpdate
    edges: list[LoopEdge]
    candidates: list[LoopCandidate]
    retrieved: list[RetrievedKeyframe]
    record: GraphRecord  # what the graph has to remember
    scans: dict[int, PackedScan]  # what came into the map with it: its own scan, or depth that came late
    words: WordsMemory | None  # the vocabulary, when it is new
    tags: tuple[TagSighting, ...]  # that it saw


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """The answer to one frame: what the front half saw, the causal pose, and the keyframes that went to the back."""

    front: FrontStep
    T_map_body: Array | None  # None: no pose yet, or its submap is not joined with the map
    localisation: Localisation
    submap: int  # of the trajectory, from 0
    keyframes: list[KeyframeStep]


@dataclass(frozen=True, slots=True, eq=False)
class Finish:
    """What came when the recording ended."""

    steps: list[Step]
    keyframes: list[KeyframeStep]  # those that had waited for gravity until the end
    update: GraphUpdate | None  # None: not one keyframe reached the back end
    record: GraphRecord | None


def seen_between(front: FrontStep) -> list[SeenFrame]:
    """Return what depth from one camera can use of a step: a frame between keyframes of which odometry knows where."""
    frame, T = front.frame, front.T_keyframe_body
    is_known = T is not None and front.track.vo.tracking is not Tracking.LOST
    if front.track.keyframe is not None or not is_known or not frame.images:
        return []
    assert T is not None
    return [SeenFrame(frame.t_ns, frame.images[0], front.keyframe_id, T)]
