"""A plan whose jobs take a second of CPU each: simulated vision on a simulated motion."""

PLAN = """
name = "tiny"
seeds = [0, 1]
members = 1
timeout_s = 300.0
config = {"loop.enabled" = false}

[[sequences]]
name = "laps"
source = "points:laps"
options = {duration_s = 5.0, tracks = 40, camera_hz = 10.0, descriptors = false}

[[estimators]]
name = "loose"
outputs = ["ekf", "graph"]

[[estimators]]
name = "slow vision"
outputs = ["ekf", "graph"]
config = {"ekf.vision_delay_s" = 0.2}
"""


def write_plan(folder, text=PLAN):
    path = folder / "tiny.toml"
    path.write_text(text)
    return path
