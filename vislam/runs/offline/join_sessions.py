"""Several sessions joined into one pose graph by loops between them: the library's side of `vislam optimize A B`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from vislam.batch.bundle.loops import loop_edges
from vislam.batch.posegraph.auto import decide
from vislam.batch.posegraph.domains import Team
from vislam.batch.posegraph.g2o import write_g2o
from vislam.batch.posegraph.optimize import PoseGraphSolution, optimize_pose_graph
from vislam.batch.posegraph.problem import PoseGraphProblem, RelativePoses
from vislam.batch.posegraph.uncertainty import Uncertainty
from vislam.config import PoseGraphConfig
from vislam.core.errors import TrackingLostError, UsageError
from vislam.core.files import storage, write_json, write_lines
from vislam.core.geometry import invert
from vislam.core.messages import Array, GraphUpdate, Submaps
from vislam.core.progress import Progress, silent
from vislam.factors import LoopModel, loop_record
from vislam.graph.joining import JOIN_FRAMES, RelativeCovariance, Waiting
from vislam.loop import LoopCloser
from vislam.runs.offline.session_graph import SessionPart, read_part
from vislam.trajectory import Trajectory, write_tum


@dataclass(frozen=True, slots=True, eq=False)
class LoopBetween:
    """A loop between two sessions and what became of it; keyframes are named as their session names them."""

    from_session: str
    from_id: int
    to_session: str
    to_id: int
    has_scale: bool
    inliers: int
    chi2: float  # at the optimum
    kept: bool


@dataclass(frozen=True, slots=True, eq=False)
class JoinedSessions:
    """Sessions in the map frame of the first, as one optimised pose graph."""

    names: tuple[str, ...]
    problem: PoseGraphProblem  # ids go on from session to session; loops that were found false are in it
    solution: PoseGraphSolution  # its start: each session in its own map
    first_ids: tuple[int, ...]  # of each session, in the problem
    trajectories: tuple[Trajectory, ...]  # of all frames of each session
    loops: tuple[LoopBetween, ...]
    summary: dict[str, Any]


def join_sessions(paths: Sequence[Path], progress: Progress = silent, team: Team | None = None) -> JoinedSessions:
    """Find loops between sessions (run folders or session files, only read) and optimise all of them as one graph.

    Loops between sessions are the only edges that may be found false. `team`: see `optimize_pose_graph`. Deterministic.
    Raises UsageError for sessions that do not fit together, DataError for one that cannot be used, TrackingLostError
    where no loops join them.
    """
    parts = _read(paths)
    search = _Search(parts)
    models, inliers = search.run(progress)
    return _optimised(parts, search, models, inliers, team)


def write_joined(joined: JoinedSessions, out: Path) -> None:
    """Write trajectory_NAME.tum of each session, joined.g2o, loops.csv and summary.json. Raises StorageError."""
    with storage(out):
        out.mkdir(parents=True, exist_ok=True)
    for name, trajectory in zip(joined.names, joined.trajectories, strict=True):
        write_tum(trajectory, out / f"trajectory_{name}.tum")
    kept = joined.problem.with_edges(joined.solution.weights != 0.0)
    write_g2o(kept, out / "joined.g2o", joined.solution.poses)
    rows = ["from_session,from_id,to_session,to_id,has_scale,inliers,chi2,kept"]
    rows += [
        f"{e.from_session},{e.from_id},{e.to_session},{e.to_id},{e.has_scale:d},{e.inliers},{e.chi2:.9g},{e.kept:d}"
        for e in joined.loops
    ]
    write_lines(out / "loops.csv", rows)
    write_json(out / "summary.json", joined.summary)


def _read(paths: Sequence[Path]) -> list[SessionPart]:
    """Return the sessions; raises UsageError where they do not fit together."""
    if len(paths) < 2:
        raise UsageError("give two sessions or more to join; one alone is optimised by `vislam optimize RUN`")
    resolved = [path.resolve() for path in paths]
    if len(set(resolved)) < len(resolved):
        raise UsageError("a session is given twice; a session is not joined with itself")
    parts: list[SessionPart] = []
    for path in paths:
        folder = path.resolve() if path.is_dir() else path.resolve().parent
        taken = [part.name for part in parts]
        name, n = folder.name, 2
        while name in taken:
            name, n = f"{folder.name}-{n}", n + 1
        parts.append(read_part(path, name))
    first = parts[0]
    for part in parts[1:]:
        if part.rig_data != first.rig_data:
            raise UsageError(f"{part.path} was made with other cameras, or another calibration, than {first.path}")
        if part.has_gravity != first.has_gravity:
            raise UsageError(f"{part.path} and {first.path} must both have an IMU, or both none")
    return parts


class _Search:
    """Looks for loops between sessions and brings each group of submaps to where enough of them agree."""

    def __init__(self, parts: list[SessionPart]) -> None:
        self.parts = parts
        counts = [len(part.poses) for part in parts]
        self.first_ids = np.concatenate([[0], np.cumsum(counts)[:-1]]).tolist()
        self.poses = np.concatenate([part.poses for part in parts])
        self.edges = RelativePoses.joined(
            [replace(p.edges, ends=p.edges.ends + first) for p, first in zip(parts, self.first_ids, strict=True)]
        )
        self.submaps = Submaps()
        self._joining: list[tuple[int, int]] = []  # a pair of keyframes for each two submaps that are joined
        self._take_submaps()
        self._graph = parts[0].config.graph
        self.lever_m = np.ascontiguousarray(parts[0].rig.T_body_cam0[:3, 3])
        self._waiting = Waiting(self._graph)
        self._known = self._knowledge([])
        self._placing: list[LoopModel] = []

    def session_of(self, keyframe_id: int) -> int:
        """Return the session that a keyframe of the joined graph is of."""
        return int(np.searchsorted(self.first_ids, keyframe_id, side="right")) - 1

    def run(self, progress: Progress) -> tuple[list[LoopModel], dict[int, int]]:
        """Return the loops between sessions, and by their ids the inliers of each."""
        detector = self._detector()
        newest_id, total = len(self.parts[0].poses) - 1, len(self.poses) - len(self.parts[0].poses)
        found: list[LoopModel] = []
        inliers: dict[int, int] = {}
        for part, first in list(zip(self.parts, self.first_ids, strict=True))[1:]:
            for keyframe in part.memory.places.keyframes:
                newest_id = first + keyframe.id
                tags = part.memory.places.tags.get(keyframe.id, ())
                moved = replace(keyframe, id=newest_id)
                edges, _ = detector.detect(moved, self.poses[newest_id], tags=tags)
                between = [e for e in edges if self.session_of(e.from_id) != self.session_of(e.to_id)]
                models = [LoopModel(loop_record(e, newest_id), self._graph, self.lever_m) for e in between]
                inliers |= {e.id: e.inliers for e in between}
                found += models
                if self._place(models):
                    detector.move(self._update())
                progress(newest_id + 1 - len(self.parts[0].poses), total, f"{len(found)} loops")
        detector.close()
        return found, inliers

    def _take_submaps(self) -> None:
        """Begin all submaps of all sessions, joined as the sessions have them."""
        for part, first in zip(self.parts, self.first_ids, strict=True):
            own = part.submaps
            for k in own.first_ids:
                if first + k:
                    self.submaps = self.submaps.begun(first + k)
            self._joining += [
                (first + own.first_ids[group], first + k)
                for k, group in zip(own.first_ids, own.groups, strict=True)
                if own.first_ids[group] != k
            ]
        self.submaps = self.submaps.joined_by(self._joining)

    def _detector(self) -> LoopCloser:
        """Return a detector that knows the first session and which submaps there will be."""
        part = self.parts[0]
        config = replace(part.config.loop, enabled=True)
        detector = LoopCloser(config, part.rig, part.config.seed, part.has_gravity)
        detector.restore(part.memory.places)
        detector.move(self._update())
        return detector

    def _update(self) -> GraphUpdate:
        return GraphUpdate(0, np.arange(len(self.poses)), self.poses, np.eye(4), None, submaps=self.submaps)

    def _place(self, models: list[LoopModel]) -> bool:
        """Let loops wait for others that agree; return whether submaps were joined."""
        waiting = [m for m in models if not self.submaps.are_joined(m.record.from_id, m.record.to_id)]
        for model in waiting:
            self._waiting.add(model)
        joined = False
        while waiting and (found := self._waiting.place(self.submaps, self.poses, self._known)) is not None:
            moves = self.submaps.groups_of(np.arange(len(self.poses))) == found.group
            self.poses[moves] = found.T_map_moved @ self.poses[moves]
            self._joining += [(m.record.from_id, m.record.to_id) for m in found.agreeing]
            self.submaps = self.submaps.joined_by(self._joining)
            self._placing += found.agreeing
            self._known = self._knowledge(self._placing)
            self._waiting.take_joined(self.submaps)
            joined = True
        return joined

    def _knowledge(self, placing: list[LoopModel]) -> RelativeCovariance:
        """Return how well the motion between two keyframes is known by odometry, the sessions' loops and `placing`."""
        edges = RelativePoses.joined([self.edges, loop_edges(placing, self.poses)])
        uncertainty = Uncertainty(edges.problem(self.poses), self.poses)

        @cache
        def known(i: int, j: int) -> Array:
            return np.asarray(uncertainty.relative(np.array([[i, j]]))[0])

        return known


