"""The bridge's driver over a real pseudo-terminal and the real pyserial, with every fault of boards and cables."""

import errno
import math
import os
import resource
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vislam.config import BridgeClockConfig, SensorCalibration, SerialConfig
from vislam.core.errors import HardwareError
from vislam.core.messages import ImuSample, MagSample
from vislam.hw.bridge import protocol
from vislam.hw.bridge.behind import Behind
from vislam.hw.bridge.bridge import FrameGaps, SerialBridge
from vislam.hw.bridge.protocol import Chips
from vislam.hw.emulator import SensorError
from vislam.hw.emulator import bridge as emulator
from vislam.hw.emulator.bridge import BridgeEmulator, LineFaults, at_rest, bridged
from vislam.hw.health import Health
from vislam.hw.serial_port import why_not_open
from waiting import HUNG_S

EXACT = (SensorError(), SensorError(), SensorError(density=(0.02, 0.02, 0.02)))  # a field without noise is a hung chip
PERIOD_NS = 2_500_000


@pytest.fixture
def config(tmp_path: Path) -> SerialConfig:
    """Patience of tests: a gap of seconds is no fault of the bridge on a busy machine."""
    clock = BridgeClockConfig(settle_s=0.2, bin_s=0.05)
    return SerialConfig(port=str(tmp_path / "tty"), start_s=HUNG_S, reopen_s=0.05, missing_s=HUNG_S, clock=clock)


@pytest.fixture
def board(config: SerialConfig) -> Iterator[BridgeEmulator]:
    with BridgeEmulator(Path(config.port), at_rest, drift=0.01) as running:
        yield running


def collect(bridge: SerialBridge, enough: Callable[[list], bool]) -> list[ImuSample | MagSample]:
    """Read until there is enough, for a time that only a broken driver needs."""
    found: list[ImuSample | MagSample] = []
    end = time.monotonic() + HUNG_S
    while not enough(found):
        assert time.monotonic() < end, f"{bridge.problem} {bridge.counters()}"
        found += bridge.read(0.05)
    return found


def imu(samples: list) -> list[ImuSample]:
    return [sample for sample in samples if isinstance(sample, ImuSample)]


