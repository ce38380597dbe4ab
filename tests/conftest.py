"""Fixtures every test may use."""

import ctypes
import gc
import os
import shutil
import signal
import sys
from contextlib import suppress
from functools import lru_cache

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is imported

os.environ.setdefault("VISLAM_COMPILING", "tests")  # each worker would compile ahead what the others do

from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import settings
from hypothesis.internal.conjecture import providers

from browser import FLAGS, PATIENCE_MS
from needs import missing
from vislam.config import CalibrationConfig
from vislam.sim.scene import Scene
from vislam.sim.worlds import simulation
from worlds.mini_recording import IMU_YAML
from worlds.shared import shared

TESTS = Path(__file__).resolve().parent
REPOSITORY = TESTS.parent
sys.path.append(str(REPOSITORY / "experiments"))  # for what is tested of them
QUICK = {line for line in (TESTS / "quick.txt").read_text(encoding="utf-8").splitlines() if not line.startswith("#")}
_LIBC = ctypes.CDLL(None)
_LEFT_OPEN = 16  # by libraries, once
_RARELY = 50_000  # new objects between two searches for garbage, as in the verbs
_M_MMAP_THRESHOLD, _MAPPED_BYTES = -3, 1 << 20

# Compilation makes first examples slow, and a build must not fail by chance: fixed examples, no deadline.
settings.register_profile("vislam", deadline=None, derandomize=True)
settings.load_profile("vislam")
providers.is_local_module_file = lambda _path: False  # or examples have constants of what the worker has imported

cv2.setNumThreads(1)  # as in deterministic replay

with suppress(AttributeError):  # of another libc; glibc would keep freed arrays of up to 32 MB for a next one
    _LIBC.mallopt(_M_MMAP_THRESHOLD, _MAPPED_BYTES)

for interrupt in (signal.SIGINT, signal.SIGHUP):  # in the background of a script they are ignored, and tests send them
    if signal.getsignal(interrupt) is signal.SIG_IGN:
        signal.signal(interrupt, signal.default_int_handler if interrupt == signal.SIGINT else signal.SIG_DFL)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out slow files before they are imported, where only quick tests are asked for."""
    if config.option.markexpr != "not slow" or collection_path.suffix != ".py":
        return None
    return collection_path.resolve().relative_to(TESTS).as_posix() not in QUICK or None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as slow what does not stand in `quick.txt`."""
    for item in items:
        if item.path.resolve().relative_to(TESTS).as_posix() not in QUICK:
            item.add_marker("slow")


class FailuresAtOnce:
    """Prints each failure when it is met, too: a run that is cut off has no summary."""

    def __init__(self, terminal: pytest.TerminalReporter) -> None:
        self._terminal = terminal

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Print what failed and why."""
        if report.failed:
            self._terminal.ensure_newline()
            self._terminal.write_line(f"FAILED {report.nodeid} ({report.when})\n{report.longreprtext}")


@pytest.hookimpl(trylast=True)  # after the reporter is there
def pytest_configure(config: pytest.Config) -> None:
    """Have failures printed at once by the process that prints."""
    if terminal := config.pluginmanager.get_plugin("terminalreporter"):
        config.pluginmanager.register(FailuresAtOnce(terminal))


def pytest_collection_finish() -> None:
    """Take what is imported by now out of Python's search for garbage, which would walk through all of it each time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(_RARELY)


@pytest.fixture
def noise(tmp_path: Path) -> CalibrationConfig:
    path = tmp_path / "noise.yaml"
    path.write_text(IMU_YAML)
    return CalibrationConfig(imu_noise=str(path))


@pytest.fixture(autouse=True, scope="session")
def painted_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Paint each simulated world once for all workers, and keep the newest: a file's tests open one again and again."""
    paint = simulation.painted

    @lru_cache(maxsize=1)
    def painted(build: Callable[..., Any], seed: int) -> Scene:
        if not build.__module__.startswith("vislam."):
            return paint(build, seed)

        def make(folder: Path) -> None:
            scene = paint(build, seed)
            for field in fields(Scene):
                np.save(folder / f"{field.name}.npy", getattr(scene, field.name))

        folder = shared(tmp_path_factory, f"painted-{build.__module__}-{build.__qualname__}-{seed}", make)
        return Scene(**{field.name: np.load(folder / f"{field.name}.npy") for field in fields(Scene)})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "painted", painted)
        yield


@pytest.fixture(autouse=True, scope="module")
def trimmed() -> Iterator[None]:
    """Give back to the system what the tests of a module have freed; they may not keep files and sockets open."""
    before = set(os.listdir("/proc/self/fd"))
    yield
    gc.collect()
    gc.freeze()  # or the next module walks through what this one has imported and compiled
    with suppress(AttributeError):
        _LIBC.malloc_trim(0)
    left = set(os.listdir("/proc/self/fd")) - before
    assert len(left) <= _LEFT_OPEN, f"the tests of this module leave {len(left)} descriptors open"


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real recordings; tests that need it are skipped where it is absent."""
    root = Path(os.environ.get("VISLAM_DATA", REPOSITORY.parent / "shared" / "data"))
    if not root.is_dir():
        missing(f"no recordings at {root}; set VISLAM_DATA to their folder")
    return root


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A Chromium that draws WebGL in software."""
    sync = pytest.importorskip("playwright.sync_api")
    path = shutil.which("chromium")
    if path is None:
        missing("chromium is not installed (Debian: apt install chromium)")
    with sync.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS, timeout=PATIENCE_MS)
        yield browser
        browser.close()
