"""What analogues compare: values and velocities of demonstrations in deviations, and the present in the same."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.common.brief import brief
from torch_ebip.filtering.updates.recent import Line
from torch_ebip.interaction.table import DemonstrationTable

FAR = 5.0
"""Deviations beyond which all is equally far."""


class Compared(NamedTuple):
    """What depends on the demonstrations alone, of k DoFs, N demonstrations and P phases.

    Attributes:
        bank: [P, N, 4 k], f^2 and f of every pair, values before velocities.
        middle, inverse, moved: [2, k], what is taken off, 1 / scale, and whether a DoF moves at all, 0 or 1.
        sensors: [k, S], 1 where a DoF is a sensor's.
        places: [P], phases.
    """

    bank: Tensor
    middle: Tensor
    inverse: Tensor
    moved: Tensor
    sensors: Tensor
    places: Tensor

    def __repr__(self) -> str:
        return brief(self)

    def seen(self, line: Line, dofs: Tensor) -> tuple[Tensor, Tensor]:
        """Of lines [R, D]: x, in deviations, and how much each counts in its sensor, [R, 2, k].

        Args:
            line: what was seen of late.
            dofs: int64 [k], which are compared.
        """
        belief = line.belief
        parts = torch.stack([line.value, line.velocity, belief, belief * line.moves], -2).index_select(-1, dofs)
        x = ((parts[..., :2, :] - self.middle) * self.inverse).clamp(-FAR, FAR)
        here = parts[..., 2:, :] * self.moved
        total = here @ self.sensors @ self.sensors.T  # of each DoF's sensor
        # Of a sensor whose DoFs are all believed alike each has an equal share, together as much as one is believed.
        # Parts are squared, not what is believed, whose square is 0 long before it is.
        part = here / torch.where(total > 0, total, 1)
        return x, here * (part.square() @ self.sensors @ self.sensors.T)


def compared_of(
    table: DemonstrationTable, pace: Tensor, scale: Tensor, dofs: Tensor, modality_of_dof: Tensor
) -> Compared:
    """Of the demonstrations of a table.

    Args:
        table: of N demonstrations, over D DoFs.
        pace: [N], their phase velocities, 1/s.
        scale: [2, k], deviations of values and velocities, units of the DoFs, and a second.
        dofs: int64 [k], which are compared.
        modality_of_dof: int64 [k].
    """
    values = table.values[..., dofs]
    velocities = table.slopes[..., dofs] * pace[:, None, None]
    middle = torch.stack([values.mean((0, 1)), torch.zeros_like(values[0, 0])])
    moved = (scale > 0) & (scale[:1] > 0)  # what stands still has a velocity of rounding alone
    inverse = torch.where(moved, 1 / torch.where(moved, scale, 1), 0)
    both = (torch.stack([values, velocities], -2) - middle) * inverse
    flat = both.clamp(-FAR, FAR).flatten(-2).transpose(0, 1)
    sensors = nn.functional.one_hot(modality_of_dof).to(values)
    places = torch.linspace(0, 1, values.shape[1], dtype=values.dtype, device=values.device)
    bank = torch.cat([flat.square(), flat], -1).contiguous()
    return Compared(bank, middle, inverse, moved.to(values), sensors, places)
