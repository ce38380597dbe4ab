"""Which loops and keyframes speak against a run: loops that the graph tested, images from all over it."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from vislam.config import Config
from vislam.core import DataError
from vislam.core.memory import EdgeReport
from vislam.core.messages import LoopDecision
from vislam.pipeline.front_report import FrontReport
from vislam.runs.evidence import KeyframeWitness, contradicting, front_evidence, judged
from vislam.runs.metrics import refuse
from vislam.runs.verdict import Trust


def test_a_loop_that_waits_for_its_submap_contradicts_nothing():
    told = [
        (LoopDecision.ACCEPTED, 3.0),
        (LoopDecision.ACCEPTED, math.nan),  # joined two submaps
        (LoopDecision.PENDING, 80.0),  # beyond the gate
        (LoopDecision.PENDING, math.nan),  # between submaps that are not joined
        (LoopDecision.REJECTED, math.nan),  # though it was to join two
        (LoopDecision.REJECTED, 5.0),  # taken out again
    ]
    reports = [EdgeReport(n, 0, n + 1, chi2, 0.0, decision, "") for n, (decision, chi2) in enumerate(told)]
    assert contradicting(reports) == 3


def test_images_of_few_keyframes_are_kept_from_all_over_a_run_and_asked_only_where_there_is_time():
    witness = KeyframeWitness(Config())
    for k in range(1000):
        keyframe = SimpleNamespace(frame=SimpleNamespace(images=(np.full((48, 64), k % 256, np.uint8), k)))
        witness.add(SimpleNamespace(keyframe=keyframe, imu=None, vo=None), SimpleNamespace(details=None))
    kept = [k for _, k in witness.seen]
    assert 6 <= len(kept) <= 11 and kept[0] == 0 and kept[-1] >= 800
    assert len({*np.diff(kept)}) == 1
    witness.is_hurried = True
    lost = front_evidence(FrontReport("stereo", None, None, "", {}, {}, [], {}, 0.0, {}), Config().machine)
    recording = SimpleNamespace(wrapped=lambda: pytest.fail("asked"))
    evidence, verdict = judged(replace(lost, soft_resets=2), Config().verdict, recording, witness.seen)
    assert evidence.causes == () and verdict.state is not Trust.TRUSTED


def test_a_run_without_a_frame_names_what_most_images_are():
    met = {"frames": 0, "name": "x", "problems": {"missing image": 1, "image that is a Git LFS pointer": 9}}
    with pytest.raises(
        DataError, match="x: not one usable frame: image that is a Git LFS pointer; run `vislam doctor`"
    ):
        refuse(met, Path())
    with pytest.raises(DataError, match="x: not one usable frame; run"):
        refuse(met | {"problems": {}}, Path())
