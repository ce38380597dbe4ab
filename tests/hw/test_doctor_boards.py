"""What the doctor says of boards with a FIFO, and how verbs name them."""

import errno
import json
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import BoardConfig, Config, SensorsConfig
from vislam.core.errors import HardwareError, UsageError
from vislam.hw.board_check import check_board
from vislam.hw.chips import BusError, I2cBus, identify
from vislam.hw.chips.known import KNOWN_IMUS
from vislam.hw.chips.mpu6050 import Mpu6050
from vislam.hw.doctor import HardwareReport, Wanted, _listen, examine
from vislam.hw.emulator import EmulatedBus, SensorError, SteppedClock, VirtualMpu6050, emulated_board, emulated_bus
from vislam.hw.emulator.board import _KINDS
from vislam.hw.emulator.bridge import BridgeEmulator, at_rest
from vislam.hw.fifo_board import FifoBoard
from vislam.hw.health import Health
from vislam.hw.sensors import CHIPS, INERTIAL_KINDS, check_devices, open_inertial, rate_of, with_raw_samples
from vislam.live.sources import open_live
from vislam.runs.record import record
from vislam.runs.sources import recorded_path
from waiting import until_it_holds
from worlds.fifo_boards import FIRMWARE
from worlds.gy85 import driving, still


def examined(kind: Any, root: Path, truth: Any = still, **options: Any) -> HardwareReport:
    clock = SteppedClock()
    bus = emulated_board(kind, truth, clock.now_ns, stepped=clock, **{"seed": 2, **options})
    with emulated_bus(bus):
        return examine(Wanted(i2c=bus.path), 2.0, clock, root=root)


def said(report: HardwareReport, severity: str) -> str:
    return "\n".join(f"{f.what} -> {f.next_step}" for f in report.findings if f.severity == severity)


@pytest.mark.parametrize("kind", ["LSM6DSOX", "ISM330DHCX", "MPU-6050", "MPU-9250", "ICM-20948"])
def test_a_good_board_is_approved_of_with_its_stamps_and_with_what_it_has_not_met(kind: str, tmp_path: Path) -> None:
    report = examined(kind, tmp_path)
    assert report.worst == "warning", "no port, no camera, no magnetometer"
    assert kind in {d.name for d in report.devices}
    good = said(report, "ok")
    for words in (
        "gravity is measured as 9.8", "400 kHz", "the gyro has 30.0", "from the counts of its FIFO, known to about 0.",
        "has not met a real chip",
    ):  # fmt: skip
        assert words in good
    timing = report.timings[0]
    assert timing.rate_hz == pytest.approx(200.0, rel=0.15)
    assert timing.jitter_ms is not None
    assert timing.jitter_ms < 0.1
    if kind in ("MPU-9250", "ICM-20948"):
        assert "the magnetometer is a AK" in good
        assert "the field is 4" in good


