"""`vislam compare`: estimators against each other, by a plan."""

import json

from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.terminal import progress_bar
from vislam.experiment.options import CompareOptions

OPTIONS = (CompareOptions,)


def main(arguments: list[str]) -> int:
    """Compare estimators."""
    options = parse(CompareOptions, arguments, "compare")
    from vislam.experiment.compare import run_comparison

    with progress_bar(options.plan.stem, "jobs") as progress:
        answer = run_comparison(options, ["vislam", "compare", *arguments], progress)
    print(json.dumps(answer.data) if options.json else "\n".join(answer.lines))
    return answer.exit_code
