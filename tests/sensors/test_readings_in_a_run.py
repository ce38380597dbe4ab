"""`vislam run` with further sensors: what they add, that it can be repeated and resumed, and what spoils nothing."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vislam.cli import run_verb
from vislam.config import load
from vislam.core.geometry import invert
from vislam.core.readings import Reading
from vislam.runs import execute, resume
from vislam.runs.folder import prepare, read_setup
from vislam.runs.further_sensors import drawn
from vislam.runs.sources import open_source
from vislam.sensors.simulated import bodies_on, drawn_readings
from vislam.sensors.toml import SensorSetup, load_sensor_setup
from vislam.trajectory import read_tum
from worlds.mini_recording import imu_rows, write_camera, write_imu
from worlds.sensed_drive import FIXES, SOURCE, WHEELS, Driven, drive, driven, settings

BLIND = "points:cart-drive,rig=stereo,duration_s=20,camera_hz=10,tracks=100,outage_begin_s=8,outage_length_s=10"
QUIET = ["--map.no-enabled", "--view.no-enabled"]
ANCHORS = {1: (-7.0, -5.0, 0.1), 2: (7.0, -5.0, 2.5), 3: (7.0, 5.0, 0.3), 4: (-7.0, 5.0, 2.8)}
RANGES = (
    '[sensors.uwb]\nkind = "range"\nsigma_m = 0.05\n'
    f"anchors = {{{', '.join(f'{name} = {list(place)}' for name, place in ANCHORS.items())}}}\n"
)
SECOND_NS = 10**9


def write_table(path: Path, columns: tuple[str, ...], readings: list[Reading]) -> None:
    rows = [",".join([str(r.t_ns), *(repr(float(value)) for value in r.values)]) for r in readings]
    path.write_text("\n".join([",".join(["t_ns", *columns]), *rows]) + "\n")


def with_files(folder: Path, tables: dict[str, str], readings: dict[str, list[Reading]]) -> Driven:
    """Write readings as tables, and run with a file of sensors that names them."""
    text = "".join(f'{text}file = "{name}.csv"\n' for name, text in tables.items())
    (folder / "kinds.toml").write_text(text)
    for name, sensor in load_sensor_setup(folder / "kinds.toml").sensors.items():
        write_table(folder / f"{name}.csv", sensor.columns, readings[name])
    return drive(folder, text)


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Driven:
    return driven(tmp_path_factory, "clean")


@pytest.fixture(scope="module")
def without(tmp_path_factory) -> Driven:
    return driven(tmp_path_factory, "without")


@pytest.fixture(scope="module")
def readings(clean) -> dict[str, list[Reading]]:
    setup = load_sensor_setup(clean.sensors)
    return dict(zip(setup.simulated_hz, drawn(open_source(SOURCE), setup, 0), strict=True))


# ---- what they add


def true_own(setup: SensorSetup, out: Path) -> dict[str, np.ndarray]:
    """Own variables as they were drawn; frames from the world of the estimate, which begins where the truth does."""
    own = {}
    for number, name in enumerate(setup.simulated_hz):
        at = setup.suite.own(name)
        draw = np.random.default_rng([0, number]).normal(size=at.stop - at.start)
        own[name] = setup.suite.starts[at] + setup.suite.sigmas[at] * draw
    truth, estimate = read_tum(out / "trajectory_truth.tum"), read_tum(out / "trajectory_graph.tum")
    first = int(np.argmin(np.abs(truth.t_ns - estimate.t_ns[0])))
    T = truth.T_world_body[first] @ invert(estimate.T_world_body[0])  # from the estimate's world into the truth's
    yaw_rad, origin_m = own["gnss"][0], own["gnss"][1:]
    Rz = np.array([[np.cos(yaw_rad), -np.sin(yaw_rad), 0.0], [np.sin(yaw_rad), np.cos(yaw_rad), 0.0], [0.0, 0.0, 1.0]])
    own["gnss"] = np.array([yaw_rad + np.arctan2(T[1, 0], T[0, 0]), *(Rz @ T[:3, 3] + origin_m)])
    return own


def test_own_variables_are_found_within_four_sigmas(clean):
    true = true_own(load_sensor_setup(clean.sensors), clean.out)
    sensors = clean.metrics["sensors"]
    assert set(sensors) == {"wheels", "gnss"}
    for name, entry in sensors.items():
        assert entry["begun"]
        for estimator in ("filter", "graph"):
            off = np.array(entry[estimator]["values"]) - true[name]
            if name == "gnss":
                off[0] = (off[0] + np.pi) % (2.0 * np.pi) - np.pi
            sigmas = np.array(entry[estimator]["sigmas"])
            print(name, estimator, np.round(off / sigmas, 2))
            assert (np.abs(off) < 4.0 * sigmas).all()
            assert (sigmas < 0.05).all()  # so that a sigma without end does not pass


def test_a_run_is_as_accurate_as_without_them_or_better(clean, without):
    print(clean.ate_m, without.ate_m)
    assert clean.ate_m["graph"] < without.ate_m["graph"] + 0.002
    assert clean.ate_m["ekf"] < without.ate_m["ekf"] + 0.005
    assert without.metrics["sensors"] == {}


def test_every_reading_is_accounted_for_in_filter_and_graph(clean, readings):
    """Each ends in one way in the filter, which uses what came after the beginning, and in one way in the graph."""
    counters = clean.metrics["counters"]
    for name, offered in readings.items():
        counts, filter_ = counters[f"sensor {name}"], counters["ekf"]
        assert counts["readings"] == len(offered)
        assert filter_[f"{name}_begun"] == 1
        accepted = filter_[f"{name}_accepted"]
        assert 0.7 * len(offered) < accepted <= len(offered) - counts["too_early"] - filter_[f"{name}_gated"]
        assert filter_[f"{name}_refused"] == filter_[f"{name}_waiting"] == 0
        counted = clean.metrics["sensors"][name]["readings"]
        filter_, graph = counted["filter"], counted["graph"]
        print(name, counted)
        assert counted["came"] == len(offered)
        assert sum(filter_.values()) == len(offered)
        of_used = graph["outliers"] + graph["failed"]
        assert sum(graph.values()) - of_used == len(offered)
        assert graph["used"] > 0.7 * len(offered)
        assert of_used < 0.05 * graph["used"]
        assert filter_["beginning"] == graph["beginning"] > 0


# ---- again


def test_the_same_readings_from_files_give_identical_bytes(clean, readings, tmp_path):
    assert with_files(tmp_path, {"wheels": WHEELS, "gnss": FIXES}, readings).bytes == clean.bytes


def test_an_interrupted_run_is_resumed_with_its_sensors(clean, tmp_path):
    out = tmp_path / "ended"
    prepare(out, overwrite=False)

    def stop(done: int, total: int, note: str) -> None:
        if done == total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        execute(open_source(SOURCE), load(None, settings(clean.sensors)), out, SOURCE, [], stop)
    source, config, base = read_setup(out)
    metrics = resume(open_source(source, config.seed, config.calibration), config, out, source, [], base=base)
    result = Driven(out, clean.sensors)
    assert metrics["resumed"]
    assert metrics["frames"] == metrics["frames_expected"]
    print(result.ate_m, clean.ate_m)
    assert result.ate_m["graph"] < clean.ate_m["graph"] + 0.01
    true = true_own(load_sensor_setup(clean.sensors), out)
    for name, entry in metrics["sensors"].items():
        assert entry["begun"]
        off = np.array(entry["graph"]["values"]) - true[name]
        assert (np.abs(off) < 4.0 * np.array(entry["graph"]["sigmas"])).all(), name


# ---- what cannot be


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        ("[sensors.wheels]\nkind = 'whels'\n", 2, "no kind of sensor is called 'whels'"),
        ("[sensors.wheels\n", 2, "cannot be read"),
        (f"{WHEELS}simulated_hz = -1.0\n", 2, "simulated_hz"),
        (WHEELS, 2, "[sensors.wheels] has no readings here"),
        (f"{WHEELS}file = 'nothing.csv'\n", 3, "nothing.csv cannot be read"),
    ],
)
def test_settings_and_files_that_cannot_be_are_told_in_one_line(text, code, message, tmp_path, capsys):
    (tmp_path / "bad.toml").write_text(text)
    arguments = ["run", SOURCE, "--out", str(tmp_path / "run"), "--sensors.file", str(tmp_path / "bad.toml"), *QUIET]
    assert run_verb(arguments) == code
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1


def test_nothing_can_be_drawn_on_a_recording_without_truth(clean, tmp_path, capsys):
    root = tmp_path / "recording" / "mav0"
    write_camera(root, "cam0", 5)
    write_imu(root, imu_rows(60))
    arguments = ["run", f"euroc:{root.parent}", "--out", str(tmp_path / "run"), "--sensors.file", str(clean.sensors)]
    assert run_verb([*arguments, *QUIET]) == 3
    error = capsys.readouterr().err.strip()
    assert "has no truth on which sensors can be drawn; give them files" in error
    assert len(error.splitlines()) == 1


# ---- what goes wrong


def in_time(readings: list[Reading], begin_s: float, end_s: float) -> list[bool]:
    first_ns = readings[0].t_ns
    return [begin_s * SECOND_NS <= r.t_ns - first_ns < end_s * SECOND_NS for r in readings]


def changed(
    readings: list[Reading], begin_s: float, end_s: float, change: Callable[[np.ndarray], np.ndarray]
) -> list[Reading]:
    """Return readings with other values for a time."""
    hit = in_time(readings, begin_s, end_s)
    return [replace(r, values=change(r.values)) if h else r for r, h in zip(readings, hit, strict=True)]


def leaping_then_silent(readings):
    said = changed(readings["gnss"], 9.0, 12.0, lambda place: place + np.array([1e4, 0.0, 0.0]))
    return readings | {"gnss": [r for r, h in zip(said, in_time(said, 0.0, 13.0), strict=True) if h]}


def backwards(readings):
    return readings | {"wheels": changed(readings["wheels"], 8.0, 13.0, lambda speeds: -speeds)}


def twice(readings):
    return readings | {"wheels": [r for one in readings["wheels"] for r in (one, one)]}


def jumping_back(readings):
    """The clock goes back by 3 s, and stays there: what it says is wrong by 3 s from where it has caught up."""
    said = readings["gnss"]
    hit = in_time(said, 9.0, 100.0)
    return readings | {
        "gnss": [replace(r, t_ns=r.t_ns - 3 * SECOND_NS) if h else r for r, h in zip(said, hit, strict=True)]
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of_gnss", "of_wheels", "seen"),
    [
        (leaping_then_silent, backwards, {("ekf", "gnss_gated"): 15, ("sensor wheels", "slipped"): 50}),
        (jumping_back, twice, {("ekf", "gnss_gated"): 5, ("ekf", "wheels_refused"): 200}),
    ],
)
def test_faults_cost_what_they_spoil_and_are_counted(of_gnss, of_wheels, seen, clean, without, readings, tmp_path):
    tables = {"wheels": WHEELS, "gnss": FIXES}
    spoilt = with_files(tmp_path, tables, of_wheels(of_gnss(readings)))
    metrics = spoilt.metrics
    print(spoilt.ate_m, clean.ate_m, without.ate_m, metrics["problems"])
    print({k: v for k, v in metrics["counters"]["ekf"].items() if k.startswith(("gnss", "wheels"))})
    for name, more_m in (("ekf", 0.02), ("graph", 0.01)):
        assert spoilt.ate_m[name] < max(clean.ate_m[name], without.ate_m[name]) + more_m
    for (of, name), count in seen.items():
        assert metrics["counters"][of][name] >= count


@pytest.mark.slow
def test_ranges_of_zero_change_nothing(without, tmp_path):
    (tmp_path / "uwb.toml").write_text(RANGES)
    sensor = load_sensor_setup(tmp_path / "uwb.toml").sensors["uwb"]
    truth = open_source(SOURCE).truth()
    t_ns = np.arange(int(truth.t_ns[0]) + SECOND_NS // 10, int(truth.t_ns[-1]) - SECOND_NS // 10, SECOND_NS // 10)
    own = np.zeros(len(sensor.variables))  # the anchors stand in the world of the truth
    good = drawn_readings("uwb", sensor, bodies_on(truth, t_ns), own, seed=1)
    zeros = changed(good, 10.0, 12.0, lambda values: np.array([values[0], 0.0]))
    result = with_files(tmp_path, {"uwb": RANGES}, {"uwb": zeros})
    metrics = result.metrics
    print(result.ate_m, without.ate_m, metrics["sensors"], metrics["problems"], metrics["counters"]["sensor uwb"])
    assert metrics["sensors"]["uwb"]["begun"]
    counted = metrics["counters"]["sensor uwb"]["unusable"] + metrics["counters"]["ekf"]["uwb_gated"]
    assert counted >= 20
    for name in ("ekf", "graph"):
        assert result.ate_m[name] < without.ate_m[name] + 0.01


# ---- without camera


@pytest.mark.slow
def test_a_cart_goes_on_by_its_wheels_where_the_camera_sees_nothing(tmp_path):
    """Inertial data alone leave metres; wheels that were calibrated on the way there, a few centimetres."""
    blind, wheeled = (tmp_path / name for name in ("blind", "wheeled"))
    blind.mkdir()
    wheeled.mkdir()
    alone, led = drive(blind, "", BLIND).ate_m, drive(wheeled, f"{WHEELS}simulated_hz = 20.0\n", BLIND).ate_m
    print("ATE [m]: without wheels", alone, "with", led)
    for name in ("ekf", "graph"):
        assert led[name] < 0.1
        assert alone[name] > 10.0 * led[name]
