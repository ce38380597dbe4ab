"""The focal length that depth images tell, and recordings that have none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vislam.calibration.self_calibration.depth_lens import focal_by_depth
from vislam.run.sources import open_source


def test_depth_images_undo_a_focal_length_that_is_a_little_wrong(data_root: Path) -> None:
    source = f"tum:{data_root / 'tum_fr1_desk'}"
    camera = open_source(source).rig.cameras[0]
    found = focal_by_depth(source, replace(camera, fx=1.02 * camera.fx, fy=1.02 * camera.fy))
    assert found is not None and abs(1.02 * found.factor - 1.0) < 0.005
    assert abs(1.02 * found.factor - 1.0) < 3.0 * found.sigma < 0.03


def test_a_recording_without_depth_says_nothing(data_root: Path, tmp_path: Path) -> None:
    source = f"euroc:{data_root / 'euroc_mh01_17s'}"
    camera = open_source(source).rig.cameras[0]
    assert focal_by_depth(source, camera) is None
    assert focal_by_depth(f"tum:{tmp_path}", camera) is None