def _optimised(
    parts: list[SessionPart], search: _Search, models: list[LoopModel], inliers: dict[int, int], team: Team | None
) -> JoinedSessions:
    """Judge the loops between sessions and optimise everything in the frame of the first."""
    suspects = [m for m in models if search.submaps.are_joined(m.record.from_id, m.record.to_id)]
    _check_joined(parts, search, suspects, len(models))
    edges = RelativePoses.joined([search.edges, loop_edges(suspects, search.poses)])
    for k in filter(None, search.submaps.first_ids):  # nothing was measured before: they say what placed submaps say
        at = np.flatnonzero(np.all(search.edges.ends == (k - 1, k), axis=1))
        edges.T_from_to[at] = invert(search.poses[k - 1]) @ search.poses[k]
    problem = edges.problem(search.poses)
    is_suspect = np.arange(len(edges.ends)) >= len(search.edges.ends)
    decision = decide(problem, PoseGraphConfig(), doubtful=is_suspect)
    weights, kept = decision.weights, decision.weights[is_suspect] > 0.0
    _check_joined(parts, search, [m for m, k in zip(suspects, kept, strict=True) if k], len(models))
    solution = optimize_pose_graph(problem.with_edges(weights != 0.0), team=team)
    own = np.concatenate([part.poses for part in parts])
    notes = (*solution.notes, decision.warning) if decision.warning else solution.notes
    solution = replace(solution, start=own, start_name="each session in its own map", weights=weights, notes=notes)
    chi2 = dict(zip([m.id for m in suspects], problem.edge_chi2(solution.poses)[is_suspect].tolist(), strict=True))
    fates = dict(zip([m.id for m in suspects], kept.tolist(), strict=True))
    loops = tuple(
        _loop(m, parts, search, chi2.get(m.id, float("nan")), fates.get(m.id, False), inliers) for m in models
    )
    trajectories = tuple(_trajectory(p, solution.poses[f:]) for p, f in zip(parts, search.first_ids, strict=True))
    names, first_ids = tuple(part.name for part in parts), tuple(search.first_ids)
    summary = _summary(parts, problem, solution, loops, trajectories)
    return JoinedSessions(names, problem, solution, first_ids, trajectories, loops, summary)


