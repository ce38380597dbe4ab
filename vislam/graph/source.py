"""What feeds the graph between loops: measured motions (loose coupling) or a sliding window (tight coupling)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from vislam.config import GraphConfig, MachineConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.errors import DataError
from vislam.core.geometry import invert, se3_exp, se3_log, skew
from vislam.core.memory import EdgeRecord, GraphMemory, GravityRecord, WindowRecord, at_pose
from vislam.core.messages import Array, KeyframePacket, NavState
from vislam.core.readings import Motion
from vislam.factors.builder import Builder, Guess
from vislam.factors.journal import KeyframeRecord, StartRecord, checked_poses
from vislam.factors.keys import B, V, X, bias_of
from vislam.factors.noise_models import checked_covariances, conditioned
from vislam.factors.odometry import MotionOdometry, Odometry
from vislam.factors.window import WindowOdometry
from vislam.graph.estimator import Estimator
from vislam.imu import ImuNoise
from vislam.window.messages import WindowEdge, WindowUpdate

_RATIO_MAX = 1e12  # eigenvalues of a covariance that is solved with
_FAR_SURER = 4.0  # times, of the variance of velocity
_CONTRADICTION = chi_square_limit(1.0 - 1e-9, 3)  # both see the same images: what is apart by chance is far less


class Window(Protocol):
    """What tight coupling needs of a sliding window."""

    def initialise(self, state: NavState | None, T_local_body: Array | None = None) -> None:
        """Set the state of keyframe 0; without an IMU its pose."""

    def add(
        self, packet: KeyframePacket, T_odom_body: Array | None = None, motions: Sequence[Motion] = ()
    ) -> WindowUpdate:
        """Take a keyframe; DataError, and nothing changed, on a packet that cannot be used."""


class Source(Protocol):
    """One kind of coupling."""

    @property
    def odometry(self) -> Odometry:
        """Return the factors it gives."""

    @property
    def details(self) -> dict[str, Any]:
        """Return what is worth telling about the last keyframe."""

    @property
    def scale_sigma(self) -> float:
        """Return the relative error that all metres may have in common, beyond what its factors know of."""

    def begin(self, start: StartRecord, state: NavState | None) -> None:
        """Take the first state."""

    def begin_submap(self, start: StartRecord, state: NavState | None) -> None:
        """Take the first state of another recording, whose first keyframe comes next."""

    def add(
        self, packet: KeyframePacket, record: KeyframeRecord, T_odom_body: Array | None, motions: Sequence[Motion]
    ) -> list[WindowRecord]:
        """Take a keyframe, validated as `record`; return what else belongs into the journal.

        `motions` is what further sensors say of the motion since the keyframe before, for a window.
        Raises DataError, and changes nothing, on observations that cannot be used.
        """

    def restore(self, records: list[KeyframeRecord], memory: GraphMemory) -> list[Guess]:
        """Take all keyframes of an earlier run, after `begin`; return the last estimate of each."""

    def go_on(self, packet: KeyframePacket, T_map_body: Array, T_odom_body: Array | None) -> None:
        """Begin again at the newest keyframe that `restore` brought: as it is in map, and as it is seen now."""

    def take_states(self, newest: NavState | None) -> tuple[tuple[int, NavState], ...]:
        """Return the states of keyframes that are to be remembered since the last call; `newest` is that in map."""

    def state(self, k: int, t_ns: int, estimator: Estimator) -> NavState:
        """Return the state of keyframe k in map with its covariance, NaN where that is unknown."""


class MotionSource:
    """Loose coupling: the graph itself estimates velocities and biases."""

    def __init__(self, config: GraphConfig, noise: ImuNoise | None, machine: MachineConfig, lever_m: Array) -> None:
        """Start empty."""
        self._odometry = MotionOdometry(Builder(config, noise, machine, lever_m))
        self.scale_sigma = config.scale_sigma  # see Source
        self._newest_id = -1

    @property
    def odometry(self) -> Odometry:
        """See Source."""
        return self._odometry

    @property
    def details(self) -> dict[str, Any]:
        """See Source."""
        return {}

    def begin(self, start: StartRecord, state: NavState | None) -> None:
        """See Source."""
        self._odometry.begin(start)

    def begin_submap(self, start: StartRecord, state: NavState | None) -> None:
        """See Source; the graph's own velocities and biases go on."""

    def add(
        self, packet: KeyframePacket, record: KeyframeRecord, T_odom_body: Array | None, motions: Sequence[Motion]
    ) -> list[WindowRecord]:
        """See Source."""
        self._odometry.append(record)
        self._newest_id = record.id
        return []

    def restore(self, records: list[KeyframeRecord], memory: GraphMemory) -> list[Guess]:
        """See Source; a velocity turns with what loops have turned since it was the newest."""
        out = []
        for k, (record, T) in enumerate(zip(records, memory.T_map_body, strict=True)):
            self._odometry.append(record)
            state = memory.states.get(k)
            velocity, bias = np.zeros(3), bias_of(np.zeros(3), np.zeros(3))
            if state is not None:
                velocity = T[:3, :3] @ state.T_world_body[:3, :3].T @ state.velocity_world_m_s
                bias = bias_of(state.gyro_bias_rad_s, state.accel_bias_m_s2)
            out.append(Guess(T, velocity, bias))
        self._newest_id = len(records) - 1
        return out

    def go_on(self, packet: KeyframePacket, T_map_body: Array, T_odom_body: Array | None) -> None:
        """See Source; motions are relative, so there is nothing to do."""

    def take_states(self, newest: NavState | None) -> tuple[tuple[int, NavState], ...]:
        """See Source."""
        return () if newest is None else ((self._newest_id, newest),)

    def state(self, k: int, t_ns: int, estimator: Estimator) -> NavState:
        """See Source; gtsam's covariance turned to NavState's order and axes."""
        guess, has_imu = estimator.state(k), estimator.has_imu
        covariance = np.full((15, 15), np.nan)
        joint = estimator.joint_covariance([X(k), V(k), B(k)] if has_imu else [X(k)])
        if joint is not None:
            turn = np.eye(len(joint))
            turn[3:6, 3:6] = guess.T_map_body[:3, :3]
            if has_imu:
                turn[9:, 9:] = np.roll(np.eye(6), 3, axis=1)
            covariance[: len(joint), : len(joint)] = turn @ joint @ turn.T
        velocity = guess.velocity_map_m_s if has_imu else np.full(3, np.nan)
        gyro, accel = np.array(guess.bias.gyroscope()), np.array(guess.bias.accelerometer())
        return NavState(t_ns, guess.T_map_body, velocity, gyro, accel, covariance)


