"""Which sensors a live run reads: the virtual cart, a recording in real time, or a cart's own."""

import os
import re
import socket
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from vislam.config import Config, SensorCalibration, SensorsConfig, validated
from vislam.core.camera import Rig
from vislam.core.errors import DataError, UsageError
from vislam.core.kinds import Kinds
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.core.reading import read_json
from vislam.datasets.calibrated import with_clock
from vislam.datasets.camera_files import read_cameras
from vislam.hw.imu_source import InertialSource
from vislam.hw.library_cameras import WITH_IMU, frame_config, gives_frames, open_frame_camera, reads_own_imu
from vislam.hw.port_readings import PortReadings
from vislam.hw.sensors import INERTIAL_KINDS, calibration_of, check_devices, open_camera, open_inertial, rate_of
from vislam.hw.serial_port import check_port
from vislam.hw.source import FrameSource, ReadingSource
from vislam.imu import ImuNoise
from vislam.live.device_owner import own_device
from vislam.live.frames import NoCamera, OneCamera
from vislam.live.handed_frames import HandedFrames
from vislam.live.handed_imu import HandedImu
from vislam.live.processes.child import Life
from vislam.live.reading_source import refuse_unread
from vislam.live.replay import ReplaySource
from vislam.live.run_live import LiveSource
from vislam.live.virtual.cart import VirtualCart
from vislam.live.virtual.place import PlaceOptions
from vislam.live.wire.slot import remove
from vislam.runs.camera_rig import rig_of
from vislam.runs.record import noise_of
from vislam.sensors import SensorSetup
from vislam.trajectory import Trajectory


def _virtual_cart(rest: str, config: Config, _: SensorsConfig) -> tuple[LiveSource, Config]:
    cart = VirtualCart(place_options(rest), config.machine.gravity_m_s2)
    return cart, cart.settings(config)


def _replay(rest: str, config: Config, _: SensorsConfig) -> tuple[LiveSource, Config]:
    return ReplaySource(rest, config.seed, calibration=config.calibration), with_clock(config)


# what opens a source of a name, of the text behind `NAME:` or `NAME,`
OpenLive = Callable[[str, Config, SensorsConfig], tuple[LiveSource, Config]]
LIVE_SOURCES = Kinds[OpenLive]("vislam.live_sources", {"virtual-cart": _virtual_cart, "replay": _replay})


def open_live(asked: str, config: Config, sensors: SensorsConfig) -> tuple[LiveSource, Config]:
    """Return the sensors that are asked for, and the settings with what those know better.

    Args:
        asked: `virtual-cart[,option=value]`, `replay:SOURCE`, or IMU and camera: `gy85+webcam`, `serial:PORT+0`.
        config: of the run.
        sensors: of the cart.

    Raises:
        UsageError: there is no such source, or an option of it is wrong.
        DataError: a calibration file or recording cannot be used.
    """
    kind = asked.partition(",")[0]
    name = re.split("[:,]", asked, maxsplit=1)[0]
    if name in LIVE_SOURCES:
        return LIVE_SOURCES[name](asked[len(name) + 1 :], config, sensors)
    inertial, plus, camera = asked.partition("+")
    if not plus and kind.partition(":")[0] in WITH_IMU:
        inertial, camera = kind, asked  # a camera with the IMU inside it
    if not camera or inertial.partition(":")[0] not in INERTIAL_KINDS:
        raise UsageError(
            f"no live source '{asked}'; there are: virtual-cart, replay:SOURCE, gy85+webcam, serial:PORT+webcam "
            f"(an IMU of {', '.join(INERTIAL_KINDS)}; in place of webcam a camera's index or path, picam, "
            "realsense[,depth], oak[,depth], or none); realsense[,depth] and oak[,depth] "
            "for such a camera with the IMU inside it"
        )
    return CartSensors(inertial, camera, config, sensors), with_clock(config)


def stored_sensors(out: Path) -> SensorsConfig:
    """Return the sensors of the live run in a folder; raises DataError when their file cannot be used."""
    path = out / "sensors.json"
    try:
        data = read_json(path)
        if not isinstance(data, dict):
            raise ValueError("it holds something else than settings")
    except (OSError, ValueError) as error:
        raise DataError(f"{path} does not state the sensors of a live run: {error}; begin with --map {out}") from error
    return validated(SensorsConfig, data, str(path))


def place_options(text: str) -> PlaceOptions:
    """Return what is asked of the virtual cart, as `option=value,...`; raises UsageError for what it does not know."""
    values: dict[str, object] = {}
    for part in filter(None, text.split(",")):
        name, equals, value = part.partition("=")
        if part == "bridge":
            value = "true"
        elif not equals:
            raise UsageError(f"'{part}' is no option of the virtual cart; write virtual-cart,option=value")
        values[name] = _outages(value) if name.endswith("_out") else value.split("/") if name == "imu_fault" else value
    options = validated(PlaceOptions, values, "virtual-cart")
    beyond = [fault for fault in options.imu_fault if fault != "unplugged"]
    if beyond and not options.bridge:
        raise UsageError(f"imu_fault={beyond[0]} is one of a serial bridge; write virtual-cart,bridge,imu_fault=...")
    return options


def _outages(text: str) -> tuple[tuple[float, float], ...]:
    """Return `20:25/40:41` as intervals in seconds."""
    try:
        pairs = [part.split(":") for part in text.split("/")]
        return tuple((float(begin), float(end)) for begin, end in pairs)
    except ValueError as error:
        raise UsageError(f"'{text}' is no list of outages; write 20:25 (from 20 s to 25 s), or 20:25/40:41") from error


