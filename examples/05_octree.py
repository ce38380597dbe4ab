"""5. An octree: depth becomes a map that keeps apart what is free, what is occupied and what nobody has seen.

    python examples/05_octree.py

A robot looks at a wall with a pillar before it, and asks what planners ask: may I stand there, how far can I look,
where is the next obstacle. Behind the pillar the honest answer is "unknown".
"""

import tempfile
from pathlib import Path

import numpy as np

from vislam import Octree
from vislam.mapping.octree import Occupancy, nearest_obstacle, ray_cast, sphere_state

# a scan: rays from the origin to a wall at x = 4 m, or to the pillar, a disc of 0.3 m radius around (2, 0)
angle, slope = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.7, 0.7, 400), np.linspace(-0.2, 0.2, 120)))
ways = np.column_stack([np.cos(angle), np.sin(angle), slope])
to_wall_m = 4.0 / ways[:, 0]
along = 2.0 * np.cos(angle)
inside = 0.3**2 - (2.0 * np.sin(angle)) ** 2  # of a ray that meets the pillar
to_pillar_m = along - np.sqrt(np.maximum(inside, 0.0))
points = ways * np.where(inside > 0.0, to_pillar_m, to_wall_m)[:, None]

grid = Octree(resolution_m=0.05)
for _ in range(3):  # one look is a hint; log-odds add up
    grid.insert(points, origin_map_m=np.zeros(3))

places = {"before the pillar": (1.0, 0.0, 0.0), "behind it": (3.0, 0.0, 0.0), "beside it": (2.0, 1.0, 0.0)}
states = sphere_state(grid, np.array(list(places.values())), radius_m=0.15)
for name, state in zip(places, states, strict=True):
    print(f"a robot of 15 cm {name}: {Occupancy(state).name.lower()}")

hits = ray_cast(grid, [0.0, 0.0, 0.0], [[1.0, 0.0, 0.0], [1.0, 0.5, 0.0]], max_range_m=10.0)
print(f"straight ahead the view ends after {hits.range_m[0]:.2f} m, half left after {hits.range_m[1]:.2f} m")

near = nearest_obstacle(grid, [[1.0, 0.0, 0.0]], window_m=2.0)
print(f"from (1, 0) the next obstacle is {near.distance_m[0]:.2f} m away")

# .bt is OctoMap's own format: octovis shows it, and any planner reads it
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "map.bt"
    grid.save(path)
    again = Octree.load(path)
    print(f"{path.stat().st_size} bytes on disk")

assert states.tolist() == [Occupancy.FREE, Occupancy.UNKNOWN, Occupancy.FREE]
assert abs(hits.range_m[0] - 1.7) < 0.05
assert np.array_equal(again.state_at(points), grid.state_at(points))
