"""One recording through the pipeline into a run folder: the library's side of `vislam run`.

`drive` feeds the pipeline and keeps the folder, `metrics` says what came out, `view` what the viewer is shown.
"""

from vislam.run.drive import Progress, Run, execute, imu_noise, resume

__all__ = ["Progress", "Run", "execute", "imu_noise", "resume"]
