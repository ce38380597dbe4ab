"""Does the verdict call what went wrong? Faults put into recordings and worlds, and the same without a fault.

    python experiments/breaks.py --out breaks [--data DIR] [--source "MH_01 stereo" ...] [--only black turned ...]
    python experiments/breaks.py --out breaks --moments 5 --seed 0   # what begins at some moment, at five random ones
    python experiments/breaks.py --out breaks --again     # judge the evidence that is stored there anew

A run counts as wrong when its filter, its live pose or its graph ends more than three times as far from the truth as
without the fault, or has no poses for half of the frames. Called is a run that is doubtful or lost. Named is one whose
events say the stream and what happened in it, within 0.1 s or the interval of its frames. What is there already in
`--out` is not run again; `runs` there keeps errors, verdicts, events and evidence, `breaks.md` the tables. Several
processes may share a folder, each with other sources.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from faults.sensor_faults import BREAKS, FAULTS, FaultyRecording

from vislam.config import Config, load, validated
from vislam.core.errors import VislamError
from vislam.core.streams import Happening
from vislam.experiment.recordings import open_cached
from vislam.runs import execute
from vislam.runs.folder import prepare, read_metrics
from vislam.runs.verdict import Evidence, judge

_WRONG = 3.0  # times the clean error
_SPARED = 1.5  # times the clean error, where what is left suffices
_NAMED_S = 0.1
_SELDOM = (
    "person",
    "clipped",
    "spikes",
    "disordered",
)  # show now and then: named from the first time on
_FROM, _TO = 0.35, 0.75  # of the length, between which moments are
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
    "hololens_000": Source("$DATA/hololens_000", 15.0),
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
    **{
        f"{flight} from {start_s} s": Source(
            f"points:euroc:$DATA/{folder},rig=stereo,start_s={start_s},duration_s=30,tracks=100,camera_hz=10", 30.0
        )
        for flight, folder, starts in (
            ("V2_02", "euroc_v202_imu", (10, 25, 40, 55, 70, 80)),
            ("room1", "tumvi_room1_imu", (10, 30, 50, 70, 90, 105)),
        )
        for start_s in starts
    },
}  # fmt: skip


@dataclass(frozen=True)
class Campaign:
    """The results of a folder, each in a file of its own."""

    out: Path
    data: str
    seed: int

    def run(self, name: str, fault: str, moment: int) -> None:
        """Run a source with a fault, unless that is there or does not fit."""
        source, path = SOURCES[name], self.out / "runs" / f"{name}, {fault}, {self.seed}-{moment}.json"
        if path.is_file() or (fault == _UNIFORM) > bool(source.uniform_uri):
            return
        uri = source.uniform_uri if fault == _UNIFORM else source.uri
        recording = open_cached(uri.replace("$DATA", self.data), 0, self.out / "worlds")
        if fault in FAULTS and not FAULTS[fault].fits(recording, source.has_images):
            return
        rng = np.random.default_rng([self.seed, moment, *f"{name}, {fault}".encode()])
        faulty = FaultyRecording(
            recording, fault if fault in FAULTS else "", seed=int(rng.integers(1 << 31)), length_s=source.length_s,
            from_s=source.length_s * rng.uniform(_FROM, _TO),
        )  # fmt: skip
        entry = {"source": name, "fault": fault, "moment": moment, "from_s": faulty.from_s, "to_s": faulty.to_s}
        entry |= {"is_spared": faulty.fault.spared(recording), **self._executed(faulty, source)}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(entry, indent=1), encoding="utf-8")
        print(f"{path.stem}, {faulty.from_s:.2f} s: {entry['state']}, {entry['ate_m']}", flush=True)

    def _executed(self, recording: FaultyRecording, source: Source) -> dict[str, Any]:
        config = load(None, {"map.enabled": False, "view.enabled": False, **source.config})
        folder, error = self.out / f"run-{os.getpid()}", ""
        shutil.rmtree(folder, ignore_errors=True)
        prepare(folder, overwrite=False)
        try:
            metrics = execute(recording, config, folder, "experiments/breaks.py", [])
        except VislamError as stopped:
            metrics, error = read_metrics(folder), str(stopped)
        shutil.rmtree(folder)
        verdict = metrics.get("verdict") or {"state": "lost", "reasons": [error], "evidence": {}}
        return {
            "ate_m": {name: entry["ate_rmse_m"] for name, entry in metrics.get("accuracy", {}).items()},
            "coverage": metrics.get("coverage_frames", 0.0),
            "duration_s": metrics.get("duration_s", 0.0),
            "interval_s": metrics.get("duration_s", 0.0) / max(metrics.get("frames", 0), 1),
            "events": metrics.get("events", []),
            "error": error,
            **verdict,
        }

    def results(self) -> list[dict[str, Any]]:
        """Return what is stored, in the order of sources and faults."""
        found = [json.loads(path.read_text(encoding="utf-8")) for path in (self.out / "runs").glob("*.json")]
        order = [_CLEAN, *FAULTS, _UNIFORM]
        return sorted(
            (entry for entry in found if entry["source"] in SOURCES and entry["fault"] in order),
            key=lambda entry: (list(SOURCES).index(entry["source"]), order.index(entry["fault"]), entry["moment"]),
        )


def judged_again(entry: dict[str, Any]) -> dict[str, Any]:
    """Return a result with the verdict that its stored evidence gives now."""
    if not entry["evidence"]:
        return entry
    verdict = judge(validated(Evidence, entry["evidence"], "stored evidence"), Config().verdict)
    return {**entry, "state": str(verdict.state), "reasons": list(verdict.reasons)}


def is_named(entry: dict[str, Any]) -> bool:
    """Whether each event that a fault is stands among those of a run, at its time."""
    within_s = max(_NAMED_S, entry["interval_s"])
    late_s = math.inf if entry["fault"] in _SELDOM else within_s
    there = [event for event in entry["events"] if -within_s <= event["from_s"] - entry["from_s"] <= late_s]
    # a step forth differs from a hole only where another stream ends earlier
    also = {Happening.STEP_FORTH: Happening.HOLE}
    kinds = {
        f"{event['stream'].split()[0]} {kind}"
        for event in there
        for kind in (event["happening"], also.get(event["happening"], "?"), "?")
    }
    return entry["fault"] not in FAULTS or kinds.issuperset(FAULTS[entry["fault"]].named)


class Judged:
    """Results beside their unbroken twins."""

    def __init__(self, results: Sequence[dict[str, Any]]) -> None:
        """Take results, those without a fault among them."""
        self._results = results
        self._clean = {entry["source"]: entry for entry in results if entry["fault"] == _CLEAN}

    def ratio(self, entry: dict[str, Any]) -> float:
        """Return how many times the clean error the worst estimate of a run has; infinite without poses."""
        clean = self._clean.get(entry["source"])
        if clean is None:
            return math.nan
        if entry["coverage"] < 0.5:
            return math.inf
        both = [name for name in ("ekf", "live", "graph") if name in clean["ate_m"] and name in entry["ate_m"]]
        return max((entry["ate_m"][name] / clean["ate_m"][name] for name in both), default=math.inf)

    def by_run(self) -> Iterator[str]:
        """Yield all runs as a table."""
        yield "| source | fault | from | error over clean | named | verdict | first reason |"
        yield "|---|---|---:|---:|---|---|---|"
        for entry in self._results:
            begins = f"{entry['from_s']:.2f} s" if entry["fault"] in BREAKS else ""
            named = ("no", "yes")[is_named(entry)] if entry["fault"] in BREAKS and FAULTS[entry["fault"]].named else ""
            reason = (entry["reasons"] or [""])[0].partition(":")[0]
            yield (
                f"| {entry['source']} | {entry['fault']} | {begins} | {self.ratio(entry):.1f} | {named} "
                f"| {entry['state']} | {reason} |"
            )

    def by_kind(self) -> Iterator[str]:
        """Yield a table of the kinds of faults."""
        yield "| fault | runs | worst error over clean | wrong | of these called | named | called | spared and worse |"
        yield "|---|---:|---:|---:|---:|---:|---:|---:|"
        for fault in FAULTS:
            runs = [entry for entry in self._results if entry["fault"] == fault]
            if not runs:
                continue
            wrong = [entry for entry in runs if self.ratio(entry) > _WRONG]
            named = f"{sum(map(is_named, runs))} of {len(runs)}" if FAULTS[fault].named else ""
            spared = [entry for entry in runs if entry["is_spared"]]
            worse = f"{sum(self.ratio(entry) > _SPARED for entry in spared)} of {len(spared)}" if spared else ""
            yield (
                f"| {fault} | {len(runs)} | {max(map(self.ratio, runs)):.1f} | {len(wrong)} | {_called(wrong)} "
                f"| {named} | {_called(runs)} | {worse} |"
            )

    def summary(self) -> Iterator[str]:
        """Yield what the verdict is worth."""
        faulty = [entry for entry in self._results if entry["fault"] != _CLEAN]
        wrong = [entry for entry in faulty if self.ratio(entry) > _WRONG]
        share = f" ({_called(wrong) / len(wrong):.0%})" if wrong else ""
        yield f"Worse than {_WRONG:g} times the clean error: {len(wrong)}, called {_called(wrong)}{share}."
        known = [entry for entry in faulty if entry["fault"] in BREAKS and FAULTS[entry["fault"]].named]
        yield f"Events named with their time: {sum(map(is_named, known))} of {len(known)}."
        spared = [entry for entry in faulty if entry["is_spared"]]
        good = sum(self.ratio(entry) <= _SPARED for entry in spared)
        yield f"At most {_SPARED:g} times the clean error where what is left suffices: {good} of {len(spared)}."
        clean_s = sum(entry["duration_s"] for entry in self._clean.values())
        yield f"Clean: {clean_s / 60.0:.1f} minutes, {_called(self._clean.values())} false alarms."


def _called(entries: Iterable[dict[str, Any]]) -> int:
    return sum(entry["state"] != "trusted" for entry in entries)


def main() -> None:
    """Run what is asked for and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", default=os.environ.get("VISLAM_DATA", ""), help="folder of recordings")
    parser.add_argument("--source", nargs="+", choices=SOURCES, default=list(SOURCES))
    parser.add_argument("--only", nargs="+", choices=[_CLEAN, *FAULTS, _UNIFORM], default=[*FAULTS, _UNIFORM])
    parser.add_argument("--moments", type=int, default=1, help="of each fault that begins at one")
    parser.add_argument("--seed", type=int, default=0, help="of the moments and of what else is random")
    parser.add_argument("--again", action="store_true", help="run nothing, judge what is stored anew")
    options = parser.parse_args()
    campaign = Campaign(options.out, options.data, options.seed)
    for moment in range(0 if options.again else options.moments):
        for name in options.source:
            for fault in dict.fromkeys([_CLEAN, *options.only]):
                if moment and fault not in BREAKS:
                    continue
                try:
                    campaign.run(name, fault, moment)
                except VislamError as error:  # a recording that is not there: the others are run
                    print(f"{name}, {fault}: {error}")
    results = campaign.results()
    judged = Judged([judged_again(entry) for entry in results] if options.again else results)
    lines = "\n".join([*judged.by_kind(), "", *judged.summary()])
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "breaks.md").write_text("\n".join([lines, "", *judged.by_run()]) + "\n", encoding="utf-8")
    print(lines)


if __name__ == "__main__":
    main()
