"""Which vislam this is."""

import hashlib
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path


def version() -> str:
    """Return name, version and, in a checkout, the revision of the code."""
    try:
        number = metadata.version("vislam")
    except metadata.PackageNotFoundError:
        number = "(not installed)"
    revision = code_revision()
    return f"vislam {number}" + (f", revision {revision}" if revision else "")


@cache
def code_revision() -> str | None:
    """Return the git revision of the code, with a hash of local changes; None outside a checkout."""
    root = Path(__file__).resolve().parent.parent.parent

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True).stdout

    try:
        if not (root / ".git").exists():
            return None
        changes = git("diff", "HEAD")
        dirty = f"+{hashlib.sha256(changes.encode()).hexdigest()[:12]}" if changes else ""
        return git("rev-parse", "HEAD").strip() + dirty
    except (OSError, subprocess.CalledProcessError):
        return None
