"""What the files of a map are called, for those who list or remove them and load nothing that makes them."""

from dataclasses import dataclass

VOXELS_NAME, CLASSES_NAME = "labels.ply", "labels.json"
FILES = {
    "cloud": "cloud.ply", "pcd": "cloud.pcd", "octomap": "octomap.bt", "ot": "octomap.ot",
    "grid": "grid.pgm", "drive": "drive.pgm",
    "mesh": "mesh.ply", "glb": "mesh.glb", "obj": "mesh.obj", "poisson": "poisson.ply", "surfels": "surfels.ply",
    "splats": "splats.ply",
    "labels": VOXELS_NAME,
}  # fmt: skip

SURFACES = ("mesh", "glb", "obj", "poisson", "surfels", "splats")  # what a doubled wall spoils
NEEDS_UP = ("grid", "drive")  # what means nothing in a map that is not level


@dataclass(frozen=True, slots=True)
class NotLevel:
    """Why z is not known to be up: in the map, and in submaps that are not joined with it; None where it is."""

    map: str | None
    submaps: str | None


LEVEL = NotLevel(None, None)  # z is up everywhere
