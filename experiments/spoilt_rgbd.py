"""A TUM recording spoilt in 20 ways: what does `vislam doctor` say of colour against depth, and how large?

    python experiments/spoilt_rgbd.py tum:/data/rgbd_dataset_freiburg1_desk
    python experiments/spoilt_rgbd.py tum:/data/rgbd_dataset_freiburg1_desk --clean sim_folder ... --cases 0 5

Every second case was used to choose limits, the others (marked) were not. A case is right when all that was spoilt is
accused, with a size near what was done (0.01 of the focal length, 1.5 px, 6 ms), and nothing else; sizes are those
beyond what the recording has by itself. Copies are made in a temporary folder, which is removed.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from vislam.core import Problems
from vislam.datasets import survey
from vislam.datasets.calibration_text import camera_text
from vislam.datasets.rgbd import RgbdFacts, rgbd_facts, rgbd_faults
from vislam.datasets.stream import Survey, frame_table


@dataclass(frozen=True)
class Spoil:
    """What is done to a recording."""

    focal: float = 1.0  # told over true
    shift_px: tuple[int, int] = (0, 0)
    late_ms: float = 0.0
    invalid: int = 0
    scale: float = 1.0

    @property
    def wanted(self) -> set[str]:
        """What must be accused."""
        done = {
            "focal length": self.focal != 1.0, "offset": self.shift_px != (0, 0), "lag": self.late_ms != 0.0,
            "invalid value": self.invalid != 0, "scale": self.scale != 1.0,
        }  # fmt: skip
        return {what for what, is_done in done.items() if is_done}


CASES = (
    Spoil(focal=1.02), Spoil(focal=0.98), Spoil(focal=1.05), Spoil(focal=0.95), Spoil(focal=1.11), Spoil(focal=0.89),
    Spoil(shift_px=(6, 0)), Spoil(shift_px=(-8, 0)), Spoil(shift_px=(0, 6)), Spoil(shift_px=(5, -7)),
    Spoil(shift_px=(12, 8)), Spoil(shift_px=(-10, 4)), Spoil(late_ms=30.0), Spoil(late_ms=50.0), Spoil(late_ms=-50.0),
    Spoil(invalid=65535), Spoil(invalid=40000), Spoil(scale=1.05), Spoil(focal=1.05, shift_px=(8, 0)),
    Spoil(focal=0.95, late_ms=30.0),
)  # fmt: skip


def write_spoilt(found: Survey, spoil: Spoil, folder: Path) -> Path:
    """Write a TUM folder that is `found` but for what is spoilt; colour images are links."""
    (folder / "depth").mkdir(parents=True)
    assert found.rig is not None and found.depth is not None
    color, camera = found.cameras[0], found.rig.cameras[0]
    (folder / "rgb").mkdir()
    for list_name, images, name, late_ms in (
        ("rgb.txt", color, "rgb", 0.0), ("depth.txt", found.depth, "depth", spoil.late_ms)
    ):  # fmt: skip
        lines = []
        for i, t_ns in enumerate(images.t_ns.tolist()):
            path = images.path(i).resolve()
            lines.append(f"{t_ns * 1e-9 + late_ms * 1e-3:.6f} {name}/{path.name}\n")
            copy = folder / name / path.name
            if name == "depth" and (spoil.shift_px != (0, 0) or spoil.invalid or spoil.scale != 1.0):
                cv2.imwrite(str(copy), _spoilt(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), spoil))
            else:
                os.symlink(path, copy)
        (folder / list_name).write_text("".join(lines))
    wrong = replace(camera, fx=camera.fx * spoil.focal, fy=camera.fy * spoil.focal)
    units = f"depth_units_per_m: {found.depth_format.units_per_m}\n"
    (folder / "sensor.yaml").write_text(camera_text(wrong, None, "spoilt") + units)
    for name in ("groundtruth.txt", "accelerometer.txt"):
        if (found.root / name).is_file():
            os.symlink((found.root / name).resolve(), folder / name)
    return folder


def _spoilt(raw: np.ndarray, spoil: Spoil) -> np.ndarray:
    dx, dy = spoil.shift_px
    shift = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]])
    raw = cv2.warpAffine(raw, shift, raw.shape[::-1], flags=cv2.INTER_NEAREST)
    raw = np.minimum(np.rint(raw * spoil.scale), 65535).astype(np.uint16)
    return np.where(raw == 0, np.uint16(spoil.invalid), raw)


def facts_of(found: Survey) -> RgbdFacts:
    """Measure a recording as the doctor does."""
    assert found.rig is not None
    return rgbd_facts(found, found.rig, frame_table(found, Problems()))


def told(facts: RgbdFacts) -> str:
    """Return the numbers in one line."""
    edges, focal = facts.edges, facts.focal
    place = "no edges" if edges is None else (
        f"({facts.offset_px[0]:.1f}, {facts.offset_px[1]:.1f}) ± {np.linalg.norm(edges.offset_sigma_px):.1f} px, "
        f"{1e3 * facts.lag_s:.0f} ± {1e3 * edges.lag_sigma_s:.0f} ms"
    )  # fmt: skip
    return f"{place}, f x {focal.factor:.4f} ± {focal.sigma:.4f}" if focal is not None else f"{place}, f unknown"


def is_right(facts: RgbdFacts, own: RgbdFacts, spoil: Spoil, accused: set[str]) -> bool:
    """Return whether exactly what was spoilt is accused, with its size."""
    if accused != spoil.wanted:
        return False
    good = True
    if facts.focal is not None and own.focal is not None and "focal length" in accused:
        good &= abs(facts.focal.factor * spoil.focal - own.focal.factor) < 0.01
    if facts.edges is not None and own.edges is not None:
        if "offset" in accused:
            beyond = facts.offset_px - own.offset_px - spoil.shift_px
            good &= float(np.abs(beyond).max()) < 1.5
        if "lag" in accused:
            good &= abs(facts.lag_s - own.lag_s - 1e-3 * spoil.late_ms) < 0.006
    return good


def main() -> None:
    """Print one line per case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--clean", nargs="*", default=[], help="recordings in which nothing is wrong")
    parser.add_argument("--cases", nargs="*", type=int, default=range(len(CASES)), help="only these, from 0")
    options = parser.parse_args()
    found = survey(options.recording)
    own = facts_of(found)
    for name, facts in [(options.recording, own), *((name, facts_of(survey(name))) for name in options.clean)]:
        accused = {fault.what for fault in rgbd_faults(facts, 640)}
        print(f"clean {Path(name).name}: {told(facts)}; accused: {', '.join(sorted(accused)) or 'nothing'}", flush=True)
    right = 0
    for k in options.cases:
        spoil = CASES[k]
        with tempfile.TemporaryDirectory() as folder:
            facts = facts_of(survey(f"tum:{write_spoilt(found, spoil, Path(folder) / 'spoilt')}"))
        accused = {fault.what for fault in rgbd_faults(facts, 640)}
        is_good = is_right(facts, own, spoil, accused)
        right += is_good
        mark = ("right" if is_good else "WRONG") + (", held out" if k % 2 else "")
        print(f"{k} {spoil}: {told(facts)}; accused: {', '.join(sorted(accused)) or 'nothing'} [{mark}]", flush=True)
    print(f"{right} of {len(options.cases)} right")


if __name__ == "__main__":
    main()
