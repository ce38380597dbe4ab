"""A source run into a folder from its opening to the report: what `vislam.run` and `vislam run` do."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from vislam.config import Config, load
from vislam.core.errors import VislamError
from vislam.core.files import refuse_links_out
from vislam.core.log import log_to
from vislam.core.progress import Progress, silent
from vislam.core.recording import MaskedRecording, Masker, Recording
from vislam.core.up import parse_up
from vislam.datasets.calibrated import with_clock
from vislam.pipeline.settings import derived
from vislam.runs.begin import execute
from vislam.runs.drive import imu_noise
from vislam.runs.folder import MapChoice, map_choice, prepare
from vislam.runs.loaded import LoadedRun, load_run
from vislam.runs.sources import open_source

Show = Callable[[str], AbstractContextManager[Progress]]  # of the recording's name


def run(
    source: str, *, out: Path | str, config: Config | Path | str | None = None, overwrite: bool = False,
    in_map: Path | str | None = None, localize_only: bool = False, masks: Masker | None = None,
    progress: Progress = silent, **settings: Any,
) -> LoadedRun:  # fmt: skip
    """Run a recording or simulated world into a new folder, as `vislam run` does, and return what it left.

        vislam.run("tum:PATH", out="runs/desk", graph={"coupling": "tight"}, seed=3)

    Args:
        source: `euroc:PATH`, `tum:PATH`, `sim:WORLD`, a bare path ...; see `open_source`.
        out: the folder to make.
        config: the settings to begin with, or a TOML file of them; None: the defaults.
        overwrite: replace the run that the folder holds.
        in_map: session or folder of an earlier run in whose map this one begins; it is not written.
        localize_only: with `in_map`, leave its keyframes and clouds as they are.
        masks: gives the masks of each frame's images, which say what not to use (see `Frame.masks`), as a network does.
        progress: called with frames done, frames in all and a short note.
        settings: by section, as docs/config.md has them, or by dotted name (`**{"graph.coupling": "tight"}`); they go
            before `config`.

    Raises a VislamError with the next step: UsageError for what cannot be asked, DataError for a bad recording.
    """
    out = Path(out)
    chosen = load(Path(config) if isinstance(config, str) else config, settings)
    run_source(
        source, chosen, out, [f"vislam.run({source!r}, out={str(out)!r})"], overwrite=overwrite,
        choice=map_choice(None if in_map is None else Path(in_map), localize_only, chosen),
        show=lambda _: nullcontext(progress), masks=masks,
    )  # fmt: skip
    return load_run(out)


def run_source(
    source: str, config: Config, out: Path, command: list[str], *, overwrite: bool, choice: MapChoice | None,
    show: Show, masks: Masker | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Run a source into a folder and write its report, whatever happened on the way; return the metrics."""
    config, recording = _opened(source, config)
    recording = recording if masks is None else MaskedRecording(recording, masks)
    prepare(out, overwrite, choice)
    with written_up(out, command), show(recording.name) as progress:
        return execute(recording, config, out, source, command, progress, choice)


def resolved(source: str, config: Config) -> Config:
    """Return what config.json of a run of this source would hold: the settings, and what follows from its sensors."""
    config, recording = _opened(source, config)
    return derived(config, recording.rig, imu_noise(config.imu, recording.imu_noise))


def _opened(source: str, config: Config) -> tuple[Config, Recording]:
    parse_up(config.up)
    config = with_clock(config)
    return config, open_source(source, config.seed, config.calibration)


@contextmanager
def written_up(out: Path, command: Sequence[str], is_hurried: Callable[[], bool] = lambda: False) -> Iterator[None]:
    """Keep the log of a run and write its report afterwards, whatever happened on the way but an interrupt.

    `is_hurried` reports whether an interrupt was answered with an end in order.
    """
    from vislam.runs import report  # what draws is loaded by the first use, when the run has given its memory back

    refuse_links_out(out)
    with log_to(out, command):
        try:
            yield
        except KeyboardInterrupt:
            raise  # an interrupt does not wait for a report
        except BaseException:
            with suppress(VislamError):  # what went wrong first is what is reported
                if (out / "metrics.json").is_file():
                    report.write_report(out)
            raise
        if not is_hurried():
            report.write_report(out)
