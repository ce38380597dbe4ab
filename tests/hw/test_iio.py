"""The kernel's IIO devices, on a tree of files and pipes as the ABI describes them."""

import itertools
import os
import shutil
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.config import BoardConfig, SensorCalibration
from vislam.core.errors import HardwareError
from vislam.core.messages import ImuSample
from vislam.hw import timing
from vislam.hw.health import Health
from vislam.hw.iio_device import Element
from vislam.hw.iio_imu import IioImu, find_devices

PERIOD_NS = 5_000_000
GYRO_SCALE, ACCEL_SCALE = 0.000266, 0.001197


class Device:
    """A device of the kernel: its files below a root, and a pipe in the place of its node."""

    def __init__(
        self, root: Path, number: int, name: str, kinds: tuple[str, ...], kind_type: str = "le:s16/16>>0", **files: str
    ) -> None:
        self.kinds = kinds
        self.folder = root / f"sys/bus/iio/devices/iio:device{number}"
        self.node = root / f"dev/iio:device{number}"
        (self.folder / "scan_elements").mkdir(parents=True)
        (self.folder / "buffer").mkdir()
        self.node.parent.mkdir(exist_ok=True)
        told = {
            "name": name, "buffer/enable": "0", "buffer/length": "2", "current_timestamp_clock": "realtime\n",
            "sampling_frequency": "50", "sampling_frequency_available": "10 50 100 200 500",
            "in_anglvel_scale": f"{GYRO_SCALE}", "in_accel_scale": f"{ACCEL_SCALE}",
        }  # fmt: skip
        index = 0
        for kind in (*kinds, "temp"):
            for axis in "xyz" if kind != "temp" else ("",):
                stem = f"scan_elements/in_{kind}_{axis}".rstrip("_")
                told |= {f"{stem}_en": "1", f"{stem}_index": f"{index}", f"{stem}_type": kind_type}
                index += 1
        stem = "scan_elements/in_timestamp"
        told |= {f"{stem}_en": "0", f"{stem}_index": f"{index}", f"{stem}_type": "le:s64/64>>0"}
        for path, text in (told | files).items():
            (self.folder / path).write_text(text)
        os.mkfifo(self.node)
        self.fd = os.open(self.node, os.O_RDWR | os.O_NONBLOCK)

    def said(self, name: str) -> str:
        return (self.folder / name).read_text().strip()

    def push(self, t_ns: int, *counts: int) -> None:
        data = struct.pack(f"<{len(counts)}h", *counts)
        os.write(self.fd, data + bytes(-len(data) % 8) + struct.pack("<q", t_ns))

    def unplug(self) -> None:
        os.close(self.fd)
        self.node.unlink()
        shutil.rmtree(self.folder)


def read_all(source: IioImu, count: int) -> list[ImuSample]:
    samples: list[ImuSample] = []
    for _ in range(100):
        samples += [sample for sample in source.read(0.02) if isinstance(sample, ImuSample)]
        if len(samples) >= count:
            break
    return samples


def config(**values: object) -> BoardConfig:
    return BoardConfig(**{"rate_hz": 200.0, "reopen_s": 0.05, **values})  # type: ignore[arg-type]


