"""Bags that are cut off, damaged or made to hurt: what can be read is read, all else is counted or one line."""

from __future__ import annotations

import bz2
import random
import resource
import sqlite3
import struct
import time
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vislam.config import CalibrationConfig
from vislam.core import Problems
from vislam.core.errors import DataError, VislamError
from vislam.core.messages import Frame
from vislam.datasets import open_dataset
from vislam.datasets.bags.bag import Bag
from vislam.datasets.bags.chunks import MOST_CHUNK_BYTES, FileBytes
from vislam.datasets.inspect import inspect
from worlds.bag_writer import Message, images_of, types_of, write_bag
from worlds.mini_recording import BEGIN_NS, FRAME_NS, picture

STORAGES = ("bag", "bag-bz2", "bag-lz4", "mcap", "mcap-zstd", "db3")
BAG_MAGIC, MCAP_MAGIC = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"
SEED = 20260101


def only_file(path: Path) -> Path:
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))


def bag_of(folder: Path, kind: str, frames: int = 12) -> Path:
    """A bag whose chunks hold a few messages each, so that a cut leaves some of them."""
    return only_file(write_bag(folder, kind, images_of(types_of(kind), frames), name=kind))


def frames_of(path: Path) -> list[Frame]:
    return [event for event in open_dataset(f"bag:{path},imu=none").events() if isinstance(event, Frame)]


@pytest.mark.parametrize("kind", STORAGES)
@pytest.mark.parametrize("share", [0.9, 0.6])
def test_a_bag_that_is_cut_off_gives_what_it_holds(kind: str, share: float, tmp_path: Path) -> None:
    path = bag_of(tmp_path, kind, frames=1000)
    whole = frames_of(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    left = frames_of(path)
    least = 0.0 if kind in ("bag-bz2", "bag-lz4") else 0.7  # chunks of a whole megabyte, packed
    assert len(left) >= least * share * len(whole)
    assert len(left) > 0
    assert all(np.array_equal(a.images[0], b.images[0]) for a, b in zip(left, whole, strict=False))
    assert any(
        word in key for key in open_dataset(str(path)).problems for word in ("cut", "closed", "malformed", "disk")
    )


def test_a_rosbag_without_its_index_is_whole(tmp_path: Path) -> None:
    path = bag_of(tmp_path, "bag")
    data = path.read_bytes()
    at = data.index(b"index_pos=") + len(b"index_pos=")
    (index,) = struct.unpack_from("<Q", data, at)
    path.write_bytes(data[:at] + bytes(8) + data[at + 8 : index])
    assert len(frames_of(path)) == 12
    active = path.rename(path.with_name("drive.bag.active"))
    assert len(frames_of(active)) == 12


def test_an_mcap_without_footer_is_whole_and_says_that_it_was_not_closed(tmp_path: Path) -> None:
    path = bag_of(tmp_path, "mcap")
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"\x0f\x04\0\0\0\0\0\0\0")])  # where the data end
    assert len(frames_of(path)) == 12
    assert open_dataset(str(path)).problems == {"mcap.mcap: not closed by its recorder": 1}


@pytest.mark.parametrize("kind", ["bag", "bag-lz4", "mcap", "mcap-zstd"])
def test_what_lies_behind_damage_in_the_middle_is_found_again(kind: str, tmp_path: Path) -> None:
    path = bag_of(tmp_path, kind, frames=1500)
    whole = len(frames_of(path))
    data = bytearray(path.read_bytes())
    begin = len(data) // 3
    data[begin : begin + 3000] = random.Random(SEED).randbytes(3000)
    path.write_bytes(data)
    frames = frames_of(path)
    assert frames[-1].t_ns == BEGIN_NS + (whole - 1) * FRAME_NS
    assert len(frames) > 0.3 * whole
    assert open_dataset(str(path)).problems


