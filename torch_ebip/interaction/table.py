"""The demonstrations as a table over phase: looked up instead of computed anew."""

from __future__ import annotations

import copy
from collections import OrderedDict
from typing import Any

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import outside_inference, owned
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.course import within
from torch_ebip.interaction.primitive import InteractionPrimitive

POINTS = 41
"""Phases of the grid: a fortieth of an interaction apart."""
KEPT = 8
"""For how many sets of DoFs that are asked for together a copy is kept."""


class DemonstrationTable(nn.Module):
    """N demonstrations between P phases, evenly from 0 to 1: a cubic polynomial a cell.

    They are Hermite's: with the values and the slopes of the trajectories at both ends of the cell.

    Args:
        values: [N, P, D], units of the DoFs.
        slopes: [N, P, D], by phase.
        periodic: whether phases are those of a circle.

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

    cells: Tensor

    def __init__(self, values: Tensor, slopes: Tensor, periodic: bool = False) -> None:
        super().__init__()
        self.periodic = periodic
        if values.ndim != 3 or values.shape[1] < 2 or slopes.shape != values.shape:
            raise ValueError(
                f"values and slopes must be [N, P, D] with at least 2 phases, got {list(values.shape)} and "
                f"{list(slopes.shape)}"
            )
        self._parts: OrderedDict[tuple[int, ...], tuple[Tensor, int, Tensor]] = OrderedDict()
        self._spread: tuple[Tensor, int | None, Tensor] | None = None
        step = 1 / (values.shape[1] - 1)
        first, last = values[:, :-1], values[:, 1:]
        start, end, rise = slopes[:, :-1] * step, slopes[:, 1:] * step, last - first
        square = 3 * rise - 2 * start - end
        self.register_buffer("cells", owned(torch.stack([first, start, square, start + end - 2 * rise], dim=-2)))

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
            paths = basis.project_paths(phase, weights)
            return cls(paths, basis.project_derivative(phase, many), basis.periodic)

    @property
    def n_dofs(self) -> int:
        """D."""
        return self.cells.shape[-1]

    @property
    def values(self) -> Tensor:
        """[N, P, D], at the phases of the grid, units of the DoFs."""
        return torch.cat([self.cells[:, :, 0], self.cells[:, -1:].sum(2)], 1)

    @property
    def slopes(self) -> Tensor:
        """[N, P, D], at the phases of the grid, by phase."""
        _, first, second, third = self.cells.unbind(-2)
        last = (first + 2 * second + 3 * third)[:, -1:]
        return torch.cat([first, last], 1) * self.cells.shape[1]

    def at(self, demonstrations: Tensor, phase: Tensor, dofs: Tensor | None = None) -> Tensor:
        """Where demonstrations are at some phases.

        Args:
            demonstrations: int64 [...], which.
            phase: [..., O]; outside [0, 1] as at the nearer end, or on the circle.
            dofs: int64 [k], which DoFs; default: all.

        Returns:
            [..., O, k], units of the DoFs; differentiable by phase.
        """
        N, P = self.cells.shape[:2]
        cells = self.cells if dofs is None else self._part(dofs)
        place = within(phase, self.periodic) * P
        cell = place.detach().floor().clamp(max=P - 1)
        t = (place - cell).unsqueeze(-1)
        rows = torch.add(cell.long(), demonstrations.unsqueeze(-1), alpha=P)
        found = cells.reshape(N * P, -1).index_select(0, rows.reshape(-1)).view(*rows.shape, 4, cells.shape[-1])
        constant, linear, square, cube = found.unbind(-2)
        return torch.addcmul(constant, t, torch.addcmul(linear, t, torch.addcmul(square, t, cube)))

    def spread(self, dofs: Tensor | None = None) -> Tensor:
        """Variance over the demonstrations at the phases of the grid, [P, k], squared units, of DoFs int64 [k]."""
        version = None if self.cells.is_inference() else self.cells._version
        if self._spread is None or version is None or self._spread[0] is not self.cells or self._spread[1] != version:
            values = self.values
            self._spread = self.cells, version, values.var(0, correction=1 if len(values) > 1 else 0)
        spread = outside_inference(self._spread[2])
        return spread if dofs is None else spread[:, dofs]

    def _part(self, dofs: Tensor) -> Tensor:
        """The cells of some DoFs, int64 [k]; those asked for lately are kept while the table is the same."""
        if self.cells.is_inference():
            return self.cells[..., dofs]
        key = tuple(dofs.tolist())
        source, version, part = self._parts.get(key, (None, 0, None))
        if part is None or source is not self.cells or version != self.cells._version:
            part = self.cells[..., dofs].contiguous()
            self._parts[key] = (self.cells, self.cells._version, part)
            if len(self._parts) > KEPT:
                self._parts.popitem(last=False)
        self._parts.move_to_end(key)
        return outside_inference(part)

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have nothing kept: versions of tensors begin anew in them."""
        return {**self.__dict__, "_parts": OrderedDict(), "_spread": None}

    def select(self, view: View) -> DemonstrationTable:
        """The table of a view of the model: of its DoFs."""
        part = DemonstrationTable.__new__(DemonstrationTable)
        nn.Module.__init__(part)
        part._parts = OrderedDict()
        part._spread = None
        part.periodic = self.periodic
        part.register_buffer("cells", self.cells[..., view.dofs])
        return part

    def extra_repr(self) -> str:
        """Sizes."""
        N, P, _, D = self.cells.shape
        return f"{N} demonstrations, {P + 1} phases, {D} DoFs"

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: nothing beside themselves."""
        return ""
