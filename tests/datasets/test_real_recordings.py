"""The readers on the real recordings: what each is known to hold."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from vislam.config import CalibrationConfig
from vislam.core import Frame, ImuSample, Problems
from vislam.core.streams import Happening
from vislam.datasets import open_dataset, survey
from vislam.datasets.camera_files import CameraCalibration, camchain_text
from vislam.datasets.extrinsics import contradicted_extrinsics
from vislam.datasets.inspect import inspect
from vislam.datasets.stream_checks import StreamChecks
from vislam.datasets.tables import in_time_order

pytestmark = pytest.mark.data


def test_euroc_mh01(data_root: Path) -> None:
    recording = open_dataset(str(data_root / "euroc_mh01_17s"))
    assert recording.frame_count == 329
    frames = imu = 0
    last_ns = 0
    for event in recording.events():
        assert event.t_ns >= last_ns
        last_ns = event.t_ns
        frames += isinstance(event, Frame)
        imu += isinstance(event, ImuSample)
        if isinstance(event, Frame):
            assert event.index == frames - 1 and [i.shape for i in event.images] == [(480, 752)] * 2
    assert (frames, imu) == (329, 3720)
    assert recording.problems == {"stereo image without partner": 2}
    truth = recording.truth()
    assert truth is not None and len(truth.t_ns) == 3720
    assert recording.rig.T_cam0_cam1[0, 3] == pytest.approx(0.110, abs=1e-3)


def test_tum_fr1_desk(data_root: Path) -> None:
    recording = open_dataset(f"tum:{data_root / 'tum_fr1_desk'}")
    assert recording.frame_count == 613 and recording.rig.cameras[0].fx == 517.306408
    events = recording.events()
    frames = [next(events) for _ in range(30)]
    events.close()
    assert all(f.color is not None and f.color.shape == (480, 640, 3) for f in frames)
    depth_m = next(f.depth_m for f in frames if f.depth_m is not None)
    assert 0.4 < float(np.median(depth_m[depth_m > 0])) < 3.0
    assert recording.problems == {"frame without depth": 40}  # 573 matches, as the benchmark's own script
    truth = recording.truth()
    assert truth is not None and len(truth.t_ns) == 2335


@pytest.mark.slow
def test_doctor_approves_of_euroc_and_refuses_inverted_extrinsics(data_root: Path, tmp_path: Path) -> None:
    result = inspect(str(data_root / "euroc_mh01_17s"))
    assert result.worst == "warning"  # the two images without partner
    assert [f.what for f in result.findings if f.severity == "warning"] == ["stereo image without partner: 2"]
    assert any("turns seen by cam0 and by the gyro differ by" in f.what for f in result.findings)
    source, root = data_root / "euroc_mh01_17s" / "mav0", tmp_path / "mav0"
    for name in ("cam0", "imu0"):
        (root / name).mkdir(parents=True)
        for file in ("data.csv", "sensor.yaml"):
            shutil.copyfile(source / name / file, root / name / file)
    (root / "cam0" / "data").symlink_to(source / "cam0" / "data")
    half = (root / "cam0" / "data.csv").read_text().splitlines(keepends=True)[:170]
    (root / "cam0" / "data.csv").write_text("".join(half))
    sensor = yaml.safe_load((root / "cam0" / "sensor.yaml").read_text())
    T = np.linalg.inv(np.array(sensor["T_BS"]["data"]).reshape(4, 4))
    sensor["T_BS"]["data"] = T.ravel().tolist()
    (root / "cam0" / "sensor.yaml").write_text(yaml.safe_dump(sensor))
    inverted = inspect(str(tmp_path))
    assert any(f.severity == "error" and "extrinsics or time stamps are wrong" in f.what for f in inverted.findings)
    [told] = contradicted_extrinsics(open_dataset(str(tmp_path)))  # as a run that went wrong names it
    assert "extrinsics or time stamps are wrong: with the inverse they differ by" in told


def test_a_pair_whose_places_are_inverted_is_named_to_a_run_that_went_wrong(data_root: Path, tmp_path: Path) -> None:
    recording = open_dataset(str(data_root / "euroc_mh01_17s"))
    assert contradicted_extrinsics(recording) == ()
    one, other = (
        CameraCalibration(c, np.linalg.inv(T))
        for c, T in zip(recording.rig.cameras, recording.rig.T_body_cams, strict=True)
    )
    chain = tmp_path / "chain.yaml"
    chain.write_text(camchain_text((one, other), "inverted"))
    told = contradicted_extrinsics(
        open_dataset(str(data_root / "euroc_mh01_17s"), CalibrationConfig(camera=str(chain)))
    )
    assert "write the inverse of both T_BS" in told[0] and "cam0 and by the gyro differ" in told[1]


def test_inertial_recordings_are_inspected(data_root: Path) -> None:
    result = inspect(str(data_root / "euroc_v101_imu"))
    assert {s.name: s.count for s in result.streams} == {"imu0": 29120, "truth": 2895}
    assert any("specific force 9.79" in f.what and f.severity == "ok" for f in result.findings)


def test_the_doctor_tells_how_truth_fits_the_imu(data_root: Path) -> None:
    result = inspect(str(data_root / "euroc_v202_imu"))
    assert any("truth is turned by 0.6" in finding.what for finding in result.findings)
    assert any("truth has noise of below 0.0" in finding.what for finding in result.findings)


@pytest.mark.parametrize(
    "name",
    ["euroc_mh01_17s", "euroc_v101_imu", "euroc_v201_imu", "euroc_v202_imu", "tumvi_room1_imu", "tum_fr1_desk",
     "hololens_000"],
)  # fmt: skip
def test_nothing_happens_in_the_streams_of_clean_recordings(data_root: Path, name: str) -> None:
    found, problems = survey(str(data_root / name)), Problems()
    problems.judges |= found.problems.judges
    checks = StreamChecks(problems)
    if found.has_imu:
        rate_hz = 0.0 if found.imu_noise is None else found.imu_noise.rate_hz
        assert len(list(checks.watched(in_time_order(found.imu_rows(problems), problems, "imu", rate_hz=rate_hz)))) > 0
    for images in found.cameras:
        for k in range(0, len(images.files) - 3, 3):
            grey = cv2.imread(str(images.path(k)), cv2.IMREAD_GRAYSCALE)
            checks.look_at(images.name, grey, int(images.t_ns[k]), int(images.t_ns[k + 3]))
    assert problems.judges
    assert checks.findings(0) == []
    assert all(event.happening is Happening.HOLE for judge in problems.judges.values() for event in judge.events)
