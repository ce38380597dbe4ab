"""Bytes of raw images a second that the reader of bags gives, beside `rosbags` alone on the same file in the same run.

    .venv/bin/python benchmarks/bag_reader.py
    .venv/bin/python benchmarks/bag_reader.py --size 1280 720 --frames 400 --keep FOLDER

A bag of random grey images of two cameras and 200 inertial samples a second is written by `rosbags` for each storage.
Both are timed from opening to the last message, in CPU seconds of the whole process, the least of several rounds, the
file being in memory. `rosbags` alone: its reader, and its `deserialize` of every message. Ours: the survey (a pass over
the whole file) and `events()`, which also pairs images, orders all by time and hands out grey arrays of its own.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from rosbags.highlevel import AnyReader

from vislam.config import CalibrationConfig
from vislam.core.messages import Frame
from vislam.datasets import open_dataset
from worlds.bag_writer import Message, Types, types_of, write_bag

_NOISE = (
    "rate_hz: 200\ngyroscope_noise_density: 1.7e-04\ngyroscope_random_walk: 2e-5\n"
    "accelerometer_noise_density: 2e-3\naccelerometer_random_walk: 3e-3\n"
)
_BEGIN_NS = 1_700_000_000_000_000_000
_KINDS = ("bag", "bag-lz4", "mcap", "mcap-zstd", "db3")  # bz2 takes too long to be measured here


def messages(types: Types, frames: int, size: tuple[int, int]) -> Iterator[Message]:
    """Yield images at 20 Hz of two cameras and inertial samples at 200 Hz between them."""
    width, height = size
    rng = np.random.default_rng(0)
    # half of the bits are noise, as in pictures that are taken in poor light
    pixels = rng.integers(0, 16, (8, height, width), dtype=np.uint8) + np.arange(width, dtype=np.uint8) // 16 * 16
    K = np.array([[400.0, 0.0, width / 2], [0.0, 400.0, height / 2], [0.0, 0.0, 1.0]])
    P = np.column_stack([K, [-40.0, 0.0, 0.0]])
    for k in range(2):
        info = types.info(_BEGIN_NS, size, K, "plumb_bob", [0.0] * 5, "imu", P=None if k == 0 else P)
        yield Message(_BEGIN_NS, f"/cam{k}/camera_info", info)
    for i in range(frames):
        t_ns = _BEGIN_NS + i * 50_000_000
        for k in range(10):
            at_ns = t_ns + k * 5_000_000
            yield Message(at_ns, "/imu", types.imu(at_ns, [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]))
        for k in range(2):
            yield Message(t_ns, f"/cam{k}/image_raw", types.image(t_ns, pixels[(i + k) % 8], "mono8", "imu"))


def ours(path: Path, noise: Path) -> int:
    """Return the bytes of images that the reader gives."""
    recording = open_dataset(f"bag:{path}", CalibrationConfig(imu_noise=str(noise)))
    return sum(image.nbytes for event in recording.events() if isinstance(event, Frame) for image in event.images)


def alone(path: Path) -> int:
    """Return the bytes of images that `rosbags` gives."""
    total = 0
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.msgtype == "sensor_msgs/msg/Image":
                total += message.data.nbytes
    return total


def least_s(read: Callable[[], int], rounds: int) -> tuple[float, float, int]:
    """Return CPU seconds and seconds by the clock, the least of each, and the bytes of images."""
    cpu, wall, total = [], [], 0
    for _ in range(rounds):
        begun, begun_cpu = time.perf_counter(), time.process_time()
        total = read()
        cpu.append(time.process_time() - begun_cpu)
        wall.append(time.perf_counter() - begun)
    return min(cpu), min(wall), total


def main() -> None:
    """Print a line per storage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--size", type=int, nargs=2, default=(752, 480))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", nargs="*", default=_KINDS)
    parser.add_argument("--keep", type=Path, help="folder for the bags")
    options = parser.parse_args()
    print(f"{'storage':<11} {'MB':>6} | {'ours MB/s of CPU':>17} {'by the clock':>13} | {'rosbags':>8} {'':>8} | ratio")
    with tempfile.TemporaryDirectory() as name:
        folder = options.keep or Path(name)
        noise = folder / "noise.yaml"
        noise.write_text(_NOISE)
        for kind in options.only:
            types = types_of(kind)
            path = write_bag(folder, kind, messages(types, options.frames, tuple(options.size)), name=kind)
            cpu, wall, total = least_s(lambda path=path: ours(path, noise), options.rounds)
            other_cpu, other_wall, other_total = least_s(lambda path=path: alone(path), options.rounds)
            assert total == other_total, (kind, total, other_total)
            mb = total / 1e6
            print(
                f"{kind:<11} {mb:6.0f} | {mb / cpu:17.0f} {mb / wall:13.0f} | {mb / other_cpu:8.0f} "
                f"{mb / other_wall:8.0f} | {other_cpu / cpu:5.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
