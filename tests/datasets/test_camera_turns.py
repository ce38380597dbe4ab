"""Focal length, mounting and clock against the gyroscope: each fault is named with its size, and nothing else is."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from vislam.core.camera import Camera
from vislam.core.findings import Finding
from vislam.core.geometry import so3_exp
from vislam.datasets.camera_turns import TurnTracks, fit_turns, turn_findings
from vislam.datasets.inspect import inspect
from vislam.datasets.recorder import record
from vislam.imu.gyro_turns import integrate_gyro
from vislam.sim import open_world

CAMERA = Camera(640, 480, 456.0, 455.0, 322.0, 238.0, 0.0, "radtan", (-0.08, 0.04, 0.0006, -0.0004))
R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) @ so3_exp(np.array([0.1, -0.05, 0.08]))
SPANS_NS = [(k, round(1e9 * (1.0 + 0.8 * k + 0.15 * part)), 150_000_000) for k in range(12) for part in range(3)]


def tracks_of_points(seed: int, readout_s: float = 0.0) -> tuple[list[TurnTracks], list[tuple[int, list[float]]]]:
    """Points seen by a hand-held camera that turns to and fro by up to 90 deg/s, and the gyroscope's rows at 200 Hz."""
    generator = np.random.default_rng(seed)
    t_s = np.arange(0.0, 12.0, 0.001)
    frequency, phase = generator.uniform(0.4, 1.2, (6, 3)), generator.uniform(0.0, 2.0 * np.pi, (6, 3))
    rate = np.sin(2.0 * np.pi * frequency * t_s[:, None, None] + phase).sum(axis=1) * 0.4
    R = integrate_gyro(t_s, rate)
    position = np.cumsum(np.sin(2.0 * np.pi * frequency[0] * t_s[:, None] + phase[1]), axis=0) * 3e-4
    gyro = rate + np.array([0.01, -0.02, 0.005]) + generator.normal(0.0, 0.003, rate.shape)
    rows = [(k * 1_000_000, [*gyro[k].tolist(), 0.0, 0.0, 9.8]) for k in range(0, len(t_s), 5)]

    def seen(points: np.ndarray, t_ns: int) -> np.ndarray:
        late_s = np.zeros(len(points))
        for _ in range(4):
            k = np.rint((t_ns * 1e-9 + late_s) * 1e3).astype(int)
            R_world_cam = R[k] @ R_BODY_CAM
            pixels = CAMERA.project(np.einsum("nji,nj->ni", R_world_cam, points - position[k]))
            late_s = np.nan_to_num(readout_s * (pixels[:, 1] / CAMERA.height - 0.5))
        return pixels

    tracks = []
    for place, begin_ns, span_ns in SPANS_NS:
        pixels = generator.uniform((20, 20), (620, 460), (150, 2))
        k = begin_ns // 1_000_000
        rays = np.column_stack([CAMERA.normalise(pixels), np.ones(150)]) * generator.uniform(1.0, 5.0, (150, 1))
        points = rays @ (R[k] @ R_BODY_CAM).T + position[k]
        ends = [begin_ns, begin_ns + span_ns]
        views = [seen(points, t) + generator.normal(0.0, 0.3, pixels.shape) for t in ends]
        speed = [(seen(points, t + 10_000_000) - seen(points, t - 10_000_000)) / 0.02 for t in ends]
        kept = np.isfinite(np.hstack([*views, *speed])).all(axis=1)
        one, two = (tuple(part[kept] for part in both) for both in (views, speed))
        tracks.append(TurnTracks(place, (begin_ns, begin_ns + span_ns), one, two))
    return tracks, rows


def judged(seed: int, readout_s: float, factor: float, turn: np.ndarray, late_s: float) -> list[Finding]:
    tracks, rows = tracks_of_points(seed, readout_s)
    late_ns = round(1e9 * late_s)
    stamped = [one._replace(span_ns=(one.span_ns[0] + late_ns, one.span_ns[1] + late_ns)) for one in tracks]
    given = Camera(640, 480, factor * CAMERA.fx, factor * CAMERA.fy, 322.0, 238.0, 0.0, "radtan", CAMERA.coefficients)
    fit = fit_turns(given, so3_exp(turn) @ R_BODY_CAM, stamped, rows, np.zeros(3))
    assert fit is not None
    return turn_findings(fit)


NOTHING = np.zeros(3)
AXIS = np.deg2rad(3.0) * np.eye(3)
FAULTS = [
    (1.15, NOTHING, 0.0, "focal length is", "too long"), (0.85, NOTHING, 0.0, "focal length is", "too short"),
    (1.0, AXIS[0], 0.0, "cam0 is turned by", "against its T_BS"),
    (1.0, AXIS[1], 0.0, "cam0 is turned by", "against its T_BS"),
    (1.0, AXIS[2], 0.0, "cam0 is turned by", "against its T_BS"),
    (1.0, NOTHING, 0.02, "its stamps are", "late"), (1.0, NOTHING, -0.02, "its stamps are", "early"),
]  # fmt: skip


