"""The RealSense driver on the real library, where it is installed: a software device of its own, recorded and played.

It has no extrinsics between cameras and IMU, so those are given; all else is the library's: callbacks, sets of images,
single samples, clocks, options that are not there.
"""

import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vislam.config import RealsenseConfig, SensorsConfig
from vislam.hw.cameras import realsense
from vislam.hw.library_cameras import open_with_imu

rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
WIDTH, HEIGHT, SECONDS, LONG_S = 64, 48, 6.0, 60.0
CAMERA = RealsenseConfig(width_px=WIDTH, height_px=HEIGHT, reopen_s=LONG_S, imu_silent_s=LONG_S)


def filled(thing: Any, **values: Any) -> Any:
    for name, value in values.items():
        setattr(thing, name, value)
    return thing


def recorded(path: Path) -> None:
    """Record some seconds of a stereo pair and an IMU whose values are the device's time in seconds."""
    device = rs.software_device()
    camera, motion = device.add_sensor("Stereo Module"), device.add_sensor("Motion Module")
    camera.add_read_only_option(rs.option.depth_units, 0.001)
    lens = filled(rs.intrinsics(), width=WIDTH, height=HEIGHT, fx=50.0, fy=50.0, ppx=32.0, ppy=24.0)
    common = {"width": WIDTH, "height": HEIGHT, "fps": 30, "bpp": 1, "fmt": rs.format.y8, "intrinsics": lens}
    pair = [
        camera.add_video_stream(filled(rs.video_stream(), type=rs.stream.infrared, index=k, uid=k, **common))
        for k in (1, 2)
    ]
    rates = {rs.stream.gyro: 200, rs.stream.accel: 250}
    moves = {
        kind: motion.add_motion_stream(
            filled(rs.motion_stream(), type=kind, index=0, uid=3 + k, fps=rate, fmt=rs.format.motion_xyz32f)
        )
        for k, (kind, rate) in enumerate(rates.items())
    }
    recorder = rs.recorder(str(path), device)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles())
        sensor.start(lambda frame: None)
    due = [(k / 30.0, None, k) for k in range(round(30 * SECONDS))]
    due += [(k / rate, kind, k) for kind, rate in rates.items() for k in range(round(rate * SECONDS))]
    began_s = time.monotonic()
    for t_s, kind, k in sorted(due, key=lambda one: one[0]):
        time.sleep(max(began_s + t_s - time.monotonic(), 0.0))
        stamp = {"timestamp": 1000.0 * (1.0 + t_s), "domain": rs.timestamp_domain.hardware_clock, "frame_number": k}
        if kind is not None:
            data = filled(rs.vector(), x=t_s, y=-9.81, z=0.0)
            profile = moves[kind].as_motion_stream_profile()
            motion.on_motion_frame(filled(rs.software_motion_frame(), data=data, profile=profile, **stamp))
            continue
        for one in pair:
            pixels = np.full((HEIGHT, WIDTH), k, np.uint8)
            facts = {"stride": WIDTH, "bpp": 1, "pixels": pixels, "profile": one.as_video_stream_profile()}
            camera.on_video_frame(filled(rs.software_video_frame(), **facts, **stamp))
    for sensor in sensors:
        sensor.stop()
        sensor.close()


def test_the_driver_reads_both_by_the_librarys_callbacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, make = tmp_path / "device.db3", rs.config
    recorded(path)

    def played() -> Any:
        config = make()
        config.enable_device_from_file(str(path), repeat_playback=False)
        return config

    monkeypatch.setattr(rs, "config", played)
    monkeypatch.setattr(realsense, "imu_pose", lambda rs, profile, first: np.eye(4))
    camera, imu = open_with_imu("realsense", replace(SensorsConfig(), realsense=CAMERA))
    frames, samples, end = [], [], time.monotonic() + LONG_S
    with closing(camera):
        while len(frames) < 10 or len(samples) < 100:
            assert time.monotonic() < end, (camera.problem, camera.counters(), imu.counters())
            samples += imu.read(0.05)
            if (frame := camera.read(0.0)) is not None:
                frames.append(frame)
    assert camera.stamped_by == "the device's clock, when readout began, on one line with its IMU's"
    assert camera.counters()["bad_stamps"] == 0
    told_s = -np.array([sample.gyro_rad_s[1] for sample in samples])
    at_gyro_s = -np.array([sample.accel_m_s2[1] for sample in samples])
    assert np.median(np.abs(at_gyro_s - told_s)) < 1e-3
    assert samples[0].accel_m_s2[2] == pytest.approx(9.81)
    off_ns = [frame.t_ns - round(frame.images[0][0, 0] / 30.0 * 1e9) for frame in frames]
    imu_off_ns = [sample.t_ns - round(s * 1e9) for sample, s in zip(samples, told_s, strict=True)]
    assert abs(np.median(off_ns) - np.median(imu_off_ns)) < 5e6
