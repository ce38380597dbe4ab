"""11. Further sensors, kind by kind: settings, simulated readings, filter and graph with and without them.

    python examples/11_further_sensors.py               # wheels and ranges
    python examples/11_further_sensors.py height twist  # others; `all`: every kind, half a minute of CPU

A cart drives for 13 s and sees nothing from 7 to 10 s. Each kind's table is what a TOML file would have; its readings
are drawn on the truth with the noise that it says, and its own variables by their sigmas, so that they must be found.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from vislam import Config, Slam, open_source
from vislam.config import FurtherSensorsConfig
from vislam.runs import further_readings
from vislam.trajectory import Trajectory, evaluate

WORLD = "points:cart-drive,rig=stereo,duration_s=13,camera_hz=5,tracks=60,outage_begin_s=7,outage_length_s=3"
ANCHORS = "anchors = {1 = [-9.0, -9.0, 0.2], 2 = [9.0, -9.0, 3.0], 3 = [9.0, 9.0, 0.5], 4 = [-9.0, 9.0, 2.5]}"
KINDS = {  # lines of its table, readings a second
    "position": ("sigma_m = 0.05\nsigma_up_m = 0.1", 5),
    "range": (f"sigma_m = 0.05\n{ANCHORS}", 20),
    "height": ("sigma_m = 0.1", 10),
    "heading": ("sigma_rad = 0.05", 10),
    "magnetic_field": ("sigma_ut = 1.0", 10),
    "wheels": ("track_width_m = 0.42", 20),
    "ackermann": ("wheelbase_m = 0.5", 20),
    "twist": ("sigma_m_s = 0.03", 20),
    "omni": ("sigma_m_s = 0.03", 20),
    "pose": ("sigma_m = 0.02\nsigma_rad = 0.02", 5),
    "odometry": ("sigma_m = 0.02\ndrift_m_per_sqrt_s = 0.02", 5),
}


def errors_m(table: str = "") -> tuple[dict[str, float], Slam]:
    """Return the errors of the filter and of the graph in metres (rms), and what ran."""
    recording, readings = open_source(WORLD), None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sensors.toml"
        file.write_text(table)
        if table:
            readings = further_readings(recording, FurtherSensorsConfig(str(file)), seed=0)
    slam = Slam(Config(), recording.rig, recording.imu_noise, readings and readings.suite)
    seen = []
    for value in readings.among(recording.events()) if readings else recording.events():
        seen += [step.front.state for step in slam.feed(value) if step.front.state is not None]
    slam.finish()
    errors = {}
    for by, states in {"filter": seen, "graph": slam.back.graph.states()}.items():
        path = Trajectory(np.array([s.t_ns for s in states]), np.array([s.T_world_body for s in states]))
        errors[by] = evaluate(path, recording.truth(), "yaw")["ate_rmse_m"]
    return errors, slam


if __name__ == "__main__":
    alone, _ = errors_m()
    print("no further sensor: " + ", ".join(f"{by} {error:.3f} m" for by, error in alone.items()))
    for kind in KINDS if "all" in sys.argv else sys.argv[1:] or ("wheels", "range"):
        lines, rate_hz = KINDS[kind]
        table = f'[sensors.it]\nkind = "{kind}"\nsimulated_hz = {rate_hz:.1f}\n{lines}\n'
        errors, slam = errors_m(table)
        print(f"\n{table}" + ", ".join(f"{by} {error:.3f} m" for by, error in errors.items()))
        told = slam.front.report().sensors["it"]
        assert told["begun"], told
        (values, sigmas), own = slam.back.graph.own("it"), told.get("filter", {}).get("values", [])
        for name, by_filter, by_graph, sigma in zip(told["variables"], own, values, sigmas, strict=True):
            print(f"  {name}: {by_filter:.3f} by the filter, {by_graph:.3f} +- {sigma:.3f} by the graph")
        assert max(errors[by] - alone[by] for by in errors) < 0.03, "a good sensor harms nobody"
