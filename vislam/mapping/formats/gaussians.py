"""Surfels as Gaussians: the PLY that 3-D Gaussian splatting begins with and its viewers open.

Properties and their encodings are those of Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field
Rendering", ToG 2023: logarithms of the scales, the logit of the opacity, a quaternion with w first, and colour as the
coefficient of the constant spherical harmonic.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vislam.mapping.cloud.surfels import Surfels
from vislam.mapping.formats.ply import write_ply

_SH0 = 0.28209479177387814  # the constant harmonic, 1 / (2 sqrt(pi))
_OPACITY = 0.95
_NOISE_AT_1M_M = 0.002  # of depth, where the confidence of a surfel is 1
_LEAST_M = 1e-4


def write_gaussians(path: Path, surfels: Surfels, spacing_m: float) -> None:
    """Write a Gaussian per surfel: as wide as half the spacing along the surface, as thick as depth is uncertain.

    Raises StorageError when the file cannot be written.
    """
    n = surfels.normals.astype(np.float64)
    # the shortest turn from z to the normal; a half turn about x where they are opposite
    half = np.column_stack([-n[:, 1], n[:, 0], np.zeros(len(n)), 1.0 + n[:, 2]])
    half[n[:, 2] < -1.0 + 1e-9] = (1.0, 0.0, 0.0, 0.0)
    x, y, z, w = Rotation.from_quat(half).as_quat().T
    thick = _NOISE_AT_1M_M / np.sqrt(np.maximum(surfels.confidence, 1e-12))
    along = np.log(0.5 * spacing_m)
    extra = {
        **dict(zip(("nx", "ny", "nz"), n.T, strict=True)),
        **{f"f_dc_{i}": (surfels.colors[:, i] / 255.0 - 0.5) / _SH0 for i in range(3)},
        "opacity": np.full(len(n), np.log(_OPACITY / (1.0 - _OPACITY))),
        "scale_0": np.full(len(n), along),
        "scale_1": np.full(len(n), along),
        "scale_2": np.log(np.clip(thick, _LEAST_M, 0.5 * spacing_m)),
        "rot_0": w, "rot_1": x, "rot_2": y, "rot_3": z,
    }  # fmt: skip
    write_ply(path, surfels.points_m, surfels.colors, extra=extra)
