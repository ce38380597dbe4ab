"""What the SLAM peers need of a recording, read without vislam so that they do not pay for its imports.

`Euroc` and `TumRgbd` list images, inertial samples and calibration; `Outcome` keeps the poses that a peer published and
reports what it cost. Used by orbslam3_peer.py and basalt_peer.py, which `vislam compare --peer` and
benchmarks/peers_cost.py run in processes of their own, with an interpreter that has the peer.
"""

import csv
import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import yaml

FR1_CAMERA = [517.306408, 516.469215, 318.643040, 255.313989], [0.262383, -0.953104, -0.005358, 0.002628, 1.163314]
FR1_DEPTH_UNITS_PER_M = 5000.0
_RADTAN = ("radial-tangential", "radtan", "plumb_bob", "none")  # what the peers' pinhole cameras understand
_PAIRED_S = 0.02  # most between a colour and a depth image


def image(path, flags=cv2.IMREAD_GRAYSCALE):
    """Return an image; raises OSError when it cannot be read."""
    read = cv2.imread(str(path), flags)
    if read is None:
        raise OSError(f"{path} cannot be read")
    return read


class Euroc:
    """A EuRoC folder: cameras, their images by stamp, and inertial samples."""

    def __init__(self, root, cameras):
        """List the frames that all of `cameras` ("cam0", "cam1") have."""
        self._mav = Path(root) / "mav0"
        if not (self._mav / "imu0" / "sensor.yaml").is_file():
            sys.exit(f"{root} is no EuRoC folder with an IMU: mav0/imu0/sensor.yaml is missing")
        if missing := [camera for camera in cameras if not (self._mav / camera / "sensor.yaml").is_file()]:
            sys.exit(f"{root} has no camera {missing[0]}")
        self.sensors = [self._yaml(camera) for camera in cameras]
        for sensor in self.sensors:
            kind, distortion = sensor.get("camera_model", "pinhole"), sensor.get("distortion_model", "none")
            if kind != "pinhole" or distortion not in _RADTAN:
                sys.exit(f"{root}: lenses of model {kind}, {distortion} are not for this peer; radial-tangential")
        self.T_body_cams = [np.array(s["T_BS"]["data"], dtype=float).reshape(4, 4) for s in self.sensors]
        self.imu = self._yaml("imu0")
        images = [self._images(camera) for camera in cameras]
        self.t_ns = sorted(set.intersection(*map(set, images)))
        self.paths = [[each[t_ns] for each in images] for t_ns in self.t_ns]
        rows = self._rows("imu0")
        if not self.t_ns or not rows:
            sys.exit(f"{root} has {len(self.t_ns)} frames that all cameras have, and {len(rows)} inertial samples")
        self.imu_t_ns = np.array([int(row[0]) for row in rows])
        self.imu_values = np.array([[float(value) for value in row[1:7]] for row in rows])  # gyro, accelerometer [N, 6]

    def _yaml(self, sensor):
        return yaml.safe_load((self._mav / sensor / "sensor.yaml").read_text().replace("%YAML:1.0", ""))

    def _rows(self, sensor):
        with (self._mav / sensor / "data.csv").open() as file:
            return [row for row in csv.reader(file) if row and not row[0].startswith("#")]

    def _images(self, camera):
        paths = {int(row[0]): self._mav / camera / "data" / row[1].strip() for row in self._rows(camera)}
        return {t_ns: path for t_ns, path in paths.items() if path.exists()}


class TumRgbd:
    """A TUM RGB-D folder of freiburg1: pairs of colour and depth images."""

    def __init__(self, root):
        """List the colour images with a depth image within 20 ms."""
        if not (Path(root) / "depth.txt").is_file():
            sys.exit(f"{root} is no TUM RGB-D folder: depth.txt is missing")
        colour, depth = self._list(Path(root), "rgb.txt"), self._list(Path(root), "depth.txt")
        stamps_s = np.array([t_ns * 1e-9 for t_ns, _ in depth])
        self.t_ns, self.paths = [], []
        for t_ns, path in colour:
            apart_s = np.abs(stamps_s - t_ns * 1e-9)
            if apart_s.min() < _PAIRED_S:
                self.t_ns.append(t_ns)
                self.paths.append([path, depth[int(apart_s.argmin())][1]])

    def _list(self, root, name):
        rows = [line.split() for line in (root / name).read_text().splitlines() if line and not line.startswith("#")]
        return [(int(row[0].replace(".", "").ljust(19, "0")), root / row[1]) for row in rows]


def require(words):
    """End the process when a package has another version than "NAME VERSION" states: it is part of what a result is."""
    name, wanted = words.split()
    if version(name) != wanted:
        sys.exit(f"{name} {version(name)} is installed here, {wanted} was asked for")


def wait_until(t_ns, first_ns, begun_s, pace):
    """Wait until a frame is due when the recording is played `pace` times as fast as it was made."""
    late_s = time.monotonic() - begun_s - (t_ns - first_ns) * 1e-9 / pace
    if late_s < 0.0:
        time.sleep(-late_s)


class Outcome:
    """The poses that a peer published, and what there is to say of the run."""

    def __init__(self, package, t_ns):
        """`t_ns`: of all frames that the peer is given."""
        self._versions = {package: version(package)}
        self._first_ns, self._frames = t_ns[0], len(t_ns)
        self.rows, self._first = [], (None, None)

    def add(self, t_ns, T_world_body, cpu_s=None):
        """Take a published pose [4, 4]; `cpu_s` is what this process had used when it came, by default until now."""
        if not self.rows:
            self._first = (t_ns - self._first_ns) * 1e-9, time.process_time() if cpu_s is None else cpu_s
        self.rows.append((t_ns, T_world_body))

    def report(self, out):
        """Write the trajectory to `out` and print the rest as a line of JSON."""
        write_tum(out, self.rows)
        facts = {"versions": self._versions, "frames": self._frames, "poses": len(self.rows)}
        print(json.dumps(facts | {"first_pose_s": self._first[0], "first_pose_cpu_s": self._first[1]}))
        sys.stdout.flush()


def write_tum(out, rows):
    """Write (t_ns, T_world_body [4, 4]) as a TUM file."""
    with Path(out).open("w") as file:
        for t_ns, T in rows:
            seconds, rest = divmod(t_ns, 10**9)
            numbers = " ".join(f"{value:.9f}" for value in (*T[:3, 3], *_quaternion_xyzw(T[:3, :3])))
            file.write(f"{seconds}.{rest:09d} {numbers}\n")


def _quaternion_xyzw(R):
    """Return the quaternion of a rotation [3, 3]: the eigenvector of Bar-Itzhack's matrix."""
    K = np.array([
        [R[0, 0] - R[1, 1] - R[2, 2], 0.0, 0.0, 0.0],
        [R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], 0.0, 0.0],
        [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[2, 2] - R[0, 0] - R[1, 1], 0.0],
        [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], np.trace(R)],
    ])  # fmt: skip
    return np.linalg.eigh(K / 3.0)[1][:, -1]  # eigh reads the lower triangle
