"""Basalt's visual-inertial odometry (in package depthai) over one stereo recording, in a process of its own.

    python basalt_peer.py MODE ROOT OUT.tum WORK PACE "depthai VERSION"    all of it; WORK is a folder to throw away
    DAI_CALIB=CALIBRATION python basalt_peer.py calibrate ROOT
    LD_PRELOAD=shim.so DAI_LIB=libdepthaicore….so DAI_CALIB=CALIBRATION python basalt_peer.py run ROOT OUT.tum PACE

ROOT is a EuRoC folder. The node reads its calibration from a device; basalt_shim.cpp gives it the one that `calibrate`
wrote. PACE: how many times as fast as it was recorded the recording is played; frames wait for the estimator, none is
dropped. Basalt closes no loops. Basalt is BSD-3, depthai MIT.
"""

import os
import subprocess
import sys
import threading
import time
from datetime import timedelta
from pathlib import Path

import cv2
import depthai
import numpy as np
from slam_recording import Euroc, Outcome, image, require, wait_until

_LEFT, _RIGHT = depthai.CameraBoardSocket.CAM_B, depthai.CameraBoardSocket.CAM_C
_CM_PER_M = 100.0
_LEAD_NS = 10_000_000_000  # the node's clock begins so long before the first frame
_IMU_AHEAD_NS = 30_000_000  # samples that it wants before an image can be used
_MOST_WAITING = 6  # frames given and not answered
_PATIENCE_S = 30.0
_FIRST_S = 3.0  # before its first answer it may want more frames
_POLL_S = 0.002


def calibrate(recording, path):
    """Write the calibration of a stereo rig with an IMU as depthai keeps it."""
    handler = depthai.CalibrationHandler()
    for socket, sensor in zip((_LEFT, _RIGHT), recording.sensors, strict=True):
        fx, fy, cx, cy = sensor["intrinsics"]
        size = depthai.Size2f(*map(float, sensor["resolution"]))
        handler.setCameraIntrinsics(socket, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], size)
        handler.setDistortionCoefficients(socket, [*map(float, sensor["distortion_coefficients"]), *[0.0] * 10])
        handler.setCameraType(socket, depthai.CameraModel.Perspective)
    T_cam1_body = np.linalg.inv(recording.T_body_cams[1])
    R, t_cm = _parts(T_cam1_body @ recording.T_body_cams[0])
    handler.setCameraExtrinsics(_LEFT, _RIGHT, R, t_cm, t_cm)
    R, t_cm = _parts(T_cam1_body)
    handler.setImuExtrinsics(_RIGHT, R, t_cm, t_cm)
    handler.setStereoLeft(_LEFT, np.eye(3).tolist())
    handler.setStereoRight(_RIGHT, np.eye(3).tolist())
    handler.eepromToJsonFile(path)


def _parts(T):
    return T[:3, :3].tolist(), [float(value) * _CM_PER_M for value in T[:3, 3]]


