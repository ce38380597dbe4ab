"""MCAP files in Foxglove's schemas: the same recording as in ROS's; hostile definitions and messages are one line."""

from __future__ import annotations

import json
import random
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.cli import run_verb
from vislam.config import CalibrationConfig
from vislam.core import Problems
from vislam.core.errors import DataError, VislamError
from vislam.core.messages import Frame
from vislam.datasets import open_dataset, survey
from vislam.datasets.bags import foxglove
from vislam.datasets.bags.stored import DamagedError
from vislam.datasets.sensor_files import sensor_readings
from vislam.sensors import load_sensor_setup
from worlds import foxglove_writer as writer
from worlds.bag_writer import Message, from_asl, types_of, write_bag
from worlds.foxglove_writer import McapWriter, descriptor, encoded, lengthy, varint
from worlds.mini_recording import BEGIN_NS, FRAME_NS, HEIGHT, WIDTH, picture, write_asl

K = [50.0, 0.0, 31.5, 0.0, 51.0, 23.5, 0.0, 0.0, 1.0]
TYPES = types_of("mcap")
IMAGE = {
    "timestamp": writer.time(BEGIN_NS), "frame_id": "cam0", "width": WIDTH, "height": HEIGHT, "encoding": "mono8",
    "step": WIDTH, "data": picture(0).tobytes(),
}  # fmt: skip


@pytest.mark.parametrize("way", ["protobuf", "backwards", "json", "ros1"])
def test_the_recording_is_that_of_ros(way: str, tmp_path: Path, noise: CalibrationConfig) -> None:
    mav0 = write_asl(tmp_path / "asl", color=way == "protobuf")
    ros = open_dataset(str(write_bag(tmp_path, "mcap", from_asl(mav0, TYPES))), noise)
    if way == "ros1":
        path = writer.write_ros1(tmp_path / "one.mcap", from_asl(mav0, types_of("bag")))
    else:
        path = writer.write(tmp_path / "fox.mcap", from_asl(mav0, TYPES), way, backwards=way == "backwards")
    fox = open_dataset(str(path), noise)
    assert fox.rig.cameras == ros.rig.cameras
    assert np.array_equal(fox.rig.T_body_cams, ros.rig.T_body_cams)
    ours, theirs = list(fox.events()), list(ros.events())
    assert len(ours) == len(theirs) > 50
    for mine, other in zip(ours, theirs, strict=True):
        assert (type(mine), mine.t_ns) == (type(other), other.t_ns)
        if isinstance(mine, Frame):
            assert all(np.array_equal(a, b) for a, b in zip(mine.images, other.images, strict=True))
    assert dict(fox.problems) == {}


