"""The demonstrations as a table over phase: looked up instead of computed anew."""

from __future__ import annotations

import copy
from collections import OrderedDict

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.filtering.model import View
from torch_ebip.interaction.primitive import InteractionPrimitive

POINTS = 41
"""Phases of the grid: a fortieth of an interaction apart."""
KEPT = 8
"""For how many sets of DoFs that are asked for together a copy is kept."""


class DemonstrationTable(nn.Module):
    """Values and slopes of N demonstrations at P phases, evenly from 0 to 1, and cubic between them.

    The interpolation is Hermite's: it has the values and the slopes of the trajectories at the points of the grid.

    Args:
        values: [N, P, D], units of the DoFs.
        slopes: [N, P, D], by phase.

    Raises:
        ValueError: fewer than two phases, or shapes that differ.

    Example:
        >>> import torch
        >>> from torch_ebip.interaction.table import DemonstrationTable
        >>> phase = torch.linspace(0, 1, 41)
        >>> table = DemonstrationTable(phase.square()[None, :, None], 2 * phase[None, :, None])
        >>> table.at(torch.zeros(1, dtype=torch.long), torch.tensor([[0.33]])).round(decimals=4).tolist()
        [[[0.10890000313520432]]]
    """

    pairs: Tensor

    def __init__(self, values: Tensor, slopes: Tensor) -> None:
        super().__init__()
        if values.ndim != 3 or values.shape[1] < 2 or slopes.shape != values.shape:
            raise ValueError(
                f"values and slopes must be [N, P, D] with at least 2 phases, got {list(values.shape)} and "
                f"{list(slopes.shape)}"
            )
        self._parts: OrderedDict[tuple[int, ...], tuple[Tensor, int, Tensor]] = OrderedDict()
        step = 1 / (values.shape[1] - 1)
        # The values, and the slopes of a cell's length, one after the other: a cell is four rows that lie together.
        self.register_buffer("pairs", owned(torch.stack([values, slopes * step], dim=-2)))

    @classmethod
    def of(cls, primitive: InteractionPrimitive, points: int = POINTS) -> DemonstrationTable:
        """The table of a primitive's demonstrations, as their regressions have them.

        Args:
            primitive: of the demonstrations.
            points: P.
        """
        weights = primitive.weights
        basis = copy.deepcopy(primitive.basis).to(weights)
        phase = torch.linspace(0, 1, points, dtype=weights.dtype, device=weights.device)
        many = weights.unsqueeze(1).expand(-1, points, -1)
        with torch.no_grad():
            return cls(basis.project_paths(phase, weights), basis.project_derivative(phase, many))

    @property
    def n_dofs(self) -> int:
        """D."""
        return self.pairs.shape[-1]

    def at(self, demonstrations: Tensor, phase: Tensor, dofs: Tensor | None = None) -> Tensor:
        """Where demonstrations are at some phases.

        Args:
            demonstrations: int64 [...], which.
            phase: [..., O], within [0, 1].
            dofs: int64 [k], which DoFs; default: all.

        Returns:
            [..., O, k], units of the DoFs; differentiable by phase.
        """
        N, P = self.pairs.shape[:2]
        pairs = self.pairs if dofs is None else self._part(dofs)
        place = phase * (P - 1)
        cell = place.detach().floor().clamp(0, P - 2)
        t = (place - cell).unsqueeze(-1)
        first = (demonstrations.long().unsqueeze(-1) * P + cell.long()).unsqueeze(-1)
        rows = 2 * first + torch.arange(4, device=phase.device)
        corners = pairs.reshape(2 * N * P, -1).index_select(0, rows.reshape(-1)).view(*rows.shape, -1)
        square, cube = t.square(), t * t.square()
        shares = torch.cat(
            [2 * cube - 3 * square + 1, cube - 2 * square + t, 3 * square - 2 * cube, cube - square], -1
        )
        return (shares.unsqueeze(-2) @ corners).squeeze(-2)

    def _part(self, dofs: Tensor) -> Tensor:
        """The pairs of some DoFs, int64 [k]; those asked for lately are kept while the table is the same."""
        if self.pairs.is_inference():
            return self.pairs[..., dofs]
        key = tuple(dofs.tolist())
        source, version, part = self._parts.get(key, (None, 0, None))
        if part is None or source is not self.pairs or version != self.pairs._version:
            part = self.pairs[..., dofs].contiguous()
            self._parts[key] = (self.pairs, self.pairs._version, part)
            if len(self._parts) > KEPT:
                self._parts.popitem(last=False)
        self._parts.move_to_end(key)
        return part

    def select(self, view: View) -> DemonstrationTable:
        """The table of a view of the model: of its DoFs."""
        part = DemonstrationTable.__new__(DemonstrationTable)
        nn.Module.__init__(part)
        part._parts = OrderedDict()
        part.register_buffer("pairs", self.pairs[..., view.dofs])
        return part

    def extra_repr(self) -> str:
        """Sizes."""
        N, P, _, D = self.pairs.shape
        return f"{N} demonstrations, {P} phases, {D} DoFs"

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: nothing beside themselves."""
        return ""
