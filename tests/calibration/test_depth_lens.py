"""The focal length that depth images tell, and recordings that have none."""

from dataclasses import replace
from pathlib import Path

from vislam.calibration.self_calibration.depth_lens import focal_by_depth
from vislam.runs.sources import open_source
from vislam.vision.depth_focal import FocalFit


def test_depth_images_undo_a_focal_length_that_is_a_little_wrong(data_root: Path) -> None:
    source = f"tum:{data_root / 'tum_fr1_desk'}"
    camera = open_source(source).rig.cameras[0]
    found = focal_by_depth(source, replace(camera, fx=1.02 * camera.fx, fy=1.02 * camera.fy))
    assert isinstance(found, FocalFit) and abs(1.02 * found.factor - 1.0) < 0.005
    assert abs(1.02 * found.factor - 1.0) < 3.0 * found.sigma < 0.03


def test_a_recording_without_depth_says_nothing(data_root: Path) -> None:
    source = f"euroc:{data_root / 'euroc_mh01_17s'}"
    camera = open_source(source).rig.cameras[0]
    assert focal_by_depth(source, camera) == ""


def test_a_recording_that_cannot_be_read_says_why(data_root: Path, tmp_path: Path) -> None:
    camera = open_source(f"euroc:{data_root / 'euroc_mh01_17s'}").rig.cameras[0]
    reason = focal_by_depth(f"tum:{tmp_path}", camera)
    assert isinstance(reason, str) and str(tmp_path) in reason
