"""Check the pages and the package for words of our own where the field, or plain English, has a word.

README, CONTRIBUTING and docs/ have none of them. Of strings, docstrings and comments of vislam/ a number is left, which
may only fall: with more than the budget the check fails and lists them; `--all` lists them in any case.
"""

import io
import re
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BUDGET_PACKAGE = 9  # words of the list in vislam/; a commit that raises it says why
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
FSTRING = getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)  # the text of an f-string since Python 3.12


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


def private_words_of_code(file: Path) -> list[str]:
    """Return one line for each word of the list in a file's comments and in strings of more than one word."""
    problems = []
    for token in tokenize.generate_tokens(io.StringIO(file.read_text(encoding="utf-8")).readline):
        if token.type not in (tokenize.COMMENT, tokenize.STRING, FSTRING) or " " not in token.string.strip():
            continue  # a key of a file or of the wire is no prose
        for at, line in enumerate(token.string.split("\n"), token.start[0]):
            for found in WORDS.finditer(CODE.sub("", line)):
                advice = ADVICE[int(str(found.lastgroup)[1:])]
                problems.append(f"{file.relative_to(ROOT)}:{at}: {found[0]!r}; write: {advice}")
    return problems


def main() -> int:
    """Print what was found; return the exit code."""
    roots = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks" / "RESULTS.md"]
    pages = [*roots, *sorted((ROOT / "docs").rglob("*.md"))]
    problems = [problem for page in pages for problem in private_words(page)]
    sys.stderr.writelines(problem + "\n" for problem in problems)
    left = [problem for file in sorted((ROOT / "vislam").rglob("*.py")) for problem in private_words_of_code(file)]
    if len(left) > BUDGET_PACKAGE or "--all" in sys.argv:
        sys.stderr.writelines(problem + "\n" for problem in left)
        sys.stderr.write(f"vislam/: {len(left)} words of the list, {BUDGET_PACKAGE} is the budget\n")
    return 1 if problems or len(left) > BUDGET_PACKAGE else 0


if __name__ == "__main__":
    sys.exit(main())
