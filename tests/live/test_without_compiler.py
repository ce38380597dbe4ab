"""The filter without a compiler (NUMBA_DISABLE_JIT=1): the same answers from the same source, slower."""

import os
import subprocess
import sys

import numpy as np

_CODE = """
import numpy as np
from vislam.ekf.loose import kernels
rng = np.random.default_rng(4)
x = np.zeros(23)
x[6] = x[19] = 1.0
A = rng.normal(size=(21, 21))
P = A @ A.T * 1e-3
sigmas = np.array([1e-3, 1e-2, 1e-5, 1e-4, 0.5, 2.0])
H, residual = rng.normal(size=(6, 21)), rng.normal(size=6) * 1e-2
for k in range(10):
    samples = rng.normal(size=(2, 6)) + [0, 0, 0, 0, 0, 9.8]
    kernels.predict(x, P, samples[0], samples[1], 0.0025, 0.0, sigmas, 9.81)
    nis, K = kernels.innovation(P, H, np.eye(6) * 1e-4, residual)
    kernels.correct(x, P, K, H, np.eye(6) * 1e-4, residual)
print(nis, *x, *P.ravel())
"""


def answers(disabled: str) -> np.ndarray:
    environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
    done = subprocess.run([sys.executable, "-c", _CODE], capture_output=True, text=True, check=True, env=environment)
    return np.array([float(word) for word in done.stdout.split()])


def test_interpreted_and_compiled_filters_agree() -> None:
    np.testing.assert_allclose(answers("1"), answers("0"), rtol=1e-9, atol=1e-12)
