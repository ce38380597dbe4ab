"""10. Your own sensor: a laser that looks down, from nothing to readings that every estimator can use.

    python examples/10_own_sensor.py

A class says what a reading is and how sure it is; vislam derives the rest. docs/extend.md goes through it.
"""

import heapq
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vislam import Config, Slam, open_source
from vislam.config import Positive
from vislam.datasets import Problems, sensor_readings
from vislam.sensors import BodyState, Configured, Variable, bodies_on, drawn_readings, load_sensor_setup, register


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
    recording = open_source("points:laps,rig=stereo,duration_s=20,camera_hz=10")  # a body that is carried about
    bodies = bodies_on(recording.truth(), recording.truth().t_ns[10:-10:10])  # ten times a second
    floor = bodies[0].position_m[2:] - 1.2
    with tempfile.TemporaryDirectory() as folder:
        setup_file = Path(folder) / "sensors.toml"
        setup_file.write_text('[sensors.laser]\nkind = "laser_down"\nfile = "laser.csv"\nsigma_m = 0.03\n')
        setup = load_sensor_setup(setup_file)
        laser, file = setup.sensors["laser"], setup.files["laser"]
        drawn = drawn_readings("laser", laser, bodies, floor, seed=1)
        file.path.write_text("t_ns,range_m\n" + "".join(f"{r.t_ns},{r.values[0]:.4f}\n" for r in drawn))
        readings = list(sensor_readings("laser", laser, file, Problems()))
    residuals = [laser.residual(r.values, b, floor)[0] for r, b in zip(readings, bodies, strict=True)]
    print(f"{len(readings)} ranges, residuals at the truth scatter by {np.std(residuals):.3f} m, 0.03 m told")
    slam = Slam(Config(), recording.rig, recording.imu_noise, setup.suite)
    for value in heapq.merge(recording.events(), readings, key=lambda value: value.t_ns):
        slam.feed(value)
    slam.finish()
    own = slam.front.report().sensors["laser"]["filter"]["values"][0], slam.back.graph.own("laser")[0][0]
    print(f"the floor is 1.2 m below the start; by the filter {-own[0]:.3f} m, by the graph {-own[1]:.3f} m")
    np.testing.assert_allclose(own, -1.2, atol=0.05)
