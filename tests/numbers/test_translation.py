"""Where the origin lies changes nothing: values up to 10^4 deviations of their noise away from 0, in float32.

Float64 computes from the same float32 inputs, so what is measured is the arithmetic alone. A value 10^4 deviations
away is stored to 6e-4 of one; products of values whose mean cancels only in exact arithmetic would be off by more
than that by factors of thousands.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.conftest import interactions
from torch_ebip import (
    BSplineBasis,
    Demonstrations,
    EnsembleFilter,
    Filter,
    GaussianBasis,
    GaussianPrior,
    Inflation,
    InteractionPrimitive,
    LiveFilter,
    MeasurementNoise,
    PolynomialBasis,
    SquareRoot,
    StackedBasis,
    StateSpace,
    StudentT,
    Update,
    bip,
    ebip,
    ebip_minus,
    particle_filter,
)
from torch_ebip.filtering.functional import (
    Taper,
    ensemble_covariance,
    ensemble_mean,
    ensemble_update,
    square_root_update,
)
from torch_ebip.filtering.functional.scores import crps
from torch_ebip.filtering.states import map_state
from torch_ebip.interaction.basis import rank_candidates
from torch_ebip.learning.losses import CRPSLoss, EnergyScoreLoss, TrajectoryLoss

NOISE = 0.01
"""Standard deviation of the noise of the interactions in conftest."""
OFFSETS = [0.0, 1e2, 1e4]
SEEN = torch.tensor([True, True, True, False, False])
SPLINES = StackedBasis([BSplineBasis(6)] * 5)  # they sum to 1: a translation of the data is one of the weights

MAKE: dict[str, Callable[[InteractionPrimitive], Filter]] = {
    "closed form": lambda p: ebip(p, square_root=True),
    "all options": lambda p: ebip(
        p, square_root=True, weigh=True, context=BSplineBasis(4), inflation=1.01, robust=StudentT()
    ),
    "localised": lambda p: ebip(p, square_root=True, localise=True, inflation=1.01),
    "mixture": lambda p: ebip_minus(p, 20, max_components=1, square_root=True),
    "bip": bip,
    "particle": lambda p: particle_filter(p, residual_variance=1e4 * p.residual_variance),
}


class Problem:
    """A filter in one dtype, and an interaction far from the origin that it does not know."""

    def __init__(self, kind: str, offset: float, dtype: torch.dtype) -> None:
        made = interactions(25, dtype=torch.float64)
        self.offset = offset * NOISE
        trajectories = [(trajectory + self.offset).float().to(dtype) for trajectory in made]
        demonstrations = Demonstrations(made.layout, trajectories, made.rate)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            self.filter = MAKE[kind](InteractionPrimitive.fit(demonstrations.subset(range(1, 25)), SPLINES))
        with torch.no_grad():  # float32 and float64 draw different numbers: no noise, no resampling
            self.filter.model.process_noise.phase.acceleration.raw.fill_(-50)
        if kind == "particle":
            self.filter.threshold = 0.0
        self.y = trajectories[0][:25]
        self.observed = SEEN & ~self.y.isnan()

    def answer(self, state: object, gradients: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Mean and deviation of the arm at the end, phase, and the gradient of a score of all of them."""
        dtype = self.y.dtype
        state = map_state(lambda part: part.to(dtype) if part.is_floating_point() else part, state)
        end = torch.ones(1, dtype=dtype)
        with torch.set_grad_enabled(gradients):
            trace = self.filter(self.y, self.observed, state=state, generator=torch.Generator().manual_seed(0))
            forecast = self.filter.forecast(trace.state, end)
            mean, deviation = forecast.mean[0, 3:] - self.offset, forecast.variance[0, 3:].sqrt()
        gradient = end[:0]
        if gradients:
            (mean.sum() + deviation.sum() + trace.log_likelihood.mean()).backward()
            gradient = torch.cat([p.grad.flatten() for p in self.filter.parameters() if p.grad is not None])
        return tuple(part.detach().double() for part in (mean, deviation, trace.phase[-1], gradient))


