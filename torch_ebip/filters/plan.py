"""How the live path projects members onto the DoFs that are measured together, into buffers that it keeps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.basis.stacked import StackedBasis
from torch_ebip.filters.span import SpanMembers


class _Range(NamedTuple):
    """k neighbouring DoFs that share a basis of F functions."""

    family: int
    weights: Tensor  # view of the members, [..., k, F, E]
    terms: Tensor  # buffer of the same shape
    projections: Tensor  # [..., k, E], view of the plan's


class Plan:
    """What is needed again and again for K DoFs that are measured together.

    Args:
        basis: of the sensors' DoFs.
        span: the members.
        dofs: K of them, numbered as in the filter.
        rows: the same, numbered as in the basis, ascending.
        terms: buffer as large as all weights that sensors see, shared by all plans.

    Attributes:
        dofs, rows: int64 [K].
        projections: HX, [..., K, E].
        right, solved: right-hand sides and solutions, [..., K, E + 1], columns contiguous for LAPACK: of the
            members, and in the last column of the mean.
        anomalies: HA, [..., K, E]; ``anomalies_by_member`` the other way round.
        draws: buffer [..., E, K]; ``draws_by_dof`` the other way round.
        constant: of the log-likelihood, -K / 2 log(2 pi).
        values: buffer [..., K], of what was measured.
        noise: deviations [..., K, 1] and R [..., K, K], once they are known for good.
    """

    def __init__(
        self, basis: StackedBasis, span: SpanMembers, dofs: Sequence[int], rows: Sequence[int], terms: Tensor
    ) -> None:
        like, K = span.matrix, len(rows)
        batch, E = like.shape[:-2], like.shape[-1]
        self.dofs, self.rows = (torch.tensor(numbers, device=like.device) for numbers in (dofs, rows))
        self.values = like.new_empty(*batch, K)
        self.projections = like.new_empty(*batch, K, E)
        self.anomalies = torch.empty_like(self.projections)
        self.anomalies_by_member = self.anomalies.transpose(-1, -2)
        self.draws = like.new_empty(*batch, E, K)
        self.draws_by_dof = self.draws.transpose(-1, -2)
        self.right, self.solved = (like.new_empty(*batch, E + 1, K).transpose(-1, -2) for _ in range(2))
        self.right_members, self.right_mean = self.right[..., :E], self.right[..., E:]
        self.moves, self.shift = self.solved[..., :E], self.solved[..., E:]
        self.one = like.new_ones(())
        self.constant = like.new_tensor(-0.5 * K * math.log(2 * math.pi))
        self.noise: tuple[Tensor, Tensor] | None = None
        self._ranges = []
        self._families = families = basis.families
        for first, last in _neighbours(basis, rows):
            part = slice(basis.weight_slices[rows[first]].start, basis.weight_slices[rows[last - 1]].stop)
            weights = span.seen(part).view(*batch, last - first, -1, E)
            buffer = terms[: weights.numel()].view(weights.shape)
            family = families.index(basis.bases[rows[first]])
            self._ranges.append(_Range(family, weights, buffer, self.projections[..., first:last, :]))

    def project(self, phase: Tensor) -> Tensor:
        """h(x) [..., K, E] of members at phases [..., E]: the plan's buffer, overwritten next time."""
        # Outside the interval a basis has more to do; a look at the extremes is cheaper than doing it in vain.
        low, high = torch.aminmax(phase)
        inside = float(low) >= 0 and float(high) <= 1
        features: dict[int, Tensor] = {}
        for family, weights, terms, projections in self._ranges:
            if family not in features:
                functions = self._families[family]
                found = functions.by_function(phase) if inside else functions(phase).transpose(-1, -2)
                features[family] = found.unsqueeze(-3)
            torch.mul(weights, features[family], out=terms)
            torch.sum(terms, -2, out=projections)
        return self.projections


def _neighbours(basis: StackedBasis, rows: Sequence[int]) -> list[tuple[int, int]]:
    """First and last (exclusive) of runs within ``rows`` that follow each other and share a basis."""
    starts = [
        i
        for i, row in enumerate(rows)
        if i == 0 or row != rows[i - 1] + 1 or basis.bases[row] != basis.bases[rows[i - 1]]
    ]
    return list(zip(starts, [*starts[1:], len(rows)], strict=True))
