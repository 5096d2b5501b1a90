"""What a phase on a circle is worth: errors of both, and their ratio."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.cyclic.jobs import AHEAD, METHODS, Answers
from torch_ebip.common.draws import seeded

BOOTSTRAPS = 2000
PAIRS = {"ebip_tuned": "tuned_once", "ebip_circle": "ebip_once"}
"""Methods with a phase on a circle, and the same with one that goes on once."""
LEGEND = (
    "root mean squared error of the partner's hand, cm; over that of the same method with a phase that goes on once, "
    "with its 95 % interval (bootstrap over people); inside: share within 95 % intervals; phase: root mean squared "
    "error on the circle, in cycles"
)


def summarise(answers: Answers, seed: int) -> list[dict[str, Any]]:
    """A row for each method, beginning and horizon."""
    cells: dict[tuple[str, str, float], list[dict[str, Any]]] = {}
    for answer in answers:
        cells.setdefault((answer["beginning"], answer["method"], answer["ahead"]), []).append(answer)
    generator = np.random.default_rng(seeded(seed).initial_seed())
    rows = []
    for (beginning, method, ahead), found in cells.items():
        squares = np.array([answer["squared"] for answer in found])
        row = {
            "beginning": beginning,
            "method": method,
            "ahead": ahead,
            "n": len(found),
            "unit": "m",
            "error": float(np.sqrt(squares.mean())),
            "inside": float(np.mean([answer["inside"] for answer in found])),
        }
        if "phase" in found[0]:
            row["phase_error"] = float(np.sqrt(np.mean([answer["phase"] for answer in found])))
        if method in PAIRS:
            others = np.array([answer["squared"] for answer in cells[beginning, PAIRS[method], ahead]])
            which = generator.integers(len(squares), size=(BOOTSTRAPS, len(squares)))
            ratios = np.sqrt(squares[which].mean(1) / others[which].mean(1))
            low, high = np.quantile(ratios, [0.025, 0.975])
            row |= {"ratio": float(np.sqrt(squares.mean() / others.mean())), "low": float(low), "high": float(high)}
        rows.append(row)
    return rows


def lines_of(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Heads and lines."""
    found = {(row["beginning"], row["method"], row["ahead"]): row for row in rows}
    lines = []
    for beginning in dict.fromkeys(row["beginning"] for row in rows):
        for method in METHODS:
            there = [found[beginning, method, ahead] for ahead in AHEAD]
            phase = there[0].get("phase_error")
            lines.append(
                [
                    beginning,
                    method,
                    *(_cell(row) for row in there),
                    f"{np.mean([row['inside'] for row in there]):.1%}",
                    "-" if phase is None else f"{phase:.3f}",
                ]
            )
    return ["begun", "method", *(f"{ahead:g} s ahead" for ahead in AHEAD), "inside", "phase"], lines


def _cell(row: Mapping[str, Any]) -> str:
    error = f"{100 * row['error']:.2f}"
    return f"{error}; {row['ratio']:.2f} ({row['low']:.2f} to {row['high']:.2f})" if "ratio" in row else error


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table."""
    heads, lines = lines_of(rows)
    body = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *body, "", LEGEND]) + "\n"


def print_table(rows: Sequence[Mapping[str, Any]]) -> None:
    """The table, in a terminal."""
    heads, lines = lines_of(rows)
    table = Table()
    for i, head in enumerate(heads):
        table.add_column(head, justify="right" if i > 1 else "left")
    for line in lines:
        table.add_row(*line)
    Console().print(table)
    Console().print(LEGEND, highlight=False)
