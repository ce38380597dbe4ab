"""Where a submap belongs: the rigid motion on which loops from several frames agree.

Between submaps that no odometry ties there is nothing that a loop could be tested against, so loops have to be each
other's witnesses: through the odometry inside both submaps they must say the same, and one image is one witness however
many old keyframes it resembles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from vislam.config import GraphConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import invert, se3_adjoint, transform
from vislam.core.messages import Array, LoopDecision, Submaps
from vislam.factors.journal import KeyframeRecord, checked_pose
from vislam.factors.keys import nearest_rigid
from vislam.factors.loop import LoopModel
from vislam.factors.motion import SUBMAP_SIGMA_DEG
from vislam.graph.belief import LoopSet
from vislam.graph.estimator import Estimator
from vislam.graph.source import Source
from vislam.graph.travel import Travel

_CONSISTENCY_MAX_SIGMA_M = 0.5  # odometry looser than this between two loops proves nothing
_SUBMAP_TILT_SIGMA_DEG = 5.0  # roll and pitch, where gravity is known on both sides
# new frames whose loops must agree through odometry to join two submaps: one image can deceive
JOIN_FRAMES = 2
_JOIN_WAITING = 20  # newest loops between submaps that are compared for that; bounds the work
_JOIN_MAX_CONTRADICTING = 0.25  # of the loops between two submaps; more, and they wait for further ones
# how well a place has to fit a tie, whose sigmas have their tails in them: what does not may be the next panel
_TIE_LIMIT = chi_square_limit(0.9, 6)
_REACH_SIGMAS = 6.0  # of a tie, within which a place counts as possible beside another one
_FRAME_REACH_M = (2.0, 5.0)  # beyond each of which one frame more has to agree
_NEAR_KEYFRAMES = 10  # between which summed odometry bounds what is known well enough
_MIN_RAY_ANGLE_RAD = np.deg2rad(5.0)  # between two directions that are to fix a place

RelativeCovariance = Callable[[int, int], Array]  # of T_i_j [6, 6], perturbed at j


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """The motion [4, 4], in map, that brings a group of submaps to where loops say it is, and the loops that agree."""

    group: int
    T_map_moved: Array
    agreeing: list[LoopModel]


class Waiting:
    """Loops between submaps that are not joined.

    Attributes:
        undecided: what else is possible where loops agree on a place, by the group that they would place.
    """

    def __init__(self, config: GraphConfig) -> None:
        """Start empty."""
        self._limit = chi_square_limit(config.loop_gate_probability, 6)
        self._edges: list[LoopModel] = []
        self.undecided: dict[int, str] = {}

    @property
    def edges(self) -> list[LoopModel]:
        """Return the loops that wait, oldest first."""
        return list(self._edges)

    def add(self, edge: LoopModel) -> LoopModel | None:
        """Take a loop; return the oldest when it has to leave for this one."""
        self._edges.append(edge)
        return self._edges.pop(0) if len(self._edges) > _JOIN_WAITING else None

    def take_joined(self, submaps: Submaps) -> list[LoopModel]:
        """Remove and return the loops whose two ends are joined by now."""
        joined = [e for e in self._edges if submaps.are_joined(e.record.from_id, e.record.to_id)]
        self._edges = [e for e in self._edges if not submaps.are_joined(e.record.from_id, e.record.to_id)]
        return joined

    def place(
        self, submaps: Submaps, poses: Array, known: RelativeCovariance, tie: RelativeCovariance | None = None
    ) -> Placement | None:
        """Return where the newer of two groups belongs, if enough of its loops agree on that; those wait no longer.

        Loops that contradict the tie between two groups wait, and so do all while one speaks for another place that
        the tie does not exclude either: a wall of equal panels fits one panel further as well.

        `poses` [M, 4, 4] are good within each group, as `known` has it, and as `tie` has it between those that are
        tied; None: none are.
        """
        self.undecided = {}
        pairs = [(submaps.group(e.record.from_id), submaps.group(e.record.to_id)) for e in self._edges]
        for pair in sorted({(min(p), max(p)) for p in pairs}):
            edges = [e for e, p in zip(self._edges, pairs, strict=True) if (min(p), max(p)) == pair]
            if len({e.record.to_id for e in edges}) < JOIN_FRAMES:
                continue
            ends = _Ends(poses, submaps, pair[1])
            tied = [r for e in edges if (r := e.record).has_scale and submaps.are_tied(r.from_id, r.to_id)]
            ties = {} if tie is None else {r.id: tie(r.from_id, r.to_id) for r in tied}
            fitting = [e for e in edges if e.record.id not in ties or self._fits(e, ties[e.record.id], ends)]
            found = self._place(fitting, ends, known)
            if found is None:
                continue
            is_open = len(fitting) - len(found[1]) > _JOIN_MAX_CONTRADICTING * len(fitting)
            if rival := self._rival(found, edges, ties, ends, np.inf if is_open else 0.0):
                self.undecided[pair[1]] = rival
            if rival or is_open:
                continue
            self._edges = [e for e in self._edges if all(e is not other for other in found[1])]
            return Placement(pair[1], *found)
        return None

    def _fits(self, edge: LoopModel, tie: Array, ends: _Ends) -> bool:
        """Return whether a loop agrees with the covariance [6, 6] of the tie between its ends."""
        return edge.chi2(*ends.of(edge, np.eye(4)), tie) < _TIE_LIMIT

    def _rival(
        self, found: tuple[Array, list[LoopModel]], edges: list[LoopModel], ties: dict[int, Array], ends: _Ends,
        reach_m: float,
    ) -> str:  # fmt: skip
        """Return which other place is within reach of the tie, or that too few frames agree on this one; else nothing.

        `reach_m` is that where nothing ties.
        The farther the tie reaches the more frames have to agree: to each of them another panel may look most alike.
        """
        T, agreeing = found
        sigmas_m = [np.sqrt(np.linalg.eigvalsh(ties[e.record.id][3:, 3:])[-1]) for e in agreeing if e.record.id in ties]
        reach_m = _REACH_SIGMAS * min(sigmas_m) if sigmas_m else reach_m
        need = JOIN_FRAMES + sum(reach_m > step_m for step_m in _FRAME_REACH_M if sigmas_m)
        if len({e.record.to_id for e in agreeing}) < need:
            return f"{need} frames have to agree on a place, as it may be {reach_m:.1f} m from where habit has it"
        for e in edges:
            if e.record.has_scale and all(e is not one for one in agreeing):
                off_m = float(np.linalg.norm(e.residual(*ends.of(e, T))[0][3:]))
                if off_m < reach_m:
                    return f"keyframe {_places(agreeing[0])}, or {off_m:.1f} m from there, as {_places(e)}"
        return ""

    def _place(
        self, edges: list[LoopModel], ends: _Ends, known: RelativeCovariance
    ) -> tuple[Array, list[LoopModel]] | None:
        """Return the motion with the most witnesses, and those, if they are enough."""
        best: tuple[Array, list[LoopModel]] | None = None
        metric = [e for e in edges if e.record.has_scale]
        for edge in metric:
            T = ends.motion_by(edge)
            agreeing = [e for e in edges if e is edge or self._agree(edge, e, T, ends, known)]
            if best is None or _witnesses(agreeing) > _witnesses(best[1]):
                best = T, agreeing
        if not metric:
            best = self._place_by_directions(edges, ends)
        return None if best is None or len({e.record.to_id for e in best[1]}) < JOIN_FRAMES else best

    def _agree(self, one: LoopModel, other: LoopModel, T: Array, ends: _Ends, known: RelativeCovariance) -> bool:
        """Return whether a loop agrees with the motion `T` that follows from another one, to their uncertainty."""
        a, b = one.record, other.record
        T_from, T_to = ends.of(other, T)
        if self._are_far(other, T_from, T_to):
            return False
        uncertainty = np.zeros((6, 6))
        if b.to_id != a.to_id:
            uncertainty += known(a.to_id, b.to_id)
        T_one_from, T_one_to = ends.of(one, T)
        back = se3_adjoint(invert(T_to) @ T_one_to)
        uncertainty += back @ one.covariance @ back.T
        if b.from_id != a.from_id:
            back = se3_adjoint(invert(T_to) @ T_one_from)
            uncertainty += back @ known(b.from_id, a.from_id) @ back.T
        if np.trace(uncertainty[3:, 3:]) > 3.0 * _CONSISTENCY_MAX_SIGMA_M**2:
            return False  # odometry so loose proves nothing
        return other.chi2(T_from, T_to, uncertainty) < self._limit

    def _are_far(self, edge: LoopModel, T_from: Array, T_to: Array) -> bool:
        """Return whether a loop misses by more than any uncertainty that may prove something: no marginal is needed."""
        if not edge.record.has_scale:
            return False
        missed_m = edge.residual(T_from, T_to)[0][3:]
        most_m2 = 3.0 * _CONSISTENCY_MAX_SIGMA_M**2 + np.trace(edge.covariance[3:, 3:])
        return bool(missed_m @ missed_m > self._limit * most_m2)

    def _place_by_directions(self, edges: list[LoopModel], ends: _Ends) -> tuple[Array, list[LoopModel]] | None:
        """Return the motion that lets most loops without scale look along their directions, at least three of them."""
        best: tuple[Array, list[LoopModel]] | None = None
        for pair in combinations(edges, 2):
            T = ends.motion_by_rays(list(pair))
            if T is None:
                continue
            agreeing = [e for e in edges if e.chi2(*ends.of(e, T)) < self._limit]
            if len(agreeing) > 2 and (best is None or _witnesses(agreeing) > _witnesses(best[1])):
                best = T, agreeing
        return best


def _places(edge: LoopModel) -> str:
    return f"{edge.record.to_id} is at keyframe {edge.record.from_id}"


@dataclass(frozen=True, slots=True, eq=False)
class _Ends:
    """The poses of both ends of a loop, one of which moves with its group."""

    poses: Array  # [M, 4, 4]
    submaps: Submaps
    moving: int  # the group

    def of(self, edge: LoopModel, T: Array) -> tuple[Array, Array]:
        """Return both poses [4, 4] once the group has moved by T [4, 4]."""
        older, newer = self.poses[edge.record.from_id], self.poses[edge.record.to_id]
        return (T @ older, newer) if self._older_moves(edge) else (older, T @ newer)

    def motion_by(self, edge: LoopModel) -> Array:
        """Return the motion [4, 4] that a metric loop asks for."""
        older, newer, T = self.poses[edge.record.from_id], self.poses[edge.record.to_id], edge.record.T_from_to
        motion = newer @ invert(older @ T) if self._older_moves(edge) else older @ T @ invert(newer)
        return nearest_rigid(motion)

    def motion_by_rays(self, edges: list[LoopModel]) -> Array | None:
        """Return the motion [4, 4] that lets rays of loops without scale meet best; None when they are parallel."""
        R: Array | None = None
        A, b = np.zeros((3, 3)), np.zeros(3)
        for edge in edges:
            older, newer, T = self.poses[edge.record.from_id], self.poses[edge.record.to_id], edge.record.T_from_to
            moves, turned, ray = self._older_moves(edge), older[:3, :3] @ T[:3, :3], older[:3, :3] @ T[:3, 3]
            if R is None:
                R = newer[:3, :3] @ turned.T if moves else turned @ newer[:3, :3].T
            ray = R @ ray if moves else ray
            still, moving = edge.eye(newer if moves else older), R @ edge.eye(older if moves else newer)
            if np.linalg.norm(ray) < 0.5:  # rotation alone
                return None
            across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
            A += across
            b += across @ (still - moving)
        if R is None or np.linalg.eigvalsh(A)[0] < 0.5 * len(edges) * _MIN_RAY_ANGLE_RAD**2 / 2.0:
            return None
        return nearest_rigid(transform(R, np.linalg.solve(A, b)))

    def _older_moves(self, edge: LoopModel) -> bool:
        return self.submaps.group(edge.record.from_id) == self.moving


class Joining:
    """Owns which submaps are joined, and joins more as far as loops between them agree."""

    def __init__(
        self, config: GraphConfig, source: Source, estimator: Estimator, loops: LoopSet, travel: Travel
    ) -> None:
        """Start with one submap; `travel` is the odometry between the estimator's keyframes."""
        self._source = source
        self._estimator = estimator
        self._loops = loops
        self._travel = travel
        self._waiting = Waiting(config)
        self.submaps = Submaps()

    @property
    def waiting(self) -> list[LoopModel]:
        """Return the loops between submaps that are not joined, oldest first."""
        return self._waiting.edges

    def begin(self, k: int, is_tied: bool) -> None:
        """Let a submap begin with keyframe k; `is_tied` as in KeyframePacket."""
        self.submaps = self.submaps.begun(k, is_tied)

    def restore(self, waiting: list[LoopModel]) -> None:
        """Take over the loops that waited in an earlier run, once the submaps and the other loops are there."""
        for model in waiting:
            self._waiting.add(model)
        self.count()

    def count(self) -> None:
        """Find out which submaps are joined, by the loops that the graph holds now."""
        if len(self.submaps.groups) > 1:
            self.submaps = self.submaps.joined_by((m.record.from_id, m.record.to_id) for m in self._loops.held)

    def wait(self, model: LoopModel) -> list[int]:
        """Let a loop between submaps that are not joined wait for other frames; return the ids of those that left."""
        self._loops.wait(model)
        gone = self._waiting.add(model)
        if gone is None:
            return []
        self._loops.ledger.add(gone, LoopDecision.REJECTED, "too many newer ones wait")
        return [gone.record.id]

    def join(self, touched: list[int], notes: list[str]) -> list[LoopModel]:
        """Join submaps as far as loops between them agree; return those that waited and can be gated now."""
        loops, place = self._loops, self._waiting.place
        covariances = self._known, loops.gate.relative_covariance
        while (found := place(self.submaps, self._estimator.poses, *covariances)) is not None:
            touched += [m.record.id for m in found.agreeing]
            self._bring(found, notes)
            witnesses = f"{len(found.agreeing)} loops of {len({m.record.to_id for m in found.agreeing})} frames"
            for model in loops.accept(found.agreeing, notes, f"joins two submaps, as {witnesses} say"):
                loops.ledger.add(model, LoopDecision.REJECTED, "though it was to join two submaps")
            for model in found.agreeing:
                loops.offer(model)
            kept = [m for m in found.agreeing if m.record.id in self._estimator.loops]
            if len({m.record.to_id for m in kept}) < JOIN_FRAMES:
                for model in kept:
                    loops.ledger.add(model, LoopDecision.REJECTED, "its witnesses against one another do not hold")
                notes.append(self._estimator.drop(kept))
            self.count()
        ready = self._waiting.take_joined(self.submaps)
        touched += [m.record.id for m in ready]
        for model in self.waiting:
            ends = self.submaps.group(model.record.from_id), self.submaps.group(model.record.to_id)
            loops.wait(model, self._waiting.undecided.get(max(ends), ""))
        return ready

    def _bring(self, found: Placement, notes: list[str]) -> None:
        """Move a group of submaps to where loops say that it is, with the weak links that it has to others."""
        every = np.arange(len(self._estimator.poses), dtype=np.int64)
        ids = every[self.submaps.groups_of(every) == found.group]
        self._estimator.look_at(every.tolist())
        poses = self._estimator.poses.copy()
        poses[ids] = found.T_map_moved @ poses[ids]
        for k in [k for k in relinked(self.submaps, ids) if k not in self.submaps.tied_ids]:
            self._source.odometry.relink(k, invert(poses[k - 1]) @ poses[k])
        notes.append(self._estimator.move(ids, found.T_map_moved))
        notes.append(
            f"submap {found.group}, {len(ids)} keyframes with what it was joined with before, joins an older one"
        )

    def _known(self, i: int, j: int) -> Array:
        """Return the covariance [6, 6] of T_i_j: by summed odometry, an upper bound, where that is short."""
        if abs(i - j) <= _NEAR_KEYFRAMES and self.submaps.of(i) == self.submaps.of(j):
            return self._travel.relative_covariance(i, j)
        return self._loops.gate.relative_covariance(i, j)


