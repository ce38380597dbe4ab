"""Loop closing: recognise places seen before and measure the relative pose, precision first."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.loop.candidates import Candidate
    from vislam.loop.closer import LoopCloser
    from vislam.loop.detector import Loop, LoopDetector
    from vislam.loop.evaluation import (
        DOUBTFUL,
        RIGHT,
        WRONG,
        Detections,
        TruePlaces,
        bootstrap_interval,
        precision_recall,
        true_places,
    )
    from vislam.loop.injection import INJECTED, FalseLoops, as_candidate, is_injected
    from vislam.loop.table import (
        LoopRow,
        caption,
        loops_text,
        read_loops,
        read_retrieved,
        read_rows,
        retrieved_text,
    )
    from vislam.loop.verification import Verification, Verifier
    from vislam.loop.view import View, make_view
    from vislam.loop.words import BagOfWords, PlaceDatabase, Vocabulary, depth_for, read_orbslam, seed_vocabulary, train

__all__ = [
    "DOUBTFUL",
    "INJECTED",
    "RIGHT",
    "WRONG",
    "BagOfWords",
    "Candidate",
    "Detections",
    "FalseLoops",
    "Loop",
    "LoopCloser",
    "LoopDetector",
    "LoopRow",
    "PlaceDatabase",
    "TruePlaces",
    "Verification",
    "Verifier",
    "View",
    "Vocabulary",
    "as_candidate",
    "bootstrap_interval",
    "caption",
    "depth_for",
    "is_injected",
    "loops_text",
    "make_view",
    "precision_recall",
    "read_loops",
    "read_orbslam",
    "read_retrieved",
    "read_rows",
    "retrieved_text",
    "seed_vocabulary",
    "train",
    "true_places",
]

__getattr__ = late(
    __name__,
    {
        "DOUBTFUL RIGHT WRONG Detections TruePlaces bootstrap_interval precision_recall": "vislam.loop.evaluation",
        "true_places": "vislam.loop.evaluation",
        "INJECTED FalseLoops as_candidate is_injected": "vislam.loop.injection",
        "BagOfWords PlaceDatabase Vocabulary depth_for read_orbslam seed_vocabulary train": "vislam.loop.words",
        "Candidate": "vislam.loop.candidates",
        "Loop LoopDetector": "vislam.loop.detector",
        "LoopCloser": "vislam.loop.closer",
        "LoopRow caption loops_text read_loops read_retrieved read_rows retrieved_text": "vislam.loop.table",
        "Verification Verifier": "vislam.loop.verification",
        "View make_view": "vislam.loop.view",
    },
)
