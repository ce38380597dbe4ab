"""Which way is up in a finished run without gravity, and what is final of it turned so that z of `map` is up.

What was published while the run went on (`odom`, the causal trajectories, the viewer's recording) and the session stay
in the axes of the first image; decision 10 has the reason. A run that begins in the map of another has it level from
the beginning on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vislam.config import Config
from vislam.core.angles import angle_deg
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.geometry import are_rotations, transform
from vislam.core.messages import Array, NavState
from vislam.core.recording import Recording
from vislam.core.trajectory import Trajectory
from vislam.core.up import Up, parse_up
from vislam.datasets.stream import FileRecording
from vislam.frontend.planar import up_in_camera
from vislam.mapping.file_names import LEVEL, NotLevel
from vislam.mapping.mapper import Mapper
from vislam.mapping.upright import surest_up
from vislam.runs.pipeline import FrontHalf
from vislam.trajectory.gravity_mean import up_of_forces

_APART_SIGMAS = 4.0  # by so much accelerometer and surfaces may differ before that is said
_APART_DEG = 5.0  # and at least by so much: floors and sensors lean
_NEXT = "say it with --up X,Y,Z in the first camera's axes, or --up camera where the first image is upright"


@dataclass(frozen=True, slots=True, eq=False)
class Levelled:
    """Up of a run, and the turn that everything final gets; of a run that knows gravity, nothing and no turn.

    Attributes:
        up: None where gravity is known.
        asked: what each source gives that was asked; surfaces are the last.
        of_map: up of the map in which a run began that was not found in it, so that `up` is of its own frame alone.
    """

    up: Up | None = None
    asked: tuple[Up, ...] = ()
    of_map: Up | None = None

    @property
    def in_map(self) -> Levelled:
        """The same of the map and its files."""
        return self if self.of_map is None else Levelled(self.of_map)

    @property
    def is_level(self) -> bool:
        """Whether z of what is final is up."""
        return self.up is None or self.up.is_known

    @property
    def T_level_map(self) -> Array:
        """The turn [4, 4] from the frame in which the run was estimated."""
        return np.eye(4) if self.up is None else self.up.T_level_map

    @property
    def not_level(self) -> NotLevel:
        """Why there are no grids of the map, or of submaps."""
        if self.up is None:
            return LEVEL
        why = f"which way is up is not known ({self.up.reason}); {_NEXT}"
        apart = "no loop joined this submap with the map, so which way is up in it is not known"
        return NotLevel(None if self.up.is_known else why, apart)

    @property
    def warnings(self) -> list[str]:
        """What there is to say of it."""
        if self.up is None:
            return []
        if not self.up.is_known:
            return [
                f"z of the map is that of the first image: which way is up is not known ({self.up.reason}); {_NEXT}"
            ]
        if self._apart_deg is not None and self._apart_deg > self._allowed_deg:
            return [
                f"up by {self.up.source} is {self._apart_deg:.1f} deg from what floors and walls say; look at the map, "
                f"and {_NEXT}"
            ]
        return []

    @property
    def _apart_deg(self) -> float | None:
        """By how much surfaces differ from the source that was believed before them."""
        *others, planes = self.asked or (Up.unknown("no source was asked"),)
        first = next((up.direction for up in others if up.direction is not None), None)
        return None if first is None or planes.direction is None else angle_deg(first, planes.direction)

    @property
    def _allowed_deg(self) -> float:
        return max(_APART_DEG, _APART_SIGMAS * _together_deg([up for up in self.asked if up.is_known]))

    def entry(self, path: Trajectory, rig: Rig) -> dict[str, Any]:
        """Return it as `{"up": ...}`, as metrics.json has it; empty with gravity. `path` [N] is as estimated."""
        if self.up is None:
            return {}
        direction = None
        if self.up.direction is not None and len(path):
            R_map_cam = path.T_world_body[0, :3, :3] @ rig.T_body_cams[0][:3, :3]
            direction = (R_map_cam.T @ self.up.direction).tolist()
        entry = {**self.up.entry(), "direction_cam0": direction, "R_map_odom": self.T_level_map[:3, :3].tolist()}
        asked = {up.source: up.entry() for up in self.asked if up.is_known}
        return {"up": {**entry, "from_planes_deg": self._apart_deg, "asked": asked}}

    def trajectory(self, path: Trajectory) -> Trajectory:
        """Return a trajectory in the level frame."""
        return path if self.up is None or not self.up.is_known else path.transformed(self.T_level_map)

    def export(self, mapper: Mapper, folder: Path) -> Mapper:
        """Write the files of a map in the level frame; return the map as they have it. Raises StorageError."""
        level = (mapper if self.up is None else mapper.turned(self.T_level_map)).refined()
        level.export(folder, not_level=self.not_level)
        return level

    def states(self, states: Sequence[NavState]) -> list[NavState]:
        """Return states in the level frame; covariances of rotation and position are the body's, and stay."""
        if self.up is None or not self.up.is_known:
            return list(states)
        T = self.T_level_map
        return [
            replace(s, T_world_body=T @ s.T_world_body, velocity_world_m_s=T[:3, :3] @ s.velocity_world_m_s)
            for s in states
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What a finished run brings to the question.

    Attributes:
        path: the final trajectory, in the frame in which it was estimated.
        mapper: None where there is no map to ask.
        front: what started, and how a camera over a floor looks at it.
        base: the map in which the run began, as its session has it; None where it began in none.
        is_found: whether it was found in it.
    """

    path: Trajectory
    mapper: Mapper | None
    front: FrontHalf
    base: dict[str, Any] | None = None
    is_found: bool = False


def find_up(recording: Recording, config: Config, known: Known) -> Levelled:
    """Return which way is up, without gravity: by the map, as given, the accelerometer, the floor, or surfaces.

    The map comes first: its frame is that of the files, the session and what was published.
    """
    if known.front.start is not None or not len(known.path):
        return Levelled()
    of_map = stored_up(known.base or {})
    if known.base is not None and not known.is_found:
        own = _by_itself(recording, config, replace(known, mapper=None))  # whose surfaces are the map's
        return replace(own, of_map=of_map or Up.unknown("the run was not found in it"))
    if of_map is None:
        return _by_itself(recording, config, known)
    unused = "" if config.up == "auto" else f"; --up {config.up} is not used where the map knows it"
    return Levelled(replace(of_map, source="map", reason=of_map.reason + unused))


def _by_itself(recording: Recording, config: Config, known: Known) -> Levelled:
    """Return which way is up as given, or by what was measured."""
    given = parse_up(config.up)
    if not isinstance(given, str):
        up = known.path.T_world_body[0, :3, :3] @ recording.rig.T_body_cams[0][:3, :3] @ given
        return Levelled(Up("told", up / np.linalg.norm(up), None, 1.0, f"--up {config.up}"))
    if given == "none":
        return Levelled(Up.unknown("--up none"))
    if given == "camera":
        return Levelled(Up("camera", np.array([0.0, 0.0, 1.0]), None, 1.0, "--up camera: as the first image has it"))
    planes = Up.unknown("there is no map to look at") if known.mapper is None else surest_up(known.mapper.views)
    others = [_by_forces(recording, known.path), _by_floor(known, recording.rig)]
    asked = (*(up for up in others if up is not None), planes)
    first = next((up for up in asked if up.is_known), None)
    if first is None:
        return Levelled(Up.unknown("; ".join(up.reason for up in asked)))
    return Levelled(first if first is planes else with_planes(first, planes), asked)


def with_planes(first: Up, planes: Up) -> Up:
    """Return both as one, weighted by their sigmas, where they agree; the first alone where they do not.

    Sigma is that of the surer one: both use one trajectory, so their errors are not independent.
    """
    if first.direction is None or planes.direction is None or not first.sigma_deg or not planes.sigma_deg:
        return first
    apart_deg = angle_deg(first.direction, planes.direction)
    if apart_deg > _APART_SIGMAS * _together_deg([first, planes]):
        return first
    up = first.direction / first.sigma_deg**2 + planes.direction / planes.sigma_deg**2
    reason = f"{first.reason}; surfaces agree to {apart_deg:.1f} deg, both weighted by their sigmas"
    sigma_deg = min(first.sigma_deg, planes.sigma_deg)
    return replace(first, direction=up / np.linalg.norm(up), sigma_deg=sigma_deg, reason=reason)


def _together_deg(ups: Sequence[Up]) -> float:
    """Return the sigma of the angle between directions."""
    return float(np.sqrt(sum((up.sigma_deg or 0.0) ** 2 for up in ups)))


def up_sentence(entry: dict[str, Any]) -> str:
    """Return the entry `up` of metrics.json in words; without a full stop."""
    reason = str(entry.get("reason", ""))
    if entry.get("direction") is None:
        return f"Which way is up is not known, and no grid is written: {reason}"
    sigma = entry.get("sigma_deg")
    accuracy = f" to {sigma:.1f} deg" if isinstance(sigma, int | float) else ""
    return f"Up by {entry.get('source', 'unknown')}{accuracy}: {reason}"


def onto_map(path: Trajectory, name: str, metrics: dict[str, Any]) -> Trajectory:
    """Return a trajectory of a run folder in `map`: the causal ones of a run without gravity are as published."""
    entry = metrics.get("up")
    R = entry.get("R_map_odom") if isinstance(entry, dict) else None
    if R is None or name not in ("ekf", "live"):
        return path
    try:
        R = np.array(R, dtype=np.float64).reshape(3, 3)
    except (TypeError, ValueError):
        return path  # no matrix: shown as it is
    return path.transformed(transform(R, np.zeros(3))) if are_rotations(R, 1e-6) else path


def stored_up(info: dict[str, Any]) -> Up | None:
    """Return what a session remembers of up in its map; None where it is not known. Raises DataError on nonsense."""
    of_map = (info.get("map") or {}).get("up")  # in which it began, and was found or not
    try:
        ups = [Up.from_entry(entry) for entry in (of_map, info.get("up")) if entry is not None]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"what is stored of up cannot be used ({error}); run the recording again") from error
    return next((up for up in ups if up.is_known), None)


def stored_level(info: dict[str, Any]) -> Levelled:
    """Return by which turn the final files of a run are level; none where gravity or nothing is known."""
    return Levelled(stored_up(info))


def _by_forces(recording: Recording, path: Trajectory) -> Up | None:
    """Return what an accelerometer without a gyroscope shows, None where there is none."""
    if not isinstance(recording, FileRecording):
        return None
    try:
        samples = recording.forces()
    except DataError as error:
        return Up.unknown(f"the accelerometer does not show it: {error}")
    return None if samples is None else up_of_forces(path, *samples)


def _by_floor(known: Known, rig: Rig) -> Up | None:
    """Return the floor's normal where odometry uses a floor, None elsewhere."""
    mount = known.front.report().calibration
    if mount.get("tilt_deg") is None or mount.get("roll_deg") is None:
        return None
    tilt, roll = np.deg2rad([mount["tilt_deg"], mount["roll_deg"]])
    up_body = rig.T_body_cams[0][:3, :3] @ up_in_camera(tilt, roll)
    up = np.mean(known.path.T_world_body[:, :3, :3] @ up_body, axis=0)
    return Up("floor", up / np.linalg.norm(up), None, 1.0, "the normal of the floor that odometry uses")
