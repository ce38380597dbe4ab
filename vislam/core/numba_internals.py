"""What vislam replaces inside numba, all of it and behind one switch: `VISLAM_PLAIN_NUMBA=1` leaves numba as it is.

Kernels come back from the cache as machine code alone; numba reads their LLVM modules at once, which for the kernels of
one run takes 40 MB and a third of a second, though only a kernel that inlines them and has to be compiled needs them.
An assignment to a slice raises a constant text: numba 0.68 puts the shapes into it, for which it compiles its strings
into every such kernel, a quarter of the time. A kernel is linked with what it calls before it is optimised, as a whole
and once more for each that calls it in turn; what is too long to be inlined joins here as it is, after that: a sixth of
the time. Results are the same bytes with and without.

A cached kernel is compiled again where a kernel that it calls, or a constant that either reads, has changed: numba
looks at the kernel's own file alone, and would go on with the old code of another.
"""

import os
from collections.abc import Iterator
from functools import cache
from itertools import islice
from types import CodeType, FunctionType
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from numba.core import caching, codegen
from numba.core.dispatcher import Dispatcher
from numba.extending import overload
from numba.np import arrayobj

from vislam.core.compiling_turns import CacheInTurns

_INLINED = 300  # instructions at most, of what a kernel calls; LLVM's own bound is lower

_read_both = getattr(codegen.CPUCodeLibrary, "_unserialize", None)
_module_for_linking = getattr(codegen.CPUCodeLibrary, "_get_module_for_linking", None)
_finalize = codegen.CPUCodeLibrary.finalize
_optimise = getattr(codegen.CPUCodeLibrary, "_optimize_final_module", None)


def replace_internals() -> None:
    """Replace what is there to be replaced, unless the switch is set; where a name is missing, numba's own stays."""
    if _is_plain():
        return
    if hasattr(arrayobj, "raise_with_shape_context"):
        arrayobj.raise_with_shape_context = _refuse_shapes
    if _read_both is not None and _module_for_linking is not None and hasattr(llvm, "ObjectFileRef"):
        codegen.CPUCodeLibrary._unserialize = classmethod(_read_code)
        codegen.CPUCodeLibrary._get_module_for_linking = _module_when_asked
    if _optimise is not None and hasattr(codegen.CPUCodeLibrary, "add_linking_library"):
        codegen.CPUCodeLibrary.finalize = _finalize_with_short
        codegen.CPUCodeLibrary._optimize_final_module = _optimise_and_link_long


def cache_with_callees(kernel: Any) -> None:
    """Let what is cached of a kernel hold for what it calls and reads, too, as that is at the kernel's first call.

    And let one process at a time compile it.
    """
    cache = getattr(kernel, "_cache", None)
    file = getattr(cache, "_cache_file", None)
    if isinstance(file, caching.IndexDataCacheFile) and "_source_stamp" in vars(file) and not _is_plain():
        file.kernel = kernel
        file.__class__ = _WithCallees
        cache.__class__ = CacheInTurns


class _WithCallees(caching.IndexDataCacheFile):  # type: ignore[misc]
    """The index of a kernel's cached versions, which holds for one stamp."""

    @property
    def _source_stamp(self) -> tuple[Any, ...]:
        return vars(self)["_source_stamp"], *_called_and_read(self.kernel.py_func, set())


_CONSTANTS = (bool, int, float, complex, str, bytes, tuple, np.generic)


def _called_and_read(function: FunctionType, seen: set[FunctionType]) -> Iterator[Any]:
    """Yield the stamps of the files of kernels that a function calls, directly or not, and what constants are."""
    seen.add(function)
    for name in sorted(_names(function.__code__)):
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher):
            if value.py_func not in seen:
                yield name, _file_stamp(value.py_func.__code__.co_filename)
                yield from _called_and_read(value.py_func, seen)
        elif isinstance(value, _CONSTANTS):
            yield name, repr(value)
        elif isinstance(value, np.ndarray):
            yield name, str(value.dtype), value.shape, value.tobytes()


def _names(code: CodeType) -> set[str]:
    """Return the names that code and the functions in it look up."""
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))


@cache
def _file_stamp(path: str) -> tuple[int, int]:
    status = os.stat(path)
    return status.st_mtime_ns, status.st_size


def _is_plain() -> bool:
    return os.environ.get("VISLAM_PLAIN_NUMBA", "0") not in ("", "0")


def _refuse_shapes(source: Any, goal: Any) -> None:
    """What assigning an array to a slice calls where shapes differ; only its compiled form is ever called."""


@overload(_refuse_shapes)
def _refuse_shapes_compiled(source: Any, goal: Any) -> Any:
    def refuse(source: Any, goal: Any) -> None:
        raise ValueError("cannot assign slice from input of different size")

    return refuse


def _read_code(cls: Any, engine: Any, state: tuple[str, str, Any]) -> Any:
    """Return a library with its code; where its state is not what numba 0.6x writes, numba reads it."""
    name, kind, data = state
    symbols = _symbols(data[0]) if kind == "object" else set()
    if not symbols:
        return _read_both(engine, state)  # type: ignore[misc]
    library = engine.create_library(name)
    library.enable_object_caching()
    library._set_compiled_object(data[0])
    library._finalize_final_module()
    library._codegen._engine._defined_symbols |= symbols
    library._bitcode = data[1]
    return library


def _symbols(code: bytes) -> set[str]:
    """Return the names that an object file defines or uses; numba asks for an address only of those it knows."""
    parsed = llvm.ObjectFileRef.from_data(code)
    tables = [section.data() for section in parsed.sections() if section.name() == b".strtab"]
    return {name.decode() for table in tables for name in table.split(b"\0") if name}


def _module_when_asked(library: Any) -> Any:
    library._ensure_finalized()
    if library._shared_module is None and hasattr(library, "_bitcode"):
        library._shared_module = llvm.parse_bitcode(library._bitcode)
    return _module_for_linking(library)  # type: ignore[misc]


def _finalize_with_short(library: Any) -> None:
    """Finalise a library that is linked at first with the short ones only."""
    called = dict.fromkeys(library._linking_libraries)
    library._long = [one for one in called if _is_long(one)]
    library._linking_libraries = [one for one in called if one not in library._long]
    _finalize(library)


def _optimise_and_link_long(library: Any) -> None:
    _optimise(library)  # type: ignore[misc]
    for one in library._long:
        library._reload_init.update(one._reload_init)
        library._final_module.link_in(one._get_module_for_linking(), preserve=True)


def _is_long(library: Any) -> bool:
    """Whether a finalised library has more instructions than are worth inlining."""
    if not hasattr(library, "_is_long"):
        functions = library._get_module_for_linking().functions
        every = (i for function in functions for block in function.blocks for i in block.instructions)
        library._is_long = next(islice(every, _INLINED, None), None) is not None
    return bool(library._is_long)
