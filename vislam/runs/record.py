"""Recording of live sensors into an ASL folder: threads that read, bounded queues, and one writer that may be slow.

Samples are written raw, with their calibration beside them, which readers apply. What does not fit into a queue is
dropped and counted; no sensor ever waits for the disk.
"""

import json
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from queue import Empty, Full, Queue
from typing import Any

import cv2
import numpy as np

from vislam.config import CalibrationConfig, RecordConfig, SensorCalibration, SensorsConfig
from vislam.core import interrupts
from vislam.core.camera import Camera, Rig
from vislam.core.errors import HardwareError, StorageError, UsageError
from vislam.core.files import write_text
from vislam.core.messages import Array, Frame, ImuSample, MagSample
from vislam.core.recording import Problems
from vislam.core.streams import Happening, Repeats, StreamEvent, StreamJudge
from vislam.datasets.camera_files import read_cameras
from vislam.datasets.imu_files import read_imu_calibration, read_mag_calibration, read_noise
from vislam.datasets.recorder import Recorder
from vislam.datasets.tables import read_frame_stamps
from vislam.hw.cameras.library_camera import LibraryCamera
from vislam.hw.cameras.video import VideoCamera
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource
from vislam.hw.library_cameras import gives_frames, open_frame_camera, open_with_imu, reads_own_imu
from vislam.hw.sensors import calibration_of, is_video, open_camera, open_inertial, with_raw_samples
from vislam.hw.source import CapturedImage
from vislam.imu import ImuCalibration, ImuNoise, MagCalibration
from vislam.imu.series import AXES
from vislam.runs.camera_rig import rig_of
from vislam.runs.recorded_readings import FurtherPorts, ReadingRecorder

_GB = 1e9
_READ_S = 0.2  # a reading thread looks so often whether to stop
_WRITE_S = 0.05  # inertial samples wait at most so long for an image that does not come
_LOOK_EVERY_S = 1.0  # between looks at the free space, and lines of progress
_JOIN_S = 2.0
_SAMPLES = 8000  # that may wait for the disk: 18 s at 450 Hz
_FIRST_IMAGE_S = 5.0
_NAMED_EVENTS = 10  # one by one, to a person
Images = VideoCamera | LibraryCamera[CapturedImage] | LibraryCamera[Frame]
Shot = CapturedImage | Frame
# x forward, y left, z up of the body, for a camera that looks ahead: x right, y down, z forward
_T_BODY_CAM = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(slots=True)
class Recorded:
    """What a recording has become; `ended` is empty while it goes on."""

    folder: Path
    began_ns: int  # CLOCK_MONOTONIC, as all stamps
    counts: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    bytes_written: int = 0
    health: Health = field(default_factory=lambda: Health(0))  # every bit that was ever set
    faults: dict[str, dict[str, int]] = field(default_factory=dict)  # counters of each sensor
    events: list[dict[str, Any]] = field(default_factory=list)  # what happened in the streams, once it is over
    notes: tuple[str, ...] = ()  # what a user should know: settings that the camera refused, missing calibrations
    ended: str = ""

    def line(self) -> str:
        """Return the state in one line."""
        seconds = (time.monotonic_ns() - self.began_ns) * 1e-9
        counts = ", ".join(f"{count} {what}" for what, count in self.counts.items() if count)
        dropped = sum(self.dropped.values())
        lost = f", {dropped} dropped" if dropped else ""
        return f"{seconds:.1f} s: {counts or 'nothing yet'}{lost}, {self.bytes_written / 1e6:.1f} MB"


