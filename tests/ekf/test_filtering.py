"""When the filter of a run hears that the noise of the IMU changed."""

import pytest

from vislam.config import MachineConfig, load
from vislam.core.messages import NoiseScale, no_observations
from vislam.ekf.filtering import Filtering
from vislam.frontend.result import identity_motion
from vislam.imu import SeenNoise
from worlds.flight import MONO
from worlds.motion import EUROC_NOISE, NS

FRAME_NS = NS // 20


class HeardNoise(Filtering):
    """Takes down since when noise is what it is, as the filter is told."""

    def __init__(self, coupling):
        config = load(None, {"ekf.coupling": coupling}).ekf
        super().__init__(config, EUROC_NOISE, MachineConfig(), MONO)
        self.since_ns = []
        follow = self.ekf.follow_noise
        self.ekf.follow_noise = lambda t_ns, scale: self.since_ns.append(t_ns) or follow(t_ns, scale)

    def frame(self, number, noise):
        t_ns = number * FRAME_NS
        self.see(t_ns, identity_motion(t_ns, 0, True, 0), no_observations(), False, None, True, noise)


@pytest.mark.parametrize("coupling", ["tight", "loose"])
@pytest.mark.parametrize("gyro", [1.5, 4.0])
def test_a_loose_filter_goes_back_to_when_noise_changed_and_a_tight_one_to_the_last_frame(coupling, gyro):
    filtering = HeardNoise(coupling)
    for number in range(1, 40):
        is_known = number >= 30  # half a second after it changed
        noise = SeenNoise(20 * FRAME_NS, NoiseScale(gyro, 3.0)) if is_known else SeenNoise(0, NoiseScale(2.0, 3.0))
        filtering.frame(number, noise)
    assert filtering.since_ns == [0, (20 if coupling == "loose" else 29) * FRAME_NS]
