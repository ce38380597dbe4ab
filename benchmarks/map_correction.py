"""What it costs when the graph moves keyframes of a run of 1,000: CPU time of one core, all of it and the longest call.

    .venv/bin/python benchmarks/map_correction.py RUN [--resolution-m 0.05]

The depth images of RUN's session are used again and again, in two shapes: ten rooms one after the other, in which a
correction is local in space, and one room, in which every keyframe sees what every other sees. Decoding counts. At the
end the map is compared with one made from scratch.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).resolve().parent.parent)]

import numpy as np  # noqa: E402

from vislam.config import MapConfig  # noqa: E402
from vislam.core.geometry import se3_exp  # noqa: E402
from vislam.core.memory import PackedScan  # noqa: E402
from vislam.core.messages import GraphUpdate  # noqa: E402
from vislam.factors import rig_from  # noqa: E402
from vislam.mapping.mapper import Mapper  # noqa: E402
from vislam.mapping.octree.octomap_io import encode_ot  # noqa: E402
from vislam.runs.session import Session  # noqa: E402

KEYFRAMES = 1000
ROOM_M = 8.0  # from one room to the next
MOVED = se3_exp(np.array([0.01, 0.0, 0.02, 0.08, 0.06, 0.0]))
CORRECTIONS = {
    "20 in the middle": range(500, 520), "50 in the middle": range(480, 530), "the last 50": range(950, 1000),
    "the last 80": range(920, 1000), "all": range(1000),
}  # fmt: skip


def update(ids: list[int], T: list[np.ndarray]) -> GraphUpdate:
    """Return an update by which keyframes are at other poses."""
    return GraphUpdate(1, np.array(ids, np.int64), np.array(T).reshape(-1, 4, 4), np.eye(4), None)


def correct(mapper: Mapper, T: dict[int, np.ndarray], ids: list[int]) -> str:
    """Move keyframes, advance until the map has followed, and return what that took."""
    for i in ids:
        T[i] = T[i] @ MOVED
    before, moved, calls_ms = mapper.counters["rebuilds"], update(ids, [T[i] for i in ids]), []
    while mapper.counters["rebuilds"] == before:
        start = time.process_time()
        mapper.move(moved)
        calls_ms.append(1e3 * (time.process_time() - start))
        moved = update([], [])
    return f"{sum(calls_ms):.0f} ms in {len(calls_ms)} calls, the longest {max(calls_ms):.0f} ms"


def main() -> None:
    """Measure both shapes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--resolution-m", type=float, default=0.05)
    options = parser.parse_args()
    session = Session(options.run / "session.db")
    rig = rig_from(session.info()["rig"])
    rows = session.rows("SELECT id, t_ns, depth_png, points, colors FROM scans ORDER BY id")
    seen = {i: PackedScan(*row) for i, *row in rows}
    placed = {k.id: k.T_map_body for k in session.keyframes()}
    config, ids = replace(MapConfig(), resolution_m=options.resolution_m), list(seen)
    for rooms in (10, 1):
        scans, T = {}, {}
        for n in range(KEYFRAMES):
            i = ids[n * len(ids) * rooms // KEYFRAMES % len(ids)] if rooms > 1 else ids[n % len(ids)]
            shift = np.eye(4)
            shift[:2, 3] = ROOM_M * (n * rooms // KEYFRAMES), 0.003 * (n % 7)
            scans[n], T[n] = seen[i], shift @ placed[i]
        mapper, start = Mapper(config, rig), time.process_time()
        mapper.restore(scans, dict(T))
        mapper.finish()
        print(
            f"rooms {rooms}, from scratch: {time.process_time() - start:.2f} s, {mapper.occupancy.nbytes / 1e6:.1f} MB"
        )
        print("  kept: marks {marks_bytes} bytes, images {store_bytes} bytes".format(**mapper.counters))
        for name, which in CORRECTIONS.items():
            print(f"  {name}: {correct(mapper, T, list(which))}", flush=True)
        scratch = Mapper(config, rig)
        scratch.restore(scans, T)
        scratch.finish()
        same = encode_ot(scratch.occupancy.leaves()) == encode_ot(mapper.occupancy.leaves())
        print(f"  the same as from scratch: {same}")


if __name__ == "__main__":
    main()
