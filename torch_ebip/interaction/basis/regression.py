"""Least squares of every demonstration and DoF on a basis, in one batch (the paper's Section III-A)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief
from torch_ebip.interaction.basis.base import Basis
from torch_ebip.interaction.basis.stacked import StackedBasis
from torch_ebip.interaction.cycles import cycles_of
from torch_ebip.recordings.demonstrations import Demonstrations

GAP_WEIGHT = 1e-4
"""Weight of a sample that was not measured; a measured one has 1."""


class Samples(NamedTuple):
    """Demonstrations as one float64 batch with their gaps filled, ready for regression.

    Attributes:
        phase: [N, T], from 0 at the first sample to 1 at the last, and in the padding; or in cycles.
        values: [N, T, D]; gaps are interpolated linearly in time and held at the ends, 0 in the padding and
            where a demonstration has no measured value of that DoF at all.
        observed: bool [N, T, D], where a value was measured.
        weight: [N, T, D], 1 where measured, `GAP_WEIGHT` in gaps, 0 in the padding.
    """

    phase: Tensor
    values: Tensor
    observed: Tensor
    weight: Tensor

    def __repr__(self) -> str:
        return brief(self)


def samples_of(demonstrations: Demonstrations, periodic: bool = False) -> Samples:
    """Pad, fill the gaps and weigh.

    Args:
        demonstrations: N of them.
        periodic: whether they repeat: phases are then those that `cycles_of` finds.

    Raises:
        ValueError: a DoF that no demonstration measured; periodic ones that do not repeat, or hold less than a cycle.
    """
    values, observed = demonstrations.to(dtype=torch.float64).pad()
    never = ~observed.any(1).any(0)
    if never.any():
        names = [dof for dof, missing in zip(demonstrations.layout.dofs, never.tolist(), strict=True) if missing]
        raise ValueError(f"no demonstration has a measured value of {', '.join(names)}")
    steps = torch.arange(values.shape[1], device=values.device)
    lengths = demonstrations.lengths.to(values.device).unsqueeze(-1)
    valid = (steps < lengths).unsqueeze(-1)
    phase = (steps / (lengths - 1).to(values.dtype)).clamp(max=1)
    filled = torch.where(valid, _fill_gaps(values, observed), 0)
    weight = torch.where(observed, 1.0, GAP_WEIGHT).to(values.dtype) * valid
    if periodic:
        phase = cycles_of(filled, observed, lengths.squeeze(-1)).phase
    return Samples(phase, filled, observed, weight)


def _fill_gaps(values: Tensor, observed: Tensor) -> Tensor:
    """Linear interpolation over dimension -2, held at the ends; 0 where a column has nothing."""
    length = values.shape[-2]
    known = torch.where(observed, values, 0)
    steps = torch.arange(length, device=values.device).unsqueeze(-1).expand_as(values)
    before = torch.where(observed, steps, -1).cummax(dim=-2).values
    after = torch.where(observed, steps, length).flip(-2).cummin(dim=-2).values.flip(-2)
    left = torch.where(before < 0, after, before).clamp(0, length - 1)
    right = torch.where(after >= length, before, after).clamp(0, length - 1)
    share = (steps - left) / (right - left).clamp(min=1)
    start, end = known.gather(-2, left), known.gather(-2, right)
    return start + (end - start) * share.to(values.dtype)


class Fit(NamedTuple):
    """Weights [N, D, B] of a regression and its residuals [N, T, D] (0 where nothing was measured)."""

    weights: Tensor
    residuals: Tensor

    def __repr__(self) -> str:
        return brief(self)


@without_autocast
def regress(basis: Basis, samples: Samples) -> Fit:
    """Weighted least squares by normal equations in float64, for all demonstrations and DoFs at once.

    Without gaps this is ordinary least squares. Gaps count `GAP_WEIGHT` of a sample, which leaves measured
    stretches as they are and keeps the weights of functions that saw no data bounded.
    A DoF that one demonstration never measured gets the mean of the others' weights.
    """
    features: Tensor = basis(samples.phase)
    count = basis.n_features
    outer = (features.unsqueeze(-1) * features.unsqueeze(-2)).flatten(-2)
    weight = samples.weight.transpose(-1, -2)
    gram = (weight @ outer).reshape(*weight.shape[:-1], count, count)
    moments = (weight * samples.values.transpose(-1, -2)) @ features
    # Relative to the trace, 1e-12 is above rounding and far below any effect on the fit.
    ridge = 1e-12 * gram.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
    factor = torch.linalg.cholesky(gram + torch.diag_embed(ridge.expand(*ridge.shape[:-1], count)))
    weights = torch.cholesky_solve(moments.unsqueeze(-1), factor).squeeze(-1)
    # Once more for what is left: values that lie far from 0 leave by ridge and rounding what matters beside their
    # spread (iterative refinement).
    left = samples.values - features @ weights.transpose(-1, -2)
    correction = ((weight * left.transpose(-1, -2)) @ features).unsqueeze(-1)
    weights = weights + torch.cholesky_solve(correction, factor).squeeze(-1)
    absent = ~samples.observed.any(1)
    if absent.any():
        share = (~absent).to(weights) / (~absent).sum(0).to(weights)
        weights = torch.where(absent.unsqueeze(-1), (weights * share.unsqueeze(-1)).sum(0), weights)
    residuals = samples.values - features @ weights.transpose(-1, -2)
    return Fit(weights, torch.where(samples.observed, residuals, 0))


def regress_all(basis: StackedBasis, samples: Samples) -> tuple[Tensor, Tensor, Tensor]:
    """Weights [N, n_weights] of all DoFs, each on its own basis; and of their residuals the mean square, [D], squared
    units, over demonstrations alike, and the `correlation_time`, [D]."""
    weights = samples.values.new_empty(len(samples.values), basis.n_weights)
    variance = samples.values.new_empty(basis.n_dofs)
    correlation = samples.values.new_empty(basis.n_dofs)
    for unique in dict.fromkeys(basis.bases):
        dofs = [d for d, other in enumerate(basis.bases) if other == unique]
        part = Samples(samples.phase, *(tensor[..., dofs] for tensor in samples[1:]))
        fit = regress(unique, part)
        for i, dof in enumerate(dofs):
            weights[:, basis.weight_slices[dof]] = fit.weights[:, i]
        variance[dofs] = mean_squared_residual(fit, part).nanmean(0)
        correlation[dofs] = correlation_time(fit, part)
    return weights, variance, correlation


def mean_squared_residual(fit: Fit, samples: Samples) -> Tensor:
    """[N, D]: each demonstration's mean squared residual over its measured samples; NaN where it has none."""
    return fit.residuals.square().sum(1) / samples.observed.sum(1)


