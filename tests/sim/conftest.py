import cv2
import pytest

from vislam.sim import Simulation, open_world

cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def painted():
    """Return a function that opens a world whose scene is painted only once per session."""
    scenes = {}

    def open_painted(name: str, **options: object) -> Simulation:
        simulation = open_world(name, **options)
        if name not in scenes:
            scenes[name] = simulation.scene
        simulation.__dict__["scene"] = scenes[name]
        return simulation

    return open_painted
