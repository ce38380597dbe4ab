"""Did a change of the code change what vislam computes? SHA-256 of the outputs of reference runs, made and compared.

    .venv/bin/python experiments/reference.py make results/reference.json
    .venv/bin/python experiments/reference.py compare results/reference.json [--only mh01_mono intel]

Replay is deterministic, so a change that only moves code leaves every output byte for byte as it was; `compare` prints
what differs and exits with 1. Other processors and versions of numpy round otherwise: make the table on the machine
where it is compared. Recordings are looked for in VISLAM_DATA, by default ../shared/data; missing ones are refused.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("VISLAM_DATA", REPOSITORY.parent / "shared" / "data"))
TIMEOUT_S = 1800.0
_VISLAM = (sys.executable, "-c", "from vislam.cli import main; main()")  # as the script `vislam`, off the path as well
_RUN_OUTPUTS = (
    "trajectory_*.tum", "states_*.csv", "loops.csv", "tracking.csv", "map/octomap.bt", "map/cloud.ply", "map/*.pcd"
)  # fmt: skip


@dataclass(frozen=True)
class Reference:
    """A command whose outputs are compared."""

    name: str
    source: str  # below the data folder, or a simulated world
    options: tuple[str, ...] = ()
    is_optimised: bool = False  # the run again in batch, too

    @property
    def is_pose_graph(self) -> bool:
        """Return whether this is a pose-graph file instead of a recording."""
        return self.source.endswith(".g2o")


REFERENCES = (
    Reference("fr1_desk", "tum:tum_fr1_desk"),
    Reference("mh01_stereo", "euroc:euroc_mh01_17s", ("--frontend.mode", "stereo")),
    Reference("mh01_mono", "euroc:euroc_mh01_17s", ("--frontend.mode", "mono"), is_optimised=True),
    Reference("workshop_cart", "sim:workshop-cart"),
    Reference("intel", "g2o/intel.g2o"),
    Reference("parking_garage", "g2o/parking-garage.g2o"),
    Reference("manhattan", "g2o/manhattan.g2o"),
    Reference("sphere2500", "g2o/sphere2500.g2o"),
    Reference("lecture_hall", "tuc_lecture_hall/Lecture_Hall.g2o"),
)


def outputs(reference: Reference, folder: Path) -> dict[str, str]:
    """Run a reference into a new folder; return the SHA-256 of what it wrote, by file name.

    Raises RuntimeError, with what vislam said last, when a command fails.
    """
    if reference.is_pose_graph:
        _vislam("optimize", str(DATA / reference.source), "--out", str(folder))
        return {path.name: _sha256(path) for path in sorted(folder.glob("*.g2o"))}
    scheme, _, name = reference.source.partition(":")
    source = reference.source if scheme == "sim" else f"{scheme}:{DATA / name}"
    _vislam("run", source, "--out", str(folder), "--view.no-enabled", *reference.options)
    if reference.is_optimised:
        _vislam("optimize", str(folder))
    written = sorted({path for pattern in _RUN_OUTPUTS for path in folder.glob(pattern)})
    return {path.relative_to(folder).as_posix(): _sha256(path) for path in written}


def differences(before: dict[str, dict[str, str]], now: dict[str, dict[str, str]]) -> Iterator[str]:
    """Yield a line for each output of `now` that is not as in `before`, and for what is in one of them only."""
    for name, files in now.items():
        old = before.get(name, {})
        for file in sorted(files.keys() | old.keys()):
            if file not in old:
                yield f"{name}/{file}: new"
            elif file not in files:
                yield f"{name}/{file}: gone"
            elif files[file] != old[file]:
                yield f"{name}/{file}: {old[file][:12]} is now {files[file][:12]}"


def machine() -> str:
    """Return what bytes depend on beside the code."""
    return f"{platform.machine()} {platform.processor() or 'cpu'}, Python {platform.python_version()}"


def _vislam(*arguments: str) -> None:
    done = subprocess.run(
        [*_VISLAM, *arguments], cwd=REPOSITORY, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    if done.returncode != 0:
        last = "\n".join(done.stderr.strip().splitlines()[-5:])
        raise RuntimeError(f"vislam {' '.join(arguments)} ended with {done.returncode}: {last}")


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def measure(only: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the SHA-256 of all outputs of the named references, by default of all."""
    table = {}
    for reference in (r for r in REFERENCES if not only or r.name in only):
        with tempfile.TemporaryDirectory() as folder:
            table[reference.name] = outputs(reference, Path(folder) / "out")
        print(f"{reference.name}: {len(table[reference.name])} files", flush=True)
    return table


def main() -> int:
    """Make the table or compare with it; return 1 where something differs and 2 where it cannot be compared."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("make", "compare"))
    parser.add_argument("table", type=Path, help="JSON file with the SHA-256 of every output")
    parser.add_argument("--only", nargs="+", default=(), choices=[r.name for r in REFERENCES], help="some of them")
    args = parser.parse_args()
    before = json.loads(args.table.read_text()) if args.action == "compare" else None
    if before is not None and before["machine"] != machine():
        print(f"{args.table} is of {before['machine']}, this is {machine()}: make it here first", file=sys.stderr)
        return 2
    try:
        now = measure(args.only)
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 2
    if before is None:
        args.table.parent.mkdir(parents=True, exist_ok=True)
        args.table.write_text(json.dumps({"machine": machine(), "outputs": now}, indent=1) + "\n")
        return 0
    lines = list(differences(before["outputs"], now))
    print("\n".join(lines) if lines else "every output is as it was")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