def _witnesses(edges: list[LoopModel]) -> tuple[int, int]:
    """Return how many frames a set of loops comes from, and how many loops it has."""
    return len({e.record.to_id for e in edges}), len(edges)


def relinked(submaps: Submaps, moved: NDArray[np.int64]) -> list[int]:
    """Return the keyframes that begin a submap and move otherwise than the one before them."""
    inside = set(moved.tolist())
    return [k for k in submaps.first_ids[1:] if (k in inside) != (k - 1 in inside)]


def weak_link(
    record: KeyframeRecord, T_map_before: Array, T_odom_before: Array | None, T_odom_body: Array | None,
    has_gravity: bool, config: GraphConfig,
) -> KeyframeRecord:  # fmt: skip
    """Return the record of a keyframe that begins a submap, tied to the one before as loosely as it deserves.

    By habit where that is known, see `KeyframeRecord.is_tied`; else the motion is what odom makes of it, a guess for
    the eye. Without any tie the equations had no unique solution.

    Raises:
        DataError: a pose in odom is none.
    """
    if record.is_tied:
        return record
    T = np.eye(4)
    if T_odom_before is not None and T_odom_body is not None:
        T = checked_pose(invert(T_odom_before) @ T_odom_body, f"keyframe {record.id}: its motion in odom")
    variances = np.full(3, np.deg2rad(SUBMAP_SIGMA_DEG) ** 2)
    if has_gravity:
        variances[:2] = np.deg2rad(_SUBMAP_TILT_SIGMA_DEG) ** 2
    R = (T_map_before @ T)[:3, :3]
    covariance = np.eye(6) * config.submap_sigma_m**2
    covariance[:3, :3] = R.T @ np.diag(variances) @ R
    return replace(record, T_previous_body=T, covariance=covariance)
