"""Further sensors recorded: at the serial bridge and at a port of their own, and read again by a run."""

import json
import math
import os
import threading
import time
import tty
from collections.abc import Iterator
from dataclasses import replace
from functools import reduce
from operator import xor
from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import BridgeClockConfig, RecordConfig, SensorsConfig, SerialConfig
from vislam.core import Problems
from vislam.core.errors import HardwareError, UsageError
from vislam.core.readings import Reading
from vislam.datasets.sensor_files import sensor_readings
from vislam.hw.emulator.bridge import BridgeEmulator, at_rest
from vislam.runs.record import Recorded, record
from vislam.runs.recorded_readings import further_ports
from vislam.sensors.toml import load_sensor_setup
from waiting import HUNG_S

CONFIG = RecordConfig(min_free_gb=0.0)
CART = """
[serial]
start_s = 30.0

[sensors.wheels]
kind = "wheels"
port = "bridge"
sigma_m_s = 0.05
ticks = {ticks_per_turn = 1000, radius_m = 0.05}

[sensors.gnss]
kind = "position"
port = "bridge"
delay_s = 0.25
gnss = {least_fix = "single", single_m = 3.0}

[sensors.baro]
kind = "height"
port = "PORT"
"""
M_PER_TICK = 2.0 * math.pi * 0.05 / 1000
SPEEDS = np.array([3000.0, -1500.0]) * M_PER_TICK


def turned(t_ns: int) -> tuple[float, float]:
    t_s = t_ns % 10**12 * 1e-9
    return 3000.0 * t_s, -1500.0 * t_s


def burst(second: int, north_min: float) -> bytes:
    """What a receiver says in a second."""
    bodies = (
        f"GNRMC,1200{second:02d}.00,A,48{north_min:07.4f},N,01131.000,E,0.0,0.0,230326,,,A",
        f"GNGGA,1200{second:02d}.00,48{north_min:07.4f},N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,",
    )
    return b"".join(b"$%s*%02X\r\n" % (body.encode(), reduce(xor, body.encode())) for body in bodies)


@pytest.fixture
def sensors() -> SensorsConfig:
    clock = BridgeClockConfig(settle_s=0.2, bin_s=0.05)
    return SensorsConfig(serial=SerialConfig(start_s=HUNG_S, reopen_s=0.05, clock=clock))


class Surroundings:
    """A bridge with encoders and a receiver, and a barometer at a port of its own, all of which talk."""

    def __init__(self, folder: Path) -> None:
        self.cart = folder / "cart.toml"
        self.tty = folder / "tty"
        self.fixes = 0
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.cart.write_text(CART.replace("PORT", os.ttyname(self._slave)))
        self._board = BridgeEmulator(self.tty, at_rest, drift=0.005, turned=turned, has_receiver=True)
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._talk, daemon=True)
        self._thread.start()

    def _talk(self) -> None:
        while not self._is_over.wait(0.2):
            self._board.say(burst(self.fixes % 60, 7.038 + 0.001 * (self.fixes % 60)))
            self.fixes += 1
            try:
                os.write(self._master, b"12.5\n")
            except BlockingIOError:
                continue

    def close(self) -> None:
        self._is_over.set()
        self._thread.join()
        self._board.close()
        os.close(self._master)
        os.close(self._slave)


@pytest.fixture
def around(tmp_path: Path) -> Iterator[Surroundings]:
    surroundings = Surroundings(tmp_path)
    yield surroundings
    surroundings.close()


def rows(path: Path) -> int:
    return len(path.read_text().splitlines()) - 1 if path.exists() else 0


def recorded_until_all_spoke(around: Surroundings, out: Path, sensors: SensorsConfig) -> Recorded:
    """Record until there are enough readings of each, by a thread that looks at the files."""
    stop = threading.Event()

    def look() -> None:
        end = time.monotonic() + HUNG_S
        while time.monotonic() < end:
            if rows(out / "wheels.csv") > 40 and rows(out / "gnss.csv") > 4 and rows(out / "baro.csv") > 4:
                break
            time.sleep(0.05)
        stop.set()

    thread = threading.Thread(target=look)
    thread.start()
    further = further_ports(around.cart)
    recorded = record(out, f"serial:{around.tty}", "none", sensors, CONFIG, stop=stop, further=further)
    thread.join()
    return recorded


def read_again(out: Path) -> dict[str, list[Reading]]:
    setup, problems = load_sensor_setup(out / "sensors.toml"), Problems()
    found = {
        name: list(sensor_readings(name, setup.sensors[name], setup.files[name], problems)) for name in setup.files
    }
    assert not problems
    return found


