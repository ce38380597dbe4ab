"""Attitude against the library VQF, which this project does not need: the same samples through both, and their ratio.

    pip install vqf    # into an environment of its own
    python benchmarks/attitude.py --broad FOLDER --cart 4

BROAD (Laidig et al. 2021): rms over what moved of the whole error, the heading and the inclination, with the
magnetometer; started by the first 2 s as power-up does. The synthetic cart of the tests: inclination without it. Beside
them the squared error of the inclination over what the filter said of it, per degree of freedom: 1 is honest.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import numpy as np  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402
from vqf import VQF  # noqa: E402

from vislam.config import AttitudeConfig  # noqa: E402
from vislam.core.messages import Array  # noqa: E402
from vislam.imu import AttitudeFilter  # noqa: E402
from worlds.broad import Trial, errors_deg, rms, started  # noqa: E402
from worlds.cart import Cart  # noqa: E402
from worlds.parts import GRAVITY_M_S2  # noqa: E402

METHODS = ("vqf", "complementary")


def matrices(wxyz: Array) -> Array:
    """Return rotations [N, 3, 3] of quaternions [N, 4]."""
    return Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix()


def broad(folder: Path) -> None:
    """Print all trials of a folder."""
    for path in sorted(folder.glob("*.mat")):
        trial = Trial.read(path)
        theirs = VQF(1.0 / trial.rate_hz).updateBatch(trial.span.gyro_rad_s, trial.span.accel_m_s2, trial.field_ut)
        library = rms(errors_deg(trial, matrices(theirs["quat9D"])))
        print(f"{path.stem}\n    {'library':14}{library.round(2)} deg (all, heading, inclination)")
        for method in METHODS:
            R, sigma_rad = trial.estimate(started(trial, AttitudeConfig(method=method)))
            errors = errors_deg(trial, R)
            ratio = np.mean(np.deg2rad(errors[2]) ** 2 / (2.0 * sigma_rad[trial.is_used] ** 2))
            ours = rms(errors)
            print(f"    {method:14}{ours.round(2)} deg, {(ours / library).round(2)} of the library's; NEES {ratio:.2f}")


def carts(count: int) -> None:
    """Print the first drives, without vibration and with it."""
    for shake in (0.0, 0.5):
        drives = [Cart.drive(seed, shake=shake) for seed in range(count)]
        samples = [(drive.span.gyro_rad_s, drive.span.accel_m_s2) for drive in drives]
        quaternions = [VQF(1.0 / 200.0).updateBatch(gyro, accel)["quat6D"] for gyro, accel in samples]
        library = [rms(drive.tilt_deg(matrices(q))) for drive, q in zip(drives, quaternions, strict=True)]
        print(f"cart, vibration {shake} m/s^2\n    {'library':14}{np.mean(library):.3f} deg of inclination")
        for method in METHODS:
            config, ours = AttitudeConfig(method=method), []
            for drive in drives:
                attitude = AttitudeFilter(config, GRAVITY_M_S2, drive.R_world_body[0], np.zeros(3))
                ours.append(rms(drive.tilt_deg(attitude.add_span(drive.span))))
            print(f"    {method:14}{np.mean(ours):.3f} deg, {np.mean(ours) / np.mean(library):.2f} of the library's")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--broad", type=Path, help="folder of BROAD's .mat files")
    parser.add_argument("--cart", type=int, default=4, help="drives of the synthetic cart")
    options = parser.parse_args()
    if options.broad is not None:
        broad(options.broad)
    carts(options.cart)
