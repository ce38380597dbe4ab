"""ORB-SLAM3 (package pyorbslam3) over one recording, in a process of its own.

    python orbslam3_peer.py MODE ROOT OUT.tum VOCABULARY PACE [FINAL.tum "pyorbslam3 VERSION"]

MODE: rgbd (ROOT is a TUM freiburg1 folder), stereo or mono (with the IMU; ROOT is a EuRoC folder). Local mapping and
loop closing are threads that take what is there, so PACE sets how fast frames come: 1 is as they were recorded.
Settings are those of the examples that ORB-SLAM3 brings for these cameras. Poses are those that tracking returns with
each frame; those in FINAL.tum are what ORB-SLAM3 saves in the end. This file is MIT; ORB-SLAM3 is GPL-3.0, and nothing
of vislam runs in this process.
"""

import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import pyorbslam3
from slam_recording import (
    FR1_CAMERA,
    FR1_DEPTH_UNITS_PER_M,
    Euroc,
    Outcome,
    TumRgbd,
    image,
    require,
    wait_until,
    write_tum,
)

_VIEWER = {
    "KeyFrameSize": 0.05, "KeyFrameLineWidth": 1.0, "GraphLineWidth": 0.9, "PointSize": 2.0, "CameraSize": 0.08,
    "CameraLineWidth": 3.0, "ViewpointX": 0.0, "ViewpointY": -0.7, "ViewpointZ": -1.8, "ViewpointF": 500.0,
}  # fmt: skip  # is asked for even where there is no viewer
_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_DRAIN_S = 3.0  # that mapping may take to finish what it has


def settings(size, fps, features):
    """Return the head of a settings file."""
    return {
        "File.version": '"1.0"', "Camera.type": '"PinHole"', "Camera.width": size[0], "Camera.height": size[1],
        "Camera.fps": fps, "Camera.RGB": 1, "ORBextractor.nFeatures": features, "ORBextractor.scaleFactor": 1.2,
        "ORBextractor.nLevels": 8, "ORBextractor.iniThFAST": 20, "ORBextractor.minThFAST": 7,
        **{f"Viewer.{name}": value for name, value in _VIEWER.items()},
    }  # fmt: skip


def camera(number, intrinsics, distortion):
    """Return the settings of a camera, 1 or 2."""
    values = zip(_NAMES, [*intrinsics, *distortion], strict=False)
    return {f"Camera{number}.{name}": float(value) for name, value in values}


def write(path, values):
    """Write a settings file as OpenCV reads it; arrays become its matrices."""
    lines = ["%YAML:1.0"]
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            numbers = ", ".join(f"{number:.12f}" for number in value.ravel())
            lines += [f"{name}: !!opencv-matrix", "  rows: 4", "  cols: 4", "  dt: f", f"  data: [{numbers}]"]
        else:
            lines.append(f"{name}: {value}")
    with open(path, "w") as file:
        file.write("\n".join(lines) + "\n")


