"""What a pipeline remembers, as plain values: enough to go on in another process, or to start from an older map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from vislam.core.imu_noise import ImuNoise
from vislam.core.messages import (
    Array,
    GraphUpdate,
    Keyframe,
    KeyframePacket,
    Localisation,
    LoopCandidate,
    LoopDecision,
    LoopEdge,
    NavState,
    RetrievedKeyframe,
    Tracking,
)
from vislam.core.readings import OwnStart


def at_pose(state: NavState, T_world_body: Array) -> NavState:
    """Return a state as another world has it, in which its pose is T_world_body [4, 4]; both have the same up."""
    R = T_world_body[:3, :3] @ state.T_world_body[:3, :3].T
    turn = np.eye(15)
    turn[3:6, 3:6] = turn[6:9, 6:9] = R
    return replace(
        state,
        T_world_body=T_world_body,
        velocity_world_m_s=R @ state.velocity_world_m_s,
        covariance=turn @ state.covariance @ turn.T,
    )


@dataclass(frozen=True, slots=True, eq=False)
class EdgeReport:
    """What became of one offered loop edge."""

    loop_id: int
    from_id: int
    to_id: int
    chi2: float  # at the gate, NaN when it was not reached
    weight: float  # of the Cauchy kernel at the current estimate, 0 when not in the graph
    decision: LoopDecision
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class EdgeRecord:
    """Motion between two consecutive keyframes, summarised by the window of tight coupling."""

    to_id: int  # from the keyframe before it
    T_previous_body: Array  # [4, 4]
    covariance: Array  # [6, 6] perturbed on the newer keyframe's side
    settled: bool  # no later one will replace it
    begins_submap: bool = False  # nothing was measured: a guess, with sigmas that say so


@dataclass(frozen=True, slots=True, eq=False)
class GravityRecord:
    """Which way is up for a keyframe, summarised by the window of tight coupling."""

    id: int
    up_body: Array  # [3] unit
    sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class WindowRecord:
    """What the window of tight coupling said with one keyframe, as far as the graph took it."""

    id: int
    t_ns: int
    edges: tuple[EdgeRecord, ...]  # that of this keyframe (none for the first), and those that replace older ones
    tilts: tuple[GravityRecord, ...]
    note: str
    rest_from: int | None = None  # the keyframe since which the body has not moved; None: it may have


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """A loop as it was put into the graph, with another older keyframe that stands for its own."""

    from_id: int
    T_from_to: Array  # [4, 4]
    covariance: Array  # [6, 6]


@dataclass(frozen=True, slots=True, eq=False)
class Tied:
    """A keyframe that a loop ties to an anchor, or an anchor itself."""

    id: int
    anchor_id: int
    covariance: Array  # [6, 6] of its pose relative to the anchor when it was tied; later it is known better


class LoopPlace(StrEnum):
    """Where the graph keeps an offered loop."""

    GRAPH = "graph"  # as a factor
    SPARE = "spare"  # accepted without a factor
    PENDING = "pending"
    WAITING = "waiting"  # between submaps that are not joined
    OUT = "out"
    UNDONE = "undone"  # taken out by a user, after the run; it stays out until brought back


@dataclass(frozen=True, slots=True, eq=False)
class LoopState:
    """What became of an offered loop so far."""

    id: int
    decision: LoopDecision
    reason: str
    chi2: float  # NaN: the gate was not reached
    place: LoopPlace
    tie: Tie | None


@dataclass(frozen=True, slots=True, eq=False)
class GraphRecord:
    """What a graph has to remember of its last keyframe, beside what was measured and the poses."""

    window: WindowRecord | None = None  # None: loose coupling
    states: tuple[tuple[int, NavState], ...] = ()  # of keyframes: in the window's frame, or in map
    loops: tuple[LoopState, ...] = ()  # those that changed
    ties: tuple[Tied, ...] = ()  # new ones
    vo_scale: float = 1.0
    own: tuple[OwnStart, ...] = ()  # the own variables of sensors as they are now


@dataclass(frozen=True, slots=True, eq=False)
class OfferedLoop:
    """A loop edge, when it was offered, and what became of it."""

    edge: LoopEdge
    offered_with: int  # the newest keyframe then
    state: LoopState


@dataclass(frozen=True, slots=True, eq=False)
class GraphMemory:
    """A pose graph: measurements, decisions and the last estimate of keyframes 0..M-1."""

    packets: list[KeyframePacket]  # observations are not needed, inertial data only for loose coupling
    T_map_body: Array  # [M, 4, 4]
    T_odom_body: Array  # [4, 4] of the newest
    windows: list[WindowRecord]  # one per keyframe, or none: loose coupling
    states: dict[int, NavState]
    loops: list[OfferedLoop]  # in the order in which they were offered
    ties: list[Tied]
    vo_scale: float
    revision: int
    own: tuple[OwnStart, ...] = ()  # the last estimate of the own variables of sensors


@dataclass(frozen=True, slots=True, eq=False)
class WordsMemory:
    """The vocabulary in use as bytes, and where training stands."""

    data: bytes
    trained_at: int  # keyframes that there were when the latest training began, whether it is in use yet or not
    trainings: int  # begun so far


@dataclass(frozen=True, slots=True, eq=False)
class TagSighting:
    """A tag in one image; `T_cam_tag` [4, 4] and its covariance [6, 6] only where size and view determine them."""

    tag_id: int
    side_px: float  # mean length of its sides
    T_cam_tag: Array | None  # z towards the camera, x to the right as printed
    covariance: Array | None  # perturbed on the tag's side, rotation first


@dataclass(frozen=True, slots=True, eq=False)
class PlacesMemory:
    """What loop detection looks in: features without images, and the words they are indexed by."""

    keyframes: list[Keyframe]
    T_map_body: Array  # [M, 4, 4]
    words: WordsMemory | None  # None: not trained yet
    tags: dict[int, tuple[TagSighting, ...]]  # by keyframe
    next_edge_id: int


@dataclass(frozen=True, slots=True, eq=False)
class PackedScan:
    """The geometry of a keyframe as the map keeps it: compressed, without loss in depth."""

    t_ns: int
    depth_png: bytes
    points: bytes
    colors: bytes
    labels_png: bytes = b""  # ids on the same rays, or of the same points; empty: none

    @property
    def nbytes(self) -> int:
        """Its size in bytes."""
        return len(self.depth_png) + len(self.points) + len(self.colors) + len(self.labels_png)


@dataclass(frozen=True, slots=True, eq=False)
class StartFacts:
    """How gravity was found."""

    status: str
    reason: str
    last: NavState  # of the newest frame then
    scale_sigma: float
    excitation_m_s2: float
    noise: ImuNoise  # the model that was used from then on
    first_state: NavState  # of keyframe 0
    begun_t_ns: int = 0  # since when there are poses: provisional ones came before `last`; 0: unknown


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """What the front half has learned so far, beside the filter's state."""

    next_track_id: int = 0
    time_offset_sigma_s: float = float("inf")  # of the camera's clock
    readout_s: float | None = None  # of a rolling shutter; None: not estimated
    filter_camera: Array | None = None  # [8] of the tight filter: time offset, sigma, rotation [3], sigmas [3]
    tilt: Array | None = None  # [6] of a camera over a floor: what the mount lacks [2] and its covariance [2, 2]
    depth_delay_s: float | None = None  # of depth images, beyond their stamps; None: not estimated
    depth_rows_s: float | None = None  # by how much longer their rows take than an image's; None: not estimated
    # [11] of a camera with depth: velocity [6] at the keyframe, rotation first, in its own frame; noise of tracks [2];
    # information in 1/s^2 on readout, delay and rows; None: not known
    habits: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FrontMemory:
    """Where the front half was at the newest keyframe."""

    keyframe_id: int
    t_ns: int  # of the keyframe, by the IMU's clock
    time_offset_s: float  # that was added to the camera's own stamp
    T_odom_body: Array  # [4, 4]
    start: StartFacts | None  # None: no IMU
    state: NavState | None  # of the filter at the keyframe; None without an IMU
    learned: Learned

    @property
    def camera_t_ns(self) -> int:
        """The keyframe's stamp by the camera's own clock."""
        return self.t_ns - round(self.time_offset_s * 1e9)


