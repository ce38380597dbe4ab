"""What a user pays: CPU, memory and the time to the first pose of vislam beside ORB-SLAM3 and Basalt.

    pip install --target /tmp/peers pyorbslam3 depthai     # a folder to throw away, beside vislam's own environment
    .venv/bin/python benchmarks/peers_cost.py --peers /tmp/peers [--rounds 3] [--only orbslam3 ...] [--out FILE.json]

The same recordings (EuRoC MH_01, 17 s, stereo and mono with the IMU; TUM fr1_desk) through every system, each run in a
process of its own, one after the other in turns. CPU is user and system time of the whole process from its start to its
end: interpreter, imports, vocabulary, reading and decoding of images. Memory is the most that was resident. Of several
rounds the least counts, for other work on the machine only adds. "vislam run" is the command with its dense map, Rerun
recording and report; "vislam, poses" leaves these out, as the peers have none. A first run of each, which loads what is
cached on disk and compiles our kernels, does not count.

Peers play at the pace of the recording (`--pace`), for their threads use what time they get; ours does not depend on
it. ORB-SLAM3 wants a vocabulary: --vocabulary ORBvoc.txt; without, one of the recordings' own images is made, which is
smaller and loads faster than the real one. Basalt needs g++, for a shim (basalt_shim.cpp beside its driver) that
stands in for its device, and has no loops. ATE is that of the causal poses after SE(3) alignment: what the CPU was
spent on. ORB-SLAM3 turns and scales its world when its IMU has been initialised, and its causal ATE with an IMU
contains that; its first pose with one camera has no metres yet.

This process stays small, for a child's peak memory begins with that of who started it.
"""

from __future__ import annotations

import argparse
import glob
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PEERS = ROOT / "vislam" / "experiment" / "peer_drivers"
TIMEOUT_S = 900.0
_VISLAM = "from vislam.cli import main; main()"
_ATE = """
import sys, numpy as np
from pathlib import Path
from vislam.runs.sources import open_source
from vislam.trajectory import evaluate, read_tum
print(evaluate(read_tum(Path(sys.argv[2])), open_source(sys.argv[1], 0).truth(), "se3")["ate_rmse_m"])
"""


@dataclass(frozen=True)
class Case:
    """A recording and how it is used."""

    name: str
    reader: str
    folder: str
    mode: str  # of vislam's front end

    def path(self, data: Path) -> Path:
        """Return where it lies."""
        return data / self.folder


CASES = (
    Case("MH_01 17 s, stereo + IMU", "euroc", "euroc_mh01_17s", "stereo"),
    Case("MH_01 17 s, mono + IMU", "euroc", "euroc_mh01_17s", "mono"),
    Case("fr1_desk 20 s, RGB-D", "tum", "tum_fr1_desk", "rgbd"),
)
SYSTEMS = ("vislam run", "vislam, poses", "orbslam3", "basalt")


@dataclass(frozen=True)
class Paid:
    """What one run cost, or why there is nothing to say."""

    failure: str = ""
    cpu_s: float = 0.0
    peak_memory_mb: float = 0.0
    frames: int = 0
    poses: int = 0
    first_pose_s: float | None = None
    first_pose_cpu_s: float | None = None
    ate_m: float | None = None
    versions: str = ""


