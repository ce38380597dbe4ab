from collections.abc import Callable

import cv2
import pytest

from vislam.sim import Simulation, open_world

cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def painted() -> Callable[..., Simulation]:
    """What opens a world, whose scene is painted once for all tests."""
    return open_world
