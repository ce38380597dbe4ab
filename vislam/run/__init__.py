"""One recording through the pipeline into a run folder: the library's side of `vislam run`.

`begin` starts or resumes a run, `drive` feeds the pipeline and keeps the folder, `metrics` says what came out, `show`
what the viewer is shown.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.run.begin import begun, check_fits, execute, map_of, resume
    from vislam.run.drive import Progress, Run, imu_noise

__all__ = ["Progress", "Run", "begun", "check_fits", "execute", "imu_noise", "map_of", "resume"]

__getattr__ = late(
    __name__,
    {
        "begun": "vislam.run.begin",
        "check_fits": "vislam.run.begin",
        "execute": "vislam.run.begin",
        "map_of": "vislam.run.begin",
        "resume": "vislam.run.begin",
        "Progress": "vislam.run.drive",
        "Run": "vislam.run.drive",
        "imu_noise": "vislam.run.drive",
    },
)