@pytest.mark.parametrize("kind", MAKE)
@pytest.mark.parametrize("offset", OFFSETS)
def test_whole_filters(kind: str, offset: float) -> None:
    """On the differentiable path and, where there is one, on the live one: values and gradients."""
    single, double = (Problem(kind, offset, dtype) for dtype in (torch.float32, torch.float64))
    state = single.filter.initial_state(generator=torch.Generator().manual_seed(0))
    for gradients in (True, False):
        mean, deviation, phase, gradient = single.answer(state, gradients)
        exact, spread, true_phase, true_gradient = double.answer(state, gradients)
        assert ((mean - exact) / spread).abs().max() < 0.01
        torch.testing.assert_close(deviation, spread, rtol=2e-3, atol=0)
        torch.testing.assert_close(phase, true_phase, rtol=0, atol=2e-5)
        if gradients:
            assert (gradient - true_gradient).norm() < 5e-3 * true_gradient.norm()


@pytest.mark.parametrize("kind", ["closed form", "all options"])
@pytest.mark.parametrize("offset", OFFSETS)
def test_steps_of_the_live_filter_and_of_a_state_made_by_hand(kind: str, offset: float) -> None:
    """Sample by sample; a state that holds members as they are, far from 0, loses no more."""
    single, double = (Problem(kind, offset, dtype) for dtype in (torch.float32, torch.float64))
    assert isinstance(single.filter, EnsembleFilter)
    start = single.filter.initial_state()
    exact, spread, _, _ = double.answer(start, False)
    bare = start._replace(deviations=start.members, centre=None)
    live = LiveFilter(single.filter, SEEN, state=start)
    by_hand = LiveFilter(single.filter, SEEN, state=bare)
    with torch.no_grad():
        for t, (sample, here) in enumerate(zip(single.y, single.observed, strict=True)):
            for each in (live, by_hand):
                if t:
                    each.predict()
                each.update(sample, here)
            if t:
                bare = single.filter.predict(bare, single.filter.dt)
            bare, _ = single.filter.update(bare, sample, here)
        end = torch.ones(1)
        forecasts = [live.forecast(end), by_hand.forecast(end), single.filter.forecast(bare, end)]
    for forecast in forecasts:
        error = forecast.mean[0, 3:].double() - single.offset - exact
        assert (error / spread).abs().max() < 0.02
        torch.testing.assert_close(forecast.variance[0, 3:].double().sqrt(), spread, rtol=5e-3, atol=0)


def test_the_first_members_are_the_demonstrations_to_the_bit() -> None:
    """Taking a centre out and adding it back rounds nothing."""
    for offset in (0.0, 1.0, 3e3, -1e6):
        made = interactions(12)
        moved = Demonstrations(made.layout, [trajectory + offset for trajectory in made], made.rate)
        primitive = InteractionPrimitive.fit(moved, SPLINES)
        state = ebip(primitive).initial_state()
        assert torch.equal(state.members[:, 2:], primitive.weights)
        assert state.centre is not None
        if abs(offset) > 100:
            assert (state.deviations[:, 2:].abs().amax(0) <= 0.5 * primitive.weights.abs().amax(0)).all()


