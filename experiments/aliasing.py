"""Where does a loss of sight end in places that look alike? Corridors of equal panels, and what joins their submaps.

    python experiments/aliasing.py [--worlds panels-2.0 ...] [--rig rgbd] [--losses 4] [--seed 0]

Each of the walls repeats one piece of itself every half to three metres, to the pixel. A walk goes along, sight is lost
for 0.3 to 3 s at random places, and what is seen after it fits as well one period further. A join is false where it
puts the two sides of a loss apart by more than a third of a period (0.15 m at least) against the truth. A loss can be
decided where the period is more than six sigmas of the tie across it: further away than that nothing is to be missed.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vislam.config import load
from vislam.core.geometry import invert
from vislam.core.messages import Frame, ImuSample, MagSample, Submaps
from vislam.core.recording import Recording, WrappedRecording
from vislam.pipeline.dark import dark
from vislam.sim.motion.path import Travel, rounded_path, walk
from vislam.sim.motion.spline import BodySpline
from vislam.sim.scene import Painter, SceneBuilder, furniture, paint, signs
from vislam.sim.worlds.simulation import open_world
from vislam.sim.worlds.table import World
from vislam.slam import Slam

HALF_WIDTH_M, HEIGHT_M, SPEED_M_S = 1.15, 2.6, 1.0
WIDTH_PX = 320
SHORTEST_S, LONGEST_S = 0.3, 3.0
FIRST_S = 4.0  # before the first loss, and between two of them
_KINDS = {
    "panels": lambda: signs.carrying(paint.plaster((160.0, 185.0, 190.0)), [(0.1, 1.9, 0.35, 1.3, signs.poster())]),
    "doors": lambda: signs.carrying(paint.brick((95, 115, 165)), [(0.15, 2.08, 0.9, 2.08, signs.door((60, 90, 150)))]),
    "shelves": lambda: signs.carrying(paint.plain((90, 95, 100)), [(0.0, 1.9, 3.0, 1.7, signs.books())]),
    "windows": lambda: signs.carrying(paint.concrete(), [(0.2, 2.2, 0.6, 1.3, signs.window())]),
}
PERIODS = {
    "panels-0.5": 0.5, "panels-1.0": 1.0, "panels-2.0": 2.0, "doors-1.5": 1.5, "doors-2.5": 2.5, "shelves-1.2": 1.2,
    "shelves-3.0": 3.0, "windows-0.8": 0.8, "windows-2.0": 2.0,
}  # fmt: skip


def repeated(piece: Painter, period_m: float, seed: int) -> Painter:
    """Return a painter of one piece again and again, with the same pixels."""

    def pixels(_: np.random.Generator, height: int, width: int, ppm: float) -> np.ndarray:
        one = piece(np.random.default_rng(seed), height, round(period_m * ppm), ppm)
        return np.ascontiguousarray(np.tile(one, (1, width // one.shape[1] + 1, 1))[:, :width])

    return pixels


def corridor(name: str, length_m: float) -> World:
    """Return a world whose walls repeat but at the ends, which are far away."""
    period_m = PERIODS[name]

    def build(rng: np.random.Generator) -> SceneBuilder:
        scene = SceneBuilder(ambient=0.9)
        low, high, w = -4.0, length_m + 8.0, HALF_WIDTH_M
        texels = round(200.0 * period_m) / period_m  # a whole number of pixels to the period
        for left, right in (((low, w), (high, w)), ((high, -w), (low, -w))):
            piece = repeated(_KINDS[name.partition("-")[0]](), period_m, int(rng.integers(0, 2**31)))
            furniture.wall(scene, left, right, HEIGHT_M, piece, texels)
        floor = repeated(paint.tiles((135, 150, 160), period_m / 2.0, 0.12), period_m, int(rng.integers(0, 2**31)))
        furniture.floor(scene, (low, -w), (high, w), floor, texels)
        furniture.ceiling(scene, (low, -w), (high, w), HEIGHT_M, paint.plain((185, 190, 190)), 90.0)
        furniture.wall(scene, (high, w), (high, -w), HEIGHT_M, paint.plain((150, 150, 150)))
        return scene

    def motion(rng: np.random.Generator) -> BodySpline:
        path = rounded_path([(0.0, 0.0), (length_m / 2.0, 0.1), (length_m, 0.0)], 2.0)
        return walk(path, Travel(path.length_m, SPEED_M_S, 1.0, 2.0, 1.0), int(rng.integers(0, 2**31)))

    words = f"a corridor that repeats every {period_m} m"
    return World(words, build, motion, "rgbd", 10.0, (0.06, 0.02, 0.04), 0.0)


class Darkened(WrappedRecording):
    """A recording in which the camera sees nothing for some stretches of time, in seconds since the first frame."""

    def __init__(self, recording: Recording, losses_s: list[tuple[float, float]]) -> None:
        super().__init__(recording)
        self.losses_s = losses_s

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Yield the values, with dark images where sight is lost."""
        first_ns: int | None = None
        for value in self._recording.events(from_ns):
            if not isinstance(value, Frame):
                yield value
                continue
            first_ns = value.t_ns if first_ns is None else first_ns
            since_s = (value.t_ns - first_ns) * 1e-9
            yield dark(value, value.t_ns) if any(a <= since_s < b for a, b in self.losses_s) else value


