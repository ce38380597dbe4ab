"""`vislam export`: the results of a run for other programs."""

from dataclasses import dataclass, replace
from pathlib import Path

from tyro.conf import Positional

from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.terminal import progress_bar
from vislam.core.errors import DataError, UsageError, printable


@dataclass(frozen=True)
class ExportOptions:
    """Options of `vislam export`."""

    run: Positional[Path]
    """Run folder"""
    mcap: Path | None = None
    """New file, NAME.mcap: poses, odometry, path, cloud, grids and tf as ROS 2 messages; needs the extra 'bags'"""
    colmap: Path | None = None
    """New folder: keyframes as images, cameras, poses and points in COLMAP's text format"""
    nerfstudio: Path | None = None
    """New folder: the same with transforms.json"""
    splats: Path | None = None
    """New file, NAME.ply: the surfaces of the map as Gaussians"""
    undistort: bool = False
    """Resample the images for pinhole cameras"""
    poses: str = "graph"
    """Of images and splats: the run's final ones, or NAME of a trajectory_NAME.tum, such as batch"""


OPTIONS = (ExportOptions,)


def main(arguments: list[str]) -> int:
    """Write the results of a run as each format that is asked for."""
    options = parse(ExportOptions, arguments, "export")
    if not any((options.mcap, options.colmap, options.nerfstudio, options.splats)):
        raise UsageError("nothing to write; give --mcap FILE, --colmap DIR, --nerfstudio DIR or --splats FILE")
    if options.mcap is not None:
        _mcap(options.run, options.mcap)
    if options.colmap is not None or options.nerfstudio is not None:
        _images(options)
    if options.splats is not None:
        _splats(options.run, options.splats, options.poses)
    return 0


def _mcap(run: Path, path: Path) -> None:
    from vislam.runs.offline.export_mcap import export_mcap

    exported = export_mcap(run, path)
    for topic, count in exported.messages.items():
        print(f"{topic}: {count}")
    for topic, reason in exported.left_out.items():
        print(f"left out {topic}: {printable(reason)}")
    print(exported.path)


def _images(options: ExportOptions) -> None:
    from vislam.runs.offline.export_images import export_images

    with progress_bar("export", "images") as bar:
        exported = export_images(options.run, options.colmap, options.nerfstudio, options.poses, options.undistort, bar)
    print(
        f"{exported.images} images, {exported.points} points seen {exported.observations} times, "
        f"{exported.mean_error_px:.3f} px apart in the mean"
    )
    if exported.apart:
        print(f"left out {exported.apart} keyframes in parts of the map that no loop has joined")
    for folder in exported.folders:
        print(folder)


def _splats(run: Path, path: Path, poses: str) -> None:
    from vislam.core.files import partial_folder
    from vislam.runs.offline.rebuild import map_settings, rebuild

    if path.exists():
        raise UsageError(f"--splats {path} exists; choose another name, or remove it")
    settings = replace(map_settings(run).map, products=("splats",))
    with progress_bar("map", "steps") as bar, partial_folder(path) as folder:
        answer = rebuild(run, settings, folder, poses, bar)
        if "splats" not in answer["written"]:
            raise DataError(f"{run}: no splats: {answer['left_out']['splats']}")
        Path(answer["written"]["splats"]).replace(path)
    print(path)