class WindowSource:
    """Tight coupling: a sliding window estimates states and landmarks, and the graph takes its edges and tilts.

    The window does not use depth images as surfaces. Where it has no inertial data either, the edge of a keyframe whose
    motion was found with surfaces is odometry's. Where it has, a motion that depth alone measured, without any track,
    is fused into the edge as well.
    """

    def __init__(self, config: GraphConfig, machine: MachineConfig, window: Window) -> None:
        """Start empty."""
        self._config = config
        self._machine = machine
        self._odometry = WindowOdometry(config, machine)
        self._window = window
        self._local: list[NavState | None] = []  # of each keyframe in the window's frame, settled or as it was newest
        self._fresh: dict[int, NavState] = {}  # of those, since `take_states`
        self._by_surfaces: dict[int, tuple[Array, Array]] = {}  # motions of keyframes whose edges are not settled yet
        self._by_depth: dict[int, tuple[Array, Array]] = {}  # motions to keyframes that no track ties to the one before
        self._details: dict[str, Any] = {}
        self.scale_sigma = config.scale_sigma  # see Source; as the window knows it, once it has an IMU to learn it by

    @property
    def odometry(self) -> Odometry:
        """See Source."""
        return self._odometry

    @property
    def details(self) -> dict[str, Any]:
        """See Source."""
        return self._details

    def begin(self, start: StartRecord, state: NavState | None) -> None:
        """See Source."""
        self._odometry.begin(start)
        self._window.initialise(state, start.T_map_body)

    def begin_submap(self, start: StartRecord, state: NavState | None) -> None:
        """See Source."""
        self._window.initialise(state, start.T_map_body)

    def add(
        self, packet: KeyframePacket, record: KeyframeRecord, T_odom_body: Array | None, motions: Sequence[Motion]
    ) -> list[WindowRecord]:
        """See Source."""
        update = self._window.add(packet, T_odom_body, motions)
        better, why = _better_state(packet, update.newest)
        if better is not None:
            self._window.initialise(better)
            self._window.add(packet, T_odom_body)
            update = replace(update, note="; ".join(note for note in (update.note, why) if note))
        self._note_depth(packet, record)
        said = self._record(update, record)
        self._odometry.append(said)
        self._local.append(update.newest)
        if update.newest is not None:
            self._fresh[record.id] = update.newest
            self.scale_sigma = update.calibration.metres_sigma
        for k, state in update.states:
            self._local[k] = self._fresh[k] = state
        self._details = {
            "calibration": update.calibration,
            "scale_sigma": update.scale_sigma,
            "rejected_tracks": update.rejected_tracks,
        }
        return [said]

    def restore(self, records: list[KeyframeRecord], memory: GraphMemory) -> list[Guess]:
        """See Source."""
        for said in memory.windows:
            self._odometry.append(said)
        self._local = [memory.states.get(k) for k in range(len(records))]
        nothing = bias_of(np.zeros(3), np.zeros(3))
        return [Guess(T, np.zeros(3), nothing) for T in memory.T_map_body]

    def go_on(self, packet: KeyframePacket, T_map_body: Array, T_odom_body: Array | None) -> None:
        """See Source; a new window starts from the state that the old one had at its newest keyframe."""
        self._window.initialise(self._local[-1], T_map_body)
        self._window.add(packet, T_odom_body)

    def take_states(self, newest: NavState | None) -> tuple[tuple[int, NavState], ...]:
        """See Source; in the window's frame."""
        fresh, self._fresh = tuple(self._fresh.items()), {}
        return fresh

    def state(self, k: int, t_ns: int, estimator: Estimator) -> NavState:
        """See Source; the window's state carried to the keyframe's pose in map, whose covariance is the graph's."""
        T_map_body = estimator.poses[k].copy()
        pose = estimator.joint_covariance([X(k)])
        if pose is not None:
            turn = np.eye(6)
            turn[3:, 3:] = T_map_body[:3, :3]
            pose = turn @ pose @ turn.T
        local = self._local[k]
        if local is not None:
            return in_map(local, T_map_body, pose)
        covariance = np.full((15, 15), np.nan)
        if pose is not None:
            covariance[:6, :6] = pose
        return NavState(t_ns, T_map_body, np.full(3, np.nan), np.zeros(3), np.zeros(3), covariance)

    def _record(self, update: WindowUpdate, record: KeyframeRecord) -> WindowRecord:
        """Choose what the graph takes: the newest edge, settled ones, and provisional ones that changed most."""
        notes = [update.note]
        kept, changed = [], []
        recent = record.id - 2 * self._config.window_refresh_max  # older edges hardly change any more
        wanted = [
            edge
            for edge in update.odometry
            if (edge.settled or edge.to_id >= recent) and not self._begins_submap(edge.to_id, record)
        ]
        for edge in map(self._with_depth, _edge_records(wanted, notes)):
            sigmas = self._odometry.worth_replacing(edge)
            if edge.settled or edge.to_id == record.id:
                kept.append(edge)
            elif sigmas > 0.0:
                changed.append((sigmas, edge))
        changed.sort(key=lambda item: -item[0])
        kept += [edge for _, edge in changed[: self._config.window_refresh_max]]
        if record.id and all(edge.to_id != record.id for edge in kept):
            kept.append(self._stand_in(record))
            if not record.begins_submap:
                notes.append("no usable edge from the window, went on as odometry or the last motion says")
        tilts = tuple(
            GravityRecord(tilt.id, np.array(tilt.up_body), float(tilt.sigma_rad))
            for tilt in update.tilts
            if tilt.id % self._config.gravity_every == 0 and _is_direction(tilt.up_body) and np.isfinite(tilt.sigma_rad)
        )
        note = "; ".join(n for n in notes if n)
        return WindowRecord(record.id, record.t_ns, tuple(kept), tilts, note, record.rest_from)

    def _note_depth(self, packet: KeyframePacket, record: KeyframeRecord) -> None:
        """Remember the motion to a keyframe that was found with surfaces, which a window does not use."""
        T, covariance = record.T_previous_body, record.covariance
        if not packet.vo.by_surfaces or record.begins_submap or T is None or covariance is None:
            return
        if packet.imu is None:
            self._by_surfaces[record.id] = T, covariance
        elif packet.vo.inliers == 0 and np.linalg.eigvalsh(covariance)[0] > 0.0:
            self._by_depth[record.id] = T, covariance

    def _with_depth(self, edge: EdgeRecord) -> EdgeRecord:
        """Return an edge of the window with the same motion as measured by depth, where there is such a measurement.

        The error by depth alone is independent of the edge's: they are fused. A motion by tracks and depth together has
        the tracks in common with the edge, so it takes its place.
        """
        together, apart = self._by_surfaces.get(edge.to_id), self._by_depth.get(edge.to_id)
        if edge.settled:
            self._by_surfaces.pop(edge.to_id, None)
            self._by_depth.pop(edge.to_id, None)
        if together is not None:
            return replace(edge, T_previous_body=together[0], covariance=together[1])
        if apart is None:
            return edge
        T, covariance = apart
        both = edge.covariance + covariance
        gain = np.linalg.solve(both, edge.covariance).T
        step = gain @ se3_log(invert(edge.T_previous_body) @ T)
        left = edge.covariance - gain @ edge.covariance
        return replace(edge, T_previous_body=edge.T_previous_body @ se3_exp(step), covariance=0.5 * (left + left.T))

    def _begins_submap(self, k: int, newest: KeyframeRecord) -> bool:
        """Return whether keyframe k begins a submap: what a window makes of its motion is no edge."""
        edge = self._odometry.edge(k)
        return newest.begins_submap if k == newest.id else edge is not None and edge.begins_submap

    def _stand_in(self, record: KeyframeRecord) -> EdgeRecord:
        """Return an edge to the newest keyframe where the window gave none: from odometry, else as before, loosely."""
        machine = self._machine
        if record.T_previous_body is not None and record.covariance is not None and record.has_scale:
            weak = record.begins_submap
            return EdgeRecord(record.id, record.T_previous_body, record.covariance, weak, weak)
        last = self._odometry.edge(record.id - 1)
        T = np.eye(4) if last is None else last.T_previous_body
        rad, m = np.deg2rad(machine.lost_rate_sigma_deg_s), machine.lost_speed_sigma_m_s  # of a second, the usual gap
        return EdgeRecord(record.id, T, np.diag(np.repeat([rad**2, m**2], 3)), False)