def test_what_further_sensors_said_is_read_again(around: Surroundings, sensors: SensorsConfig, tmp_path: Path) -> None:
    out = tmp_path / "ride"
    recorded = recorded_until_all_spoke(around, out, sensors)
    found = read_again(out)
    assert {name: len(readings) for name, readings in found.items()} == {
        name: recorded.counts[f"{name} readings"] for name in ("wheels", "gnss", "baro")
    }
    # what they said, at a time of the IMU's clock
    wheels = np.array([reading.values for reading in found["wheels"]])
    assert np.median(wheels, axis=0) == pytest.approx(SPEEDS, abs=0.02)
    assert all(reading.values == pytest.approx([12.5]) for reading in found["baro"])
    north_m = np.array([reading.values[1] for reading in found["gnss"]])
    steps = np.diff(north_m) / (0.001 / 60 * 111_200.0)  # of a fix; now and then the receiver said several at once
    assert steps == pytest.approx(np.round(steps), abs=0.02)
    for fix in found["gnss"]:
        assert fix.covariance is not None
        assert np.sqrt(np.diag(fix.covariance)) == pytest.approx([3.0, 3.0, 6.0])
    imu_ns = np.loadtxt(out / "mav0" / "imu0" / "data.csv", delimiter=",")[:, 0]
    for readings in found.values():
        assert imu_ns[0] - 2e9 < readings[-1].t_ns < imu_ns[-1] + 2e9
    # and the settings of each, with the receiver's datum
    setup = load_sensor_setup(out / "sensors.toml")
    assert setup.sensors["wheels"].settings.sigma_m_s == 0.05  # type: ignore[attr-defined]
    assert setup.datums["gnss"].latitude_deg == pytest.approx(48.1173, abs=2e-3)
    assert not setup.ports
    facts = json.loads((out / "recording.json").read_text())
    assert facts["faults"]["sensor wheels"]["readings"] >= len(found["wheels"])
    assert any(f"--sensors.file {out / 'sensors.toml'}" in note for note in facts["notes"])


@pytest.mark.slow  # a whole run
def test_a_run_on_the_recording_has_the_same_readings(
    around: Surroundings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film = tmp_path / "wall.avi"
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8), (7, 7), 2.0)
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (320, 240))
    for _ in range(80):
        writer.write(cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX))
    writer.release()
    out, run = tmp_path / "ride", tmp_path / "run"
    command = ["record", "--out", str(out), "--imu", f"serial:{around.tty}", "--camera", str(film), "--config"]
    assert run_verb([*command, str(around.cart), "--min-free-gb", "0"]) == 0
    assert f"--sensors.file {out / 'sensors.toml'}" in capsys.readouterr().out.replace("\n", "")
    command = ["run", str(out), "--sensors.file", str(out / "sensors.toml"), "--out", str(run)]
    assert run_verb([*command, "--view.no-enabled", "--map.no-enabled"]) == 0
    told = json.loads((run / "metrics.json").read_text())["sensors"]
    found = read_again(out)
    assert len(found["wheels"]) > 10
    for name, readings in found.items():
        came = told[name]["readings"]["came"]
        assert 0.5 * len(readings) < came <= len(readings), name  # all but those after the last frame


def test_sensors_that_cannot_be_recorded_are_refused(
    around: Surroundings, sensors: SensorsConfig, tmp_path: Path
) -> None:
    further = further_ports(around.cart)
    with pytest.raises(UsageError, match=r"port = \"bridge\" is the serial bridge, and --imu gy85 is none"):
        record(tmp_path / "a", "gy85", "none", sensors, CONFIG, further=further)
    gone = tmp_path / "gone.toml"
    gone.write_text('[sensors.baro]\nkind = "height"\nport = "/dev/ttyNOWHERE"\n')
    with pytest.raises(HardwareError, match="there is no port /dev/ttyNOWHERE"):
        record(tmp_path / "b", f"serial:{around.tty}", "none", sensors, CONFIG, further=further_ports(gone))
    gone.write_text('[sensors.baro]\nkind = "height"\nfile = "baro.csv"\n')
    with pytest.raises(UsageError, match=r"\[sensors.baro\]: it needs a port to be recorded from"):
        further_ports(gone)
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "b").exists()


def test_a_sensor_that_says_nothing_is_named_at_the_end(sensors: SensorsConfig, tmp_path: Path) -> None:
    cart = tmp_path / "cart.toml"
    cart.write_text('[sensors.wheels]\nkind = "wheels"\nport = "bridge"\nticks = {ticks_per_turn = 9, radius_m = 1}\n')
    with BridgeEmulator(tmp_path / "tty", at_rest):  # a sketch that counts nothing
        recorded = record(
            tmp_path / "r", f"serial:{tmp_path / 'tty'}", "none", replace(sensors), CONFIG, seconds=2.0,
            further=further_ports(cart),
        )  # fmt: skip
    assert any(
        "[sensors.wheels] gave no reading: the sketch on the board counts no encoders" in n for n in recorded.notes
    )
    assert read_again(tmp_path / "r") == {"wheels": []}  # a table without rows
