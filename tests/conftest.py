"""Fixtures every test may use."""

import os
import signal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is imported

from pathlib import Path

import cv2
import pytest
from hypothesis import settings

from needs import missing

REPOSITORY = Path(__file__).resolve().parent.parent

# Compilation makes first examples slow, and a build must not fail by chance: fixed examples, no deadline.
settings.register_profile("vislam", deadline=None, derandomize=True)
settings.load_profile("vislam")

cv2.setNumThreads(1)  # as in deterministic replay

for interrupt in (signal.SIGINT, signal.SIGHUP):  # in the background of a script they are ignored, and tests send them
    if signal.getsignal(interrupt) is signal.SIG_IGN:
        signal.signal(interrupt, signal.default_int_handler if interrupt == signal.SIGINT else signal.SIG_DFL)


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real recordings; tests that need it are skipped where it is absent."""
    root = Path(os.environ.get("VISLAM_DATA", REPOSITORY.parent / "shared" / "data"))
    if not root.is_dir():
        missing(f"no recordings at {root}; set VISLAM_DATA to their folder")
    return root
