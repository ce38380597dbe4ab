"""Random damage to any file of any format gives a stream in time order or a one-line error, never a traceback."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from test_other_formats import write_kitti, write_tum, write_video

from vislam.core.errors import VislamError
from vislam.datasets import open_dataset
from vislam.datasets.inspect import inspect
from worlds.mini_recording import HEIGHT, IMU_YAML, WIDTH, camera_yaml, imu_rows, write_asl

SEED, ROUNDS = 20260101, 40
INSERTS = [b"nan", b"1e999", b"\n", b",", b"\0" * 50, b"9" * 400, b"[", b"{", b": "]


def asl(folder: Path) -> Path:
    root = write_asl(folder, frames=3)
    (root / "mocap0").mkdir()
    (root / "mocap0" / "data.csv").write_text("#t\n1,1,2,3,0.6,0.8,0,0\n2,1,2,3,0.6,0.8,0,0\n")
    return folder


def tum(folder: Path) -> Path:
    path = write_tum(folder / "kinect", (WIDTH, HEIGHT))
    (path / "sensor.yaml").write_text(camera_yaml())
    return path


def video(folder: Path) -> Path:
    (folder / "ride.imu.csv").write_text("#t\n" + "\n".join(imu_rows(3)) + "\n")
    (folder / "ride.imu.yaml").write_text(IMU_YAML)
    return write_video(folder)


def damage(path: Path, rng: random.Random) -> None:
    data = bytearray(path.read_bytes())
    at = rng.randrange(len(data) + 1)
    kind = rng.choice(["cut", "flip", "insert", "shuffle", "noise", "remove"])
    if kind == "remove":
        path.unlink()
        return
    if kind == "cut":
        data = data[:at]
    elif kind == "flip":
        for _ in range(min(len(data), 10)):
            data[rng.randrange(len(data))] = rng.randrange(256)
    elif kind == "insert":
        data[at:at] = rng.choice(INSERTS)
    elif kind == "shuffle":
        lines = data.split(b"\n")
        rng.shuffle(lines)
        data = bytearray(b"\n".join(lines))
    else:
        data = bytearray(rng.randbytes(300))
    path.write_bytes(data)


def play(source: str) -> int:
    """Play a recording whole and return how many values came; their stamps must not go back."""
    recording = open_dataset(source)
    recording.truth()
    stamps = [event.t_ns for event in recording.events()]
    assert stamps == sorted(stamps)
    return len(stamps)


@pytest.mark.parametrize(("name", "make"), [("euroc", asl), ("tum", tum), ("kitti", write_kitti), ("video", video)])
def test_random_damage(tmp_path: Path, name: str, make: Callable[[Path], Path]) -> None:
    print(f"seed {SEED}")
    rng = random.Random(SEED)
    whole = tmp_path / "whole"
    whole.mkdir()
    source = make(whole).relative_to(whole)
    assert play(f"{name}:{whole / source}") > 0
    for i in range(ROUNDS):
        copy = tmp_path / f"damaged{i}"
        shutil.copytree(whole, copy)
        files = sorted(path for path in copy.rglob("*") if path.is_file())
        tables = [path for path in files if path.suffix != ".png"]
        damage(rng.choice(tables if rng.random() < 0.7 else files), rng)
        for look in (play, inspect):
            try:
                look(f"{name}:{copy / source}")
            except VislamError as error:
                assert str(error) and "\n" not in str(error)
