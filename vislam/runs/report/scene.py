"""The trajectories of a run brought into one frame for drawing, with their errors against the truth."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import VislamError
from vislam.core.geometry import invert, sim3_parts, transform
from vislam.core.messages import Array
from vislam.loop import LoopRow
from vislam.runs.folder import recorded_alignment
from vislam.runs.levelled import onto_map
from vislam.runs.report.run_files import RunFiles, as_dict
from vislam.trajectory import Trajectory, align, associate, nees
from vislam.trajectory.truth_fit import TruthFit

_LABELS = {"truth": "truth", "ekf": "EKF alone", "live": "live (causal)", "graph": "graph, final", "batch": "batch"}


@dataclass(frozen=True, slots=True, eq=False)
class ErrorCurve:
    """Error of one estimate over time after alignment."""

    t_s: Array  # [M] since the start of the run
    position_m: Array  # [M]
    rotation_deg: Array  # [M]


@dataclass(slots=True, eq=False)
class Scene:
    """Trajectories in one frame, aligned where there is a truth; times count from `zero_ns`.

    The frame is the map (z up). Without an IMU nothing but the run's own estimate shows that it is level, so then it is
    the truth's.
    """

    zero_ns: int
    end_s: float
    paths: dict[str, Trajectory] = field(default_factory=dict)
    truth: Trajectory | None = None
    errors: dict[str, ErrorCurve] = field(default_factory=dict)
    nees: dict[str, dict[str, Array]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)  # why something cannot be drawn
    has_gravity: bool = True
    labels: dict[str, str] = field(default_factory=lambda: dict(_LABELS))
    S_scene_map: Array = field(default_factory=lambda: np.eye(4))  # where the files of the map stand; a similarity

    def seconds(self, t_ns: NDArray[np.int64] | Sequence[int]) -> Array:
        """Return times as seconds since the start of the run."""
        return np.asarray(np.asarray(t_ns, dtype=np.int64) - self.zero_ns, dtype=np.float64) * 1e-9


def build_scene(run: RunFiles) -> Scene:
    """Align what can be aligned; what cannot be is drawn as it is and noted."""
    stamps = [t.t_ns for t in run.estimates.values() if len(t)]
    if run.tracking is not None and len(run.tracking.t_ns):
        stamps.append(run.tracking.t_ns)
    zero = min((int(t[0]) for t in stamps), default=0)
    end = max((int(t[-1]) for t in stamps), default=zero)
    scene = Scene(zero, (end - zero) * 1e-9)
    if run.metrics.get("has_imu") is False:
        scene.has_gravity = False
        scene.labels["ekf"] = "odometry"  # without an IMU there is no filter
    if run.truth is None:
        scene.paths = {name: onto_map(path, name, run.metrics) for name, path in run.estimates.items()}
        return scene
    alignment = recorded_alignment(run.metrics)
    aligned: dict[str, Trajectory] = {}
    base = np.eye(4)  # the truth's world as seen from the map
    placed = np.eye(4)  # the map as seen from the truth's world
    for name, estimate in run.estimates.items():
        try:
            pairs = associate(estimate, run.truth)
            S = align(pairs, alignment)
        except VislamError as error:
            scene.notes.append(f"{name} cannot be aligned to the truth: {error}")
            continue
        moved = pairs.aligned(S)
        scene.errors[name] = ErrorCurve(
            scene.seconds(pairs.t_ns), moved.position_errors_m(), np.rad2deg(moved.rotation_errors_rad())
        )
        aligned[name] = estimate.transformed(S)
        placed = S if name in ("graph", "batch") else placed
        _, R, t = sim3_parts(S)
        if scene.has_gravity:
            base = invert(transform(R, t))  # the last one, the graph's or the batch's, decides
    scene.paths = {name: trajectory.transformed(base) for name, trajectory in aligned.items()}
    scene.S_scene_map = base @ placed
    if aligned:
        inside = (run.truth.t_ns >= zero) & (run.truth.t_ns <= end)
        scene.truth = Trajectory(run.truth.t_ns[inside], run.truth.T_world_body[inside]).transformed(base)
    _add_nees(run, scene)
    return scene


def loop_segments(run: RunFiles, scene: Scene, decision: str) -> Array:
    """Return the ends [L, 2, 3] of the loops with this decision within the run, on its best trajectory."""
    rows, ends = loop_ends(run, scene)
    return ends[[k for k, loop in enumerate(rows) if loop.decision == decision]]


def loop_ends(run: RunFiles, scene: Scene) -> tuple[list[LoopRow], Array]:
    """Return all loops within the run whose times are known, with their ends [L, 2, 3] on its best trajectory."""
    path = next((scene.paths[name] for name in ("batch", "graph", "live") if len(scene.paths.get(name, ()))), None)
    if path is None:
        return [], np.empty((0, 2, 3))
    of_map = as_dict(run.metrics, "map").get("keyframes", 0)  # the first ids: their stamps are of another clock
    first = of_map if isinstance(of_map, int) else 0
    rows = [loop for loop in run.loops if loop.from_id >= first and min(loop.from_t_ns, loop.to_t_ns) >= 0]
    t_ns = np.array([[loop.from_t_ns, loop.to_t_ns] for loop in rows], dtype=np.int64).reshape(-1, 2)
    t_ns = np.clip(t_ns, path.t_ns[0], path.t_ns[-1])  # a keyframe may lie just outside the per-frame trajectory
    return rows, path.at(t_ns.ravel())[:, :3, 3].reshape(-1, 2, 3)


def _add_nees(run: RunFiles, scene: Scene) -> None:
    if run.truth is None:
        return
    for name, states in run.states.items():
        try:
            fit = TruthFit.read(run.metrics.get("truth"))
            scene.nees[name] = nees(states, run.truth, scene.has_gravity, fit)
        except VislamError as error:
            scene.notes.append(f"no consistency of {name}: {error}")
