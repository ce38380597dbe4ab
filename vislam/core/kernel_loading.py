"""Compiled kernels come back from the cache as machine code alone: their LLVM modules wait until somebody inlines them.

numba reads both at once. The modules of the kernels of one run take 40 MB and a third of a second, and nothing asks for
them unless a kernel that calls them has to be compiled.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
from numba.core import codegen

_read_both = getattr(codegen.CPUCodeLibrary, "_unserialize", None)
_module_for_linking = getattr(codegen.CPUCodeLibrary, "_get_module_for_linking", None)


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


if _read_both is not None and _module_for_linking is not None and hasattr(llvm, "ObjectFileRef"):
    codegen.CPUCodeLibrary._unserialize = classmethod(_read_code)
    codegen.CPUCodeLibrary._get_module_for_linking = _module_when_asked
