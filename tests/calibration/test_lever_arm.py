"""Where a camera sits on the IMU by the accelerometer: exact motions with noise, and motion that does not show it."""

import numpy as np
from scipy.spatial.transform import Rotation

from vislam.calibration.self_calibration.adjust import Piece, Shared
from vislam.calibration.self_calibration.lever_arm import LeverArm, find_lever_arm
from vislam.calibration.self_calibration.segments import Segment
from vislam.calibration.self_calibration.structure import Structure
from vislam.core.camera import Camera
from vislam.core.geometry import so3_log
from vislam.core.imu_noise import ImuNoise
from vislam.core.messages import Array, ImuSample

CAMERA = Camera(640, 480, 470.0, 470.0, 319.5, 239.5, 0.0, "radtan", (0.0,) * 4)
NOISE = ImuNoise(1.7e-4, 2e-3, 2e-5, 3e-3, 200.0)
R_CAM_BODY = Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix()
ARM_M = np.array([0.06, -0.03, 0.02])
BIAS_M_S2 = np.array([0.1, -0.05, 0.08])
OFFSET_S = 0.012
STEP_S = 1e-3


def moved(rng: np.random.Generator, t_s: Array, turns: float) -> tuple[Array, Array]:
    """Return attitudes [N, 3, 3] and centres [N, 3] of a camera that is waved."""
    phase, speed = rng.uniform(0.0, 6.3, 6), rng.uniform(2.0, 5.0, 6)
    way = np.sin(np.outer(t_s, speed) + phase)
    return Rotation.from_rotvec(turns * way[:, :3]).as_matrix(), 0.2 * way[:, 3:]


def stretch(seed: int, turns: float) -> tuple[Piece, list[ImuSample], float]:
    """Return 16 keyframes within 4 s in a frame and of a scale of their own, samples, and the scale in metres."""
    rng = np.random.default_rng(seed)
    state = rng.bit_generator.state
    t_s = np.arange(-0.1, 4.2, 0.005)
    begin_ns = round(1e10 * seed)
    gravity = 9.81 * Rotation.random(random_state=seed).apply([0.0, 0.0, -1.0])

    def body(at_s: Array) -> tuple[Array, Array]:
        rng.bit_generator.state = state
        R, centre = moved(rng, at_s, turns)
        return R @ R_CAM_BODY, centre - R @ R_CAM_BODY @ ARM_M

    (R0, P0), (R, P), (R1, P1) = body(t_s - STEP_S), body(t_s), body(t_s + STEP_S)
    forces = np.einsum("nji,nj->ni", R, (P1 - 2.0 * P + P0) / STEP_S**2 - gravity) + BIAS_M_S2
    rates = np.array([so3_log(np.ascontiguousarray(a.T @ b)) for a, b in zip(R0, R1, strict=True)]) / (2.0 * STEP_S)
    forces += rng.normal(0.0, NOISE.accelerometer_noise_density * 200.0**0.5, forces.shape)
    rates += rng.normal(0.0, NOISE.gyroscope_noise_density * 200.0**0.5, rates.shape)
    stamps = begin_ns + np.round((t_s + OFFSET_S) * 1e9).astype(np.int64)
    samples = [ImuSample(int(t), w, f) for t, w, f in zip(stamps, rates, forces, strict=True)]
    keys_s = np.linspace(0.0, 4.0, 16)
    R, P = body(keys_s)
    scale_m = float(rng.uniform(0.5, 5.0))
    centre = P + R @ ARM_M + rng.normal(0.0, 0.002, P.shape)
    turned = R @ R_CAM_BODY.T @ Rotation.from_rotvec(rng.normal(0.0, 3e-4, (16, 3))).as_matrix()
    at = Structure(turned, centre / scale_m, np.tile([0.0, 0.0, 1.0], (3, 1)), np.ones(3), 0)
    table = np.zeros((16, 3, 2))
    t_ns = begin_ns + np.round(keys_s * 1e9).astype(np.int64)
    return Piece(Segment(t_ns, table, table, table), at, np.ones((16, 3), dtype=np.bool_)), samples, scale_m


def found(turns: float, seeds: range) -> tuple[LeverArm | None, Array]:
    pieces, samples, scales = [], list[ImuSample](), []
    for seed in seeds:
        piece, more, scale_m = stretch(seed, turns)
        pieces.append(piece)
        samples += more
        scales.append(scale_m)
    shared = Shared(CAMERA, 0.0, None, R_CAM_BODY, OFFSET_S)
    return find_lever_arm(pieces, shared, samples, NOISE, 1.0), np.array(scales)


def test_a_lever_arm_is_found_with_the_scale_of_every_stretch() -> None:
    lever, scales = found(0.5, range(8))
    assert lever is not None
    errors = np.concatenate([lever.arm_m - ARM_M, lever.accel_bias_m_s2 - BIAS_M_S2])
    print(errors, lever.known.sigmas, lever.scale_m / scales, lever.centre_sigma_m)
    assert np.all(np.abs(errors) < 4.0 * lever.known.sigmas)
    assert np.all(np.abs(errors[:3]) < 0.005) and np.all(lever.known.sigmas[:3] < 0.01)
    assert np.all(np.abs(lever.scale_m / scales - 1.0) < 0.03)
    assert 0.001 < lever.centre_sigma_m < 0.005


def test_sigmas_of_lever_arms_are_those_of_their_errors() -> None:
    errors = []
    for first in range(20, 140, 6):
        lever, _ = found(0.5, range(first, first + 6))
        assert lever is not None
        errors.append((lever.arm_m - ARM_M) / lever.known.sigmas[:3])
    print(np.sqrt(np.mean(np.square(errors))))
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_without_turning_the_lever_arm_stays_open() -> None:
    lever, _ = found(0.0, range(200, 206))
    assert lever is None or np.all(lever.known.sigmas[:3] > 0.05)


def test_two_stretches_or_missing_samples_say_no_lever_arm() -> None:
    assert found(0.5, range(2))[0] is None
    pieces = [stretch(seed, 0.5)[0] for seed in range(4)]
    shared = Shared(CAMERA, 0.0, None, R_CAM_BODY, OFFSET_S)
    assert find_lever_arm(pieces, shared, stretch(0, 0.5)[1], NOISE, 1.0) is None
