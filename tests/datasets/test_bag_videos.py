"""Video topics of bags: each frame is that of its message, damage costs frames, and what lacks is named."""

from __future__ import annotations

import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from needs import missing
from vislam.config import CalibrationConfig
from vislam.core.errors import DataError
from vislam.datasets import open_dataset
from vislam.datasets.inspect import inspect
from worlds import foxglove_writer
from worlds.bag_writer import ROS1, ROS2, K, Message, types_of, write_bag
from worlds.mini_recording import BEGIN_NS, FRAME_NS, picture

SIZE, FRAMES = (96, 64), 20
VIDEO, PACKET = "foxglove_msgs/msg/CompressedVideo", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
HEAD = "std_msgs/Header header\n"
LATER = HEAD + "int32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\nbool is_bigendian\nuint8[] data"
OLD = HEAD + "uint8[] data\nint32 img_width\nint32 img_height\nstring encoding\nuint64 pts\nuint8 flags"
for store, packet in ((ROS1, OLD), (ROS2, LATER)):
    text = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
    store.register(get_types_from_msg(text, VIDEO) | get_types_from_msg(packet, PACKET))
ENCODERS = {"h264": "libx264", "h265": "libx265", "vp9": "libvpx-vp9", "av1": "libsvtav1"}
OPTIONS = {"vp9": {"lag-in-frames": "0", "b": "0"}, "av1": {"preset": "12", "svtav1-params": "pred-struct=1:keyint=5"}}
VIEWS = [np.roll(cv2.GaussianBlur(picture(1, SIZE, color=True), (0, 0), 2.0), 2 * i, axis=1) for i in range(FRAMES)]


def encoded(codec: str) -> list[bytes]:
    """Views as a packet each, every fifth of which needs no other."""
    try:
        import av
    except ImportError:
        missing("av")
    encoder = av.CodecContext.create(ENCODERS[codec], "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = *SIZE, "yuv420p", Fraction(1, 20)
    encoder.gop_size, encoder.max_b_frames = 5, 0
    encoder.options = {"crf": "8"} | OPTIONS.get(codec, {"tune": "zerolatency"})
    frames = [av.VideoFrame.from_ndarray(view, format="bgr24") for view in VIEWS]
    return [bytes(packet) for frame in [*frames, None] for packet in encoder.encode(frame)]


def bag_of(
    folder: Path, packets: list[bytes], codec: str, kind: str = "mcap", carrier: str = VIDEO, with_imu: bool = False
) -> Path:
    """`kind` is a storage of ROS, or protobuf or json: Foxglove's own in MCAP."""
    types = types_of(kind)
    messages = [Message(BEGIN_NS, "/cam0/camera_info", types.info(BEGIN_NS, SIZE, K, "plumb_bob", []))]
    for i, packet in enumerate(packets):
        t_ns, data = BEGIN_NS + i * FRAME_NS, np.frombuffer(packet, np.uint8)
        header = types.header(t_ns, "cam0")
        if carrier == VIDEO:
            video = types.make(VIDEO, timestamp=header.stamp, frame_id="cam0", data=data, format=codec)
        elif carrier == PACKET:
            size = dict(zip(("img_width", "img_height") if types.ros1 else ("width", "height"), SIZE, strict=True))
            encoding = ENCODERS[codec] if types.ros1 else f"{codec};yuv420p;bgr8;bgr8"
            rest = {} if types.ros1 else {"is_bigendian": False}
            video = types.make(PACKET, header=header, data=data, encoding=encoding, pts=i, flags=0, **size, **rest)
        else:
            video = types.compressed(t_ns, packet, codec)
        messages.append(Message(t_ns, "/cam0/video", video))
    for t in range(BEGIN_NS, BEGIN_NS + 40 * with_imu, 2):
        messages.append(Message(t, "/imu", types.imu(t, [0.1, 0, 0, 0, 0, 9.8])))
    if kind in ("protobuf", "json"):
        return foxglove_writer.write(folder / "fox.mcap", messages, kind)
    return write_bag(folder, kind, messages)


def assert_shown(frame: Any) -> None:
    i = (frame.t_ns - BEGIN_NS) // FRAME_NS
    away = [float(np.abs(frame.color.astype(int) - view).mean()) for view in VIEWS]
    assert int(np.argmin(away)) == i and away[i] < 4.0, (i, away)
    assert np.array_equal(frame.images[0], cv2.cvtColor(frame.color, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize(
    ("codec", "kind", "carrier"),
    [
        ("h264", "mcap", VIDEO), ("h265", "db3", PACKET), ("vp9", "protobuf", VIDEO), ("av1", "json", VIDEO),
        ("av1", "bag", VIDEO), ("h264", "bag-lz4", PACKET), ("h265", "mcap-zstd", "CompressedImage"),
    ],
)  # fmt: skip
def test_frames_of_video_are_those_of_their_messages(codec: str, kind: str, carrier: str, tmp_path: Path) -> None:
    packets = encoded(codec)
    recording = open_dataset(str(bag_of(tmp_path, packets, codec, kind, carrier)))
    for begin in (0, 7):  # in the middle between two that need no other
        frames = list(recording.events(BEGIN_NS + begin * FRAME_NS))
        assert [frame.t_ns for frame in frames] == [BEGIN_NS + i * FRAME_NS for i in range(begin, FRAMES)]
        for frame in frames:
            assert_shown(frame)
    packets[6] = packets[6][: len(packets[6]) // 2] if codec == "h264" else b""  # others do not notice a cut
    (tmp_path / "late").mkdir()
    late = open_dataset(str(bag_of(tmp_path / "late", [b""] * 3 + packets[3:], codec, kind, carrier)))
    for frame in (frames := list(late.events())):
        assert_shown(frame)
    seen = [(frame.t_ns - BEGIN_NS) // FRAME_NS for frame in frames]
    assert seen == [5, *range(10, FRAMES)] and sum(late.problems.values()) == FRAMES - len(seen)


def test_without_av_topic_codec_and_extra_are_named_and_an_imu_is_not_hidden(
    tmp_path: Path, noise: CalibrationConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    path = bag_of(tmp_path, [bytes(9)] * 3, "h264", with_imu=True)
    with pytest.raises(
        DataError, match=r"/cam0/video is h264 video, which needs av: pip install '\.\[video\]'.*cam0=none runs"
    ):
        open_dataset(str(path), noise)
    assert open_dataset(f"{path},cam0=none", noise).rig.is_blind
    assert "needs av" in {topic.name: topic.taken_for for topic in inspect(str(path)).topics}["/cam0/video"]
