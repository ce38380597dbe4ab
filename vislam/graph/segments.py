"""Segments: stretches of old keyframes that loops tie so well to anchors that what they say can be summed up."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from vislam.core.geometry import invert, se3_adjoint, se3_exp, se3_log
from vislam.core.messages import Array
from vislam.factors.builder import Label
from vislam.factors.keys import X, nearest_rigid
from vislam.factors.loop import LoopModel, relative_covariance
from vislam.factors.noise_models import gaussian
from vislam.factors.visual import pose_factor

_DENSE = 0.25  # loops per keyframe of a segment whose place anchors know; without scale three count as one
_RATIO_MAX = 1e6  # eigenvalues of a tie's covariance, as of other factors


@dataclass(frozen=True, slots=True)
class Segment:
    """Keyframes `first` to `end`, that excluded, with their loops, all of which tie them to older anchors."""

    first: int
    end: int
    loops: tuple[int, ...]  # ids
    anchors: tuple[int, ...]  # keyframes at the older ends, ascending

    @property
    def keyframes(self) -> range:
        """Return its keyframes."""
        return range(self.first, self.end)

    @property
    def labels(self) -> list[Label]:
        """Return the names of the factors that tie its keyframes to one another and to others."""
        inside = [label for k in self.keyframes for label in (("edge", k), ("tilt", k))]
        return [*inside, ("edge", self.end), *(("loop", n) for n in self.loops)]


@dataclass(frozen=True, slots=True, eq=False)
class Stand:
    """Where a keyframe stands that left the solver."""

    host: int  # keyframe that the solver has
    T_host_self: Array  # [4, 4]
    covariance: Array  # [6, 6] of that, perturbed at the keyframe


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """What segments that left the solver say of the way from one keyframe to another, most of them anchors."""

    T_from_to: Array  # [4, 4]
    covariance: Array  # [6, 6] of that, perturbed at the end

    def with_another(self, other: Link) -> Link:
        """Return what both say together, each independent of the other: their information adds up."""
        step = se3_log(invert(self.T_from_to) @ other.T_from_to)
        gain = self.covariance @ np.linalg.inv(self.covariance + other.covariance)
        left = self.covariance - gain @ self.covariance
        return Link(nearest_rigid(self.T_from_to @ se3_exp(gain @ step)), 0.5 * (left + left.T))

    def factor(self, a: int, b: int) -> gtsam.NonlinearFactor:
        """Return the factor between keyframes a and b."""
        return pose_factor(X(a), X(b), self.T_from_to, gaussian(self.covariance, _RATIO_MAX))


@dataclass(frozen=True, slots=True, eq=False)
class Summary:
    """What is left of a segment."""

    links: dict[tuple[int, int], Link]  # between the keyframes around it
    stands: dict[int, Stand]  # of its keyframes


class SummedUp:
    """Owns what is left of all segments that left a solver: nothing after a new start, which has all of them again."""

    def __init__(self) -> None:
        """Start empty."""
        self.firsts: set[int] = set()  # first keyframes of segments that were tried
        self.pinned: set[int] = set()  # keyframes on which hangs what segments know
        self.stands: dict[int, Stand] = {}  # of keyframes that left
        self._links: dict[tuple[int, int], tuple[Link, int]] = {}  # between anchors, with their slots

    def host(self, k: int) -> int:
        """Return the keyframe beside which keyframe k stands; k itself where the solver has it."""
        stand = self.stands.get(k)
        return k if stand is None else stand.host

    def joined(self, summary: Summary) -> dict[tuple[int, int], Link]:
        """Return the links of a summary, each together with those of earlier segments between the same anchors."""
        held = self._links
        return {p: held[p][0].with_another(link) if p in held else link for p, link in summary.links.items()}

    def slots(self, pairs: Iterable[tuple[int, int]]) -> list[int]:
        """Return the slots of links between anchors, as far as there are some."""
        return [self._links[pair][1] for pair in pairs if pair in self._links]

    def take(
        self, segment: Segment, summary: Summary, links: dict[tuple[int, int], Link], slots: Sequence[int]
    ) -> None:
        """Take what is left of a segment: its links, joined with earlier ones, are in these slots of the solver."""
        inside = {*segment.keyframes}
        self._links = {pair: own for pair, own in self._links.items() if not {*pair} & inside}
        self._links |= {pair: (link, slot) for (pair, link), slot in zip(links.items(), slots, strict=True)}
        self.stands |= summary.stands
        self.pinned |= {*segment.anchors}


@dataclass(slots=True)
class _Ties:
    """What ties a segment to older ones."""

    loops: list[LoopModel] = field(default_factory=list)
    weight: float = 0.0
    is_anchor: bool = False  # loops or segments tie to one of its keyframes


def segments(
    loops: Iterable[LoopModel], size: int, last: int, *, frozen: Collection[int] = (), pinned: Collection[int] = ()
) -> Iterator[Segment]:
    """Yield the segments of `size` keyframes up to `last`, oldest first, that loops tie to older keyframes.

    No loop ties to them. Segments that begin with one of `frozen` are summed up already, and beside the keyframes
    `pinned` stand others: none of these is yielded.
    """
    ties: dict[int, _Ties] = {}
    for model in loops:
        a, b = _older(model) // size, model.record.to_id // size
        ties.setdefault(a, _Ties()).is_anchor = True
        own = ties.setdefault(b, _Ties())
        own.loops.append(model)
        if a < b:
            own.weight += 1.0 if model.record.has_scale else 1.0 / 3.0
    apart = {0, *(k // size for k in frozen), *(k // size for k in pinned)}
    for n in sorted(ties.keys() - apart):
        own = ties[n]
        if own.weight >= _DENSE * size and not own.is_anchor and (n + 1) * size <= last:
            anchors = tuple(sorted({_older(m) for m in own.loops}))
            yield Segment(n * size, (n + 1) * size, tuple(m.id for m in own.loops), anchors)


def summarised(
    graph: gtsam.GaussianFactorGraph, segment: Segment, poses: Mapping[int, Array], around: list[int], known: Array
) -> Summary:
    """Return what a segment's own factors say of the keyframes around it, and where its keyframes stand beside anchors.

    Args:
        graph: these factors, linearised at `poses`.
        segment: the keyframes, which leave the solver.
        poses: T_map_body [4, 4] of the segment's keyframes and those around.
        around: ids of all others that the factors touch, among them the anchors.
        known: joint covariance [6 A, 6 A] of these as the solver has it, with the segment.

    Raises:
        numpy.linalg.LinAlgError: the factors do not determine where the keyframes are.
    """
    order = gtsam.Ordering()
    for k in (*segment.keyframes, *around):
        order.push_back(X(k))
    H, eta = (np.asarray(part) for part in graph.hessian(order))
    own = 6 * len(segment.keyframes)
    spread = np.linalg.inv(H[:own, :own])
    carry = -spread @ H[:own, own:]
    cross = carry @ known
    joint = np.block([[spread + cross @ carry.T, cross], [cross.T, known]])
    information, shift = H[own:, own:] + H[own:, :own] @ carry, eta[own:] + carry.T @ eta[:own]
    return Summary(_tree(information, shift, around, poses), _stands(joint, segment, around, poses))


def joint_beside(stands: Mapping[int, Stand], keys: list[int], solved: Callable[[list[int]], Array]) -> Array:
    """Return the joint marginal of variables, of which `solved` gives those that the solver has.

    How one stands beside another errs independently of all else.
    """
    beside = [stands.get(key - X(0)) for key in keys]
    if not any(beside):
        return solved(keys)
    hosts = [key if stand is None else X(stand.host) for key, stand in zip(keys, beside, strict=True)]
    unique = sorted(set(hosts))
    known = solved(unique)
    carry, own = np.zeros((6 * len(keys), 6 * len(unique))), np.zeros((6 * len(keys), 6 * len(keys)))
    for n, (host, stand) in enumerate(zip(hosts, beside, strict=True)):
        rows, columns = slice(6 * n, 6 * n + 6), slice(6 * unique.index(host), 6 * unique.index(host) + 6)
        carry[rows, columns] = np.eye(6) if stand is None else se3_adjoint(invert(stand.T_host_self))
        own[rows, rows] = 0.0 if stand is None else stand.covariance
    return np.asarray(carry @ known @ carry.T + own)


def _tree(information: Array, shift: Array, ids: list[int], poses: Mapping[int, Array]) -> dict[tuple[int, int], Link]:
    """Return relative poses between keyframes, by their `information` [6 A, 6 A] and its vector `shift`.

    They make the tree of the surest ones. What two of them err in common is lost, as in the tree of Chow and Liu that
    Carlevaris-Bianco et al. keep ("Generic node removal for factor-graph SLAM", T-RO 2014).
    """
    covariance = np.zeros(information.shape)  # where the first stays
    covariance[6:, 6:] = np.linalg.inv(information[6:, 6:])
    steps = covariance @ shift
    moved = {k: poses[k] @ se3_exp(steps[6 * n : 6 * n + 6]) for n, k in enumerate(ids)}
    pairs: dict[tuple[int, int], tuple[float, Array]] = {}
    for n, a in enumerate(ids):
        for m, b in enumerate(ids[n + 1 :], n + 1):
            own = _relative(moved[a], moved[b], covariance, n, m)
            pairs[a, b] = float(np.linalg.slogdet(own)[1]), own
    out: dict[tuple[int, int], Link] = {}
    reached = {ids[0]}
    while len(reached) < len(ids):
        open_ = [pair for pair in pairs if (pair[0] in reached) != (pair[1] in reached)]
        a, b = min(open_, key=lambda pair: pairs[pair][0])
        out[a, b] = Link(nearest_rigid(invert(moved[a]) @ moved[b]), pairs[a, b][1])
        reached |= {a, b}
    return out


def _stands(joint: Array, segment: Segment, around: list[int], poses: Mapping[int, Array]) -> dict[int, Stand]:
    """Let each of a segment's keyframes stand beside the nearest anchor; `joint` is of keyframes and those around."""
    places = np.stack([poses[k][:3, 3] for k in segment.anchors])
    out: dict[int, Stand] = {}
    for n, k in enumerate(segment.keyframes):
        nearest = int(np.argmin(np.linalg.norm(places - poses[k][:3, 3], axis=1)))
        host = segment.anchors[nearest]
        at = len(segment.keyframes) + around.index(host)
        covariance = _relative(poses[host], poses[k], joint, at, n)
        out[k] = Stand(host, nearest_rigid(invert(poses[host]) @ poses[k]), covariance)
    return out


def _relative(T_a: Array, T_b: Array, joint: Array, a: int, b: int) -> Array:
    """Return the covariance [6, 6] of T_a_b from the joint one, in which the poses are number a and b."""
    rows = np.r_[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]
    return relative_covariance(T_a, T_b, joint[np.ix_(rows, rows)])


def _older(model: LoopModel) -> int:
    """Return the keyframe to which the graph ties the newer end of a loop."""
    return model.record.from_id if model.tie is None else model.tie.from_id