@dataclass(frozen=True)
class Loss:
    """What became of one loss of sight."""

    world: str
    lasted_s: float
    sigma_m: float  # of the tie across it; NaN: sight came back without a new submap, or inertial data went on
    is_joined: bool
    off_m: float  # between the two sides, against the truth

    @property
    def tolerance_m(self) -> float:
        """How far off a join may be that is right."""
        return max(PERIODS[self.world] / 3.0, 0.15)

    @property
    def is_false(self) -> bool:
        """Whether it was joined, and wrongly."""
        return self.is_joined and self.off_m > self.tolerance_m

    @property
    def can_be_decided(self) -> bool:
        """Whether what is known of the motion across excludes the next period."""
        return PERIODS[self.world] > 6.0 * self.sigma_m


def losses_of(rng: np.random.Generator, duration_s: float, most: int) -> list[tuple[float, float]]:
    """Return stretches of time without sight, in order."""
    out, at = list[tuple[float, float]](), FIRST_S
    while len(out) < most:
        begin = at + float(rng.uniform(0.0, 1.5))
        end = begin + float(rng.uniform(SHORTEST_S, LONGEST_S))
        if end + FIRST_S > duration_s:
            break
        out.append((begin, end))
        at = end + FIRST_S
    return out


def run(name: str, rig: str, most: int, seed: int, length_m: float) -> list[Loss]:
    """Return what became of each loss in one world."""
    world = open_world(corridor(name, length_m), seed, rig=rig, image_width_px=WIDTH_PX, workers=2)
    recording = Darkened(world, losses_of(np.random.default_rng([seed, len(name)]), world.duration_s, most))
    config = load(
        None, {"map.enabled": False, "view.enabled": False, "frontend.mode": rig, "imu.enabled": rig == "mono"}
    )
    slam = Slam(config, recording.rig, recording.imu_noise if rig == "mono" else None)
    truth, sigmas, submaps = recording.truth(), dict[int, float](), Submaps()
    stamps = dict[int, int]()
    for value in recording.events():
        for step in slam.feed(value):
            for keyframe in step.keyframes:
                packet, submaps = keyframe.odometry.packet, keyframe.update.submaps
                stamps[packet.keyframe.id] = packet.keyframe.t_ns
                if packet.begins_submap and packet.vo.T_keyframe_body is not None:
                    sigmas[packet.keyframe.id] = float(np.sqrt(np.linalg.eigvalsh(packet.vo.covariance[3:, 3:])[-1]))
    slam.finish()
    assert slam.back is not None and truth is not None
    poses = dict(zip(slam.back.graph.ids.tolist(), slam.back.graph.poses(), strict=True))
    ids = np.array(sorted(stamps))
    first_ns, out = stamps[int(ids[0])], list[Loss]()
    for begin_s, end_s in recording.losses_s:
        since_s = np.array([(stamps[int(i)] - first_ns) * 1e-9 for i in ids])
        before, after = ids[since_s < begin_s], ids[since_s >= end_s]
        if not len(before) or not len(after):
            continue
        a, b = int(before[-1]), int(after[0])
        moved = invert(truth.at(stamps[a])) @ truth.at(stamps[b])
        off_m = float(np.linalg.norm((invert(invert(poses[a]) @ poses[b]) @ moved)[:3, 3]))
        out.append(Loss(name, end_s - begin_s, sigmas.get(b, float("nan")), submaps.are_joined(a, b), off_m))
    return out


def main() -> None:
    """Run what is asked for and print a line for each loss, and what all of them come to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", choices=PERIODS, default=list(PERIODS))
    parser.add_argument("--rig", choices=("rgbd", "stereo", "mono"), default="rgbd")
    parser.add_argument("--losses", type=int, default=4, help="in each world, at most")
    parser.add_argument("--length-m", type=float, default=24.0, help="of the walk")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="a JSON file for the losses")
    asked = parser.parse_args()
    print(f"seed {asked.seed}")
    losses = list[Loss]()
    for name in asked.worlds:
        for loss in run(name, asked.rig, asked.losses, asked.seed, asked.length_m):
            losses.append(loss)
            word = "FALSE" if loss.is_false else "joined" if loss.is_joined else "apart"
            print(
                f"{name:12} {loss.lasted_s:4.1f} s  tie {loss.sigma_m:5.2f} m  {word:6} off {loss.off_m:5.2f} m",
                flush=True,
            )
    decidable = [loss for loss in losses if loss.can_be_decided]
    joined = sum(loss.is_joined and not loss.is_false for loss in decidable)
    print(f"{len(losses)} losses, {sum(loss.is_false for loss in losses)} false joins; "
          f"{joined} of {len(decidable)} that can be decided are joined")  # fmt: skip
    if asked.out is not None:
        asked.out.write_text(json.dumps([vars(loss) for loss in losses], indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
