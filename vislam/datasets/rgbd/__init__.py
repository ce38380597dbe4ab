"""Colour against depth of an RGB-D recording: does depth lie where it should, when it should, and fit the lens."""

from vislam.datasets.rgbd.depth_place import PlaceFit, fit_place, misplaced
from vislam.datasets.rgbd.facts import RgbdFacts, rgbd_facts
from vislam.datasets.rgbd.judgement import MEND, Known, RgbdFault, known, misplaced_words, rgbd_faults, rgbd_findings

__all__ = [
    "MEND", "Known", "PlaceFit", "RgbdFacts", "RgbdFault", "fit_place", "known", "misplaced", "misplaced_words",
    "rgbd_facts", "rgbd_faults", "rgbd_findings",
]  # fmt: skip
