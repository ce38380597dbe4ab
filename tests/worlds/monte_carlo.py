"""Many simulated runs of the filter against exact truth: is its covariance what its errors are?

Truth is the ideal samples integrated by the filter's own arithmetic, so that nothing is left to discretisation and
every deviation from the chi-square band is the filter's. The errors of vision that one keyframe shares are drawn where
they arise, in its landmarks: they displace the keyframe.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from vislam.config import EkfConfig
from vislam.core.geometry import invert, quaternion_wxyz, se3_adjoint, so3_exp, transform
from vislam.core.messages import Array, ImuSample, NavState, Tracking, VoMeasurement
from vislam.ekf import Ekf, MsckfEkf
from vislam.ekf.loose import kernels
from vislam.imu import ImuNoise
from worlds.motion import NS, T0_NS, Motion, relative_vo, state_error
from worlds.parts import GRAVITY_M_S2, MACHINE

IMU = ImuNoise(1e-3, 1e-2, 1e-4, 1e-3, 200.0)  # of the class of a GY-85
CAMERA = transform(so3_exp(np.array([0.3, -0.2, 0.1])), np.array([0.1, -0.05, 0.2]))
START_SIGMAS = np.repeat([0.02, 0.001, 0.05, 0.01, 0.1], 3)  # 1.1 deg of tilt, biases as after a second at rest
ROTATION_SIGMA_RAD, TRANSLATION_SIGMA_M = np.deg2rad(0.1), 0.002
COVARIANCE = np.diag(np.repeat([ROTATION_SIGMA_RAD**2, TRANSLATION_SIGMA_M**2], 3))
SHARED = 0.5  # of the variance, the same for all motions from one keyframe
GROUPS: dict[str, list[int]] = {
    "rotation": [0, 1, 2],
    "position": [3, 4, 5],
    "velocity": [6, 7, 8],
    "gyro bias": [9, 10, 11],
    "accel bias": [12, 13, 14],
    "all": list(range(15)),
}


@dataclass(frozen=True)
class Scenario:
    """One row of the campaign: how the body moves, what vision measures, and when it arrives."""

    name: str
    motion: Literal["hand", "cart"] = "hand"
    metric: bool = True
    delay_s: float = 0.0
    jitter_s: float = 0.0  # on top of the delay, uniform, so that frames overtake each other
    lost: float = 0.0  # fraction of frames without vision
    outage_s: tuple[float, float] = (0.0, 0.0)  # from, to: no vision
    duration_s: float = 60.0
    frames_per_keyframe: int = 8
    camera_hz: float = 10.0
    start_sigmas: Array = field(default_factory=START_SIGMAS.copy)


SCENARIOS = (
    Scenario("on time"),
    Scenario("50 ms late", delay_s=0.05),
    Scenario("100 ms late", delay_s=0.1),
    Scenario("250 ms late", delay_s=0.25),
    Scenario("out of order", delay_s=0.02, jitter_s=0.35),
    Scenario("5 % lost", lost=0.05),
    Scenario("5 s outage", outage_s=(25.0, 30.0)),
    Scenario("everything", delay_s=0.1, jitter_s=0.2, lost=0.05, outage_s=(25.0, 30.0)),
    Scenario("cart, on time", "cart"),
    Scenario("cart, everything", "cart", delay_s=0.1, jitter_s=0.2, lost=0.05, outage_s=(25.0, 30.0)),
    Scenario("directions, on time", metric=False),
    Scenario("directions, 250 ms late", metric=False, delay_s=0.25),
    Scenario("directions, 5 % lost", metric=False, lost=0.05),
    Scenario("directions, 5 s outage", metric=False, outage_s=(25.0, 30.0)),
)


@dataclass(frozen=True)
class Drive:
    """A noisy run with its truth, one row per sample."""

    t_ns: NDArray[np.int64]  # [N]
    samples: Array  # [N, 6] gyro, accel
    truth: Array  # [N, 10] position, velocity, quaternion wxyz
    biases: Array  # [N, 6] gyro, accel

    def pose(self, k: int) -> Array:
        return kernels.pose(self.truth[k], 0, 6)

    def error(self, k: int, state: NavState) -> Array:
        """Return the error [15] of a state at sample k."""
        return state_error((self.pose(k), self.truth[k, 3:6], self.biases[k]), state)


@dataclass(frozen=True)
class Run:
    """Errors [K, 15] and covariances [K, 15, 15] of one run, one row per second, and what its innovations were."""

    errors: Array
    covariances: Array
    nis: dict[str, tuple[int, float, int]]
    counters: dict[str, int]
    yaw: Array  # [K, 2] error about the vertical and its variance

    def nees(self, group: str) -> Array:
        """Return the normalised estimation error squared [K] of a group of `GROUPS`, or of "yaw"."""
        errors, covariances = self.errors, self.covariances
        if group == "yaw":
            return self.yaw[:, 0] ** 2 / self.yaw[:, 1]
        rows = GROUPS[group]
        e, P = errors[:, rows], covariances[:, rows][:, :, rows]
        return np.einsum("ki,ki->k", e, np.linalg.solve(P, e[:, :, None])[:, :, 0])


def drive(motion: str, seed: int, duration_s: float, noise: ImuNoise = IMU) -> Drive:
    """Return a noisy run: by "hand", brisk in all six degrees, or of a "cart": straight legs, then turns."""
    rng = np.random.default_rng(seed)
    count = round(duration_s * noise.rate_hz) + 1
    times = np.arange(count) / noise.rate_hz
    t_ns = T0_NS + np.round(times * NS).astype(np.int64)
    x = np.zeros(kernels.NOMINAL)
    x[6] = x[19] = 1.0
    if motion == "hand":
        hand = Motion.random(seed)
        T, velocity, *_ = hand.at(0.0)
        x[0:3], x[3:6], x[6:10] = T[:3, 3], velocity, quaternion_wxyz(T[:3, :3].copy())
        ideal = np.ascontiguousarray(_hand_samples(hand, times))  # or another kernel is compiled
    else:
        ideal = _cart_samples(times, rng)
    truth = np.empty((count, 10))
    nothing = np.zeros((kernels.ERRORS, kernels.ERRORS))
    kernels.predict_run(x, nothing, t_ns, ideal, np.zeros(count), truth, np.zeros(6), GRAVITY_M_S2)
    white = np.repeat([noise.gyroscope_noise_density, noise.accelerometer_noise_density], 3) * np.sqrt(noise.rate_hz)
    walk = np.repeat([noise.gyroscope_random_walk, noise.accelerometer_random_walk], 3) / np.sqrt(noise.rate_hz)
    biases = np.cumsum(rng.normal(size=(count, 6)) * walk, axis=0)
    return Drive(t_ns, ideal + biases + rng.normal(size=(count, 6)) * white, truth, biases)


def inside(ekf: Ekf | MsckfEkf) -> Any:
    """Return the state within a filter, of which `state()` and `own()` show a part: clones and correlations, too."""
    return ekf._state


def soak(duration_s: float, config: EkfConfig, seed: int = 3) -> tuple[float, dict[str, int]]:
    """Drive long, with vision late and lossy; return the smallest eigenvalue that P ever had, and the counters.

    The eigenvalue is that of the correlations, so that units do not hide a negative one. P is checked to be symmetric
    and finite 20 times a second.
    """
    scenario = Scenario("soak", "cart", delay_s=0.1, jitter_s=0.1, lost=0.05, duration_s=duration_s)
    smallest = np.inf
    for ekf, _, k in replay(scenario, config, seed):
        if k % 10:
            continue
        P = inside(ekf).P
        assert np.isfinite(P).all()
        assert np.array_equal(P, P.T)
        sigmas = np.sqrt(np.diag(P))
        smallest = min(smallest, float(np.linalg.eigvalsh(P / np.outer(sigmas, sigmas))[0]))
    print(f"{duration_s:.0f} s: smallest eigenvalue of the correlations {smallest:.1e}")
    return smallest, ekf.counters


def replay(scenario: Scenario, config: EkfConfig, seed: int) -> Iterator[tuple[Ekf, Drive, int]]:
    """Run the filter once and yield it after every sample k. The start is drawn from the covariance it is given."""
    way = drive(scenario.motion, seed, scenario.duration_s)
    rng = np.random.default_rng([seed, 1])
    ekf = Ekf(config, IMU, MACHINE, None if scenario.metric else CAMERA)
    ekf.initialise(start(way, scenario.start_sigmas, rng))
    deliveries = sorted(vision(scenario, way, rng), key=lambda delivery: delivery[0])
    i = 0
    for k in range(len(way.t_ns)):
        t_ns = int(way.t_ns[k])
        ekf.predict(ImuSample(t_ns, way.samples[k, :3], way.samples[k, 3:]))
        while i < len(deliveries) and deliveries[i][0] <= t_ns:
            deliver(ekf, *deliveries[i][1:])
            i += 1
        yield ekf, way, k


def run(scenario: Scenario, config: EkfConfig, seed: int) -> Run:
    """Run the filter once and look at it every second."""
    every = round(IMU.rate_hz)
    errors, covariances, yaw = [], [], []
    for ekf, way, k in replay(scenario, config, seed):
        if k and k % every == 0:
            state = ekf.state()
            error = way.error(k, state)
            up = state.T_world_body[2, :3]  # the body-side error about the world's vertical
            errors.append(error)
            covariances.append(state.covariance)
            yaw.append((up @ error[:3], up @ state.covariance[:3, :3] @ up))
    return Run(np.array(errors), np.array(covariances), ekf.nis_statistics, ekf.counters, np.array(yaw))


def start(way: Drive, sigmas: Array, rng: np.random.Generator) -> NavState:
    """Return a first state whose error is drawn from its covariance."""
    drawn = rng.normal(size=15) * sigmas
    T = way.pose(0)
    T = transform(T[:3, :3] @ so3_exp(-drawn[:3]), T[:3, 3] - drawn[3:6])
    bias = way.biases[0] - drawn[9:]
    return NavState(int(way.t_ns[0]), T, way.truth[0, 3:6] - drawn[6:9], bias[:3], bias[3:], np.diag(sigmas**2))


def vision(scenario: Scenario, way: Drive, rng: np.random.Generator) -> Iterator[tuple[int, VoMeasurement, int | None]]:
    """Yield what a front end makes of the frames: when it arrives, the motion, and the keyframe it begins (or None)."""
    root, camera = np.linalg.cholesky(COVARIANCE), None if scenario.metric else CAMERA
    step = round(IMU.rate_hz / scenario.camera_hz)
    keyframe, keyframe_k, common, since = -1, 0, np.zeros(6), 0
    for frame, k in enumerate(range(0, len(way.t_ns), step)):
        t_ns = int(way.t_ns[k])
        if frame and rng.random() < scenario.lost:
            continue
        if scenario.outage_s[0] <= k / IMU.rate_hz < scenario.outage_s[1]:
            since = 0  # what comes after it is related to nothing before it
            keyframe_k = -1
            continue
        vo, begins = None, None
        if keyframe >= 0 and keyframe_k >= 0:
            exact = invert(way.pose(keyframe_k)) @ way.pose(k)
            error = np.sqrt(SHARED) * common + np.sqrt(1.0 - SHARED) * (root @ rng.normal(size=6))
            to_body = se3_adjoint(invert(exact))  # the error arises at the keyframe, a motion is perturbed at the body
            covariance = to_body @ COVARIANCE @ to_body.T
            vo = relative_vo(t_ns, keyframe, exact, covariance, to_body @ error, camera)
            since += 1
        if vo is None or since >= scenario.frames_per_keyframe:
            keyframe, keyframe_k, common, since = keyframe + 1, k, root @ rng.normal(size=6), 0
            begins = keyframe
        arrives = t_ns + round((scenario.delay_s + scenario.jitter_s * rng.random()) * NS)
        if vo is None:
            vo = VoMeasurement(t_ns, max(keyframe - 1, 0), None, np.eye(6), scenario.metric, Tracking.LOST, 0)
        yield arrives, vo, begins


def deliver(ekf: Ekf, vo: VoMeasurement, begins: int | None) -> None:
    """Tell the filter about one frame, as the front half does."""
    ekf.update_vo(vo)
    if begins is not None:
        ekf.add_keyframe(begins, vo.t_ns)


def band(degrees: int, runs: int) -> tuple[float, float]:
    """Return the 95 % chi-square band of the mean of `runs` independent NEES values of `degrees`."""
    low, high = chi2.ppf([0.025, 0.975], degrees * runs) / runs
    return float(low), float(high)


@dataclass(frozen=True)
class Consistency:
    """Average NEES over runs of one scenario, by group of states."""

    runs: list[Run]

    def degrees(self, group: str) -> int:
        return 1 if group == "yaw" else len(GROUPS[group])

    def average(self, group: str, settle_s: int = 5) -> float:
        """Return the NEES averaged over runs and over the seconds after the first few."""
        return float(np.mean([run.nees(group)[settle_s:].mean() for run in self.runs]))

    def inside(self, group: str, settle_s: int = 5) -> float:
        """Return the fraction of seconds at which the average over runs lies in its 95 % band."""
        average = np.mean([run.nees(group)[settle_s:] for run in self.runs], axis=0)
        low, high = band(self.degrees(group), len(self.runs))
        return float(np.mean((average > low) & (average < high)))

    def rmse(self, rows: slice) -> float:
        """Return the root mean square over runs and seconds of the norm of some error rows."""
        return float(np.sqrt(np.mean([np.sum(run.errors[5:, rows] ** 2, axis=1) for run in self.runs])))

    def nis(self, kind: str = "vo") -> float:
        """Return the mean normalised innovation squared per degree of freedom."""
        parts = np.array([run.nis[kind] for run in self.runs], dtype=float).sum(axis=0)
        return float(parts[1] / parts[2])


def honest(**changes: object) -> EkfConfig:
    """Return settings that know the simulated noise exactly: no inflation."""
    return EkfConfig(**{"vo_inflation": 1.0, "vo_shared_fraction": SHARED, **changes})


def shortened(scenario: Scenario, duration_s: float) -> Scenario:
    """Return the scenario over a shorter time, an outage moved to its middle."""
    begin, end = scenario.outage_s
    outage_s = (0.5 * duration_s, 0.5 * duration_s + end - begin)
    return replace(scenario, duration_s=duration_s, outage_s=outage_s if end > begin else (0.0, 0.0))


def campaign(scenario: Scenario, runs: int, config: EkfConfig, first_seed: int = 5000) -> Consistency:
    """Return the runs of one scenario with seeds `first_seed`, `first_seed + 1` and so on."""
    return Consistency([run(scenario, config, first_seed + i) for i in range(runs)])


def table(rows: Iterable[tuple[str, Consistency]]) -> Iterator[str]:
    """Yield the lines of a table: NEES per degree of freedom of each group, with how often it was in the band."""
    groups = ["all", "rotation", "yaw", "position", "velocity", "gyro bias", "accel bias"]
    yield f"{'scenario':28s}" + "".join(f"{group:>15s}" for group in groups) + f"{'NIS/dof':>9s}{'rmse m':>9s}"
    for name, result in rows:
        cells = ""
        for group in groups:
            degrees, average = result.degrees(group), result.average(group)
            low, high = band(degrees, len(result.runs))
            mark = " " if low <= average <= high else "!"
            cells += f"{average / degrees:9.2f}{mark}{100 * result.inside(group):4.0f}%"
        yield f"{name:28s}{cells}{result.nis():9.3f}{result.rmse(slice(3, 6)):9.3f}"


def _hand_samples(motion: Motion, times: Array) -> Array:
    """Return ideal samples [N, 6] of `Motion.at`, all times at once."""

    def sums(terms: Array) -> tuple[Array, Array, Array]:
        a, w, phi = (terms[..., i, None] for i in range(3))
        s, c = np.sin(w * times + phi), np.cos(w * times + phi)
        return (a * s).sum(0), (a * w * c).sum(0), (-a * w * w * s).sum(0)

    _, _, acceleration = sums(motion.position)
    (roll, pitch, yaw), (droll, dpitch, dyaw), _ = sums(motion.angles)
    sr, cr, sp, cp, sy, cy = (f(angle) for angle in (roll, pitch, yaw) for f in (np.sin, np.cos))
    rate = np.stack([droll - dyaw * sp, dpitch * cr + dyaw * sr * cp, -dpitch * sr + dyaw * cr * cp])
    ax, ay, az = acceleration + np.array([[0.0], [0.0], [GRAVITY_M_S2]])
    bx, by = cy * ax + sy * ay, -sy * ax + cy * ay  # yaw, then pitch, then roll taken off
    cx, cz = cp * bx - sp * az, sp * bx + cp * az
    return np.concatenate([rate, np.stack([cx, cr * by + sr * cz, -sr * by + cr * cz])]).T


def _cart_samples(times: Array, rng: np.random.Generator) -> Array:
    """Return ideal samples [N, 6] of a level cart: a ramp to 0.6-1 m/s, legs of 8 s, turns of 60 to 120 deg in 2 s."""
    speed = rng.uniform(0.6, 1.0)
    ramp_s = 2.0
    v = speed * np.where(times < ramp_s, 0.5 - 0.5 * np.cos(np.pi * np.minimum(times, ramp_s) / ramp_s), 1.0)
    dv = np.where(times < ramp_s, 0.5 * speed * np.pi / ramp_s * np.sin(np.pi * times / ramp_s), 0.0)
    rate = np.zeros_like(times)
    begin = rng.uniform(9.0, 12.0)
    while begin < times[-1]:
        angle = np.deg2rad(rng.uniform(60.0, 120.0)) * rng.choice([-1.0, 1.0])
        inside = (times >= begin) & (times < begin + 2.0)
        rate += np.where(inside, angle / 2.0 * (1.0 - np.cos(np.pi * (times - begin))), 0.0)
        begin += 10.0
    zero = np.zeros_like(times)
    return np.stack([zero, zero, rate, dv, v * rate, np.full_like(times, GRAVITY_M_S2)], axis=1)
