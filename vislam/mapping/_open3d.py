"""Importing Open3D where the system has no libusb: the wheel libusb-package carries the library."""

import ctypes
import importlib
from typing import Any

from vislam.core.errors import install_line


def load_open3d() -> tuple[Any, str]:
    """Return the open3d module and an empty string, or None and the reason why it cannot be used."""
    try:
        return _quiet(importlib.import_module("open3d")), ""
    except ImportError as error:
        if "libusb" not in str(error):
            return None, f"open3d is not usable ({error}); {install_line('map')}"
    except OSError as error:
        if "libusb" not in str(error):
            return None, f"open3d is not usable ({error})"
    return _load_with_own_libusb()


def _load_with_own_libusb() -> tuple[Any, str]:
    """Load libusb globally from its wheel: its SONAME is the one that open3d's library asks the linker for."""
    try:
        libusb_package = importlib.import_module("libusb_package")
        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        return _quiet(importlib.import_module("open3d")), ""
    except (ImportError, OSError) as error:
        return None, f"open3d needs libusb-1.0 ({error}); pip install libusb-package"


def _quiet(open3d: Any) -> Any:
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d