def record(
    out: Path,
    imu: str,
    camera: str,
    sensors: SensorsConfig,
    config: RecordConfig,
    seconds: float | None = None,
    in_real_time: bool = True,
    stop: threading.Event | None = None,
    progress: Callable[[Recorded], None] | None = None,
    further: FurtherPorts | None = None,
) -> Recorded:
    """Record until a stop, for some seconds, to the end of a video, or until the disk budget is used up.

    Args:
        out: folder to make.
        imu: `gy85[:BUS]`, `board[:BUS]` or a chip's name, `serial[:PORT]`, `realsense` or `oak` for the one inside such
            a camera, or `none`.
        camera: index, device file, `webcam`, `picam`, `realsense[,depth]`, `oak[,depth]`, video file or `none`.
        sensors: settings of both.
        config: budget and queues.
        seconds: length, None: until stopped.
        in_real_time: of a video; otherwise as fast as it is written.
        stop: ends the recording when set, as a first signal does (`interrupts.SIGNALS`) once it is going.
        progress: is called with the state once a second.
        further: sensors at ports, whose readings are written beside the recording.

    Raises:
        UsageError: the folder holds something, a sensor's name is none, or one is at a bridge that is not the IMU.
        HardwareError: a sensor is missing at the start.
        StorageError: there is no space, or the disk failed; what was written is a recording.
        DataError: a calibration file cannot be used.
    """
    if imu == camera == "none":
        raise UsageError("nothing to record; give --imu, --camera or both")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out} already holds something; choose a new folder for the recording")
    _check_space(out, config)
    files = sensors.calibration
    inertial: InertialSource | None = None
    images: Images | None = None
    own_rig: tuple[Rig, tuple[str, ...]] | None = None
    readings = None if further is None else ReadingRecorder(further, imu)
    try:
        is_inside = reads_own_imu(imu, camera)
        if imu != "none" and not is_inside:
            passed = None if readings is None else readings.bridge_end
            inertial = open_inertial(imu, with_raw_samples(sensors), further=passed)
        if camera != "none":
            own_rig = rig_of(camera, sensors, files.camera, is_inside) if gives_frames(camera) else None
            if is_inside:
                images, inertial = open_with_imu(camera, with_raw_samples(sensors))
            else:
                images = _open_images(camera, sensors, in_real_time)
        first = None if images is None else _first_image(images, camera)
        rig, notes = (None, ()) if first is None else own_rig or _rig(first, files, sensors.hfov_deg)
        notes = (*notes, *_camera_notes(images), *_stamp_notes(imu, inertial))
        noise = None if inertial is None else noise_of(files, sensors, inertial.rate_hz)
        imu_calibration, mag_calibration = _calibrations(files, calibration_of(imu, sensors))
        with Recorder(
            out, rig, noise, image_format=config.image_format, comment=f"vislam record, {imu}, {camera}",
            imu_calibration=imu_calibration, mag_calibration=mag_calibration,
        ) as recorder:  # fmt: skip
            recorded = Recorded(out, time.monotonic_ns(), notes=notes)
            if readings is not None:
                readings.begin(recorder, out)
            with interrupts.counted() as asked:
                asked.take_time()
                recording = _Recording(
                    recorder, recorded, config, inertial, images, readings, in_real_time,
                    lambda: asked.count > 0 or (stop is not None and stop.is_set()),
                )  # fmt: skip
                return recording.run(first, seconds, progress)
    finally:
        for source in (inertial, images, readings):
            if source is not None:
                source.close()


