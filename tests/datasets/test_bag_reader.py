"""Bags as recordings: every storage gives what the folder gives that it was made of, and what it says is understood."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from vislam.cli import run_verb
from vislam.config import CalibrationConfig, FrontEndConfig
from vislam.core import Problems
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.datasets import open_dataset, survey
from vislam.datasets.bags.bag import Bag
from vislam.datasets.inspect import inspect
from vislam.frontend import mode_for
from worlds.bag_writer import KINDS, K, Message, from_asl, images_of, types_of, write_bag
from worlds.mini_recording import BEGIN_NS, FRAME_NS, HEIGHT, IMU_YAML, WIDTH, picture, write_asl

SIZE = (WIDTH, HEIGHT)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("color", [False, True])
def test_a_bag_gives_what_its_folder_gives(kind: str, color: bool, tmp_path: Path, noise: CalibrationConfig) -> None:
    mav0 = write_asl(tmp_path / "asl", color=color)
    path = write_bag(tmp_path, kind, from_asl(mav0, types_of(kind)))
    folder, bag = open_dataset(f"euroc:{mav0}"), open_dataset(str(path), noise)
    assert bag.rig.cameras == folder.rig.cameras
    for ours, theirs in zip(bag.rig.T_body_cams, folder.rig.T_body_cams, strict=True):
        assert np.allclose(ours, theirs, rtol=0.0, atol=1e-12)
    assert bag.imu_noise == folder.imu_noise
    ours, theirs = list(bag.events()), list(folder.events())
    assert len(ours) == len(theirs) > 50
    for mine, other in zip(ours, theirs, strict=True):
        assert type(mine) is type(other)
        assert mine.t_ns == other.t_ns
        if isinstance(mine, Frame):
            assert all(np.array_equal(a, b) for a, b in zip(mine.images, other.images, strict=True))
            assert color == (mine.color is not None)
            assert not color or np.array_equal(mine.color, other.color)
            assert all(image.flags.writeable and image.flags.c_contiguous for image in mine.images)
        else:
            assert isinstance(mine, ImuSample)
            assert mine.gyro_rad_s.tolist() == other.gyro_rad_s.tolist()
            assert mine.accel_m_s2.tolist() == other.accel_m_s2.tolist()
    assert dict(bag.problems) == {}
    assert [event.t_ns for event in bag.events()] == [event.t_ns for event in ours]


def test_further_cameras_of_a_bag_are_those_of_its_folder(tmp_path: Path, noise: CalibrationConfig) -> None:
    mav0 = write_asl(tmp_path / "asl", rear=True)
    path = write_bag(tmp_path, "mcap", from_asl(mav0, types_of("mcap")))
    folder, bag = open_dataset(f"euroc:{mav0}"), open_dataset(f"bag:{path},further=/cam2/image_raw", noise)
    assert bag.rig.cameras == folder.rig.cameras and bag.rig.further == (2,)
    assert np.allclose(bag.rig.T_body_cams[2], folder.rig.T_body_cams[2], rtol=0.0, atol=1e-12)
    pairs = zip(bag.events(), folder.events(), strict=True)
    images = [(a.images[2], b.images[2]) for a, b in pairs if isinstance(a, Frame) and isinstance(b, Frame)]
    assert len(images) == 6 and all(np.array_equal(a, b) for a, b in images)


def test_of_several_imus_in_a_file_the_one_of_the_topic_is_taken(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", from_asl(write_asl(tmp_path / "asl"), types_of("mcap")))
    block = IMU_YAML.replace("\n", "\n  ").rstrip()
    other = block.replace("1.7e-04", "9e-3") + "\n  rostopic: /other\n"
    (tmp_path / "imu.yaml").write_text(f"imu0:\n  {other}imu1:\n  {block}\n  rostopic: /imu0\n")
    recording = open_dataset(str(path), CalibrationConfig(imu_noise=str(tmp_path / "imu.yaml")))
    assert recording.imu_noise.gyroscope_noise_density == 1.7e-4


@pytest.mark.parametrize("kind", KINDS)
def test_messages_are_those_that_rosbags_reads(kind: str, tmp_path: Path) -> None:
    mav0 = write_asl(tmp_path / "asl", frames=4)
    path = write_bag(tmp_path, kind, from_asl(mav0, types_of(kind)))
    with AnyReader([path]) as reader:
        theirs = sorted((c.topic, c.msgtype, t, bytes(data)) for c, t, data in reader.messages())
    bag, problems = Bag(path), Problems()
    ours = sorted((f.topic.name, f.topic.type, f.log_ns, bag.read(f.place)) for f in bag.scan(problems))
    bag.close()
    assert problems == {}
    assert ours == theirs


def test_topics_are_guessed_shown_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mav0 = write_asl(tmp_path / "asl")
    path = write_bag(tmp_path, "mcap", from_asl(mav0, types_of("mcap")))
    file = next(path.glob("*.mcap"))
    assert run_verb(["doctor", str(file), "--json"]) in (0, 3)
    told = {t["name"]: t for t in json.loads(capsys.readouterr().out)["topics"]}
    assert told["/cam0/image_raw"]["taken_for"] == "cam0"
    assert told["/cam0/image_raw"]["rate_hz"] == pytest.approx(20.0)
    assert told["/imu0"]["count"] == 51
    assert told["/tf_static"]["taken_for"] == "places of sensors"
    run_verb(["doctor", str(file)])
    assert "/cam1/image_raw" in capsys.readouterr().out
    one = survey(f"bag:{path},cam0=/cam1/image_raw,cam1=none,imu=none,info0=/cam0/camera_info")
    assert [camera.name for camera in one.cameras] == ["cam0"]
    assert {t.name: t.taken_for for t in one.topics}["/cam1/image_raw"] == "cam0"
    assert not one.has_imu
    assert one.lacking == {}
    bare = survey(f"{path},imu=none")
    assert not bare.has_imu
    run_verb(["doctor", f"euroc:{mav0}", "--json"])
    assert "topics" not in json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ("imu=/imu1", DataError, "imu=/imu1: no such topic; of Imu there are /imu0"),
        ("cam0=/imu0", DataError, "CompressedVideo or FFMPEGPacket is asked, it is sensor_msgs/msg/Imu"),
        ("further=/cam0/image_raw", DataError, "/cam0/image_raw is named as two cameras"),
        ("camera=/x", UsageError, "no option 'camera'; there are: cam0"),
        ("stamps=wall", UsageError, "option stamps"),
        ("imu", DataError, "no recording"),
        ("imu=none,x", UsageError, "'x' in .* is no option"),
    ],
)
def test_options_that_do_not_fit_are_named(options: str, error: type[Exception], words: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", from_asl(write_asl(tmp_path / "asl"), types_of("mcap")))
    if words == "no recording":
        words = "does not exist"
    with pytest.raises(error, match=words):
        open_dataset(f"bag:{path},{options}")
    if error is DataError and "exist" not in words:
        assert words in " ".join(finding.what for finding in inspect(f"bag:{path},{options}").findings)


def test_only_bags_take_options(tmp_path: Path) -> None:
    mav0 = write_asl(tmp_path / "asl")
    with pytest.raises(UsageError, match="only a bag or a film takes options"):
        open_dataset(f"euroc:{mav0},imu=none")


def test_what_a_bag_lacks_is_named_with_the_option_that_gives_it(tmp_path: Path, noise: CalibrationConfig) -> None:
    messages = list(from_asl(write_asl(tmp_path / "asl"), types_of("mcap")))
    path = write_bag(tmp_path, "mcap", [m for m in messages if m.topic != "/tf_static"])
    with pytest.raises(DataError, match=r"the noise of its IMU \(/imu0\); give --calibration.imu-noise"):
        open_dataset(str(path))
    with pytest.raises(DataError, match=r"no transform from cam0 to imu .* --calibration.camera FILE with T_cam_imu"):
        open_dataset(str(path), noise)
    bare = write_bag(tmp_path, "mcap", [m for m in messages if "info" not in m.topic], name="bare")
    with pytest.raises(DataError, match="/cam0/image_raw: no CameraInfo beside its images"):
        open_dataset(str(bare), noise)
    chain = tmp_path / "chain.yaml"
    entry = (
        "  T_cam_imu:\n  - [1, 0, 0, {x}]\n  - [0, 1, 0, 0]\n  - [0, 0, 1, 0]\n  - [0, 0, 0, 1]\n"
        "  camera_model: pinhole\n"
        f"  intrinsics: [50, 50, 32, 24]\n  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n"
        f"  resolution: [{WIDTH}, {HEIGHT}]\n"
    )
    chain.write_text("cam0:\n" + entry.format(x=0) + "cam1:\n" + entry.format(x=-0.1))
    for incomplete in (path, bare):
        recording = open_dataset(str(incomplete), CalibrationConfig(imu_noise=noise.imu_noise, camera=str(chain)))
        assert recording.rig.T_body_cams[1][0, 3] == pytest.approx(0.1)
        assert recording.rig.cameras[0].fx == 50.0
    findings = inspect(str(bare)).findings
    assert sum(f.severity == "warning" and "--calibration" in f.what for f in findings) == 2


def test_the_noise_may_stand_beside_the_bag(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", from_asl(write_asl(tmp_path / "asl"), types_of("mcap")))
    (tmp_path / "drive.imu.yaml").write_text(IMU_YAML)
    noise = open_dataset(str(path)).imu_noise
    assert noise is not None
    assert noise.rate_hz == 200.0
    file = next(path.glob("*.mcap"))
    (path / f"{file.stem}.imu.yaml").write_text("rate_hz: 200\n")
    with pytest.raises(DataError, match=r"imu.yaml: no 'gyroscope_noise_density'"):
        open_dataset(str(file))


def test_the_extra_is_named_where_it_is_missing(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", images_of(types_of("mcap")))
    script = (
        "import sys; sys.modules['rosbags'] = None\nfrom vislam.datasets import open_dataset; open_dataset(sys.argv[1])"
    )
    done = subprocess.run([sys.executable, "-c", script, path], capture_output=True, text=True, check=False)
    assert "DataError: bags need rosbags" in done.stderr
    assert "pip install '.[bags]'" in done.stderr


def pixels_of(shape: tuple[int, ...], dtype: type, top: int) -> np.ndarray:
    return np.random.default_rng(3).integers(0, top, shape).astype(dtype)


GREY, COLOR = pixels_of((HEIGHT, WIDTH), np.uint8, 256), pixels_of((HEIGHT, WIDTH, 3), np.uint8, 256)
FOUR, DEEP = pixels_of((HEIGHT, WIDTH, 4), np.uint8, 256), pixels_of((HEIGHT, WIDTH), np.uint16, 65536)


def bayer(pattern: str) -> np.ndarray:
    """A colour that is the same all over, seen through a pattern of filters."""
    out = np.zeros((HEIGHT, WIDTH), np.uint8)
    values = {"r": 200, "g": 100, "b": 50}
    for k, letter in enumerate(pattern):
        out[k // 2 :: 2, k % 2 :: 2] = values[letter]
    return out


@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize("pad", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels", "bgr"),
    [
        ("mono8", GREY, None),
        ("8UC1", GREY, None),
        ("mono16", DEEP, None),
        ("bgr8", COLOR, COLOR),
        ("rgb8", COLOR, COLOR[..., ::-1]),
        ("bgra8", FOUR, FOUR[..., :3]),
        ("rgba8", FOUR, FOUR[..., 2::-1]),
        ("bgr16", COLOR.astype(np.uint16) * 256 + 77, COLOR),
        ("rgb16", COLOR.astype(np.uint16) * 256 + 77, COLOR[..., ::-1]),
        ("bayer_rggb16", bayer("rggb").astype(np.uint16) * 256 + 9, np.full((HEIGHT, WIDTH, 3), (50, 100, 200))),
        *(
            (f"bayer_{p}8", bayer(p), np.full((HEIGHT, WIDTH, 3), (50, 100, 200)))
            for p in ("rggb", "bggr", "gbrg", "grbg")
        ),
    ],
)
def test_images_of_every_encoding(
    kind: str, pad: int, encoding: str, pixels: np.ndarray, bgr: np.ndarray | None, tmp_path: Path
) -> None:
    types = types_of(kind)
    messages = [Message(1_000, "/cam0/camera_info", types.info(1_000, SIZE, K, "plumb_bob", []))]
    for big in (False, True):
        messages.append(
            Message(2_000 + big, "/cam0/image_raw", types.image(2_000 + big, pixels, encoding, pad=pad, big=big))
        )
    frames = [e for e in open_dataset(str(write_bag(tmp_path, kind, messages))).events() if isinstance(e, Frame)]
    assert len(frames) == 2
    for frame in frames:
        if bgr is None:
            assert frame.color is None
            assert np.array_equal(frame.images[0], pixels if pixels.dtype == np.uint8 else pixels >> 8)
        else:
            assert frame.color is not None
            inner = (slice(2, -2), slice(2, -2))  # a pattern has no neighbours at the edge
            assert np.array_equal(frame.color[inner], np.asarray(bgr, np.uint8)[inner])
            assert np.array_equal(frame.images[0], cv2.cvtColor(frame.color, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize(("encoding", "grey_at"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_images_of_webcams(encoding: str, grey_at: int, tmp_path: Path) -> None:
    types = types_of("mcap")
    pixels = np.full((HEIGHT, WIDTH, 2), 128, np.uint8)
    ramp = np.linspace(16, 235, WIDTH)
    pixels[..., grey_at] = ramp
    messages = images_of(types, 1)
    messages[1] = Message(BEGIN_NS, "/cam0/image_raw", types.image(BEGIN_NS, pixels, encoding))
    (frame,) = open_dataset(str(write_bag(tmp_path, "mcap", messages))).events()
    assert np.allclose(frame.images[0], (ramp.astype(np.uint8) - 16.0) * 255.0 / 219.0, atol=1.5)


@pytest.mark.parametrize("format_", ["jpeg", "png"])
def test_compressed_images(format_: str, tmp_path: Path) -> None:
    types = types_of("mcap")
    data = cv2.imencode(f".{format_}", COLOR)[1].tobytes()
    messages = [Message(1_000, "/front/camera_info", types.info(1_000, SIZE, K, "plumb_bob", []))]
    messages += [Message(t, "/front/image_raw/compressed", types.compressed(t, data, f"bgr8; {format_} compressed"))
                 for t in (1_000, 2_000)]  # fmt: skip
    messages.append(Message(3_000, "/front/image_raw/compressed", types.compressed(3_000, data[:-40], format_)))
    recording = open_dataset(str(write_bag(tmp_path, "mcap", messages)))
    frames = list(recording.events())
    assert len(frames) == 2
    assert np.array_equal(frames[0].color, cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    assert recording.problems == {"unreadable image (first: front/image_raw/compressed/3000)": 1}


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "compressed"])
def test_depth_in_millimetres_and_metres(encoding: str, big: bool, tmp_path: Path) -> None:
    types = types_of("mcap")
    truth = np.linspace(0.5, 4.0, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH).round(3)
    truth[0, :3] = 0.0
    messages = [Message(1_000, "/rgb/camera_info", types.info(1_000, SIZE, K, "plumb_bob", []))]
    messages.append(Message(1_000, "/rgb/image_raw", types.image(1_000, COLOR, "rgb8")))
    if encoding == "32FC1":
        meters = truth.astype(np.float32)
        meters[0, :3] = np.nan, np.inf, -1.0
        depth = types.image(1_010, meters, encoding, big=big)
    elif encoding == "16UC1":
        depth = types.image(1_010, np.round(truth * 1e3).astype(np.uint16), encoding, big=big)
    else:
        png = cv2.imencode(".png", np.round(truth * 1e3).astype(np.uint16))[1].tobytes()
        depth = types.compressed(1_010, b"\0" * 12 + png, "16UC1; compressedDepth")
    messages.append(Message(1_010, "/depth/image", depth))
    recording = open_dataset(str(write_bag(tmp_path, "mcap", messages)))
    (frame,) = recording.events()
    assert recording.rig.has_depth
    assert np.allclose(frame.depth_m, truth, atol=1e-6)


@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize(
    ("model", "coefficients", "is_"),
    [
        ("plumb_bob", [-0.1, 0.01, 1e-4, 2e-4, 0.0], ("radtan", (-0.1, 0.01, 1e-4, 2e-4))),
        ("plumb_bob", [-0.1, 0.01, 1e-4, 2e-4, 0.3], ("radtan", (-0.1, 0.01, 1e-4, 2e-4, 0.3))),
        ("plumb_bob", [], ("none", ())),
        ("rational_polynomial", [-0.1, 0.01, 1e-4, 2e-4, 0.0, 0.0, 0.0, 0.0], ("radtan", (-0.1, 0.01, 1e-4, 2e-4))),
        ("equidistant", [0.1, 0.2, 0.3, 0.4], ("equidistant", (0.1, 0.2, 0.3, 0.4))),
        ("fisheye", [0.1, 0.2, 0.3, 0.4], ("equidistant", (0.1, 0.2, 0.3, 0.4))),
        (
            "rational_polynomial",
            [-0.1, 0.01, 1e-4, 2e-4, 0.0, 0.5, 0.1, 0.2],
            ("rational", (-0.1, 0.01, 1e-4, 2e-4, 0.0, 0.5, 0.1, 0.2)),
        ),
        (
            "rational_polynomial",
            [-0.1, 0.01, 1e-4, 2e-4, 0.0, 0.5],
            ("rational", (-0.1, 0.01, 1e-4, 2e-4, 0.0, 0.5, 0.0, 0.0)),
        ),
        ("rational_polynomial", [0.1] * 12, "'rational_polynomial' with 12 coefficients is not supported"),
        ("plumb_bob", [0.1] * 8, "'plumb_bob' with 8 coefficients is not supported; use plumb_bob, rational_poly"),
        ("kannala_brandt", [0.1, 0.2, 0.3, 0.4], ("equidistant", (0.1, 0.2, 0.3, 0.4))),
        ("thin_prism", [0.1] * 12, "'thin_prism' with 12 coefficients is not supported"),
        ("plumb_bob", [float("nan")] * 5, "finite"),
    ],
)
def test_lenses(kind: str, model: str, coefficients: list[float], is_: object, tmp_path: Path) -> None:
    types = types_of(kind)
    messages = images_of(types)
    messages[0] = Message(BEGIN_NS, "/cam0/camera_info", types.info(BEGIN_NS, SIZE, K, model, coefficients))
    path = write_bag(tmp_path, kind, messages)
    if isinstance(is_, str):
        with pytest.raises(DataError, match=is_):
            open_dataset(str(path))
        return
    camera = open_dataset(str(path)).rig.cameras[0]
    assert (camera.distortion, camera.coefficients) == is_


def test_a_calibration_of_zeros_or_of_another_size_is_named(tmp_path: Path) -> None:
    types = types_of("mcap")
    for name, size, matrix, words in (("a", SIZE, K * 0, "not calibrated"), ("b", (640, 480), K, "is for 640x480")):
        messages = images_of(types)
        messages[0] = Message(BEGIN_NS, "/cam0/camera_info", types.info(BEGIN_NS, size, matrix, "plumb_bob", []))
        with pytest.raises(DataError, match=f"{words}.*--calibration.camera"):
            open_dataset(str(write_bag(tmp_path, "mcap", messages, name=name)))


def test_a_pair_without_transforms_is_placed_by_its_rectification(tmp_path: Path) -> None:
    types = types_of("mcap")
    R = [cv2.Rodrigues(np.array(v))[0] for v in ([0.01, 0.02, -0.01], [-0.02, 0.01, 0.03])]
    P = [np.column_stack([K, [x, 0.0, 0.0]]) for x in (0.0, -50.0 * 0.12)]
    messages = []
    for k, side in enumerate(("left", "right")):
        info = types.info(1_000, SIZE, K, "plumb_bob", [], side, R[k], P[k])
        messages.append(Message(1_000, f"/{side}/camera_info", info))
        messages.append(Message(1_000, f"/{side}/image_raw", types.image(1_000, GREY, "mono8", side)))
    rig = open_dataset(str(write_bag(tmp_path, "mcap", messages))).rig
    point = np.array([0.3, -0.2, 4.0])  # in cam0
    T_cam1_cam0 = np.linalg.inv(rig.T_body_cams[1]) @ rig.T_body_cams[0]
    right = R[1] @ (T_cam1_cam0[:3, :3] @ point + T_cam1_cam0[:3, 3])
    assert np.allclose(right, R[0] @ point - [0.12, 0.0, 0.0], atol=1e-12)


def test_places_are_chained_through_frames_that_keep_still(tmp_path: Path, noise: CalibrationConfig) -> None:
    types = types_of("bag")
    T1, T2, T3 = np.eye(4), np.eye(4), np.eye(4)
    T1[:3, 3], T2[:3, 3] = [0.1, 0.0, 0.2], [0.0, 0.0, -0.1]
    T1[:3, :3] = cv2.Rodrigues(np.array([0.1, -0.4, 0.3]))[0]
    T3[0, 3] = 5.0
    static = types.transforms(0, [("base", "imu", T1), ("base", "head", T2)])
    optical = types.transforms(0, [("head", "cam0", T1), ("odom", "base", T3), ("cam0", "head2", T1)])
    messages = [Message(1_000, "/tf", optical), Message(1_000, "/tf_static", static), *images_of(types)]
    T3[0, 3] = 6.0
    messages += [Message(2_000, "/tf", types.transforms(0, [("odom", "base", T3)]))]
    messages += [Message(BEGIN_NS + i * 5_000_000, "/imu", types.imu(BEGIN_NS + i * 5_000_000, [0, 0, 0, 0, 0, 9.8]))
                 for i in range(40)]  # fmt: skip
    recording = open_dataset(str(write_bag(tmp_path, "bag", messages)), noise)
    assert np.allclose(recording.rig.T_body_cams[0], np.linalg.inv(T1) @ T2 @ T1, atol=1e-12)


def test_the_field_is_in_microtesla_and_in_the_axes_of_the_body(tmp_path: Path, noise: CalibrationConfig) -> None:
    types = types_of("mcap")
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    messages = images_of(types)
    messages.append(Message(0, "/tf_static", types.transforms(0, [("imu", "mag", T), ("imu", "cam0", np.eye(4))])))
    for i in range(40):
        t_ns = BEGIN_NS + i * 5_000_000
        messages.append(Message(t_ns, "/imu", types.imu(t_ns, [0, 0, 0, 0, 0, 9.8])))
        messages.append(Message(t_ns, "/mag", types.field(t_ns, [20e-6, 0.0, -40e-6], "mag")))
    events = list(open_dataset(str(write_bag(tmp_path, "mcap", messages)), noise).events())
    fields = [event.field_ut for event in events if isinstance(event, MagSample)]
    assert len(fields) == 40
    assert np.allclose(fields[0], [0.0, 20.0, -40.0])


@pytest.mark.parametrize("options", ["", ",imu=/accel", ",imu=/gyro"])
def test_rates_and_forces_on_two_topics_are_joined_in_the_axes_of_the_rates(
    options: str, tmp_path: Path, noise: CalibrationConfig, caplog: pytest.LogCaptureFixture
) -> None:
    types = types_of("mcap")
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    static = types.transforms(0, [("gyro", "accel", T), ("gyro", "cam0", np.eye(4))])
    messages = [*images_of(types), Message(0, "/tf_static", static)]
    for i in range(41):
        t_ns = BEGIN_NS + i * 5_000_000
        messages.append(Message(t_ns, "/gyro", types.imu(t_ns, [0.1 * i, 0.2, 0.3, 0, 0, 0], "gyro")))
    for i in range(11):
        t_ns = BEGIN_NS + i * 20_000_000
        messages.append(Message(t_ns, "/accel", types.imu(t_ns, [0, 0, 0, 4.0 * i, 1.0, 9.8], "accel")))
    path = write_bag(tmp_path, "mcap", messages)
    samples = [e for e in open_dataset(f"bag:{path}{options}", noise).events() if isinstance(e, ImuSample)]
    assert [s.t_ns for s in samples] == [BEGIN_NS + i * 5_000_000 for i in range(41)]
    assert np.allclose([s.gyro_rad_s for s in samples], [[0.1 * i, 0.2, 0.3] for i in range(41)])
    assert np.allclose([s.accel_m_s2 for s in samples], [[-1.0, i, 9.8] for i in range(41)])
    assert "rates of /gyro with the forces of /accel" in caplog.text
    roles = {topic.name: topic.taken_for for topic in survey(f"bag:{path}{options}").topics}
    assert (roles["/gyro"], roles["/accel"]) == ("rates of imu0", "forces of imu0")


def test_a_gyroscope_alone_is_no_imu(tmp_path: Path, noise: CalibrationConfig) -> None:
    types = types_of("mcap")
    rates = [Message(t, "/gyro", types.imu(t, [0.1, 0, 0, 0, 0, 0], "cam0")) for t in range(BEGIN_NS, BEGIN_NS + 40, 2)]
    path = write_bag(tmp_path, "mcap", [*images_of(types), *rates])
    with pytest.raises(DataError, match=r"forces are all zero.*imu=none"):
        open_dataset(str(path), noise)


def test_a_bag_without_images_is_what_it_is(tmp_path: Path) -> None:
    types = types_of("mcap")
    poses = [Message(BEGIN_NS + i, "/vicon", types.pose_stamped(BEGIN_NS + i, [i, 0, 1])) for i in range(5)]
    path = write_bag(tmp_path, "mcap", poses)
    report = inspect(str(path))
    errors = [f.what for f in report.findings if f.severity == "error"]
    assert len(errors) == 1 and not any("vision" in finding.what for finding in report.findings)
    assert [topic.taken_for for topic in report.topics] == ["not used; poses, for truth=/vicon"]
    assert f"there are /vicon; its poses can be evaluated: vislam eval {path} --topic /vicon" in errors[0]
    with pytest.raises(DataError, match="no camera images that can be read; there are /vicon"):
        open_dataset(str(path))


def test_cameras_that_transforms_put_at_one_place_are_named(tmp_path: Path) -> None:
    types = types_of("mcap")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array([0.1, -0.4, 0.3]))[0], [0.3, -0.2, 1.7]
    messages = [Message(0, "/tf_static", types.transforms(0, [("base", "cam0", T), ("base", "cam1", T)]))]
    for i in range(3):
        t_ns = BEGIN_NS + i * FRAME_NS
        for k in range(2):
            messages.append(Message(t_ns, f"/cam{k}/image_raw", types.image(t_ns, picture(i), "mono8", f"cam{k}")))
    infos = [types.info(BEGIN_NS, SIZE, K, "plumb_bob", [0.0] * 5, f"cam{k}") for k in range(2)]
    messages += [Message(BEGIN_NS, f"/cam{k}/camera_info", info) for k, info in enumerate(infos)]
    path = write_bag(tmp_path, "mcap", messages)
    with pytest.raises(DataError, match=r"cam0 and cam1 sit at the same place.*/tf_static"):
        mode_for(FrontEndConfig(), open_dataset(str(path)).rig)
    assert any("same place" in f.what and f.severity == "error" for f in inspect(str(path)).findings)


def test_truth_is_read_only_where_it_is_told(tmp_path: Path) -> None:
    types = types_of("mcap")
    messages = images_of(types)
    messages += [Message(BEGIN_NS + i * FRAME_NS, "/vicon", types.pose_stamped(BEGIN_NS + i * FRAME_NS, [i, 0, 1]))
                 for i in range(5)]  # fmt: skip
    path = write_bag(tmp_path, "mcap", messages)
    assert open_dataset(str(path)).truth() is None
    truth = open_dataset(f"bag:{path},truth=/vicon").truth()
    assert truth is not None
    assert truth.T_world_body[:, 0, 3].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_stamps_are_the_headers_and_where_they_are_zero_the_recorders(tmp_path: Path) -> None:
    types = types_of("mcap")
    messages = images_of(types, 4)
    late = [Message(m.t_ns + 7_000, m.topic, m.value) for m in messages]
    path = write_bag(tmp_path, "mcap", late, name="late")
    assert [f.t_ns for f in open_dataset(str(path)).events()] == [BEGIN_NS + i * FRAME_NS for i in range(4)]
    log = [f.t_ns for f in open_dataset(f"bag:{path},stamps=log").events()]
    assert log == [BEGIN_NS + i * FRAME_NS + 7_000 for i in range(4)]
    for message in messages:
        message.value.header.stamp = types.make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    recording = open_dataset(str(write_bag(tmp_path, "mcap", messages, name="zero")))
    assert [f.t_ns for f in recording.events()] == [BEGIN_NS + i * FRAME_NS for i in range(4)]
    assert recording.problems["/cam0/image_raw: without a stamp, the recorder's time is taken"] == 4


@pytest.mark.parametrize(
    ("values", "words"),
    [([0.01, 0, 0, 0, 0, 1.0], "unit seems to be g"), ([60.0, 3.0, 0, 0, 0, 9.8], "unit seems to be deg/s")],
)
def test_units_that_cannot_be_are_refused(
    values: list[float], words: str, tmp_path: Path, noise: CalibrationConfig
) -> None:
    types = types_of("mcap")
    messages = images_of(types)
    messages += [Message(BEGIN_NS + i * 5_000_000, "/imu", types.imu(BEGIN_NS + i * 5_000_000, values, "cam0"))
                 for i in range(400)]  # fmt: skip
    path = write_bag(tmp_path, "mcap", messages)
    with pytest.raises(DataError, match=words):
        open_dataset(str(path), noise)
    assert open_dataset(f"bag:{path},imu=none").imu_noise is None


@pytest.mark.parametrize("is_packed", [False, True])
def test_frozen_and_dark_images_of_a_bag_are_named_as_those_of_a_folder(tmp_path: Path, is_packed: bool) -> None:
    types = types_of("mcap")
    topic = "/cam0/image_raw/compressed" if is_packed else "/cam0/image_raw"
    messages = [Message(BEGIN_NS, "/cam0/camera_info", types.info(BEGIN_NS, (WIDTH, HEIGHT), K, "plumb_bob", []))]
    for i in range(60):
        t_ns = BEGIN_NS + i * FRAME_NS
        image = np.full((HEIGHT, WIDTH), i % 2, np.uint8) if 40 <= i < 50 else picture(9 if 10 <= i < 20 else i)
        data = cv2.imencode(".png", image)[1].tobytes()
        packed = types.compressed(t_ns, data, "png") if is_packed else types.image(t_ns, image, "mono8")
        messages.append(Message(t_ns, topic, packed))
    result = inspect(str(write_bag(tmp_path, "mcap", messages)))
    said = [finding.what for finding in result.findings if finding.severity == "warning"]
    assert any(what.startswith("cam0: images that equal the one before from 0.50 to 0.95 s (10)") for what in said), (
        said
    )
    assert any(what.startswith("cam0: dark or blank images from 2.00 to 2.50 s (10)") for what in said), said
