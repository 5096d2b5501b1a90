"""h of an interaction: each member's weights through the basis at its own phase."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.common.brief import brief
from torch_ebip.common.modules import FastTwins, sharing
from torch_ebip.filtering.carriers.columns import ColumnMembers
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.basis.stacked import StackedBasis


class BasisProjection(FastTwins, nn.Module):
    """h(x): the paper's observation function.

    Args:
        basis: one basis a DoF.
        moving: m, how many entries of a state come before the weights, the phase first.
    """

    twins: ClassVar[dict[str, tuple[str, ...]]] = {
        "forward": ("rows", "projector", "jacobian"),
        "rows": ("projector", "jacobian"),
    }

    def __init__(self, basis: StackedBasis, moving: int = 2) -> None:
        super().__init__()
        self.basis = basis
        self.moving = moving

    def forward(self, members: Tensor) -> Tensor:
        """Projections [..., E, D] of members [..., E, n]."""
        moving, still = torch.split(members, [self.moving, members.shape[-1] - self.moving], dim=-1)
        return self._rows(moving, still, None, None)

    def rows(self, moving: Tensor, still: Tensor, dofs: Sequence[int] | None, centre: Tensor | None = None) -> Tensor:
        """Projections [..., E, k] of members, of some dofs.

        Args:
            moving: [..., E, m].
            still: weights, [..., E, n_weights].
            dofs: ascending indices; None for all.
            centre: [..., n_weights], to which the weights are deviations; default: they are none.
        """
        return self._rows(moving, still, dofs, centre)

    def _rows(self, moving: Tensor, still: Tensor, dofs: Sequence[int] | None, centre: Tensor | None) -> Tensor:
        return self.basis.project(moving[..., 0], still, dofs, centre)

    def at(self, members: Tensor, phase: Tensor) -> Tensor:
        """Projections [..., P, E, D] of members [..., E, n] at points of phase [..., P] that all of them share."""
        return self.basis.project_paths(phase.unsqueeze(-2), members[..., self.moving :]).transpose(-2, -3)

    def entries(self, dofs: Tensor) -> Tensor:
        """int64 [k]: where in a state the weights of some DoFs are, bool [D]."""
        return self.moving + dofs[self.basis.dof_of_weight().to(dofs.device)].nonzero().squeeze(-1)

    def select(self, view: View) -> BasisProjection:
        """The same for a view of the model."""
        dofs = torch.zeros(self.basis.n_dofs, dtype=torch.bool, device="cpu")
        dofs[view.dofs.cpu()] = True
        part = sharing(self)
        part.basis = self.basis.select(dofs)
        return part

    def jacobian(self, mean: Tensor) -> Callable[[Tensor], Tensor]:
        """The product with H', [..., k, n] -> [..., k, D], at a mean [..., n]: the paper's equation of H_t.

        Each row of H has the phase and the weights of its own DoF only: one multiplication an entry.
        """
        basis, m = self.basis, self.moving
        phase = mean[..., 0]
        slope = basis.project_derivative(phase, mean[..., m:]).unsqueeze(-2)

        def product(matrix: Tensor) -> Tensor:
            """matrix H'."""
            return matrix[..., :1] * slope + basis.project_rows(phase, matrix[..., m:])

        return product

    def projector(
        self, members: ColumnMembers, centre: Tensor, rows: Sequence[int], out: Tensor, terms: Tensor
    ) -> Callable[[], None]:
        """See `torch_ebip.filtering.carriers.serving.ProjectsColumns`.

        Args:
            members: changed in place by their carrier.
            centre: [..., n_weights], to which their weights are deviations.
            rows: which DoFs, ascending.
            out: [..., K, E], where the projections go.
            terms: [B k E], memory for as many numbers as the weights are.
        """
        return _Projector(self.basis, members, centre, rows, out, terms)


class _Range(NamedTuple):
    """k neighbouring DoFs that share a basis of F functions."""

    family: int
    weights: Tensor  # view of the members, [..., k, F, E]
    centre: Tensor | None  # to which they are deviations, [..., k, F]; None where it is 0
    terms: Tensor  # buffer of the same shape
    projections: Tensor  # [..., k, E], view of the buffer

    def __repr__(self) -> str:
        return brief(self)


class _Projector:
    """Projects members that are columns, each range of neighbouring DoFs at once."""

    def __init__(
        self,
        basis: StackedBasis,
        members: ColumnMembers,
        centre: Tensor,
        rows: Sequence[int],
        out: Tensor,
        terms: Tensor,
    ) -> None:
        batch, E = out.shape[:-2], out.shape[-1]
        self._phase = members.moving[..., 0, :]
        self._add_product: Callable[..., Tensor] = Tensor.baddbmm_ if batch else Tensor.addmm_
        self._ranges = []
        self._families = families = basis.families
        for first, last in _neighbours(basis, rows):
            part = slice(basis.weight_slices[rows[first]].start, basis.weight_slices[rows[last - 1]].stop)
            weights = members.seen(part).view(*batch, last - first, -1, E)
            buffer = terms[: weights.numel()].view(weights.shape)
            family = families.index(basis.bases[rows[first]])
            middle = centre[..., part].reshape(*batch, last - first, -1)
            somewhere = middle if bool(middle.any()) else None
            self._ranges.append(_Range(family, weights, somewhere, buffer, out[..., first:last, :]))

    def __call__(self) -> None:
        """Write h(x) of the members as they are."""
        phase = self._phase
        # Outside the interval a basis has more to do; a look at the extremes is cheaper than doing it in vain.
        low, high = torch.aminmax(phase)
        inside = float(low) >= 0 and float(high) <= 1
        features: dict[int, Tensor] = {}
        for family, weights, centre, terms, projections in self._ranges:
            if family not in features:
                functions = self._families[family]
                features[family] = functions.by_function(phase) if inside else functions(phase).transpose(-1, -2)
            torch.mul(weights, features[family].unsqueeze(-3), out=terms)
            torch.sum(terms, -2, out=projections)
            if centre is not None:
                self._add_product(projections, centre, features[family])


def _neighbours(basis: StackedBasis, rows: Sequence[int]) -> list[tuple[int, int]]:
    """First and last (exclusive) of runs within ``rows`` that follow each other and share a basis."""
    starts = [
        i
        for i, row in enumerate(rows)
        if i == 0 or row != rows[i - 1] + 1 or basis.bases[row] != basis.bases[rows[i - 1]]
    ]
    return list(zip(starts, [*starts[1:], len(rows)], strict=True))
