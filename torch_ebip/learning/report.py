"""How a model came about, and what it is worth: plain values, a table, and a verdict in a line."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from typing import Any

STAGES = ("mean", "nearest", "closed_form", "factor", "start", "gradient", "shrinkage")
"""In the order in which they are reported; the first two are what can be said without a filter."""

CLEAR = 2.5
"""Standard errors that a gain must have: options were chosen on some of the interactions that it is measured on."""


class Report(Mapping[str, Any]):
    """What `learn` says of a model. It is read like a dictionary, printed as a table, and cannot be changed.

    Entries, as far as there is something to say: ``verdict``, ``stages`` (scores by stage: see `STAGES`), ``chosen``
    (the stage whose filter the model has), ``interactions`` (how many were left out to score them),
    ``demonstrations``, ``factor``, ``start``, ``validation`` (loss by step), ``best_step``, ``stopped_early``,
    ``shrinkage`` (shares by target, one for each of `LEADS`), ``basis``, ``settings``, ``versions``, ``seconds``.

    Args:
        content: plain values.

    Example:
        >>> from torch_ebip.learning.report import Report
        >>> Report({"verdict": "better than the training mean"}).verdict
        'better than the training mean'
    """

    def __init__(self, content: Mapping[str, Any]) -> None:
        self._content = copy.deepcopy(dict(content))

    def __getitem__(self, name: str) -> Any:
        return copy.deepcopy(self._content[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def __len__(self) -> int:
        return len(self._content)

    def __repr__(self) -> str:
        return f"Report({self.verdict!r})"

    @property
    def verdict(self) -> str:
        """In one line."""
        return str(self._content.get("verdict", "nothing is known of how this model was made"))

    def plain(self) -> dict[str, Any]:
        """All of it, as JSON can say it."""
        return copy.deepcopy(self._content)

    def __str__(self) -> str:
        stages: Mapping[str, Mapping[str, float]] = self._content.get("stages", {})
        if not stages:
            return self.verdict
        columns = list(dict.fromkeys(key for scores in stages.values() for key in scores if _shown(key)))
        rows = [["stage", *columns]]
        for stage, scores in stages.items():
            name = f"{stage} *" if stage == self._content.get("chosen") else stage
            rows.append([name, *(f"{scores[key]:.4g}" if key in scores else "-" for key in columns)])
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
        ]
        return "\n".join([*lines, self.verdict])


def _shown(key: str) -> bool:
    return key in ("loss", "error", "coverage_95") or key.startswith("mae/")


def verdict_of(
    stages: Mapping[str, Mapping[str, float]],
    chosen: str,
    interactions: int,
    gain: float | None,
    reason: str | None,
) -> str:
    """What the scores of the stages come to.

    Args:
        stages: their scores; ``mean`` and ``nearest`` among them.
        chosen: the stage whose filter was kept.
        interactions: how many were left out.
        gain: standard errors by which the squared error is less than the training mean's; None if nobody looked.
        reason: why there was no gradient, or less of it than was asked for; None if there was.
    """
    last = stages.get("shrinkage", stages[chosen])["error"]
    mean, nearest = stages["mean"]["error"], stages["nearest"]["error"]
    if gain is None:
        said = "not compared"
    elif gain < CLEAR or last >= 0.95 * mean:
        said = "no better than the training mean, as far as so many tell"
    elif last < 0.95 * nearest:
        said = "better than both"
    else:
        said = "better than the training mean, not than the nearest demonstration"
    text = (
        f"{said}: at the end {last:.2f} of the targets' spread off, the training mean {mean:.2f}, the nearest "
        f"demonstration {nearest:.2f}, on {interactions} interactions left out of their ensembles"
    )
    return f"{text}; {reason}" if reason else text