class CartSensors:
    """Satisfies `LiveSource`: an inertial source and a camera of this machine."""

    def __init__(self, inertial: str, camera: str, config: Config, sensors: SensorsConfig) -> None:
        """Read the calibration files; the devices are opened by the processes that read them.

        Raises UsageError where a camera has no calibration, DataError when a file cannot be used.
        """
        for name, path in (("imu", config.calibration.imu), ("mag", config.calibration.mag)):
            if path is not None:
                raise UsageError(
                    "live drivers take the calibration of their chips from the sensors file (--sensors FILE, section "
                    f"calibration of gy85, board or serial), not from --calibration.{name}"
                )
        self._is_inside = reads_own_imu(inertial, camera)
        self.name = f"live {inertial}+{camera}"
        given, ideal = calibration_of(inertial, sensors), SensorCalibration()
        self.is_mag_calibrated = (given.mag_bias_ut, given.mag_matrix) != (ideal.mag_bias_ut, ideal.mag_matrix)
        calibration = config.calibration.camera
        is_blind = camera == "none"
        self.rig = Rig((), ()) if is_blind else _rig(camera, sensors, calibration, self._is_inside)
        self.imu_noise: ImuNoise | None = noise_of(config.calibration, sensors, rate_of(inertial, sensors))
        self.frame_count, self.problems = 0, dict[str, int]()
        self.duration_s: float | None = None
        self._inertial, self._camera, self._sensors = inertial, camera, sensors
        self._passed: tuple[socket.socket, socket.socket] | None = None  # from the bridge to who reads further sensors
        self._handed: tuple[socket.socket, socket.socket] | None = None  # from a device's process to the fast one
        self._memory = f"vislam-device-{os.getpid()}-{id(self):x}"

    def __getstate__(self) -> dict[str, object]:
        """Return what travels to other processes: each end of a wire goes with what opens it, and alone."""
        return {**self.__dict__, "_passed": None, "_handed": None}

    def check(self) -> None:
        """Raise HardwareError where a device is missing or may not be opened."""
        check_devices(self._inertial, self._camera, self._sensors)

    def inertial(self) -> Callable[[], InertialSource]:
        """Return what opens the IMU; call `readings` before, for a bridge passes on what further sensors say.

        That of a camera is in the hands of a process of its own: call `helpers` after.
        """
        if self._is_inside:
            self._handed = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            settings = frame_config(self._camera, self._sensors)
            return partial(HandedImu, self._handed[1], settings.imu_rate_hz, settings.imu_silent_s)
        passed = None if self._passed is None else self._passed[0]
        return partial(open_inertial, self._inertial, self._sensors, further=passed)

    def cameras(self) -> Callable[[], FrameSource]:
        """Return what opens the camera."""
        if self._is_inside:
            return partial(HandedFrames, self._memory, frame_config(self._camera, self._sensors).missing_s)
        return partial(_open_frames, self._camera, self._sensors) if self.rig.cameras else NoCamera

    def readings(self, setup: SensorSetup) -> Callable[[], ReadingSource]:
        """Return what reads further sensors at their ports.

        Raises UsageError for a sensor without a port, or at a bridge where there is none, HardwareError for a port that
        is not there.
        """
        refuse_unread(setup, setup.ports, "on a cart it needs a port; a replay plays files")
        at_bridge = [name for name, port in setup.ports.items() if port.at_bridge]
        if at_bridge and self._inertial.partition(":")[0] != "serial":
            raise UsageError(
                f'[sensors.{at_bridge[0]}]: port = "bridge" is the serial bridge, and --source {self._inertial} has '
                "none; take --source serial:PORT+..., or give the sensor a port of its own"
            )
        for port in setup.ports.values():
            if not port.at_bridge:
                check_port(port.port, port.baud)
        self.close()
        self._passed = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) if at_bridge else None
        return partial(PortReadings, setup.ports, None if self._passed is None else self._passed[1])

    def helpers(self) -> dict[str, Callable[[Life], None]]:
        """Return the process that owns a camera with the IMU inside it; other sensors need none."""
        if self._handed is None:
            return {}
        return {
            "device": partial(
                own_device, name=self._camera, sensors=self._sensors, memory=self._memory, samples=self._handed[0]
            )
        }

    def close(self) -> None:
        """Close our ends of the wires, and remove the memory of a device's process that was killed."""
        for end in (*(self._passed or ()), *(self._handed or ())):
            end.close()
        if self._is_inside:
            remove(self._memory)

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Raise DataError: live sensors cannot be read twice."""
        raise DataError(f"{self.name} is not recorded; `vislam record` does that")

    def truth(self) -> Trajectory | None:
        """Return nothing: it is unknown."""
        return None


def _rig(camera: str, sensors: SensorsConfig, calibration: str | None, with_imu: bool) -> Rig:
    if gives_frames(camera):
        rig, guesses = rig_of(camera, sensors, calibration, with_imu)
        if guesses:
            raise UsageError(f"{guesses[0]}, which cannot be taken for true; set it, in metres, or give a calibration")
        return rig
    if calibration is None:
        raise UsageError(
            "a live camera needs its calibration: --calibration.camera FILE, which `vislam calibrate camera` writes; "
            "without a camera: +none in its place"
        )
    found = read_cameras(Path(calibration))[0]
    if found.T_body_cam is None:
        raise DataError(
            f"{calibration} does not say where the camera is on the body (T_cam_imu, T_BS); add it, "
            "or run `vislam calibrate camera-imu`"
        )
    return Rig((found.camera,), (found.T_body_cam,))


def _open_frames(name: str, sensors: SensorsConfig) -> FrameSource:
    if gives_frames(name):
        return open_frame_camera(name, sensors)
    return OneCamera(open_camera(name, sensors))
