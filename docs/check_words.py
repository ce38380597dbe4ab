"""Check README, CONTRIBUTING and docs/ for words of our own where the field, or plain English, has a word."""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
INSTEAD = {
    r"tells?|told|untold": "report, state, give, assume, distinguish",
    r"news": "change, update",
    r"nobody|no one knows": "unknown, no user, none",
    r"somebody": "a user, another, a person",
    r"anew": "again",
    r"(?:goes|go|going|went) by": "use, follow",
    r"so many": "a number, as many",
    r"whoever": "users who, readers that",
    r"what ails": "faults of",
    r"says": "states, reports, has",
}
WORDS = re.compile("|".join(rf"(?P<w{i}>\b(?:{words})\b)" for i, words in enumerate(INSTEAD)), re.IGNORECASE)
CODE = re.compile(r"``.*?``|`[^`\n]*`")  # names and output of the program are not prose
ADVICE = list(INSTEAD.values())


def private_words(page: Path) -> list[str]:
    """Return one line for each word of a page that stands in the list, outside of code."""
    problems, fenced = [], False
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        if line.lstrip().startswith("```"):
            fenced = not fenced
        if fenced or line.startswith("    "):
            continue
        for found in WORDS.finditer(CODE.sub("", line)):
            advice = ADVICE[int(str(found.lastgroup)[1:])]
            problems.append(f"{page.relative_to(ROOT)}:{number}: {found[0]!r}; write: {advice}")
    return problems


def main() -> int:
    """Print what was found; return the exit code."""
    roots = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks" / "RESULTS.md"]
    pages = [*roots, *sorted((ROOT / "docs").rglob("*.md"))]
    problems = [problem for page in pages for problem in private_words(page)]
    sys.stderr.writelines(problem + "\n" for problem in problems)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
