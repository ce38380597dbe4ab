"""A recording seen with the calibration files that the user names instead of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from vislam.config import CalibrationConfig, Config
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.core.recording import Problems
from vislam.datasets.calibration import DepthFile, parse_depth, warn_once
from vislam.datasets.camera_files import read_cameras
from vislam.datasets.foreign_cameras import CameraCalibration, load_keys
from vislam.datasets.imu_files import read_imu_calibration, read_mag_calibration, read_noise
from vislam.datasets.stream import KnownCamera, Survey, with_depth_format

_OFFSET_WIDER = 3.0  # sigmas of a calibrated time offset that a later day may be off
_LEAST_OFFSET_SIGMA_S = 0.001
_RATE_SAMPLES = 400  # from which the usual rate of an IMU is taken


def calibrated(found: Survey, files: CalibrationConfig) -> Survey:
    """Return what a recording holds, with its calibration replaced where a file is named.

    Raises DataError when a file cannot be used, or has another number of cameras or another image size.
    """
    given = () if files.camera is None else _against_first(Path(files.camera))
    found = _moved(found, given or found.clocks, str(files.camera if given else found.root))
    if files.camera is not None and (found.rig is not None or found.known_cameras):
        found = replace(found, rig=_rig(found, Path(files.camera)), lacking=_without(found, "camera"))
    if files.camera is not None:
        found = _with_depth(found, Path(files.camera))
    if files.imu is not None:
        found = replace(found, imu_calibration=read_imu_calibration(Path(files.imu)))
    topic = next((one.name for one in found.topics if one.taken_for in ("imu0", "rates of imu0")), "")
    if files.imu_noise is not None and found.imu_noise is not None:
        noise = read_noise(Path(files.imu_noise), topic)
        found = replace(found, imu_noise=replace(noise, rate_hz=found.imu_noise.rate_hz or noise.rate_hz))
    elif files.imu_noise is not None and "imu_noise" in found.lacking:
        noise = read_noise(Path(files.imu_noise), topic)
        found = replace(found, imu_noise=noise, lacking=_without(found, "imu_noise"))
    if files.mag is not None:
        found = replace(found, mag_calibration=read_mag_calibration(Path(files.mag)))
    return found


def with_imu_rate(found: Survey) -> Survey:
    """Return what a recording holds, with the usual rate of its first inertial samples where no file states it.

    Raises DataError where there are not two of them.
    """
    if found.imu_noise is None or found.imu_noise.rate_hz > 0.0 or not found.has_imu:
        return found
    stamps = [t_ns for t_ns, _ in islice(found.imu_rows(Problems()), _RATE_SAMPLES)]
    steps_ns = np.diff(np.array(stamps, dtype=np.int64))
    steps_ns = steps_ns[steps_ns > 0]
    if len(steps_ns) == 0:
        raise DataError(f"{found.root}: no file states the IMU's rate, and it has {len(stamps)} samples; write rate_hz")
    return replace(found, imu_noise=replace(found.imu_noise, rate_hz=1e9 / float(np.median(steps_ns))))


def joined_rig(known: Sequence[KnownCamera], has_depth: bool) -> Rig | None:
    """Return the rig of cameras of which all is known, None where something is not."""
    whole = [(one.camera, one.T_body_cam) for one in known if one.camera is not None and one.T_body_cam is not None]
    if not known or len(whole) != len(known):
        return None
    return Rig(tuple(camera for camera, _ in whole), tuple(T for _, T in whole), has_depth)


def with_clock(config: Config) -> Config:
    """Return the settings with the time offset of the camera's calibration file, unless they have their own."""
    if config.calibration.camera is None or config.init.time_offset_s != 0.0:
        return config
    first = read_cameras(Path(config.calibration.camera))[0]
    if first.time_offset_s is None:
        return config
    init = replace(config.init, time_offset_s=first.time_offset_s)
    if first.time_offset_sigma_s is not None:
        sigma_s = max(_OFFSET_WIDER * first.time_offset_sigma_s, _LEAST_OFFSET_SIGMA_S)
        init = replace(init, time_offset_sigma_s=min(sigma_s, init.time_offset_sigma_s))
    return replace(config, init=init)