def rgbd(root, work, vocabulary):
    """Return the recording, how to track frame i, the body in the camera, and the system."""
    recording = TumRgbd(root)
    values = settings((640, 480), 30, 1000) | camera(1, *FR1_CAMERA)
    values |= {"Stereo.ThDepth": 40.0, "Stereo.b": 0.07732, "RGBD.DepthMapFactor": FR1_DEPTH_UNITS_PER_M}
    write(f"{work}/settings.yaml", values)
    system = pyorbslam3.Slam(vocabulary, f"{work}/settings.yaml", pyorbslam3.Sensor.RGBD)

    def track(i):
        colour, depth = recording.paths[i]
        rgb = cv2.cvtColor(image(colour, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        raw = image(depth, cv2.IMREAD_UNCHANGED).astype(np.float32)
        return system.track_rgbd(rgb, raw, recording.t_ns[i] * 1e-9)

    return recording, track, np.eye(4), system


def inertial(root, work, vocabulary, is_stereo):
    """Return the same for one or two cameras with an IMU."""
    recording = Euroc(root, ["cam0", "cam1"] if is_stereo else ["cam0"])
    first, imu = recording.sensors[0], recording.imu
    fps = round(1e9 / float(np.median(np.diff(recording.t_ns))))
    values = settings(first["resolution"], fps, 1200 if is_stereo else 1000)
    for number, sensor in enumerate(recording.sensors, 1):
        values |= camera(number, sensor["intrinsics"], sensor["distortion_coefficients"])
    if is_stereo:
        T_cam0_cam1 = np.linalg.inv(recording.T_body_cams[0]) @ recording.T_body_cams[1]
        values |= {"Stereo.ThDepth": 60.0, "Stereo.T_c1_c2": T_cam0_cam1}
    values |= {
        "IMU.T_b_c1": recording.T_body_cams[0], "IMU.Frequency": float(imu["rate_hz"]),
        "IMU.NoiseGyro": imu["gyroscope_noise_density"], "IMU.NoiseAcc": imu["accelerometer_noise_density"],
        "IMU.GyroWalk": imu["gyroscope_random_walk"], "IMU.AccWalk": imu["accelerometer_random_walk"],
    }  # fmt: skip
    write(f"{work}/settings.yaml", values)
    sensor = pyorbslam3.Sensor.IMU_STEREO if is_stereo else pyorbslam3.Sensor.IMU_MONOCULAR
    system = pyorbslam3.Slam(vocabulary, f"{work}/settings.yaml", sensor)
    rows = np.column_stack([recording.imu_t_ns * 1e-9, recording.imu_values])
    begin = np.searchsorted(recording.imu_t_ns, [recording.t_ns[0] - 50_000_000, *recording.t_ns], side="right")

    def track(i):
        images, since = [image(path) for path in recording.paths[i]], rows[begin[i] : begin[i + 1]]
        call = system.track_stereo if is_stereo else system.track_monocular
        return call(*images, recording.t_ns[i] * 1e-9, since)

    return recording, track, np.linalg.inv(recording.T_body_cams[0]), system


def saved(system, recording, T_cam_body, work, published):
    """Return what ORB-SLAM3 saves in the end as (t_ns, T_world_body), level as its last published pose is.

    With an IMU it saves poses relative to the first keyframe's body and so loses where down is; the poses that it
    published, also (t_ns, T_world_body), know.
    """
    path = Path(work) / "saved.txt"
    (system.save_trajectory_euroc if system.inertial else system.save_trajectory_tum)(str(path))
    unit_ns, stamps = (1.0 if system.inertial else 1e9), np.array(recording.t_ns)
    rows = []
    for line in path.read_text().splitlines():
        t, x, y, z, *q = map(float, line.split())
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation(*q), (x, y, z)
        t_ns = int(stamps[np.abs(stamps - round(t * unit_ns)).argmin()])  # it keeps time as a double
        rows.append((t_ns, T if system.inertial else T @ T_cam_body))  # with an IMU they are the body's already
    known = dict(published)
    last = next(((T, known[t_ns]) for t_ns, T in reversed(rows) if t_ns in known), None)
    if system.inertial and last is not None:
        T_world_first = last[1] @ np.linalg.inv(last[0])
        rows = [(t_ns, T_world_first @ T) for t_ns, T in rows]
    return rows


def rotation(x, y, z, w):
    """Return the rotation [3, 3] of a quaternion."""
    x, y, z, w = np.array([x, y, z, w]) / np.linalg.norm([x, y, z, w])
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def main():
    """Run one mode."""
    mode, root, out, vocabulary, pace, *final = sys.argv[1:]
    if final:
        require(final[1])
    if mode not in ("rgbd", "stereo", "mono"):
        sys.exit(f"ORB-SLAM3 knows no mode {mode}; it does mono, stereo and rgbd")
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as work:
        opened = rgbd(root, work, vocabulary) if mode == "rgbd" else inertial(root, work, vocabulary, mode == "stereo")
        recording, track, T_cam_body, system = opened
        outcome, begun_s = Outcome("pyorbslam3", recording.t_ns), time.monotonic()
        for i, t_ns in enumerate(recording.t_ns):
            wait_until(t_ns, recording.t_ns[0], begun_s, float(pace))
            result = track(i)
            if result.pose_valid:
                outcome.add(t_ns, np.array(result.pose_wc) @ T_cam_body)
        time.sleep(_DRAIN_S)
        system.shutdown()
        outcome.report(out)
        if final:
            write_tum(final[0], saved(system, recording, T_cam_body, work, outcome.rows))


if __name__ == "__main__":
    main()
