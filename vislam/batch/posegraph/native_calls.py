"""Calls of C routines by address from compiled code: BLAS and LAPACK as scipy carries them, and Python's strtod.

An address is a run-time argument, so compiled callers stay cacheable (one that is baked in changes with every process).
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import get_cython_function_address, intrinsic
from numpy.typing import NDArray


def scipy_addresses(*routines: str) -> NDArray[np.int64]:
    """Return the addresses in this process of routines of scipy.linalg, as "cython_blas.dtrsm"."""
    names = [routine.split(".") for routine in routines]
    return np.array([get_cython_function_address(f"scipy.linalg.{at}", name) for at, name in names], dtype=np.int64)


def strtod_address() -> int:
    """Return the address of PyOS_string_to_double: correctly rounded and blind to the locale; needs the GIL."""
    return int(ctypes.cast(ctypes.pythonapi.PyOS_string_to_double, ctypes.c_void_p).value or 0)


def _codegen(return_type: ir.Type) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, pointers = arguments
        word = ir.IntType(64)
        count = signature.args[1].count
        function = ir.FunctionType(return_type, [word] * count)
        target = builder.inttoptr(address, function.as_pointer())
        result = builder.call(target, [builder.extract_value(pointers, i) for i in range(count)])
        return context.get_dummy_value() if isinstance(return_type, ir.VoidType) else result

    return codegen


@intrinsic
def call_void(typing_context: Any, address: Any, pointers: Any) -> Any:
    """Call the routine at `address` with a tuple of pointers (integers); it returns nothing."""
    return types.void(types.int64, pointers), _codegen(ir.VoidType())


@intrinsic
def call_double(typing_context: Any, address: Any, pointers: Any) -> Any:
    """Call the routine at `address` with a tuple of pointers (integers); it returns a double."""
    return types.float64(types.int64, pointers), _codegen(ir.DoubleType())
