"""What a finished run found of its further sensors, as a file for the next one: every run is a calibration of them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from vislam.calibration.options import SensorsOptions
from vislam.calibration.outcome import Folder, Outcome, refuse
from vislam.core.errors import DataError, UsageError
from vislam.core.reading import read_json
from vislam.sensors.sensor import Variable
from vislam.sensors.toml import load_sensor_setup

_LEARNT = 0.5  # of the sigma that a variable began with: above it the run adds little to what was given
_ESTIMATORS = ("graph", "filter")  # the graph has seen all of the run, the filter what came before


class _Found(NamedTuple):
    """An own variable as a run ended with it."""

    variable: Variable
    value: float
    sigma: float

    @property
    def why_not(self) -> str:
        """Why the next run shall not begin with it; empty: it shall."""
        if not self.variable.of_machine:
            return "of that run's world"
        if self.variable.walk > 0.0:
            return "walks"
        return "" if self.sigma < _LEARNT * self.variable.sigma else "not learnt in this run"


def calibrate_sensors(options: SensorsOptions) -> Outcome:
    """Write tables `[sensors.NAME.known]` with value and sigma of each own variable that a run has found.

    Left out is what another run finds again (the heading of a frame), what walks, and what is hardly better known than
    before the run.

    Raises:
        UsageError: the folder is no finished run with further sensors, or holds an earlier calibration.
        DataError: its files are damaged, or nothing was found.
        StorageError: the files cannot be written.
    """
    found = _found(options.run)
    taken = {name: [one for one in entries if not one.why_not] for name, entries in found.items()}
    refuse(
        "the further sensors",
        [] if any(taken.values()) else [
            f"{name}: {one.variable.name} is {one.why_not}" for name, entries in found.items() for one in entries
        ] or ["none of them has variables of its own that began"],
    )  # fmt: skip
    folder = Folder(options.out, ("sensors.toml", "sensors.json"), options.overwrite)
    tables = [f"[sensors.{name}.known]\n{''.join(map(_row, entries))}" for name, entries in taken.items() if entries]
    path = folder.write_text("sensors.toml", f"# value and sigma, as {options.run} found them\n" + "\n".join(tables))
    report = {name: {one.variable.name: _entry(one) for one in entries} for name, entries in found.items()}
    folder.write_report("sensors.json", report)
    lines = [f"{name}.{one.variable.name:<22} {_said(one)}" for name, entries in found.items() for one in entries]
    return Outcome(
        report, (*lines, f"append {path} to the file of the sensors; the next run begins with it"), tuple(folder.files)
    )


def _found(run: Path) -> dict[str, list[_Found]]:
    config, metrics = _json(run / "config.json"), _json(run / "metrics.json")
    file = config.get("sensors", {}).get("file")
    if not isinstance(file, str):
        raise UsageError(f"{run} had no further sensors; run with --sensors.file cart.toml, docs/more-sensors.md")
    suite = load_sensor_setup(Path(file)).suite
    found = metrics.get("sensors")
    if not isinstance(found, dict) or set(found) != set(suite.names):
        raise DataError(f"{run / 'metrics.json'} has not the sensors of {file}; was that file changed? run it again")
    return {name: _of_sensor(suite[name].variables, found[name], run) for name in suite.names}


def _of_sensor(variables: tuple[Variable, ...], entry: Mapping[str, Any], run: Path) -> list[_Found]:
    if not (variables and entry.get("begun")):
        return []
    estimate = next((entry[name] for name in _ESTIMATORS if name in entry), None)
    if estimate is None:
        return []
    try:
        rows = list(
            zip(entry["variables"], map(float, estimate["values"]), map(float, estimate["sigmas"]), strict=True)
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{run / 'metrics.json'}: estimates that are none: {error}; run it again") from error
    if [name for name, _, _ in rows] != [variable.name for variable in variables]:
        raise DataError(f"{run / 'metrics.json'} has other variables than the sensors' file; run it again")
    return [_Found(variable, *numbers) for variable, (_, *numbers) in zip(variables, rows, strict=True)]


def _json(path: Path) -> dict[str, Any]:
    try:
        data = read_json(path)
    except FileNotFoundError as error:
        raise UsageError(f"{path.parent} is no finished run: it has no {path.name}") from error
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read: {error}") from error
    if not isinstance(data, dict):
        raise DataError(f"{path} holds no JSON object")
    return data


def _row(found: _Found) -> str:
    return f"{found.variable.name} = [{found.value!r}, {found.sigma!r}]\n"


def _entry(found: _Found) -> dict[str, Any]:
    return {"value": found.value, "sigma": found.sigma, "before": found.variable.sigma, "left_out": found.why_not}


def _said(found: _Found) -> str:
    return f"{found.value:.6g} +- {found.sigma:.2g}" + (f" (left out: {found.why_not})" if found.why_not else "")
