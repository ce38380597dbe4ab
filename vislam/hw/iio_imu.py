"""An inertial chip that the kernel drives, through its Industrial I/O buffers: stamped by the kernel."""

import time
from pathlib import Path

from vislam.config import BoardConfig
from vislam.core.errors import HardwareError
from vislam.core.messages import ImuSample, MagSample
from vislam.hw.accel_at_gyro import AccelAtGyro
from vislam.hw.health import Health
from vislam.hw.iio_device import KINDS, IioDevice, Scans, kinds_of
from vislam.hw.imu_source import InertialSource
from vislam.hw.timing import wall_ahead_ns

_NS = 1_000_000_000
_BUFFER_S = 1.0  # that the kernel keeps
_KEPT = 2000  # samples of one sensor that wait for the other: ten seconds at 200 Hz
_FAR_NS = 2 * _NS  # a stamp so far from now is of another clock


class IioImu(InertialSource):
    """An `InertialSource` with one device of gyro and accelerometer, or with one of each.

    Stamps are the kernel's, taken at the chip's interrupt; `config.delay_s` is taken off (the kernel does not have the
    delay of a filter: None is none). Where gyro and accelerometer are devices of their own, the accelerometer is
    interpolated to the gyro's stamps. None streams a temperature beside the samples. One thread only.
    """

    stamped_by = "the kernel, at the chip's interrupt"

    def __init__(self, config: BoardConfig, name: str = "", root: Path = Path("/")) -> None:
        """Find the devices, set them up and start them.

        Args:
            config: rate, calibration and times.
            name: of the chip as the kernel has it, or a device such as `iio:device0`; empty: whichever is there.
            root: where /dev and /sys are.

        Raises HardwareError: there is none, or it cannot be set up.
        """
        super().__init__(config.calibration, config.silent_s, config.max_temperature_change_c)
        self._config, self._name, self._root = config, name, root
        self.rate_hz = config.rate_hz
        self._devices: list[IioDevice] = []
        self._pairs = AccelAtGyro(_KEPT)
        self._newest_ns: dict[str, int] = {}  # by device
        self._retry_ns = 0
        self._open()

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what was captured, see `InertialSource`; waits for the next sample, `timeout_s` at most."""
        deadline = time.monotonic_ns() + round(timeout_s * _NS)
        while True:
            now = time.monotonic_ns()
            if not self._devices:
                self._reopen(now)
            left_s = max(deadline - time.monotonic_ns(), 0) / _NS
            if not self._devices:
                time.sleep(min(left_s, max(self._retry_ns - time.monotonic_ns(), 0) / _NS))
            else:
                samples = self._received(left_s)
                if samples:
                    return samples
            if time.monotonic_ns() >= deadline:
                return []

    def health(self) -> Health:
        """Return the sensor bits that hold now and the events since the last call."""
        return super().health() | (Health(0) if self._devices else Health.GYRO_FAULT | Health.ACCEL_FAULT)

    def close(self) -> None:
        """Stop the devices; may be called twice."""
        for device in self._devices:
            device.close()
        self._devices = []

    # ---- samples ----------------------------------------------------------------------------------------------

    def _received(self, timeout_s: float) -> list[ImuSample | MagSample]:
        for k, device in enumerate(self._devices):
            try:
                # one is waited for: the other's samples lie in the kernel's buffer meanwhile
                self._take(device, device.read(timeout_s if k == 0 else 0.0))
            except OSError:
                self._faults.add("gone", Health.BUS_FAULT | Health.IMU_GAP)
                self.close()
                self._retry_ns = time.monotonic_ns() + round(self._config.reopen_s * _NS)
                return []
        merged = self._merged()
        if merged:
            self._last_out_ns = time.monotonic_ns()
        return [*merged]

    def _take(self, device: IioDevice, scans: Scans) -> None:
        now = time.monotonic_ns()
        shift_ns = 0 if device.clock == "monotonic" else wall_ahead_ns()
        newest_ns = self._newest_ns.get(device.name, 0)
        for row, t_ns in enumerate((scans.t_ns - shift_ns).tolist()):
            if abs(t_ns - now) > _FAR_NS:
                self._faults.add("stamps_far", Health.CLOCK_STEP)
            elif t_ns <= newest_ns:
                self._faults.add("stamps_backwards")
            else:
                newest_ns = t_ns
                for kind, values in scans.values.items():
                    watch = self._gyro if kind == "anglvel" else self._accel
                    if not watch.sound([values[row].tolist()])[0]:
                        self._pairs.clear()  # nothing is interpolated to what hangs, or across it
                    elif watch is self._gyro:
                        self._pairs.add_gyro(t_ns, values[row])
                    else:
                        self._pairs.add_accel(t_ns, values[row])
        self._newest_ns[device.name] = newest_ns

    def _merged(self) -> list[ImuSample]:
        """Return the gyro's samples around which the accelerometer has some, with those interpolated."""
        delay_ns = round((self._config.delay_s or 0.0) * _NS)
        return [self._inertial(t_ns - delay_ns, rate, force) for t_ns, rate, force in self._pairs.merged()]

    # ---- coming and going -------------------------------------------------------------------------------------

    def _reopen(self, now: int) -> None:
        if now < self._retry_ns:
            return
        self._retry_ns = now + round(self._config.reopen_s * _NS)
        try:
            self._open()
        except HardwareError:
            self._faults.add("open_failures")
        else:
            self._faults.add("reopened")

    def _open(self) -> None:
        devices: list[IioDevice] = []
        length = max(round(_BUFFER_S * self._config.rate_hz), 2)
        try:
            for folder in find_devices(self._root, self._name):
                devices.append(IioDevice(folder, self._root / "dev" / folder.name, self._config.rate_hz, length))
        except HardwareError:
            for device in devices:
                device.close()
            raise
        self._devices = devices
        gyro = next(device for device in devices if "anglvel" in device.kinds)
        self.rate_hz = gyro.rate_hz or self._config.rate_hz
        self._pairs.clear()


def find_devices(root: Path, name: str = "") -> list[Path]:
    """Return the folders of one device with gyro and accelerometer, or of one with each, in this order.

    `name` is that of the chip or the beginning of it (`lsm6dsox` for `lsm6dsox_gyro` and `lsm6dsox_accel`), or of a
    device. Raises HardwareError where there is none.
    """
    folders = sorted((root / "sys/bus/iio/devices").glob("iio:device*"))
    found: dict[Path, tuple[str, ...]] = {}
    for folder in folders:
        try:
            chip = (folder / "name").read_text(encoding="ascii", errors="replace").strip()
        except OSError:
            chip = ""
        if not name or name == folder.name or chip.startswith(name):
            found[folder] = kinds_of(folder)
    both = next((folder for folder, kinds in found.items() if set(kinds) == set(KINDS)), None)
    if both is not None:
        return [both]
    single = [next((folder for folder, kinds in found.items() if kinds == (kind,)), None) for kind in KINDS]
    if None not in single:
        return [folder for folder in single if folder is not None]
    listed = ", ".join(folder.name for folder in folders) or "none"
    raise HardwareError(
        f"{root / 'sys/bus/iio/devices'}: no device{f' {name}' if name else ''} streams a gyro and an accelerometer "
        f"(devices: {listed}); load the chip's driver (docs/sensors.md), or use the chip without it: a name such as "
        "lsm6dsox"
    )
