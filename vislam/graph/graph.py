"""Graph: poses, landmarks and what was measured between them, by hand."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from vislam.config import GraphConfig, MachineConfig
from vislam.core.camera import Rig
from vislam.core.errors import DataError, UsageError
from vislam.core.memory import EdgeReport
from vislam.core.messages import Array, ImuSpan, LoopDecision
from vislam.factors.journal import LoopRecord, checked_pose, checked_span
from vislam.factors.keys import B, L, V, X, bias_of
from vislam.factors.loop import LoopModel, relative_covariance
from vislam.factors.motion import ACCEL_BIAS_SIGMA_MAX, GYRO_BIAS_SIGMA_MAX
from vislam.factors.noise_models import checked_covariance
from vislam.factors.preintegration import Preintegrator
from vislam.graph.measurements import (
    RATIO_MAX,
    Between,
    BiasPrior,
    Guesses,
    ImuBetween,
    ImuStart,
    Measurement,
    PosePrior,
    VelocityPrior,
    View,
    fix_points,
)
from vislam.graph.solution import Solution
from vislam.imu import ImuNoise

_CONFIG = GraphConfig(
    loop_floor_deg=0.0, loop_floor_m=0.0, covariance_ratio_max=RATIO_MAX,  # noise is as given
    relinearize_rotation_rad=2e-4, relinearize_skip=1,  # with every update, near to what batch finds
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Optimised:
    """What `Graph.optimise` ended with."""

    cost: float  # half the squared sum of whitened errors, as robust kernels count them
    solver: str  # isam2-cholesky, isam2-qr or batch-lm
    accepted: tuple[int, ...]  # ids of the loops that are believed
    rejected: tuple[int, ...]  # and of those that are not
    note: str = ""  # what went wrong on the way


class Graph:
    """A factor graph by hand: add poses and what was measured, `optimise`, read `poses` and `covariance`.

        graph = Graph()
        graph.prior(graph.add_pose(), np.eye(4), (1e-3, 1e-3))
        for T_before_after in odometry:
            graph.add_pose()
            graph.between(len(graph) - 2, len(graph) - 1, T_before_after, (0.01, 0.05))
        graph.loop(0, len(graph) - 1, T_first_last, (0.01, 0.05))
        print(graph.optimise(), graph)
        T_map_body, covariance = graph.poses(), graph.covariance(len(graph) - 1)

    Poses T_map_body [4, 4] and landmarks have ids 0, 1, 2, ... in the order in which they come. The noise of a pose is
    (sigma_rad, sigma_m), or six sigmas or a covariance [6, 6]: rotation first, then translation, on the body side.
    Measurements are believed as they are given, but for loops, which are tested, and views, which are under a Huber
    kernel. Each method raises UsageError for what is not there, and DataError for numbers that cannot be used; either
    is a VislamError, and leaves the graph as it was.
    """

    def __init__(self, *, rig: Rig | None = None, imu: ImuNoise | None = None, gravity_m_s2: float = 9.81) -> None:
        """Start empty; views need the cameras of a `rig`, inertial samples the noise of the `imu`."""
        self._rig = rig
        machine = MachineConfig(gravity_m_s2=gravity_m_s2)
        self._preintegrator = None if imu is None else Preintegrator(_CONFIG, imu, machine)
        self._count = 0
        self._solved = 0  # poses that have a value
        self._landmarks = 0
        self._given: dict[int, Array] = {}  # first guesses, by key
        self._inertial: set[int] = set()  # poses with velocity and biases
        self._waiting: list[Measurement] = []  # for the next `optimise`
        self._new_loops: list[LoopModel] = []
        self._kinds: Counter[str] = Counter()
        self._solution = Solution(_CONFIG)

    def __len__(self) -> int:
        """Return how many poses there are."""
        return self._count

    def __repr__(self) -> str:
        """Return what the graph has, and what its solution costs."""
        reports, values = self._solution.reports(), self._solution.values
        believed = sum(report.decision is LoopDecision.ACCEPTED for report in reports)
        placed = sum(values.exists(L(n)) for n in range(self._landmarks))
        counts = {"poses": f"{self._count}", **{kind: f"{count}" for kind, count in sorted(self._kinds.items())}}
        counts["loops"] = f"{len(reports) + len(self._new_loops)} ({believed} believed)"
        counts["landmarks"] = f"{self._landmarks} ({placed} placed)"
        has = ", ".join(f"{kind} {count}" for kind, count in counts.items() if not count.startswith("0 "))
        state = f"cost {self._solution.cost:.6g} by {self._solution.solver_name}" if values.size() else "not optimised"
        return f"Graph({has}; {state})"

    def add_pose(self, T_map_body: ArrayLike | None = None) -> int:
        """Add a pose and return its id; T_map_body [4, 4] is a first guess, which measurements give otherwise."""
        if T_map_body is not None:
            self._given[X(self._count)] = checked_pose(_array(T_map_body), f"guess of pose {self._count}")
        self._count += 1
        return self._count - 1

    def add_landmark(self, point_map_m: ArrayLike | None = None) -> int:
        """Add a landmark and return its id; its place [3] in map is a first guess, which its views give otherwise."""
        if point_map_m is not None:
            self._given[L(self._landmarks)] = _vector(point_map_m, f"guess of landmark {self._landmarks}")
        self._landmarks += 1
        return self._landmarks - 1

    def prior(self, pose: int, T_map_body: ArrayLike, noise: ArrayLike) -> None:
        """Say where a pose is in map. One pose at least needs this, for something has to fix the map."""
        what = f"prior of pose {self._checked(pose)}"
        self._take(PosePrior(pose, checked_pose(_array(T_map_body), what), _covariance(noise, what)))

    def between(self, i: int, j: int, T_i_j: ArrayLike, noise: ArrayLike) -> None:
        """Add the pose [4, 4] of j in the axes of i, as odometry measures it, with its noise at j."""
        what = self._edge(i, j)
        self._take(Between(i, j, checked_pose(_array(T_i_j), what), _covariance(noise, what)))

    def loop(self, i: int, j: int, T_i_j: ArrayLike, noise: ArrayLike) -> int:
        """Add a relative pose that may be false, as place recognition finds it; return its id, see `loops`.

        It is believed if a chi-square test against what the graph knows of the two poses allows it, and if the rest of
        the graph does not contradict it later on. Loops tie no pose to the map: something else has to.
        """
        what = f"loop, {self._edge(i, j)}"
        number = len(self._solution.reports()) + len(self._new_loops)
        T, covariance = checked_pose(_array(T_i_j), what), _covariance(noise, what)
        record = LoopRecord(number, i, j, T, covariance, True, max(i, j))
        self._new_loops.append(LoopModel(record, _CONFIG, np.zeros(3)))
        return number

    def velocity(self, pose: int, velocity_map_m_s: ArrayLike, sigma_m_s: float) -> None:
        """Say how fast [3] the body is at a pose, in map; for inertial spans that begin or end there."""
        what = f"velocity at pose {self._checked(pose)}"
        self._take(VelocityPrior(pose, _vector(velocity_map_m_s, what), _sigma(sigma_m_s, what)))

    def bias(
        self, pose: int, gyro_rad_s: ArrayLike, accel_m_s2: ArrayLike, sigma_rad_s: float, sigma_m_s2: float
    ) -> None:
        """Say what biases [3] the IMU has at a pose; for inertial spans that begin or end there."""
        what = f"biases at pose {self._checked(pose)}"
        sigmas = _sigma(sigma_rad_s, what), _sigma(sigma_m_s2, what)
        self._take(BiasPrior(pose, _vector(gyro_rad_s, what), _vector(accel_m_s2, what), *sigmas))

    def imu(self, i: int, j: int, t_ns: ArrayLike, gyro_rad_s: ArrayLike, accel_m_s2: ArrayLike) -> None:
        """Add inertial samples that cover the time from pose i to pose j: times [N] in ns, [N, 3] and [N, 3].

        Velocity and biases at both are estimated with the poses. Where the first span begins they have wide priors,
        beside what `velocity` and `bias` say.
        """
        what = f"IMU span, {self._edge(i, j)}"
        if self._preintegrator is None:
            raise UsageError(f"{what}: the graph has no IMU; begin with Graph(imu=ImuNoise(...))")
        stamps = np.asarray(t_ns)
        if stamps.ndim != 1 or len(stamps) < 2 or stamps.dtype.kind not in "iu":
            raise DataError(f"{what}: two whole times in ns are needed, got shape {stamps.shape} of {stamps.dtype}")
        span = ImuSpan(stamps.astype(np.int64), _array(gyro_rad_s), _array(accel_m_s2))
        span = checked_span(span, int(stamps[0]), int(stamps[-1]), what)
        measured = ImuBetween(i, j, span, self._preintegrator)
        measured.integrated(bias_of(np.zeros(3), np.zeros(3)))  # holes are found now
        self._take(measured)
        if not self._inertial & {i, j}:
            self._waiting.append(ImuStart(i, GYRO_BIAS_SIGMA_MAX, ACCEL_BIAS_SIGMA_MAX))
        self._inertial |= {i, j}

    def view(self, pose: int, landmark: int, pixel_px: ArrayLike, sigma_px: float = 1.0, camera: int = 0) -> None:
        """Add that a camera sees a landmark at a raw pixel [2]. It is placed as soon as rays that cross see it."""
        what = f"view of landmark {landmark} from pose {self._checked(pose)}"
        if not 0 <= landmark < self._landmarks:
            raise UsageError(f"{what}: there are {self._landmarks} landmarks; add_landmark() comes first")
        cameras = 0 if self._rig is None else len(self._rig.cameras)
        if self._rig is None or not 0 <= camera < cameras:
            raise UsageError(f"{what}: no camera {camera}, the graph has {cameras}; begin with Graph(rig=Rig(...))")
        pixel = _array(pixel_px)
        if pixel.shape != (2,):
            raise DataError(f"{what}: a pixel has two numbers, got shape {pixel.shape}")
        lens, T_body_cam = self._rig.cameras[camera], self._rig.T_body_cams[camera]
        self._take(View.of(pose, landmark, pixel, _sigma(sigma_px, what), lens, T_body_cam, _CONFIG.huber_k))

    def optimise(self, *, incremental: bool = False) -> Optimised:
        """Solve for all variables, from the last solution and the guesses of what is new.

        By Levenberg-Marquardt over everything, or `incremental`: by iSAM2, which does work for what changed only.

        Raises:
            UsageError: a pose that nothing ties to one with a prior.
            DataError: no solver finds a solution.
        """
        fresh, guesses = self._reached()
        note = self._solution.take(fresh, guesses.new, incremental)
        self._solved = self._count
        self._waiting = [one for one in self._waiting if all(one is not other for other in fresh)]
        decided = self._solution.decide(self._new_loops)
        self._new_loops = []
        reports, notes = self._solution.reports(), "; ".join(n for n in (note, decided) if n)
        accepted = tuple(r.loop_id for r in reports if r.decision is LoopDecision.ACCEPTED)
        rejected = tuple(r.loop_id for r in reports if r.decision is not LoopDecision.ACCEPTED)
        return Optimised(self._solution.cost, self._solution.solver_name, accepted, rejected, notes)

    def poses(self) -> Array:
        """Return T_map_body [M, 4, 4] of all poses."""
        return np.stack([self._pose(k) for k in range(self._count)]) if self._count else np.zeros((0, 4, 4))

    def landmarks(self) -> Array:
        """Return the places [L, 3] of all landmarks in map, NaN of those whose rays do not say where."""
        values, keys = self._solution.values, map(L, range(self._landmarks))
        points = [values.atPoint3(key) if values.exists(key) else np.full(3, np.nan) for key in keys]
        return np.array(points).reshape(-1, 3)

    def velocities(self) -> Array:
        """Return the velocities [M, 3] in map, m/s, NaN of poses without inertial data."""
        values, keys = self._solution.values, map(V, range(self._count))
        found = [values.atVector(key) if values.exists(key) else np.full(3, np.nan) for key in keys]
        return np.array(found).reshape(-1, 3)

    def biases(self) -> Array:
        """Return the biases [M, 6] of gyroscope and accelerometer, rad/s and m/s^2, NaN of poses without."""
        values, out = self._solution.values, np.full((self._count, 6), np.nan)
        for k in (k for k in range(self._count) if values.exists(B(k))):
            bias = values.atConstantBias(B(k))
            out[k, :3], out[k, 3:] = bias.gyroscope(), bias.accelerometer()
        return out

    def covariance(self, *poses: int) -> Array:
        """Return the joint marginal covariance [6 N, 6 N] of poses: of each rotation, then translation, body side."""
        if not poses:
            raise UsageError("covariance(...) needs to know of which poses, as in covariance(0, 3)")
        for pose in poses:
            self._pose(pose)
        joint = self._solution.covariance([X(pose) for pose in poses])
        if joint is None:
            raise DataError(
                f"no covariance of poses {list(poses)}: the measurements do not fix the graph in all directions"
            )
        return joint

    def relative_covariance(self, i: int, j: int) -> Array:
        """Return the marginal covariance [6, 6] of T_i_j, rotation, then translation, at j."""
        self._edge(i, j)
        return relative_covariance(self._pose(i), self._pose(j), self.covariance(i, j))

    def loops(self) -> list[EdgeReport]:
        """Return of each loop that `optimise` has seen what became of it, and why, by id."""
        return self._solution.reports()

    def _take(self, measurement: Measurement) -> None:
        self._waiting.append(measurement)
        self._kinds[measurement.kind] += 1

    def _reached(self) -> tuple[list[Measurement], Guesses]:
        """Return the measurements whose variables have a value, and the values of those that are new."""
        guesses = Guesses(self._solution.values, self._given)
        left, fresh = self._waiting, list[Measurement]()
        while True:
            reached = [(one, one.reach(guesses)) for one in left]
            fresh += [one for one, has_all in reached if has_all]
            rest = [one for one, has_all in reached if not has_all]
            before = guesses.new.size()
            fix_points([one for one in rest if isinstance(one, View)], guesses)
            if len(rest) == len(left) and guesses.new.size() == before:
                break
            left = rest[::-1]  # a chain may hang on its last pose as well
        loose = [k for k in range(self._solved, self._count) if not guesses.has(X(k))]
        if loose:
            raise UsageError(
                f"{len(loose)} of {self._count} poses, first {loose[0]}, hang on nothing that has a place in map; "
                "give one a prior(...) and tie the others to it by between(...) or imu(...)"
            )
        return fresh, guesses

    def _checked(self, pose: int) -> int:
        if not 0 <= pose < self._count:
            raise UsageError(f"there is no pose {pose}, the graph has {self._count}; add_pose() comes first")
        return pose

    def _edge(self, i: int, j: int) -> str:
        if self._checked(i) == self._checked(j):
            raise UsageError(f"pose {i} to itself: an edge needs two poses")
        return f"edge from pose {i} to {j}"

    def _pose(self, pose: int) -> Array:
        if not self._solution.values.exists(X(self._checked(pose))):
            raise UsageError(f"pose {pose} came after the last optimise(); call it first")
        return np.asarray(self._solution.values.atPose3(X(pose)).matrix())


def _array(numbers: ArrayLike) -> Array:
    try:
        return np.asarray(numbers, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"an array of numbers is needed, got {type(numbers).__name__}: {error}") from error


def _vector(numbers: ArrayLike, what: str) -> Array:
    vector = _array(numbers)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise DataError(f"{what}: three finite numbers are needed, got {vector.tolist()}")
    return vector


def _sigma(sigma: float, what: str) -> float:
    if not (np.isfinite(sigma) and sigma > 0.0):
        raise DataError(f"{what}: a sigma is positive and finite, got {sigma}")
    return float(sigma)


def _covariance(noise: ArrayLike, what: str) -> Array:
    """Return the covariance [6, 6] of (sigma_rad, sigma_m), of six sigmas, or of itself."""
    numbers = _array(noise)
    if numbers.shape in ((2,), (6,)):
        sigmas = np.repeat(numbers, 6 // len(numbers))
        if not (np.all(np.isfinite(sigmas)) and np.all(sigmas > 0.0)):
            raise DataError(f"{what}: sigmas are positive and finite, got {numbers.tolist()}")
        return np.diag(sigmas**2)
    covariance = checked_covariance(numbers, 6, f"{what}: noise is (sigma_rad, sigma_m), six sigmas or a matrix")
    smallest = float(np.linalg.eigvalsh(covariance)[0])
    if not smallest > 0.0:
        raise DataError(f"{what}: covariance is not positive definite, its smallest eigenvalue is {smallest:.3g}")
    return covariance