class Odometry:
    """The node on the host, fed by hand."""

    def __init__(self, recording, outcome):
        """Start it."""
        self._recording, self._outcome = recording, outcome
        self._base_ns = recording.t_ns[0] - _LEAD_NS
        self._next_sample = int(np.searchsorted(recording.imu_t_ns, recording.t_ns[0] - 50_000_000))
        self._pipeline = depthai.Pipeline(createImplicitDevice=False)
        node = self._pipeline.create(depthai.node.BasaltVIO)
        node.runSyncOnHost(True)
        node.setImuUpdateRate(int(recording.imu["rate_hz"]))
        node.setGyroNoiseStd([recording.imu["gyroscope_noise_density"] ** 2] * 3)  # it takes the root
        node.setAccelNoiseStd([recording.imu["accelerometer_noise_density"] ** 2] * 3)
        self._inputs = [node.left.createInputQueue(16, True), node.right.createInputQueue(16, True)]
        self._samples = node.imu.createInputQueue(16, True)
        self._poses = node.transform.createOutputQueue(10_000, False)
        self._passed = node.passthrough.createOutputQueue(10_000, False)  # it waits until they are taken
        self.answers, self.first_cpu_s = [], None
        self._pipeline.start()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self):
        while True:
            message = self._poses.get()  # waits without polling
            t, q = message.getTranslation(), message.getQuaternion()
            if not self.answers:
                self.first_cpu_s = time.process_time()
            self.answers.append((t.x, t.y, t.z, q.qx, q.qy, q.qz, q.qw))

    def wait(self, given):
        """Wait until no more than a few of the frames given have no answer."""
        begun_s = time.monotonic()
        while given - len(self.answers) > _MOST_WAITING:
            if time.monotonic() - begun_s > (_PATIENCE_S if self.answers else _FIRST_S):
                return
            time.sleep(_POLL_S)

    def give(self, i):
        """Hand over frame i and the samples around it."""
        t_ns = self._recording.t_ns[i]
        for instance, (queue, path) in enumerate(zip(self._inputs, self._recording.paths[i], strict=True), 1):
            queue.send(self._frame(path, t_ns, i, instance))
        if i == 0:
            time.sleep(1.0)  # samples that come before its first pair are dropped
        packets = []
        while self._next_sample < len(self._recording.imu_t_ns):
            sample_ns = int(self._recording.imu_t_ns[self._next_sample])
            if sample_ns > t_ns + _IMU_AHEAD_NS:
                break
            packets.append(self._packet(sample_ns, self._recording.imu_values[self._next_sample]))
            self._next_sample += 1
        if packets:
            data = depthai.IMUData()
            data.packets = packets
            self._samples.send(data)

    def _frame(self, path, t_ns, i, instance):
        pixels, frame = image(path), depthai.ImgFrame()
        frame.setType(depthai.ImgFrame.Type.GRAY8)
        frame.setWidth(pixels.shape[1])
        frame.setHeight(pixels.shape[0])
        frame.setData(pixels.reshape(-1))
        frame.setInstanceNum(instance)
        stamp = timedelta(microseconds=(t_ns - self._base_ns) / 1000)
        frame.setTimestamp(stamp)
        frame.setTimestampDevice(stamp)
        frame.setSequenceNum(i)
        return frame

    def _packet(self, t_ns, values):
        packet = depthai.IMUPacket()
        packet.gyroscope.x, packet.gyroscope.y, packet.gyroscope.z = values[:3]
        packet.acceleroMeter.x, packet.acceleroMeter.y, packet.acceleroMeter.z = values[3:]
        for report in (packet.gyroscope, packet.acceleroMeter):
            for stamp in (report.timestamp, report.tsDevice):
                stamp.sec, stamp.nsec = divmod(t_ns - self._base_ns, 10**9)
        return packet

    def finish(self):
        """Wait until nothing comes any more; give the poses, the last of which belongs to the last frame."""
        before = -1
        while len(self.answers) != before:
            before = len(self.answers)
            time.sleep(2.0)
        stamps = self._recording.t_ns[len(self._recording.t_ns) - len(self.answers) :]
        for t_ns, (x, y, z, *q) in zip(stamps, self.answers, strict=True):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = _rotation(*q), (x, y, z)
            self._outcome.add(t_ns, T, self.first_cpu_s)


def _rotation(x, y, z, w):
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def prepared(mode, root, out, work, pace, package):
    """Compile the shim and write the calibration into a folder; become the process that runs with both."""
    require(package)
    if mode != "stereo":
        sys.exit(f"Basalt does stereo with an IMU only, not {mode}")
    calibrate(Euroc(root, ["cam0", "cam1"]), f"{work}/calibration.json")
    shim = str(Path(__file__).with_name("basalt_shim.cpp"))
    subprocess.run(["g++", "-std=c++17", "-shared", "-fPIC", "-O1", shim, "-o", f"{work}/shim.so", "-ldl"], check=True)
    library = next(Path(depthai.__file__).parent.glob("depthai.libs/libdepthaicore*.so"), None)
    if library is None:
        sys.exit(f"this depthai ({depthai.__file__}) has no libdepthaicore to put the shim before")
    settings = {"DAI_CALIB": f"{work}/calibration.json", "DAI_LIB": library.name, "LD_PRELOAD": f"{work}/shim.so"}
    os.execve(sys.executable, [sys.executable, __file__, "run", root, out, pace], {**os.environ, **settings})


def main():
    """Write the calibration, run, or both."""
    cv2.setNumThreads(1)
    if sys.argv[1] not in ("calibrate", "run"):
        prepared(*sys.argv[1:7])
    recording = Euroc(sys.argv[2], ["cam0", "cam1"])
    if sys.argv[1] == "calibrate":
        calibrate(recording, os.environ["DAI_CALIB"])
        return
    out, pace = sys.argv[3], float(sys.argv[4])
    outcome = Outcome("depthai", recording.t_ns)
    odometry, begun_s = Odometry(recording, outcome), time.monotonic()
    for i, t_ns in enumerate(recording.t_ns):
        wait_until(t_ns, recording.t_ns[0], begun_s, pace)
        odometry.wait(i)
        odometry.give(i)
    odometry.finish()
    outcome.report(out)
    os._exit(0)  # the pipeline's threads do not end by themselves


if __name__ == "__main__":
    main()
