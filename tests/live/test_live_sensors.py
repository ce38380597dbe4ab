"""Further sensors of a live run: played along with a recording, and what is refused before anything starts."""

import os
from pathlib import Path

import numpy as np
import pytest

from vislam.config import Config, SensorsConfig, load, load_cart, load_sensors
from vislam.core.errors import HardwareError, UsageError
from vislam.live.replay import ReplaySource
from vislam.live.run_live import LiveRun
from vislam.live.sources import open_live
from vislam.live.status import status_line
from vislam.runs.folder import prepare
from vislam.sensors import load_sensor_setup
from vislam.sensors.kinds import Wheels

WORLD = "points:laps,camera_hz=10,tracks=150,duration_s=600"  # a quiet machine needs 30 of them
KEYFRAMES = 20  # that the graph has, however late: on a busy machine vision falls behind the IMU
ENOUGH = {"gnss": 15, "wheels": 60}  # readings that the published filter accepts
SAMPLES = 6000  # of the IMU, 200 a second: the cart has been round two corners

SIMULATED = """
[sensors.wheels]
kind = "wheels"
simulated_hz = 20.0

[sensors.gnss]
kind = "position"
simulated_hz = 5.0
sigma_m = 0.3
gnss = {datum = [47.0, 8.0, 400.0]}

[sensors.baro]
kind = "height"
file = "baro.csv"
"""


def settings(file: Path | None) -> Config:
    off = {"view.enabled": False, "map.enabled": False, "live.send_to": ()}
    further = {} if file is None else {"sensors.file": str(file)}
    return load(None, {**off, **further, "live.name": f"vislam-test-sensors-{os.getpid()}"})


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, list[str]]:
    """Metrics of a replay with wheels, fixes and a barometer that is never heard, and the lines of its status."""
    folder = tmp_path_factory.mktemp("sensors")
    file, out = folder / "sensors.toml", folder / "run"
    file.write_text(SIMULATED)
    (folder / "baro.csv").write_text("t_ns,height_m\n9000000000000,1.0\n")
    prepare(out, overwrite=False)
    source = ReplaySource(WORLD)
    live = LiveRun(source, settings(file), out, f"replay:{WORLD}", ["vislam", "live"])
    lines: list[str] = []

    def watch(run: LiveRun) -> None:
        lines.append(status_line(run))
        status = run.notes.get("fast", {}).get("status") or {}
        if status.get("samples", 0) > SAMPLES and status["map_revision"] > KEYFRAMES:
            run.stop()

    return live.execute(watch, source.duration_s), lines


def test_sensors_begin_in_filter_and_graph_of_a_live_run(run: tuple[dict, list[str]]) -> None:
    sensors = run[0]["sensors"]
    for name in ("wheels", "gnss"):
        assert sensors[name]["begun"]
        for estimator in ("filter", "graph"):
            assert np.isfinite(sensors[name][estimator]["values"]).all()
            assert len(sensors[name][estimator]["sigmas"]) == len(sensors[name]["variables"]) > 0
    at = sensors["wheels"]["variables"].index("track_width_m")
    assert sensors["wheels"]["graph"]["sigmas"][at] < 0.9 * Wheels().variables[at].sigma  # it was driven, not guessed
    assert not sensors["baro"]["begun"]
    assert sensors["gnss"]["datum"] == {"latitude_deg": 47.0, "longitude_deg": 8.0, "height_m": 400.0}


def test_the_published_filter_takes_the_readings_of_vision_s_side(run: tuple[dict, list[str]]) -> None:
    published, beside_vision = run[0]["live"]["filter"], run[0]["counters"]["ekf"]
    for name in ("wheels", "gnss"):
        assert published[f"{name}_begun"] == 1
        accepted, told = published[f"{name}_accepted"], beside_vision[f"{name}_accepted"]
        assert ENOUGH[name] < accepted <= told
        assert run[0]["counters"][f"sensor {name}"]["played"] >= told


def test_the_status_line_names_a_silent_sensor_only(run: tuple[dict, list[str]]) -> None:
    going = [line for line in run[1] if "map" in line]
    assert "baro nothing yet" in going[-1]
    assert any("wheels" not in line and "gnss" not in line for line in going)


def test_a_sensor_that_nobody_could_read_is_refused_before_anything_starts(tmp_path: Path) -> None:
    file = tmp_path / "cart.toml"
    file.write_text('[sensors.gnss]\nkind = "position"\nport = "/dev/absent"\nbaud = 38400\n')
    setup = load_sensor_setup(file)
    assert setup.ports["gnss"].baud == 38400
    command = ["vislam", "live"]
    with pytest.raises(UsageError, match=r"\[sensors.gnss\]: a replay needs its file, or simulated_hz"):
        LiveRun(ReplaySource("points:still"), settings(file), tmp_path / "run", "replay", command)
    cart, _ = open_live("gy85+none", settings(file), SensorsConfig())
    with pytest.raises(HardwareError, match="there is no port /dev/absent"):
        cart.readings(setup)
    file.write_text('[sensors.baro]\nkind = "height"\nsimulated_hz = 5\n')
    with pytest.raises(UsageError, match=r"\[sensors.baro\]: on a cart it needs a port"):
        cart.readings(load_sensor_setup(file))
    file.write_text('[sensors.baro]\nkind = "height"\nfile = "baro.csv"\n')
    virtual, config = open_live("virtual-cart", settings(file), SensorsConfig())
    with pytest.raises(UsageError, match=r"\[sensors.baro\]: the virtual cart draws its sensors; give simulated_hz"):
        LiveRun(virtual, config, tmp_path / "run", "virtual-cart", command)


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ('kind = "height"\nport = "/dev/tty0"\nformat = "ubx"', "ubx holds fixes"),
        ('kind = "height"\nport = "/dev/tty0"\nticks = {ticks_per_turn = 1, radius_m = 1}', "counts are those of kind"),
        ('kind = "height"\nport = "/dev/a"\n[sensors.other]\nkind = "height"\nport = "/dev/a"', "sensor it has /dev/a"),
        ('kind = "position"\nport = "/dev/tty0"\ngnss = {datum = [100.0, 0.0, 0.0]}', "datum"),
    ],
)
def test_a_port_that_cannot_be_is_refused(tmp_path: Path, table: str, why: str) -> None:
    (tmp_path / "cart.toml").write_text(f"[sensors.it]\n{table}\n")
    with pytest.raises(UsageError, match=why):
        load_sensor_setup(tmp_path / "cart.toml")


def test_one_file_describes_all_of_a_cart(tmp_path: Path) -> None:
    file = tmp_path / "cart.toml"
    file.write_text('[serial]\nbaud = 1000000\n[sensors.gnss]\nkind = "position"\nport = "/dev/ttyACM0"\n')
    cart, further = load_cart(file)
    assert cart.serial.baud == load_sensors(file).serial.baud == 1_000_000
    assert further.file == str(file)
    assert load_sensor_setup(file).suite.names == ("gnss",)
    file.write_text("[serial]\nbaud = 1000000\n")
    assert load_cart(file)[1].file is None
    file.write_text('[wheels]\nkind = "wheels"\n')
    with pytest.raises(UsageError, match=r"no table \[wheels\]"):
        load_sensor_setup(file)