def test_one_device_with_both_is_set_up_and_read_with_the_kernel_s_stamps(tmp_path: Path) -> None:
    device = Device(tmp_path, 0, "mpu6050", ("accel", "anglvel"))
    source = IioImu(config(), root=tmp_path)
    assert device.said("buffer/enable") == "1"
    assert device.said("sampling_frequency") == "200"
    assert device.said("current_timestamp_clock") == "monotonic"
    assert int(device.said("buffer/length")) == 200
    assert device.said("scan_elements/in_timestamp_en") == device.said("scan_elements/in_accel_x_en") == "1"
    assert device.said("scan_elements/in_temp_en") == "0"
    assert source.rate_hz == 200.0
    begin = time.monotonic_ns()
    for k in range(50):
        device.push(begin + k * PERIOD_NS, 100 + k, -200, 8192, k, -k, 2 * k)
    samples = read_all(source, 50)
    assert [s.t_ns for s in samples] == [begin + k * PERIOD_NS for k in range(50)]
    np.testing.assert_allclose(samples[7].gyro_rad_s, GYRO_SCALE * np.array([7, -7, 14]))
    np.testing.assert_allclose(samples[7].accel_m_s2, ACCEL_SCALE * np.array([107, -200, 8192]))
    assert source.health() == Health(0)
    assert source.counters() == {}
    assert "kernel" in source.stamped_by
    source.close()
    source.close()
    assert device.said("buffer/enable") == "0"


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_a_sensor_that_hangs_alone_is_named_and_not_integrated(tmp_path: Path, sensor: str) -> None:
    device = Device(tmp_path, 0, "mpu6050", ("accel", "anglvel"))
    source = IioImu(config(silent_s=60.0), root=tmp_path)
    begin = time.monotonic_ns() - 150 * PERIOD_NS
    for k in range(130):
        accel, gyro = (k, 0) if sensor == "gyro" else (0, k)
        device.push(begin + k * PERIOD_NS, accel, 0, 8192, gyro, 0, 1)
    samples = []
    while source.counters().get(f"{sensor}_stuck", 0) < 10:
        samples += source.read(0.02)
    assert len(samples) == 20
    assert source.health() == Health[f"{sensor.upper()}_FAULT"] | Health.IMU_GAP
    device.push(time.monotonic_ns(), 131, 0, 8192, 131, 0, 1)
    assert len(read_all(source, 1)) == 1
    assert source.health() == Health(0)
    source.close()
    os.close(device.fd)


def test_two_devices_are_joined_at_the_gyro_s_stamps(tmp_path: Path) -> None:
    accel = Device(tmp_path, 0, "lsm6dsox_accel", ("accel",))
    gyro = Device(tmp_path, 1, "lsm6dsox_gyro", ("anglvel",))
    source = IioImu(config(delay_s=0.002), "lsm6dsox", root=tmp_path)
    begin = time.monotonic_ns()
    for k in range(40):
        accel.push(begin + k * PERIOD_NS, 10 * k, 0, 8192)
        gyro.push(begin + k * PERIOD_NS + 1_000_000, k, 0, 0)
    samples = read_all(source, 39)
    assert len(samples) == 39, "the last one waits for the accelerometer's next"
    for k, sample in enumerate(samples):
        assert sample.t_ns == begin + k * PERIOD_NS + 1_000_000 - 2_000_000
        np.testing.assert_allclose(sample.accel_m_s2[0], ACCEL_SCALE * (10 * k + 2.0), atol=1e-9)
        np.testing.assert_allclose(sample.gyro_rad_s[0], GYRO_SCALE * k)
    source.close()


def test_axes_and_offsets_of_each_axis(tmp_path: Path) -> None:
    files = {"in_accel_z_scale": "0.5", "in_accel_z_offset": "3", "in_anglvel_offset": "-1"}
    device = Device(tmp_path, 0, "adis", ("accel", "anglvel"), **files)
    calibration = SensorCalibration(accel_axes=("-y", "x", "z"))
    source = IioImu(config(calibration=calibration), root=tmp_path)
    device.push(time.monotonic_ns(), 1, 2, 3, 1, 2, 3)
    sample = read_all(source, 1)[0]
    np.testing.assert_allclose(sample.accel_m_s2, [-2 * ACCEL_SCALE, ACCEL_SCALE, 3.0])
    np.testing.assert_allclose(sample.gyro_rad_s, GYRO_SCALE * np.array([0, 1, 2]))
    source.close()


def test_stamps_of_the_wall_clock_are_moved_and_others_are_refused(tmp_path: Path) -> None:
    device = Device(tmp_path, 0, "old", ("accel", "anglvel"))
    (device.folder / "current_timestamp_clock").unlink()
    source = IioImu(config(), root=tmp_path)
    before = time.monotonic_ns()
    device.push(time.time_ns(), 0, 0, 8192, 0, 0, 1)
    device.push(12345, 0, 0, 8192, 0, 0, 1)
    samples = read_all(source, 1)
    assert len(samples) == 1
    assert before - 50_000_000 < samples[0].t_ns < time.monotonic_ns() + 50_000_000
    assert source.counters()["stamps_far"] == 1
    assert source.health() & Health.CLOCK_STEP
    source.close()


def test_a_process_put_aside_moves_no_stamp_of_the_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    for at in range(1, 10):
        looks = itertools.count(1)

        def now_ns(looks: Iterator[int] = looks, at: int = at) -> int:
            look = next(looks)
            return 10**12 + look * 100 + (300_000_000 if look >= at else 0)

        fake = SimpleNamespace(monotonic_ns=now_ns, time_ns=lambda now=now_ns: now() + 7 * 10**17)
        monkeypatch.setattr(timing, "time", fake)
        assert abs(timing.wall_ahead_ns() - 7 * 10**17) < 1000, at


