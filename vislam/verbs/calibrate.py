"""`vislam calibrate WHAT`: what camera, IMU, magnetometer and floor are like; `calibration.kinds` has every WHAT."""

from __future__ import annotations

import json

import tyro

from vislam.errors import UsageError


def main(arguments: list[str]) -> int:
    """Calibrate what the first argument names."""
    from vislam.calibration.kinds import KINDS
    from vislam.runfolder import plain

    if not arguments or arguments[0] in ("-h", "--help"):
        lines = [f"  {name:<12}{kind.summary}" for name, kind in KINDS.items()]
        usage = "usage: vislam calibrate WHAT ...; vislam calibrate WHAT --help tells more"
        print("\n".join([usage, "", *lines]))
        return 0 if arguments else UsageError.exit_code
    kind = KINDS.get(arguments[0])
    if kind is None:
        raise UsageError(f"nothing called '{arguments[0]}' to calibrate; there are: {', '.join(KINDS)}")
    prog = f"vislam calibrate {arguments[0]}"
    options = tyro.cli(kind.options, prog=prog, description=kind.summary, args=arguments[1:])
    outcome = kind.calibrate(options)
    print(json.dumps(plain(outcome.report)) if options.json else "\n".join([*outcome.lines, *map(str, outcome.files)]))
    return 0