def test_doctor_names_the_schema_and_what_it_was_taken_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = writer.write(tmp_path / "fox.mcap", from_asl(write_asl(tmp_path / "asl"), TYPES), "protobuf")
    run_verb(["doctor", str(path), "--json"])
    told = {t["name"]: (t["type"], t["taken_for"]) for t in json.loads(capsys.readouterr().out)["topics"]}
    assert told["/cam0/image_raw"] == ("foxglove.RawImage", "cam0")
    assert told["/cam0/camera_info"] == ("foxglove.CameraCalibration", "calibration of cam0")
    assert told["/tf_static"] == ("foxglove.FrameTransforms", "places of sensors")


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_packed_images_depth_fixes_and_truth(encoding: str, tmp_path: Path) -> None:
    png = cv2.imencode(".png", picture(3))[1].tobytes()
    depth = np.full((HEIGHT, WIDTH), 1500, np.uint16)
    info = TYPES.info(BEGIN_NS, (WIDTH, HEIGHT), np.reshape(K, (3, 3)), "kannala_brandt", [0.1, 0.2, 0.3, 0.4])
    fix = TYPES.make(
        "sensor_msgs/msg/NavSatFix", header=TYPES.header(BEGIN_NS, "gnss"), latitude=47.0, longitude=8.0,
        altitude=400.0, status=TYPES.make("sensor_msgs/msg/NavSatStatus", status=0, service=1),
        position_covariance_type=2, position_covariance=np.diag([4.0, 4.0, 9.0]).ravel(),
    )  # fmt: skip
    messages = [Message(BEGIN_NS, "/cam0/camera_info", info), Message(BEGIN_NS, "/fix", fix)]
    for i in range(3):
        t_ns = BEGIN_NS + i * FRAME_NS
        messages.append(Message(t_ns, "/cam0/compressed", TYPES.compressed(t_ns, png, "png")))
        messages.append(Message(t_ns, "/cam0/depth_aligned", TYPES.image(t_ns, depth, "16UC1")))
        messages.append(Message(t_ns, "/pose", TYPES.pose_stamped(t_ns, (1.0, 2.0, 0.1 * i))))
    path = writer.write(tmp_path / "fox.mcap", messages, encoding)
    recording = open_dataset(f"bag:{path},truth=/pose")
    frames = [event for event in recording.events() if isinstance(event, Frame)]
    assert len(frames) == 3
    assert np.array_equal(frames[0].images[0], picture(3))
    assert frames[0].depth_m is not None and np.all(frames[0].depth_m == np.float32(1.5))
    assert recording.rig.cameras[0].distortion == "equidistant"
    truth = recording.truth()
    assert truth is not None and truth.positions_m[2].tolist() == pytest.approx([1.0, 2.0, 0.2])
    file = tmp_path / "sensors.toml"
    file.write_text(
        f'[sensors.gnss]\nkind = "position"\nfile = "{path}"\ntopic = "/fix"\ngnss = {{datum = [47.0, 8.0, 399.0]}}\n'
    )
    setup = load_sensor_setup(file)
    readings = list(sensor_readings("gnss", setup.sensors["gnss"], setup.files["gnss"], Problems()))
    assert [reading.t_ns for reading in readings] == [BEGIN_NS]
    assert readings[0].values == pytest.approx([0.0, 0.0, 1.0], abs=1e-3)


def of_image(tmp_path: Path, definition: bytes, data: bytes | None = None, schema: str = "foxglove.RawImage") -> Path:
    made = McapWriter()
    made.channel("/cam0/camera_info", "foxglove.CameraCalibration", "protobuf",
                 descriptor("foxglove.CameraCalibration"), "protobuf")  # fmt: skip
    made.channel("/cam0/image", schema, "protobuf", definition, "protobuf")
    info = {"timestamp": writer.time(BEGIN_NS), "frame_id": "cam0", "width": WIDTH, "height": HEIGHT, "K": K}
    made.message("/cam0/camera_info", BEGIN_NS, encoded("foxglove.CameraCalibration", info))
    made.message("/cam0/image", BEGIN_NS, encoded("foxglove.RawImage", IMAGE) if data is None else data)
    return made.write(tmp_path / "fox.mcap")


RAW, TIME = "foxglove.RawImage", "google.protobuf.Timestamp"
OTHER_NUMBER = {RAW: [(n, 11 if n == "step" else k, t, m) for n, k, t, m in writer.SCHEMAS[RAW]]}
OTHER_NAME = {RAW: [("stride" if n == "step" else n, k, t, m) for n, k, t, m in writer.SCHEMAS[RAW]]}
OTHER_TYPE = {RAW: [(n, k, 13 if n == "width" else t, m) for n, k, t, m in writer.SCHEMAS[RAW]]}
CIRCLE = {TIME: [("seconds", 1, ".foxglove.RawImage", False)]}


def nested(depth: int) -> bytes:
    data = b""
    for _ in range(depth):
        data = lengthy(4, lengthy(1, b"A") + lengthy(3, data))
    return lengthy(1, lengthy(2, b"foxglove") + data)


