"""A lens from waving a camera about: exact worlds with noise, what motion does not show, and a real recording."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vislam.calibration.self_calibration import waving
from vislam.calibration.self_calibration.adjust import Shared, steadied
from vislam.calibration.self_calibration.certainty import certainty
from vislam.calibration.self_calibration.lens_search import Solution, find_lens, with_gyro
from vislam.calibration.self_calibration.patches import _aligned
from vislam.calibration.self_calibration.segments import Segment
from vislam.calibration.self_calibration.structure import GYRO, READOUT, SHARED, Gyro, Structure, linearise, residuals
from vislam.core.camera import Camera, Rig
from vislam.core.messages import Array
from vislam.datasets.camera_files import read_cameras
from worlds.calibration import calibrate, refusal

RADTAN = Camera(640, 480, 470.0, 468.0, 325.0, 234.0, 0.0, "radtan", (-0.21, 0.06, 0.0006, -0.0005, -0.012))
WIDE = Camera(640, 480, 290.0, 291.0, 316.0, 243.0, 0.0, "equidistant", (-0.01, 0.004, -0.003, 0.001))
GUESS = Camera(640, 480, 564.0, 564.0, 319.5, 239.5, 0.0, "radtan", (0.0,) * 5)  # a fifth too long
NOISE_PX = 0.3


def attitude(seed: int, t_s: Array, turns: float) -> tuple[Rotation, Array]:
    """Return how a swung camera is turned and where it is [N, 3] at times [N]."""
    rng = np.random.default_rng([seed, 1])
    phase, speed = rng.uniform(0.0, 6.3, 6), rng.uniform(0.8, 1.6, 6)
    way = np.sin(np.outer(t_s, speed) + phase)
    return Rotation.from_rotvec(turns * way[:, :3]), 0.5 * way[:, 3:]


def waved(seed: int, camera: Camera, readout_s: float = 0.0, turns: float = 0.35, points: int = 100) -> Segment:
    """Return what a camera sees of a cloud of points as it is swung about it for 3 s, 12 keyframes."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform([-4.0, -3.0, 2.0], [4.0, 3.0, 6.0], (points, 3))

    def project(t_s: Array) -> Array:
        turned, centre = attitude(seed, t_s, turns)
        return camera.project(np.einsum("nji,nj->ni", turned.as_matrix(), cloud - centre))

    def seen(t_s: float) -> Array:
        pixels = project(np.full(points, t_s))
        for _ in range(3):
            pixels = project(t_s + (np.nan_to_num(pixels[:, 1]) / (camera.height - 1) - 0.5) * readout_s)
        return np.where(camera.contains(pixels)[:, None], pixels, np.nan) + rng.normal(0.0, NOISE_PX, (points, 2))

    times = np.linspace(0.0, 3.0, 12)
    pixels = np.stack([seen(t) for t in times])
    flow = np.stack([seen(t + 0.03) - seen(t - 0.03) for t in times]) / 0.06
    pixels[~np.isfinite(flow)] = np.nan
    pixels[:, np.isfinite(pixels[:, :, 0]).sum(axis=0) < 3] = np.nan
    return Segment(np.round((times + 10.0 * seed) * 1e9).astype(np.int64), pixels, flow, flow)


def solved(seeds: range, camera: Camera, guess: Camera, readout_s: float = 0.0) -> Solution:
    found = find_lens([waved(seed, camera, readout_s) for seed in seeds], guess, None)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def rolling() -> Solution:
    """Return what six stretches of a rolling shutter show, begun with a focal length a fifth too long."""
    return solved(range(6), RADTAN, GUESS, 0.02)


def test_a_focal_length_is_found_from_a_fifth_too_much_with_the_readout(rolling: Solution) -> None:
    found = rolling
    errors = found.shared.values[:GYRO] - [470.0, 468.0, 325.0, 234.0, *RADTAN.coefficients, 0.02]
    known = certainty(found)
    print(errors, known.sigmas[:GYRO])
    assert np.all(np.abs(errors) < 4.0 * known.sigmas[:GYRO])
    assert np.all(np.abs(errors[:2]) < 0.005 * 470.0)
    assert np.all(known.sigmas[:2] < 0.01 * 470.0)
    assert abs(errors[READOUT]) < 1e-3
    assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.15)
    kept = sum(int(piece.kept.sum()) for piece in found.pieces)
    assert kept > 0.9 * sum(int(np.isfinite(piece.segment.pixels[:, :, 0]).sum()) for piece in found.pieces)


