"""A hundred random starts of one camera with an IMU: how soon, how exact, what is refused, and is any of them wrong.

    python benchmarks/initialisation.py [starts per kind [KIND ...]]

Wrong is a scale off by more than 5 % and three of its stated sigmas, or a tilt off by more than 2 deg and three sigmas.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path[:0] = [str(TESTS)]

from worlds.start import KINDS, Start, initialiser  # noqa: E402

SHARES = {"static": 15, "moving": 40, "gentle": 15, "rotation": 10, "uniform": 10, "accelerating": 10}


def tilt_sigma_rad(R: np.ndarray, covariance: np.ndarray) -> float:
    """Return the larger sigma of roll and pitch."""
    return float(np.sqrt(np.linalg.eigvalsh((R @ covariance[:3, :3] @ R.T)[:2, :2])[-1]))


def run_kind(kind: str, count: int) -> int:
    """Run the starts of one kind, print a row and every wrong one; return how many are wrong."""
    scale, sigma, tilt, seconds, cpu_ms, causes, wrong = [], [], [], [], [], {}, 0
    for seed in range(count):
        start = Start(kind, seed)
        search = initialiser(start)
        begin = time.process_time()
        found, answers = start.run(search)
        attempts = sum(n for cause, n in search.refusals.items() if cause != "duration") + 1
        cpu_ms.append(1e3 * (time.process_time() - begin) / attempts)
        if found.last is None:
            causes[answers[-1].cause] = causes.get(answers[-1].cause, 0) + 1
            continue
        given = [answer.last for answer in answers if answer.last is not None]
        seconds.append((given[0].t_ns - start.stamps[0]) * 1e-9)
        tilt.append(start.tilt_error_rad(found.last))
        error = 0.0
        if found.status == "moving":
            error = start.scale_error(found)
            scale.append(error)
            sigma.append(found.scale_sigma)
        limit = max(np.deg2rad(2.0), 3.0 * tilt_sigma_rad(found.last.T_world_body[:3, :3], found.last.covariance))
        if abs(error) > max(0.05, 3.0 * found.scale_sigma) or tilt[-1] > limit:
            wrong += 1
            print(f"WRONG {kind} {seed}: scale {error:+.1%}, tilt {np.rad2deg(tilt[-1]):.2f} deg: {found.reason}")
    row = f"{kind:13}{len(seconds):4d}/{count:<4d}{wrong:6d}"
    row += f"{np.median(seconds):8.2f}{np.max(seconds):7.2f}" if seconds else f"{'-':>8}{'-':>7}"
    if scale:
        ratio = np.array(scale) / np.array(sigma)
        row += f"{100 * np.median(np.abs(scale)):9.2f}{100 * np.max(np.abs(scale)):7.2f}{100 * np.median(sigma):8.2f}"
        row += f"{np.sqrt(np.mean(ratio**2)):7.2f}"
    else:
        row += f"{'-':>9}{'-':>7}{'-':>8}{'-':>7}"
    row += f"{np.rad2deg(np.max(tilt)):9.2f}" if tilt else f"{'-':>9}"
    print(f"{row}{np.median(cpu_ms):8.0f}  {causes}", flush=True)
    return wrong


def main() -> None:
    """Print the table."""
    print(
        f"{'':13}{'started':>9}{'wrong':>6}{'t/s':>8}{'max':>7}{'scale/%':>9}{'max':>7}{'sigma':>8}{'rms z':>7}", end=""
    )
    print(f"{'tilt max':>9}{'cpu/ms':>8}  last refusals of those not started")
    counts = dict.fromkeys(sys.argv[2:] or KINDS, int(sys.argv[1])) if len(sys.argv) > 1 else SHARES
    wrong = sum(run_kind(kind, count) for kind, count in counts.items())
    print(f"{wrong} wrong of {sum(counts.values())}")


if __name__ == "__main__":
    main()
