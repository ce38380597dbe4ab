"""Did a change of the code change what vislam computes? SHA-256 of the outputs of reference runs, made and compared.

    .venv/bin/python experiments/reference.py make results/reference.json
    .venv/bin/python experiments/reference.py compare results/reference.json [--only mh01_mono intel]
    .venv/bin/python experiments/reference.py repeat --short

Replay is deterministic, so a change that only moves code leaves every output byte for byte as it was; `compare` prints
what differs and exits with 1. Other processors and versions of numpy round otherwise: make the table on the machine
where it is compared. `repeat` needs no table: it runs everything twice, in fresh processes, and compares the two.

--short leaves out what needs a recording or much time. Recordings are looked for in VISLAM_DATA, by default
../shared/data; missing ones are refused. A live run depends on the machine's speed, so of it only the layout of its
files is compared.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import resource
import shlex
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
_OUTPUTS = (
    "trajectory_*.tum", "states_*.csv", "loops.csv", "tracking.csv", "map/octomap.bt", "map/cloud.ply", "map/*.pcd",
    "*.g2o", "*.yaml", "*.toml", "board.png",
)  # fmt: skip
_POINTS = "duration_s=6,camera_hz=5,tracks=60"
_CART = "sim:cart-drive,image_width_px=320,exposure_s=0,camera_hz=10"
_ROOM = "sim:handheld-room,image_width_px=320,exposure_s=0,camera_hz=10"
_SENSORS = """
[sensors.wheels]
kind = "wheels"
simulated_hz = 20.0
track_width_m = 0.42
[sensors.gnss]
kind = "position"
simulated_hz = 5.0
sigma_m = 0.05
[sensors.uwb]
kind = "range"
simulated_hz = 20.0
sigma_m = 0.05
anchors = {1 = [-9.0, -9.0, 0.2], 2 = [9.0, -9.0, 3.0], 3 = [9.0, 9.0, 0.5], 4 = [-9.0, 9.0, 2.5]}
"""


@dataclass(frozen=True)
class Reference:
    """Commands of vislam, run in order in an empty folder; what is compared are the outputs in its folder `out`."""

    name: str
    commands: tuple[str, ...]  # {data}: the folder of recordings
    is_short: bool = False
    is_live: bool = False  # depends on the machine's speed: only the layout of its files is compared


def _run(source: str, options: str = "", out: str = "out") -> str:
    return f"run {source} --out {out} --view.no-enabled {options}"


def _graph(file: str) -> tuple[str, ...]:
    return (f"optimize {{data}}/{file} --out out",)


REFERENCES = (
    Reference("fr1_desk", (_run("tum:{data}/tum_fr1_desk"),)),
    Reference("mh01_stereo", (_run("euroc:{data}/euroc_mh01_17s", "--frontend.mode stereo"),)),
    Reference("mh01_mono", (_run("euroc:{data}/euroc_mh01_17s", "--frontend.mode mono"), "optimize out")),
    Reference("workshop_cart", (_run("sim:workshop-cart"),)),
    Reference("intel", _graph("g2o/intel.g2o")),
    Reference("parking_garage", _graph("g2o/parking-garage.g2o")),
    Reference("manhattan", _graph("g2o/manhattan.g2o")),
    Reference("sphere2500", _graph("g2o/sphere2500.g2o")),
    Reference("lecture_hall", _graph("tuc_lecture_hall/Lecture_Hall.g2o")),
    Reference("tight_mono", (_run(f"points:laps,rig=mono,{_POINTS}"),)),
    Reference("loose", (_run(f"points:laps,{_POINTS}", "--ekf.coupling loose --graph.coupling loose"),), is_short=True),
    Reference("planar", (_run(f"{_CART},duration_s=3", "--frontend.planar.height-m 0.6"),), is_short=True),
    Reference("depth", (_run(f"{_ROOM},rig=rgbd,duration_s=3", "--map.products cloud octomap"),), is_short=True),
    Reference(
        "further_sensors",
        (
            _run("points:cart-drive,duration_s=12,camera_hz=5,tracks=60", "--sensors.file sensors.toml"),
            "calibrate sensors out --out out --overwrite",
        ),
        is_short=True,
    ),
    Reference(
        "joined",
        (
            _run(f"points:corridor-loop,{_POINTS}", out="one"),
            _run(f"points:corridor-loop,{_POINTS},pixel_sigma_px=0.8", out="two"),
            "optimize one two --out out",
        ),
    ),
    Reference(
        "false_loops",
        (
            "simulate --graph manhattan --poses 400 --outlier-fraction 0.3 --alias-group 5 --out false.g2o",
            "posegraph false.g2o --robust auto --out out",
        ),
        is_short=True,
    ),
    Reference("board", ("calibrate board --out out",), is_short=True),
    Reference("floor", (f"calibrate floor {_CART},duration_s=8 --height-m 0.6 --out out",)),
    Reference("camera_imu", (f"calibrate camera-imu {_ROOM},duration_s=12 --out out",)),
    Reference("live", (f"live --source replay:points:laps,{_POINTS} --out out --view.no-enabled",), is_live=True),
)


def outputs(reference: Reference, folder: Path) -> dict[str, str]:
    """Run a reference in an empty folder; return the SHA-256 of what lies in its `out`, by file name.

    Raises RuntimeError, with the last lines of vislam's errors, when a command fails.
    """
    (folder / "sensors.toml").write_text(_SENSORS)
    for command in reference.commands:
        _vislam(shlex.split(command.format(data=DATA)), folder)
    out = folder / "out"
    if reference.is_live:
        return {"layout": hashlib.sha256("\n".join(layout(out)).encode()).hexdigest()}
    written = sorted({path for pattern in _OUTPUTS for path in out.glob(pattern)})
    return {path.relative_to(out).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in written}


def layout(run: Path) -> Iterator[str]:
    """Yield what a run folder holds whatever the machine's speed: files, columns, and the sections of its metrics."""
    for path in sorted(path for path in run.rglob("*") if path.is_file()):
        yield path.relative_to(run).as_posix()
        if path.suffix == ".csv":
            with path.open() as file:
                yield file.readline().strip()
    yield from sorted(json.loads((run / "metrics.json").read_text()))


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


