"""The doctor's hardware half: what it finds, says and advises, on virtual boards and on a machine with nothing."""

import json
import os
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from vislam.cli import run_verb
from vislam.hw.doctor import HardwareReport, Wanted, examine
from vislam.hw.emulator import EmulatedBus, SteppedClock, VirtualAdxl345, emulated_board, emulated_bus, emulated_gy85
from worlds.capture import FakeCapture
from worlds.gy85 import driving, still


def examined(bus: EmulatedBus, clock: SteppedClock, seconds: float = 2.0, **options: Any) -> HardwareReport:
    with emulated_bus(bus):
        return examine(Wanted(i2c=bus.path), seconds, clock, **options)


def board(truth=still, **options: Any) -> tuple[EmulatedBus, SteppedClock]:  # type: ignore[no-untyped-def]
    clock = SteppedClock()
    return emulated_gy85(truth, clock.now_ns, stepped=clock, **{"seed": 2, **options}), clock


def said(report: HardwareReport, severity: str) -> str:
    return "\n".join(f"{f.what} -> {f.next_step}" for f in report.findings if f.severity == severity)


def test_a_good_board_is_approved_of_with_numbers(tmp_path: Path) -> None:
    report = examined(*board(), root=tmp_path)
    assert report.worst == "warning", "no port and no camera"
    assert {d.name for d in report.devices} == {"I2C", "ITG3205", "ADXL345", "HMC5883L or DA5883"}
    good = said(report, "ok")
    for words in ("ADXL345 passes", "HMC5883L passes", "gravity is measured as 9.8", "the field is 48 uT", "400 kHz"):
        assert words in good
    inertial = report.timings[0]
    assert inertial.rate_hz == pytest.approx(400.0, rel=2e-3)
    assert inertial.jitter_ms is not None
    assert inertial.jitter_ms < 0.2
    assert said(report, "warning").count("->") == 2


@pytest.mark.parametrize("kind", ["DA5883", "QMC5883L", "QMC5883P", "none"])
def test_clones_are_named(kind: str, tmp_path: Path) -> None:
    report = examined(*board(magnetometer=kind), root=tmp_path)
    text = said(report, "ok") + said(report, "warning")
    assert ("there is no magnetometer" if kind == "none" else f"the magnetometer is a {kind}") in text


def test_missing_chips_wires_and_other_chips_are_errors_when_the_bus_was_asked_for(tmp_path: Path) -> None:
    bus, clock = board()
    del bus.chips[0x68]
    report = examined(bus, clock, root=tmp_path)
    assert report.worst == "error"
    assert "no ITG3205 free to use -> check power" in said(report, "error")
    bus.chips.clear()
    assert "no ITG3205 and no ADXL345" in said(examined(bus, clock, root=tmp_path), "error")
    bus.is_stuck = True
    assert "held low" in said(examined(bus, clock, root=tmp_path), "error")
    bus.unplug()
    assert "cannot be opened" in said(examined(bus, clock, root=tmp_path), "error")


def test_a_chip_at_its_other_address_and_a_stranger(tmp_path: Path) -> None:
    bus, clock = board()
    bus.chips[0x1D] = bus.chips.pop(0x53)
    bus.chips[0x68].registers[0] = 0x71
    report = examined(bus, clock, root=tmp_path)
    assert "not at its usual address -> tie the chip's address pin" in said(report, "error")
    words = "0x71 in register 0x00: no ITG3205 or ICM-20948 or BMI270; 0x00 in register 0x75: no MPU-6050 or"
    assert any(f"unknown chip ({words}" in d.name for d in report.devices)


@pytest.mark.parametrize(("make", "address"), [(emulated_gy85, "0053"), (partial(emulated_board, "LSM6DSOX"), "006a")])
def test_a_chip_that_the_kernel_owns_is_left_alone(make: Any, address: str, tmp_path: Path) -> None:
    device = tmp_path / f"sys/bus/i2c/devices/7-{address}"
    driver = tmp_path / "sys/bus/i2c/drivers/its_driver"
    device.mkdir(parents=True)
    driver.mkdir(parents=True)
    (device / "driver").symlink_to(driver)
    clock = SteppedClock()
    report = examined(make(still, clock.now_ns, path="/dev/i2c-7", stepped=clock), clock, root=tmp_path)
    assert f"echo 7-{address} | sudo tee /sys/bus/i2c/drivers/its_driver/unbind" in said(report, "error")


