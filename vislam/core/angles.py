"""Angles, exact near zero and near half a turn, where the arc cosine loses half of the digits, and directions."""

import math

import numpy as np

from vislam.core.messages import Array


def wrapped(angle_rad: float) -> float:
    """Return an angle in (-pi, pi]."""
    return math.pi - (math.pi - angle_rad) % (2.0 * math.pi)


def angles_between(a: Array, b: Array) -> Array:
    """Return the angles between vectors [..., 3] of any length in rad, 0 where one of them is zero."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def angle_between(a: Array, b: Array) -> float:
    """Return the angle between two vectors [3] of any length in rad."""
    return float(angles_between(a, b))


def angle_deg(a: Array, b: Array) -> float:
    """Return `angle_between` in degrees."""
    return float(np.rad2deg(angle_between(a, b)))


def angles_of(R: Array) -> Array:
    """Return by how much rotations [..., 3, 3] turn, in rad, by sine (antisymmetric part) and cosine (trace)."""
    skewed = R - R.swapaxes(-1, -2)
    twice_sine = np.sqrt(skewed[..., 0, 1] ** 2 + skewed[..., 0, 2] ** 2 + skewed[..., 1, 2] ** 2)
    return np.asarray(np.arctan2(twice_sine, np.trace(R, axis1=-2, axis2=-1) - 1.0))


def directions(n: int) -> Array:
    """Return n unit vectors [n, 3] spread evenly over the sphere, along the golden spiral."""
    k = np.arange(n) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * k / n), np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.column_stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)])