SOURCES = ["euroc_mh01_17s", "handheld-room", "corridor-loop"]


def said_size(text: str) -> float:
    return next(float(word) for word in text.split() if word.replace(".", "").isdigit())


def check_named(found: list[Finding], factor: float, late_s: float, begin: str, end: str) -> None:
    (warning,) = found
    assert warning.severity == "warning" and warning.next_step
    assert begin in warning.what and warning.what.endswith(end), warning.what
    true = 100.0 * abs(factor - 1.0) or 1e3 * abs(late_s) or 3.0
    assert said_size(warning.what) == pytest.approx(true, rel=0.15), warning.what


@pytest.mark.parametrize("readout_s", [0.0, 0.025])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_is_right_is_not_accused_though_the_shutter_rolls(seed: int, readout_s: float) -> None:
    (found,) = judged(seed, readout_s, 1.0, NOTHING, 0.0)
    assert found.severity == "ok" and "the focal length is" in found.what


@pytest.mark.parametrize("readout_s", [0.0, 0.025])
@pytest.mark.parametrize(("factor", "turn", "late_s", "begin", "end"), FAULTS)
def test_each_fault_alone_is_named_with_its_size(
    factor: float, turn: np.ndarray, late_s: float, begin: str, end: str, readout_s: float
) -> None:
    check_named(judged(1, readout_s, factor, turn, late_s), factor, late_s, begin, end)


def test_few_places_show_how_turns_differ_and_no_cause_and_two_show_nothing() -> None:
    tracks, rows = tracks_of_points(1)
    fit = fit_turns(CAMERA, R_BODY_CAM, [one for one in tracks if one.place < 4], rows, NOTHING)
    assert fit is not None and fit.x is None and fit.differ < 0.1
    assert fit_turns(CAMERA, R_BODY_CAM, [one for one in tracks if one.place < 2], rows, NOTHING) is None
    assert fit_turns(CAMERA, R_BODY_CAM, tracks, rows[:100], NOTHING) is None  # before the first place
    assert fit_turns(CAMERA, R_BODY_CAM, [], rows, NOTHING) is None


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Recordings of two simulated worlds."""
    made = {}
    for world, seed, duration_s in (("handheld-room", 3, 11.0), ("corridor-loop", 1, 15.0)):
        made[world] = tmp_path_factory.mktemp(world)
        options = {"rig": "mono", "duration_s": duration_s, "camera_hz": 10.0, "image_width_px": 320}
        record(open_world(world, seed, workers=2, **options), made[world])
    return made


def spoilt(source: Path, root: Path, factor: float, turn: np.ndarray, late_s: float) -> Path:
    """Copy cam0, up to 150 images of it, and imu0 with a wrong focal length, mount or clock."""
    for name in ("cam0", "imu0"):
        (root / "mav0" / name).mkdir(parents=True)
        for file in ("data.csv", "sensor.yaml"):
            shutil.copyfile(source / "mav0" / name / file, root / "mav0" / name / file)
    cam0 = root / "mav0" / "cam0"
    (cam0 / "data").symlink_to(source / "mav0" / "cam0" / "data")
    sensor = yaml.safe_load((cam0 / "sensor.yaml").read_text())
    T = np.array(sensor["T_BS"]["data"]).reshape(4, 4)
    T[:3, :3] = so3_exp(turn) @ T[:3, :3]
    sensor["T_BS"]["data"] = T.ravel().tolist()
    sensor["intrinsics"] = [factor * f for f in sensor["intrinsics"][:2]] + sensor["intrinsics"][2:]
    (cam0 / "sensor.yaml").write_text(yaml.safe_dump(sensor))
    head, *lines = (cam0 / "data.csv").read_text().splitlines()
    stamped = [line.split(",") for line in lines[:150]]
    late_ns = round(1e9 * late_s)
    (cam0 / "data.csv").write_text("\n".join([head, *(f"{int(t) + late_ns},{name}" for t, name in stamped)]) + "\n")
    return root


@pytest.mark.slow
@pytest.mark.parametrize(("source", "faults"), zip(SOURCES, (FAULTS[k::3] for k in range(3)), strict=True), ids=SOURCES)
def test_doctor_names_faults_of_a_recording_and_approves_of_it_without(
    source: str, faults: list, recordings: dict[str, Path], request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    root = recordings[source] if source in recordings else request.getfixturevalue("data_root") / source

    def turns(*fault: float | np.ndarray, name: str) -> list[Finding]:
        found = inspect(str(spoilt(root, tmp_path / name, *fault))).findings  # type: ignore[arg-type]
        return [one for one in found if "gyro's turns" in one.what or "by the gyro" in one.what]

    if source in recordings:  # see test_doctor_approves_of_euroc_and_refuses_inverted_extrinsics for the other
        (clean,) = turns(1.0, NOTHING, 0.0, name="clean")
        assert clean.severity == "ok", clean.what
    for k, (factor, turn, late_s, begin, end) in enumerate(faults):
        check_named(turns(factor, turn, late_s, name=str(k)), factor, late_s, begin, end)
