"""Factors of the pose graph, built from plain measurements; the only room besides the graph that knows gtsam."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.factors.factor_log import (
        FactorLog,
        LoggedEdge,
        LoggedKeyframe,
        rig_data,
        rig_from,
        state_data,
        state_from,
    )
    from vislam.factors.journal import checked_pose, loop_record
    from vislam.factors.keys import nearest_rigid
    from vislam.factors.loop import LoopModel
    from vislam.factors.noise_models import checked_covariance, conditioned
    from vislam.factors.window import WindowOdometry

__all__ = [
    "FactorLog",
    "LoggedEdge",
    "LoggedKeyframe",
    "LoopModel",
    "WindowOdometry",
    "checked_covariance",
    "checked_pose",
    "conditioned",
    "loop_record",
    "nearest_rigid",
    "rig_data",
    "rig_from",
    "state_data",
    "state_from",
]

__getattr__ = late(
    __name__,
    {
        "FactorLog LoggedEdge LoggedKeyframe rig_data rig_from state_data state_from": "vislam.factors.factor_log",
        "LoopModel": "vislam.factors.loop",
        "checked_pose loop_record": "vislam.factors.journal",
        "WindowOdometry": "vislam.factors.window",
        "checked_covariance conditioned": "vislam.factors.noise_models",
        "nearest_rigid": "vislam.factors.keys",
    },
)
