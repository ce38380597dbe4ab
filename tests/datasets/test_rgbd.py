"""Colour against depth: every fault is found with its size, alone, and what cannot be told is not told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_other_formats import write_tum

from vislam.config import CalibrationConfig
from vislam.core import Problems
from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.geometry import so3_exp
from vislam.core.messages import Frame
from vislam.datasets import open_dataset, survey
from vislam.datasets.calibration import DepthFile, parse_depth
from vislam.datasets.images import DepthFormat, read_raw_depth
from vislam.datasets.inspect import inspect
from vislam.datasets.recorder import record
from vislam.datasets.rgbd import RgbdFacts, rgbd_facts, rgbd_faults
from vislam.datasets.rgbd.facts import OddValue, odd_values
from vislam.datasets.stream import frame_table
from vislam.sim import open_world
from vislam.sim.motion.path import wander
from vislam.sim.motion.spline import BodySpline
from vislam.sim.worlds.table import WORLDS
from vislam.vision.depth_edges import EdgeAlignment, FrameEnds, align_edges, frame_ends
from vislam.vision.depth_focal import FocalFit, SeenPoints, fit_focal
from worlds.mini_recording import camera_yaml

CAMERA = Camera(640, 480, 520.0, 515.0, 318.0, 242.0, 0.0, "radtan", (-0.1, 0.02, 0.0, 0.0))


def moving_boards(offset_px: tuple[int, int], lag_s: float, still: bool = False, wider: int = 0) -> list[FrameEnds]:
    """Frames of boards before a wall that move as one; depth is drawn where it lies `lag_s` before its stamp."""
    generator = np.random.default_rng(1)
    frames = []
    for k in range(12):
        velocity = np.zeros(2) if still else 300.0 * np.array([np.cos(1.1 * k), np.sin(1.1 * k)])
        delay_s = 0.004 * (k % 3 - 1)
        image, depth = np.full((240, 320), 60, np.uint8), np.full((240, 320), 4.0, np.float32)
        moved = np.rint(velocity * (delay_s - lag_s) + offset_px).astype(int)
        for _ in range(14):
            left, top = generator.integers(20, 260), generator.integers(20, 180)
            width, height = generator.integers(25, 60, 2)
            grey = int(generator.integers(110, 250))
            cv2.rectangle(image, (left, top), (left + width, top + height), grey, -1)
            begin = np.add((left, top), moved) - wider
            end = np.add((left + width, top + height), moved) + wider
            cv2.rectangle(depth, begin.tolist(), end.tolist(), float(generator.uniform(1.0, 3.0)), -1)
        image = np.clip(image + generator.normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8)
        flow = np.broadcast_to(velocity.astype(np.float32), (240, 320, 2))
        frames.append(frame_ends(depth, image, flow, delay_s))
    return frames


@pytest.mark.parametrize(("offset_px", "lag_s"), [((0, 0), 0.0), ((6, -4), 0.0), ((0, 0), 0.03), ((-9, 5), -0.04)])
def test_place_and_lag_of_depth_are_found_apart(offset_px: tuple[int, int], lag_s: float) -> None:
    found = align_edges(moving_boards(offset_px, lag_s))
    assert found is not None
    np.testing.assert_allclose(found.offset_px, offset_px, atol=0.5)
    assert found.lag_s == pytest.approx(lag_s, abs=0.003)
    assert found.offset_sigma_px.max() < 0.5 and found.lag_sigma_s < 0.003


def test_foregrounds_that_a_sensor_makes_wider_are_no_offset() -> None:
    found = align_edges(moving_boards((0, 0), 0.0, wider=2))
    assert found is not None
    np.testing.assert_allclose(found.offset_px, 0.0, atol=0.5)


def test_a_camera_that_stands_still_tells_no_lag() -> None:
    found = align_edges(moving_boards((5, 0), 0.0, still=True))
    assert found is not None and np.isinf(found.lag_sigma_s)
    assert found.offset_px[0] == pytest.approx(5.0, abs=0.5)


def test_a_wall_alone_tells_nothing() -> None:
    image, flow = np.full((240, 320), 90, np.uint8), np.zeros((240, 320, 2), np.float32)
    assert align_edges([frame_ends(np.full((240, 320), 2.0, np.float32), image, flow, 0.0)] * 12) is None
    assert align_edges([]) is None


def point_pairs(count: int, true_camera: Camera, unit: float = 1.0, readout_s: float = 0.0) -> list:
    """Points as two views of a turning camera see them, with noise of tracks and depth."""
    generator = np.random.default_rng(2)
    pairs = []
    for _ in range(count):
        pixels = generator.uniform((40, 40), (600, 440), (150, 2))
        z = generator.uniform(1.0, 3.0, 150)
        points = np.column_stack([true_camera.normalise(pixels), np.ones(150)]) * z[:, None]
        R, t = so3_exp(generator.normal(0.0, 0.12, 3)), generator.normal(0.0, 0.1, 3)
        there = points @ R.T + t
        seen = true_camera.project(there)
        speed = (seen - pixels) / 0.5
        views = []
        for p, depth in ((pixels, z), (seen, there[:, 2])):
            late = speed * (p[:, 1:] / true_camera.height - 0.5) * readout_s
            rho = unit / depth + generator.normal(0.0, 0.003, 150)
            views.append(SeenPoints(p + late + generator.normal(0.0, 0.3, p.shape), speed, rho, np.zeros((150, 2))))
        pairs.append(tuple(views))
    return pairs


@pytest.mark.parametrize("off", [1.0, 1.02, 0.95, 1.11])
@pytest.mark.parametrize("unit", [1.0, 1.05])
def test_the_focal_length_is_found_whatever_the_unit_of_depth(off: float, unit: float) -> None:
    told = replace(CAMERA, fx=CAMERA.fx * off, fy=CAMERA.fy * off)
    found = fit_focal(told, point_pairs(20, CAMERA, unit), np.full(2, 0.5), 0.003)
    assert found is not None and found.sigma < 0.004
    assert found.factor * off == pytest.approx(1.0, abs=0.006)


def test_a_rolling_shutter_is_no_focal_length() -> None:
    found = fit_focal(CAMERA, point_pairs(20, CAMERA, readout_s=0.02), np.full(2, 0.5), 0.003)
    assert found is not None
    assert found.readout_s == pytest.approx(0.02, abs=0.002) and found.factor == pytest.approx(1.0, abs=0.006)


def test_views_that_agree_on_no_motion_tell_no_focal_length() -> None:
    generator = np.random.default_rng(4)
    pairs = [
        (a, replace(b, pixels=generator.uniform(40, 440, b.pixels.shape))) for a, b in point_pairs(12, CAMERA)
    ]  # fmt: skip
    assert fit_focal(CAMERA, pairs, np.full(2, 0.5), 0.003) is None
    assert fit_focal(CAMERA, [], np.full(2, 0.5), 0.003) is None


def test_numbers_that_are_no_depth_stand_out() -> None:
    counts = np.zeros(65536, np.int64)
    counts[3000:9000] = 100
    often = counts >= 0
    assert odd_values(counts, often, ()) == ()
    counts[65535] = 1
    assert [(odd.value, odd.is_known) for odd in odd_values(counts, often, ())] == [(65535, True)]
    counts[65535], counts[8000] = 0, 100_000  # among the depths
    assert [(odd.value, odd.is_known) for odd in odd_values(counts, often, ())] == [(8000, False)]
    assert odd_values(counts, np.zeros(65536, bool), ()) == ()  # a face in a few images only
    assert odd_values(counts, often, (8000,))[0].is_known


def test_saturated_and_named_numbers_are_no_depth_and_an_offset_is_undone() -> None:
    raw = np.full((4, 6), 2000, np.uint16)
    raw[0, 0], raw[1, 1], raw[2, 3] = 65535, 1234, 4000
    depth = DepthFormat(1000.0, (1234,), (2.2, 1.0)).in_m(raw)
    assert depth[1, 1] == 4.0  # lay at row 2, column 3
    assert depth[0, 5] == 0.0 and depth[3, 0] == 0.0  # from outside
    plain = DepthFormat(1000.0, (1234,)).in_m(raw)
    assert plain[0, 0] == 0.0 and plain[1, 1] == 0.0 and plain[2, 3] == 4.0


def test_a_sensor_file_says_how_depth_is_read(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "my_kinect", (64, 48))
    keys = "depth_units_per_m: 1000\ndepth_invalid: [5000]\ndepth_time_offset_s: -0.01\n"
    (folder / "sensor.yaml").write_text(camera_yaml(extra=keys))
    frames = [event for event in open_dataset(str(folder)).events() if isinstance(event, Frame)]
    found = survey(str(folder))
    assert found.depth is not None
    # 10 ms after its frame becomes none, 25 ms becomes 15 ms, which is near enough
    assert found.depth.t_ns[0] - frames[0].t_ns == pytest.approx(0, abs=2000)
    depths = [None if frame.depth_m is None else float(frame.depth_m.max()) for frame in frames]
    assert depths == [0.0, None, 15.0, 20.0]


def test_the_file_of_a_calibration_says_it_too(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1", (640, 480))
    text = "resolution: [640, 480]\nintrinsics: [500, 500, 320, 240]\ndistortion_model: none\n"
    (tmp_path / "sensor.yaml").write_text(text + "depth_units_per_m: 10000\n")
    recording = open_dataset(str(folder), CalibrationConfig(camera=str(tmp_path / "sensor.yaml")))
    first = next(event for event in recording.events() if isinstance(event, Frame))
    assert first.depth_m is not None and first.depth_m.max() == pytest.approx(0.5)
    assert recording.rig.cameras[0].fx == 500.0


@pytest.mark.parametrize(
    "keys", [{"depth_offset_px": [1]}, {"depth_offset_px": [1e9, 0]}, {"depth_time_offset_s": "x"},
             {"depth_time_offset_s": 1e6}, {"depth_invalid": "none"}, {"depth_units_per_m": 0}],
)  # fmt: skip
def test_keys_of_depth_that_cannot_be_are_refused(keys: dict[str, object]) -> None:
    with pytest.raises(DataError, match=r"sensor\.yaml"):
        parse_depth(keys, Path("sensor.yaml"))
    assert parse_depth({}, Path("sensor.yaml")) == DepthFile()


def facts(offset_px=(0.0, 0.0), sigma_px=0.5, lag_s=0.0, lag_sigma_s=0.002, factor=1.0, sigma=0.004) -> RgbdFacts:
    nothing = np.zeros(0)
    edges = EdgeAlignment(
        np.array(offset_px), np.full(2, sigma_px), lag_s, lag_sigma_s, 9000, 1.8, np.zeros((2, 0)), nothing, nothing,
        nothing,
    )  # fmt: skip
    return RgbdFacts((), 1.5, edges, FocalFit(factor, sigma, 0.0, 0.001, np.zeros(2), 0.0, 40, 4000, 9.0), 300)


@pytest.mark.parametrize(
    ("found", "what"),
    [
        (facts(), []),
        (facts(offset_px=(0.8, 2.5), lag_s=0.013, factor=0.995), []),  # as a Kinect of the benchmark has it
        (facts(offset_px=(6.0, 0.0)), ["offset"]),
        (facts(lag_s=0.03), ["lag"]),
        (facts(lag_s=-0.03), ["lag"]),
        (facts(factor=0.98), ["focal length"]),
        (facts(factor=0.98, sigma=0.02), []),
        (facts(offset_px=(6.0, 0.0), sigma_px=4.0), []),
        (facts(lag_s=0.03, lag_sigma_s=np.inf), []),
        (replace(facts(), odd_values=(OddValue(65535, 0.2, True),)), ["invalid value"]),
        (replace(facts(), median_depth_m=0.02), ["unit"]),
        (replace(facts(), edges=None, focal=None), []),
    ],
)
def test_only_what_is_wrong_and_sure_is_accused(found: RgbdFacts, what: list[str]) -> None:
    assert [fault.what for fault in rgbd_faults(found, 640)] == what


def test_doctor_tells_of_saturated_depth_and_of_what_it_cannot_tell(tmp_path: Path, monkeypatch) -> None:
    folder = write_tum(tmp_path / "my_kinect", (64, 48))
    (folder / "sensor.yaml").write_text(camera_yaml())
    for path in (folder / "depth").iterdir():
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        raw[:10] = 65535
        cv2.imwrite(str(path), raw)
    read: list[str] = []
    reading = lambda path, lens: (read.append(path.name), read_raw_depth(path, lens))[1]  # noqa: E731
    monkeypatch.setattr("vislam.datasets.images.read_raw_depth", reading)
    said = {finding.what: finding.severity for finding in inspect(str(folder)).findings}
    assert read == ["0.png", "2.png", "3.png"]  # each once, though two examinations want them
    assert said["depth 65535 in 20.8% of the pixels means that nothing was measured"] == "warning"
    assert any(what.startswith("colour and depth do not show offset or lag or focal length") for what in said)


def hand_with_fast_turns(rng: np.random.Generator) -> BodySpline:
    """Turns of up to some 140 deg/s, as of a hand, in the middle of a room."""
    seeds = rng.integers(0, 2**32, 3)

    def design(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sway, swing, tremble = (np.random.default_rng(seed) for seed in seeds)
        position = np.array([0.0, 0.0, 1.35]) + wander(t_s, sway, 0.12, (0.2, 0.8), 3)
        angles = np.column_stack([0.0 * t_s, 0.0 * t_s + 0.12, 0.35 * t_s])
        angles += wander(t_s, swing, 1.0, (0.3, 1.0), 3) * np.array([0.1, 0.14, 0.28])
        return position, angles + wander(t_s, tremble, 0.006, (1.5, 4.0), 3)

    return BodySpline.from_design(design, 6.5, 0.05)


@pytest.mark.slow
def test_fast_turns_with_a_rolling_shutter_do_not_bias_the_focal_length(tmp_path: Path) -> None:
    seed, readout_s = 1, 0.03
    room = replace(WORLDS["handheld-room"], motion=hand_with_fast_turns)
    options = {"rig": "rgbd", "camera_hz": 30.0, "image_width_px": 320, "readout_s": readout_s, "world_seed": seed}
    record(open_world(room, seed, workers=2, **options), tmp_path)
    found = survey(str(tmp_path))
    frames, rig = frame_table(found, Problems()), found.rig
    assert rig is not None
    for off in (1.0, 1.05):
        camera = replace(rig.cameras[0], fx=off * rig.cameras[0].fx, fy=off * rig.cameras[0].fy)
        measured = rgbd_facts(found, replace(rig, cameras=(camera,)), frames)
        focal = measured.focal
        assert focal is not None and focal.readout_s == pytest.approx(off * readout_s, abs=1e-3)  # as pixels per angle
        assert abs(off * focal.factor - 1.0) < min(3.0 * focal.sigma, 0.01)
        assert [fault.what for fault in rgbd_faults(measured, 320)] == ([] if off == 1.0 else ["focal length"])