def in_map(local: NavState, T_map_body: Array, pose_covariance: Array | None) -> NavState:
    """Return a state of a window at its pose in map [4, 4].

    The window gives how velocity and biases depend on the pose, the graph how well the pose is known: `pose_covariance`
    [6, 6] in NavState's axes takes the place of the window's own, and what depends on it follows.
    """
    state = at_pose(local, T_map_body)
    covariance = state.covariance
    if pose_covariance is not None and np.all(np.isfinite(covariance)):
        own = conditioned(covariance[:6, :6], _RATIO_MAX)
        gain = np.linalg.solve(own, covariance[:6, 6:]).T
        rest = covariance[6:, 6:] - gain @ own @ gain.T
        covariance[:6, :6] = pose_covariance
        covariance[6:, :6] = gain @ pose_covariance
        covariance[:6, 6:] = covariance[6:, :6].T
        covariance[6:, 6:] = rest + gain @ pose_covariance @ gain.T
    return state


def _edge_records(edges: Sequence[WindowEdge], notes: list[str]) -> list[EdgeRecord]:
    """Return the edges that can be used; `notes` gets what is wrong with others."""
    whats = [f"the window's edge from {edge.from_id} to {edge.to_id}" for edge in edges]
    try:
        motions = checked_poses([edge.T_from_to for edge in edges], whats)
        covariances = checked_covariances([edge.covariance for edge in edges], 6, whats)
    except DataError as error:
        if len(edges) > 1:
            return [record for edge in edges for record in _edge_records([edge], notes)]
        notes.append(str(error))
        return []
    return [
        EdgeRecord(edge.to_id, T, covariance, edge.settled)
        for edge, T, covariance in zip(edges, motions, covariances, strict=True)
    ]