def _check_joined(parts: list[SessionPart], search: _Search, loops: list[LoopModel], found: int) -> None:
    """Raise TrackingLostError unless loops from enough frames tie every session, over others, to the first."""
    frames: dict[tuple[int, int], set[int]] = {}
    for model in loops:
        pair = (search.session_of(model.record.from_id), search.session_of(model.record.to_id))
        frames.setdefault(pair, set()).add(model.record.to_id)
    least = JOIN_FRAMES
    tied, grown = {0}, True
    while grown:
        new = {b for pair, ids in frames.items() for b in pair if len(ids) >= least and tied & set(pair)} - tied
        tied, grown = tied | new, bool(new)
    apart = [part.name for i, part in enumerate(parts) if i not in tied]
    if apart:
        raise TrackingLostError(
            f"no loops join {', '.join(apart)} with {parts[0].name}: {found} found between the sessions, and "
            f"fewer than {least} frames agree on a place; do they see the same scene, from similar directions?"
        )


def _loop(
    model: LoopModel, parts: list[SessionPart], search: _Search, chi2: float, kept: bool, inliers: dict[int, int]
) -> LoopBetween:
    record = model.record
    a, b = search.session_of(record.from_id), search.session_of(record.to_id)
    return LoopBetween(
        parts[a].name, record.from_id - search.first_ids[a], parts[b].name, record.to_id - search.first_ids[b],
        record.has_scale, inliers[record.id], chi2, kept,
    )  # fmt: skip


def _trajectory(part: SessionPart, poses: Array) -> Trajectory:
    """Return the pose of every frame of a session, given its keyframes' [M, 4, 4] or more."""
    own = [k for k in part.memory.places.keyframes if k.id >= part.first_id]
    return part.frames.placed({k.id: k.t_ns for k in own}, {k.id: poses[k.id] for k in own})


def _summary(
    parts: list[SessionPart], problem: PoseGraphProblem, solution: PoseGraphSolution, loops: tuple[LoopBetween, ...],
    trajectories: tuple[Trajectory, ...],
) -> dict[str, Any]:  # fmt: skip
    return {
        "sessions": [
            {"name": part.name, "path": str(part.path), "keyframes": len(part.poses), "frames": len(trajectory)}
            for part, trajectory in zip(parts, trajectories, strict=True)
        ],
        "poses": len(problem.ids),
        "edges": len(problem.edges),
        "loops_between": len(loops),
        "loops_kept": sum(loop.kept for loop in loops),
        "chi2_before": problem.chi2(solution.start, solution.weights),
        "chi2_after": solution.costs[-1],
        "iterations": len(solution.costs) - 1,
        "converged": solution.converged,
        "warnings": list(solution.notes),
    }
