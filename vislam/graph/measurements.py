"""What a graph by hand was given: each measurement as factors, with the first guess that it makes of its variables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import gtsam
import numpy as np

from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.messages import Array, ImuSpan
from vislam.factors.keys import B, L, V, X, bias_of, nearest_rigid
from vislam.factors.noise_models import gaussian, huber, sigmas
from vislam.factors.preintegration import Preintegrated, Preintegrator
from vislam.factors.visual import pose_factor

RATIO_MAX = 1e12  # of a covariance's eigenvalues: it is taken as given, this only keeps its information finite
_SPEED_M_S = 30.0  # sigma of the first velocity of inertial data, about which nothing was given
_RAY_RAD = np.deg2rad(0.5)  # between rays that are to fix a point


class Guesses:
    """First guesses of variables that come next: what the caller gave, else what measurements make of those known."""

    def __init__(self, known: gtsam.Values, given: Mapping[int, Array]) -> None:
        """Start from an estimate; `given` has poses [4, 4] and points [3] by key."""
        self._known = known
        self._given = given
        self.new = gtsam.Values()

    def has(self, key: int) -> bool:
        """Return whether a variable has a value."""
        return bool(self.new.exists(key) or self._known.exists(key))

    def is_given(self, key: int) -> bool:
        """Return whether the caller gave a guess."""
        return key in self._given

    def pose(self, key: int) -> Array:
        """Return a pose [4, 4]."""
        return np.asarray(self._of(key).atPose3(key).matrix())

    def point(self, key: int) -> Array:
        """Return a point [3]."""
        return np.asarray(self._of(key).atPoint3(key))

    def velocity(self, key: int) -> Array:
        """Return a velocity [3]."""
        return np.asarray(self._of(key).atVector(key))

    def bias(self, key: int) -> gtsam.imuBias.ConstantBias:
        """Return the biases of an IMU."""
        return self._of(key).atConstantBias(key)

    def put_pose(self, key: int, T_map_body: Array | None = None) -> None:
        """Add a pose [4, 4], in the place of which a given one is taken."""
        if not self.has(key):
            given = self._given.get(key, T_map_body)
            assert given is not None
            self.new.insert(key, gtsam.Pose3(nearest_rigid(given)))

    def put_point(self, key: int, point_map_m: Array | None = None) -> None:
        """Add a point [3], in the place of which a given one is taken."""
        if not self.has(key):
            self.new.insert(key, np.asarray(self._given.get(key, point_map_m), dtype=np.float64))

    def put_velocity(self, key: int, velocity_m_s: Array) -> None:
        """Add a velocity [3]."""
        if not self.has(key):
            self.new.insert(key, velocity_m_s)

    def put_bias(self, key: int, bias: gtsam.imuBias.ConstantBias) -> None:
        """Add the biases of an IMU."""
        if not self.has(key):
            self.new.insert(key, bias)

    def _of(self, key: int) -> gtsam.Values:
        return self.new if self.new.exists(key) else self._known


class Measurement(Protocol):
    """One measurement between variables of a graph."""

    kind: ClassVar[str]  # in the plural

    def reach(self, guesses: Guesses) -> bool:
        """Guess variables that have no value from those that have; return whether all have one now."""

    def factors(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """Return the factors, at an estimate that has all variables."""


@dataclass(frozen=True, slots=True, eq=False)
class PosePrior:
    """Where a pose is in map."""

    kind: ClassVar[str] = "priors"
    k: int
    T_map_body: Array  # [4, 4]
    covariance: Array  # [6, 6] body side

    def reach(self, guesses: Guesses) -> bool:
        """See Measurement."""
        guesses.put_pose(X(self.k), self.T_map_body)
        return True

    def factors(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """See Measurement."""
        model = gaussian(self.covariance, RATIO_MAX)
        return [gtsam.PriorFactorPose3(X(self.k), gtsam.Pose3(self.T_map_body), model)]


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """Relative pose of two poses."""

    kind: ClassVar[str] = "between"
    i: int
    j: int
    T_i_j: Array  # [4, 4]
    covariance: Array  # [6, 6] perturbed at j

    def reach(self, guesses: Guesses) -> bool:
        """See Measurement."""
        a, b = X(self.i), X(self.j)
        if guesses.has(a):
            guesses.put_pose(b, guesses.pose(a) @ self.T_i_j)
        elif guesses.has(b):
            guesses.put_pose(a, guesses.pose(b) @ invert(self.T_i_j))
        return guesses.has(a)

    def factors(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """See Measurement."""
        return [pose_factor(X(self.i), X(self.j), self.T_i_j, gaussian(self.covariance, RATIO_MAX))]


@dataclass(frozen=True, slots=True, eq=False)
class VelocityPrior:
    """How fast the body is at a pose, in map."""

    kind: ClassVar[str] = "priors"
    k: int
    velocity_map_m_s: Array  # [3]
    sigma_m_s: float

    def reach(self, guesses: Guesses) -> bool:
        """See Measurement."""
        guesses.put_velocity(V(self.k), self.velocity_map_m_s)
        return guesses.has(X(self.k))

    def factors(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """See Measurement."""
        model = gtsam.noiseModel.Isotropic.Sigma(3, self.sigma_m_s)
        return [gtsam.PriorFactorVector(V(self.k), self.velocity_map_m_s, model)]


@dataclass(frozen=True, slots=True, eq=False)
class BiasPrior:
    """The biases of the IMU at a pose."""

    kind: ClassVar[str] = "priors"
    k: int
    gyro_rad_s: Array  # [3]
    accel_m_s2: Array  # [3]
    sigma_gyro_rad_s: float
    sigma_accel_m_s2: float

    def reach(self, guesses: Guesses) -> bool:
        """See Measurement."""
        guesses.put_bias(B(self.k), bias_of(self.gyro_rad_s, self.accel_m_s2))
        return guesses.has(X(self.k))

    def factors(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """See Measurement."""
        model = sigmas(np.repeat([self.sigma_accel_m_s2, self.sigma_gyro_rad_s], 3))
        return [gtsam.PriorFactorConstantBias(B(self.k), bias_of(self.gyro_rad_s, self.accel_m_s2), model)]


@dataclass(frozen=True, slots=True, eq=False)
class ImuBetween:
    """Inertial samples from one pose to another; the velocities and biases at both are variables."""

    kind: ClassVar[str] = "IMU spans"
    i: int
    j: int
    span: ImuSpan
    preintegrator: Preintegrator

    def reach(self, guesses: Guesses) -> bool:
        """See Measurement; without any other knowledge the body moves at the mean speed between the poses."""
        i, j = self.i, self.j
        if not guesses.has(X(i)):
            return False
        guesses.put_bias(B(i), bias_of(np.zeros(3), np.zeros(3)))
        integrated = self.integrated(guesses.bias(B(i)))
        if not guesses.has(V(i)):
            known = guesses.has(X(j))
            moved_m = guesses.pose(X(j))[:3, 3] - guesses.pose(X(i))[:3, 3] if known else np.zeros(3)
            guesses.put_velocity(V(i), moved_m / integrated.duration_s)
        state = gtsam.NavState(gtsam.Pose3(guesses.pose(X(i))), guesses.velocity(V(i)))
        predicted = integrated.pim.predict(state, guesses.bias(B(i)))
        guesses.put_pose(X(j), predicted.pose().matrix())
        guesses.put_velocity(V(j), np.array(predicted.velocity()))
        guesses.put_bias(B(j), guesses.bias(B(i)))
        return True

    def factors(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """See Measurement; integrated at the biases of the estimate."""
        integrated = self.integrated(values.atConstantBias(B(self.i)))
        return [self.preintegrator.factor(self.i, self.j, integrated)]

    def integrated(self, bias: gtsam.imuBias.ConstantBias) -> Preintegrated:
        """Return the samples integrated at these biases; DataError where they have too long a hole."""
        t_ns = self.span.t_ns
        found = self.preintegrator.integrate(self.span, int(t_ns[0]), int(t_ns[-1]), bias)
        if found is None:
            raise DataError(
                f"the IMU's samples from pose {self.i} to {self.j} have holes too long to be bridged; "
                "leave that span out and tie the poses otherwise"
            )
        return found


@dataclass(frozen=True, slots=True, eq=False)
class ImuStart:
    """What is known of velocity and biases where the first inertial data begin, if nothing is: wide priors."""

    kind: ClassVar[str] = ""
    k: int
    sigma_gyro_rad_s: float
    sigma_accel_m_s2: float

    def reach(self, guesses: Guesses) -> bool:
        """See Measurement."""
        return guesses.has(V(self.k)) and guesses.has(B(self.k))

    def factors(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """See Measurement."""
        bias = BiasPrior(self.k, np.zeros(3), np.zeros(3), self.sigma_gyro_rad_s, self.sigma_accel_m_s2)
        return VelocityPrior(self.k, np.zeros(3), _SPEED_M_S).factors(values) + bias.factors(values)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A landmark seen from a pose by a camera: where on the plane z = 1, with what covariance there."""

    kind: ClassVar[str] = "views"
    k: int
    landmark: int
    at: Array  # [2]
    covariance: Array  # [2, 2]
    T_body_cam: Array  # [4, 4]
    huber_k: float

    @classmethod
    def of(
        cls, k: int, landmark: int, pixel_px: Array, sigma_px: float, camera: Camera, T_body_cam: Array, huber_k: float
    ) -> View:
        """Return the view of a pixel [2]; DataError where no ray of the camera gives it."""
        ray = camera.unproject(pixel_px)
        if not np.all(np.isfinite(ray)):
            raise DataError(f"pixel {pixel_px.tolist()} of landmark {landmark} at pose {k}: no ray of the camera")
        back = np.linalg.inv(camera.project_jacobian(ray)[0, :, :2])
        return cls(k, landmark, ray[0, :2], sigma_px**2 * back @ back.T, T_body_cam, huber_k)

    def reach(self, guesses: Guesses) -> bool:
        """See Measurement; one view alone guesses nothing that the caller did not give."""
        pose, point = X(self.k), L(self.landmark)
        if guesses.has(pose) and guesses.is_given(point):
            guesses.put_point(point)
        if guesses.has(point) and guesses.is_given(pose):
            guesses.put_pose(pose)
        return guesses.has(pose) and guesses.has(point)

    def factors(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """See Measurement."""
        model = huber(gaussian(self.covariance, RATIO_MAX), self.huber_k)
        pose, point = X(self.k), L(self.landmark)
        return [
            gtsam.GenericProjectionFactorCal3_S2(
                self.at, model, pose, point, gtsam.Cal3_S2(), gtsam.Pose3(self.T_body_cam)
            )
        ]


def fix_points(views: list[View], guesses: Guesses) -> None:
    """Put each point that has no value where the rays of its views meet, if they do well enough to say where."""
    by_point: dict[int, list[View]] = {}
    for view in views:
        if not guesses.has(L(view.landmark)) and guesses.has(X(view.k)):
            by_point.setdefault(view.landmark, []).append(view)
    for landmark, seen in by_point.items():
        T = np.stack([guesses.pose(X(view.k)) @ view.T_body_cam for view in seen])
        rays = np.einsum("nij,nj->ni", T[:, :3, :3], np.array([[*view.at, 1.0] for view in seen]))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        A = across.sum(axis=0)
        if np.linalg.eigvalsh(A)[0] < 0.5 * _RAY_RAD**2:
            continue
        point = np.linalg.solve(A, np.einsum("nij,nj->i", across, T[:, :3, 3]))
        if np.all(np.einsum("ni,ni->n", point - T[:, :3, 3], rays) > 0.0):
            guesses.put_point(L(landmark), point)