@pytest.mark.parametrize(("option", "at"), [("--serial", ""), ("--imu", "serial:")])
def test_a_bridge_says_which_chip_it_has(
    option: str, at: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BridgeEmulator(tmp_path / "tty", at_rest, seed=1, board="MPU-6050"):
        arguments = ["doctor", option, f"{at}{tmp_path / 'tty'}", "--seconds", "1", "--serial.start-s", "30", "--json"]
        assert run_verb(arguments) == 0
    told = json.loads(capsys.readouterr().out)
    assert {"kind": "chips", "path": f"{at}{tmp_path / 'tty'}", "name": "MPU-6050"} in told["devices"]
    good = "\n".join(finding["what"] for finding in told["findings"] if finding["severity"] == "ok")
    for words in ("gravity is measured as 9.8", "stamped by the board's clock"):
        assert words in good


@pytest.mark.parametrize("in_file", [False, True])
def test_the_doctor_sends_a_bmi270_its_configuration(
    in_file: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bus = emulated_board("BMI270", still, time.monotonic_ns, seed=2)
    (tmp_path / "cart.toml").write_text(f'[board]\nfirmware = "{FIRMWARE}"\n')
    told = ["--config", str(tmp_path / "cart.toml")] if in_file else ["--board.firmware", str(FIRMWARE)]
    with emulated_bus(bus):
        assert run_verb(["doctor", "--i2c", bus.path, "--seconds", "1"]) == HardwareError.exit_code
        assert "name bmi270_maximum_fifo.c" in capsys.readouterr().out
        assert run_verb(["doctor", "--i2c", bus.path, "--seconds", "2", *told]) == 0
    assert "gravity is measured as 9.8" in capsys.readouterr().out


def test_everything_on_the_bus_is_listed(tmp_path: Path) -> None:
    report = examined("LSM6DSOX", tmp_path, magnetometer="LIS3MDL")
    assert {d.name for d in report.devices} == {"I2C", "LSM6DSOX", "LIS3MDL"}
    assert "the magnetometer is a LIS3MDL" in said(report, "ok")


def test_ids_are_read_again_where_a_wire_was_disturbed() -> None:
    clock = SteppedClock()
    bus = emulated_board("ICM-20948", still, clock.now_ns)
    with emulated_bus(bus):
        for every in (3, 4, 5, 7, 11):
            bus.nack_every = every
            assert [chip.name for chip in identify(I2cBus(bus.path, 0.02))] == ["ICM-20948"]


def test_a_board_that_moves_is_not_approved_of(tmp_path: Path) -> None:
    assert "stand still and try again" in said(examined("LSM6DSOX", tmp_path, driving), "warning")

    def turning(t_ns: int):  # type: ignore[no-untyped-def]
        return (0.0, 0.0, 0.3), (0.0, 0.0, 9.8), (20.0, 0.0, -42.0), 30.0

    assert "10 allowed" in said(examined("LSM6DSOX", tmp_path, turning), "warning")


def test_a_clone_is_stated_and_measured_as_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(_KINDS, "MPU-6050", (VirtualMpu6050, 0x98, 0x68, 0.005, 400.0))
    path = "/dev/i2c-emulated"
    stated = said(examined("MPU-6050", tmp_path), "error")
    assert "the chip is likely a clone of the MPU-6050 (0x98 in register 0x75)" in stated
    assert f"vislam doctor --imu mpu6050-clone:{path}" in stated
    assert "ITG3205" not in stated
    clock = SteppedClock()
    bus = emulated_board("MPU-6050", still, clock.now_ns, stepped=clock, seed=2)
    config = BoardConfig(chip="mpu6050", bus=path)
    with emulated_bus(bus), closing(FifoBoard(config, clock, named="mpu6050-clone")) as board:
        findings = check_board(board, *_listen(board, 1.0, clock), path)
    good = "\n".join(f.what for f in findings if f.severity == "ok")
    assert "MPU-6050 clone 0x98 passes its self-test: a clone, taken for an MPU-6500; gravity is 9.8" in good
    assert "MPU-6050 clone 0x98 passes its self-test: the gyroscope responds with 1.00 1.00 1.00 of its trim" in good
    assert "gravity is measured as 9.8" in good


@pytest.mark.parametrize(
    ("who_am_i", "named", "lsb"), [(0x98, "mpu6050-clone", "1389 LSB, 2781"), (0x68, "mpu6050", "2146 LSB, 4289")]
)
def test_a_gyroscope_of_half_the_scale_is_a_fault(who_am_i: int, named: str, lsb: str) -> None:
    clock = SteppedClock()
    noise = SensorError(density=(4e-3, 4e-3, 4e-3))  # without noise a sensor would be a hung one
    half = SensorError(scale=(0.5, 0.5, 0.5), density=(2e-4, 2e-4, 2e-4))
    bus = EmulatedBus({0x68: VirtualMpu6050(still, clock.now_ns, half, noise, who_am_i=who_am_i)}, stepped=clock)
    with emulated_bus(bus), closing(FifoBoard(BoardConfig(bus=bus.path), clock, named=named)) as board:
        findings = check_board(board, *_listen(board, 0.3, clock), bus.path)
        assert board.health() == Health.GYRO_FAULT | Health.ACCEL_FAULT, "nothing else comes of the test"
    (found,) = [f for f in findings if "fails its self-test" in f.what]
    assert f"gyroscope's scale is off: x 0.50 of its trim ({lsb} asked), y 0.50" in found.what
    assert found.next_step == "vislam calibrate imu"


@pytest.mark.parametrize("every", [5, 9, 23])
def test_a_self_test_on_a_disturbed_bus_leaves_the_settings(every: int) -> None:
    clock = SteppedClock()
    bus = emulated_board("MPU-6050", still, clock.now_ns, stepped=clock)
    with emulated_bus(bus), closing(FifoBoard(BoardConfig(bus=bus.path), clock)) as board:
        bus.nack_every = every
        assert board.run_self_tests() == ()
        bus.nack_every = 0
        forces = [np.linalg.norm(s.accel_m_s2) for s in _listen(board, 1.5, clock)[0]]
        assert len(forces) > 100
        np.testing.assert_allclose(forces, 9.8, atol=0.4)
        assert bytes(bus.chips[0x68].registers[0x19:0x1D]) == bytes((4, 2, 0x08, 0x10))
        assert [test.passed for test in board.run_self_tests()] == [True]


def test_a_clone_is_tested_again_where_a_wire_was_disturbed(monkeypatch: pytest.MonkeyPatch) -> None:
    once, own = [OSError(errno.EREMOTEIO, "no acknowledge")], Mpu6050.self_test

    def disturbed(imu: Mpu6050, clock: Any) -> Any:
        if once:
            raise BusError("/dev/i2c-emulated", once.pop())
        return own(imu, clock)

    monkeypatch.setattr(Mpu6050, "self_test", disturbed)
    clock = SteppedClock()
    bus = EmulatedBus({0x68: VirtualMpu6050(still, clock.now_ns, who_am_i=0x98)}, stepped=clock)
    with emulated_bus(bus), closing(FifoBoard(BoardConfig(bus=bus.path), clock, named="mpu6050-clone")) as board:
        assert ["gravity" in test.what for test in board.self_tests] == [True, False]


@pytest.mark.parametrize(
    ("gravity", "outcome"), [(4.9, "refused"), (19.6, "refused"), (0.0, "refused"), (9.81, "ok"), (None, "moves")]
)
def test_gravity_decides_whether_the_scale_of_a_clone_fits(
    gravity: float | None, outcome: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(_KINDS, "MPU-6050", (VirtualMpu6050, 0x98, 0x68, 0.005, 400.0))

    def truth(t_ns: int):  # type: ignore[no-untyped-def]
        force = 9.81 + 5.0 * np.sin(t_ns * 1e-8) if gravity is None else gravity
        return (0.0, 0.0, 0.0), (0.0, 0.0, force), (20.0, 0.0, -42.0), 30.0

    clock = SteppedClock()
    with emulated_bus(emulated_board("MPU-6050", truth, clock.now_ns, stepped=clock, seed=2)):
        if outcome == "refused":
            with pytest.raises(
                HardwareError, match=rf"clone 0x98 does not fit.*gravity is {gravity:.1f}.*another board"
            ):
                FifoBoard(BoardConfig(bus="/dev/i2c-emulated"), clock, named="mpu6050-clone")
            return
        with closing(FifoBoard(BoardConfig(bus="/dev/i2c-emulated"), clock, named="mpu6050-clone")) as board:
            test, own = board.self_tests
            assert test.passed is own.passed is (True if outcome == "ok" else None)
            assert ("start it at rest" in test.what) == (outcome == "moves")


@pytest.mark.parametrize("named", ["board", "lsm6dsox", "lsm6dso32"])
def test_an_lsm6dso32_is_told_by_gravity_or_asked_for(named: str) -> None:
    clock = SteppedClock()

    def turning(t_ns: int):  # type: ignore[no-untyped-def]
        force = (0.01 * np.sin(t_ns * 1e-8), 0.0, 9.80665)  # without noise a sensor at rest is a hung chip
        return driving(t_ns)[0], force, *still(t_ns)[2:]

    bus = emulated_board("LSM6DSO32", turning, clock.now_ns, stepped=clock, seed=2, grade="exact", magnetometer="none")
    with emulated_bus(bus), closing(FifoBoard(BoardConfig(bus=bus.path), clock, named=named)) as board:
        forces = [s.accel_m_s2 for s in _listen(board, 1.0, clock)[0]]
        assert np.linalg.norm(np.mean(forces, axis=0)) == pytest.approx(9.81, abs=0.02)
        assert board.imu is not None
        assert board.imu.name == "LSM6DSO32"
        assert board.imu.accel_m_s2 == pytest.approx(0.244e-3 * 9.80665), "8 g, as asked"
        assert [test.passed for test in board.self_tests] == [True]
    other = emulated_board("ISM330DHCX", still, clock.now_ns, stepped=clock)
    with emulated_bus(other), pytest.raises(HardwareError, match="asked for, the chip is an ISM330DHCX"):
        FifoBoard(BoardConfig(bus=other.path), clock, named="lsm6dso32")


def test_names_of_a_command_line_are_families_that_there_are() -> None:
    families = {known.chip for known in KNOWN_IMUS}
    assert {family for family in CHIPS.values() if family} == families
    for known in KNOWN_IMUS:
        assert known.chip in CHIPS
    assert set(INERTIAL_KINDS) > set(CHIPS)


def test_a_board_is_opened_by_its_name_and_the_settings(tmp_path: Path) -> None:
    config = SensorsConfig(board=BoardConfig(rate_hz=100.0))
    with emulated_bus(emulated_board("LSM6DSOX", still, time.monotonic_ns, path="/dev/i2c-9")):
        for name in ("board:/dev/i2c-9", "lsm6dsox:/dev/i2c-9", "ism330dhcx:/dev/i2c-9"):
            source = open_inertial(name, config)
            try:
                assert source.rate_hz == pytest.approx(104.0, rel=0.01)
                assert rate_of(name, config) == 100.0
            finally:
                source.close()
            check_devices(name, "none", config)
        with pytest.raises(HardwareError, match="no mpu6050 answers"):
            open_inertial("mpu9250:/dev/i2c-9", config)
    with pytest.raises(HardwareError, match="cannot be opened"):
        check_devices("board:/dev/i2c-absent", "none", config)
    with pytest.raises(UsageError, match=r"no IMU called 'bmi160'.*lsm6dsox"):
        open_inertial("bmi160", config)
    assert recorded_path("lsm6dsox:/dev/i2c-1+webcam") is None


def test_live_takes_a_board_and_its_calibration() -> None:
    biased = BoardConfig(calibration=SensorsConfig().board.calibration)
    source, _ = open_live("mpu9250+none", Config(), SensorsConfig(board=biased))
    assert source.rig.is_blind
    assert source.imu_noise is not None
    assert source.imu_noise.rate_hz == 200.0
    assert with_raw_samples(SensorsConfig()).board.calibration == biased.calibration
    with pytest.raises(UsageError, match=r"no live source.*lsm6dsox"):
        open_live("bmi160+none", Config(), SensorsConfig())


def test_a_board_is_recorded(tmp_path: Path) -> None:
    from vislam.config import RecordConfig

    with emulated_bus(emulated_board("ICM-20948", still, time.monotonic_ns)) as bus:
        recorded = record(
            tmp_path / "r", f"board:{bus.path}", "none", SensorsConfig(), RecordConfig(), **until_it_holds(imu=60)
        )
    assert sum(recorded.counts.values()) > 50
    assert any("stamped by the chip's clock" in note for note in recorded.notes)
    rows = np.loadtxt(tmp_path / "r/mav0/imu0/data.csv", delimiter=",", comments="#")
    assert (np.diff(rows[:, 0]) > 0).all()
    np.testing.assert_allclose(rows[:, 4:7].mean(axis=0), [0.0, 0.0, 9.8], atol=0.3)


def test_the_verb_measures_an_imu_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    with emulated_bus(emulated_board("MPU-6050", still, time.monotonic_ns, seed=2)) as bus:
        assert run_verb(["doctor", "--imu", f"mpu6050:{bus.path}", "--seconds", "2", "--json"]) == 0
        answer = json.loads(capsys.readouterr().out)
        assert answer["timings"][0]["count"] > 20
        assert any("FIFO" in finding["what"] for finding in answer["findings"])
    assert run_verb(["doctor", "--imu", "mpu6050:/dev/absent"]) == 5
    assert "cannot be opened" in capsys.readouterr().out
    assert run_verb(["doctor", "--imu", "nothing"]) == 2
    assert run_verb(["doctor", "sim:corridor-loop", "--imu", "board"]) == 2