class _Recording:
    """Owns the recorder; the threads own their sensors and meet it in the queues only."""

    def __init__(
        self,
        recorder: Recorder,
        recorded: Recorded,
        config: RecordConfig,
        inertial: InertialSource | None,
        images: Images | None,
        readings: ReadingRecorder | None,
        drops_images: bool,
        is_over: Callable[[], bool],
    ) -> None:
        self._recorder = recorder
        self._recorded = recorded
        self._config = config
        self._inertial = inertial
        self._images = images
        self._readings = readings
        self._samples: Queue[ImuSample | MagSample] = Queue(_SAMPLES)
        self._frames: Queue[Shot] = Queue(config.image_queue)
        self._is_over = is_over
        self._drops_images = drops_images  # when the queue is full, as with a camera; else a video waits
        self._dropped = {"inertial samples": 0, "images": 0}  # each written by one thread
        self._imu_faults: dict[str, int] = {}
        self._health = [Health(0), Health(0)]  # of the inertial thread and of the camera's
        self._is_stopping = threading.Event()
        self._images_ended = threading.Event()
        rate_hz = 0.0 if inertial is None else inertial.rate_hz
        self._judges = {"imu0": StreamJudge("imu0", AXES, rate_hz=rate_hz), "cam0": StreamJudge("cam0")}
        self._first_ns, self._repeats = recorded.began_ns, Repeats()
        self._began_utc = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())

    def run(self, first: Shot | None, seconds: float | None, progress: Callable[[Recorded], None] | None) -> Recorded:
        recorded = self._recorded
        self._describe()
        threads = [
            threading.Thread(target=work, name=work.__name__, daemon=True)
            for work, source in ((self._read_inertial, self._inertial), (self._read_images, self._images))
            if source is not None
        ]
        try:
            if first is not None:
                self._first_ns = first.t_ns
                self._write_frame(first)
            for thread in threads:
                thread.start()
            looked_s = time.monotonic()
            while not recorded.ended:
                self._write_waiting(_WRITE_S)
                recorded.ended = self._why_end(seconds)
                if time.monotonic() - looked_s > _LOOK_EVERY_S or recorded.ended:
                    looked_s = time.monotonic()
                    self._take_stock()
                    if progress is not None:
                        progress(recorded)
            self._is_stopping.set()
            for thread in threads:
                thread.join(_JOIN_S)
            self._write_waiting(0.0)
            while not (self._samples.empty() and self._frames.empty()):
                self._write_waiting(0.0)
            if self._readings is not None:
                recorded.notes += self._readings.notes()
            events = [replace(one, done=_done(one)) for judge in self._judges.values() for one in judge.events]
            recorded.events = [event.entry(self._first_ns) for event in events]
            recorded.notes += tuple(event.words(self._first_ns) for event in events[:_NAMED_EVENTS])
        except StorageError as error:
            recorded.ended = str(error)
            with suppress(StorageError, OSError):  # what went wrong first is what is reported
                self._take_stock()
                self._describe()
            raise
        finally:
            self._is_stopping.set()
        self._take_stock()
        self._describe()
        return recorded

    def _read_inertial(self) -> None:
        assert self._inertial is not None
        looked_s = 0.0
        while not self._is_stopping.is_set():
            for sample in self._inertial.read(_READ_S):
                try:
                    self._samples.put_nowait(sample)
                except Full:
                    self._dropped["inertial samples"] += 1
            if time.monotonic() - looked_s > _READ_S:  # sources belong to one thread, their counters too
                looked_s = time.monotonic()
                self._health[0] |= self._inertial.health()
                self._imu_faults = self._inertial.counters()

    def _read_images(self) -> None:
        images = self._images
        assert images is not None
        while not self._is_stopping.is_set():
            was_finished = isinstance(images, VideoCamera) and images.is_finished
            image = images.read(_READ_S)
            if image is not None:
                self._queue(image)
            elif was_finished:
                self._images_ended.set()
                return
            if not isinstance(images, VideoCamera):
                self._health[1] |= images.health()

    def _queue(self, image: Shot) -> None:
        while not self._is_stopping.is_set():
            try:
                self._frames.put(image, block=not self._drops_images, timeout=_READ_S)
            except Full:
                if self._drops_images:
                    self._dropped["images"] += 1
                    return
            else:
                return

    def _write_waiting(self, wait_s: float) -> None:
        """Write all samples and readings and one image that wait."""
        if self._readings is not None:
            self._readings.take()
        for _ in range(self._samples.qsize()):
            sample = self._samples.get_nowait()
            if isinstance(sample, ImuSample):
                self._judges["imu0"].takes(sample.t_ns, [*sample.gyro_rad_s.tolist(), *sample.accel_m_s2.tolist()])
            self._recorder.write(sample)
        try:
            image = self._frames.get(timeout=wait_s) if wait_s > 0.0 else self._frames.get_nowait()
        except Empty:
            return
        self._write_frame(image)

    def _write_frame(self, image: Shot) -> None:
        if not isinstance(image, Frame):
            is_color = image.image.ndim == 3
            grey = cv2.cvtColor(image.image, cv2.COLOR_BGR2GRAY) if is_color else image.image
            color = image.image if is_color else None
            image = Frame(image.t_ns, image.index, (np.asarray(grey, dtype=np.uint8),), color)
        judge, shown = self._judges["cam0"], image.images[0]
        if judge.takes(image.t_ns):
            judge.look(shown, image.t_ns, image.t_ns)
            if self._repeats.take(shown):
                judge.note(Happening.REPEATED, image.t_ns, image.t_ns)
        self._recorder.write(image)

    def _why_end(self, seconds: float | None) -> str:
        """Return why the recording ends now, empty if it goes on."""
        if self._is_over():
            return "stopped"
        if seconds is not None and time.monotonic_ns() - self._recorded.began_ns >= seconds * 1e9:
            return f"{seconds:g} s are recorded"
        if self._images_ended.is_set():
            return "the video is at its end"
        if self._recorder.bytes_written >= self._config.max_gb * _GB:
            return f"{self._config.max_gb:g} GB are used up; give --max-gb for more"
        if shutil.disk_usage(self._recorded.folder).free < self._config.min_free_gb * _GB:
            return f"less than {self._config.min_free_gb:g} GB are free; make space, or record to another disk"
        return ""

    def _take_stock(self) -> None:
        recorded = self._recorded
        recorded.counts = dict(self._recorder.counts)
        recorded.bytes_written = self._recorder.bytes_written
        recorded.health = self._health[0] | self._health[1]
        recorded.faults = {}
        if self._inertial is not None:
            recorded.faults["imu"] = self._imu_faults
        if self._images is not None:
            recorded.faults["camera"] = self._images.counters()
        if self._readings is not None:
            recorded.faults |= {f"sensor {name}": counts for name, counts in self._readings.counters().items()}
        replaced = recorded.faults.get("camera", {}).get("replaced", 0)
        recorded.dropped = {**self._dropped, "images before the queue": replaced}

    def _describe(self) -> None:
        """Write recording.json: what was recorded how; without `ended` where the recording was killed."""
        recorded = self._recorded
        data: dict[str, Any] = {
            "began_utc": self._began_utc,
            "clock": "CLOCK_MONOTONIC",
            **asdict(recorded),
            "folder": recorded.folder.name,
            "health": [bit.name for bit in recorded.health],
        }
        if self._images is not None:
            data["stamped_by"] = self._images.stamped_by
        if isinstance(self._images, LibraryCamera):
            data["camera_settings"] = [asdict(setting) for setting in self._images.settings]
        write_text(recorded.folder / "recording.json", json.dumps(data, indent=1) + "\n")


