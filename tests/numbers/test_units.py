"""Units do not matter: a modality in other units has its forecasts in these units, and nothing else changes.

Powers of two are exact in floating point: six orders of magnitude change nothing to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from tests.conftest import interactions
from torch_ebip import (
    BSplineBasis,
    Demonstrations,
    Filter,
    GaussianBasis,
    InteractionPrimitive,
    LiveFilter,
    PolynomialBasis,
    StackedBasis,
    bip,
    ebip,
    ebip_minus,
    particle_filter,
    select_basis,
)
from torch_ebip.learning.objective import ForecastObjective, Weights

SEEN = torch.tensor([True, True, True, False, False])
MAKE: dict[str, Callable[[InteractionPrimitive], Filter]] = {
    "closed form": ebip,
    "all options": lambda p: ebip(
        p, 12, square_root=True, weigh=True, context=BSplineBasis(4), inflation=1.01, residual_variance=None
    ),
    "localised": lambda p: ebip(p, localise=True, weight_noise=0.1),
    "mixture": lambda p: ebip_minus(p, 20, max_components=1),
    "bip": lambda p: bip(p, shrinkage=0.1),
}


def in_units(factors: dict[str, float], dtype: torch.dtype, count: int = 16) -> Demonstrations:
    """Interactions whose modalities are multiplied by factors; what does not move at all included."""
    made = interactions(count, dtype=dtype)
    factor = dofs_of(made, factors)
    return Demonstrations(made.layout, [trajectory * factor for trajectory in made], made.rate)


def dofs_of(made: Demonstrations, factors: dict[str, float]) -> Tensor:
    """The factor of each DoF."""
    factor = torch.ones(5, dtype=made[0].dtype)
    for name, value in factors.items():
        factor[made.layout.slice(name)] = value
    return factor


class Outcome(NamedTuple):
    """What does not depend on units, and what does, in the units of one modality."""

    phase: Tensor
    likelihood: Tensor
    mean: Tensor
    deviation: Tensor
    gradients: list[Tensor]


def outcome(make: Callable[[InteractionPrimitive], Filter], factors: dict[str, float], dtype: torch.dtype) -> Outcome:
    """From recordings to forecasts; means and deviations in the first units again."""
    made = in_units(factors, dtype)
    factor = dofs_of(made, factors)
    filter = make(InteractionPrimitive.fit(made.subset(range(1, 16)), StackedBasis([BSplineBasis(6)] * 5)))
    y = made[0][:20]
    observed = SEEN & ~y.isnan()
    trace = filter(y, observed, generator=torch.Generator().manual_seed(0))
    forecast = filter.forecast(trace.state, torch.tensor([0.8, 1.0], dtype=dtype))
    ((forecast.mean / factor).sum() + trace.phase.sum() + trace.log_likelihood.sum()).backward()
    gradients = [parameter.grad for parameter in filter.parameters() if parameter.grad is not None]
    jacobian = (observed * factor.log()).sum(-1)
    parts = (trace.phase, trace.log_likelihood + jacobian, forecast.mean / factor, forecast.variance.sqrt() / factor)
    return Outcome(*(part.detach() for part in parts), gradients)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("factors", [{"hand": 2.0**20}, {"arm": 2.0**-20}, {"hand": 2.0**-20, "gaze": 2.0**20}])
@pytest.mark.parametrize("kind", MAKE)
def test_powers_of_two_change_nothing_to_the_bit(kind: str, factors: dict[str, float], dtype: torch.dtype) -> None:
    one, other = outcome(MAKE[kind], {}, dtype), outcome(MAKE[kind], factors, dtype)
    if kind != "mixture":  # whose means and deviations of weights numpy sums in another order
        assert torch.equal(one.phase, other.phase)
        assert torch.equal(one.mean, other.mean)
        assert torch.equal(one.deviation, other.deviation)
    tolerance = {"rtol": 1e-4, "atol": 1e-4} if dtype == torch.float32 else {"rtol": 1e-9, "atol": 1e-9}
    for a, b in zip(one[:4], other[:4], strict=True):
        torch.testing.assert_close(a, b, **tolerance)
    assert one.gradients
    for a, b in zip(one.gradients, other.gradients, strict=True):
        torch.testing.assert_close(a, b, **tolerance)


@pytest.mark.parametrize("factors", [{"hand": 1e6}, {"arm": 1e-6}, {"hand": 1e-6, "gaze": 1e6}])
@pytest.mark.parametrize("kind", [*MAKE, "particle"])
def test_six_orders_of_magnitude(kind: str, factors: dict[str, float]) -> None:
    """In float64, by factors that are not exact."""
    make = MAKE.get(kind, lambda p: particle_filter(p, softness=0.1))
    one, other = outcome(make, {}, torch.float64), outcome(make, factors, torch.float64)
    for a, b in zip([*one[:4], *one.gradients], [*other[:4], *other.gradients], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("power", [2.0**20, 2.0**-20])
@pytest.mark.parametrize("kind", ["closed form", "all options"])
def test_the_live_filter(kind: str, power: float) -> None:
    results = []
    for factors in ({}, {"hand": power}):
        made = in_units(factors, torch.float32)
        primitive = InteractionPrimitive.fit(made.subset(range(1, 16)), StackedBasis([BSplineBasis(6)] * 5))
        live = LiveFilter(MAKE[kind](primitive), SEEN, generator=torch.Generator().manual_seed(0))
        for t in range(20):
            if t:
                live.predict()
            live.update(torch.where(SEEN, made[0][t], math.nan))
        results.append((live.phase, live.forecast(torch.ones(1)).mean / dofs_of(made, factors)))
    (phase, mean), (other, rescaled) = results
    assert torch.equal(phase, other)
    assert torch.equal(mean, rescaled)


@pytest.mark.parametrize("factor", [2.0**20, 2.0**-20, 1e6, 1e-12, 1e12])
def test_the_choice_of_a_basis(factor: float) -> None:
    made, other = in_units({}, torch.float64), in_units({"gaze": factor}, torch.float64)
    candidates = [PolynomialBasis(5), GaussianBasis(6), BSplineBasis(6), BSplineBasis(8)]
    assert select_basis(made, candidates).bases == select_basis(other, candidates).bases


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**20, 2.0**-40])
def test_the_closed_form_of_what_is_fitted_exactly(factor: float) -> None:
    """Its floor is one in its own units: R of a straight line, of a constant, and of nothing at all."""
    results = []
    for unit in (1.0, factor):
        made = interactions(8, dtype=torch.float64)
        trajectories = []
        for i, trajectory in enumerate(made):
            trajectory[:, 0] = torch.linspace(0, 1 + i, len(trajectory), dtype=torch.float64)
            trajectory[:, 1] = 0.5
            trajectory[:, 2] = 0
            trajectories.append(trajectory * torch.tensor([unit, unit, 1, 1, 1], dtype=torch.float64))
        fitted = InteractionPrimitive.fit(
            Demonstrations(made.layout, trajectories, made.rate), StackedBasis([PolynomialBasis(3)] * 5)
        )
        results.append(fitted.residual_variance)
    one, other = results
    assert torch.equal(one[:2] * factor**2, other[:2])
    assert torch.equal(one[2:], other[2:])
    assert (other > 0).all()


@pytest.mark.parametrize("factors", [{"hand": 2.0**20}, {"arm": 2.0**-20}, {"arm": 2.0**20, "gaze": 2.0**-20}])
def test_what_tuning_minimises(factors: dict[str, float]) -> None:
    losses = []
    for chosen in ({}, factors):
        made = in_units(chosen, torch.float32)
        primitive = InteractionPrimitive.fit(made, StackedBasis([BSplineBasis(6)] * 5))
        filter = MAKE["all options"](primitive)
        objective = ForecastObjective(primitive, ~SEEN, weights=Weights())
        y, observed = made.pad()
        y, observed = y[:3, :20], observed[:3, :20] & SEEN
        keep = torch.tensor([[9, 19]] * 3)
        trace = filter(y, observed, generator=torch.Generator().manual_seed(0), keep=keep)
        now = keep / (made.lengths[:3].unsqueeze(-1) - 1)
        truth = primitive.basis.project(objective.phases_ahead(now), primitive.weights[:3, None, None])[..., ~SEEN]
        loss = sum(objective(filter, trace, observed, truth, now, ~SEEN).values())
        assert isinstance(loss, Tensor)
        loss.backward()
        losses.append([loss.detach(), *(p.grad for p in filter.parameters() if p.grad is not None)])
    assert torch.equal(losses[0][0], losses[1][0])
    for a, b in zip(*losses, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)
