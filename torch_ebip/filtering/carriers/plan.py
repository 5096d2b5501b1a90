"""Buffers of the live path for the DoFs that are measured together, kept from step to step."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from torch_ebip.filtering.carriers.columns import ColumnMembers
from torch_ebip.filtering.carriers.serving import ProjectsColumns

Made = TypeVar("Made")
PLANS = 64
"""For how many sets of measured DoFs buffers are kept; the set not used for longest is dropped."""


class Plan:
    """What is needed again and again for K DoFs that are measured together.

    Args:
        measurement: of the sensors' DoFs.
        members: that it projects.
        centre: [..., k], to which what stands still of them are deviations.
        dofs: K of them, numbered as in the filter.
        rows: the same, numbered as in the measurement, ascending.
        terms: memory shared by all plans.

    Attributes:
        dofs, rows: int64 [K].
        projections: HX, [..., K, E].
        mean: buffer [..., K] of its mean; ``mean_by_dof`` the same as a column.
        residual: buffer of y - mean HX, [..., K, 1].
        solver: the last five fields of `Columns`.
        anomalies: HA, [..., K, E]; ``anomalies_by_member`` the other way round.
        draws: buffer [..., E, K]; ``draws_by_dof`` the other way round.
        constant: of the log-likelihood, -K / 2 log(2 pi).
        values: buffer [..., K], of what was measured; ``values_by_dof`` the same as a column, [..., K, 1].
        noise: deviations [..., K], the same as a column, and R, [..., K, K], while they stay as they are.
    """

    def __init__(
        self,
        measurement: ProjectsColumns,
        members: ColumnMembers,
        centre: Tensor,
        dofs: Sequence[int],
        rows: Sequence[int],
        terms: Tensor,
    ) -> None:
        like, K = members.matrix, len(rows)
        batch, E = like.shape[:-2], like.shape[-1]
        self.dofs, self.rows = (torch.tensor(numbers, device=like.device) for numbers in (dofs, rows))
        self.values = like.new_empty(*batch, K)
        self.values_by_dof = self.values.unsqueeze(-1)
        self.projections = like.new_empty(*batch, K, E)
        self.anomalies = torch.empty_like(self.projections)
        self.mean_by_dof = like.new_empty(*batch, K, 1)
        self.mean = self.mean_by_dof.squeeze(-1)
        self.anomalies_by_member = self.anomalies.transpose(-1, -2)
        self.draws = like.new_empty(*batch, E, K)
        self.draws_by_dof = self.draws.transpose(-1, -2)
        right, solved = (like.new_empty(*batch, E + 1, K).transpose(-1, -2) for _ in range(2))
        self.residual = right[..., E:]
        self.solver = (right, solved, right[..., :E], solved[..., :E], solved[..., E:])
        self.one = like.new_ones(())
        self.constant = like.new_tensor(-0.5 * K * math.log(2 * math.pi))
        self.noise: tuple[Tensor, Tensor, Tensor] | None = None
        self._project = measurement.projector(members, centre, rows, self.projections, terms)

    def project(self) -> Tensor:
        """h(x) [..., K, E] of the members as they are: the plan's buffer, overwritten next time."""
        self._project()
        return self.projections

    def believe(self, deviations: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Deviations, the same as a column, and R, of the deviations [..., D] of all of the sensors' DoFs."""
        deviation = deviations[..., self.rows]
        R = torch.diag_embed(deviation.square())
        return deviation, deviation.unsqueeze(-1), R.expand(*self.values.shape[:-1], *R.shape[-2:])

    def log_likelihood(self, factor: Tensor, residual: Tensor, shift: Tensor, seen: Tensor | None) -> Tensor:
        """Log-likelihood [...] of a sample.

        Args:
            factor: Cholesky factor of S, [..., K, K].
            residual: y - mean HX, [..., K, 1].
            shift: S^-1 times it.
            seen: bool [B, K, 1], what each entry of the batch measured; None for all.

        Raises:
            ValueError: a value that was measured is NaN or infinite.
        """
        diagonal = factor.diagonal(dim1=-2, dim2=-1)
        if self.values.ndim > 1:
            distance = (residual * shift).sum((-1, -2))
            constant = self.constant if seen is None else self.constant * seen.to(residual).mean((-1, -2))
            likelihood = torch.sub(constant, torch.add(diagonal.log().sum(-1), distance, alpha=0.5))
            finite = bool(likelihood.isfinite().all())
        else:  # a few numbers: faster in Python than in kernels
            deviance = float(torch.dot(residual.view(-1), shift.view(-1)))
            finite = math.isfinite(deviance)
            deviance = sum(map(math.log, diagonal.tolist())) + 0.5 * deviance if finite else math.nan
            finite = math.isfinite(deviance)  # an S that overflowed has a factor, too
            likelihood = torch.sub(self.constant, self.one, alpha=deviance)
        if not finite:
            self.check_finite(seen)
            raise ValueError("the likelihood of a sample is not finite: the members are not, or y is out of range")
        return likelihood

    def check_finite(self, seen: Tensor | None) -> None:
        """Raise ValueError if a value that was measured, bool [B, K, 1], is NaN or infinite."""
        if seen is None and math.isfinite(float(self.values.sum())):
            return
        infinite = ~self.values.isfinite() if seen is None else ~self.values.isfinite() & seen[..., 0]
        if bool(infinite.any()):
            bad = self.dofs[infinite.reshape(-1, len(self.dofs)).any(0)].tolist()
            raise ValueError(f"y is NaN or infinite where it is observed, in DoFs {bad[:8]}; mark it False there")

    @staticmethod
    def without(seen: Tensor, deviation: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
        """Deviations and R where rows that are not seen, bool [B, K, 1], have no noise and 1 on R's diagonal."""
        one = torch.eye(R.shape[-1], dtype=R.dtype, device=R.device)
        return torch.where(seen, deviation, 0), torch.where(seen, R, one)


def kept(
    store: OrderedDict[tuple[bool, ...], Made], key: tuple[bool, ...], make: Callable[[tuple[bool, ...]], Made]
) -> Made:
    """What was made for a key before, or made now. (A cached method would keep its object alive.)"""
    if key not in store:
        store[key] = make(key)
        if len(store) > PLANS:
            store.popitem(last=False)
    store.move_to_end(key)
    return store[key]


class Plans:
    """A plan for each set of DoFs that are measured together; those used lately are kept.

    Args:
        measurement: of the sensors' DoFs.
        members: that it projects.
        centre: [..., k], see `Plan`.
        sensors: the DoFs that may be measured, ascending.
        terms: memory shared by all plans.
    """

    def __init__(
        self,
        measurement: ProjectsColumns,
        members: ColumnMembers,
        centre: Tensor,
        sensors: Sequence[int],
        terms: Tensor,
    ) -> None:
        self._parts = measurement, members, centre, terms
        self._rows = {dof: row for row, dof in enumerate(sensors)}
        self._kept: OrderedDict[tuple[bool, ...], Plan | None] = OrderedDict()

    def of(self, measured: tuple[bool, ...]) -> Plan | None:
        """That of some DoFs, a bool for each of the filter's; None for none.

        Raises:
            ValueError: a DoF that may not be measured.
        """
        return kept(self._kept, measured, self._make)

    def forget_noise(self) -> None:
        """R is another one."""
        for plan in self._kept.values():
            if plan is not None:
                plan.noise = None

    def _make(self, measured: tuple[bool, ...]) -> Plan | None:
        dofs = [dof for dof, here in enumerate(measured) if here]
        strangers = [dof for dof in dofs if dof not in self._rows]
        if strangers:
            raise ValueError(
                f"DoFs {strangers[:8]} are measured, but are none of those this live filter was made for"
            )
        measurement, members, centre, terms = self._parts
        rows = [self._rows[dof] for dof in dofs]
        return Plan(measurement, members, centre, dofs, rows, terms) if dofs else None