def _done(event: StreamEvent) -> str:
    return (
        "left out" if event.stream == "cam0" and event.happening.done.startswith("left out") else "written as it came"
    )


def _check_space(out: Path, config: RecordConfig) -> None:
    parent = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.exists())
    free = shutil.disk_usage(parent).free
    if free < config.min_free_gb * _GB:
        raise StorageError(
            f"{parent} has {free / _GB:.1f} GB free, {config.min_free_gb:g} GB must stay free; make space, record to "
            "another disk, or lower --min-free-gb"
        )


def _first_image(images: Images, name: str) -> Shot:
    image = images.read(_FIRST_IMAGE_S)
    if image is None:
        raise HardwareError(f"camera {name} gives no image within {_FIRST_IMAGE_S:g} s")
    return image


def _open_images(camera: str, sensors: SensorsConfig, in_real_time: bool) -> Images:
    if gives_frames(camera):
        return open_frame_camera(camera, sensors)
    return open_camera(camera, sensors, stamps_ns=_video_stamps(camera), in_real_time=in_real_time)


def _rig(first: Shot, files: CalibrationConfig, hfov_deg: float) -> tuple[Rig, tuple[str, ...]]:
    """Return the rig of the recording, and what is guessed in it."""
    height, width = (first.images[0] if isinstance(first, Frame) else first.image).shape[:2]
    if files.camera is None:
        focal_px = 0.5 * width / np.tan(0.5 * np.deg2rad(hfov_deg))
        guessed = Camera(width, height, focal_px, focal_px, 0.5 * (width - 1), 0.5 * (height - 1))
        note = f"the camera is not calibrated: {hfov_deg:g} deg field of view and no distortion are written; see docs"
        return Rig((guessed,), (_T_BODY_CAM,)), (note,)
    found = read_cameras(Path(files.camera))[0]
    if (found.camera.width, found.camera.height) != (width, height):
        raise UsageError(
            f"{files.camera} is for {found.camera.width}x{found.camera.height}, the camera gives {width}x{height}; "
            "calibrate at the size that is recorded, or set webcam.width-px and height-px"
        )
    if found.T_body_cam is None:
        note = f"{files.camera} does not say where the camera sits: looking ahead, at the IMU, is written"
        return Rig((found.camera,), (_T_BODY_CAM,)), (note,)
    return Rig((found.camera,), (np.asarray(found.T_body_cam),)), ()


