"""What pages carry: files of the folder `assets`, and arrays as text."""

import base64
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array


def assets(name: str) -> str:
    """Return a text file that the page carries."""
    return (Path(__file__).with_name("assets") / name).read_text(encoding="utf-8")


def packed(values: NDArray[Any], dtype: str) -> str:
    """Return an array as `dtype` in base64, as `data.js` unpacks it."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")


def floats(values: Array) -> str:
    """Return an array as little-endian float32 in base64."""
    return packed(values, "<f4")
