"""Draw the paper's figure, ATE of filter, graph and batch, from the table of docs/ekf_vs_graph.md."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).resolve().parent
MARKS = {"tight filter": "o", "tight graph, causal": "s", "tight graph, final": "^", "batch": "D"}
TICKS_MM = [2, 3, 5, 10, 20, 30]


def table(page: str) -> tuple[list[str], dict[str, list[float]]]:
    """Return the sequences of the page's first table, and ATE [m] by each estimate's name."""
    rows = [line.strip("| ").split("|") for line in page.splitlines() if line.startswith("| ")]
    names, *rest = [[re.sub(r"[* ]+$|^[* ]+", "", cell) for cell in row] for row in rows]
    rest = [row for row in rest if len(row) == len(names)]
    return [row[0] for row in rest], {name: [float(row[n]) for row in rest] for n, name in enumerate(names) if n}


def main() -> None:
    """Write figure.png beside this file."""
    sequences, errors = table((HERE.parent / "docs" / "ekf_vs_graph.md").read_text(encoding="utf-8"))
    figure, axes = plt.subplots(figsize=(6.4, 3.9), constrained_layout=True)
    for (name, mark), shift in zip(MARKS.items(), (-0.24, -0.08, 0.08, 0.24), strict=True):
        axes.plot(
            [1e3 * ate_m for ate_m in errors[name]], [n + shift for n in range(len(sequences))], mark, ms=5, label=name
        )
    axes.set_yticks(range(len(sequences)), sequences)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xticks(TICKS_MM, [str(tick) for tick in TICKS_MM])
    axes.minorticks_off()
    axes.set_xlabel("ATE [mm]")
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=4, fontsize=8)
    figure.savefig(HERE / "figure.png", dpi=150, metadata={"Software": None})


if __name__ == "__main__":
    main()