def test_a_slow_bus_gets_the_line_for_the_boot_file(tmp_path: Path) -> None:
    clock = SteppedClock()
    bus = emulated_gy85(still, clock.now_ns, stepped=clock)
    slow = EmulatedBus(bus.chips, bus.path, stepped=clock, bus_hz=100_000.0)
    text = said(examined(slow, clock, root=tmp_path), "warning")
    assert "the bus runs at 100 kHz" in text
    assert "i2c_arm_baudrate=400000" in text
    assert "samples a second, 400 asked" in text


def test_faults_in_the_measured_seconds_are_explained(tmp_path: Path) -> None:
    bus, clock = board()
    bus.nack_every = 40
    text = said(examined(bus, clock, root=tmp_path), "warning")
    assert "nack: " in text
    assert "pull-ups" in text


def test_a_board_that_moves_or_is_broken_is_not_approved_of(tmp_path: Path) -> None:
    moving = said(examined(*board(truth=driving), root=tmp_path), "warning")
    assert "stand still and try again" in moving
    bus, clock = board()
    bus.chips[0x53] = VirtualAdxl345(still, clock.now_ns, self_test_g=(0.0, 0.0, 0.0))
    assert "ADXL345 fails its self-test" in said(examined(bus, clock, root=tmp_path), "warning")

    def heavy(t_ns: int):  # type: ignore[no-untyped-def]
        return (0.0, 0.0, 1.0), (0.0, 0.0, 11.0), (300.0, 0.0, 0.0), 30.0

    text = said(examined(*board(truth=heavy), root=tmp_path), "warning")
    assert "gravity is measured as 11.0" in text
    assert "the gyro's zero is at" in text
    assert "gives no samples" in text


def test_nothing_attached_is_told_without_an_error(tmp_path: Path) -> None:
    report = examine(Wanted(), 1.0, SteppedClock(), tmp_path)
    assert report.worst == "warning"
    text = said(report, "warning")
    for words in ("there is no I2C bus", "raspi-config", "no serial port", "no camera"):
        assert words in text
    (tmp_path / "sys/bus/i2c/devices/i2c-1").mkdir(parents=True)
    assert "sudo modprobe i2c-dev" in said(examine(Wanted(), 1.0, SteppedClock(), tmp_path), "warning")


def test_files_of_ports_and_cameras_are_listed_and_closed_ones_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dev").mkdir()
    for name in ("ttyUSB0", "video0"):
        (tmp_path / "dev" / name).touch()
    label = tmp_path / "sys/class/video4linux/video0/name"
    label.parent.mkdir(parents=True)
    label.write_text("HP Wide Vision HD Camera\n")
    assert examine(Wanted(), 1.0, SteppedClock(), tmp_path).devices[-1].name == "HP Wide Vision HD Camera"
    real = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: False if "video0" in str(path) else real(path, mode))
    text = said(examine(Wanted(), 1.0, SteppedClock(), tmp_path), "warning")
    assert "you may not open it -> sudo usermod -aG" in text


def test_a_camera_that_is_asked_for_is_measured_and_its_settings_compared(tmp_path: Path) -> None:
    device = tmp_path / "dev" / "video0"
    device.parent.mkdir()
    device.touch()
    report = examine(Wanted(camera=str(device)), 0.5, None, tmp_path, open_capture=lambda _: FakeCapture())
    assert report.timings[0].count > 0
    assert "focus: asked 0.0, the camera does not offer it" in said(report, "warning")
    missing = examine(Wanted(camera=str(tmp_path / "dev" / "video9")), 0.5, None, tmp_path)
    assert missing.worst == "error"
    assert "there is no camera" in said(missing, "error")


def test_the_verb(capsys: pytest.CaptureFixture[str]) -> None:
    with emulated_bus(emulated_gy85(still, time.monotonic_ns, seed=2)) as bus:
        assert run_verb(["doctor", "--i2c", bus.path, "--seconds", "0.5", "--json"]) == 0
        answer = json.loads(capsys.readouterr().out)
        assert {d["name"] for d in answer["devices"]} >= {"ITG3205", "ADXL345"}
        assert answer["timings"][0]["count"] > 5  # 100 on an idle machine
        assert run_verb(["doctor", "--i2c", bus.path, "--seconds", "0.5"]) == 0
        assert "passes its self-test" in capsys.readouterr().out
    assert run_verb(["doctor", "--i2c", bus.path]) == 5
    assert "cannot be opened" in capsys.readouterr().out
    assert run_verb(["doctor", "--serial", "/dev/absent"]) == 5
    assert run_verb(["doctor", "--camera", "/dev/absent"]) == 5
    assert run_verb(["doctor", "sim:corridor-loop", "--i2c", "/dev/i2c-1"]) == 2
    assert run_verb(["doctor", "--seconds", "0"]) == 2
