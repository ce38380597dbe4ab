"""Errors that a window's edges have in common, where scale and level are known from inertial data alone.

One camera's window sees directions well and lengths only up to a scale that wanders slowly: what an edge's sigma along
its way has beyond that across it is scale, and the next edge has the same. Summed as if independent, a thousand such
errors nearly cancel; they do not. Nor is level known better from many keyframes than from the one that knows it best:
the accelerometer's bias is the same in all. Nothing in a graph of poses measures either better than the window did, so
both are considered and not estimated (Schmidt 1966; Jazwinski 1970, section 8.4): they move no pose.
"""

from __future__ import annotations

import numpy as np

from vislam.core.geometry import skew
from vislam.core.memory import EdgeRecord, GravityRecord
from vislam.core.messages import Array

_NO_WAY_M = 1e-6  # an edge so short has no direction


class SharedErrors:
    """Owns what each edge has of the error of scale, and how well level is known."""

    def __init__(self) -> None:
        """Start with keyframe 0."""
        self._along: Array = np.zeros((64, 3))  # sigma of scale's part of an edge along its way, in body axes, m
        self._level_rad = np.inf

    def take(self, edge: EdgeRecord) -> None:
        """Take an edge, in the place of an older one to the same keyframe; weak links know nothing of scale."""
        while edge.to_id >= len(self._along):
            self._along = np.concatenate([self._along, np.zeros_like(self._along)])
        T = edge.T_previous_body
        way = T[:3, :3].T @ T[:3, 3]
        length_m = float(np.linalg.norm(way))
        self._along[edge.to_id] = 0.0
        if edge.begins_submap or length_m < _NO_WAY_M:
            return
        way /= length_m
        across = np.eye(3) - np.outer(way, way)
        P = edge.covariance[3:, 3:]
        beyond = float(way @ P @ way) - float(np.linalg.eigvalsh(across @ P @ across)[-1])
        self._along[edge.to_id] = np.sqrt(max(beyond, 0.0)) * way

    def level(self, tilt: GravityRecord) -> None:
        """Take how well level is known at a keyframe."""
        self._level_rad = min(self._level_rad, tilt.sigma_rad)

    def effect(self, ids: list[int], poses: Array) -> Array:
        """Return what one sigma of each of three errors does to poses [6 N, 3]: rotation and position, in body axes.

        `poses` [M, 4, 4] are those of all keyframes in map. The errors are scale, and level about map's x and y.
        """
        newest = max(ids)
        R, p = poses[: newest + 1, :3, :3], poses[: newest + 1, :3, 3]
        by_scale = np.cumsum(np.einsum("kij,kj->ki", R, self._along[: newest + 1]), axis=0)
        level_rad = self._level_rad if np.isfinite(self._level_rad) else 0.0
        out = np.zeros((len(ids), 6, 3))
        for row, k in enumerate(ids):
            turn = R[k].T[:, :2] * level_rad
            out[row, :3, 1:] = turn
            out[row, 3:, 0] = R[k].T @ by_scale[k]
            out[row, 3:, 1:] = -R[k].T @ skew(p[k] - p[0])[:, :2] * level_rad
        return out.reshape(-1, 3)
