"""Bags: rosbag 1, rosbag 2 and MCAP as recordings, with topics guessed or given."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from vislam.config import validated
from vislam.datasets.bags.bag import SUFFIXES, is_bag
from vislam.datasets.bags.choice import BagOptions
from vislam.datasets.bags.poses import trajectory_of_topic
from vislam.datasets.bags.surveying import survey_bag
from vislam.datasets.bags.topic_readings import first_fix, readings_of_topic
from vislam.datasets.stream import Survey

__all__ = [
    "LOOKS_FOR", "SUFFIXES", "first_fix", "is_bag", "readings_of_topic", "recognises", "survey", "survey_with",
    "trajectory_of_topic",
]  # fmt: skip

LOOKS_FOR = f"a bag ({', '.join(SUFFIXES)}, or a folder with such files)"
recognises = is_bag


def survey(path: Path) -> Survey:
    """Return what a bag holds, with its topics guessed; what is wrong with it is in `errors`.

    Raises DataError when the extra `bags` is not installed.
    """
    return survey_with(path, {})


def survey_with(path: Path, options: Mapping[str, str]) -> Survey:
    """Return what a bag holds, with topics as they are given; raises UsageError for an option that is none."""
    return survey_bag(path, validated(BagOptions, options, f"bag:{path}"))
