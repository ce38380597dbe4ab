"""Trajectories as latitude, longitude and height where a further sensor has a datum: tables, and lines on a map."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.config import FurtherSensorsConfig
from vislam.core.errors import DataError
from vislam.core.files import csv_text, write_text
from vislam.core.messages import Array, NavState
from vislam.sensors.geodetic import Geodetic, LocalFrame
from vislam.sensors.measuring_frame import UP, frame_pose, frame_variables
from vislam.sensors.toml import load_sensor_setup
from vislam.trajectory import Trajectory, read_states_csv

COLUMNS = ("t_ns", "latitude_deg", "longitude_deg", "height_m")
SIGMA_COLUMNS = ("most_sigma_east_m", "most_sigma_north_m", "most_sigma_up_m")
LINES = "trajectory.geojson"
TABLES = {"filter": "trajectory_ekf_geodetic.csv", "graph": "trajectory_graph_geodetic.csv"}
_STATES = {"filter": "states_ekf.csv", "graph": "states_graph.csv"}
_FRAME = [variable.name for variable in frame_variables("own")]
_DIGITS, _HEIGHT_DIGITS = 9, 4  # of degrees, 0.1 mm, and of metres


def datums_of(config: FurtherSensorsConfig) -> dict[str, Geodetic]:
    """Return, by sensor, the datum of its frame: as given, or of the first good fix in the file of a receiver.

    Raises UsageError as `load_sensor_setup`.
    """
    if config.file is None:
        return {}
    from vislam.datasets.sensor_files import local_frame  # most runs have no such file

    setup = load_sensor_setup(Path(config.file))
    datums = dict(setup.datums)
    for name, file in setup.files.items():
        if name not in datums and file.format != "csv":
            try:
                datums[name] = local_frame(file).datum
            except DataError:  # no good fix: reading the file reports it
                continue
    return datums


class GeodeticOutputs:
    """Knows which sensors have a datum, and writes trajectories by the first one whose frame was found."""

    def __init__(self, datums: Mapping[str, Geodetic]) -> None:
        """Take the datums that are known before the run."""
        self._datums = dict(datums)

    def write(
        self, out: Path, sensors: dict[str, dict[str, Any]], trajectories: Mapping[str, Trajectory]
    ) -> dict[str, Any] | None:
        """Write tables and lines of a run, if a sensor has a datum; return the sensor's name and its datum.

        Args:
            out: the folder of the run; where it has states with covariances, the tables have sigmas.
            sensors: what `metrics.json` has of further sensors; their datum is added. A receiver at a port has reported
                its own there.
            trajectories: of the filter in `odom` and of the graph in `map`, by "filter" and "graph".
        """
        reported = {name: Geodetic(**entry["datum"]) for name, entry in sensors.items() if "datum" in entry}
        used = None
        for name, datum in {**self._datums, **reported}.items():
            if (entry := sensors.get(name)) is None:
                continue
            entry["datum"] = asdict(datum)
            places = {
                by: places_of(trajectory, frame, datum)
                for by, trajectory in trajectories.items()
                if len(trajectory) and (frame := _frame(entry, by)) is not None
            }
            if used is None and places:
                used = {"sensor": name, **asdict(datum)}
                sigmas = {by: _sigmas(out / _STATES[by], trajectories[by], entry, by) for by in places}
                _write(out, {by: trajectories[by] for by in places}, places, sigmas)
        return used


def places_of(trajectory: Trajectory, frame: Array, datum: Geodetic) -> list[Geodetic]:
    """Return where the body was: by `T_frame_world` as yaw, x, y, z [4], or [0] of a world that is the frame."""
    local, (R, t) = LocalFrame(datum), frame_pose(frame)
    return [local.geodetic(place) for place in trajectory.positions_m @ R.T + t]


def most_sigmas(
    states: Sequence[NavState], t_ns: NDArray[np.int64], positions_m: Array, frame: Array, frame_sigmas: Array
) -> Array:
    """Return what sigmas east, north, up [N, 3] of placed positions are at most, however body and frame hang together.

    The sigma of a sum is at most the sum of the sigmas: of the body in the run's world, between `states` interpolated;
    of the frame's heading by how far the body is from where the world begins; and of the frame's origin.

    Args:
        states: with covariances, ascending; before the first and after the last they count as they are there.
        t_ns: [N] of the positions.
        positions_m: [N, 3] in the run's world.
        frame: yaw, x, y, z [4] of the frame, or [0] of a world that is the frame.
        frame_sigmas: theirs.
    """
    R, _ = frame_pose(frame)
    of_body = np.array([np.sqrt(np.diag(R @ state.covariance[3:6, 3:6] @ R.T)) for state in states])
    stamps = np.array([state.t_ns for state in states])
    sigmas = np.column_stack([np.interp(t_ns, stamps, of_body[:, axis]) for axis in range(3)])
    if len(frame):
        lever = np.abs(np.cross(UP, positions_m @ R.T))
        sigmas += frame_sigmas[0] * lever + frame_sigmas[1:4]
    return np.asarray(sigmas)


def lines_on_a_map(places: Mapping[str, list[Geodetic]]) -> dict[str, Any]:
    """Return lines as GeoJSON (RFC 7946: longitude first, cut where they cross the meridian of 180 degrees)."""
    features = []
    for name, line in places.items():
        parts = [part for part in _cut(line) if len(part) > 1]
        if parts:
            kind, coordinates = ("LineString", parts[0]) if len(parts) == 1 else ("MultiLineString", parts)
            geometry = {"type": kind, "coordinates": coordinates}
            features.append({"type": "Feature", "properties": {"estimator": name}, "geometry": geometry})
    return {"type": "FeatureCollection", "features": features}


def _frame(entry: Mapping[str, Any], by: str) -> Array | None:
    """Return the frame's variables by an estimator [4], [0] of a known frame; None where they are not found yet."""
    return _of_frame(entry, by, "values")


