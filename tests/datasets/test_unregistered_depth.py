"""Depth with a lens and a place of its own is registered as it is read, whatever the recording is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_other_formats import write_tum

from vislam.config import CalibrationConfig
from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.messages import Frame
from vislam.datasets import open_dataset, survey
from vislam.datasets.calibration import parse_depth
from vislam.datasets.calibration_text import depth_keys_text
from vislam.datasets.images import DepthFormat
from vislam.datasets.inspect import inspect
from vislam.vision.depth_registration import DepthCamera, DepthRegistration
from worlds.bag_writer import Message, types_of, write_bag
from worlds.mini_recording import HEIGHT, WIDTH, camera_yaml, picture, write_asl

LENS = Camera(40, 30, 45.0, 46.0, 20.5, 14.0, 0.0, "radtan", (-0.1, 0.02, 0.001, 0.0))
PLACE = np.array([[0.0, -1.0, 0.0, 0.05], [1.0, 0.0, 0.0, -0.01], [0.0, 0.0, 1.0, 0.02], [0.0, 0.0, 0.0, 1.0]])
RAW = np.random.default_rng(3).integers(700, 3000, (30, 40)).astype(np.uint16)
RAW[4:7, 10:20], RAW[20, 5] = 0, 65535
KEYS = {
    "resolution": [40, 30], "intrinsics": [45.0, 46.0, 20.5, 14.0], "distortion_model": "radial-tangential",
    "distortion_coefficients": [-0.1, 0.02, 0.001, 0.0], "T_color_depth": PLACE.tolist(),
}  # fmt: skip


def text_of(keys: dict[str, object]) -> str:
    return "".join(f"{key}: {value}\n" for key, value in keys.items())


def registered(camera: Camera, units_per_m: float) -> np.ndarray:
    depth_m = np.where(RAW == 65535, 0, RAW).astype(np.float32) / np.float32(units_per_m)
    found = DepthRegistration(DepthCamera(LENS, PLACE), camera).registered(depth_m)
    assert found.shape == (camera.height, camera.width) and found.any() and not found.all()
    return found


def first_depth(source: str, files: CalibrationConfig | None = None) -> tuple[np.ndarray | None, Camera]:
    recording = open_dataset(source, *([] if files is None else [files]))
    frame = next(event for event in recording.events() if isinstance(event, Frame))
    return frame.depth_m, recording.rig.cameras[0]


def tum_folder(folder: Path) -> Path:
    write_tum(folder, (WIDTH, HEIGHT))
    (folder / "sensor.yaml").write_text(camera_yaml())
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), RAW)
    return folder


def test_a_tum_folder_says_so_in_the_sensor_file_of_its_depth(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "mine")
    (folder / "depth" / "sensor.yaml").write_text(text_of(KEYS | {"depth_time_offset_s": -0.01}))
    depth_m, camera = first_depth(str(folder))
    np.testing.assert_array_equal(depth_m, registered(camera, 5000.0))
    recording = open_dataset(str(folder))
    frames = [event for event in recording.events() if isinstance(event, Frame)]
    # 10 ms less: the one that was 25 ms late is near enough
    assert [frame.depth_m is not None for frame in frames] == [True, False, True, True]
    assert frames[3].depth_lag_s == pytest.approx(0.015, abs=1e-5)
    assert not [one for one in inspect(str(folder)).findings if one.severity == "error"]


def test_what_is_written_of_it_is_read_back_from_a_named_file(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "mine")
    how = DepthFormat(1000.0, own=DepthCamera(replace(LENS, skew_px=0.1), PLACE))
    (tmp_path / "c.yaml").write_text(camera_yaml() + depth_keys_text(how))
    files = CalibrationConfig(camera=str(tmp_path / "c.yaml"))
    depth_m, camera = first_depth(str(folder), files)
    expected = DepthRegistration(how.own, camera).registered(how.in_m(RAW))
    np.testing.assert_array_equal(depth_m, expected)


def test_an_asl_folder_says_so_as_well(tmp_path: Path) -> None:
    mav0 = write_asl(tmp_path / "asl", stereo=False)
    (mav0 / "depth0" / "data").mkdir(parents=True)
    stamps = [line.split(",")[0] for line in (mav0 / "cam0" / "data.csv").read_text().splitlines()[1:]]
    for stamp in stamps:
        cv2.imwrite(str(mav0 / "depth0" / "data" / f"{stamp}.png"), RAW)
    (mav0 / "depth0" / "data.csv").write_text("#t,file\n" + "".join(f"{t},{t}.png\n" for t in stamps))
    (mav0 / "depth0" / "sensor.yaml").write_text(text_of(KEYS))
    depth_m, camera = first_depth(str(mav0))
    np.testing.assert_array_equal(depth_m, registered(camera, 1000.0))


def bag(folder: Path, name: str, *, info: bool = True, place: bool = True, zeros: bool = False) -> Path:
    types = types_of("mcap")
    K = np.array([[50.0, 0.0, 31.5], [0.0, 51.0, 23.5], [0.0, 0.0, 1.0]])
    out = [
        Message(1_000, "/color/camera_info", types.info(1_000, (WIDTH, HEIGHT), K, "plumb_bob", [], "color")),
        Message(1_000, "/color/image_raw", types.image(1_000, picture(0), "mono8", "color")),
        Message(1_010, "/depth/image", types.image(1_010, RAW, "16UC1", "depth")),
    ]
    if info:
        info_of = types.info(1_000, (40, 30), LENS.K * (not zeros), "plumb_bob", [*LENS.coefficients, 0.0], "depth")
        out.append(Message(1_000, "/depth/camera_info", info_of))
    if place:
        edges = [("link", "color", np.eye(4)), ("link", "depth", PLACE)]
        out.append(Message(1_000, "/tf_static", types.transforms(1_000, edges)))
    return write_bag(folder, "mcap", out, name=name)


def test_a_bag_with_two_camera_infos_and_places_gives_registered_depth(tmp_path: Path) -> None:
    path = bag(tmp_path, "whole")
    depth_m, camera = first_depth(str(path))
    np.testing.assert_allclose(depth_m, registered(camera, 1000.0), rtol=1e-6)
    roles = {topic.name: topic.taken_for for topic in survey(str(path)).topics}
    assert roles["/depth/image"] == "depth0" and roles["/depth/camera_info"] == "calibration of depth0"


@pytest.mark.parametrize("lacks", [{"info": False}, {"place": False}, {"zeros": True}])
def test_a_bag_that_lacks_either_is_read_without_depth_unless_it_is_asked_for(
    lacks: dict[str, bool], tmp_path: Path
) -> None:
    path = bag(tmp_path, "partly", **lacks)
    assert first_depth(str(path))[0] is None
    words = "not calibrated" if "zeros" in lacks else "need a CameraInfo beside them and transforms"
    with pytest.raises(DataError, match=words) as caught:
        open_dataset(f"bag:{path},depth=/depth/image")
    assert "depth=none" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"intrinsics": None}, "has no intrinsics; write resolution, intrinsics"),
        ({"resolution": None}, "has no resolution"),
        ({"T_color_depth": None}, r"depth of \[40, 30\] does not match cam0's 64x48; register it"),
        ({"T_color_depth": None, "resolution": None}, "there is no T_color_depth; write it, too"),
        ({"T_color_depth": [1.0] * 16}, "T_color_depth is not a rigid transform"),
        ({"T_color_depth": [1.0, float("nan")]}, "must be 16 finite numbers"),
        ({"T_color_depth": [1, 0, 0, 50, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "50 m from colour; write metres"),
        ({"registered_to": "cam0"}, "registered_to a camera or has a T_color_depth"),
        ({"distortion_coefficients": [0.1]}, "takes .* coefficients, got 1"),
    ],
)
def test_a_file_that_cannot_be_is_named(keys: dict[str, object], words: str, tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "mine")
    stated = {key: value for key, value in (KEYS | keys).items() if value is not None}
    (folder / "depth" / "sensor.yaml").write_text(text_of(stated).replace("nan", ".nan"))
    with pytest.raises(DataError, match=words) as caught:
        open_dataset(str(folder))
    assert "\n" not in str(caught.value) and "depth/sensor.yaml" in str(caught.value)


def test_depth_of_another_size_than_stated_is_named(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "mine")
    (folder / "depth" / "sensor.yaml").write_text(text_of(KEYS | {"resolution": [80, 60]}))
    with pytest.raises(DataError, match="is 40x30 but its calibration is for 80x60"):
        first_depth(str(folder))
    with pytest.raises(DataError, match="depth_camera must hold resolution"):
        parse_depth({"depth_camera": [1, 2]}, Path("sensor.yaml"))
