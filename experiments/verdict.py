"""Does the verdict call what went wrong? Faults put into recordings and worlds, and the same without a fault.

    python experiments/verdict.py --out verdict [--data DIR] [--source "MH_01 stereo" ...] [--only black turned ...]
    python experiments/verdict.py --out verdict --again     # judge the evidence that is stored there anew

A run counts as wrong when its filter or its graph ends more than three times as far from the truth as without the
fault, or has no poses for half of the frames. Called is a run that is doubtful or lost. What is there already in
`--out` is not run again; `verdict.json` there keeps errors, verdicts and evidence, `verdict.md` the table.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vislam.config import Config, load, validated
from vislam.core.errors import VislamError
from vislam.experiment.recordings import open_cached
from vislam.runs import execute
from vislam.runs.folder import prepare, read_metrics
from vislam.runs.verdict import Evidence, judge
from vislam.sim.faults.faults import FAULTS, FaultyRecording

_WRONG = 3.0  # times the clean error
_CLEAN = "clean"
_UNIFORM = "uniform"  # a motion of its own, not a fault of sensors


@dataclass(frozen=True)
class Source:
    """A recording or world, how it is run, and how much of it."""

    uri: str
    length_s: float
    config: dict[str, Any] = field(default_factory=dict)
    uniform_uri: str = ""  # the same in uniform motion

    @property
    def has_images(self) -> bool:
        """Whether frames come as images."""
        return not self.uri.startswith("points:")


SOURCES = {
    "MH_01 stereo": Source("euroc:$DATA/euroc_mh01_17s", 9.0, {"frontend.mode": "stereo"}),
    "MH_01 mono": Source("euroc:$DATA/euroc_mh01_17s", 12.0, {"frontend.mode": "mono"}),
    "fr1_desk": Source("tum:$DATA/tum_fr1_desk", 9.0),
    "workshop-cart": Source("sim:workshop-cart", 12.0),
    "corridor-loop": Source("sim:corridor-loop", 15.0),
    "V2_01 stereo": Source(
        "points:euroc:$DATA/euroc_v201_imu,rig=stereo,start_s=5,duration_s=15,tracks=100,camera_hz=10", 15.0
    ),
    "V1_01 stereo": Source(
        "points:euroc:$DATA/euroc_v101_imu,rig=stereo,duration_s=40,tracks=100,camera_hz=10", 40.0
    ),
    "V2_02 stereo": Source(
        "points:euroc:$DATA/euroc_v202_imu,rig=stereo,duration_s=40,tracks=100,camera_hz=10", 40.0
    ),
    "room1 stereo": Source(
        "points:euroc:$DATA/tumvi_room1_imu,rig=stereo,duration_s=40,tracks=100,camera_hz=10", 40.0
    ),
    "V1_01 mono": Source("points:euroc:$DATA/euroc_v101_imu,rig=mono,duration_s=40", 40.0),
    "V2_01 mono": Source("points:euroc:$DATA/euroc_v201_imu,rig=mono,duration_s=40", 40.0),
    "room1 mono": Source("points:euroc:$DATA/tumvi_room1_imu,rig=mono,duration_s=40", 40.0),
    "laps mono": Source(
        "points:laps,rig=mono,duration_s=40", 40.0, {}, "points:straight,rig=mono,duration_s=40"
    ),
}  # fmt: skip


class Campaign:
    """Owns the results of a folder."""

    def __init__(self, out: Path, data: str) -> None:
        self._out, self._data = out, data
        self._path = out / "verdict.json"
        out.mkdir(parents=True, exist_ok=True)
        self.results: dict[str, dict[str, Any]] = {}
        if self._path.is_file():
            self.results = json.loads(self._path.read_text(encoding="utf-8"))

    def run(self, name: str, fault: str) -> None:
        """Run a source with a fault, unless that is there or does not fit."""
        source, key = SOURCES[name], f"{name}, {fault}"
        if key in self.results or (fault == _UNIFORM) > bool(source.uniform_uri):
            return
        uri = source.uniform_uri if fault == _UNIFORM else source.uri
        recording = open_cached(uri.replace("$DATA", self._data), 0, self._out / "worlds")
        if fault in FAULTS and not FAULTS[fault].fits(recording, source.has_images):
            return
        faulty = FaultyRecording(recording, fault if fault in FAULTS else "", length_s=source.length_s)
        config = load(None, {"map.enabled": False, "view.enabled": False, **source.config})
        self.results[key] = {"source": name, "fault": fault, **self._executed(faulty, config)}
        self._path.write_text(json.dumps(self.results, indent=1), encoding="utf-8")
        print(f"{key}: {self.results[key]['state']}, {self.results[key]['ate_m']}", flush=True)

    def _executed(self, recording: FaultyRecording, config: Config) -> dict[str, Any]:
        folder, error = self._out / "run", ""
        shutil.rmtree(folder, ignore_errors=True)
        prepare(folder, overwrite=False)
        try:
            metrics = execute(recording, config, folder, "experiments/verdict.py", [])
        except VislamError as stopped:
            metrics, error = read_metrics(folder), str(stopped)
        verdict = metrics.get("verdict") or {"state": "lost", "reasons": [error], "evidence": {}}
        return {
            "ate_m": {name: entry["ate_rmse_m"] for name, entry in metrics.get("accuracy", {}).items()},
            "coverage": metrics.get("coverage_frames", 0.0),
            "duration_s": metrics.get("duration_s", 0.0),
            "error": error,
            **verdict,
        }

    def judge_again(self) -> None:
        """Replace the verdicts by those that the stored evidence gives now."""
        config = Config().verdict
        for entry in self.results.values():
            if entry["evidence"]:
                verdict = judge(validated(Evidence, entry["evidence"], "stored evidence"), config)
                entry["state"], entry["reasons"] = str(verdict.state), list(verdict.reasons)
        self._path.write_text(json.dumps(self.results, indent=1), encoding="utf-8")

    def ratio(self, entry: dict[str, Any]) -> float:
        """Return how many times the clean error a run has, by the worse of filter and graph; infinite without poses."""
        clean = self.results.get(f"{entry['source']}, {_CLEAN}")
        if clean is None:
            return math.nan
        if entry["coverage"] < 0.5:
            return math.inf
        both = [name for name in ("ekf", "graph") if name in clean["ate_m"] and name in entry["ate_m"]]
        return max((entry["ate_m"][name] / clean["ate_m"][name] for name in both), default=math.inf)

    def table(self) -> str:
        """Return all runs as a table, and under it what the verdict is worth."""
        lines = ["| source | fault | error over clean | verdict | first reason |", "|---|---|---:|---|---|"]
        wrong, called, clean_s, alarms = 0, 0, 0.0, 0
        for entry in self.results.values():
            ratio, is_called = self.ratio(entry), entry["state"] != "trusted"
            if entry["fault"] == _CLEAN:
                clean_s, alarms = clean_s + entry["duration_s"], alarms + is_called
            elif ratio > _WRONG:
                wrong, called = wrong + 1, called + is_called
            reason = (entry["reasons"] or [""])[0].partition(":")[0]
            lines.append(f"| {entry['source']} | {entry['fault']} | {ratio:.1f} | {entry['state']} | {reason} |")
        share = f"{called / wrong:.0%}" if wrong else "none"
        lines += ["", f"Worse than {_WRONG:g} times the clean error: {wrong}, called {called} ({share})."]
        lines.append(f"Clean: {clean_s / 60.0:.1f} minutes, {alarms} false alarms.")
        return "\n".join(lines) + "\n"


def main() -> None:
    """Run what is asked for and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", default=os.environ.get("VISLAM_DATA", ""), help="folder of recordings")
    parser.add_argument("--source", nargs="+", choices=SOURCES, default=list(SOURCES))
    parser.add_argument("--only", nargs="+", choices=[_CLEAN, *FAULTS, _UNIFORM], default=[*FAULTS, _UNIFORM])
    parser.add_argument("--again", action="store_true", help="run nothing, judge what is stored anew")
    options = parser.parse_args()
    campaign = Campaign(options.out, options.data)
    if options.again:
        campaign.judge_again()
    else:
        for name in options.source:
            for fault in dict.fromkeys([_CLEAN, *options.only]):
                try:
                    campaign.run(name, fault)
                except VislamError as error:  # a recording that is not there: the others are run
                    print(f"{name}, {fault}: {error}")
    table = campaign.table()
    (options.out / "verdict.md").write_text(table, encoding="utf-8")
    print(table)


if __name__ == "__main__":
    main()
