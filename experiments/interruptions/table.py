"""What interruptions cost: errors beside those of the same people undisturbed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.interruptions.jobs import FAR, Answers
from experiments.interruptions.kinds import KINDS, RECOVERY, SHOWN
from torch_ebip.common.draws import seeded

BOOTSTRAPS = 2000


def summarise(answers: Answers, unit: str, seed: int) -> list[dict[str, Any]]:
    """A row for each method, kind and moment.

    ``error`` is the mean absolute error of the end, ``ratio`` that over the error of the same method when it had seen
    as much of the same people, undisturbed, with a 95 % interval (bootstrap over people); ``far`` the share of DoFs
    further off than `FAR` deviations, ``deviation`` the median deviation, ``phase_error`` the mean one.
    """
    by_cell: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for answer in answers:
        by_cell.setdefault((answer["method"], answer["kind"], answer["moment"]), []).append(answer)
    generator = np.random.default_rng(seeded(seed).initial_seed())
    rows = []
    for (method, kind, moment), found in by_cell.items():
        pairs = np.array([(a["error"], a["usual"]) for a in found])
        pairs = pairs[np.isfinite(pairs).all(1)]
        draws = pairs[generator.integers(len(pairs), size=(BOOTSTRAPS, len(pairs)))].mean(1)
        low, high = np.quantile(draws[:, 0] / draws[:, 1], [0.025, 0.975])
        rows.append(
            {
                "method": method,
                "kind": kind,
                "moment": moment,
                "n": len(pairs),
                "unit": unit,
                "error": float(pairs[:, 0].mean()),
                "ratio": float(pairs[:, 0].mean() / pairs[:, 1].mean()),
                "low": float(low),
                "high": float(high),
                "far": float(np.mean([a["far"] for a in found])),
                "deviation": float(np.median([a["deviation"] for a in found])),
                "phase_error": float(np.mean([a["phase_error"] for a in found])),
            }
        )
    return rows


def cells(rows: Sequence[Mapping[str, Any]], moment: str) -> tuple[list[str], list[list[str]]]:
    """Heads and lines of a table of one moment: a column a method, in each the ratio and the share far off."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    found = {(row["method"], row["kind"]): row for row in rows if row["moment"] == moment}
    lines = []
    for kind in KINDS:
        there = [found.get((method, kind)) for method in methods]
        if any(row is not None for row in there):
            lines.append([kind, *(_cell(row) for row in there)])
    return ["interruption", *methods], lines


def _cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "-"
    return f"{row['ratio']:.2f} ({row['low']:.2f} to {row['high']:.2f}), {row['far']:.1%}"


TITLES = {
    "late": f"asked when {SHOWN:.0%} of the interaction were seen",
    "after": f"asked {RECOVERY:g} s after the interruption",
    "during": "asked in the middle of the interruption",
}
LEGEND = (
    "mean absolute error of the end over that when as much was seen of the same people, undisturbed, with its 95 % "
    f"interval; share of values further off than {FAR:g} of their deviations"
)


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """All tables."""
    parts = []
    for moment, title in TITLES.items():
        heads, lines = cells(rows, moment)
        body = [f"| {' | '.join(line)} |" for line in lines]
        parts.append("\n".join([f"**{title}**", "", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *body]))
    return "\n\n".join([*parts, LEGEND]) + "\n"


def print_table(rows: Sequence[Mapping[str, Any]]) -> None:
    """All tables, in a terminal."""
    console = Console()
    for moment, title in TITLES.items():
        heads, lines = cells(rows, moment)
        table = Table(title=title, title_justify="left")
        for i, head in enumerate(heads):
            table.add_column(head, justify="right" if i else "left")
        for line in lines:
            table.add_row(*line)
        console.print(table)
    console.print(LEGEND, highlight=False)