def test_a_coefficient_that_the_model_lacks_bends_the_rest() -> None:
    """On MH_01 the missing k3 moved the principal point by 11 px and turned the camera by 0.8 deg."""
    bent = replace(RADTAN, coefficients=(-0.35, 0.25, 0.0006, -0.0005, -0.12))
    segments = [waved(seed, bent, 0.02) for seed in range(4)]
    pair = [find_lens(segments, replace(GUESS, coefficients=(0.0,) * n), None) for n in (4, 5)]
    short, full = (found for found in pair if found is not None)
    assert len(short.shared.camera.coefficients) == 4
    print(short.sigma_px, full.sigma_px, short.shared.values[:GYRO], full.shared.values[:GYRO])
    known = certainty(full)
    errors = full.shared.values[:GYRO] - [470.0, 468.0, 325.0, 234.0, *bent.coefficients, 0.02]
    assert np.all(np.abs(errors) < 4.0 * known.sigmas[:GYRO])
    assert short.sigma_px > 1.1 * full.sigma_px


def test_a_wide_lens_is_found_as_an_equidistant_one() -> None:
    guess = replace(WIDE, fx=350.0, fy=350.0, cx=319.5, cy=239.5, coefficients=(0.0,) * 4)
    found = solved(range(20, 25), WIDE, guess)
    known = certainty(found)
    errors = found.shared.values[:4] - [290.0, 291.0, 316.0, 243.0]
    print(errors, known.sigmas[:9])
    assert np.all(np.abs(errors) < 4.0 * known.sigmas[:4])
    assert np.all(np.abs(errors[:2]) < 0.005 * 290.0)


def test_a_gyroscope_joins_in(rolling: Solution) -> None:
    """Rotation and offset against it come out, within what is told of them."""
    R_body_cam, offset_s, bias = Rotation.from_rotvec([0.7, -1.1, 0.4]), 0.012, np.array([0.02, -0.01, 0.03])
    rng = np.random.default_rng(8)
    t_s, rates = [], []
    for seed in range(6):
        at = np.arange(-0.5, 3.5, 0.005)
        before, after = attitude(seed, at - 0.001, 0.35)[0], attitude(seed, at + 0.001, 0.35)[0]
        rates.append(R_body_cam.apply((before.inv() * after).as_rotvec() / 0.002) + bias)
        t_s.append(at + 10.0 * seed + offset_s)
    samples = np.vstack(rates)
    gyro = Gyro(0, np.concatenate(t_s), samples + rng.normal(0.0, 2e-3, samples.shape), 2e-3 * 0.07, 0.01)
    joint = with_gyro(rolling, gyro)
    assert isinstance(joint, Solution)
    known = certainty(joint)
    turn = Rotation.from_matrix(joint.shared.R_cam_body) * R_body_cam
    errors = np.array(
        [*turn.as_rotvec(), joint.shared.time_offset_s - offset_s, *(joint.shared.gyro_bias_rad_s - bias)]
    )
    print(errors, known.sigmas[GYRO:])
    assert np.all(np.abs(errors) < 4.0 * known.sigmas[GYRO : GYRO + 7])
    assert np.rad2deg(turn.magnitude()) < 0.3 and abs(errors[3]) < 1e-3
    T_told = np.eye(4)
    T_told[:3, 3] = 0.1, 0.2, 0.3
    (entry,) = waving._chain(waving.SelfResult(joint, known, 6, Rig((RADTAN,), (T_told,)), "", 1.0))
    assert entry.T_body_cam is not None and entry.T_body_cam[:3, 3].tolist() == [0.1, 0.2, 0.3]
    assert entry.T_body_cam[:3, :3] == pytest.approx(joint.shared.R_cam_body.T)
    assert entry.time_offset_s == joint.shared.time_offset_s
    assert known.sigmas[0] <= 1.2 * certainty(rolling).sigmas[0]
    still = replace(gyro, rate_rad_s=rng.normal(0.0, 0.1, samples.shape))
    assert "do not turn alike: their speeds correlate by 0" in str(with_gyro(rolling, still))
    assert "fewer than 30 pairs" in str(with_gyro(rolling, replace(gyro, t_s=gyro.t_s + 1000.0)))


def test_without_turning_the_focal_length_stays_open() -> None:
    found = find_lens([waved(seed, RADTAN, turns=0.0) for seed in range(40, 43)], GUESS, None)
    assert found is None or certainty(found).sigmas[0] > 0.01 * 470.0


