"""Hamming distances between 256-bit descriptors, and waiting less for memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.jit import njit

DESCRIPTOR_BYTES = 32


@intrinsic
def popcount(typing_context: Any, value: Any) -> Any:
    """Count the set bits of a uint64 with the processor's own instruction."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


@intrinsic
def prefetch(typing_context: Any, table: Any, row: Any) -> Any:
    """Ask for the cache line where a row of a 2-D array begins, without waiting; any row, even outside the array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        stride = builder.extract_value(array.strides, 0)
        octet, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
        place = builder.gep(builder.bitcast(array.data, octet), [builder.mul(arguments[1], stride)])
        kind = ir.FunctionType(ir.VoidType(), [octet, flag, flag, flag])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [place, flag(0), flag(3), flag(1)])  # for reading, into all caches, data
        return context.get_dummy_value()

    return types.void(table, types.int64), generate


@njit(cache=True, nogil=True)
def distance(a: NDArray[np.uint64], i: int, b: NDArray[np.uint64], j: int) -> int:
    """Return the Hamming distance between rows `a[i]` and `b[j]` of packed descriptors [N, 4]."""
    low = popcount(a[i, 0] ^ b[j, 0]) + popcount(a[i, 1] ^ b[j, 1])
    high = popcount(a[i, 2] ^ b[j, 2]) + popcount(a[i, 3] ^ b[j, 3])
    return int(low + high)


def packed(descriptors: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return descriptors [N, 32] uint8 as [N, 4] uint64 (no copy when they are contiguous).

    Raises DataError when they are not 256-bit descriptors.
    """
    if descriptors.dtype != np.uint8 or descriptors.ndim != 2 or descriptors.shape[1] != DESCRIPTOR_BYTES:
        raise DataError(
            f"loop closing needs 256-bit descriptors [N, {DESCRIPTOR_BYTES}] uint8 such as ORB's, "
            f"got {list(descriptors.shape)} {descriptors.dtype}"
        )
    return np.ascontiguousarray(descriptors).view(np.uint64)
