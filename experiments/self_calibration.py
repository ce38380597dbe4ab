"""What `vislam calibrate self` finds, against the calibration that a recording brings, and what a run makes of it.

    .venv/bin/python experiments/self_calibration.py SOURCE ... [--wrong 1.2] [--model auto] [--runs] [--out FOLDER]

SOURCE is anything that `vislam run` takes. The search begins with a focal length wrong by --wrong and no distortion.
With --runs each recording on disk is run twice, with its own calibration and with the one that was found.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from vislam.calibration.kinds import KINDS
from vislam.calibration.options import SelfOptions
from vislam.config import CalibrationConfig, Config, FrontEndConfig
from vislam.core import Array
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.geometry import so3_exp
from vislam.datasets.camera_files import read_cameras
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.sources import open_source


def true_rig(source: str) -> Rig:
    """Return the rig that a recording tells, or of simulated points the one that projected them."""
    recording = open_source(source)
    return getattr(recording, "true_rig", recording.rig)


def field_deg(camera: Camera, wrong: float, model: str) -> float:
    """Return the horizontal field of view that a wrong focal length stands for."""
    half = 0.5 * camera.width / (wrong * camera.fx)
    return float(np.rad2deg(2.0 * (half if model == "equidistant" else np.arctan(half))))


def lens_difference(found: Camera, told: Camera) -> tuple[float, float]:
    """Return by which share the focal length of `found` is longer, and what else differs, rms in px.

    Over a grid of the image without its outer twentieth; a turn of the camera counts for nothing. So lenses with and
    without k3 can be compared, whose fx and fy mean different things.
    """
    u, v = (np.linspace(0.05, 0.95, n) * size for n, size in ((40, found.width), (30, found.height)))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = np.column_stack([found.normalise(pixels), np.ones(len(pixels))])
    seen = np.isfinite(rays).all(axis=1) & np.isfinite(told.project(rays)).all(axis=1)
    pixels, rays, centre = pixels[seen], rays[seen], np.array([told.cx, told.cy])

    def off(x: Array) -> Array:
        at = told.project(rays @ so3_exp(x[:3].copy()).T)
        return np.asarray(np.nan_to_num((1.0 + x[3]) * (at - centre) + centre - pixels, nan=1e3))

    fit = least_squares(lambda x: off(x).ravel(), np.zeros(4))
    return float(fit.x[3]), float(np.sqrt(np.mean(np.sum(off(fit.x) ** 2, axis=1))))


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
        truth = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients, *[0.0] * 5]
        lens = [item for item in report["parameters"].items() if item[0] != "readout_s"]
        for (name, value), told in zip(lens, truth, strict=False):
            sigma = report["sigmas"][name]
            print(f"  {name:>4} {value:10.4f}  truth {told:10.4f}  error {value - told:+9.4f}  sigma {sigma:8.4f}")
        longer, left_px = lens_difference(read_cameras(folder / "camchain.yaml")[0].camera, camera)
        print(f"  as lenses: focal length {longer:+.2%}, {left_px:.2f} px rms besides")
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