def _stamp_notes(name: str, inertial: InertialSource | None) -> tuple[str, ...]:
    """Return where the stamps of an inertial source come from; those of a GY-85 and a bridge are in the docs."""
    if inertial is None or not inertial.stamped_by or name.startswith(("gy85", "serial")):
        return ()
    return (f"inertial samples of {name} are stamped by {inertial.stamped_by}",)


def _camera_notes(images: Images | None) -> tuple[str, ...]:
    settings = () if images is None or isinstance(images, VideoCamera) else images.settings
    return tuple(
        f"camera: {setting.name} {setting.asked} was asked for, it has {'none' if setting.got is None else setting.got}"
        for setting in settings
        if setting.differs
    )


def noise_of(files: CalibrationConfig, sensors: SensorsConfig, rate_hz: float) -> ImuNoise:
    """Return the noise of a live IMU: of its calibration file where there is one, or as the sensors file states it."""
    if files.imu_noise is not None:
        return replace(read_noise(Path(files.imu_noise)), rate_hz=rate_hz)
    s = sensors
    return ImuNoise(
        s.gyroscope_noise_density,
        s.accelerometer_noise_density,
        s.gyroscope_random_walk,
        s.accelerometer_random_walk,
        rate_hz,
    )


def _calibrations(files: CalibrationConfig, known: SensorCalibration) -> tuple[ImuCalibration, MagCalibration]:
    """Return calibrations from files, or else from the settings of the sensor."""

    def matrix(rows: Any) -> Array:
        return np.array(rows, dtype=np.float64)

    imu = ImuCalibration(
        matrix(known.gyro_bias_rad_s), matrix(known.accel_bias_m_s2), matrix(known.gyro_matrix),
        matrix(known.accel_matrix),
    )  # fmt: skip
    mag = MagCalibration(matrix(known.mag_bias_ut), matrix(known.mag_matrix))
    return (
        imu if files.imu is None else read_imu_calibration(Path(files.imu)),
        mag if files.mag is None else read_mag_calibration(Path(files.mag)),
    )


def _video_stamps(camera: str) -> list[int] | None:
    """Return the stamps in the table beside a video, None where there is none."""
    if not is_video(camera) or not (table := Path(camera).with_suffix(".csv")).is_file():
        return None
    return [t_ns for t_ns, _ in read_frame_stamps(table, Problems())]
