"""`vislam calibrate WHAT`: what camera, IMU, magnetometer and floor are like; `calibration.kinds` has every WHAT."""

import json

from vislam.calibration.kinds import KINDS
from vislam.cli.verbs.arguments import parse
from vislam.core.errors import UsageError

OPTIONS = tuple(kind.options for kind in KINDS.values())
WORDS = tuple(KINDS)


def main(arguments: list[str]) -> int:
    """Calibrate what the first argument names."""
    if not arguments or arguments[0] in ("-h", "--help"):
        lines = [f"  {name:<12}{kind.summary}" for name, kind in KINDS.items()]
        usage = "usage: vislam calibrate WHAT ...; vislam calibrate WHAT --help has more"
        print("\n".join([usage, "", *lines]))
        return 0 if arguments else UsageError.exit_code
    kind = KINDS.get(arguments[0])
    if kind is None:
        raise UsageError(f"nothing called '{arguments[0]}' to calibrate; there are: {', '.join(KINDS)}")
    options = parse(kind.options, arguments[1:], f"calibrate {arguments[0]}", summary=kind.summary)
    from vislam.core.files import plain

    outcome = kind.calibrate(options)
    print(json.dumps(plain(outcome.report)) if options.json else "\n".join([*outcome.lines, *map(str, outcome.files)]))
    return 0
