"""Where compiled kernels are kept: where numba keeps them by itself, or a private folder where it can write nowhere.

By itself numba writes beside the source, or under the home, or refuses to import a kernel. What it keeps are pickles,
and loading one runs what is in it: so a folder that another user could have written is never used.
"""

import os
import stat
import sys
import warnings
from contextlib import suppress
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent.parent
_PRIVATE = 0o700
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def choose_kernel_cache() -> None:
    """Point numba at a private folder where neither the package nor the home can be written; warn of it once.

    It must run before a kernel is imported. Processes that this one starts use the same folder.
    """
    if _set_by_hand() or _home_is_ours() or _package_is_writable():
        return
    folder = private_folder()
    if folder is None:
        _warn("nor any folder for temporary files; set NUMBA_CACHE_DIR to a folder of yours that can be written")
        return
    _link_compiled(folder)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))  # it looks for a home, too, and warns
    if "numba" in sys.modules:  # it has read the environment
        from numba.core import config

        config.CACHE_DIR = str(folder)
    _warn(f"so compiled code is kept in {folder}; set NUMBA_CACHE_DIR to a folder that lasts")


def private_folder() -> Path | None:
    """Return a folder for temporary files that this user alone can read and write, the same each time if possible.

    None where there is no place for one.
    """
    import tempfile

    places = [Path("/dev/shm")]
    with suppress(OSError):
        places.insert(0, Path(tempfile.gettempdir()))
    for place in places:
        if not _names_stay(place):
            continue
        with suppress(OSError):
            folder = place / f"vislam-{os.geteuid()}"
            with suppress(FileExistsError):
                folder.mkdir(_PRIVATE)
            if _is_private(folder):
                return folder
            return _passing_folder(place)
    return None


def _passing_folder(place: Path) -> Path:
    """Make a private folder of a new name for this process: another user has that of ours."""
    import atexit
    import shutil
    import tempfile

    folder = Path(tempfile.mkdtemp(prefix=f"vislam-{os.geteuid()}-", dir=place))
    maker = os.getpid()

    def remove() -> None:
        if os.getpid() == maker:
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder


def _is_private(folder: Path) -> bool:
    """A folder of ours, no link, that no other user can enter, and in which we can write."""
    status = folder.lstat()
    ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid()
    return ours and stat.S_IMODE(status.st_mode) == _PRIVATE and os.access(folder, os.W_OK | os.X_OK)


def _names_stay(place: Path) -> bool:
    """Whether no other user can put another folder in the place of one of ours there."""
    try:
        status = place.stat()
    except OSError:
        return False
    if status.st_uid not in (0, os.geteuid()):
        return False
    return not status.st_mode & _OTHERS_WRITE or bool(status.st_mode & stat.S_ISVTX)


def _set_by_hand() -> bool:
    named = os.environ.get("NUMBA_CACHE_DIR", "")
    return named != "" and _can_write(Path(named).absolute())


def _home_is_ours() -> bool:
    """Whether numba's folder under the home can be written by us, and belongs to us: under sudo it can be another's."""
    cache = os.getenv("XDG_CACHE_HOME", os.path.expanduser("~/.cache"))  # as numba finds it
    if not os.path.isabs(cache):  # there is no home: numba would make a folder '~' wherever it is started
        return False
    folder = _nearest(Path(cache, "numba"))
    return folder.stat().st_uid == os.geteuid() and _can_write(folder)


def _package_is_writable() -> bool:
    """Whether numba can write beside each file of the package."""
    return all(_can_write(Path(root, "__pycache__")) for root, _, _ in os.walk(_PACKAGE) if "__pycache__" not in root)


def _can_write(folder: Path) -> bool:
    """Whether files can be made in a folder that is there or can be made."""
    nearest = _nearest(folder)
    return nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK, effective_ids=True)


def _nearest(folder: Path) -> Path:
    """Return the folder or, where it is missing, the nearest above it that is there."""
    return next(f for f in (folder, *folder.parents) if os.path.exists(f))  # Path.exists raises where it may not look


def _link_compiled(folder: Path) -> None:
    """Link what was compiled beside the source into the folder: an image that brings it need not compile again.

    It is trusted like the source beside it. numba replaces links where it compiles something new, and follows none.
    """
    from hashlib import sha1

    for compiled in _PACKAGE.rglob("__pycache__/*.nb[ci]"):
        source = compiled.parent.parent
        ours = folder / f"{source.name}_{sha1(str(source).encode()).hexdigest()}"  # as numba names it
        with suppress(OSError):
            ours.mkdir(exist_ok=True)
            (ours / compiled.name).symlink_to(compiled)


def _warn(what: str) -> None:
    text = f"neither vislam's folder {_PACKAGE} nor the home can be written, {what}"
    warnings.warn(text, RuntimeWarning, stacklevel=3)