def _against_first(path: Path) -> list[float | None]:
    """Return what is to be added to stamps of cameras in s, beyond the first's (`with_clock`); empty if not stated."""
    first, *others = (camera.time_offset_s for camera in read_cameras(path))
    if first is None:
        if any(other is not None for other in others):
            raise DataError(f"{path}: timeshift_cam_imu stands for cam1 alone; write cam0's, too")
        return []
    return [0.0, *(None if other is None else other - first for other in others)]


def _moved(found: Survey, clocks: Sequence[float | None], of: str) -> Survey:
    """Return what a recording holds, with the stamps of its cameras moved, which is stated."""
    later_ns = [round((clock or 0.0) * 1e9) for clock in clocks][: len(found.cameras)]
    if not any(later_ns):
        return found
    pairs = zip(found.cameras, [*later_ns, *[0] * len(found.cameras)], strict=False)
    cameras = tuple(replace(camera, t_ns=camera.t_ns + ns) for camera, ns in pairs)
    moves = ", ".join(f"{camera.name} {ns * 1e-6:+.3f} ms" for camera, ns in zip(cameras, later_ns, strict=False) if ns)
    warn_once(f"stamps are moved by timeshift_cam_imu of {of}: {moves}")
    depth = found.depth  # its stamps are of the first camera's clock
    return replace(
        found,
        cameras=cameras,
        depth=None if depth is None else replace(depth, t_ns=depth.t_ns + later_ns[0]),
        clocks=(),
    )


def _with_depth(found: Survey, path: Path) -> Survey:
    """Return what a recording holds, with its depth read as the camera's file states, if it does."""
    said = parse_depth(keys := load_keys(path), path)
    if said == DepthFile() or found.depth is None:
        return found
    if found.streams is not None and any(str(key).startswith("depth_") for key in keys):
        raise DataError(f"{path} states how depth is read, which a bag's messages state already; leave depth_... out")
    return found if found.streams is not None else with_depth_format(found, said.over(found.depth_format))


def _without(found: Survey, name: str) -> dict[str, DataError]:
    return {key: error for key, error in found.lacking.items() if key != name}


def _rig(found: Survey, path: Path) -> Rig:
    """Return the rig of a recording by a file, which goes before what the recording states of its cameras."""
    cameras, known = read_cameras(path), found.known_cameras
    if found.rig is not None:
        known = tuple(map(KnownCamera, found.rig.cameras, found.rig.T_body_cams))
    if len(cameras) < len(known):
        raise DataError(f"{path} has {len(cameras)} camera, the recording has {len(known)}; calibrate both")
    for index, (new, old) in enumerate(zip(cameras, known, strict=False)):
        size = (new.camera.width, new.camera.height)
        if old.camera is not None and size != (old.camera.width, old.camera.height):
            raise DataError(
                f"{path}: cam{index} is for {size[0]}x{size[1]}, the recording has "
                f"{old.camera.width}x{old.camera.height}; calibrate at the size that is recorded"
            )
    T_ins = _placed(cameras, [old.T_body_cam for old in known])
    has_depth = found.depth is not None if found.rig is None else found.rig.has_depth
    rig = joined_rig([KnownCamera(new.camera, T) for new, T in zip(cameras, T_ins, strict=False)], has_depth)
    if rig is None:
        missing = next(k for k, T in enumerate(T_ins) if T is None)
        raise DataError(f"{path} does not state where cam{missing} sits, nor does the recording: it needs T_cam_imu")
    return rig


def _placed(cameras: Sequence[CameraCalibration], recorded: Sequence[Array | None]) -> list[Array | None]:
    """Return where cameras are: as their file states, by the body or by the camera before, else as recorded."""
    found: list[Array | None] = []
    for new, old in zip(cameras, recorded, strict=False):
        T = new.T_body_cam
        if T is None and new.T_before_cam is not None and found and found[-1] is not None:
            T = found[-1] @ new.T_before_cam
        found.append(old if T is None else np.asarray(T))
    return found