def _is_direction(v: Array) -> bool:
    return bool(abs(float(np.linalg.norm(v)) - 1.0) < 1e-6)


def _better_state(packet: KeyframePacket, newest: NavState | None) -> tuple[NavState | None, str]:
    """Return the filter's state and why, where the window has to begin again at it; None: the window may go on.

    After a blind stretch by inertial data alone its speed is metres per second off, too far to be linearised there.
    And from steady motion into a turn a window of one camera may take a tilt for an acceleration, and be sure of it.
    """
    if newest is None:
        return None, ""
    known, at_sight = packet.filter_state, packet.state_at_sight
    if at_sight is not None:
        window_m2_s2, filter_m2_s2 = (float(np.trace(s.covariance[6:9, 6:9])) for s in (newest, at_sight))
        if window_m2_s2 > _FAR_SURER * filter_m2_s2:
            return at_sight, "the window begins anew, for the filter knew the way in the dark"
    if known is not None and known.t_ns == newest.t_ns:
        (ours, P), (theirs, Q) = _body_velocity(newest), _body_velocity(known)
        apart = ours - theirs
        if float(apart @ np.linalg.solve(P + Q, apart)) > _CONTRADICTION:
            off = f"off by {float(np.linalg.norm(apart)):.2f} m/s"
            return (
                known,
                f"the window begins anew: its speed is {off} from the filter's, which a sensor of motion tells",
            )
    return None, ""


def _body_velocity(state: NavState) -> tuple[Array, Array]:
    """Return the velocity [3] in the body's axes and its covariance [3, 3]."""
    R = state.T_world_body[:3, :3]
    velocity = R.T @ state.velocity_world_m_s
    J = np.hstack([skew(velocity), R.T])
    index = np.r_[0:3, 6:9]
    return velocity, J @ state.covariance[np.ix_(index, index)] @ J.T