def _of_frame(entry: Mapping[str, Any], by: str, what: str) -> Array | None:
    """Return "values" or "sigmas" of the frame's variables; see `_frame`."""
    names, found = entry["variables"], entry.get(by)
    if not set(_FRAME) <= set(names):
        return np.zeros(0) if entry["begun"] else None
    return None if found is None else np.array([found[what][names.index(name)] for name in _FRAME])


def _sigmas(states: Path, trajectory: Trajectory, entry: Mapping[str, Any], by: str) -> Array | None:
    """Return the sigmas [N, 3] of a table; None where the run has no covariances."""
    frame, frame_sigmas = _of_frame(entry, by, "values"), _of_frame(entry, by, "sigmas")
    found = read_states_csv(states)[1] if states.is_file() else []
    if not found or frame is None or frame_sigmas is None:
        return None
    return most_sigmas(found, trajectory.t_ns, trajectory.positions_m, frame, frame_sigmas)


def _write(
    out: Path,
    trajectories: Mapping[str, Trajectory],
    places: Mapping[str, list[Geodetic]],
    sigmas: Mapping[str, Array | None],
) -> None:
    for by, trajectory in trajectories.items():
        rows = [(t_ns, *_text(place)) for t_ns, place in zip(trajectory.t_ns.tolist(), places[by], strict=True)]
        if (most := sigmas[by]) is None:
            table = csv_text(COLUMNS, rows)
        else:
            shown = [[f"{sigma:.{_HEIGHT_DIGITS}f}" for sigma in row] for row in most.tolist()]
            table = csv_text(COLUMNS + SIGMA_COLUMNS, [(*row, *of) for row, of in zip(rows, shown, strict=True)])
        write_text(out / TABLES[by], table)
    write_text(out / LINES, json.dumps(lines_on_a_map(places)) + "\n")


def _text(place: Geodetic) -> tuple[str, str, str]:
    latitude, longitude = (f"{angle:.{_DIGITS}f}" for angle in (place.latitude_deg, place.longitude_deg))
    return latitude, longitude, f"{place.height_m:.{_HEIGHT_DIGITS}f}"


def _cut(line: list[Geodetic]) -> list[list[list[float]]]:
    """Return a line in parts that stay on their side of the meridian of 180 degrees, as longitude, latitude, height."""
    parts: list[list[list[float]]] = [[]]
    for k, place in enumerate(line):
        here = [place.longitude_deg, place.latitude_deg, place.height_m]
        before = [line[k - 1].longitude_deg, line[k - 1].latitude_deg, line[k - 1].height_m] if k else here
        if abs(here[0] - before[0]) > 180.0:
            side = 180.0 if before[0] > 0.0 else -180.0
            way = here[0] + 2.0 * side - before[0]  # of longitude, the short way round
            share = (side - before[0]) / way if way else 0.5
            middle = [b + share * (h - b) for b, h in zip(before[1:], here[1:], strict=True)]
            parts[-1].append(_rounded([side, *middle]))
            parts.append([_rounded([-side, *middle])])
        parts[-1].append(_rounded(here))
    return parts


def _rounded(place: list[float]) -> list[float]:
    return [round(place[0], _DIGITS), round(place[1], _DIGITS), round(place[2], _HEIGHT_DIGITS)]
