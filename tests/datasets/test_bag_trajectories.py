"""The same recording from its folder and from a bag of it gives the same bytes of trajectory."""

from __future__ import annotations

from pathlib import Path

import pytest

from needs import missing
from vislam.cli import run_verb
from vislam.datasets import survey
from vislam.datasets.camera_files import CameraCalibration, camchain_text
from vislam.datasets.formats.tum import PUBLISHED
from worlds.bag_writer import from_asl, from_tum, types_of, write_bag

FRAMES = 70
TRAJECTORIES = ("trajectory_ekf.tum", "trajectory_graph.tum", "trajectory_live.tum")


def begun(folder: Path, out: Path, lists: dict[str, int]) -> Path:
    """The first part of a recording: what is in `lists` cut after so many lines, all else linked."""
    out.mkdir(parents=True)
    for path in folder.iterdir():
        inner = {name.partition("/")[2]: count for name, count in lists.items() if name.startswith(f"{path.name}/")}
        if inner:
            begun(path, out / path.name, inner)
        elif path.name in lists:
            lines = path.read_text().splitlines(keepends=True)
            (out / path.name).write_text("".join(lines[: lists[path.name]]))
        else:
            (out / path.name).symlink_to(path.resolve())
    return out


def trajectories(source: str, out: Path, *options: str) -> list[bytes]:
    assert run_verb(["run", source, "--out", str(out), "--view.no-enabled", "--map.no-enabled", *options]) == 0
    return [(out / name).read_bytes() for name in TRAJECTORIES]


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bag-lz4", "mcap-zstd", "db3"])
def test_of_a_stretch_of_mh_01(kind: str, data_root: Path, tmp_path: Path) -> None:
    """A bag's transforms are quaternions, which round the matrices of the folder: both are given the same file."""
    whole = data_root / "euroc_mh01_17s"
    if not whole.is_dir():
        missing(f"{whole}")
    rows = {"mav0/cam0/data.csv": FRAMES + 1, "mav0/cam1/data.csv": FRAMES + 1, "mav0/imu0/data.csv": 10 * FRAMES + 60}
    folder = begun(whole, tmp_path / "folder", rows)
    rig = survey(str(folder)).rig
    assert rig is not None
    chain = tmp_path / "chain.yaml"
    pairs = zip(rig.cameras, rig.T_body_cams, strict=True)
    chain.write_text(camchain_text([CameraCalibration(camera, T) for camera, T in pairs], "both"))
    options = ("--calibration.camera", str(chain))
    bag = write_bag(tmp_path, kind, from_asl(folder / "mav0", types_of(kind)))
    noise = ("--calibration.imu-noise", str(whole / "mav0/imu0/sensor.yaml"))
    of_folder = trajectories(f"euroc:{folder}", tmp_path / "a", *options)
    assert trajectories(str(bag), tmp_path / "b", *options, *noise) == of_folder
    assert len(of_folder[0]) > 1000


@pytest.mark.data
@pytest.mark.slow
def test_of_a_stretch_of_fr1_desk(data_root: Path, tmp_path: Path) -> None:
    whole = data_root / "tum_fr1_desk"
    if not whole.is_dir():
        missing(f"{whole}")
    folder = begun(whole, tmp_path / "freiburg1", {"rgb.txt": FRAMES + 3, "depth.txt": FRAMES + 3})
    bag = write_bag(tmp_path, "mcap", from_tum(folder, types_of("mcap"), PUBLISHED["1"]))
    of_folder = trajectories(f"tum:{folder}", tmp_path / "a", "--up", "none")  # by an accelerometer, which no bag has
    assert trajectories(str(bag), tmp_path / "b", "--up", "none") == of_folder
    assert len(of_folder[0]) > 1000
