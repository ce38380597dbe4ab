"""Trajectories: the value, its files, and how one is judged against another."""

from vislam.core.trajectory import Trajectory
from vislam.trajectory.association import Pairs, associate, coverage, spans
from vislam.trajectory.consistency import Consistency, anees, nees
from vislam.trajectory.evaluation import (
    Alignment,
    RelativeErrors,
    align,
    are_misordered,
    ate,
    evaluate,
    gauge_alignment,
    rpe,
    scale_error,
)
from vislam.trajectory.formats import (
    read_kitti,
    read_tum,
    write_kitti,
    write_tum,
)
from vislam.trajectory.recognised import Recognised, read_trajectory, recognise
from vislam.trajectory.states import read_states_csv, write_states_csv

__all__ = [
    "Alignment",
    "Consistency",
    "Pairs",
    "Recognised",
    "RelativeErrors",
    "Trajectory",
    "align",
    "anees",
    "are_misordered",
    "associate",
    "ate",
    "coverage",
    "evaluate",
    "gauge_alignment",
    "nees",
    "read_kitti",
    "read_states_csv",
    "read_trajectory",
    "read_tum",
    "recognise",
    "rpe",
    "scale_error",
    "spans",
    "write_kitti",
    "write_states_csv",
    "write_tum",
]
