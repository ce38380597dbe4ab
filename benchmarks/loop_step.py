"""What loop detection costs per keyframe, at the keyframes of finished runs.

    .venv/bin/python benchmarks/loop_step.py RUN [RUN ...]

The keyframes of each run, features and final poses as its session has them, go through a new detector: once in a row,
as in the run, and once as after a loss, when the second half knows of the first only how it looks, and no loop is taken
into a graph, so that all of them look for their place. CPU time of the thread in ms; words are trained in another one.
Tags are not looked for: a session has no images. Gross are edges that differ from the run's final poses by more than
0.5 m or 10 degrees. The digest is of all decisions and poses: equal ones found the same.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
import time
from pathlib import Path

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402

import results  # noqa: E402
from vislam.config import LoopConfig, LoopTruthConfig  # noqa: E402
from vislam.core.geometry import invert, so3_log  # noqa: E402
from vislam.core.messages import Frame, Keyframe, LoopCandidate, LoopDecision, LoopEdge  # noqa: E402
from vislam.loop import LoopCloser  # noqa: E402
from vislam.runs.session.reader import Session, StoredKeyframe  # noqa: E402

RULE = LoopTruthConfig()


class Pass:
    """One pass over the keyframes of a run."""

    def __init__(self, session: Session, stored: list[StoredKeyframe], is_lost: bool) -> None:
        log = session.factor_log()
        detector = LoopCloser(LoopConfig(), log.rig, 0, log.first_state is not None)
        middle = len(stored) // 2
        self.times_ms: list[float] = []
        self.verified, self.edges, self.gross = 0, 0, 0
        digest = hashlib.sha256()
        for k in stored:
            keyframe = Keyframe(k.id, k.t_ns, Frame(k.t_ns, k.id, ()), k.keypoints_px, k.descriptors, k.points_body_m)
            before, start = detector.counters["verified"], time.thread_time()
            edges, records = detector.detect(keyframe, k.T_map_body, is_lost and k.id == middle, tags=())
            spent_ms = 1e3 * (time.thread_time() - start)
            for record in records:
                digest.update(_bytes(record))
            if not is_lost or k.id >= middle:
                self.times_ms.append(spent_ms)
                self.edges += len(edges)
                self.gross += sum(_is_gross(edge, stored) for edge in edges)
                self.verified += detector.counters["verified"] - before
        detector.close()
        self.digest = digest.hexdigest()[:12]

    def percentiles_ms(self) -> tuple[float, float, float]:
        """Return median, 95th percentile and longest time."""
        p50, p95, most = np.percentile(self.times_ms, (50, 95, 100)).tolist()
        return p50, p95, most

    def row(self, name: str, kind: str) -> str:
        """Return a line of the table."""
        count = len(self.times_ms)
        p50, p95, most = self.percentiles_ms()
        return (
            f"| {name} | {kind} | {count} | {p50:.1f} / {p95:.1f} / {most:.1f} | {self.verified / count:.1f} "
            f"| {self.edges} | {self.gross} | {self.digest} |"
        )


def _is_gross(edge: LoopEdge, stored: list[StoredKeyframe]) -> bool:
    if not edge.has_scale:
        return False
    error = invert(edge.T_from_to) @ invert(stored[edge.from_id].T_map_body) @ stored[edge.to_id].T_map_body
    turn = np.linalg.norm(so3_log(np.ascontiguousarray(error[:3, :3])))
    return bool(np.linalg.norm(error[:3, 3]) > RULE.gross_m or np.rad2deg(turn) > RULE.gross_deg)


def _bytes(record: LoopCandidate) -> bytes:
    says = (record.from_id, record.to_id, record.source, record.inliers, record.decision is LoopDecision.ACCEPTED)
    return repr((*says, record.reason)).encode() + (b"" if record.T_from_to is None else record.T_from_to.tobytes())


def main() -> None:
    """Measure the runs that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--record", action="store_true", help="keep the times in benchmarks/results")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print("| run | keyframes | number | CPU p50 / p95 / most [ms] | verified each | edges | gross | digest |")
    print("|---|---|---:|---:|---:|---:|---:|---|")
    cpu_ms: dict[str, float] = {}
    for run in args.runs:
        session = Session(run / "session.db")
        stored = list(session.keyframes())
        for kind in ("in a row", "lost"):
            done = Pass(session, stored, kind == "lost")
            print(done.row(run.name, kind), flush=True)
            p50, p95, _ = done.percentiles_ms()
            cpu_ms |= {f"{run.name}, {kind}: p50": p50, f"{run.name}, {kind}: p95": p95}
        session.close()
    if args.record:
        results.record("loop_step", cpu_ms)


if __name__ == "__main__":
    main()
