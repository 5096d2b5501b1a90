"""A look at recordings before anything is learned from them: what is there, what is missing, what looks wrong."""

from __future__ import annotations

import html
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from torch import Tensor

from torch_ebip.recordings.copies import copies
from torch_ebip.recordings.jumps import cut_turns
from torch_ebip.recordings.layout import Layout

FEW = 20
"""Demonstrations below which `learn` leaves parts of the recipe out."""
LARGE = {"m": (20.0, "is it in mm?"), "rad": (4 * math.pi, "is it in degrees?")}
"""Sizes beyond which values in a unit are hardly of people and robots, and what they might be."""
LONG = 0.25
"""s, of a gap that is worth a word."""
SLOW = 0.5
"""Share of samples that repeat the one before, beyond which a sensor is slower than the rate says."""
HEADS = ("DoF", "unit", "least", "most", "not measured", "longest gap [s]")


class DofLook(NamedTuple):
    """One degree of freedom.

    Attributes:
        name, unit: of it.
        least, most: of all its values; NaN if it was never measured.
        missing: share of its samples that were not measured.
        gap: the longest time between two of them, s, that is longer than a step; 0 if there is none.
        still: whether it never moves.
        repeats: share of its samples that are the one before, to the last digit.
    """

    name: str
    unit: str
    least: float
    most: float
    missing: float
    gap: float
    still: bool
    repeats: float


@dataclass(frozen=True, repr=False)
class RecordingsReport:
    """What `Demonstrations.report` finds; as text when printed, as a table in a notebook.

    Attributes:
        count: N demonstrations.
        rate: samples a second, Hz.
        durations: the shortest, the median and the longest, s.
        labels: how many demonstrations have each.
        dofs: one entry a DoF.
        warnings: a sentence each.
    """

    count: int
    rate: float
    durations: tuple[float, float, float]
    labels: dict[str, int]
    dofs: tuple[DofLook, ...]
    warnings: tuple[str, ...]

    def __str__(self) -> str:
        rows = [HEADS, *self._rows()]
        widths = [max(len(row[i]) for row in rows) for i in range(len(HEADS))]
        pads = [str.ljust, str.ljust, *[str.rjust] * (len(HEADS) - 2)]
        lines = [
            "  ".join(pad(cell, width) for pad, cell, width in zip(pads, row, widths, strict=True)).rstrip()
            for row in rows
        ]
        return "\n".join([self._head(), *lines, *(f"! {warning}" for warning in self.warnings)])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """For notebooks."""
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in HEADS)
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in self._rows()
        )
        said = "".join(f"<li>{html.escape(warning)}</li>" for warning in self.warnings)
        return f"<p>{html.escape(self._head())}</p><table><tr>{head}</tr>{rows}</table><ul>{said}</ul>"

    def _head(self) -> str:
        least, middle, most = self.durations
        labels = "; ".join(f"{count} {label}" for label, count in self.labels.items())
        lasting = f"{least:.3g} to {most:.3g} s, half of them {middle:.3g} s or less"
        return f"{self.count} demonstrations at {self.rate:g} Hz, {lasting}" + (f"; {labels}" if labels else "")

    def _rows(self) -> list[tuple[str, ...]]:
        return [
            (
                dof.name,
                dof.unit,
                f"{dof.least:.4g}",
                f"{dof.most:.4g}",
                f"{100 * dof.missing:.1f} %",
                f"{dof.gap:.2f}" if dof.gap else "-",
            )
            for dof in self.dofs
        ]


def look(
    layout: Layout, trajectories: Sequence[Tensor], rate: float, labels: Sequence[str] | None, remarks: Sequence[str]
) -> RecordingsReport:
    """See `Demonstrations.report`.

    Args:
        layout: what the columns are.
        trajectories: N of [T_i, D].
        rate: samples a second, Hz.
        labels: one a demonstration.
        remarks: of who read them.
    """
    lasting = sorted((len(trajectory) - 1) / rate for trajectory in trajectories)
    values = [trajectory.detach().double().cpu().numpy() for trajectory in trajectories]
    dofs = tuple(
        _dof(name, unit, [each[:, i] for each in values], rate)
        for i, (name, unit) in enumerate(zip(layout.dofs, layout.units, strict=True))
    )
    said = [*remarks, *cut_turns(layout, trajectories), *_odd(layout, dofs)]
    if alike := copies(trajectories):
        some = "; ".join(", ".join(map(str, each)) for each in alike[:5])
        said.append(f"demonstrations are there more than once: {some}{'; ...' if alike[5:] else ''}")
    if len(trajectories) < FEW:
        said.append(f"{len(trajectories)} demonstrations are few: from {FEW} on `learn` uses all that it has")
    if lasting[-1] > 5 * lasting[len(lasting) // 2]:
        said.append(f"the longest lasts {lasting[-1]:.3g} s, five times as long as half of them: were all cut alike?")
    return RecordingsReport(
        len(trajectories), rate, (lasting[0], lasting[len(lasting) // 2], lasting[-1]), dict(Counter(labels or ())),
        dofs, tuple(said),
    )  # fmt: skip


def _dof(name: str, unit: str, columns: list[np.ndarray], rate: float) -> DofLook:
    """One degree of freedom, of columns [T_i]."""
    together = np.concatenate(columns)
    said = together[~np.isnan(together)]
    gaps = [np.diff(np.flatnonzero(~np.isnan(column))) for column in columns]
    gap = max((int(each.max()) for each in gaps if len(each)), default=1)
    repeats = [np.diff(column[~np.isnan(column)]) == 0 for column in columns]
    return DofLook(
        name, unit,
        float(said.min()) if len(said) else math.nan, float(said.max()) if len(said) else math.nan,
        1 - len(said) / len(together),
        gap / rate if gap > 1 else 0.0,
        bool(len(said)) and bool(said.min() == said.max()),
        float(np.concatenate(repeats).mean()) if sum(map(len, repeats)) else 0.0,
    )  # fmt: skip


def _odd(layout: Layout, dofs: Sequence[DofLook]) -> list[str]:
    """What is odd about DoFs, those of a modality together."""
    said = []
    for modality in layout.modalities:
        mine = [dof for dof in dofs if dof.name in modality.dofs]
        for what, which in (
            ("never measured", [d for d in mine if d.missing == 1]),
            ("never moves", [d for d in mine if d.still]),
        ):
            if which:
                said.append(f"{modality.name}: {', '.join(d.name for d in which[:5])} {what}")
        gap = max(d.gap for d in mine)
        if gap > LONG:
            said.append(f"{modality.name}: up to {gap:.2f} s without a value")
        repeats = min(d.repeats for d in mine)
        if repeats > SLOW and not all(d.still for d in mine):
            said.append(
                f"{modality.name}: {100 * repeats:.0f} % of its samples are the one before: slower than the rate?"
            )
        limit, guess = LARGE.get(modality.unit, (math.inf, ""))
        size = max((max(abs(d.least), abs(d.most)) for d in mine if d.missing < 1), default=0.0)
        if size > limit and modality.kind == "plain":
            said.append(f"{modality.name}: values up to {size:.3g} {modality.unit}: {guess}")
    return said
