"""`report.html`: what a run did, in one file that needs nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.runs.report.loop_plots import write_loop_plot
    from vislam.runs.report.page import write_figures, write_report

__all__ = ["write_figures", "write_loop_plot", "write_report"]

__getattr__ = late(
    __name__,
    {
        "write_figures": "vislam.runs.report.page",
        "write_loop_plot": "vislam.runs.report.loop_plots",
        "write_report": "vislam.runs.report.page",
    },
)
