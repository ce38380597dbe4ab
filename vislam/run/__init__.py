"""One recording through the pipeline into a run folder: the library's side of `vislam run`.

`drive` feeds the pipeline and keeps the folder, `metrics` says what came out, `view` what the viewer is shown.
"""

from vislam.run.drive import Progress, Run, begun, execute, imu_noise, map_of, resume

__all__ = ["Progress", "Run", "begun", "execute", "imu_noise", "map_of", "resume"]
