"""The recorder: what is read is what was written, and neither a crash nor a full disk costs more than a row."""

import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError, StorageError, UsageError
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.datasets import open_dataset
from vislam.datasets.recorder import Recorder, record
from vislam.imu import ImuNoise
from worlds.mini_recording import HEIGHT, WIDTH, picture, write_asl
from worlds.parts import R_BODY_CAM

NOISE = ImuNoise(1.7e-4, 2e-3, 1.9e-5, 0.0, 200.0)


def pose(x_m: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = R_BODY_CAM
    T[:3, 3] = [0.0, -x_m, 0.1]
    return T


def rig(stereo: bool = False, depth: bool = False) -> Rig:
    first = Camera(WIDTH, HEIGHT, 50.1, 51.2, 31.3, 23.4, 0.05, "radtan", (-0.1, 0.01, 1e-4, 2e-4, 1e-3))
    second = Camera(WIDTH, HEIGHT, 50.1, 51.2, 31.3, 23.4, 0.0, "equidistant", (0.1, 0.01, 1e-4, 2e-4))
    return Rig((first, second)[: 1 + stereo], (pose(0.0), pose(0.1))[: 1 + stereo], has_depth=depth)


@contextmanager
def file_size_limit(limit_bytes: int) -> Iterator[None]:
    """Let the kernel refuse to write files beyond a size, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


finite = st.floats(allow_nan=False, allow_infinity=False)
vectors = st.tuples(finite, finite, finite)


@settings(max_examples=30)
@given(st.dictionaries(st.integers(0, 2**61), st.tuples(vectors, vectors), min_size=1, max_size=5), vectors)
def test_samples_come_back_bit_for_bit(samples: dict[int, tuple], field: tuple) -> None:
    with tempfile.TemporaryDirectory() as name:
        with Recorder(Path(name) / "r", rig(), NOISE) as recorder:
            recorder.write(Frame(0, 0, (picture(0),)))
            for t_ns in sorted(samples):
                recorder.write(ImuSample(t_ns, *(np.array(v) for v in samples[t_ns])))
            recorder.write(MagSample(7, np.array(field)))
        recording = open_dataset(f"euroc:{Path(name) / 'r'}")
        events = list(recording.events())
    imu = [e for e in events if isinstance(e, ImuSample)]
    assert [s.t_ns for s in imu] == sorted(samples)
    for sample in imu:
        gyro, accel = samples[sample.t_ns]
        assert sample.gyro_rad_s.tobytes() == np.array(gyro).tobytes()
        assert sample.accel_m_s2.tobytes() == np.array(accel).tobytes()
    mag = [e for e in events if isinstance(e, MagSample)]
    assert np.array_equal(mag[0].field_ut, field)
    assert recording.imu_noise == NOISE


def test_color_stereo_depth_and_calibration_come_back(tmp_path: Path) -> None:
    depth_m = np.linspace(0.0, 70.0, WIDTH * HEIGHT, dtype=np.float32).reshape(HEIGHT, WIDTH)
    depth_m[0, :3] = [np.nan, np.inf, -1.0]
    written = rig(stereo=True, depth=True)
    with Recorder(tmp_path / "r", written, None) as recorder:
        for i in range(3):
            depth = depth_m if i != 1 else None
            recorder.write(Frame(100 + i, i, (picture(i), picture(50 + i)), picture(i, color=True), depth))
    recording = open_dataset(str(tmp_path / "r"))
    assert recording.rig.cameras == written.cameras and recording.rig.has_depth
    for got, wanted in zip(recording.rig.T_body_cams, written.T_body_cams, strict=True):
        np.testing.assert_array_equal(got, wanted)
    frames = list(recording.events())
    assert [f.t_ns for f in frames] == [100, 101, 102]
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.color, picture(i, color=True)) and np.array_equal(frame.images[1], picture(50 + i))
    assert frames[1].depth_m is None
    inside = (depth_m > 0) & (depth_m < 65.5)
    np.testing.assert_allclose(frames[0].depth_m[inside], depth_m[inside], atol=0.00051)
    assert np.all(frames[0].depth_m[0, :3] == 0.0)
    assert np.all(frames[0].depth_m[depth_m > 65.6] == 0.0)
    assert recorder.problems["depth pixel beyond 16 bits"] > 0
    assert recorder.counts["frames"] == 3


def test_depth_of_another_moment_comes_back_with_its_own_stamp(tmp_path: Path) -> None:
    depth_m = np.ones((HEIGHT, WIDTH), dtype=np.float32)
    with Recorder(tmp_path / "r", rig(depth=True), None) as recorder:
        for i in range(3):
            lag_s = 0.007 if i else -0.007
            t_ns = 1_000_000_000 + i * 33_000_000
            recorder.write(Frame(t_ns, i, (picture(i),), None, depth_m, depth_lag_s=lag_s))
    frames = [event for event in open_dataset(str(tmp_path / "r")).events() if isinstance(event, Frame)]
    assert [round(frame.depth_lag_s, 9) for frame in frames] == [-0.007, 0.007, 0.007]


def test_a_copied_recording_plays_the_same(tmp_path: Path) -> None:
    root = write_asl(tmp_path / "a", frames=4)
    (root / "mocap0").mkdir()
    (root / "mocap0" / "data.csv").write_text("#t\n1,0.1,0.2,0.3,0.6,0.8,0,0\n2,0.1,0.2,0.4,0.6,0.8,0,0\n")
    source = open_dataset(str(tmp_path / "a"))
    told: list[int] = []
    record(source, tmp_path / "b", on_frame=told.append)
    assert told == [1, 2, 3, 4]
    copy = open_dataset(str(tmp_path / "b"))
    for one, other in zip(source.events(), copy.events(), strict=True):
        assert (one.t_ns, type(one)) == (other.t_ns, type(other))
        if isinstance(one, Frame):
            assert all(np.array_equal(a, b) for a, b in zip(one.images, other.images, strict=True))
        else:
            assert one.accel_m_s2.tobytes() == other.accel_m_s2.tobytes()
    np.testing.assert_allclose(copy.truth().T_world_body, source.truth().T_world_body, atol=1e-12)
    assert copy.rig.cameras == source.rig.cameras and copy.imu_noise == source.imu_noise


def test_full_disk_keeps_what_was_written(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "r", rig(), NOISE)
    recorder.write(Frame(1_000_000_000, 0, (picture(0),)))
    written = 0
    with file_size_limit(4000), pytest.raises(StorageError) as caught:
        for i in range(1000):
            recorder.write(ImuSample(1_000_000_000 + i * 5_000_000, np.full(3, i / 3), np.full(3, i / 7)))
            written = i + 1
    assert f"kept 1 frames, {written} imu samples up to t=" in str(caught.value)
    assert "imu0/data.csv cannot be written: " in str(caught.value) and "record into a new folder" in str(caught.value)
    recording = open_dataset(str(tmp_path / "r"))
    events = list(recording.events())
    assert len(events) == 1 + written and recording.problems == {}
    with pytest.raises(UsageError, match="is closed"):
        recorder.write(ImuSample(1, np.zeros(3), np.zeros(3)))


def test_full_disk_in_the_middle_of_an_image(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "r", rig(), NOISE)
    recorder.write(ImuSample(0, np.zeros(3), np.zeros(3)))
    recorder.write(Frame(1, 0, (picture(0),)))
    with file_size_limit(1000), pytest.raises(StorageError, match=r"2.png cannot be written: "):
        recorder.write(Frame(2, 1, (picture(1),)))
    recording = open_dataset(str(tmp_path / "r"))
    assert [e.t_ns for e in recording.events()] == [0, 1]
    assert recording.problems == {}
    assert [p.name for p in (tmp_path / "r" / "mav0" / "cam0" / "data").iterdir()] == ["1.png"]


def test_no_space_is_told_in_words(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    recorder = Recorder(tmp_path / "r", rig(), NOISE)
    log = tmp_path / "r" / "mav0" / "mag0"
    log.mkdir()
    (log / "data.csv").symlink_to("/dev/full")
    with pytest.raises(StorageError, match=r"mag0/data.csv cannot be written: the disk is full; kept nothing"):
        recorder.write(MagSample(1, np.zeros(3)))


def test_a_killed_recorder_leaves_a_recording(tmp_path: Path) -> None:
    script = f"""
import os, numpy as np
from vislam.core.camera import Camera, Rig
from vislam.datasets.recorder import Recorder
from vislam.imu import ImuNoise
from vislam.core.messages import Frame, ImuSample
T = np.eye(4)
rig = Rig((Camera({WIDTH}, {HEIGHT}, 50.0, 50.0, 31.0, 23.0),), (T,))
recorder = Recorder(__import__("pathlib").Path({str(tmp_path / "r")!r}), rig, ImuNoise(1e-4, 1e-3, 1e-5, 1e-4, 200.0))
for i in range(50):
    recorder.write(ImuSample(i * 10, np.full(3, i), np.full(3, i)))
    if i % 10 == 0:
        recorder.write(Frame(i * 10, i, (np.full(({HEIGHT}, {WIDTH}), i, np.uint8),)))
os.kill(os.getpid(), 9)
"""
    done = subprocess.run([sys.executable, "-c", script], check=False, timeout=120)
    assert done.returncode == -9
    recording = open_dataset(str(tmp_path / "r"))
    events = list(recording.events())
    assert sum(isinstance(e, Frame) for e in events) == 5 and len(events) == 55
    assert recording.problems == {}


def test_misuse_is_refused(tmp_path: Path) -> None:
    with Recorder(tmp_path / "r", rig(), None) as recorder:
        with pytest.raises(DataError, match="without the noise model"):
            recorder.write(ImuSample(0, np.zeros(3), np.zeros(3)))
        with pytest.raises(DataError, match="2 images came for a rig of 1"):
            recorder.write(Frame(0, 0, (picture(0), picture(1))))
        with pytest.raises(DataError, match="32x24"):
            recorder.write(Frame(0, 0, (picture(0, (32, 24)),)))
        with pytest.raises(DataError, match="without depth"):
            recorder.write(Frame(0, 0, (picture(0),), None, np.ones((HEIGHT, WIDTH), np.float32)))
    with pytest.raises(UsageError, match="already holds something"):
        Recorder(tmp_path / "r", rig(), None)
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="already holds something"):
        Recorder(tmp_path / "file", rig(), None)


def test_frames_that_do_not_rise_are_counted_not_overwritten(tmp_path: Path) -> None:
    with Recorder(tmp_path / "r", rig(), None) as recorder:
        for t_ns, seed in ((10, 0), (10, 1), (5, 2), (11, 3)):
            recorder.write(Frame(t_ns, 0, (picture(seed),)))
    assert recorder.problems == {"frame whose stamp does not rise (first: 10 ns)": 2}
    frames = list(open_dataset(str(tmp_path / "r")).events())
    assert [f.t_ns for f in frames] == [10, 11] and np.array_equal(frames[0].images[0], picture(0))


def test_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot be written"):
        Recorder(tmp_path / "file" / "r", rig(), None)
    assert os.listdir(tmp_path) == ["file"]