class Bench:
    """Runs systems on recordings in processes of their own, and keeps what they leave in one folder."""

    def __init__(self, args: argparse.Namespace, work: Path) -> None:
        """Use the peers' folder and the recordings that the command line names."""
        self._data, self._peers, self._pace, self._work = args.data, args.peers, str(args.pace), work
        self._vocabulary = args.vocabulary
        self._prepared: dict[str, str] = {}  # why a system cannot be run, empty: it can

    def run(self, system: str, case: Case) -> Paid:
        """Run a system once."""
        if system == "basalt" and case.mode != "stereo":
            return Paid("does stereo with an IMU only")
        if not case.path(self._data).is_dir():
            return Paid(f"{case.path(self._data)} is missing")
        if system not in self._prepared:
            self._prepared[system] = self._prepare(system)
        if self._prepared[system]:
            return Paid(self._prepared[system])
        out = self._work / "out"
        command, environment = self._command(system, case, out)
        return self._measured(command, environment, case, out, system)

    def _prepare(self, system: str) -> str:
        """Make what a peer needs beside its package; return why it cannot be run, or an empty string."""
        if system.startswith("vislam"):
            return ""
        package = {"orbslam3": "pyorbslam3", "basalt": "depthai"}[system]
        if self._peers is None or not (self._peers / package).is_dir():
            return f"absent: {package} is not in {self._peers or 'a folder given by --peers'}"
        if system == "orbslam3" and self._vocabulary is None:
            images = [path for case in CASES for path in self._images(case)]
            self._vocabulary = self._work / "vocabulary.txt"
            return self._done([sys.executable, PEERS / "orbslam3_vocabulary.py", self._vocabulary, *images])
        if system == "basalt":
            shim = [
                "g++",
                "-std=c++17",
                "-shared",
                "-fPIC",
                "-O1",
                PEERS / "basalt_shim.cpp",
                "-o",
                self._work / "shim.so",
            ]
            calibrate = [sys.executable, PEERS / "basalt_peer.py", "calibrate", CASES[0].path(self._data)]
            return self._done([*shim, "-ldl"]) or self._done(calibrate, self._environment(system, preload=False))
        return ""

    def _images(self, case: Case) -> list[str]:
        below = "mav0/cam0/data/*" if case.reader == "euroc" else "rgb/*"
        return sorted(glob.glob(str(case.path(self._data) / below)))

    def _environment(self, system: str, preload: bool = True) -> dict[str, str]:
        if system.startswith("vislam"):
            return {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
        values = {"PYTHONPATH": str(self._peers)}
        if system == "basalt":
            library = next(iter(self._peers.glob("depthai.libs/libdepthaicore*.so")), Path("libdepthaicore.so"))
            values |= {"DAI_CALIB": str(self._work / "calibration.json"), "DAI_LIB": library.name}
            values |= {"LD_PRELOAD": str(self._work / "shim.so")} if preload else {}
        return values

    def _command(self, system: str, case: Case, out: Path) -> tuple[list[str | Path], dict[str, str]]:
        source, path, poses = f"{case.reader}:{case.path(self._data)}", case.path(self._data), out.with_suffix(".tum")
        commands: dict[str, list[str | Path]] = {
            "vislam run": ["-c", _VISLAM, "run", source, "--out", out, "--overwrite", "--frontend.mode", case.mode],
            "vislam, poses": [ROOT / "benchmarks" / "peers" / "vislam_poses.py", source, case.mode, poses],
            "orbslam3": [PEERS / "orbslam3_peer.py", case.mode, path, poses, self._vocabulary or "", self._pace],
            "basalt": [PEERS / "basalt_peer.py", "run", path, poses, self._pace],
        }
        return [sys.executable, *commands[system]], self._environment(system)

    def _measured(
        self, command: list[str | Path], environment: dict[str, str], case: Case, out: Path, system: str
    ) -> Paid:
        """Run a command to its end and return what the system accounts to it."""
        said, errors = self._work / "said.txt", self._work / "errors.txt"
        with said.open("wb") as stdout, errors.open("wb") as stderr:
            limited = ["timeout", str(TIMEOUT_S), *map(str, command)]
            pid = os.posix_spawnp(
                limited[0], limited, {**os.environ, **environment},
                file_actions=[(os.POSIX_SPAWN_DUP2, stdout.fileno(), 1), (os.POSIX_SPAWN_DUP2, stderr.fileno(), 2)],
            )  # fmt: skip
            _, status, usage = os.wait4(pid, 0)
        if status != 0:
            code = os.waitstatus_to_exitcode(status)
            lines = errors.read_text(errors="replace").strip().splitlines()
            return Paid(f"exit code {code}: {lines[-1] if lines else 'no message'}")
        told = self._from_run(out) if system == "vislam run" else json.loads(said.read_text().strip().splitlines()[-1])
        told["versions"] = ", ".join(f"{name} {version}" for name, version in told["versions"].items())
        poses = out / "trajectory_live.tum" if system == "vislam run" else out.with_suffix(".tum")
        used = {"cpu_s": usage.ru_utime + usage.ru_stime, "peak_memory_mb": usage.ru_maxrss / 1024.0}
        return Paid(**told, **used, ate_m=self._ate(case, poses))

    def _from_run(self, out: Path) -> dict[str, object]:
        metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        versions = json.loads((out / "manifest.json").read_text(encoding="utf-8"))
        poses = sum(not line.startswith("#") for line in (out / "trajectory_live.tum").read_text().splitlines())
        cost = metrics["cost"]
        return {
            "versions": {"vislam": str(versions.get("code_revision"))[:12]},
            "frames": metrics["frames"],
            "poses": poses,
            "first_pose_s": cost["first_pose_s"],
            "first_pose_cpu_s": cost["before_cpu_s"] + (cost["first_pose_cpu_s"] or 0.0),
        }

    def _ate(self, case: Case, poses: Path) -> float | None:
        source = f"{case.reader}:{case.path(self._data)}"
        done = subprocess.run(
            [sys.executable, "-c", _ATE, source, poses], capture_output=True, text=True, check=False,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        return float(done.stdout) if done.returncode == 0 else None

    def _done(self, command: list[object], environment: dict[str, str] | None = None) -> str:
        """Run a preparation; return why it failed, or an empty string."""
        try:
            done = subprocess.run(
                [str(part) for part in command], capture_output=True, text=True, check=False,
                env={**os.environ, **(environment or {})},
            )  # fmt: skip
        except OSError as error:
            return str(error)
        lines = done.stderr.strip().splitlines()
        return f"{command[0]}: {lines[-1] if lines else 'failed'}" if done.returncode else ""


def least(rounds: list[Paid]) -> Paid:
    """Return the run that took least CPU; one that failed only when all did."""
    well = [paid for paid in rounds if not paid.failure]
    return min(well, key=lambda paid: paid.cpu_s) if well else rounds[0]


def row(system: str, paid: Paid, ours: Paid) -> str:
    """Return a line of the table; ratios are to "vislam, poses"."""
    if paid.failure:
        return f"  {system:14} {paid.failure}"
    first = "–" if paid.first_pose_s is None else f"{paid.first_pose_s:.2f} ({paid.first_pose_cpu_s:.1f} CPU)"
    ate = "–" if paid.ate_m is None else f"{paid.ate_m:.3f}"
    known = bool(ours.cpu_s)
    ratios = (
        f"{paid.cpu_s / ours.cpu_s:5.2f} {paid.peak_memory_mb / ours.peak_memory_mb:5.2f}" if known else "    –     –"
    )
    return (
        f"  {system:14} {paid.cpu_s:7.1f} {1e3 * paid.cpu_s / paid.frames:9.1f} {paid.peak_memory_mb:8.0f} {ratios}"
        f"  {first:>17} {ate:>7} {paid.poses:5}/{paid.frames}  {paid.versions}"
    )


HEAD = (
    f"  {'':14} {'CPU [s]':>7} {'ms/frame':>9} {'RSS [MB]':>8} {'CPU':>5} {'RSS':>5}  "
    f"{'first pose [s]':>17} {'ATE [m]':>7} {'poses':>9}"
)


def main() -> int:
    """Measure and print; 1 when a run of vislam failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", type=Path, help="folder that the peers were installed into")
    parser.add_argument("--data", type=Path, default=os.environ.get("VISLAM_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--pace", type=float, default=1.0, help="of the peers: times real time")
    parser.add_argument("--vocabulary", type=Path, help="ORBvoc.txt")
    parser.add_argument("--only", nargs="+", choices=SYSTEMS, default=SYSTEMS)
    parser.add_argument("--case", type=int, nargs="+", default=range(len(CASES)), help="numbers of recordings, from 0")
    parser.add_argument("--out", type=Path, help="JSON file of every run")
    args = parser.parse_args()
    if args.rounds < 1:
        parser.error("--rounds counts those after the first, which only warms up; it must be 1 or more")
    args.data = Path(args.data)
    kept = []
    with tempfile.TemporaryDirectory() as work:
        bench = Bench(args, Path(work))
        for case in [CASES[i] for i in args.case]:
            found: dict[str, list[Paid]] = {system: [] for system in args.only}
            for number in range(args.rounds + 1):
                for system in args.only:
                    paid = bench.run(system, case)
                    kept.append({"case": case.name, "system": system, "round": number, **asdict(paid)})
                    if number or paid.failure:  # the first one warms up
                        found[system].append(paid)
            ours = least(found["vislam, poses"]) if "vislam, poses" in found else Paid()
            print(f"{case.name}; load {os.getloadavg()[0]:.1f}, ratios to vislam, poses\n{HEAD}")
            for system, rounds in found.items():
                print(row(system, least(rounds), ours), flush=True)
    if args.out is not None:
        args.out.write_text(json.dumps(kept, indent=1) + "\n")
    return int(any(entry["failure"] for entry in kept if entry["system"].startswith("vislam")))


if __name__ == "__main__":
    sys.exit(main())