@pytest.mark.parametrize("offset", OFFSETS)
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("options", ["plain", "tapered", "inflated", "masked"])
@pytest.mark.parametrize("n", [3, 400])  # products from the left, and by way of an E x E transform
def test_one_update(offset: float, weighted: bool, options: str, n: int) -> None:
    generator = torch.Generator().manual_seed(1)
    members = (offset + torch.randn(20, n, generator=generator)).float()
    projections, draws = members[:, :3].clone(), torch.randn(20, 3, generator=generator)
    y = offset + torch.randn(3, generator=generator)
    weights = torch.softmax(torch.randn(20, generator=generator), -1) if weighted else None
    observed = torch.tensor([True, False, True]) if options == "masked" else None
    factor = torch.eye(3)

    def run(stochastic: bool, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        x, hx, noise = (part.to(dtype, copy=True).requires_grad_() for part in (members, projections, factor))
        share = None if weights is None else weights.to(dtype)
        taper = None
        if options == "tapered":
            taper = Taper(torch.full((n, 3), 0.7, dtype=dtype), 0.3 * torch.eye(3, dtype=dtype) + 0.7)
        inflation = torch.tensor(1.1, dtype=dtype) if options == "inflated" else None
        perturbations = (draws.to(dtype),) if stochastic else ()
        update = ensemble_update if stochastic else square_root_update
        after, likelihood = update(
            x, hx, y.to(dtype), noise, *perturbations, observed, taper=taper, weights=share, inflation=inflation
        )
        ((after - offset).square().mean() + likelihood).backward()
        return after.detach().double(), likelihood.detach().double(), torch.cat([hx.grad, noise.grad]).double()

    for stochastic in (False, True):
        (after, likelihood, gradient), (exact, truth, slope) = (
            run(stochastic, dtype) for dtype in (torch.float32, torch.float64)
        )
        # What is stored is rounded to 6e-4 deviations at 10^4 of them.
        assert ((after - exact) / exact.std(0)).abs().max() < 2e-5 + 5e-7 * offset
        assert abs(likelihood - truth) < 1e-4 + 1e-6 * offset
        assert (gradient - slope).norm() < (1e-4 + 1e-6 * offset) * slope.norm()


@pytest.mark.parametrize("stochastic", [False, True])
def test_the_mean_of_many_members(stochastic: bool) -> None:
    """It moves by K (y - mean HX), in whose product nothing may cancel; rounding of the members averages out."""
    generator = torch.Generator().manual_seed(2)
    deviations = torch.randn(2000, 40, generator=generator)
    members = (deviations + 1e5).float()
    draws = (torch.randn(2000, 2, generator=generator),) if stochastic else ()
    means = []
    for dtype in (torch.float32, torch.float64):
        x, perturbations = members.to(dtype), [draw.to(dtype) for draw in draws]
        update = ensemble_update if stochastic else square_root_update
        y, factor = torch.full((2,), 1e5 + 3, dtype=dtype), torch.eye(2, dtype=dtype)
        after, _ = update(x, x[:, :2], y, factor, *perturbations)
        means.append((after.double() - 1e5).mean(0))
    assert (means[0] - means[1]).abs().max() < 1e-3


class Linear(nn.Module):
    """h(x) = H x."""

    def __init__(self, matrix: Tensor) -> None:
        super().__init__()
        self.register_buffer("matrix", matrix)

    def forward(self, members: Tensor) -> Tensor:
        return members @ self.matrix.T


class Still(nn.Module):
    """g(x) = x."""

    def forward(self, members: Tensor, dt: Tensor) -> Tensor:
        return members


@pytest.mark.parametrize("inflation", [None, 1.05])
def test_a_filter_of_any_model(inflation: float | None) -> None:
    """No basis, no phase: a state 10^4 deviations from 0 against the same filter in float64."""
    generator = torch.Generator().manual_seed(0)
    start = (1e4 + torch.randn(50, 4, generator=generator)).float()
    y = (1e4 + 0.5 * torch.randn(30, 2, generator=generator)).float()
    means = []
    for dtype in (torch.float32, torch.float64):
        prior = GaussianPrior(torch.zeros(4, dtype=dtype), torch.eye(4, dtype=dtype))
        noise = MeasurementNoise(torch.ones(2, dtype=dtype))
        model = StateSpace(Still(), Linear(torch.eye(2, 4, dtype=dtype) + 0.0), None, noise, 2, 1.0)
        update = Update(SquareRoot(), inflation=None if inflation is None else Inflation(inflation))
        made = EnsembleFilter(model, prior, 50, update)
        state = made.initial_state()._replace(deviations=start.to(dtype))
        after = made(y.to(dtype), state=state).state
        means.append((after.mean.double(), after.covariance.double()))
    (mean, covariance), (exact, truth) = means
    deviation = truth.diagonal().sqrt()
    assert ((mean - exact) / deviation).abs().max() < 0.02
    torch.testing.assert_close(covariance / deviation / deviation[:, None], truth / deviation / deviation[:, None],
                               rtol=0, atol=0.01)  # fmt: skip


def test_moments_scores_and_losses() -> None:
    generator = torch.Generator().manual_seed(0)
    members = (1e4 + torch.randn(3, 200, 2, generator=generator)).float()
    target = (1e4 + torch.randn(3, 2, generator=generator)).float()
    weights = torch.softmax(torch.randn(3, 200, generator=generator), -1)
    scale = torch.ones(2)
    for ours, tolerance in (
        (lambda m, t, w: ensemble_mean(m, w) - 1e4, 6e-4),  # half of the last digit there
        (lambda m, t, w: ensemble_covariance(m, w), 5e-6),
        (lambda m, t, w: crps(m, t, w), 2e-6),
        (lambda m, t, w: crps(m, t, w, fair=False), 2e-6),
        (lambda m, t, w: CRPSLoss(scale.to(m))(m, t, w), 2e-6),
        (lambda m, t, w: EnergyScoreLoss(scale.to(m))(m, t), 2e-6),
        (lambda m, t, w: TrajectoryLoss(3 * scale.to(m))(m[:, 0], t), 2e-6),
    ):
        single = ours(members, target, weights)
        double = ours(members.double(), target.double(), weights.double() / weights.double().sum(-1, keepdim=True))
        np.testing.assert_allclose(single, double, rtol=0, atol=tolerance)


def test_a_regression_moves_with_its_data() -> None:
    """Weights, residuals, R and the ranking by BIC, of data moved by 10^4 deviations of its noise and 10^8."""
    made = interactions(12, dtype=torch.float64)
    candidates = [BSplineBasis(6), PolynomialBasis(5), GaussianBasis(8, offset=True)]  # each has the constant in it
    ranked = rank_candidates(made, candidates)
    primitive = InteractionPrimitive.fit(made, SPLINES)
    for offset in (1e4 * NOISE, 1e8 * NOISE):
        moved = Demonstrations(made.layout, [trajectory + offset for trajectory in made], made.rate)
        tolerance = 1e-14 * offset
        for row, again in zip(ranked, rank_candidates(moved, candidates), strict=True):
            assert (row.modality, row.basis) == (again.modality, again.basis)
            assert again.bic == pytest.approx(row.bic, abs=1e-2)
            assert again.rmse == pytest.approx(row.rmse, rel=1e-6)
        fitted = InteractionPrimitive.fit(moved, SPLINES)
        torch.testing.assert_close(fitted.weights - offset, primitive.weights, rtol=1e-6, atol=1e3 * tolerance)
        for name in ("residual_variance", "residual_correlation_time", "value_variance", "end_variance"):
            torch.testing.assert_close(getattr(fitted, name), getattr(primitive, name), rtol=1e-5, atol=0, msg=name)


def test_constants_and_what_barely_moves() -> None:
    """A spread of a few roundings is none; one of 10^-5 of the distance is one."""
    made = interactions(12)
    still = [trajectory.clone() for trajectory in made]
    for i, trajectory in enumerate(still):
        trajectory[:, 2] = math.pi
        trajectory[:, 0] = 1000 + 0.01 * i * torch.linspace(0, 1, len(trajectory))
    primitive = InteractionPrimitive.fit(Demonstrations(made.layout, still, made.rate), SPLINES)
    assert primitive.value_variance[2] == 0
    moving = torch.cat([trajectory[:, 0] for trajectory in still]).double()
    assert primitive.value_variance[0] == pytest.approx(float(moving.var()), rel=0.01)
