"""The same recording from its folder and from a bag of it gives the same bytes of trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from needs import missing
from vislam.config import load
from vislam.datasets import survey
from vislam.datasets.camera_files import CameraCalibration, camchain_text
from vislam.datasets.formats.tum import PUBLISHED
from vislam.runs import execute
from vislam.runs.folder import prepare
from vislam.runs.sources import open_source
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


def trajectories(source: str, out: Path, **settings: object) -> list[bytes]:
    config = load(None, {"view.enabled": False, "map.enabled": False, **settings})
    prepare(out, overwrite=False)
    execute(open_source(source, config.seed, config.calibration), config, out, source, [])
    return [(out / name).read_bytes() for name in TRAJECTORIES]


@dataclass(frozen=True)
class Stretch:
    """The begin of a recording as a folder, how it is run, and what comes of that."""

    folder: Path
    settings: dict[str, object]
    trajectories: list[bytes]


@pytest.fixture(scope="module")
def mh_01(data_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Stretch:
    """A bag's transforms are quaternions, which round the matrices of the folder: both are given the same file."""
    whole, place = data_root / "euroc_mh01_17s", tmp_path_factory.mktemp("mh_01")
    if not whole.is_dir():
        missing(f"{whole}")
    rows = {"mav0/cam0/data.csv": FRAMES + 1, "mav0/cam1/data.csv": FRAMES + 1, "mav0/imu0/data.csv": 10 * FRAMES + 60}
    folder = begun(whole, place / "folder", rows)
    rig = survey(str(folder)).rig
    assert rig is not None
    chain = place / "chain.yaml"
    pairs = zip(rig.cameras, rig.T_body_cams, strict=True)
    chain.write_text(camchain_text([CameraCalibration(camera, T) for camera, T in pairs], "both"))
    settings: dict[str, object] = {"calibration.camera": str(chain)}
    return Stretch(folder, settings, trajectories(f"euroc:{folder}", place / "run", **settings))


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bag-lz4", "mcap-zstd", "db3"])
def test_of_a_stretch_of_mh_01(kind: str, mh_01: Stretch, data_root: Path, tmp_path: Path) -> None:
    bag = write_bag(tmp_path, kind, from_asl(mh_01.folder / "mav0", types_of(kind)))
    noise = {"calibration.imu_noise": str(data_root / "euroc_mh01_17s/mav0/imu0/sensor.yaml")}
    assert trajectories(str(bag), tmp_path / "run", **mh_01.settings, **noise) == mh_01.trajectories
    assert len(mh_01.trajectories[0]) > 1000


@pytest.mark.data
@pytest.mark.slow
def test_of_a_stretch_of_fr1_desk(data_root: Path, tmp_path: Path) -> None:
    whole = data_root / "tum_fr1_desk"
    if not whole.is_dir():
        missing(f"{whole}")
    folder = begun(whole, tmp_path / "freiburg1", {"rgb.txt": FRAMES + 3, "depth.txt": FRAMES + 3})
    bag = write_bag(tmp_path, "mcap", from_tum(folder, types_of("mcap"), PUBLISHED["1"]))
    of_folder = trajectories(f"tum:{folder}", tmp_path / "a", up="none")  # by an accelerometer, which no bag has
    assert trajectories(str(bag), tmp_path / "b", up="none") == of_folder
    assert len(of_folder[0]) > 1000