@pytest.mark.parametrize(
    ("definition", "words"),
    [
        (descriptor(RAW, OTHER_NUMBER), r"is not Foxglove's: foxglove.RawImage.step has another number or type"),
        (descriptor(RAW, OTHER_NAME), r"is not Foxglove's: number 5 of foxglove.RawImage is stride"),
        (descriptor(RAW, OTHER_TYPE), r"foxglove.RawImage.width has another number or type"),
        (descriptor(RAW, CIRCLE), r"google.protobuf.Timestamp.seconds has another number or type"),
        (b"", "no foxglove.RawImage in it"),
        (descriptor("foxglove.Pose"), "no foxglove.RawImage in it"),
        (nested(2000), "no foxglove.RawImage in it"),
        (b"\xff" * 100, "cannot be read: message with a number that does not end"),
        (b"\x0a" + varint(2**60) + b"abc", "cannot be read: message cut short"),
        (descriptor(RAW) + lengthy(9, bytes(2**18)), "more than any of Foxglove's"),
        (lengthy(1, lengthy(2, b"foxglove") + b"\x18\x01" * 20_000), "more than 10000 fields"),
    ],
)
def test_a_definition_that_is_not_foxgloves_is_refused(definition: bytes, words: str, tmp_path: Path) -> None:
    path = of_image(tmp_path, definition)
    told = {topic.name: topic.taken_for for topic in survey(str(path)).topics}
    assert "its definition of foxglove.RawImage" in told["/cam0/image"]
    with pytest.raises(DataError, match=f"cam0=/cam0/image: its definition of foxglove.RawImage.*{words}") as caught:
        open_dataset(f"bag:{path},cam0=/cam0/image")
    assert "\n" not in str(caught.value)


def test_what_foxglove_adds_to_a_definition_does_no_harm(tmp_path: Path) -> None:
    newer = {RAW: [*writer.SCHEMAS[RAW], ("exposure_s", 20, writer.DOUBLE, False)]}
    data = encoded(RAW, IMAGE) + varint(20 << 3 | 1) + bytes(8)
    assert open_dataset(str(of_image(tmp_path, descriptor(RAW, newer), data))).frame_count == 1


def test_schemas_that_are_not_read_are_said_to_be_none(tmp_path: Path) -> None:
    path = of_image(tmp_path, b"", schema="foxglove.PointCloud")
    told = {topic.name: topic.taken_for for topic in survey(str(path)).topics}
    assert told["/cam0/image"] == "a type that vislam does not read"


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("protobuf", b"\x0a" + varint(2**60)),
        ("protobuf", encoded(RAW, IMAGE)[:-5]),
        ("protobuf", b"\x0d\x00\x00\x00\x00"),  # a stamp that is a number
        ("protobuf", b"\x18\x01" * 20_000),
        ("protobuf", b"\x22" + varint(2**17) + bytes(2**17)),  # an encoding of 128 KiB
        ("json", b"[" * 100_000),
        ("json", b"{"),
        ("json", b"[]"),
        ("json", b'{"width": 1e999}'),
        ("json", b'{"width": "wide"}'),
        ("json", b'{"data": "no base64!"}'),
        ("json", b'{"timestamp": 17}'),
        ("json", b'{"timestamp": {"sec": ' + b"9" * 5000 + b"}}"),
        ("json", b" " * (2**24 + 1)),
    ],
)
def test_a_message_that_is_none_is_damaged(encoding: str, data: bytes) -> None:
    with pytest.raises(DamagedError):
        foxglove.decoded(RAW, encoding, data)
    foxglove.stamp(RAW, encoding, data)


def test_lists_without_end_take_no_memory() -> None:
    data = b"".join(lengthy(5, bytes(8 * 1000)) for _ in range(2000))
    alone = (varint(5 << 3 | 1) + bytes(8)) * 9000
    many = lengthy(1, b"") * 9000
    tracemalloc.start()
    try:
        for schema, message in (
            ("foxglove.CameraCalibration", data),
            ("foxglove.CameraCalibration", alone),
            ("foxglove.CameraCalibration", lengthy(5, bytes(2**24))),
            ("foxglove.FrameTransforms", many),
        ):
            with pytest.raises(DamagedError):
                foxglove.decoded(schema, "protobuf", message)
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()


