"""The choice of family and size for each modality by the Bayesian information criterion (Section V-A)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.interaction.basis.base import Basis
from torch_ebip.interaction.basis.bspline import BSplineBasis
from torch_ebip.interaction.basis.gaussian import GaussianBasis
from torch_ebip.interaction.basis.periodic import FourierBasis, PeriodicBSplineBasis
from torch_ebip.interaction.basis.polynomial import PolynomialBasis
from torch_ebip.interaction.basis.regression import (
    Samples,
    mean_squared_residual,
    measured_variance,
    regress,
    samples_of,
)
from torch_ebip.interaction.basis.sigmoid import SigmoidBasis
from torch_ebip.interaction.basis.stacked import StackedBasis
from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.layout import Layout


class CandidateFit(NamedTuple):
    """How well one basis represents one modality.

    Attributes:
        modality: its name.
        unit: of the three errors.
        basis: the candidate.
        bic: sum over demonstrations and DoFs of n ln(residual variance) + B ln n; smaller is better.
        rmse: root mean squared residual over all measured samples.
        start_error: mean absolute residual at the first measured sample.
        end_error: the same at the last one, which at phase 1 is what the robot must get right.
    """

    modality: str
    unit: str
    basis: Basis
    bic: float
    rmse: float
    start_error: float
    end_error: float


def default_candidates(sizes: Sequence[int] = (6, 8, 10, 12, 15)) -> list[Basis]:
    """The paper's three families and B-splines, every one in these sizes.

    Gaussians and sigmoids, which have no constant among them, come plain and with one function given to it.
    """
    candidates: list[Basis] = []
    for size in sizes:
        candidates += [
            PolynomialBasis(size - 1),
            GaussianBasis(size),
            GaussianBasis(size, offset=True),
            SigmoidBasis(size),
            SigmoidBasis(size, offset=True),
            BSplineBasis(size),
        ]
    return candidates


def periodic_candidates(sizes: Sequence[int] = (5, 7, 9, 11, 15)) -> list[Basis]:
    """Fourier series and B-splines on a circle, in these odd numbers of functions."""
    bases: list[Basis] = [PeriodicBSplineBasis(size) for size in sizes]
    return bases + [FourierBasis((size - 1) // 2) for size in sizes]


def select_basis(
    demonstrations: Demonstrations,
    candidates: Sequence[Basis] | None = None,
    *,
    ranking: Sequence[CandidateFit] | None = None,
    periodic: bool = False,
) -> StackedBasis:
    """For each modality the candidate with the smallest BIC; `rank_candidates` gives the table behind it.

    Args:
        demonstrations: all of them count.
        candidates: default `default_candidates()` or `periodic_candidates()`; those with more functions than the
            shortest demonstration has samples are left out.
        ranking: what `rank_candidates` said of these demonstrations, if it is known already.
        periodic: whether they repeat.

    Raises:
        ValueError: no candidate is small enough, or a DoF was never measured; some are periodic and others not, or
            they are and the demonstrations do not repeat.
    """
    best: dict[str, CandidateFit] = {}
    for row in rank_candidates(demonstrations, candidates, periodic) if ranking is None else ranking:
        best.setdefault(row.modality, row)
    layout = demonstrations.layout
    return StackedBasis([best[modality.name].basis for modality in layout.modalities for _ in modality.dofs])


def rank_candidates(
    demonstrations: Demonstrations, candidates: Sequence[Basis] | None = None, periodic: bool = False
) -> list[CandidateFit]:
    """Every candidate fitted to every modality: modalities in the layout's order, the best BIC first in each.

    Args:
        demonstrations, candidates, periodic: see `select_basis`.

    Raises:
        ValueError: as `select_basis`.
    """
    shortest = int(demonstrations.lengths.min())
    usual = periodic_candidates if periodic else default_candidates
    offered = list(candidates) if candidates is not None else usual()
    kinds = {basis.periodic for basis in offered}
    if len(kinds) > 1 or (periodic and kinds == {False}):
        raise ValueError("candidates must all be periodic, for demonstrations that repeat, or none of them")
    usable = [basis for basis in offered if basis.n_features <= shortest]
    if not usable:
        sizes = sorted({basis.n_features for basis in offered})
        raise ValueError(
            f"the shortest demonstration has {shortest} samples; none of the candidates with {sizes} functions "
            "is small enough for it"
        )
    samples = samples_of(demonstrations, True in kinds)
    # A DoF that never moves is fitted exactly by any basis: the floor keeps its logarithm finite. It is one of the
    # spread, because where the origin lies says nothing; and of the size where there is no spread.
    spread = measured_variance(samples, torch.finfo(demonstrations[0].dtype).eps)
    size = torch.where(samples.observed, samples.values, 0).square().mean((0, 1))
    floor = 1e-12 * torch.where(spread > 0, spread, size) + 1e-300
    rows = [row for basis in usable for row in _fit(demonstrations.layout, basis, samples, floor)]
    order = demonstrations.layout.names
    return sorted(rows, key=lambda row: (order.index(row.modality), row.bic))


def _fit(layout: Layout, basis: Basis, samples: Samples, floor: Tensor) -> list[CandidateFit]:
    """One batched regression for all DoFs, one row for each modality; residual variances above a floor [D]."""
    fit = regress(basis, samples)
    counts = samples.observed.sum(1)
    n = counts.to(samples.values)
    terms = n * (mean_squared_residual(fit, samples) + floor).log() + basis.n_features * n.log()
    bic = torch.where(counts > 0, terms, 0).sum(0)
    steps = torch.arange(samples.observed.shape[1], device=counts.device).view(1, -1, 1)
    first = torch.where(samples.observed, steps, len(steps[0]) - 1).amin(1, keepdim=True)
    last = torch.where(samples.observed, steps, 0).amax(1, keepdim=True)
    start, end = (fit.residuals.gather(1, at).squeeze(1).abs() for at in (first, last))
    rows = []
    for modality in layout.modalities:
        part = layout.slice(modality.name)
        measured = counts[:, part] > 0
        squares = fit.residuals[..., part].square().sum() / counts[:, part].sum()
        rows.append(
            CandidateFit(
                modality.name,
                modality.unit,
                basis,
                float(bic[part].sum()),
                float(squares.sqrt()),
                float(start[:, part][measured].mean()),
                float(end[:, part][measured].mean()),
            )
        )
    return rows


def selection_table(rows: Sequence[CandidateFit], best: int = 3) -> str:
    """The first ``best`` rows of each modality as text, errors in the modality's unit."""
    lines = [f"{'modality':<20} {'basis':<58} {'BIC':>12} {'rmse':>10} {'start':>10} {'end':>10} unit"]
    seen: dict[str, int] = {}
    for row in rows:
        seen[row.modality] = seen.get(row.modality, 0) + 1
        if seen[row.modality] <= best:
            lines.append(
                f"{row.modality:<20} {row.basis!s:<58} {row.bic:12.0f} {row.rmse:10.4g} "
                f"{row.start_error:10.4g} {row.end_error:10.4g} {row.unit}"
            )
    return "\n".join(lines)
