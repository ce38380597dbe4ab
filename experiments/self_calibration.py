"""What `vislam calibrate self` finds, against the calibration that a recording brings, and what a run makes of it.

    .venv/bin/python experiments/self_calibration.py SOURCE ... [--wrong 1.2] [--model auto] [--runs] [--out FOLDER]

SOURCE is anything that `vislam run` takes. The search begins with a focal length wrong by --wrong and no distortion.
With --runs each recording on disk is run twice, with its own calibration and with the one that was found.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from vislam.calibration.kinds import KINDS
from vislam.calibration.options import SelfOptions
from vislam.config import CalibrationConfig, Config, FrontEndConfig
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.run import execute
from vislam.run.folder import prepare
from vislam.run.sources import open_source


def true_rig(source: str) -> Rig:
    """Return the rig that a recording tells, or of simulated points the one that projected them."""
    recording = open_source(source)
    return getattr(recording, "true_rig", recording.rig)


def field_deg(camera: Camera, wrong: float, model: str) -> float:
    """Return the horizontal field of view that a wrong focal length stands for."""
    half = 0.5 * camera.width / (wrong * camera.fx)
    return float(np.rad2deg(2.0 * (half if model == "equidistant" else np.arctan(half))))


def ate_m(source: str, folder: Path, calibration: CalibrationConfig, mode: str, readout_s: float | None) -> float:
    """Run a recording and return the error of its final trajectory."""
    prepare(folder, overwrite=True)
    config = Config(calibration=calibration, frontend=FrontEndConfig(mode=mode, readout_s=readout_s))
    metrics = execute(open_source(source, 0, calibration), config, folder, source, ["experiments/self_calibration.py"])
    return float(metrics["accuracy"]["graph"]["ate_rmse_m"])


def main() -> None:
    """Print one table per recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--wrong", type=float, default=1.2)
    parser.add_argument("--model", default="auto")
    parser.add_argument("--mode", default="auto", help="front end of the runs")
    parser.add_argument("--runs", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("self_calibration"))
    arguments = parser.parse_args()
    for number, source in enumerate(arguments.sources):
        rig, folder = true_rig(source), arguments.out / str(number)
        camera = rig.cameras[0]
        wide = camera.distortion if arguments.model == "auto" else arguments.model
        fov_deg = field_deg(camera, arguments.wrong, wide)
        print(f"\n{source}: begins at {arguments.wrong * camera.fx:.0f} px, {fov_deg:.0f} deg")
        options = SelfOptions(source, fov_deg=fov_deg, model=arguments.model, out=folder, overwrite=True)
        try:
            report = KINDS["self"].calibrate(options).report
        except DataError as error:
            print(f"  refused: {error}")
            continue
        truth = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients]
        for (name, value), told in zip(report["parameters"].items(), truth, strict=False):
            sigma = report["sigmas"][name]
            print(f"  {name:>4} {value:10.4f}  truth {told:10.4f}  error {value - told:+9.4f}  sigma {sigma:8.4f}")
        print(
            f"  readout {1e3 * report['parameters']['readout_s']:.2f} +- {1e3 * report['sigmas']['readout_s']:.2f} ms"
        )
        print(f"  camera and IMU: {report['camera_imu']}")
        arm = report["camera_imu"].get("accelerometer")
        if arm is not None:
            errors_cm = 1e2 * (np.array(arm["translation_m"]) - rig.T_body_cams[0][:3, 3])
            sigmas_cm = 1e2 * np.array(arm["translation_sigma_m"])
            print(f"  translation off by {errors_cm.round(2)} cm, sigma {sigmas_cm.round(2)} cm")
        if arguments.runs:
            found = CalibrationConfig(camera=str(folder / "camchain.yaml"))
            own = ate_m(source, folder / "own", CalibrationConfig(), arguments.mode, None)
            new = ate_m(source, folder / "found", found, arguments.mode, None)
            print(f"  ATE {own:.4f} m with its own calibration, {new:.4f} m with this one: {new / own:.2f} times")


if __name__ == "__main__":
    main()