def mutated(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(len(out))
        change = rng.randrange(4)
        if change == 0:
            out[at] = rng.randrange(256)
        elif change == 1:
            del out[at : at + rng.randint(1, 20)]
        elif change == 2:
            out[at:at] = rng.randbytes(rng.randint(1, 10))
        else:
            out[at:at] = out[max(0, at - 30) : at]
        if not out:
            return b"\0"
    return bytes(out)


SMALL: dict[str, Callable[[], dict]] = {
    RAW: lambda: IMAGE | {"data": bytes(30)},
    "foxglove.CompressedImage": lambda: {"timestamp": writer.time(BEGIN_NS), "data": b"12345", "format": "jpeg"},
    "foxglove.CameraCalibration": lambda: {"timestamp": writer.time(BEGIN_NS), "width": 4, "D": [0.1] * 5, "K": K},
    "foxglove.LocationFix": lambda: {"latitude": 1.0, "position_covariance": [1.0] * 9, "timestamp": writer.time(1)},
    "foxglove.PoseInFrame": lambda: {"pose": {"position": {"x": 1.0}, "orientation": {"w": 1.0}}},
    "foxglove.FrameTransforms": lambda: {
        "transforms": [{"parent_frame_id": "a", "child_frame_id": "b", "rotation": {"w": 1.0}}] * 3
    },
}


@given(st.sampled_from(sorted(SMALL)), st.sampled_from(["protobuf", "json"]), st.integers(0, 2**32 - 1))
@settings(max_examples=400)
def test_fuzzed_messages_are_read_or_damaged(schema: str, encoding: str, seed: int) -> None:
    values, rng = SMALL[schema](), random.Random(seed)
    data = mutated(encoded(schema, values) if encoding == "protobuf" else writer.as_json(schema, values), rng)
    foxglove.stamp(schema, encoding, data)
    try:
        foxglove.decoded(schema, encoding, data)
    except DamagedError as error:
        assert "\n" not in str(error) and len(str(error)) < 200


@given(st.sampled_from(sorted(SMALL)), st.integers(0, 2**32 - 1))
@settings(max_examples=200)
def test_fuzzed_definitions_are_taken_or_refused(schema: str, seed: int) -> None:
    assert foxglove.why_refused(schema, "protobuf", descriptor(schema)) == ""
    why = foxglove.why_refused(schema, "protobuf", mutated(descriptor(schema), random.Random(seed)))
    assert "\n" not in why and len(why) < 250


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_fuzzed_files_are_read_or_refused_in_one_line(encoding: str, tmp_path: Path) -> None:
    path = writer.write(tmp_path / "fox.mcap", from_asl(write_asl(tmp_path / "asl", frames=3), TYPES), encoding)
    whole, rng = path.read_bytes(), random.Random(20260101)
    for _ in range(60):
        path.write_bytes(mutated(whole, rng))
        try:
            recording = open_dataset(f"bag:{path},imu=none")
            for _ in recording.events():
                pass
        except VislamError as error:
            assert "\n" not in str(error)


def test_bytes_are_understood_as_protobuf_defines_them() -> None:
    """A message spelt out by the encoding's definition: zeros left out, a field that no schema has."""
    stamp, size, cam0 = "0a04 0801 1007", "15 02000000 1d 01000000", "3a04 63616d30"
    data = bytes.fromhex(f"{stamp} {size} 2205 6d6f6e6f38 2d 02000000 3202 0aff {cam0} f801 ac02")
    message = foxglove.decoded(RAW, "protobuf", data)
    assert (message.width, message.height, message.step, message.encoding) == (2, 1, 2, "mono8")
    assert message.data.tolist() == [10, 255] and message.header.frame_id == "cam0"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 7)
    assert foxglove.decoded(RAW, "protobuf", b"").width == 0
