"""A run in the map of another, whose images go dark: where it is in that map, with and without asking depth.

    .venv/bin/python experiments/depth_in_map.py
    .venv/bin/python experiments/depth_in_map.py --source tum:FOLDER --split 10 --until 20 --dark-after 1

A recording is split in time: seconds 0 to `--split` make the map, the rest (up to `--until`) is run in it, with images
made black from `--dark-after` seconds after it was found there. Errors are of causal poses in the map's frame, which is
laid on the truth by the map's keyframes: rms over the dark frames, and at the end. `edges` are loops by depth into the
map that the graph believes at the end, of those that were offered; `off` is by how much they differ from the truth
(median, worst), `false` those by more than 10 cm or 5 deg, `NEES` the mean of e' P^-1 e, six when the covariance is
right. With `--start` no image is seen at all: the true pose at the begin, 0.2 m and 10 deg off, is given instead.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import numpy as np  # noqa: E402

from vislam.config import Config, load  # noqa: E402
from vislam.core.geometry import align_points, invert, se3_exp, se3_log  # noqa: E402
from vislam.core.imu_noise import ImuNoise  # noqa: E402
from vislam.core.messages import Array, Frame, ImuSample, Localisation, LoopEdge, MagSample  # noqa: E402
from vislam.core.recording import Recording, WrappedRecording  # noqa: E402
from vislam.pipeline.settings import derived  # noqa: E402
from vislam.run import execute, imu_noise, map_of  # noqa: E402
from vislam.run.session import Session  # noqa: E402
from vislam.run.sources import open_source  # noqa: E402
from vislam.slam import Slam  # noqa: E402
from vislam.trajectory import Trajectory  # noqa: E402

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


def truth_in_map(session: Session, truth: Trajectory) -> Array:
    """Return T_map_truth [4, 4], by the positions of the map's keyframes."""
    stored = list(session.keyframes())
    T = truth.at(np.array([k.t_ns for k in stored]))
    return align_points(T[:, :3, 3], np.array([k.T_map_body[:3, 3] for k in stored]))


def run(old: Path, part: Part, settings: Config, noise: ImuNoise | None, dark_after_s: float | None) -> str:
    """Run a stretch in a map and return a row of the table; dark from the begin where `dark_after_s` is None."""
    truth = part.truth()
    assert truth is not None
    config = derived(settings, part.rig, noise)
    session = Session(old / "session.db")
    T_map_truth = truth_in_map(session, truth)
    memory = map_of(session, part, config, noise)
    stamps = {k.id: k.t_ns for k in session.keyframes()}
    session.close()
    first_id = len(stamps)
    slam = Slam(config, part.rig, noise)
    slam.begin_in_map(memory)
    edges: dict[int, LoopEdge] = {}
    dark_from: int | None = 0 if dark_after_s is None else None
    found_t_ns, errors, asked = None, [], []
    reasons: dict[str, int] = {}
    for value in part.events():
        if isinstance(value, Frame) and dark_from is not None and value.t_ns >= dark_from:
            value = darkened(value)
        for step in slam.feed(value):
            t_ns = step.front.frame.t_ns
            if step.localisation is Localisation.RELOCALISED and found_t_ns is None:
                found_t_ns = t_ns
                dark_from = t_ns + round((dark_after_s or 0.0) * 1e9) if dark_from is None else dark_from
            if found_t_ns is not None and dark_from is not None and t_ns >= dark_from and step.T_map_body is not None:
                error = se3_log(invert(step.T_map_body) @ T_map_truth @ truth.at(np.array([t_ns]))[0])
                errors.append([t_ns * 1e-9, np.linalg.norm(error[3:]), np.rad2deg(np.linalg.norm(error[:3]))])
            for keyframe in step.keyframes:
                k = keyframe.odometry.packet.keyframe
                stamps[k.id] = k.t_ns
                of_depth = [c for c in keyframe.candidates if c.source == "depth"]
                asked += of_depth
                for c in of_depth:
                    words = "".join(x for x in c.reason.split(",")[0] if not x.isdigit())
                    reasons[words] = reasons.get(words, 0) + 1
                pairs = {(c.from_id, c.to_id) for c in of_depth}
                edges.update({e.id: e for e in keyframe.edges if (e.from_id, e.to_id) in pairs})
    slam.finish()
    assert slam.back is not None
    believed = [r.loop_id for r in slam.back.graph.edge_reports() if r.loop_id in edges and r.decision == "accepted"]
    off, nees = [], []
    for i in believed:
        e = edges[i]
        a, b = truth.at(np.array([stamps[e.from_id], stamps[e.to_id]]))
        xi = se3_log(invert(e.T_from_to) @ invert(a) @ b)
        off.append([np.linalg.norm(xi[3:]), np.rad2deg(np.linalg.norm(xi[:3]))])
        nees.append(float(xi @ np.linalg.solve(e.covariance, xi)))
    E, O = np.array(errors).reshape(-1, 3), np.array(off).reshape(-1, 2)
    false = int(((O[:, 0] > 0.1) | (O[:, 1] > 5.0)).sum())
    print(f"  reasons {reasons}; counters {slam.back.counters.get('depth in map')}; "
          f"{len([k for k in stamps if k >= first_id])} keyframes; timing {slam.clock.summary_ms().get('depth in map')}",
          file=sys.stderr)  # fmt: skip
    if not len(E):
        return "not found |  |  |  |  |  |  |  |"
    lasted = E[-1, 0] - E[0, 0]
    rms = np.sqrt(np.mean(E[:, 1:] ** 2, axis=0))
    edge = f"{len(believed)} of {len(edges)}"
    if off:
        edge += f" | {100 * np.median(O[:, 0]):.1f}, {100 * O[:, 0].max():.1f} cm; {np.median(O[:, 1]):.2f}, "
        edge += f"{O[:, 1].max():.2f}° | {false} | {np.mean(nees):.1f}"
    else:
        edge += " |  |  | "
    return (
        f"{lasted:.1f} s | {100 * rms[0]:.1f} cm, {rms[1]:.2f}° | {100 * E[:, 1].max():.1f} cm | "
        f"{100 * E[-1, 1]:.1f} cm, {E[-1, 2]:.2f}° | {edge} |"
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
                    loop = replace(loop, start_in_map=start(old, part))
                row = run(old, part, replace(settings, loop=loop), noise, None if args.start else args.dark_after)
                print(f"| {source} | {'yes' if asks else 'no'} | {row}", flush=True)


def start(old: Path, part: Part) -> str:
    """Return the true pose at the begin of a stretch, 0.2 m and 10 deg off, as `--loop.start-in-map` takes it."""
    from vislam.core.geometry import quaternion_xyzw_from_rotation

    truth, session = part.truth(), Session(old / "session.db")
    assert truth is not None
    first = next(value.t_ns for value in part.events() if isinstance(value, Frame))
    off = se3_exp(np.array([0.0, np.deg2rad(10.0), 0.0, 0.14, 0.0, -0.14]))
    T = truth_in_map(session, truth) @ truth.at(np.array([first]))[0] @ off
    session.close()
    return ",".join(f"{x:.9f}" for x in [*T[:3, 3], *quaternion_xyzw_from_rotation(T[:3, :3])])


if __name__ == "__main__":
    main()
