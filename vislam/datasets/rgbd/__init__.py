"""Colour against depth of an RGB-D recording: does depth lie where it should, when it should, and fit the lens."""

from vislam.datasets.rgbd.depth_place import PlaceFit, fit_place
from vislam.datasets.rgbd.facts import RgbdFacts, rgbd_facts
from vislam.datasets.rgbd.judgement import Known, RgbdFault, known, rgbd_faults, rgbd_findings

__all__ = [
    "Known", "PlaceFit", "RgbdFacts", "RgbdFault", "fit_place", "known", "rgbd_facts", "rgbd_faults", "rgbd_findings",
]  # fmt: skip
