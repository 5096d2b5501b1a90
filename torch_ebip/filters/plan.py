"""How the live path projects members onto the DoFs that are measured together, into buffers that it keeps."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from torch_ebip.basis.stacked import StackedBasis
from torch_ebip.filters.span import SpanMembers

Made = TypeVar("Made")
PLANS = 64
"""For how many sets of measured DoFs buffers are kept; the set not used for longest is dropped."""


class _Range(NamedTuple):
    """k neighbouring DoFs that share a basis of F functions."""

    family: int
    weights: Tensor  # view of the members, [..., k, F, E]
    centre: Tensor | None  # to which they are deviations, [..., k, F]; None where it is 0
    terms: Tensor  # buffer of the same shape
    projections: Tensor  # [..., k, E], view of the plan's


class Plan:
    """What is needed again and again for K DoFs that are measured together.

    Args:
        basis: of the sensors' DoFs.
        span: the members.
        centre: [..., n_weights] of the basis, to which they are deviations.
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
    """

    def __init__(
        self,
        basis: StackedBasis,
        span: SpanMembers,
        centre: Tensor,
        dofs: Sequence[int],
        rows: Sequence[int],
        terms: Tensor,
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
        self._add_product: Callable[..., Tensor] = Tensor.baddbmm_ if batch else Tensor.addmm_
        self.one = like.new_ones(())
        self.constant = like.new_tensor(-0.5 * K * math.log(2 * math.pi))
        self._noise: tuple[Tensor, Tensor] | None = None
        self._ranges = []
        self._families = families = basis.families
        for first, last in _neighbours(basis, rows):
            part = slice(basis.weight_slices[rows[first]].start, basis.weight_slices[rows[last - 1]].stop)
            weights = span.seen(part).view(*batch, last - first, -1, E)
            buffer = terms[: weights.numel()].view(weights.shape)
            family = families.index(basis.bases[rows[first]])
            middle = centre[..., part].reshape(*batch, last - first, -1)
            somewhere = middle if bool(middle.any()) else None
            self._ranges.append(_Range(family, weights, somewhere, buffer, self.projections[..., first:last, :]))

    def project(self, phase: Tensor) -> Tensor:
        """h(x) [..., K, E] of members at phases [..., E]: the plan's buffer, overwritten next time."""
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
        return self.projections

    def measurement_noise(self, deviations: Callable[[], tuple[Tensor, bool]]) -> tuple[Tensor, Tensor]:
        """Deviations as a column, [..., K, 1], and R, [..., K, K]; asked for once if they do not change with phase.

        Args:
            deviations: gives those of all sensors' DoFs, [..., D], and whether they change.
        """
        if self._noise is not None:
            return self._noise
        every, changing = deviations()
        deviation = every[..., self.rows]
        R = torch.diag_embed(deviation.square())
        noise = deviation.unsqueeze(-1), R.expand(*self.values.shape[:-1], *R.shape[-2:])
        self._noise = None if changing else noise
        return noise

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
        infinite = ~self.values.isfinite() if seen is None else ~self.values.isfinite() & seen[..., 0]
        if bool(infinite.any()):
            bad = self.dofs[infinite.reshape(-1, len(self.dofs)).any(0)].tolist()
            raise ValueError(f"y is NaN or infinite where it is observed, in DoFs {bad[:8]}; mark it False there")

    @staticmethod
    def without(seen: Tensor, deviation: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
        """Deviations and R where rows that are not seen, bool [B, K, 1], have no noise and 1 on R's diagonal."""
        one = torch.eye(R.shape[-1], dtype=R.dtype, device=R.device)
        return torch.where(seen, deviation, 0), torch.where(seen, R, one)


def _neighbours(basis: StackedBasis, rows: Sequence[int]) -> list[tuple[int, int]]:
    """First and last (exclusive) of runs within ``rows`` that follow each other and share a basis."""
    starts = [
        i
        for i, row in enumerate(rows)
        if i == 0 or row != rows[i - 1] + 1 or basis.bases[row] != basis.bases[rows[i - 1]]
    ]
    return list(zip(starts, [*starts[1:], len(rows)], strict=True))


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


def measured_dofs(
    y: Tensor, observed: Tensor | None, like: Tensor, batch_shape: tuple[int, ...], n_dofs: int
) -> tuple[tuple[bool, ...], Tensor | None]:
    """Which DoFs were measured by some entry of the batch; and by which, bool [B, D], if not by all.

    Raises:
        ValueError: wrong shapes, dtypes or devices.
    """
    shape = (*batch_shape, n_dofs)
    if y.dtype != like.dtype or y.device != like.device:
        raise ValueError(f"y must be {like.dtype} on {like.device}, as the filter is, got {y.dtype} on {y.device}")
    if y.shape != shape:
        raise ValueError(f"y must be {list(shape)}, one value for each DoF, got {list(y.shape)}")
    if observed is None:
        observed = y == y  # not where it is NaN
    elif observed.dtype != torch.bool or observed.shape != shape:
        raise ValueError(f"observed must be bool {list(shape)}, got {observed.dtype} {list(observed.shape)}")
    if not batch_shape:
        return tuple(observed.tolist()), None
    some = observed.any(0)
    mask = None if bool((observed == some).all()) else observed
    return tuple(some.tolist()), mask