def measured_variance(samples: Samples, resolution: float) -> Tensor:
    """[D]: variance of each DoF over all measured samples; 0 for a constant.

    Args:
        samples: of all demonstrations.
        resolution: relative, of the dtype that the values had: what a constant leaves by it is no scale to measure
            anything by.
    """
    count = samples.observed.sum((0, 1))
    values = torch.where(samples.observed, samples.values, 0)
    mean = values.sum((0, 1)) / count
    deviation = torch.where(samples.observed, samples.values - mean, 0)
    variance = deviation.square().sum((0, 1)) / count
    return torch.where(variance > (resolution * mean).square(), variance, 0)


@without_autocast
def correlation_time(fit: Fit, samples: Samples) -> Tensor:
    """[D]: integrated autocorrelation time of the residuals, in samples; 1 for white ones.

    tau = 1 + 2 sum_k rho_k over the lags before the first rho_k <= 0 (Geyer 1992), with the autocorrelation
    rho pooled over demonstrations.
    """
    length = fit.residuals.shape[1]
    spectrum = torch.fft.rfft(fit.residuals, n=2 * length, dim=1)
    products = torch.fft.irfft(spectrum.abs().square(), n=2 * length, dim=1)[:, :length].sum(0)
    present = torch.fft.rfft(samples.observed.to(fit.residuals), n=2 * length, dim=1)
    pairs = torch.fft.irfft(present.abs().square(), n=2 * length, dim=1)[:, :length].sum(0).round()
    covariance = products / pairs.clamp(min=1)
    variance = covariance[0]
    correlation = covariance / torch.where(variance > 0, variance, 1)
    leading = (correlation > 0).to(correlation).cumprod(0)
    time: Tensor = 1 + 2 * (correlation * leading)[1:].sum(0)
    return time
