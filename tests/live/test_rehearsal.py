"""What is compiled before a live run counts: the search for loops, too, with a training of words."""

import pytest

from vislam.config import load
from vislam.live import rehearsal
from vislam.live.virtual.cart import NOISE
from vislam.live.virtual.place import PlaceOptions, virtual_rig
from vislam.loop.words import database
from vislam.slam import Slam

PLANAR = {"frontend.mode": "planar", "frontend.planar.height_m": 0.6}


@pytest.mark.parametrize(("rig", "settings"), [("mono", PLANAR), ("rgbd", {})])
def test_loops_are_rehearsed(monkeypatch, rig, settings):
    slams, trainings = [], []

    def slam(*arguments):
        slams.append(Slam(*arguments))
        return slams[0]

    def train(*arguments):
        trainings.append(real_train(*arguments))
        return trainings[-1]

    real_train = database._train
    monkeypatch.setattr(rehearsal, "Slam", slam)
    monkeypatch.setattr(database, "_train", train)
    rehearsal.rehearse(load(None, settings), virtual_rig(PlaceOptions(rig=rig)), NOISE)
    found = slams[0].back.counters["loop"]
    print(found)
    assert found["accepted"] > 0
    assert trainings and trainings[0] is not None