def test_lz4_in_mcap(tmp_path: Path) -> None:
    """No writer at hand makes it, so a whole file's records are packed here."""
    data = bag_of(tmp_path, "mcap").read_bytes()
    at = 8
    records = b""
    while data[at] != 15:
        (length,) = struct.unpack_from("<Q", data, at + 1)
        if data[at] == 6:
            (name,) = struct.unpack_from("<I", data, at + 9 + 28)
            records += data[at + 9 + 40 + name : at + 9 + length]
        elif data[at] in (3, 4, 5):
            records += data[at : at + 9 + length]
        at += 9 + length
    packed = lz4.frame.compress(records)
    path = tmp_path / "lz4.mcap"
    path.write_bytes(MCAP_MAGIC + chunk(packed, b"lz4", len(records)))
    assert len(frames_of(path)) == 12


def chunk(packed: bytes, method: bytes, declared: int, length: int | None = None) -> bytes:
    head = struct.pack("<QQQI", 0, 0, declared, 0) + struct.pack("<I", len(method)) + method
    body = head + struct.pack("<Q", len(packed)) + packed
    return b"\x06" + struct.pack("<Q", len(body) if length is None else length) + body


def rosbag_chunk(packed: bytes, method: bytes, declared: int, length: int | None = None) -> bytes:
    fields = [b"op=\x05", b"compression=" + method, b"size=" + struct.pack("<I", declared)]
    header = b"".join(struct.pack("<I", len(f)) + f for f in fields)
    told = len(packed) if length is None else length
    return struct.pack("<I", len(header)) + header + struct.pack("<I", told) + packed


