"""`report.html`: what a run did, in one file that needs nothing else."""

from vislam.report.loop_plots import write_loop_plot
from vislam.report.page import write_report

__all__ = ["write_loop_plot", "write_report"]
