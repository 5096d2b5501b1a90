"""How a model came about, and what it is worth: plain values, a table, and a verdict in a line."""

from __future__ import annotations

import copy
import platform
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from torch_ebip.interaction.basis.stacked import StackedBasis
from torch_ebip.recordings.layout import Layout

STAGES = ("mean", "nearest", "closed_form", "factor", "start", "gradient", "shrinkage", "analogues", "expert")
"""In the order in which they are reported; the first two are what can be said without a filter."""

CLEAR = 2.5
"""Standard errors that a gain must have: options were chosen on some of the interactions that it is measured on."""


BOTH = "better than both"
MEAN = "better than the training mean, not than the nearest demonstration"
NEITHER = "no better than the training mean, as far as so many tell"


class Report(Mapping[str, Any]):
    """What `learn` says of a model. It is read like a dictionary, printed as a table, and cannot be changed.

    Entries, as far as there is something to say: ``verdict``, ``stages`` (scores by stage, of filters before their
    read-out, and of read-outs: see `STAGES`), ``chosen`` (the stage whose filter the model has), ``interactions``
    (how many were left out to score them), ``demonstrations``, ``factor``, ``start``, ``validation`` (loss by step,
    after the read-out), ``best_step``, ``stopped_early``, ``shrinkage`` (mean shares by target and horizon),
    ``analogues`` and ``expert`` (whether they are used, their shares, the CRPS with and without them), ``horizons``,
    ``remarks`` (what was left out, and why), ``surprise`` (what of interactions left out is unusual, and what is then
    said; empty where they were too few), ``pace`` (see `learn_pace`), ``course`` (CRPS with a phase that goes on
    ``once`` and with one on a ``circle``, where demonstrations seem to repeat), ``basis``, ``settings``,
    ``versions``, ``seconds``.

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
        rows = [["stage", *(column.removeprefix("error/") for column in columns)]]
        for stage, scores in stages.items():
            name = f"{stage} *" if stage == self._content.get("chosen") else stage
            rows.append([name, *(f"{scores[key]:.4g}" if key in scores else "-" for key in columns)])
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
        ]
        return "\n".join([*lines, *self._content.get("remarks", ()), self.verdict])


def _shown(key: str) -> bool:
    return key in ("loss", "remaining", "error", "coverage_95") or key.startswith(("error/", "mae/"))


def verdict_of(
    stages: Mapping[str, Mapping[str, float]],
    chosen: str,
    interactions: int,
    gain: Mapping[str, float] | None,
    reason: str | None,
) -> str:
    """What the scores of the stages come to.

    Args:
        stages: their scores; ``mean`` and ``nearest`` among them.
        chosen: the stage whose filter was kept.
        interactions: how many were left out.
        gain: by horizon, standard errors by which the squared error is less than the training mean's; None if nobody
            looked.
        reason: why there was no gradient, or less of it than was asked for; None if there was.
    """
    tried = [stages[name] for name in ("shrinkage", "analogues", "expert") if name in stages]
    last = min(tried, key=lambda scores: scores.get("crps", 0.0)) if tried else stages[chosen]
    mean, nearest = stages["mean"], stages["nearest"]
    if gain is None:
        said = "not compared"
    else:
        kinds: dict[str, list[str]] = {BOTH: [], MEAN: [], NEITHER: []}
        for horizon, errors in gain.items():
            key = f"error/{horizon}"
            if key not in last or key not in mean:
                continue
            if errors < CLEAR or last[key] >= 0.95 * mean[key]:
                kinds[NEITHER].append(horizon)
            elif last[key] < 0.95 * nearest[key]:
                kinds[BOTH].append(horizon)
            else:
                kinds[MEAN].append(horizon)
        there = {kind: horizons for kind, horizons in kinds.items() if horizons}
        said = "; ".join(kind if len(there) == 1 else f"{kind} {_at(horizons)}" for kind, horizons in there.items())
    text = (
        f"{said or 'not compared'}: {last['error']:.2f} of the targets' spread off, the training mean "
        f"{mean['error']:.2f}, the nearest demonstration {nearest['error']:.2f}, on {interactions} interactions left "
        "out of their ensembles"
    )
    return f"{text}; {reason}" if reason else text


def _at(horizons: Sequence[str]) -> str:
    """``at 0.1 s, 0.25 s and the end``."""
    named = ["the end" if horizon == "end" else horizon for horizon in horizons]
    return f"at {named[0]}" if len(named) == 1 else f"at {', '.join(named[:-1])} and {named[-1]}"


def versions() -> dict[str, str]:
    """Of what computed it."""
    return {"python": platform.python_version(), "torch": str(torch.__version__), "numpy": np.__version__}


def described(layout: Layout, basis: StackedBasis) -> dict[str, Any]:
    """Which basis each modality of a layout has, and how many weights all have together."""
    named = {m.name: str(basis.bases[layout.slice(m.name).start]) for m in layout.modalities}
    return {"basis": named, "n_weights": basis.n_weights}
