"""The experiment: a plan of sequences and estimators, run, measured, compared and written down.

`plan` has what to compare, `jobs` what that means run by run, `worker` does one run, `engines` do many, `store` keeps
the results, `statistics` judges them, `report` shows them, `verify` runs them again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.experiment.compare import run_comparison
    from vislam.experiment.options import CompareOptions
    from vislam.experiment.programs import Setup

__all__ = [
    "CompareOptions",
    "Setup",
    "run_comparison",
]

__getattr__ = late(
    __name__,
    {
        "CompareOptions": "vislam.experiment.options",
        "Setup": "vislam.experiment.programs",
        "run_comparison": "vislam.experiment.compare",
    },
)