def test_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    device = Device(tmp_path, 0, "bmi270", ("accel", "anglvel"))
    source = IioImu(config(), root=tmp_path)
    device.push(time.monotonic_ns(), 0, 0, 8192, 0, 0, 1)
    assert len(read_all(source, 1)) == 1
    device.unplug()
    begin = time.monotonic()
    while time.monotonic() - begin < 0.3:
        assert source.read(0.1) == []
    word = source.health()
    assert word & Health.IMU_MISSING
    assert word & Health.GYRO_FAULT
    counters = source.counters()
    assert counters["gone"] == 1
    assert counters["open_failures"] < 20, "no busy loop"
    device = Device(tmp_path, 0, "bmi270", ("accel", "anglvel"))
    for _ in range(20):
        source.read(0.05)
        if source.counters().get("reopened"):
            break
    t_ns = time.monotonic_ns()
    device.push(t_ns - 5_000_000, 0, 0, 8192, 0, 0, 1)
    device.push(t_ns, 0, 0, 8192, 0, 0, 1)
    device.push(t_ns, 0, 0, 8192, 0, 0, 1)
    assert [s.t_ns for s in read_all(source, 2)] == [t_ns - 5_000_000, t_ns]
    assert source.counters()["stamps_backwards"] == 1
    source.health()
    source.close()


def test_what_cannot_be_used_says_so(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match=r"no device streams.*devices: none"):
        find_devices(tmp_path)
    Device(tmp_path, 0, "only_accel", ("accel",))
    with pytest.raises(HardwareError, match=r"devices: iio:device0\); load the chip's driver"):
        find_devices(tmp_path)
    both = Device(tmp_path, 1, "mpu6050", ("accel", "anglvel"))
    assert find_devices(tmp_path, "iio:device1") == [both.folder]
    with pytest.raises(HardwareError, match="no device icm streams"):
        find_devices(tmp_path, "icm")
    (both.folder / "in_accel_scale").unlink()
    with pytest.raises(HardwareError, match=r"has no scale of accel.*udev rule"):
        IioImu(config(), root=tmp_path)
    (both.folder / "in_accel_scale").write_text("nan")
    with pytest.raises(HardwareError, match="has no scale"):
        IioImu(config(), root=tmp_path)
    (both.folder / "in_accel_scale").write_text("0.001")
    (both.folder / "current_timestamp_clock").unlink()
    (both.folder / "current_timestamp_clock").symlink_to("/dev/null")
    with pytest.raises(HardwareError, match="stamps are of the clock ''"):
        IioImu(config(), root=tmp_path)
    (both.folder / "buffer/enable").unlink()
    (both.folder / "buffer").rmdir if False else shutil.rmtree(both.folder / "buffer")
    with pytest.raises(HardwareError, match="buffer/enable"):
        IioImu(config(), root=tmp_path)


@pytest.mark.parametrize("kind", ["", "le:s16", "le:s16/12>>0", "be:s24/24>>0", "le:s16/16X3>>0", "le:s16/16>>4", "xx"])
def test_types_that_are_none_are_refused(kind: str, tmp_path: Path) -> None:
    Device(tmp_path, 0, "odd", ("accel", "anglvel"), kind_type=kind)
    with pytest.raises(HardwareError, match="type"):
        IioImu(config(), root=tmp_path)


@given(st.integers(1, 64), st.integers(0, 63), st.booleans(), st.data())
def test_every_layout_of_bits_comes_out_right(bits: int, shift: int, signed: bool, data: st.DataObject) -> None:
    storage = next((s for s in (8, 16, 32, 64) if bits + shift <= s), None)
    if storage is None or (bits == 64 and not signed):
        return
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    value = data.draw(st.integers(low, high))
    junk = data.draw(st.integers(0, (1 << storage) - 1))
    mask = ((1 << bits) - 1) << shift
    word = (value << shift) & mask | junk & ~mask & (1 << storage) - 1
    element = Element.parsed("0", f"be:{'s' if signed else 'u'}{bits}/{storage}>>{shift}")
    assert element.values(np.array([word], dtype=f">u{storage // 8}")).tolist() == [value]
