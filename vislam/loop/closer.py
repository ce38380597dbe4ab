"""LoopCloser: from a new keyframe to verified loop edges, with one recorded reason per candidate."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from vislam.config import LoopConfig
from vislam.core.camera import Rig
from vislam.core.geometry import invert, invert_many, transform_points
from vislam.core.memory import PlacesMemory, TagSighting, WordsMemory
from vislam.core.messages import (
    Array,
    GraphUpdate,
    Keyframe,
    LoopCandidate,
    LoopDecision,
    LoopEdge,
    RetrievedKeyframe,
    Submaps,
)
from vislam.loop.candidates import AppearanceCandidates, Candidate, odometry_candidates, proposer, view_bounds
from vislam.loop.tags import TagBook, sight_tags
from vislam.loop.verification import Likeness, Verification, Verifier, judge, tilt_error_rad
from vislam.loop.view import View, make_view, make_views
from vislam.loop.words import PlaceDatabase, Vocabulary, side_by_side

_MIN_OVERLAP = 0.35  # share of what is seen that a candidate should see too, by the map
_MIN_APART_KEYFRAMES = 3  # between odometry candidates, so that they constrain different places
_NOMINAL_DEPTH_M = 3.0  # of features without depth, to guess what two keyframes share
_MAX_TAGS = 2  # candidates per keyframe that saw the same tag
_PROBES = 64  # points of the new keyframe that are projected into old ones; enough to rank overlaps
_SHOWN_MATCHES = 40  # per candidate, for the picture that explains it


class PoseTable:
    """Keyframe ids, ascending, and their poses T_map_body; grows by doubling, follows graph updates."""

    def __init__(self) -> None:
        self._ids = np.empty(64, np.int64)
        self._poses = np.empty((64, 4, 4))
        self._slots: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._slots)

    def __getitem__(self, keyframe_id: int) -> Array:
        """Return T_map_body [4, 4] of a keyframe."""
        pose: Array = self._poses[self._slots[keyframe_id]]
        return pose

    @property
    def ids(self) -> NDArray[np.int64]:
        """The ids [N]."""
        return self._ids[: len(self)]

    @property
    def poses(self) -> Array:
        """The poses T_map_body [N, 4, 4]."""
        return self._poses[: len(self)]

    def add(self, keyframe_id: int, T_map_body: Array) -> None:
        """Add a keyframe. Raises ValueError unless ids ascend and the pose is finite: the caller is at fault."""
        count = len(self)
        if count and keyframe_id <= self._ids[count - 1]:
            raise ValueError(f"keyframe {keyframe_id} came after keyframe {self._ids[count - 1]}")
        if T_map_body.shape != (4, 4) or not np.all(np.isfinite(T_map_body)):
            raise ValueError(f"keyframe {keyframe_id} has no finite pose: {T_map_body.tolist()}")
        if count == len(self._ids):
            self._ids = np.resize(self._ids, 2 * count)
            self._poses = np.resize(self._poses, (2 * count, 4, 4))
        self._ids[count], self._poses[count] = keyframe_id, T_map_body
        self._slots[keyframe_id] = count

    def move(self, update: GraphUpdate) -> None:
        """Take over the poses that moved; keyframes that are not known here are ignored."""
        for keyframe_id, pose in zip(update.ids.tolist(), update.T_map_body, strict=True):
            slot = self._slots.get(keyframe_id)
            if slot is not None:
                self._poses[slot] = pose


class LoopCloser:
    """Finds loops and verifies them one by one; owns the vocabulary, the index and the features of old keyframes.

    Whether a verified one is believed is for the graph to decide.

    `gravity_aligned`: the map's z axis is up (there is an IMU), so that a loop's tilt can be checked.
    """

    def __init__(self, config: LoopConfig, rig: Rig, seed: int, gravity_aligned: bool = False) -> None:
        self._config = config
        self._rig = rig
        self._gravity_aligned = gravity_aligned
        self._bounds = view_bounds(rig.cameras[0])
        self._views: dict[int, View] = {}
        self._poses = PoseTable()
        self._submaps = Submaps()
        self._database = PlaceDatabase(config, seed)
        self._appearance = AppearanceCandidates(config.island_gap)
        self._verifier = Verifier(config, rig, seed)
        self._tags = TagBook()
        self._proposers = {name: proposer(name)(config, rig) for name in config.proposers}
        self._next_edge_id = 0
        self._likeness: dict[int, Likeness] = {}  # of those to the newest keyframe
        self.retrieved: list[RetrievedKeyframe] = []  # what looked most like the newest keyframe
        self.counters = {"unlike": 0, "verified": 0, "accepted": 0, "rejected": 0}

    @property
    def vocabulary(self) -> Vocabulary:
        """The vocabulary in use."""
        return self._database.vocabulary

    @property
    def words_revision(self) -> int:
        """Grows when what `words` returns is new."""
        return self._database.revision

    def words(self) -> WordsMemory | None:
        """Return the vocabulary as `restore` takes it; None before the first training."""
        return self._database.words()

    def tags(self, keyframe_id: int) -> tuple[TagSighting, ...]:
        """Return the tags that a keyframe saw."""
        return self._tags.of(keyframe_id)

    def restore(self, memory: PlacesMemory) -> None:
        """Take over the keyframes of an earlier run.

        Raises DataError when features or vocabulary are damaged.
        """
        views = list(side_by_side(partial(make_views, rig=self._rig), memory.keyframes))
        self._views = {view.id: view for view in views}
        for view, T_map_body in zip(views, memory.T_map_body, strict=True):
            self._poses.add(view.id, T_map_body)
        for keyframe_id, sightings in memory.tags.items():
            self._tags.add(keyframe_id, sightings)
        self._database.restore(views, memory.words)
        self._next_edge_id = memory.next_edge_id

    def detect(
        self,
        keyframe: Keyframe,
        T_map_body: Array,
        begins_submap: bool = False,
        tags: tuple[TagSighting, ...] | None = None,
        is_tied: bool = False,
    ) -> tuple[list[LoopEdge], list[LoopCandidate]]:
        """Look for loops that a new keyframe closes.

        Args:
            keyframe: the newest keyframe; ids ascend.
            T_map_body: its current estimate [4, 4].
            begins_submap: no odometry ties it to the one before.
            tags: that it saw; None: they are looked for in its image.
            is_tied: but habit does, so that `T_map_body` means something.

        Returns:
            Verified edges, to be offered to the graph, and every candidate with its decision and reason. Raises
            DataError for features that cannot be used.
        """
        if not self._config.enabled:
            return [], []
        view = make_view(keyframe, self._rig)
        if begins_submap and len(self._poses):
            self._submaps = self._submaps.begun(view.id, is_tied)
        self._poses.add(view.id, T_map_body)
        if tags is None:
            tags = self._look_for_tags(keyframe)
        self._tags.add(view.id, tags)
        verified = self._verify(view)
        self._views[view.id] = view
        edges: list[LoopEdge] = []
        records = [self._record(candidate, view, found, edges) for candidate, found in verified]
        self._database.add(view)
        return edges, records

    def offer(
        self, candidate: Candidate, keyframe_id: int, found: Verification
    ) -> tuple[list[LoopEdge], LoopCandidate]:
        """Judge what others found of a keyframe that `detect` has seen; return its edge, if any, and the record."""
        edges: list[LoopEdge] = []
        return edges, self._record(candidate, self._views[keyframe_id], found, edges)

    def close(self) -> None:
        """End what runs in the background; raises what failed there."""
        self._database.close()

    def move(self, update: GraphUpdate) -> None:
        """Follow the keyframes that the graph moved, and the submaps that it joined."""
        self._poses.move(update)
        self._submaps = update.submaps

    def _look_for_tags(self, keyframe: Keyframe) -> tuple[TagSighting, ...]:
        """Return the tags in a keyframe's image; until one is known or a size is set, few images are searched."""
        config = self._config
        is_looked_at = config.tag_size_m is not None or not self._tags.is_empty or keyframe.id % config.tags_every == 0
        return sight_tags(keyframe.frame, self._rig.cameras[0], config) if is_looked_at else ()

    def _candidates(self, view: View) -> list[Candidate]:
        """Return candidates in the order of verification: by tags, of packages, by appearance and odometry in turn.

        Of an old keyframe and its neighbours that both suggest, it is appearance that matching has confirmed already.
        """
        config = self._config
        old = self._poses.ids[self._old(view)]
        order = self._tags.candidates(view.id, int(old[-1]), _MAX_TAGS) if len(old) else []
        for name, propose in self._proposers.items():
            known = {k: self._views[k] for k in old.tolist() if k in self._views}
            order += _apart([Candidate(k, name, 0.0) for k in propose(view, known) if k in known], order, 0)
        near = _apart(self._near(view), order, 0)
        wanted = max(config.max_appearance, config.max_verifications - len(order) - len(near))
        alike = _apart(self._alike(view), order, config.island_gap)[: wanted if config.max_appearance else 0]
        last = int(old[-1]) if len(old) else view.id
        if not self._submaps.are_joined(last, view.id) and self._submaps.are_tied(last, view.id):
            order, near = order + near, []  # after a loss, the keyframes just before it are likely to be near
            alike = _apart(alike, order, 0)
        near = _apart(near, alike, config.island_gap)
        for turn in range(max(len(near), len(alike))):
            order += alike[turn : turn + 1] + near[turn : turn + 1]
        return order

    def _alike(self, view: View) -> list[Candidate]:
        """Return candidates by appearance, leaving out what was seen just now: it always looks most alike."""
        config = self._config
        self.retrieved, self._likeness = [], {}
        recent: list[int] = []
        for old in reversed(self._views.values()):
            age_s = (view.t_ns - old.t_ns) * 1e-9
            long_ago = len(recent) >= config.appearance_skip_keyframes and age_s >= config.appearance_skip_s
            if long_ago or self._submaps.of(old.id) != self._submaps.of(view.id):
                break
            recent.append(old.id)
        ids, scores = self._database.query(view, config.retrieved, np.array(recent, dtype=np.int64))
        chosen = self._appearance.select(ids, scores, {i: self._compare(i, view) for i in ids})
        self.retrieved = [
            RetrievedKeyframe(id, view.id, score, place.score, place.consistency)
            for id, score in zip(ids, scores, strict=True)
            for place in (self._appearance.island_of(id),)
        ]
        return chosen

    def _compare(self, keyframe_id: int, view: View) -> Likeness:
        """Return how alike an old keyframe is to a view, matched once."""
        known = self._likeness.get(keyframe_id)
        if known is None:
            known = self._likeness[keyframe_id] = self._verifier.compare(self._views[keyframe_id], view)
            self.counters["unlike"] += not known.is_alike
        return known

    def _old(self, view: View) -> NDArray[np.int64]:
        """Return the places, in the table of poses, of keyframes that visual odometry does not tie to a view."""
        ids, own = self._poses.ids, self._submaps.of(view.id)
        begin = int(np.searchsorted(ids, self._submaps.first_ids[own]))
        return np.arange(max(begin, len(ids) - 1 - self._config.odometry_skip_keyframes))

    def _near(self, view: View) -> list[Candidate]:
        """Return candidates by odometry: old keyframes that should see most of the same by the current map."""
        config = self._config
        old = self._old(view)
        if len(self._submaps.groups) > 1:
            old = old[[self._is_placed(k, view.id) for k in self._poses.ids[old].tolist()]]
        if len(old) == 0:
            return []
        T_body_cam = self._rig.T_body_cams[0]
        T_map_cam = self._poses[view.id] @ T_body_cam
        return odometry_candidates(
            transform_points(T_map_cam, self._probes(view)), T_map_cam[:3, 3], self._poses.ids[old],
            invert_many(self._poses.poses[old] @ T_body_cam), self._bounds, config.max_odometry, _MIN_OVERLAP,
            _MIN_APART_KEYFRAMES,
        )  # fmt: skip

    def _is_placed(self, one: int, other: int) -> bool:
        """Whether the poses of two keyframes mean something to each other: in submaps that are joined or tied."""
        return self._submaps.are_joined(one, other) or self._submaps.are_tied(one, other)

    def _probes(self, view: View) -> Array:
        """Return some points [P, 3] that cam0 sees; without depth, features pushed out to a nominal one."""
        if view.has_points:
            points = view.points_or_nan()[view.known]
        else:
            rays = np.column_stack([view.xy, np.ones(len(view.xy))]).astype(np.float64)
            points = rays * _NOMINAL_DEPTH_M
        return np.asarray(points[:: max(1, len(points) // _PROBES)], dtype=np.float64)

    def _verify(self, view: View) -> list[tuple[Candidate, Verification]]:
        """Return the candidates of a view, verified within the budget."""
        budget = self._config.max_verifications
        skipped = Verification(f"not verified: {budget} verifications per keyframe are spent", 0)
        found = []
        for n, candidate in enumerate(self._candidates(view)):
            found.append((candidate, self._verified(candidate, view) if n < budget else skipped))
        return found

    def _verified(self, candidate: Candidate, view: View) -> Verification:
        self.counters["verified"] += 1
        is_placed = self._is_placed(candidate.id, view.id)
        T_guess = invert(self._poses[candidate.id]) @ self._poses[view.id] if is_placed else None
        found = self._verifier.verify(self._views[candidate.id], view, self._likeness.get(candidate.id), T_guess)
        if found.T_a_b is None and candidate.source == "tag":
            return self._tags.verify(candidate.id, view.id, self._rig.T_body_cams[0], self._config) or found
        return found

    def _record(self, candidate: Candidate, view: View, found: Verification, edges: list[LoopEdge]) -> LoopCandidate:
        """Return the record of a candidate; one that nothing speaks against also becomes an edge."""
        tilt_rad = None
        if found.T_a_b is not None and self._gravity_aligned:
            tilt_rad = tilt_error_rad(found.T_a_b, self._poses[candidate.id], self._poses[view.id])
        decision, reason = judge(found, tilt_rad)
        self.counters[decision.value] += 1
        if decision is LoopDecision.ACCEPTED:
            is_apart = not self._submaps.are_joined(candidate.id, view.id)
            rivals = self._verifier.rivals(self._views[candidate.id], view, found) if is_apart else []
            ends = candidate.id, view.id, candidate.score  # by which the last is known
            edges += [one.edge(n, *ends) for n, one in enumerate((*rivals, found), self._next_edge_id)]
            self._next_edge_id += 1 + len(rivals)
        return LoopCandidate(
            candidate.id, view.id, candidate.source, candidate.score, found.inliers, decision, reason, found.sigma_m,
            candidate.consistency, found.supporters, found.T_a_b, self._matches_px(candidate.id, view.id, found),
        )  # fmt: skip

    def _matches_px(self, from_id: int, to_id: int, found: Verification) -> Array | None:
        """Return some matches [M, 4] of a pair in pixels of both images."""
        a, b = self._views.get(from_id), self._views.get(to_id)
        if a is None or b is None or found.pairs is None or not len(found.pairs):
            return None
        pairs = found.pairs[:: -(-len(found.pairs) // _SHOWN_MATCHES)]
        project = self._rig.cameras[0].project
        ends = [np.column_stack([view.xy[pairs[:, k]], np.ones(len(pairs))]) for k, view in enumerate((a, b))]
        return np.hstack([project(rays.astype(np.float64)) for rays in ends])


def _apart(candidates: list[Candidate], others: list[Candidate], gap: int) -> list[Candidate]:
    """Return the candidates whose ids are more than `gap` from those of the others."""
    return [c for c in candidates if all(abs(c.id - other.id) > gap for other in others)]
