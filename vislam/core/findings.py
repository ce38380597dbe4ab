"""What an examination found: the lines that `vislam doctor` prints."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was checked: what came out, where, and what to do about it (empty when nothing)."""

    severity: Severity
    what: str
    where: str
    next_step: str = ""


def worst(findings: Iterable[Finding]) -> Severity:
    """Return the worst severity among findings; "ok" of none."""
    seen = {finding.severity for finding in findings}
    return "error" if "error" in seen else "warning" if "warning" in seen else "ok"