@dataclass(frozen=True, slots=True, eq=False)
class SlamMemory:
    """A whole pipeline after its newest keyframe."""

    front: FrontMemory
    first_state: NavState | None  # of keyframe 0; None without an IMU
    T_start: Array  # [4, 4] where keyframe 0 was put in map
    graph: GraphMemory
    places: PlacesMemory
    scans: dict[int, PackedScan]  # by keyframe
    held: int = 0  # number of first keyframes that belong to a map that is not to change
    map_keyframes: int = 0  # number of first keyframes that are of earlier runs
    T_guess: Array | None = None  # [4, 4] where the body is assumed to be in that map when a recording begins; None

    def turned(self, T: Array) -> SlamMemory:
        """Return the memory of a run without gravity with `map` and `odom` both moved by T [4, 4]."""
        T_map_body = T @ self.graph.T_map_body
        return replace(
            self,
            front=replace(self.front, T_odom_body=T @ self.front.T_odom_body),
            T_start=T @ self.T_start,
            graph=replace(self.graph, T_map_body=T_map_body, T_odom_body=T @ self.graph.T_odom_body),
            places=replace(self.places, T_map_body=T_map_body),
        )


@dataclass(frozen=True, slots=True, eq=False)
class FrameEntry:
    """What is remembered of every frame."""

    t_ns: int
    keyframe_id: int  # the newest keyframe
    T_keyframe_body: Array | None  # [4, 4] relative to it; None: known by interpolation only
    T_odom_body: Array | None = None  # [4, 4] causal
    T_map_body: Array | None = None  # [4, 4] causal
    tracking: Tracking = Tracking.OK
    inliers: int = 0
    vo_keyframe_id: int = -1  # what the motion was measured against
    reason: str = ""
    localisation: Localisation = Localisation.TRACKING
    submap: int = 0  # of the trajectory
    motion: Array | None = None  # [30] of the filter, see `trajectory.motion_numbers`; None: it has no state


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeEntry:
    """One keyframe, with all that came of it, on its way into a session."""

    packet: KeyframePacket
    T_odom_body: Array  # [4, 4]
    update: GraphUpdate
    record: GraphRecord
    edges: Sequence[LoopEdge] = ()
    candidates: Sequence[LoopCandidate] = ()
    retrieved: Sequence[RetrievedKeyframe] = ()
    shifts: Mapping[int, tuple[float, float]] = field(
        default_factory=dict
    )  # edge: rms and largest of what moved with it
    scans: dict[int, PackedScan] = field(default_factory=dict)  # its own, or one that came late, by keyframe
    words: WordsMemory | None = None  # None: as before
    tags: tuple[TagSighting, ...] = ()
    start: StartFacts | None = None  # goes with the first keyframe
    front: Learned | None = None
    filter_state: NavState | None = None
