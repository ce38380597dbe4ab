"""A run in the map of another, whose images go dark: where it is in that map, with and without asking depth.

    .venv/bin/python experiments/depth_in_map.py
    .venv/bin/python experiments/depth_in_map.py --source tum:FOLDER --split 10 --until 20 --dark-after 1

A recording is split in time: seconds 0 to `--split` make the map, the rest (up to `--until`) is run in it, with images
made black from `--dark-after` seconds after it was found there. Errors are of causal poses in the map's frame, which is
laid on the truth by the first run: rms over the dark frames, and at the end. `edges` are loops by depth into the
map that the graph believes at the end, of those that were offered; `off` is by how much all offered differ from the
truth (median, worst), `false` those by more than 10 cm or 5 deg, `NEES` the mean of e' P^-1 e, six when the covariance
is right. With `--start` all images are negatives, which odometry follows and no image of the map is like, and a pose is
given: the true one, `--off` metres and degrees off. Far off, nothing must be found.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import numpy as np  # noqa: E402

from vislam.config import Config, load  # noqa: E402
from vislam.core.geometry import align_points, invert, quaternion_xyzw_from_rotation, se3_exp, se3_log  # noqa: E402
from vislam.core.imu_noise import ImuNoise  # noqa: E402
from vislam.core.messages import Array, Frame, ImuSample, Localisation, LoopDecision, LoopEdge, MagSample  # noqa: E402
from vislam.core.recording import Recording, WrappedRecording  # noqa: E402
from vislam.pipeline.settings import derived  # noqa: E402
from vislam.pipeline.steps import Step  # noqa: E402
from vislam.runs import execute, imu_noise, map_of  # noqa: E402
from vislam.runs.session import Session  # noqa: E402
from vislam.runs.sources import open_source  # noqa: E402
from vislam.slam import Slam  # noqa: E402
from vislam.trajectory import Trajectory, read_tum  # noqa: E402

SOURCES = ("sim:handheld-room,camera_hz=15,image_width_px=480",)
BLACK = 8  # grey level


class Part(WrappedRecording):
    """A stretch of a recording, in seconds after its first frame."""

    def __init__(self, recording: Recording, begin_s: float, end_s: float, with_imu: bool) -> None:
        """Take the stretch, and inertial data only if they are wanted."""
        super().__init__(recording)
        first = next(v.t_ns for v in recording.events() if isinstance(v, Frame))
        self._span = first + round(begin_s * 1e9), first + round(end_s * 1e9)
        self._with_imu = with_imu
        self.frame_count = sum(isinstance(value, Frame) for value in self.events())

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Yield its values."""
        for value in self._recording.events(from_ns):
            if self._span[0] <= value.t_ns < self._span[1] and (self._with_imu or isinstance(value, Frame)):
                yield value


def darkened(frame: Frame) -> Frame:
    """Return a frame with black images and its depth."""
    color = None if frame.color is None else np.full_like(frame.color, BLACK)
    return replace(frame, images=tuple(np.full_like(image, BLACK) for image in frame.images), color=color)


def negative(frame: Frame) -> Frame:
    """Return a frame whose images are negatives."""
    color = None if frame.color is None else 255 - frame.color
    return replace(frame, images=tuple(255 - image for image in frame.images), color=color)


def truth_in_map(old: Path, truth: Trajectory) -> Array:
    """Return T_map_truth [4, 4], by the final positions of the run that made the map."""
    path = read_tum(old / "trajectory_graph.tum")
    inside = (path.t_ns >= truth.t_ns[0]) & (path.t_ns <= truth.t_ns[-1])
    return align_points(truth.at(path.t_ns[inside])[:, :3, 3], path.positions_m[inside])


@dataclass
class Seen:
    """What a run in a map left."""

    errors: list[tuple[float, float, float]] = field(default_factory=list)  # in the dark: seconds, metres, degrees
    edges: dict[int, LoopEdge] = field(default_factory=dict)  # by depth, that were offered to the graph
    asked: int = 0
    stamps: dict[int, int] = field(default_factory=dict)  # of keyframes

    def take(self, step: Step) -> None:
        """Take what came of keyframes."""
        for keyframe in step.keyframes:
            new = keyframe.odometry.packet.keyframe
            self.stamps[new.id] = new.t_ns
            pairs = {(c.from_id, c.to_id) for c in keyframe.candidates if c.source == "depth"}
            self.asked += len(pairs)
            self.edges.update({e.id: e for e in keyframe.edges if (e.from_id, e.to_id) in pairs})


