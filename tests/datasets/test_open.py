"""Naming a recording: formats, bare paths, and clear errors for what is none."""

import os
from pathlib import Path

import pytest

from vislam.core.errors import DataError, UsageError
from vislam.datasets import READERS, open_dataset
from vislam.datasets.inspect import inspect
from worlds.mini_recording import write_asl


def test_unknown_format_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no format 'rosbag' in .*; known formats: euroc, tum, kitti, video"):
        open_dataset(f"rosbag:{tmp_path}")


@pytest.mark.parametrize("name", ["", *READERS])
def test_missing_and_empty_folders_say_what_was_looked_for(tmp_path: Path, name: str) -> None:
    prefix = f"{name}:" if name else ""
    with pytest.raises(DataError, match="does not exist"):
        open_dataset(f"{prefix}{tmp_path / 'none'}")
    with pytest.raises(DataError, match="is empty; looked for") as caught:
        open_dataset(f"{prefix}{tmp_path}")
    wanted = [READERS[name]] if name else READERS.values()
    assert all(reader.LOOKS_FOR in str(caught.value) for reader in wanted)


def test_folder_of_something_else(tmp_path: Path) -> None:
    (tmp_path / "holiday.txt").write_text("sun")
    with pytest.raises(
        DataError, match=r"is no recording that vislam knows: looked for mav0/cam0/data.csv or mav0/imu0"
    ):
        open_dataset(str(tmp_path))


def test_wrong_format_for_a_recording_names_the_right_one(tmp_path: Path) -> None:
    write_asl(tmp_path, frames=2)
    with pytest.raises(DataError, match=f"is no tum recording: looked for rgb.txt; it looks like euroc:{tmp_path}"):
        open_dataset(f"tum:{tmp_path}")


def test_a_path_may_contain_a_colon(tmp_path: Path) -> None:
    folder = tmp_path / "run:7"
    write_asl(folder, frames=2)
    assert open_dataset(str(folder)).name == "run:7"
    assert open_dataset(f"euroc:{folder}").name == "run:7"


def test_a_file_without_permission_is_an_error_not_a_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = write_asl(tmp_path, frames=2)
    opened = os.open

    def refuse(path: Path, flags: int, *args: int) -> int:
        if Path(path).name == "data.csv":
            raise PermissionError(13, "Permission denied", str(path))
        return opened(path, flags, *args)

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(DataError, match=r"data.csv cannot be read: Permission denied"):
        open_dataset(str(root))


def test_a_pointer_of_git_lfs_is_named_as_one(tmp_path: Path) -> None:
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:" + "4d" * 32 + "\nsize 12345\n"
    mav0 = write_asl(tmp_path, stereo=False)
    for name in ("drive.mcap", "drive.db3", "drive.bag"):
        (tmp_path / name).write_text(pointer)
        with pytest.raises(DataError, match=f"{name} cannot be read: a Git LFS pointer.*git lfs pull"):
            open_dataset(f"bag:{tmp_path / name}")
    (tmp_path / "ride.mp4").write_text(pointer)
    assert any("ride.mp4 cannot be read: a Git LFS" in f.what for f in inspect(str(tmp_path / "ride.mp4")).findings)
    for image in (mav0 / "cam0" / "data").iterdir():
        image.write_text(pointer)
    assert any("Git LFS pointer" in f.what for f in inspect(str(mav0)).findings)
    for name in ("imu0/data.csv", "cam0/sensor.yaml"):
        kept = (mav0 / name).read_text()
        (mav0 / name).write_text(pointer)
        assert any(f"{name} cannot be read: a Git LFS" in f.what for f in inspect(str(mav0)).findings)
        (mav0 / name).write_text(kept)


def test_a_folder_is_opened_through_a_link(tmp_path: Path) -> None:
    mav0 = write_asl(tmp_path / "there", stereo=False)
    (tmp_path / "link").symlink_to(mav0.parent)
    (tmp_path / "mav0").mkdir()
    for part in ("cam0", "imu0"):
        (tmp_path / "mav0" / part).symlink_to(mav0 / part)
    for path in (tmp_path / "link", tmp_path):
        assert len(list(open_dataset(str(path)).events())) == len(list(open_dataset(str(mav0)).events())) > 6
