"""`report.html`: what a run did, in one file that needs nothing else."""

from vislam.report.page import write_report

__all__ = ["write_report"]
