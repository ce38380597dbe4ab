"""What is compiled before a live run counts: the search for loops, too, with a training of words."""

from multiprocessing import Pipe

import numpy as np
import pytest

from vislam.config import load
from vislam.core.jit import njit
from vislam.live import map_rehearsal
from vislam.live.map_rehearsal import rehearse_map
from vislam.live.processes.child import Flag, Life, Signals, measured
from vislam.live.rehearsal import rehearse
from vislam.live.virtual.cart import NOISE
from vislam.live.virtual.place import PlaceOptions, virtual_rig
from vislam.pipeline.settings import derived
from vislam.slam import Slam

PLANAR = {"frontend.mode": "planar", "frontend.planar.height_m": 0.6}


@pytest.mark.parametrize(("rig", "settings"), [("mono", PLANAR), ("rgbd", {})])
def test_loops_are_rehearsed(monkeypatch, rig, settings):
    slams = []

    def slam(*arguments):
        slams.append(Slam(*arguments))
        return slams[0]

    monkeypatch.setattr("vislam.slam.Slam", slam)
    rehearse(load(None, settings), virtual_rig(PlaceOptions(rig=rig)), NOISE)
    found = slams[0].back.counters["loop"]
    print(found)
    assert found["accepted"] > 0
    assert slams[0].back.loops.words() is not None  # they were trained


@pytest.mark.parametrize(("before", "while_it_runs", "after", "late"), [(1, 0, 0, 0), (0, 0, 1, 0), (1, 2, 1, 2)])
def test_kernels_that_come_after_a_process_was_ready_are_counted(before, while_it_runs, after, late):
    def call(count):
        for _ in range(count):
            njit()(lambda x: x)(1)  # another kernel each time

    def body(life):
        call(before)
        life.ready()
        call(while_it_runs)
        life.when_over()
        call(after)

    hears, says = Pipe(duplex=False)
    signals = Signals(Flag(), Flag())
    signals.go.set()
    measured(Life("front", says, signals), body)
    told = [hears.recv() for _ in range(2)]
    assert (told[1].values["cost"]["late_kernels"] > 0) == (late > 0)
    assert told[1].values["cost"]["late_kernels"] >= late


@pytest.mark.parametrize("rig", ["mono", "rgbd"])
def test_the_map_is_rehearsed_with_what_it_writes(rig, monkeypatch):
    stages = []

    def stage(*arguments):
        stages.append(real_stage(*arguments))
        return stages[0]

    real_stage = map_rehearsal.map_stage
    monkeypatch.setattr(map_rehearsal, "map_stage", stage)
    sensors = virtual_rig(PlaceOptions(rig=rig))
    rehearse_map(derived(load(None, {}), sensors, NOISE), sensors)
    counters = stages[0].counters["map"]
    print(counters)
    assert counters["keyframes_sparse"] + counters["keyframes_dense"] > 5
    assert counters["keyframes_integrated_again"] > 5
    assert np.isfinite(stages[0].mapper.cloud().points_m).all() and len(stages[0].mapper.cloud().points_m)
