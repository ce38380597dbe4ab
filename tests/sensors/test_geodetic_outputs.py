"""Latitude and longitude of a run's trajectories, and the line that a map program opens."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, NavState
from vislam.runs.geodetic_outputs import (
    COLUMNS,
    LINES,
    SIGMA_COLUMNS,
    TABLES,
    GeodeticOutputs,
    lines_on_a_map,
    most_sigmas,
    places_of,
)
from vislam.runs.session import Session
from vislam.sensors.geodetic import Geodetic, LocalFrame
from vislam.sensors.measuring_frame import about_up
from vislam.sensors.toml import load_sensor_setup
from vislam.trajectory import Trajectory, read_tum
from worlds.sensed_drive import DATUM, Driven, driven


@pytest.fixture(scope="module")
def with_fixes(tmp_path_factory) -> Driven:
    return driven(tmp_path_factory, "clean")


def table_of(path: Path) -> tuple[Array, list[Geodetic]]:
    with path.open() as file:
        rows = list(csv.reader(file))
    assert rows[0] in ([*COLUMNS], [*COLUMNS, *SIGMA_COLUMNS])
    stamps = np.array([int(row[0]) for row in rows[1:]])
    return stamps, [Geodetic(*map(float, row[1:4])) for row in rows[1:]]


def sigmas_of(path: Path) -> Array:
    with path.open() as file:
        return np.array([[float(row[name]) for name in SIGMA_COLUMNS] for row in csv.DictReader(file)])


def true_enu(run: Driven) -> tuple[Array, Array]:
    """Stamps [N] and east, north, up [N, 3] of the truth, by the frame that was drawn for the run."""
    setup = load_sensor_setup(run.sensors)
    at = setup.suite.own("gnss")
    rng = np.random.default_rng([0, list(setup.simulated_hz).index("gnss")])
    yaw, *shift = setup.suite.starts[at] + setup.suite.sigmas[at] * rng.normal(size=at.stop - at.start)
    truth = read_tum(run.out / "trajectory_truth.tum")
    return truth.t_ns, truth.positions_m @ so3_exp(np.array([0.0, 0.0, yaw])).T + shift


@pytest.mark.parametrize("by", TABLES)
def test_latitude_and_longitude_are_those_of_the_truth(with_fixes: Driven, by: str) -> None:
    stamps, places = table_of(with_fixes.out / TABLES[by])
    local = LocalFrame(DATUM)
    enu = np.array([local.enu(place) for place in places])
    true_t_ns, true_m = true_enu(with_fixes)
    wanted = np.column_stack([np.interp(stamps, true_t_ns, true_m[:, k]) for k in range(3)])
    settled = stamps > stamps[0] + 5 * 10**9 if by == "filter" else stamps > 0
    error = np.linalg.norm(enu - wanted, axis=1)[settled]
    assert len(error) > 60
    assert np.sqrt(np.mean(error**2)) < 0.05
    most = sigmas_of(with_fixes.out / TABLES[by])[settled]
    share = np.abs(enu - wanted)[settled] / most
    print(by, "rms of error over most sigma", np.sqrt(np.mean(share**2, axis=0)), "sigmas", np.median(most, axis=0))
    assert np.sqrt(np.mean(share**2)) < 1.0  # they are the most that a sigma can be
    assert share.max() < 4.0
    assert most.max() < 0.5


def test_no_sigma_is_larger_however_body_and_frame_hang_together() -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        root = rng.normal(size=(7, 7)) * rng.uniform(0.1, 2.0, 7)[:, None]
        joint, p, frame = root @ root.T, rng.uniform(-50.0, 50.0, 3), rng.normal(size=4)
        covariance = np.zeros((15, 15))
        covariance[3:6, 3:6] = joint[:3, :3]
        state = NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), covariance)
        R = about_up(float(frame[0]))
        J = np.hstack([R, np.cross([0.0, 0.0, 1.0], R @ p)[:, None], np.eye(3)])
        sigmas = np.sqrt(np.diag(J @ joint @ J.T))
        most = most_sigmas([state], np.array([0, 1]), np.array([p, p]), frame, np.sqrt(np.diag(joint))[3:])
        assert (sigmas <= most[0] * (1.0 + 1e-12)).all()
        assert (most[0] == most[1]).all()
        alone = most_sigmas([state], np.array([0]), p[None], np.zeros(0), np.zeros(0))
        assert alone[0] == pytest.approx(np.sqrt(np.diag(joint))[:3])


def test_the_datum_and_the_line_are_in_the_folder(with_fixes: Driven) -> None:
    sensors = with_fixes.metrics["sensors"]
    datum = {"latitude_deg": DATUM.latitude_deg, "longitude_deg": DATUM.longitude_deg, "height_m": DATUM.height_m}
    assert sensors["gnss"]["datum"] == datum
    assert "datum" not in sensors["wheels"]
    session = Session(with_fixes.out / "session.db")
    assert session.info()["datum"] == {"sensor": "gnss", **datum}
    session.close()
    collection = json.loads((with_fixes.out / LINES).read_text())
    assert collection["type"] == "FeatureCollection"
    for feature, (by, name) in zip(collection["features"], TABLES.items(), strict=True):
        assert feature["properties"] == {"estimator": by}
        assert feature["geometry"]["type"] == "LineString"
        _, places = table_of(with_fixes.out / name)
        first = feature["geometry"]["coordinates"][0]
        assert first == [places[0].longitude_deg, places[0].latitude_deg, places[0].height_m]


def test_without_a_datum_nothing_is_added(tmp_path_factory) -> None:
    out = driven(tmp_path_factory, "without").out
    assert not any((out / name).exists() for name in (LINES, *TABLES.values()))
    session = Session(out / "session.db")
    assert "datum" not in session.info()
    session.close()


def path_of(positions_m: Array) -> Trajectory:
    T = np.tile(np.eye(4), (len(positions_m), 1, 1))
    T[:, :3, 3] = positions_m
    return Trajectory(np.arange(len(T), dtype=np.int64), T)


@given(
    st.sampled_from([90.0, -90.0, 89.9999, 45.0, 0.0]), st.floats(-180.0, 180.0), st.floats(-3.1, 3.1),
    st.tuples(*[st.floats(-1e4, 1e4)] * 3),
)  # fmt: skip
def test_places_near_poles_and_the_date_line_are_as_far_apart_as_the_path(latitude, longitude, yaw, shift) -> None:
    datum = Geodetic(latitude, longitude, 0.0)
    path_m = np.array([[0.0, 0.0, 0.0], [1000.0, 0.0, 5.0], [1000.0, 1000.0, -5.0]])
    local, R = LocalFrame(datum), so3_exp(np.array([0.0, 0.0, yaw]))
    places = places_of(path_of(path_m), np.array([yaw, *shift]), datum)
    back = np.array([local.enu(place) for place in places])
    np.testing.assert_allclose((back - shift) @ R, path_m, atol=1e-6)


@given(st.floats(-1e3, 1e3), st.floats(-80.0, 80.0), st.sampled_from([1.0, -1.0]))
def test_a_line_over_the_date_line_is_cut_there(north_m: float, latitude: float, side: float) -> None:
    """RFC 7946, 3.1.9: no part crosses, and the ends of two parts meet at the meridian."""
    path_m = side * np.array([[-500.0, 0.0, 0.0], [700.0, north_m, 3.0]])
    places = places_of(path_of(path_m), np.zeros(4), Geodetic(latitude, side * 180.0, 10.0))
    [feature] = lines_on_a_map({"graph": places})["features"]
    assert feature["geometry"]["type"] == "MultiLineString"
    before, after = feature["geometry"]["coordinates"]
    assert before[-1][0] == -after[0][0] == side * 180.0
    assert before[-1][1:] == after[0][1:]
    assert abs(before[-1][1] - latitude) < 0.01
    for part in (before, after):
        assert max(lon for lon, *_ in part) - min(lon for lon, *_ in part) < 1.0


def test_a_receiver_that_told_its_datum_in_the_run_is_enough(tmp_path) -> None:
    """As the receiver at a port does, and as `vislam loops RUN --undo` finds it in the metrics."""
    place = Geodetic(47.0, 8.0, 400.0)
    told = {"latitude_deg": 47.0, "longitude_deg": 8.0, "height_m": 400.0}
    path = path_of(np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]]))
    sensors = {
        "early": {"begun": False, "variables": ["yaw_rad", "x_m", "y_m", "z_m"], "datum": told},
        "gnss": {"begun": True, "variables": [], "datum": told},
    }
    assert GeodeticOutputs({}).write(tmp_path, sensors, {"graph": path}) == {"sensor": "gnss", **told}
    _, places = table_of(tmp_path / TABLES["graph"])
    np.testing.assert_allclose(LocalFrame(place).enu(places[1]), [3.0, 4.0, 0.0], atol=2e-4)
    assert not (tmp_path / TABLES["filter"]).exists()
    sensors.pop("gnss")
    assert GeodeticOutputs({}).write(tmp_path, sensors, {"graph": path}) is None


def test_a_line_of_one_place_is_none() -> None:
    assert lines_on_a_map({"graph": [Geodetic(1.0, 2.0, 3.0)]})["features"] == []
