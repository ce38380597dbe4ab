"""Compiled kernels where neither the package nor the home can be written, each in a fresh process."""

import ctypes
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from needs import missing

VISLAM = Path(__file__).resolve().parents[2] / "vislam"
_DROP_FROM_BOUNDS, _WRITES_ANYWHERE = 24, 1  # PR_CAPBSET_DROP, CAP_DAC_OVERRIDE
_KERNEL = """
from numba.core import event
import vislam, os
with event.install_recorder("numba:compile") as compiled:
    from vislam.core.small import cross
    cross((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
print(len(compiled.buffer), os.environ.get("NUMBA_CACHE_DIR"))
"""


class Place:
    """A copy of the package, a home and a folder for temporary files."""

    def __init__(self, root: Path) -> None:
        self.package, self.home, self.temporary = root / "lib" / "vislam", root / "home", root / "tmp"
        shutil.copytree(VISLAM / "core", self.package / "core", ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(VISLAM / "__init__.py", self.package)
        self.home.mkdir()
        self.temporary.mkdir()

    @property
    def private(self) -> Path:
        return self.temporary / f"vislam-{os.geteuid()}"

    def freeze(self) -> None:
        """Take away the right to write the package and the home."""
        for folder in (self.home, self.package, *(p for p in self.package.rglob("*") if p.is_dir())):
            folder.chmod(0o555)

    def run(self, code: str, **more: str) -> tuple[list[str], str]:
        """Run code on the copy; return the words on stdout, and stderr."""
        environment = {"HOME": str(self.home), "TMPDIR": str(self.temporary), "PATH": os.environ["PATH"], **more}
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=self.temporary,
            env=environment | {"PYTHONPATH": str(self.package.parent)}, preexec_fn=_obey_modes,
        )  # fmt: skip
        return done.stdout.split(), done.stderr

    def chooses(self, **more: str) -> tuple[str, str]:
        """Return where numba is told to keep kernels, and stderr; none is compiled."""
        (folder,), said = self.run("import os, vislam; print(os.environ.get('NUMBA_CACHE_DIR'))", **more)
        return folder, said

    def compiles(self, **more: str) -> tuple[bool, str, str]:
        """Call a kernel; return whether it was compiled, where numba was told to keep it, and stderr."""
        (compiled, folder), said = self.run(_KERNEL, **more)
        return int(compiled) > 0, folder, said


def _obey_modes() -> None:
    """Root may write whatever a file's mode says; after this what it starts may not."""
    if os.geteuid() == 0 and ctypes.CDLL(None).prctl(_DROP_FROM_BOUNDS, _WRITES_ANYWHERE, 0, 0, 0) != 0:
        raise OSError("prctl")


@pytest.fixture
def place(tmp_path: Path) -> Place:
    found = Place(tmp_path)
    try:
        subprocess.run(["true"], check=True, preexec_fn=_obey_modes)
    except subprocess.SubprocessError:
        missing("root that may not give up the right to write anywhere")
    return found


def test_a_private_folder_serves_where_nothing_can_be_written(place: Place) -> None:
    place.freeze()
    compiled, folder, said = place.compiles()
    assert compiled
    assert folder == str(place.private)
    assert said.count("RuntimeWarning") == 1
    assert folder in said
    status = place.private.stat()
    assert (stat.S_IMODE(status.st_mode), status.st_uid) == (0o700, os.geteuid())
    compiled, folder, _ = place.compiles()
    assert folder == str(place.private)
    assert not compiled  # the second time it is there


def test_what_a_process_starts_uses_the_same_folder_without_a_word(place: Place) -> None:
    place.freeze()
    child = "import vislam, os; print(os.environ['NUMBA_CACHE_DIR'])"
    said_by_numba = "import numba, vislam; print(numba.config.CACHE_DIR, flush=True)"  # which was imported before
    folders, said = place.run(
        f"{said_by_numba}; import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    )
    assert folders == [str(place.private)] * 2
    assert said.count("RuntimeWarning") == 1


def test_a_folder_that_others_can_write_is_never_used(place: Place) -> None:
    place.freeze()
    place.private.mkdir()
    place.private.chmod(0o770)
    _, folder, _ = place.compiles()
    assert folder != str(place.private)
    assert list(place.private.iterdir()) == []
    assert not Path(folder).exists()  # of this process alone


def test_a_link_in_the_folders_place_is_not_followed(place: Place) -> None:
    place.freeze()
    elsewhere = place.temporary / "elsewhere"
    elsewhere.mkdir(0o700)
    place.private.symlink_to(elsewhere)
    assert place.chooses()[0] != str(place.private)
    assert list(elsewhere.iterdir()) == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder away")
def test_a_folder_of_another_user_is_not_used(place: Place) -> None:
    place.freeze()
    place.private.mkdir(0o700)
    os.chown(place.private, 12345, 12345)
    assert place.chooses()[0] != str(place.private)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder away")
def test_a_home_of_another_user_is_no_place_for_pickles(place: Place) -> None:
    place.freeze()
    place.home.chmod(0o777)
    os.chown(place.home, 12345, 12345)
    assert place.chooses()[0] == str(place.private)


def test_numba_chooses_where_the_home_can_be_written(place: Place) -> None:
    place.freeze()
    place.home.chmod(0o755)
    assert place.compiles()[1:] == ("None", "")
    assert list((place.home / ".cache" / "numba").rglob("*.nbc"))


def test_numba_chooses_where_the_package_can_be_written(place: Place) -> None:
    place.home.chmod(0o555)
    assert place.compiles()[1:] == ("None", "")
    assert list(place.package.rglob("*.nbc"))


def test_a_folder_set_by_hand_is_kept_if_it_can_be_written(place: Place) -> None:
    place.freeze()
    chosen = place.temporary / "chosen"
    assert place.chooses(NUMBA_CACHE_DIR=str(chosen)) == (str(chosen), "")
    chosen.mkdir(exist_ok=True)
    chosen.chmod(0o555)
    assert place.chooses(NUMBA_CACHE_DIR=str(chosen / "below"))[0] == str(place.private)


def test_what_is_compiled_beside_a_read_only_source_is_not_compiled_again(place: Place) -> None:
    assert place.compiles()[0]
    place.freeze()
    compiled, folder, _ = place.compiles()
    assert not compiled
    assert folder == str(place.private)


def test_without_any_folder_it_says_what_to_do(place: Place) -> None:
    place.freeze()
    code = (
        "import os, vislam.core.kernel_cache as k\nk._names_stay = lambda place: False\n"
        "del os.environ['NUMBA_CACHE_DIR']\nk.choose_kernel_cache()\nprint('NUMBA_CACHE_DIR' in os.environ)"
    )
    words, said = place.run(code)
    assert words == ["False"]
    assert "nor any folder" in said
