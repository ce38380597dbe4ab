"""A recording with registered depth, seen by made-up depth cameras: what does a run lose, what does calibration find?

    python experiments/unregistered_depth.py tum:/data/rgbd_dataset_freiburg1_desk
    python experiments/unregistered_depth.py tum:/data/rgbd_dataset_freiburg1_desk --cases 0 3 --calibrate

Each camera has another focal length (0.8 to 1.2), sits 15 to 60 mm beside colour, is turned by up to 1 degree, and is
0 to 40 ms late. Depth is drawn into it, what it hides from itself is lost. Copies are made in a temporary folder, which
is removed.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import vislam
from vislam.core.geometry import invert, so3_exp, so3_log
from vislam.datasets import survey
from vislam.datasets.calibration_text import camera_text, depth_keys_text
from vislam.datasets.images import DepthFormat, read_depth
from vislam.datasets.rgbd import fit_place, misplaced
from vislam.datasets.stream import Survey, with_depth_format
from vislam.vision.depth_registration import DepthCamera, DepthRegistration

UNITS_PER_M = 5000.0
CASES = 12


def made_up(case: int, found: Survey) -> DepthFormat:
    """Return how depth of one made-up camera is read."""
    assert found.rig is not None
    generator = np.random.default_rng(case)
    color = found.rig.cameras[0]
    lens = replace(
        color, fx=color.fx * (f := generator.uniform(0.8, 1.2)), fy=color.fx * f, cx=color.width / 2 + 3.0,
        cy=color.height / 2 - 4.0, distortion="none", coefficients=(),
    )  # fmt: skip
    T, side = np.eye(4), generator.normal(size=3) * [1.0, 0.5, 0.2]
    T[:3, 3] = side / np.linalg.norm(side) * generator.uniform(0.015, 0.060)
    turn = generator.normal(size=3)
    T[:3, :3] = so3_exp(turn / np.linalg.norm(turn) * np.deg2rad(generator.uniform(0.0, 1.0)))
    return DepthFormat(UNITS_PER_M, time_offset_s=-generator.uniform(0.0, 0.040), own=DepthCamera(lens, T))


def write_seen(found: Survey, how: DepthFormat, stated: DepthFormat, folder: Path) -> Path:
    """Write a TUM folder whose depth is seen as `how` says, and whose calibration says `stated`."""
    assert found.rig is not None and found.depth is not None and how.own is not None
    color, lens = found.rig.cameras[0], how.own.camera
    (folder / "depth").mkdir(parents=True)
    os.symlink((found.root / "rgb").resolve(), folder / "rgb")
    for name in ("rgb.txt", "groundtruth.txt"):
        os.symlink((found.root / name).resolve(), folder / name)
    drawing = DepthRegistration(DepthCamera(color, invert(how.own.T_color_depth)), lens)
    lines = []
    for i, t_ns in enumerate(found.depth.t_ns.tolist()):
        depth_m = drawing.registered(read_depth(found.depth.path(i), color, found.depth_format))
        raw = np.minimum(np.rint(depth_m * UNITS_PER_M), 65534).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{i}.png"), raw, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        lines.append(f"{t_ns * 1e-9 - how.time_offset_s:.6f} depth/{i}.png\n")
    (folder / "depth.txt").write_text("".join(lines))
    (folder / "sensor.yaml").write_text(camera_text(color, None, "made up") + depth_keys_text(stated))
    return folder


def ate_m(source: str, folder: Path) -> float:
    """Return the error of a run's final trajectory in metres."""
    run = vislam.run(source, out=folder, frontend={"mode": "rgbd"}, map={"enabled": False})
    return float(run.metrics["accuracy"]["graph"]["ate_rmse_m"])


def found_again(source: str, truth: DepthFormat) -> str:
    """Return how far place, focal length and lag are from the truth, found from a start that is off."""
    assert truth.own is not None
    seen = survey(source)
    start = replace(truth, time_offset_s=0.0, own=DepthCamera(truth.own.camera.with_focal(1.03), np.eye(4)))
    assert seen.rig is not None
    fit = fit_place(with_depth_format(seen, start), seen.rig)
    if fit is None or fit.how.own is None:
        return "nothing found"
    off = fit.how.own.T_color_depth @ invert(truth.own.T_color_depth)
    mm = 1e3 * (fit.how.own.T_color_depth - truth.own.T_color_depth)[:3, 3]
    late_ms = 1e3 * (truth.time_offset_s - fit.how.time_offset_s)
    return (
        f"turn {np.rad2deg(so3_log(off[:3, :3])).round(2)} deg, place {mm.round(1)} mm, focal length "
        f"{fit.how.own.camera.fx / truth.own.camera.fx - 1.0:+.2%}, lag {late_ms:+.1f} ms"
    )


def as_registered(source: Path, truth: DepthFormat, out: Path) -> str:
    """Return how depth that is taken for registered is judged, and the error by what is found of it then."""
    (source / "sensor.yaml").write_text(camera_text(survey(str(source)).rig.cameras[0], None, "made up"))
    seen = survey(str(source))
    assert seen.rig is not None and truth.own is not None
    fit = misplaced(seen, seen.rig)
    if fit is None or fit.how.own is None:
        return "taken for registered"
    (source / "sensor.yaml").write_text(camera_text(seen.rig.cameras[0], None, "found") + depth_keys_text(fit.how))
    mm = 1e3 * (fit.how.own.T_color_depth - truth.own.T_color_depth)[:3, 3]
    return (
        f"place {mm.round(1)} mm, focal length {fit.how.own.camera.fx / truth.own.camera.fx - 1.0:+.2%}, "
        f"{ate_m(str(source), out):.4f} m"
    )


def main() -> None:
    """Run the cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source")
    parser.add_argument("--cases", type=int, nargs="+", default=list(range(CASES)))
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="find the camera, too, from a start that is off, and with nothing stated",
    )
    args = parser.parse_args()
    found = survey(args.source)
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        own_m = ate_m(args.source, root / "own")
        print(f"registered: {own_m:.4f} m", flush=True)
        for case in args.cases:
            how = made_up(case, found)
            folder = write_seen(found, how, how, root / f"seen{case}")
            seen_m = ate_m(str(folder), root / f"run{case}")
            print(f"{case}: {seen_m:.4f} m, {seen_m / own_m:.2f} of it", flush=True)
            if args.calibrate:
                print(f"   {found_again(str(folder), how)}", flush=True)
                print(f"   as registered: {as_registered(folder, how, root / f'found{case}')}", flush=True)


if __name__ == "__main__":
    main()