def test_derivatives_are_those_of_the_prediction() -> None:
    segment = waved(3, RADTAN, 0.02)
    rng = np.random.default_rng(5)
    n, m = segment.pixels.shape[:2]
    way = rng.normal(0.0, 0.1, (n, 3))
    ray = rng.normal([0.0, 0.0, 1.0], 0.3, (m, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    at = Structure(Rotation.from_rotvec(way).as_matrix(), way, ray, rng.uniform(0.2, 1.0, m), 0)
    shared = Shared(RADTAN, 0.0)
    kept = np.isfinite(segment.pixels[:, :, 0])
    lines = linearise(segment, at, shared.camera, shared.readout_s, kept)
    step = 1e-6

    def change(by_pose: Array, by_point: Array, by_shared: Array) -> Array:
        r = []
        for sign in (1.0, -1.0):
            there = shared.moved(sign * by_shared)
            moved = at.moved(sign * by_pose, sign * by_point)
            r.append(residuals(segment, moved, there.camera, there.readout_s)[lines.keyframe, lines.point])
        return (r[1] - r[0]) / (2.0 * step)

    for a in range(6):
        by_pose = np.zeros((n, 6))
        by_pose[:, a] = step
        assert lines.by_pose[:, :, a] == pytest.approx(change(by_pose, np.zeros((m, 3)), np.zeros(SHARED)), abs=1e-3)
    for a in range(3):
        by_point = np.zeros((m, 3))
        by_point[:, a] = step
        assert lines.by_point[:, :, a] == pytest.approx(change(np.zeros((n, 6)), by_point, np.zeros(SHARED)), abs=1e-3)
    for a in range(GYRO):
        by_shared = step * np.eye(SHARED)[a]
        expected = change(np.zeros((n, 6)), np.zeros((m, 3)), by_shared)
        assert lines.by_shared[:, :, a] == pytest.approx(expected, abs=1e-3)


def test_velocities_of_one_motion_are_better_than_single_ones(rolling: Solution) -> None:
    piece = rolling.pieces[0]
    noisy = piece.segment.flow_px_s + np.random.default_rng(1).normal(0.0, 20.0, piece.segment.flow_px_s.shape)
    again = steadied(replace(piece, segment=replace(piece.segment, flow_px_s=noisy)), rolling.shared)
    off = (again.segment.velocity_px_s - piece.segment.velocity_px_s)[piece.kept]
    assert np.sqrt(np.mean(off**2)) < 10.0  # of 20


def test_a_patch_is_found_to_a_fraction_of_a_pixel() -> None:
    import cv2

    rng = np.random.default_rng(2)
    image = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (120, 160)).astype(np.float32), (0, 0), 2.0)
    image = cv2.normalize(image, None, 0.0, 255.0, cv2.NORM_MINMAX)
    shifted = cv2.warpAffine(image, np.array([[1.0, 0.0, 0.4], [0.0, 1.0, -0.7]]), (160, 120), flags=cv2.INTER_CUBIC)
    at = np.array([[60.0, 50.0], [90.0, 70.0]])
    templates = np.stack([image[y - 8 : y + 9, x - 8 : x + 9] for x, y in at.astype(int)])
    found = _aligned(templates, (0.7 * shifted + 20.0).astype(np.uint8), at)
    assert found - at == pytest.approx(np.array([[0.4, -0.7]] * 2), abs=0.06)
    assert np.isnan(_aligned(templates, np.full((120, 160), 90, dtype=np.uint8), at)).all()


def test_the_verb_writes_what_a_run_takes(
    rolling: Solution, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(waving, "follow_segments", lambda *_: [piece.segment for piece in rolling.pieces])
    monkeypatch.setattr(waving, "find_lens", lambda *_: rolling)
    out = tmp_path / "out"
    answer = calibrate(capsys, "self", "points:still,duration_s=8,tracks=60,rig=stereo", "--out", out)
    chain = read_cameras(out / "camchain.yaml")
    assert [camera.camera.width for camera in chain] == [640, 752]
    assert chain[0].camera.fx == answer["parameters"]["fx"]
    assert chain[0].time_offset_s is None
    assert answer["camera_imu"] == {"reason_without": "the recording has no IMU"}
    assert any("the shutter rolls: 20." in said or "the shutter rolls: 19." in said for said in answer["statements"])
    assert (out / "self.png").stat().st_size > 10_000
    again = refusal(capsys, "self", "points:still,duration_s=8,tracks=60", "--out", out, code=2)
    assert "already holds" in again


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ("--out", tmp_path / "out")
    still = refusal(capsys, "self", "points:still,duration_s=8,tracks=60,rig=mono", *out)
    assert "stretches" in still and "wave the camera" in still
    assert not list((tmp_path / "out").glob("*"))