def swinging(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
    """A motion that tells its time: 1 ms too late is 12 mrad/s off at most."""
    phase = 2.0 * math.pi * 2.0 * (t_ns % 500_000_000) * 1e-9
    return (math.sin(phase), math.cos(phase), 0.5), (1.0, _step(t_ns) - 2.0, 9.8), (20.0, -10.0, -43.0), 31.0


def _step(t_ns: int) -> float:
    """A count and a half of an ADXL345 every 10 ms: a sensor that has neither motion nor noise is a hung chip."""
    return 0.057 * (t_ns // 10_000_000 % 2)


def trembling(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
    """At rest but for a count or two."""
    return (0.002 * (t_ns // 10_000_000 % 2), 0.0, 0.0), (_step(t_ns), 0.0, 9.80665), *at_rest(t_ns)[2:]


def test_samples_are_calibrated_and_stamped_at_capture(config: SerialConfig) -> None:
    calibration = SensorCalibration(
        gyro_axes=("-y", "x", "z"), mag_axes=("y", "-x", "z"), gyro_bias_rad_s=(0.0, 0.0, 0.1),
        accel_matrix=((1.1, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    )  # fmt: skip
    with BridgeEmulator(Path(config.port), swinging, drift=-0.02, errors=EXACT):
        bridge = SerialBridge(replace(config, calibration=calibration))
        assert bridge.rate_hz == 400.0
        samples = collect(bridge, lambda found: len(found) > 900)
        assert bridge.temperature_c == pytest.approx(31.0, abs=0.1)
        bridge.close()
    late_rad_s = []
    for sample in imu(samples)[300:]:
        (x, y, z), _, _, _ = swinging(sample.t_ns)
        late_rad_s.append(max(abs(sample.gyro_rad_s - [-y, x, z - 0.1])))
        assert sample.accel_m_s2[[0, 2]] == pytest.approx([1.1, 9.8], abs=0.03)
        assert -2.03 < sample.accel_m_s2[1] < -2.0 + 0.057 + 0.03
    assert np.median(late_rad_s) < 0.02
    fields = [sample for sample in samples if isinstance(sample, MagSample)]
    assert len(fields) == pytest.approx(900 / 9, abs=30)
    assert np.mean([s.field_ut for s in fields], axis=0) == pytest.approx([-10.0, -20.0, -43.0], abs=0.06)


def rocking(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
    """A motion in which gyro and accelerometer tell their time."""
    phase = 2.0 * math.pi * 2.0 * (t_ns % 500_000_000) * 1e-9
    return (math.sin(phase), math.cos(phase), 0.5), (5.0 * math.sin(phase), -2.0, 9.8), (20.0, -10.0, -43.0), 31.0


def late_ms(told: np.ndarray, slope: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return by how much each sample was taken before its stamp, from where the slope is steep."""
    steep = abs(slope) > 0.5 * abs(slope).max()
    return (true - told)[steep] / slope[steep] * 1e3


@pytest.mark.parametrize("name", ["MPU-6050", "MPU-6500", "MPU-9250", "MPU-9255"])
def test_an_mpu_gives_right_units_at_the_right_time(config: SerialConfig, name: str) -> None:
    with BridgeEmulator(Path(config.port), rocking, drift=-0.02, errors=EXACT, board=name):
        bridge = SerialBridge(config)
        samples = collect(bridge, lambda found: len(found) > 900)
        assert bridge.temperature_c == pytest.approx(31.0, abs=0.1)
        assert bridge.board_name == (f"{name}, AK8963" if name in ("MPU-9250", "MPU-9255") else name)
        word, counts = bridge.health(), bridge.counters()
        bridge.close()
    assert word & (Health.MAG_FAULT | Health.GYRO_FAULT | Health.ACCEL_FAULT) == 0  # without a magnetometer as well
    assert counts.get("before_hello", 0) == 0
    found = imu(samples)[300:]
    truth = [rocking(sample.t_ns) for sample in found]
    rates, forces = np.array([t[0] for t in truth]), np.array([t[1] for t in truth])
    gyro, accel = np.array([s.gyro_rad_s for s in found]), np.array([s.accel_m_s2 for s in found])
    assert gyro[:, 2] == pytest.approx(rates[:, 2], abs=1e-3)
    assert accel[:, 1:] == pytest.approx(forces[:, 1:], abs=3e-3)
    slope = 4.0 * math.pi * rates[:, 1]
    of_gyro, of_accel = (
        late_ms(*of) for of in ((gyro[:, 0], slope, rates[:, 0]), (accel[:, 0], 5 * slope, forces[:, 0]))
    )
    print(f"{name}: gyro {np.median(of_gyro):.2f} ms late, {np.std(of_gyro):.2f} rms; accel {np.median(of_accel):.2f}")
    assert abs(np.median(of_gyro)) < 1.6  # of the host's clock, on a busy machine
    assert np.median(of_accel) - np.median(of_gyro) == pytest.approx(0.0, abs=0.15)  # whatever the host does
    if "AK8963" in bridge.board_name:
        fields = [sample for sample in samples if isinstance(sample, MagSample)]
        assert np.mean([s.field_ut for s in fields], axis=0) == pytest.approx([20.0, -10.0, -43.0], abs=0.1)


def test_an_mpu_in_the_place_of_a_gy85_is_never_read_in_its_units(config: SerialConfig) -> None:
    with BridgeEmulator(Path(config.port), trembling, errors=EXACT):
        bridge = SerialBridge(config)
        samples = imu(collect(bridge, lambda found: len(imu(found)) > 100))
    with BridgeEmulator(Path(config.port), trembling, errors=EXACT, board="MPU-6050") as board:
        samples += imu(collect(bridge, lambda found: len(imu(found)) > 100))
        board.unplug()
        collect(bridge, lambda _: bridge.counters().get("port_lost", 0) > 1)
        board.plug()
        samples += imu(collect(bridge, lambda found: len(imu(found)) > 100))
        assert bridge.board_name == "MPU-6050"
    bridge.close()
    assert np.array([s.accel_m_s2 for s in samples])[:, 2] == pytest.approx(9.807, abs=0.03)


def test_a_chip_that_the_sketch_does_not_know_is_named(config: SerialConfig) -> None:
    with (
        BridgeEmulator(Path(config.port), at_rest, board="stranger"),
        pytest.raises(HardwareError, match=r"a chip with the id 0x98, and the sketch knows MPU-6050 0x68"),
    ):
        SerialBridge(replace(config, start_s=3.0))


def test_counts_of_an_mpu_wait_until_it_is_known_how_old_they_are() -> None:
    board = bridged("MPU-9250")
    assert board.ages is not None
    behind = Behind(SerialConfig())
    behind.greet(board.hello)
    assert not behind.is_known
    other = bridged("MPU-6050")
    assert other.ages is not None
    behind.take(other.ages)  # of the chip before
    assert not behind.is_known
    behind.take(board.ages)
    assert behind.is_known
    behind.greet(bridged("GY-85").hello)
    assert behind.is_known  # its filters are in the settings
    assert behind.name == "ADXL345, ITG3205, HMC5883L"


def test_no_wrong_sample_passes_a_bad_cable(config: SerialConfig) -> None:
    with BridgeEmulator(Path(config.port), trembling, seed=1, errors=EXACT) as board:
        bridge = SerialBridge(config)
        right = imu(collect(bridge, lambda found: len(imu(found)) > 20))
        board.faults = LineFaults(dropped=0.002, flipped=0.002)
        samples = imu(collect(bridge, lambda found: len(found) > 800))
        word, counts = bridge.health(), bridge.counters()
        bridge.close()
    assert counts["bad_frames"] > 20
    assert counts["frames_lost"] > 20
    assert Health.BUS_FAULT | Health.IMU_GAP in word
    rates, forces = ({tuple(getattr(s, of)) for s in right} for of in ("gyro_rad_s", "accel_m_s2"))
    assert (len(rates), len(forces)) == (2, 2)
    for sample in samples:
        assert tuple(sample.gyro_rad_s) in rates
        assert tuple(sample.accel_m_s2) in forces
    assert (np.diff([sample.t_ns for sample in samples]) > 0).all()


def test_an_unplugged_board_is_missed_and_taken_back(config: SerialConfig, board: BridgeEmulator) -> None:
    bridge = SerialBridge(replace(config, missing_s=0.05))
    before = imu(collect(bridge, lambda found: len(found) > 100))
    board.unplug()
    end = time.monotonic() + HUNG_S
    while bridge.counters().get("port_lost", 0) == 0:
        assert time.monotonic() < end
        bridge.read(0.05)
    assert bridge.read(0.2) == []
    assert Health.IMU_MISSING in bridge.health()
    assert "no port" in bridge.problem
    bridge.close()  # a caller may close what is gone
    board.plug()
    after = imu(collect(bridge, lambda found: len(found) > 100))
    assert after[0].t_ns > before[-1].t_ns
    assert bridge.problem == ""
    assert bridge.counters()["opened"] == 2
    assert Health.CLOCK_STEP in bridge.health()
    bridge.close()
    bridge.close()


def test_a_restarted_board_gets_a_new_clock_at_once(config: SerialConfig, board: BridgeEmulator) -> None:
    bridge = SerialBridge(config)
    samples = collect(bridge, lambda found: len(found) > 300)
    board.restart()
    samples += collect(bridge, lambda found: len(found) > 300)
    counts, word = bridge.counters(), bridge.health()
    bridge.close()
    assert counts["device_restarts"] == 1
    assert counts["clock_steps"] >= 1
    assert counts.get("frames_lost", 0) < 300  # what was before the restart is not missing
    assert Health.CLOCK_STEP in word
    assert (np.diff([sample.t_ns for sample in imu(samples)]) > 0).all()


def frame(sequence: int, t_us: int) -> protocol.RawSample:
    return protocol.RawSample(
        sequence, t_us, protocol.Status(0), (sequence % 2, 0, 256), (sequence % 2, 0, 0), (0, 0, 0), 0
    )


@pytest.mark.parametrize("up_us", [20_000_000, 3_000_000_000])
def test_what_a_restarted_board_sends_before_its_hello_is_not_lost(up_us: int) -> None:
    gaps = FrameGaps()
    for sent, arrival_ms, lost in (
        (frame(10295, up_us), 1000, 0),
        (frame(10296, up_us + 2500), 1002, 0),
        (frame(10299, up_us + 10_000), 1010, 2),
        (frame(0, 300_000), 3010, None),
        (frame(1, 302_500), 3012, 0),
        (frame(3, 307_500), 3017, 1),
    ):
        assert gaps.before(sent, arrival_ms * 1_000_000) == lost


def test_frames_lost_while_the_host_was_put_aside_are_counted() -> None:
    gaps = FrameGaps()
    assert gaps.before(frame(10296, 2**32 - 2500), 9_000_000_000) == 0
    assert gaps.before(frame(13796, 8_000_000), 9_000_000_000) == 3499, "8 s of a clock that wraps"


class ReadBoard:
    """A board at rest whose port keeps 1.6 s; its time passes as it is read, so load delays no arrival."""

    def __init__(self) -> None:
        self.now_ns, self._due_ns, self._sequence = 10**12, 10**12, 0

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        """Is asked for by the driver."""

    def reset_input_buffer(self) -> None:
        self._kept()

    def restart(self) -> None:
        self._sequence = 0

    def received(self, _descriptor: int, _timeout_s: float) -> bytes:
        self.now_ns = max(self.now_ns, self._due_ns)
        return self._kept()

    def _kept(self) -> bytes:
        frames = []
        while self._due_ns <= self.now_ns:
            t_us = round(self._sequence * PERIOD_NS * 1.01) // 1000  # its clock runs fast
            sample = frame(self._sequence, t_us)
            hello = replace(bridged("GY-85").hello, sequence=0, t_us=0, chips=Chips(7) | Chips.STARTED)
            frames.append(sample if self._sequence else hello)
            self._sequence, self._due_ns = self._sequence + 1, self._due_ns + PERIOD_NS
        return b"".join(map(protocol.encode, frames[:640]))


@pytest.fixture
def read_board(monkeypatch: pytest.MonkeyPatch) -> ReadBoard:
    board = ReadBoard()
    monkeypatch.setattr("serial.Serial", lambda *_, **__: board)
    monkeypatch.setattr("vislam.hw.serial_port.received", board.received)
    monkeypatch.setattr("vislam.hw.bridge.bridge.time", SimpleNamespace(monotonic_ns=lambda: board.now_ns))
    return board


@pytest.mark.parametrize("began_again", [False, True])
def test_a_host_that_was_busy_stamps_as_if_it_had_not_been(
    config: SerialConfig, read_board: ReadBoard, began_again: bool
) -> None:
    bridge = SerialBridge(config)
    before = imu(collect(bridge, lambda found: len(found) > 300))
    if began_again:
        read_board.restart()
    read_board.now_ns += 200_000_000
    after = imu(collect(bridge, lambda found: len(found) > 300))
    assert bridge.counters().get("frames_lost", 0) == 0
    samples = after if began_again else [*before, *after]
    assert np.diff([sample.t_ns for sample in samples]) == pytest.approx(PERIOD_NS, rel=1e-3)
    assert after[-1].t_ns == pytest.approx(read_board.now_ns, abs=2 * PERIOD_NS)


def test_what_lay_in_the_port_for_long_bends_no_stamp_and_is_counted(
    config: SerialConfig, read_board: ReadBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As at the begin of a live run, whose other processes take longer to start."""
    monkeypatch.setattr("vislam.hw.bridge.bridge._STALE_NS", 500_000_000)
    bridge = SerialBridge(config)
    before = imu(collect(bridge, lambda found: len(imu(found)) > 10))
    read_board.now_ns += 2_500_000_000
    after = imu(collect(bridge, lambda found: len(imu(found)) > 300))
    lost, opened = bridge.counters()["frames_lost"], bridge.counters()["opened"]
    assert opened == 1, "that would restart an Arduino"
    assert lost == pytest.approx((after[0].t_ns - before[-1].t_ns) / PERIOD_NS, abs=2)
    assert after[-1].t_ns == pytest.approx(read_board.now_ns, abs=2 * PERIOD_NS)
    assert np.diff([sample.t_ns for sample in after]) == pytest.approx(PERIOD_NS, rel=1e-3)


def test_a_port_that_is_not_there_is_named_at_once(config: SerialConfig) -> None:
    with pytest.raises(HardwareError, match=r"there is no port .*tty; there are: "):
        SerialBridge(config)


def test_a_board_may_come_later(config: SerialConfig) -> None:
    config = replace(config, missing_s=0.05)
    bridge = SerialBridge(config, must_be_there=False)
    assert bridge.read(0.12) == []
    assert bridge.counters()["open_failures"] >= 2
    assert Health.IMU_MISSING in bridge.health()
    with BridgeEmulator(Path(config.port), at_rest):
        collect(bridge, lambda found: len(imu(found)) > 10)
    bridge.close()


@pytest.mark.parametrize(
    ("faults", "problem", "counter"),
    [
        (LineFaults(silent=True), "is silent", "silent"),
        (LineFaults(garbage=True), "another rate than 500000 baud", "no_valid_frame"),
        (LineFaults(no_gyro=True), "no answer from the gyro", "gyro_errors"),
        (LineFaults(no_gyro=True, no_accel=True), "no answer from the accelerometer and the gyro", "accel_errors"),
    ],
)
def test_what_keeps_samples_from_coming_is_said(
    config: SerialConfig, board: BridgeEmulator, faults: LineFaults, problem: str, counter: str
) -> None:
    board.faults = faults
    short = replace(config, start_s=3.0, missing_s=0.05)
    with pytest.raises(HardwareError, match=problem):
        SerialBridge(short)
    patient = SerialBridge(short, must_be_there=False)
    collect(patient, lambda _: patient.counters().get(counter, 0) > 0)
    assert Health.IMU_MISSING in patient.health()
    board.faults = LineFaults()
    collect(patient, lambda found: len(imu(found)) > 10)
    patient.close()


def test_a_sketch_of_another_version_is_refused(
    config: SerialConfig, board: BridgeEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    def encode_as_2(message: protocol.RawSample | protocol.Hello) -> bytes:
        body = bytearray(protocol.unstuff(protocol.encode(message)[:-1]) or b"")
        if isinstance(message, protocol.Hello):
            body[7] = 2
        body[-2:] = protocol.binascii.crc_hqx(bytes(body[:-2]), 0xFFFF).to_bytes(2, "little")
        return protocol.stuff(bytes(body)) + b"\0"

    monkeypatch.setattr(emulator, "encode", encode_as_2)
    board.restart()
    with pytest.raises(HardwareError, match="version 2 of the protocol, this vislam speaks 1"):
        SerialBridge(config)


def test_a_chip_that_goes_away_and_comes_back(config: SerialConfig, board: BridgeEmulator) -> None:
    bridge = SerialBridge(config)
    board.faults = LineFaults(no_accel=True)
    collect(bridge, lambda _: bridge.counters().get("accel_errors", 0) > 10)
    assert Health.ACCEL_FAULT | Health.IMU_GAP | Health.BUS_FAULT in bridge.health()
    board.faults = LineFaults()
    collect(bridge, lambda found: len(imu(found)) > 10)
    assert Health.ACCEL_FAULT not in bridge.health()
    bridge.close()


@pytest.mark.parametrize(
    ("name", "fault", "kind", "value", "most"),
    [
        ("gyro", LineFaults(frozen=True), ImuSample, (1, 2, 3), 20),
        ("accel", LineFaults(frozen_accel=True), ImuSample, (1, 2, 250), 20),
        ("mag", LineFaults(frozen_mag=True), MagSample, (200, -400, 8), 10),
    ],
)
def test_a_sensor_that_hangs_is_a_fault_and_not_used(
    config: SerialConfig, board: BridgeEmulator, name: str, fault: LineFaults, kind: Any, value: Any, most: int
) -> None:
    hello, bit = bridged("GY-85").hello, Health[f"{name.upper()}_FAULT"]
    unit = {"gyro": hello.gyro_nrad_s * 1e-9, "accel": hello.accel_nm_s2 * 1e-9, "mag": hello.mag_pt * 1e-6}[name]
    field = {"gyro": "gyro_rad_s", "accel": "accel_m_s2", "mag": "field_ut"}[name]
    bridge = SerialBridge(config)
    collect(bridge, lambda found: len(imu(found)) > 200 and any(isinstance(sample, MagSample) for sample in found))
    assert bridge.health() & (Health.GYRO_FAULT | Health.ACCEL_FAULT | Health.MAG_FAULT | Health.BUS_FAULT) == 0
    board.faults = fault
    samples = collect(bridge, lambda _: bridge.counters().get(f"{name}_stuck", 0) > 10)
    given = [s for s in samples if isinstance(s, kind) and np.allclose(getattr(s, field), np.array(value) * unit)]
    assert len(given) == most, "of gyro and accelerometer 50 ms of what is no motion, of the field 0.2 s"
    assert bit in bridge.health()
    board.faults = LineFaults()
    collect(bridge, lambda found: sum(isinstance(sample, kind) for sample in found) > 10)
    bridge.health()
    assert bit not in bridge.health()
    bridge.close()


def test_saturation_and_temperature_are_told(config: SerialConfig) -> None:
    def wild(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
        return (0.0, 40.0, 0.0), (0.0, 0.0, -200.0), (200.0, 0.0, 0.0), 50.0

    with BridgeEmulator(Path(config.port), wild):
        bridge = SerialBridge(replace(config, calibrated_at_c=25.0))
        samples = collect(bridge, lambda found: len(found) > 100)
        word, counts = bridge.health(), bridge.counters()
        bridge.close()
    assert Health.ACCEL_SATURATED | Health.GYRO_SATURATED | Health.MAG_FAULT | Health.TEMPERATURE_DRIFT in word
    assert counts["gyro_saturated"] > 0 < counts["accel_saturated"]
    assert counts["mag_overflow"] > 0
    assert not any(isinstance(sample, MagSample) for sample in samples)


def test_the_drift_since_the_zero_is_taken_off(config: SerialConfig) -> None:
    def warm(t_ns: int) -> tuple[tuple, tuple, tuple, float]:
        return *trembling(t_ns)[:3], 31.0

    with BridgeEmulator(Path(config.port), warm, errors=EXACT):
        bridge = SerialBridge(config)
        before = imu(collect(bridge, lambda found: len(found) > 100))
        assert bridge.temperature_c == pytest.approx(31.0, abs=0.1)
        bridge.zeroed_at(29.0, np.array([0.01, 0.0, -0.02]))
        collect(bridge, lambda found: len(found) > 100)  # what had been read before
        after = imu(collect(bridge, lambda found: len(found) > 100))
        assert Health.TEMPERATURE_DRIFT not in bridge.health()
        bridge.zeroed_at(15.0, np.zeros(3))
        assert Health.TEMPERATURE_DRIFT in bridge.health()
        bridge.close()
    change = np.mean([s.gyro_rad_s for s in after], axis=0) - np.mean([s.gyro_rad_s for s in before], axis=0)
    np.testing.assert_allclose(change, [-0.02, 0.0, 0.04], atol=2e-3)


def test_a_board_may_go_away_while_it_is_opened(
    config: SerialConfig, board: BridgeEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    def vanish(*_: object, **__: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    bridge = SerialBridge(config, must_be_there=False)
    with monkeypatch.context() as patch:
        patch.setattr("serial.Serial", vanish)
        assert bridge.read(0.1) == []
    assert bridge.counters()["open_failures"] >= 1
    collect(bridge, lambda found: len(imu(found)) > 10)
    bridge.close()


def test_it_is_read_where_a_thousand_files_are_open(config: SerialConfig) -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(before[0], min(4096, before[1])), before[1]))
    held = [os.open(os.devnull, os.O_RDONLY) for _ in range(1100)]  # whatever is opened now comes after
    try:
        with BridgeEmulator(Path(config.port), at_rest):
            bridge = SerialBridge(config)
            collect(bridge, lambda found: len(imu(found)) > 10)
            bridge.close()
    finally:
        for descriptor in held:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_one_port_has_one_reader(config: SerialConfig, board: BridgeEmulator) -> None:
    bridge = SerialBridge(config)
    with pytest.raises(HardwareError, match="another program"):
        SerialBridge(config)
    bridge.close()


def test_a_file_is_no_port(config: SerialConfig) -> None:
    Path(config.port).write_text("no port")
    with pytest.raises(HardwareError, match="cannot be opened as a serial port"):
        SerialBridge(config)


def test_a_port_without_permission_says_which_group(config: SerialConfig) -> None:
    assert "dialout" in why_not_open(config.port, config.baud, OSError(errno.EACCES, "Permission denied"))


def test_without_pyserial_it_says_what_to_install(config: SerialConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(HardwareError, match=r"pip install '\.\[hw\]'"):
        SerialBridge(config)


def test_endless_noise_neither_hangs_nor_fills_memory(config: SerialConfig) -> None:
    master, slave = os.openpty()
    os.set_blocking(master, False)
    Path(config.port).symlink_to(os.ttyname(slave))
    stop = threading.Event()

    def babble() -> None:
        while not stop.is_set():
            try:
                os.write(master, b"\xa5\x5a\x01" * 300)
            except BlockingIOError:
                time.sleep(0.001)

    writer = threading.Thread(target=babble)
    writer.start()
    bridge = SerialBridge(replace(config, start_s=1.0), must_be_there=False)
    for _ in range(5):
        assert bridge.read(0.1) == []
    collect(bridge, lambda _: bridge.counters().get("no_valid_frame", 0) > 0)
    bridge.close()
    stop.set()
    writer.join()
    os.close(slave)
    os.close(master)
