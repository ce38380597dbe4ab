"""Segments: stretches of old keyframes that loops tie so well to anchors that what they say can be summed up."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import gtsam
import numpy as np

from vislam.factors.keys import X, nearest_rigid
from vislam.factors.known import Known
from vislam.factors.loop import LoopModel
from vislam.factors.noise import gaussian
from vislam.factors.visual import pose_factor

_DENSE = 0.25  # loops per keyframe that let a segment do without its neighbours; without scale three count as one
_FIXED = 1e-4  # sigma, rad and m, of the central keyframe while its segment is summed up: far below any measured one
_RATIO_MAX = 1e6  # eigenvalues of a tie's covariance, as of other factors


@dataclass(frozen=True, slots=True)
class Segment:
    """Keyframes `first` to `end`, that excluded, with their loops, all of which tie them to older anchors."""

    first: int
    end: int
    loops: tuple[int, ...]  # ids
    anchors: tuple[int, ...]  # keyframes at the older ends, ascending

    @property
    def centre(self) -> int:
        """Return the keyframe in the middle."""
        return (self.first + self.end) // 2


@dataclass(slots=True)
class _Ties:
    """What ties a segment to older ones."""

    loops: list[LoopModel] = field(default_factory=list)
    weight: float = 0.0
    is_anchor: bool = False  # loops tie to one of its keyframes


def segments(loops: Iterable[LoopModel], size: int, last: int) -> Iterator[Segment]:
    """Yield the segments of `size` keyframes up to `last`, oldest first, that loops tie to older keyframes.

    Their neighbours are tied as well, so that none comes loose when the odometry between them is cut, and no loop ties
    to them.
    """
    ties: dict[int, _Ties] = {}
    for model in loops:
        a, b = _older(model) // size, model.record.to_id // size
        ties.setdefault(a, _Ties()).is_anchor = True
        own = ties.setdefault(b, _Ties())
        own.loops.append(model)
        if a < b:
            own.weight += 1.0 if model.record.has_scale else 1.0 / 3.0
    held = {0} | {n for n, own in ties.items() if own.weight >= _DENSE * size}
    for n in sorted(held - {0}):
        own = ties[n]
        if own.is_anchor or (n + 1) * size > last or not {n - 1, n + 1} <= held:
            continue
        anchors = tuple(sorted({_older(m) for m in own.loops}))
        yield Segment(n * size, (n + 1) * size, tuple(m.id for m in own.loops), anchors)


def summarised(
    factors: gtsam.NonlinearFactorGraph, segment: Segment, values: gtsam.Values
) -> list[gtsam.NonlinearFactor]:
    """Return what a segment's own factors say of its anchors, as relative poses to its central keyframe.

    One for each anchor: what they err in common, the odometry between the places where their loops end, is taken for
    independent, as in the tree of Chow and Liu that Carlevaris-Bianco et al. keep ("Generic node removal for
    factor-graph SLAM", T-RO 2014). `values` has all poses, near the solution.

    Raises:
        RuntimeError: the factors do not determine where the anchors are.
    """
    local, centre = gtsam.Values(), X(segment.centre)
    for k in (*range(segment.first, segment.end), *segment.anchors):
        local.insert(X(k), values.atPose3(X(k)))
    graph = gtsam.NonlinearFactorGraph(factors)
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED)
    graph.add(gtsam.PriorFactorPose3(centre, local.atPose3(centre), fixed))
    steps, marginals = graph.linearize(local).optimize(), gtsam.Marginals(graph, local)
    out: list[gtsam.NonlinearFactor] = []
    T_centre_map = local.atPose3(centre).inverse()
    for k in segment.anchors:
        T = T_centre_map.compose(local.atPose3(X(k)).retract(steps.at(X(k))))
        model = gaussian(np.asarray(marginals.marginalCovariance(X(k))), _RATIO_MAX)
        out.append(pose_factor(centre, X(k), nearest_rigid(T.matrix()), model))
    return out


def shape_factors(known: Known, segment: Segment) -> list[gtsam.NonlinearFactor]:
    """Return factors that keep a segment's keyframes where they are, as well as that is known.

    They stand around a hub beside the central keyframe: gtsam asks all that stand around a keyframe tied to anchors
    whether they moved, with each update.
    """
    centre, hub = segment.centre, segment.centre + 1
    pairs = [(centre, hub)] + [(hub, k) for k in range(segment.first, segment.end) if k not in (centre, hub)]
    out: list[gtsam.NonlinearFactor] = []
    for a, b in pairs:
        model = gaussian(known.relative(a, b), _RATIO_MAX)
        out.append(pose_factor(X(a), X(b), nearest_rigid(known.motion(a, b)), model))
    return out


def _older(model: LoopModel) -> int:
    """Return the keyframe to which the graph ties the newer end of a loop."""
    return model.record.from_id if model.tie is None else model.tie.from_id
