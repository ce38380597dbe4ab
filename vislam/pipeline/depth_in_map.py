"""Where a keyframe is in the map of an earlier run by its depth, where images find none: in the dark, in other light.

A rough pose must be known: carried on from the last loop through odometry, with its covariance from the graph, or given
by the user. The pose by depth (`DepthLocaliser`) is offered as a loop like any other once several keyframes in a row
agree through odometry; the graph tests it then as it tests all.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import invert, se3_adjoint, se3_log
from vislam.core.memory import SlamMemory
from vislam.core.messages import Array, GraphUpdate, Keyframe, KeyframePacket, LoopEdge, Submaps
from vislam.frontend.by_depth import DEPTH_APART_S
from vislam.loop import Candidate, Verification
from vislam.mapping.depth.localise import DepthAnswer, Guess
from vislam.mapping.depth.stored import stored_depth
from vislam.trajectory.odometry_keyframe import OdometryKeyframe

RelativeCovariance = Callable[[int, int], Array]  # of T_i_j [6, 6], perturbed at j

_LEAST_M, _LEAST_DEG = 0.05, 3.0  # of a guess's standard deviations: where several starts are to end in one place
_GIVEN_M, _GIVEN_DEG = 0.3, 15.0  # of a pose given by the user: "near the charging station"
_DRIFT = 0.05  # of the way since then: odometry that nothing holds
_MOST_M, _MOST_DEG = 0.5, 20.0  # farther off, depth was measured to find false places


@dataclass(frozen=True, slots=True, eq=False)
class _Last:
    """What depth answered for a keyframe."""

    id: int
    answer: DepthAnswer
    in_a_row: int


class DepthInMap:
    """Asks the depth of a map's keyframes about new ones."""

    def __init__(self, config: Config, rig: Rig, memory: SlamMemory, submaps: Submaps) -> None:
        """Take the first `memory.map_keyframes` keyframes, those of the map, but for what no loop joined with it."""
        self._config = config.loop
        self._limit = chi_square_limit(config.graph.loop_gate_probability, 6)
        self._count = memory.map_keyframes
        poses = memory.graph.T_map_body
        of_map = {k: s for k, s in memory.scans.items() if k < self._count and submaps.group(k) == 0}
        self._localiser, self._ids = stored_depth(rig, config.map, of_map, poses)
        self._numbers = {k: n for n, k in enumerate(self._ids)}
        self._poses = {k: poses[k] for k in self._ids}
        self._submaps = submaps
        self._given = memory.T_guess
        self._T_map_odom_given: Array | None = None
        self._way_m, self._T_odom_before = 0.0, np.eye(4)
        self._since_s, self._t_ns_before = 0.0, 0  # from the keyframe before to the newest
        self._T_body_cam = rig.T_body_cams[0]
        self._last: _Last | None = None
        self.counters = {"asked": 0, "refused": 0, "alone": 0, "offered": 0}

    def guess(self, T_map_body: Array) -> None:
        """Take where the body is about now, [4, 4], at the next keyframe; it counts where the place is not known."""
        self._given, self._way_m = T_map_body, 0.0

    def move(self, update: GraphUpdate) -> None:
        """Follow the keyframes that the graph moved, and the submaps that it joined."""
        self._submaps = update.submaps
        for k, T in zip(update.ids.tolist(), update.T_map_body, strict=True):
            if k in self._numbers:
                self._poses[k] = T
                self._localiser.move(self._numbers[k], T)

    def look(
        self, odometry: OdometryKeyframe, T_map_odom: Array, known: RelativeCovariance, edges: Sequence[LoopEdge]
    ) -> tuple[Candidate, Verification] | None:
        """Return the loop proposed by a new keyframe's depth; None without a guess, or with a loop into the map.

        Args:
            odometry: the keyframe, which the graph does not have yet.
            T_map_odom: where the graph has odom [4, 4].
            known: covariance between keyframes of the graph.
            edges: loops that end with it already; one into the map is all that is wanted.
        """
        packet = odometry.packet
        self._follow(odometry)
        depth_m = packet.keyframe.frame.depth_m
        if depth_m is None or any(edge.from_id < self._count for edge in edges):
            return None
        guess = self._guess(odometry, T_map_odom, known)
        near = -1 if guess is None else self._localiser.nearest(guess.T_map_body)
        if guess is None or near < 0:
            return None
        self.counters["asked"] += 1
        T_body_then = self._body_at_depth(packet.keyframe)
        answer = self._localiser.localise(depth_m, replace(guess, T_map_body=guess.T_map_body @ T_body_then))
        T_map_body = answer.T_map_body @ invert(T_body_then)
        answer = replace(answer, T_map_body=T_map_body, covariance=answer.covariance + self._apart(packet))
        candidate = Candidate(self._ids[near], "depth", answer.overlap * answer.agreement)
        against = answer.reason or (
            "" if answer.determined == 6 else f"depth tells {answer.determined} of 6 directions"
        )
        if against:
            self.counters["refused"] += 1
            return candidate, Verification(f"by depth: {against}", 0)
        return self._in_a_row(packet, odometry.T_odom_body, candidate, answer)

    def _in_a_row(
        self, packet: KeyframePacket, T_odom_body: Array, candidate: Candidate, answer: DepthAnswer
    ) -> tuple[Candidate, Verification]:
        """Return an answer that nothing speaks against as a verified pose, if those before it agree."""
        wanted, last, k = self._config.depth_in_a_row, self._last, packet.keyframe.id
        agrees = last is not None and last.id == k - 1 and self._agree(last.answer, answer, packet)
        count = last.in_a_row + 1 if agrees and last is not None else 1
        self._last = _Last(k, answer, count)
        candidate = Candidate(candidate.id, candidate.source, candidate.score, count - 1)
        if agrees and self._T_map_odom_given is not None:
            self._T_map_odom_given, self._way_m = answer.T_map_body @ invert(T_odom_body), 0.0
        if count < wanted:
            self.counters["alone"] += 1
            return candidate, Verification(f"by depth: {count} of {wanted} keyframes in a row agree", 0)
        self.counters["offered"] += 1
        fits = f"by depth: {answer.overlap:.0%} overlaps, {answer.agreement:.0%} of it fits, {count} in a row agree"
        return candidate, Verification(
            fits, 0, T_a_b=invert(self._poses[candidate.id]) @ answer.T_map_body, covariance=answer.covariance,
            sigma_m=float(np.sqrt(np.linalg.eigvalsh(answer.covariance[3:, 3:])[-1])),
        )  # fmt: skip

    def _agree(self, before: DepthAnswer, now: DepthAnswer, packet: KeyframePacket) -> bool:
        """Return whether two answers are as far from one another as their keyframes are by odometry."""
        moved = packet.vo.T_keyframe_body
        if moved is None or packet.begins_submap:
            return False
        change = se3_log(invert(before.T_map_body @ moved) @ now.T_map_body)
        covariance = now.covariance + _carried(before.covariance, packet)
        return float(change @ np.linalg.solve(covariance, change)) < self._limit

    def _guess(self, odometry: OdometryKeyframe, T_map_odom: Array, known: RelativeCovariance) -> Guess | None:
        """Return where the body is thought to be; None where that is unknown, or known well enough already."""
        config, packet, T_odom_body = self._config, odometry.packet, odometry.T_odom_body
        k = packet.keyframe.id
        is_joined = not packet.begins_submap and self._submaps.group(k) == 0
        if not is_joined:
            if self._T_map_odom_given is None:
                return None
            sigma_m = _GIVEN_M + _DRIFT * self._way_m
            return Guess(self._T_map_odom_given @ T_odom_body, sigma_m, _GIVEN_DEG) if sigma_m <= _MOST_M else None
        self._T_map_odom_given = None  # loops know better
        T_map_body = T_map_odom @ T_odom_body
        near = self._localiser.nearest(T_map_body)
        if near < 0 or packet.vo.T_keyframe_body is None:
            return None
        covariance = _carried(known(self._ids[near], k - 1), packet)
        sigma_rad, sigma_m = (float(np.sqrt(np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1])) for i in (0, 3))
        sigma_deg = float(np.rad2deg(sigma_rad))
        if not (sigma_m <= _MOST_M and sigma_deg <= _MOST_DEG):
            return None
        if sigma_m <= config.depth_worth_m and sigma_deg <= config.depth_worth_deg:
            return None
        return Guess(T_map_body, max(sigma_m, _LEAST_M), max(sigma_deg, _LEAST_DEG))

    def _body_at_depth(self, keyframe: Keyframe) -> Array:
        """Return where the body was when depth was taken [4, 4], as seen from where it was for the image."""
        if keyframe.T_image_depth is None:
            return np.eye(4)
        return np.asarray(self._T_body_cam @ keyframe.T_image_depth @ invert(self._T_body_cam))

    def _apart(self, packet: KeyframePacket) -> Array:
        """Return the covariance [6, 6] of what is not known of when depth was taken, here and in the map, in motion."""
        moved = packet.vo.T_keyframe_body
        if moved is None or not self._since_s > 0.0:
            return np.zeros((6, 6))
        twist_per_s = se3_log(moved) / self._since_s
        return 2.0 * DEPTH_APART_S**2 * np.outer(twist_per_s, twist_per_s)

    def _follow(self, odometry: OdometryKeyframe) -> None:
        """Carry on the pose given for the first keyframe, and the time; a loss of track ends the former."""
        T_odom_body, t_ns = odometry.T_odom_body, odometry.packet.keyframe.t_ns
        self._since_s, self._t_ns_before = (t_ns - self._t_ns_before) * 1e-9, t_ns
        if self._given is not None:
            self._T_map_odom_given, self._given = self._given @ invert(T_odom_body), None
        elif odometry.packet.begins_submap:
            self._T_map_odom_given = None
        else:
            self._way_m += float(np.linalg.norm(T_odom_body[:3, 3] - self._T_odom_before[:3, 3]))
        self._T_odom_before = T_odom_body


def _carried(covariance: Array, packet: KeyframePacket) -> Array:
    """Return a covariance [6, 6] at the keyframe before as it is at this one, after visual odometry's motion."""
    moved = packet.vo.T_keyframe_body
    assert moved is not None, "asked only where there is a motion"
    adjoint = se3_adjoint(np.asarray(invert(moved)))
    return np.asarray(adjoint @ covariance @ adjoint.T + packet.vo.covariance)