def run(old: Path, part: Part, settings: Config, noise: ImuNoise | None, dark_after_s: float | None) -> str:
    """Run a stretch in a map and return a row of the table; negative from the begin where `dark_after_s` is None."""
    truth, config = part.truth(), derived(settings, part.rig, noise)
    assert truth is not None
    session = Session(old / "session.db")
    T_map_truth = truth_in_map(old, truth)
    memory = map_of(session, part, config, noise)
    seen = Seen(stamps={k.id: k.t_ns for k in session.keyframes()})
    session.close()
    slam = Slam(config, part.rig, noise)
    slam.begin_in_map(memory)
    dark_from: int | None = 0 if dark_after_s is None else None
    is_found = False
    for value in part.events():
        is_dark = isinstance(value, Frame) and dark_from is not None and value.t_ns >= dark_from
        change = negative if dark_after_s is None else darkened
        for step in slam.feed(change(value) if is_dark and isinstance(value, Frame) else value):
            seen.take(step)
            t_ns = step.front.frame.t_ns
            if step.localisation is Localisation.RELOCALISED and not is_found:
                is_found = True
                dark_from = t_ns + round((dark_after_s or 0.0) * 1e9) if dark_from is None else dark_from
            if is_found and dark_from is not None and t_ns >= dark_from and step.T_map_body is not None:
                xi = se3_log(invert(step.T_map_body) @ T_map_truth @ truth.at(np.array([t_ns]))[0])
                rad, m = np.linalg.norm(xi.reshape(2, 3), axis=1)
                seen.errors.append((t_ns * 1e-9, float(m), float(np.rad2deg(rad))))
    slam.finish()
    assert slam.back is not None
    reports = slam.back.graph.edge_reports()
    believed = [r.loop_id for r in reports if r.loop_id in seen.edges and r.decision is LoopDecision.ACCEPTED]
    return row(seen, len(believed), truth)


def row(seen: Seen, believed: int, truth: Trajectory) -> str:
    """Return the columns of the table."""
    offered = list(seen.edges.values())
    edges = f"{believed} of {len(offered)}, asked {seen.asked} times"
    if offered:
        xi = []
        for edge in offered:
            a, b = truth.at(np.array([seen.stamps[edge.from_id], seen.stamps[edge.to_id]]))
            xi.append(se3_log(invert(edge.T_from_to) @ invert(a) @ b))
        nees = np.mean([x @ np.linalg.solve(e.covariance, x) for x, e in zip(xi, offered, strict=True)])
        rad, m = np.linalg.norm(np.array(xi).reshape(-1, 2, 3), axis=2).T
        cm, deg = 100.0 * m, np.rad2deg(rad)
        false = int(((cm > 10.0) | (deg > 5.0)).sum())
        off = f"{np.median(cm):.1f}, {cm.max():.1f} cm; {np.median(deg):.2f}, {deg.max():.2f}°"
        edges += f" | {off} | {false} | {nees:.1f}"
    else:
        edges += " | | | "
    if not seen.errors:
        return f"not found | | | | {edges} |"
    t_s, off_m, off_deg = np.array(seen.errors).T
    rms_m, rms_deg = (float(np.sqrt(np.mean(e**2))) for e in (off_m, off_deg))
    return (
        f"{t_s[-1] - t_s[0]:.1f} s | {100.0 * rms_m:.1f} cm, {rms_deg:.2f}° | {100.0 * off_m.max():.1f} cm | "
        f"{100.0 * off_m[-1]:.1f} cm, {off_deg[-1]:.2f}° | {edges} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", nargs="+", default=SOURCES)
    parser.add_argument("--split", type=float, default=10.0, help="seconds that make the map")
    parser.add_argument("--until", type=float, default=20.0, help="seconds at which the run in it ends")
    parser.add_argument("--dark-after", type=float, default=1.0, help="seconds after the run was found in the map")
    parser.add_argument("--imu", action="store_true", help="with the recording's inertial data")
    parser.add_argument("--start", action="store_true", help="dark from the begin, with a pose that is given")
    parser.add_argument("--off", nargs=2, type=float, default=(0.2, 10.0), help="metres and degrees")
    parser.add_argument("--old", type=Path, help="folder for the map; it is made where it is not there")
    args = parser.parse_args()
    print("| recording | by depth | dark | rms | worst | at the end | edges | off (median, worst) | false | NEES |")
    print("|---|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for source in args.source:
        recording = open_source(source)
        with tempfile.TemporaryDirectory() as folder:
            old = Path(folder) / "old" if args.old is None else args.old
            settings = load(None, {"view.enabled": False, "imu.enabled": args.imu, "frontend.mode": "rgbd"})
            if not (old / "session.db").is_file():
                old.mkdir(parents=True, exist_ok=True)
                execute(Part(recording, 0.0, args.split, args.imu), settings, old, source, [])
            part = Part(recording, args.split, args.until, args.imu)
            noise = imu_noise(settings.imu, recording.imu_noise)
            settings = replace(settings, map=replace(settings.map, enabled=False))
            for asks in (True, False):
                loop = replace(settings.loop, depth_in_map=asks)
                if args.start:
                    loop = replace(loop, start_in_map=start(old, part, *args.off))
                columns = run(old, part, replace(settings, loop=loop), noise, None if args.start else args.dark_after)
                print(f"| {source} | {'yes' if asks else 'no'} | {columns}", flush=True)


def start(old: Path, part: Part, off_m: float, off_deg: float) -> str:
    """Return the true pose at the begin of a stretch, so far off, as `--loop.start-in-map` takes it."""
    truth = part.truth()
    assert truth is not None
    first = next(value.t_ns for value in part.events() if isinstance(value, Frame))
    off = se3_exp(np.array([0.0, np.deg2rad(off_deg), 0.0, 0.7 * off_m, 0.0, -0.7 * off_m]))
    T = truth_in_map(old, truth) @ truth.at(np.array([first]))[0] @ off
    return ",".join(f"{x:.9f}" for x in [*T[:3, 3], *quaternion_xyzw_from_rotation(T[:3, :3])])


if __name__ == "__main__":
    main()
