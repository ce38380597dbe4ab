"""What boards on an I2C bus share: rounds of questions, the magnetometer beside the inertial chips, self-tests."""

from collections.abc import Callable

from vislam.config import BoardConfig, Gy85Config
from vislam.core.messages import ImuSample, MagSample
from vislam.hw.board_magnetometer import BoardMagnetometer
from vislam.hw.chips import I2cBus, Magnetometer, SelfTest
from vislam.hw.health import Health
from vislam.hw.imu_source import InertialSource, Watch
from vislam.hw.link import ChipLinks, Link
from vislam.hw.timing import Clock, read_in_rounds


class ChipBoard(InertialSource):
    """An `InertialSource` for a board that fills `_round`. One thread only.

    Transfers are bounded, which is what a call may take longer than asked.

    Attributes:
        self_tests: what those that were run found.
    """

    def __init__(
        self,
        config: Gy85Config | BoardConfig,
        clock: Clock | None,
        inertial: tuple[Link, ...],
        find: Callable[[I2cBus, float], Magnetometer | None],
    ) -> None:
        """Take settings, clock and chips; nothing is opened yet. `find` is how a magnetometer is found on a bus."""
        super().__init__(config.calibration, config.silent_s, config.max_temperature_change_c, clock)
        self.rate_hz = config.rate_hz
        self.self_tests: tuple[SelfTest, ...] = ()
        self._mag = BoardMagnetometer(config, self._clock, self._faults, find, config.mag is True)
        self._links = ChipLinks(config, self._clock, self._faults, (*inertial, self._mag.link))
        self._next_ns = self._last_out_ns  # when the next round is due

    @property
    def magnetometer_name(self) -> str | None:
        """Which magnetometer was found; None if there is none."""
        return self._mag.name

    def run_self_tests(self) -> tuple[SelfTest, ...]:
        """Test the chips by their own means; about 2 s, standing still, no samples meanwhile."""
        self.self_tests = self._links.tested()
        self._resume()
        self._next_ns = self._last_out_ns = self._clock.now_ns()
        return self.self_tests

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what was captured, see `InertialSource`; waits for the next sample, `timeout_s` at most."""
        return read_in_rounds(self._clock, timeout_s, lambda: self._next_ns, self._poll)

    def health(self) -> Health:
        """Return the sensor bits that hold now and the events since the last call."""
        return super().health() | self._links.health()

    def close(self) -> None:
        """Close the bus; may be called twice."""
        self._links.close()

    def _poll(self) -> list[ImuSample | MagSample]:
        now = self._clock.now_ns()
        inertial = self._round(now)
        if inertial:
            self._last_out_ns = self._clock.now_ns()
        samples: list[ImuSample | MagSample] = [*inertial]
        found = self._mag.read(self._links, now)
        if found is not None:
            samples += self._magnetic(found[0], found[1].field_ut.tolist(), found[1].overflow)
            self._drop_hung(self._field, self._mag.link, now)
            samples.sort(key=lambda sample: sample.t_ns)
        return samples

    def _round(self, now: int) -> list[ImuSample]:
        """Ask the inertial chips once, and set `_next_ns`; what a wire can do raises nothing."""
        raise NotImplementedError

    def _resume(self) -> None:
        """Forget what came of the inertial chips before and during self-tests."""
        raise NotImplementedError

    def _drop_hung(self, watch: Watch, link: Link, now: int) -> None:
        """Have a chip set up again that gives one value for ever."""
        if watch.is_stuck:
            watch.begin()
            self._links.hung(link, watch.fault, now)
