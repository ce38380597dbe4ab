"""One recording through the pipeline into a run folder: the library's side of `vislam run`.

`begin` starts or resumes a run, `drive` feeds the pipeline and keeps the folder, `metrics` says what came out, `view`
what the viewer is shown.
"""

from vislam.run.begin import begun, check_fits, execute, map_of, resume
from vislam.run.drive import Progress, Run, imu_noise

__all__ = ["Progress", "Run", "begun", "check_fits", "execute", "imu_noise", "map_of", "resume"]
