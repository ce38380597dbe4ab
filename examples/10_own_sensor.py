"""10. Your own sensor: a laser that looks down, from nothing to readings that every estimator can use.

    python examples/10_own_sensor.py

A class says what a reading is and how sure it is; derivatives may be left to vislam. Registered, the kind has a table
of its own in a file of sensors. docs/your-sensor.md goes through it.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vislam.config.ranges import Positive
from vislam.core.geometry import so3_exp
from vislam.datasets.sensor_files import sensor_readings
from vislam.datasets.tables import Problems
from vislam.sensors import BodyState, Configured, Variable, linearised, load_sensor_setup, register
from vislam.sensors.simulated import drawn_readings


@dataclass(frozen=True)
class LaserSettings:
    """The keys of its table, with what they may be."""

    sigma_m: Positive = 0.02
    floor_sigma_m: Positive = 1.0  # how well the floor's height is known before


class DownwardLaser(Configured):
    """The distance to a level floor, along the body's -z."""

    Settings = LaserSettings
    columns = ("range_m",)  # of a reading and of its file
    touches = ("rotation", "position")  # the parts of the body's state that show in it

    def __init__(self, settings: LaserSettings | None = None) -> None:
        self.settings = settings or LaserSettings()
        self.variables = (Variable("floor_m", self.settings.floor_sigma_m),)  # estimated with everything else

    def predicted(self, body: BodyState, own: np.ndarray) -> np.ndarray:
        return np.array([(body.position_m[2] - own[0]) / body.R_world_body[2, 2]])  # longer when it is tilted

    def residual(self, values: np.ndarray, body: BodyState, own: np.ndarray) -> np.ndarray:
        return values - self.predicted(body, own)

    def noise(self, values: np.ndarray) -> np.ndarray:
        return np.array([[self.settings.sigma_m**2]])

    def check(self, values: np.ndarray) -> str:
        return "" if values[0] > 0.0 else f"no range: {values[0]:g} m"

    def draw(self, body: BodyState, own: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return self.predicted(body, own) + self.settings.sigma_m * rng.normal(size=1)


if __name__ == "__main__":
    register("laser_down", DownwardLaser)  # a package does it by an entry point in the group vislam.sensors
    turns = [so3_exp(np.array([0.2 * np.sin(k), 0.1, 0.01 * k])) for k in range(200)]
    places = [np.array([0.1 * k, 0.0, 1.5 + 0.5 * np.sin(0.1 * k)]) for k in range(200)]
    still = [np.zeros(3)] * 4
    bodies = [BodyState(k * 10**8, R, p, *still) for k, (R, p) in enumerate(zip(turns, places, strict=True))]
    floor = np.array([-0.3])
    with tempfile.TemporaryDirectory() as folder:
        setup_file = Path(folder) / "sensors.toml"
        setup_file.write_text('[sensors.laser]\nkind = "laser_down"\nfile = "laser.csv"\nsigma_m = 0.03\n')
        setup = load_sensor_setup(setup_file)
        laser, file = setup.sensors["laser"], setup.files["laser"]
        drawn = drawn_readings("laser", laser, bodies, floor, seed=1)
        file.path.write_text("t_ns,range_m\n" + "".join(f"{r.t_ns},{r.values[0]:.4f}\n" for r in drawn))
        readings = list(sensor_readings("laser", laser, file, Problems()))
    linear = [linearised(laser, r, b, floor) for r, b in zip(readings, bodies, strict=True)]
    np.testing.assert_allclose(linear[0].H_own, -1.0 / bodies[0].R_world_body[2, 2], rtol=1e-6)
    chi_square = np.mean([one.residual[0] ** 2 / one.noise[0, 0] for one in linear])
    print(f"{len(readings)} ranges, normalised squared residual at the truth {chi_square:.2f}")
    assert 0.8 < chi_square < 1.2
    # The same file through the filter and the graph comes here.
