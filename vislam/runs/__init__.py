"""One recording through the pipeline into a run folder: the library's side of `vislam run`.

`begin` starts or resumes a run, `drive` feeds the pipeline and keeps the folder, `metrics` sums up the results, `show`
what the viewer is shown.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.runs.begin import begun, check_fits, execute, map_of, resume
    from vislam.runs.drive import Run, imu_noise
    from vislam.runs.further_sensors import further_readings
    from vislam.runs.offline.depth_localiser import depth_localiser

__all__ = [
    "Run",
    "begun",
    "check_fits",
    "depth_localiser",
    "execute",
    "further_readings",
    "imu_noise",
    "map_of",
    "resume",
]

__getattr__ = late(
    __name__,
    {
        "begun": "vislam.runs.begin",
        "check_fits": "vislam.runs.begin",
        "execute": "vislam.runs.begin",
        "map_of": "vislam.runs.begin",
        "resume": "vislam.runs.begin",
        "depth_localiser": "vislam.runs.offline.depth_localiser",
        "further_readings": "vislam.runs.further_sensors",
        "Run": "vislam.runs.drive",
        "imu_noise": "vislam.runs.drive",
    },
)