def bomb(method: str) -> bytes:
    """More than a gigabyte of zeros."""
    if method == "bz2":
        return bz2.compress(bytes(2**24)) * 70
    if method == "zstd":
        from vislam.datasets.bags.chunks import _zstd

        return _zstd().compress(bytes(2**28)) * 5
    return lz4.frame.compress(bytes(2**28))


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("empty.bag", b""),
        ("magic.bag", BAG_MAGIC),
        ("old.bag", b"#ROSBAG V1.2\n"),
        ("noise.bag", random.Random(1).randbytes(5000)),
        ("header.bag", BAG_MAGIC + b"\xff" * 4000),
        ("length.bag", BAG_MAGIC + rosbag_chunk(b"x", b"none", 2**32 - 1, 2**32 - 1)),
        ("size.bag", BAG_MAGIC + rosbag_chunk(lz4.frame.compress(b"x" * 100), b"lz4", 2**32 - 1)),
        ("method.bag", BAG_MAGIC + rosbag_chunk(b"x", b"\x1b[31mrar", 10)),
        ("magic.mcap", MCAP_MAGIC),
        ("record.mcap", MCAP_MAGIC + b"\x05" + struct.pack("<Q", 2**60) + b"x" * 50),
        ("long.mcap", MCAP_MAGIC + b"\x03" + struct.pack("<Q", 2**64 - 1)),
        ("chunk.mcap", MCAP_MAGIC + chunk(b"x" * 50, b"", 2**60, 2**60)),
        ("packed.mcap", MCAP_MAGIC + chunk(lz4.frame.compress(b"x"), b"lz4", 2**60)),
        ("name.mcap", MCAP_MAGIC + chunk(b"", b"", 0)[:33] + struct.pack("<I", 2**31) + b"x" * 50),
        ("nested.mcap", MCAP_MAGIC + chunk(chunk(b"", b"", 0) * 1000, b"", 0)),
        ("empty.db3", b""),
        ("magic.db3", b"SQLite format 3\0"),
        ("noise.db3", b"SQLite format 3\0" + random.Random(2).randbytes(9000)),
        ("bomb.bag", lambda: BAG_MAGIC + rosbag_chunk(bomb("bz2"), b"bz2", MOST_CHUNK_BYTES)),
        ("more.bag", lambda: BAG_MAGIC + rosbag_chunk(bomb("lz4"), b"lz4", 1000)),
        ("bomb.mcap", lambda: MCAP_MAGIC + chunk(bomb("zstd"), b"zstd", MOST_CHUNK_BYTES)),
        ("lz4.mcap", lambda: MCAP_MAGIC + chunk(bomb("lz4"), b"lz4", MOST_CHUNK_BYTES)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_hostile_files_are_refused_in_one_line(name: str, data: bytes | Callable[[], bytes], tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(data() if callable(data) else data)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun = time.process_time()
    with pytest.raises(DataError) as told:
        open_dataset(str(path))
    assert len(str(told.value).splitlines()) == 1
    assert inspect(str(path)).worst == "error"
    assert time.process_time() - begun < 10.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - grown < 300 * 1024


HOSTILE_SQL = {
    "view": "CREATE VIEW messages AS WITH RECURSIVE t(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM t) "
    "SELECT id, 1 AS topic_id, 0 AS timestamp, x'00' AS data FROM t",
    "types": "CREATE TABLE messages(id TEXT, topic_id, timestamp, data);"
    "INSERT INTO messages VALUES('a', 1, 'late', 5), ('b', 'x', 2, NULL), (NULL, 9, 3, x'00')",
    "columns": "CREATE TABLE messages(id INTEGER PRIMARY KEY, other)",
    "large": "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data "
    "GENERATED ALWAYS AS (zeroblob(1000000000)));INSERT INTO messages(topic_id, timestamp) VALUES(1, 1)",
    "none": "",
}


@pytest.mark.parametrize("name", HOSTILE_SQL)
def test_hostile_databases_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    path = tmp_path / "drive.db3"
    base = sqlite3.connect(path)
    base.executescript("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format);")
    base.execute("INSERT INTO topics VALUES(1, '/cam0', 'sensor_msgs/msg/Image', 'cdr')")
    base.executescript(HOSTILE_SQL[name])
    base.commit()
    base.close()
    with pytest.raises(DataError) as told:
        open_dataset(str(path))
    assert len(str(told.value).splitlines()) == 1


def test_definitions_of_a_bag_are_never_parsed(tmp_path: Path) -> None:
    """Its schemas may go round in circles; the standard's are used."""
    path = bag_of(tmp_path, "mcap")
    data = path.read_bytes()
    at = data.index(b"uint32 height")
    path.write_bytes(data[:at] + b"sensor_msgs/Image x"[:13].ljust(13) + data[at + 13 :])
    assert len(frames_of(path)) == 12
    other = bag_of(tmp_path, "bag")
    sums = other.read_bytes().replace(b"060021388200f6f0f447d0fcd9c64743", b"f" * 32)
    other.write_bytes(sums)
    with pytest.raises(DataError, match="no camera images that can be read"):
        open_dataset(str(other))
    told = {topic.name: topic.taken_for for topic in inspect(str(other)).topics}
    assert "not the standard one" in told["/cam0/image_raw"]


def test_images_that_change_their_size_are_named(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", images_of(types_of("mcap"), [*map(picture, range(3)), picture(3, (40, 30))]))
    with pytest.raises(DataError, match="is 40x30 but its calibration is for 64x48"):
        frames_of(path)
    assert any("is 40x30" in finding.what for finding in inspect(str(path)).findings)


@pytest.mark.parametrize(
    "change",
    [
        {"width": 2**31},
        {"height": 2**32 - 1},
        {"step": 2**32 - 1},
        {"step": 1},
        {"encoding": "yuv\x1b[0m"},
        {"data": 0},
    ],
    ids=str,
)
def test_images_that_say_impossible_things_are_counted_or_refused(change: dict[str, object], tmp_path: Path) -> None:
    messages = images_of(types_of("mcap"), 3)
    for name, value in change.items():
        setattr(messages[2].value, name, np.zeros(3, np.uint8) if name == "data" else value)
    path = write_bag(tmp_path, "mcap", messages)
    try:
        assert len(frames_of(path)) == 2
        assert sum(open_dataset(str(path)).problems.values()) == 0  # counted while it is played
    except DataError as error:
        assert "but its calibration is for" in str(error)
    assert inspect(str(path)).worst in ("warning", "error")


def test_odd_samples_and_stamps_are_counted(tmp_path: Path, noise: CalibrationConfig) -> None:
    types = types_of("mcap")
    messages = images_of(types_of("mcap"), 4)
    messages.append(Message(BEGIN_NS, "/cam0/image_raw", types.image(BEGIN_NS + 1, picture(9), "mono8")))
    for i in range(100):
        t_ns = BEGIN_NS + (i if i != 50 else 10) * 5_000_000
        values = [0.0, 0.0, float("nan") if i == 20 else 0.0, 0.0, 0.0, 9.81]
        messages.append(Message(t_ns, "/imu", types.imu(t_ns, values, "cam0")))
    recording = open_dataset(str(write_bag(tmp_path, "mcap", messages)), noise)
    events = list(recording.events())
    assert [event.t_ns for event in events] == sorted(event.t_ns for event in events)
    told = " ".join(recording.problems)
    assert "cam0: backward stamp" in told
    assert "imu: backward stamp" in told
    assert "/imu: messages with NaN or infinity" in told


@pytest.mark.parametrize("behind_s", [5.0, 1e6])
def test_two_clocks_are_named(behind_s: float, tmp_path: Path) -> None:
    types = types_of("mcap")
    messages = images_of(types_of("mcap"), 4)
    for i in range(100):
        t_ns = BEGIN_NS + round(behind_s * 1e9) + i * 5_000_000
        messages.append(Message(BEGIN_NS + i * 5_000_000, "/imu", types.imu(t_ns, [0, 0, 0, 0, 0, 9.8], "cam0")))
    path = write_bag(tmp_path, "mcap", messages)
    with pytest.raises(DataError, match="two clocks; stamps=log"):
        open_dataset(str(path))


def test_a_topic_that_vanishes_leaves_what_it_gave(tmp_path: Path) -> None:
    types = types_of("mcap")
    messages = images_of(types_of("mcap"), 10)
    for message in list(messages):
        right = Message(message.t_ns, message.topic.replace("cam0", "cam1"), message.value)
        messages += [right] if message.t_ns < BEGIN_NS + 9 * FRAME_NS else []
    del types
    recording = open_dataset(f"bag:{write_bag(tmp_path, 'mcap', messages)},cam1=none")
    assert recording.frame_count == 10


def test_files_of_a_split_bag_are_one(tmp_path: Path) -> None:
    messages = images_of(types_of("mcap"), 9)
    folder = tmp_path / "drive"
    folder.mkdir()
    for k, part in enumerate((messages[:4], messages[4:7], messages[7:])):
        file = only_file(write_bag(tmp_path, "mcap", part, name=f"part{k}"))
        file.rename(folder / f"drive_{k * 5}.mcap")  # 0, 5, 10
    assert [frame.t_ns for frame in frames_of(folder)] == [BEGIN_NS + i * FRAME_NS for i in range(9)]
    (folder / "drive_5.mcap").write_bytes(b"no bag")
    with pytest.raises(DataError, match=r"drive_5.mcap begins neither"):
        frames_of(folder)


def play(path: Path) -> None:
    """Whatever a file holds: values in order, or one line."""
    try:
        recording = open_dataset(f"bag:{path},imu=none")
        stamps = [event.t_ns for event in recording.events()]
        assert stamps == sorted(stamps)
        inspect(str(path))
    except VislamError as error:
        assert len(str(error).splitlines()) == 1


SEEDS: dict[str, bytes] = {}


@pytest.mark.parametrize("kind", STORAGES)
def test_mutated_bags_are_read_or_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    data = SEEDS.setdefault(kind, bag_of(tmp_path, kind, frames=3).read_bytes())
    path = tmp_path / f"mutated{'.bag' if kind.startswith('bag') else '.mcap' if kind.startswith('mcap') else '.db3'}"

    @settings(max_examples=60, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(st.lists(st.tuples(st.integers(0, len(data) - 1), st.integers(0, 4), st.binary(min_size=1, max_size=12)),
                    min_size=1, max_size=6))  # fmt: skip
    def mutate(changes: list[tuple[int, int, bytes]]) -> None:
        out = bytearray(data)
        for at, how, piece in changes:
            if how == 0:
                out[at : at + len(piece)] = piece
            elif how == 1:
                out[at:at] = piece
            elif how == 2:
                del out[at : at + 10 * len(piece)]
            elif how == 3:
                out[at : at + 8] = struct.pack("<q", 2**60)
            elif len(out) > 40:
                del out[max(at, 40) :]
        path.write_bytes(out)
        play(path)

    mutate()


UNKNOWN = b"\x08\0\0\0\x04\0\0\0op=\x63\0\0\0\0"  # a record of rosbag 1 of a kind that is none


@pytest.mark.parametrize(
    ("name", "record", "records", "method", "declared", "chunks", "what"),
    [
        ("a.bag", UNKNOWN, 10**6, "bz2", 16 * 10**6, 1, "records"),
        ("a.bag", UNKNOWN, 10**6, "lz4", 16 * 10**6, 1, "records"),
        ("a.mcap", b"\x63" + bytes(8), 10**6, "lz4", 9, 1, ""),
        ("a.bag", b"\0", 2**24, "bz2", 2**24, 70, "unpacked bytes"),
    ],
    ids=["bz2", "lz4", "more than stated", "many chunks"],
)
def test_a_packed_bag_cannot_ask_for_far_more_than_its_size(
    name: str, record: bytes, records: int, method: str, declared: int, chunks: int, what: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    packed = (bz2 if method == "bz2" else lz4.frame).compress(record * records)
    magic, pack = (BAG_MAGIC, rosbag_chunk) if name == "a.bag" else (MCAP_MAGIC, chunk)
    path.write_bytes(magic + pack(packed, method.encode(), declared) * chunks)
    problems = Problems()
    if what:
        with pytest.raises(DataError, match=f"asks for far more {what} than its size justifies"):
            list(Bag(path).scan(problems))
    else:
        assert list(Bag(path).scan(problems)) == [] and problems


@pytest.mark.parametrize("kind", ["mcap-message", "db3-message"])
def test_a_packed_message_unpacks_to_what_its_camera_and_its_bag_justify(kind: str, tmp_path: Path) -> None:
    path = bag_of(tmp_path, kind)
    assert len(frames_of(path)) == 12
    messages = images_of(types_of(kind))
    image = messages[2].value
    image.data = np.concatenate([image.data, np.zeros(2**24, np.uint8)])
    path = only_file(write_bag(tmp_path, kind, messages, name="bomb"))
    recording = open_dataset(f"bag:{path},imu=none")
    assert [event.t_ns - BEGIN_NS for event in recording.events()] == [0, 2 * FRAME_NS]
    bag = Bag(path)
    place = max(bag.scan(Problems()), key=lambda found: found.place.length).place
    with pytest.raises(DataError, match="asks for far more unpacked bytes than its size justifies"):
        for _ in range(100):
            bag.read(place)


def test_the_index_is_read_once_for_all_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, count = chunk(b"\x05", b"", 0), 300
    places = [len(MCAP_MAGIC) + i * len(one) for i in range(count)]
    body = MCAP_MAGIC + one * count + struct.pack("<BQ", 15, 4) + bytes(4)
    index = b"".join(struct.pack("<BQQQQ", 8, 64, 0, 0, place) + bytes(40) for place in places)
    path = tmp_path / "a.mcap"
    path.write_bytes(body + index + struct.pack("<BQQQI", 2, 20, len(body), 0, 0) + MCAP_MAGIC)
    reads, read = [], FileBytes.read
    monkeypatch.setattr(FileBytes, "read", lambda self, at, length: reads.append(at) or read(self, at, length))
    problems = Problems()
    assert list(Bag(path).scan(problems)) == []
    assert sum(problems.values()) >= count
    assert len(reads) < 12 * count


def test_memory_does_not_grow_with_the_length_of_a_bag(tmp_path: Path) -> None:
    black = [np.zeros((480, 640), np.uint8)] * 1499
    path = write_bag(tmp_path, "mcap-zstd", images_of(types_of("mcap-zstd"), black))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    recording = open_dataset(str(path))
    assert sum(1 for _ in recording.events()) == 1499  # 460 MB
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024
    problems = Problems()
    assert sum(1 for _ in Bag(path).scan(problems)) == 1500
    assert problems == {}