def _vislam(arguments: Sequence[str], folder: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(
        [*_VISLAM, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    if done.returncode != 0:
        last = "\n".join(done.stderr.strip().splitlines()[-5:])
        raise RuntimeError(f"vislam {' '.join(arguments)} ended with {done.returncode}: {last}")


def measure(references: Sequence[Reference]) -> dict[str, dict[str, str]]:
    """Return the SHA-256 of all outputs of these references; print how many there are and the CPU seconds taken."""
    table = {}
    for reference in references:
        begun_s = _children_cpu_s()
        with tempfile.TemporaryDirectory() as folder:
            table[reference.name] = outputs(reference, Path(folder))
        if not table[reference.name]:
            raise RuntimeError(f"{reference.name} wrote nothing that could be compared")
        print(
            f"{reference.name}: {len(table[reference.name])} files, {_children_cpu_s() - begun_s:.0f} s of CPU",
            flush=True,
        )
    return table


def _children_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> int:
    """Make the table or compare with it; return 1 where something differs and 2 where it cannot be compared."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("make", "compare", "repeat"))
    parser.add_argument("table", type=Path, nargs="?", help="JSON file with the SHA-256 of every output")
    parser.add_argument("--only", nargs="+", default=(), choices=[r.name for r in REFERENCES], help="some of them")
    parser.add_argument("--short", action="store_true", help="only what is quick and needs no recording")
    args = parser.parse_args()
    if (args.table is None) != (args.action == "repeat"):
        parser.error("make and compare need a table, repeat takes none")
    before = json.loads(args.table.read_text()) if args.action == "compare" else None
    if before is not None and before["machine"] != machine():
        print(f"{args.table} is of {before['machine']}, this is {machine()}: make it here first", file=sys.stderr)
        return 2
    chosen = [r for r in REFERENCES if (not args.only or r.name in args.only) and (r.is_short or not args.short)]
    try:
        if args.action == "repeat":
            before = {"outputs": measure(chosen)}
        now = measure(chosen)
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
