"""Jumps that look like a turn that was cut: of angles, rotation vectors and quaternions that nobody declared."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from torch_ebip.recordings.layout import Layout

SLACK = 0.05
"""Share of a turn by which a step may be off one."""


def cut_turns(layout: Layout, trajectories: Sequence[Tensor]) -> list[str]:
    """A sentence for each plain modality whose values jump as wrapped rotations do.

    Args:
        layout: what the columns are.
        trajectories: N of [T_i, D].
    """
    said = []
    for modality in layout.modalities:
        if modality.kind != "plain":
            continue
        part = layout.slice(modality.name)
        steps = [trajectory[:, part] for trajectory in trajectories]
        for i, dof in enumerate(modality.dofs):
            if any(_whole_turn(values[:, i]) for values in steps):
                said.append(f"{dof} jumps by a whole turn: is it an angle? Say kind='angle'")
        if len(modality.dofs) == 4 and any(_flips(values) for values in steps):
            said.append(
                f"{modality.name} changes its sign: is it a quaternion? Keep q and -q apart before it is learned"
            )
        if len(modality.dofs) == 3 and any(_turned_over(values) for values in steps):
            said.append(
                f"{modality.name} turns over at a half turn: is it a rotation vector? Make it continuous before"
            )
    return said


def warn_of_cut_turns(layout: Layout, trajectories: Sequence[Tensor]) -> None:
    """Warn of all that `cut_turns` finds: they cannot be learned as they are.

    Args:
        layout: what the columns are.
        trajectories: N of [T_i, D].
    """
    said = cut_turns(layout, trajectories)
    if said:
        warnings.warn("; ".join(said), stacklevel=3)


def _whole_turn(values: Tensor) -> bool:
    """A step of 2 pi, of values [T] that are within a turn otherwise."""
    steps = values[~values.isnan()].diff().abs()
    turns = (steps - 2 * math.pi).abs() < SLACK * 2 * math.pi
    return bool(turns.any()) and bool((steps[~turns] < math.pi / 2).all())


def _rows(values: Tensor) -> Tensor:
    return values[~values.isnan().any(-1)]


def _flips(values: Tensor) -> bool:
    """Unit vectors [T, 4] of which one is about minus the one before."""
    rows = _rows(values)
    norms = rows.norm(dim=-1)
    unit = len(rows) > 1 and bool(((norms - 1).abs() < 0.02).all())
    return unit and bool(((rows[1:] + rows[:-1]).norm(dim=-1) < 0.3).any())


def _turned_over(values: Tensor) -> bool:
    """Vectors [T, 3] of which one is about the one before less a turn about it."""
    rows = _rows(values)
    if len(rows) < 2:
        return False
    steps, norms = rows.diff(dim=0).norm(dim=-1), rows.norm(dim=-1)
    turns = ((steps - 2 * math.pi).abs() < SLACK * 2 * math.pi) & (norms[1:] < math.pi + 0.1)
    whole = torch.stack([rows.diff(dim=0)[:, i].abs() for i in range(3)], -1).amax(-1) > 2 * math.pi * (1 - SLACK)
    return bool((turns & ~whole).any()) and bool((norms < math.pi + 0.1).all())
