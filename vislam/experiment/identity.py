"""What a result depends on besides its configuration: data, code, packages, and how it is measured."""

import hashlib
import json
import platform
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from vislam.runs.folder import fingerprint
from vislam.runs.sources import is_world, split_source

HARNESS_VERSION = 1  # of what a job does and measures beside the code below; a new one makes all results new

_PACKAGE = Path(__file__).resolve().parent.parent
_PACKAGES = ("numpy", "scipy", "gtsam", "opencv-python-headless", "numba", "llvmlite")
# they show results or ask for them and cannot change a number; all other code can
_WITHOUT_EFFECT = ("cli/", "__main__.py", "report/", "runs/viewer/", "experiment/")
_MEASURING = tuple(
    f"experiment/{name}.py" for name in ("worker", "measures", "recordings", "programs", "commands", "stated")
)


@cache
def environment() -> dict[str, Any]:
    """Return what must be equal for results to be the same: code, packages, Python and harness."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "none"
    return {
        "code_sha256": code_sha256(_PACKAGE),
        "packages": versions,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "harness": HARNESS_VERSION,
    }


def code_sha256(package: Path) -> str:
    """Return the SHA-256 of the sources that a result can depend on, committed or not."""
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        name = file.relative_to(package).as_posix()
        if name.startswith(_WITHOUT_EFFECT) and name not in _MEASURING:
            continue
        digest.update(f"{name}\n".encode() + file.read_bytes())
    return digest.hexdigest()


def source_identity(source: str) -> str:
    """Return what a source holds, wherever it lies: format, SHA-256 of the data, options; "missing" without data."""
    scheme, name, options = split_source(source)
    options = ",".join(_option_identity(option) for option in options.split(","))
    if is_world(scheme, name):
        return f"{scheme}{name}{options}"
    return f"{scheme}{fingerprint(Path(name)) or 'missing'}{options}"


def _option_identity(option: str) -> str:
    """Return an option of a source; what it holds where its value is a path."""
    name, _, value = option.partition("=")
    if "/" not in value:
        return option
    return f"{name}={fingerprint(Path(split_source(value)[1])) or 'missing'}"


def sha256_of(data: Any) -> str:
    """Return the SHA-256 of plain data, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(data, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
