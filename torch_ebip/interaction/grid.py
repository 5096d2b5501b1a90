"""Tables over phases that lie evenly from 0 to 1, looked up between them."""

from __future__ import annotations

from torch import Tensor, lerp


def between(table: Tensor, phase: Tensor) -> Tensor:
    """Rows of a table [P, k], linearly between its phases, at a phase [...]: [..., k], in the units of the table.

    Differentiable by phase; before 0 and behind 1 as there.
    """
    last = len(table) - 1
    place = phase.clamp(0, 1) * last
    cell = place.detach().floor().clamp(max=last - 1)
    index = cell.long().reshape(-1)
    low, high = table.index_select(0, index), table.index_select(0, index + 1)
    return lerp(low, high, (place - cell).reshape(-1, 1)).view(*phase.shape, -1)
