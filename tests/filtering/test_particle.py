"""The particle filter against exact posteriors, and resampling against its definition."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from tests.filtering.contract import FilterContract
from tests.filtering.test_kalman import Additive, Linear
from tests.interaction.test_ebip import silent
from torch_ebip import (
    BSplineBasis,
    Gate,
    GaussianPrior,
    MeasurementNoise,
    ParticleFilter,
    ParticleState,
    StateSpace,
    functional,
    particle_filter,
)


class TestPlain(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> ParticleFilter:
        primitive = small_primitive(dtype)
        return particle_filter(primitive, residual_variance=1e4 * primitive.residual_variance)

    def make_without_draws(self) -> ParticleFilter:
        made = silent(particle_filter(small_primitive(torch.float64)))
        made.threshold = 0.0
        return made


class TestEverything(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> ParticleFilter:
        primitive = small_primitive(dtype)
        variance = 300 * primitive.residual_variance
        options = {"context": BSplineBasis(4), "weight_noise": 0.1, "softness": 0.2, "robust": Gate(3.0)}
        return particle_filter(primitive, 20, residual_variance=variance, **options)

    def make_without_draws(self) -> ParticleFilter:
        primitive = small_primitive(torch.float64)
        made = silent(particle_filter(primitive, 20, context=BSplineBasis(4), robust=Gate(3.0)))
        made.threshold = 0.0
        return made


def test_systematic_resampling_is_what_it_says() -> None:
    """Against a loop over positions, and floor or ceil of E w offspring, E w in the mean over draws."""
    generator = torch.Generator().manual_seed(0)
    log_weights = 2 * torch.randn(3, 7, generator=generator, dtype=torch.float64)
    weights = torch.softmax(log_weights, -1).numpy()
    counts = np.zeros((3, 7))
    for k in range(400):
        u = torch.full((3,), (k + 0.5) / 400, dtype=torch.float64)
        ancestors = functional.systematic_resample(log_weights + 5, u)
        for b in range(3):
            expected, j, total = [], 0, weights[b, 0]
            for i in range(7):
                while (i + float(u[b])) / 7 >= total:
                    j += 1
                    total += weights[b, j]
                expected.append(j)
            assert ancestors[b].tolist() == expected
            offspring = np.bincount(expected, minlength=7)
            assert (np.abs(offspring - 7 * weights[b]) < 1).all()
            counts[b] += offspring / 400
    np.testing.assert_allclose(counts, 7 * weights, atol=0.01)


def test_resampling_survives_rounding_and_names_what_is_wrong() -> None:
    last = functional.systematic_resample(torch.tensor([0.0, -1e9]), torch.tensor(0.999999))
    assert last.tolist() == [0, 0]
    with pytest.raises(ValueError, match="without any positive weight"):
        functional.systematic_resample(torch.full((4,), -math.inf), torch.tensor(0.5))
    with pytest.raises(ValueError, match=r"one number for each row of log_weights, \[2\], got \[\]"):
        functional.systematic_resample(torch.zeros(2, 4), torch.tensor(0.5))


def scalar_problem(count: int, softness: float = 0.0) -> ParticleFilter:
    """x' = 0.9 x + N(0, 0.3^2), y = 1.5 x + N(0, 0.5^2), x_0 ~ N(1, 1)."""
    matrix = lambda value: torch.full((1, 1), value, dtype=torch.float64)  # noqa: E731
    return ParticleFilter(
        StateSpace(
            Linear(matrix(0.9)),
            Linear(matrix(1.5)),
            Additive(0.09),
            MeasurementNoise(torch.full((1,), 0.25, dtype=torch.float64)),
            1,
            1.0,
        ),
        GaussianPrior(torch.ones(1, dtype=torch.float64), torch.eye(1, dtype=torch.float64)),
        count,
        softness=softness,
    )


@pytest.mark.parametrize("softness", [0.0, 0.3])
def test_it_converges_to_the_exact_posterior(softness: float) -> None:
    """One-dimensional and linear: mean, variance and evidence of a Kalman filter, at the Monte Carlo rate."""
    generator = torch.Generator().manual_seed(0)
    y = torch.cumsum(0.5 * torch.randn(12, 1, generator=generator, dtype=torch.float64), 0)
    y[4] = math.nan
    mean, variance, evidence, exact = 1.0, 1.0, 0.0, []
    for t, value in enumerate(y[:, 0].tolist()):
        if t:
            mean, variance = 0.9 * mean, 0.81 * variance + 0.09
        if not math.isnan(value):
            S = 2.25 * variance + 0.25
            r = value - 1.5 * mean
            evidence -= 0.5 * (r * r / S + math.log(2 * math.pi * S))
            mean, variance = mean + 1.5 * variance / S * r, variance * 0.25 / S
        exact.append(1.5 * mean)
    errors = []
    for count in (100, 1_600, 25_600):
        made = scalar_problem(count, softness)
        with torch.no_grad():
            trace = made(y.expand(20, -1, -1), generator=torch.Generator().manual_seed(1))
        errors.append((trace.projection[..., 0] - torch.tensor(exact).double()).square().mean().sqrt().item())
        spread = trace.state.covariance[:, 0, 0].mean().item()
        assert spread == pytest.approx(variance, rel=10 / math.sqrt(20 * count) + 0.01)
        total = trace.log_likelihood.sum(-1).mean().item()
        assert total == pytest.approx(evidence, abs=10 / math.sqrt(20 * count) + 12 / count)
    assert errors[2] < 0.005
    for coarse, fine in pairwise(errors):
        assert 2.5 < coarse / fine < 6.5  # 16 times the particles: 4 expected


def test_only_entries_that_need_it_are_resampled() -> None:
    made = silent(particle_filter(small_primitive(torch.float64)))
    state = made.initial_state((2,))
    sharp = torch.log_softmax(-10.0 * torch.arange(24, dtype=torch.float64), -1)
    state = ParticleState(state.members, torch.stack([state.log_weights[0], sharp]))
    assert state.effective_size.tolist() == pytest.approx([24, 1], abs=1e-3)
    after = made.predict(state, 0.1, torch.Generator().manual_seed(0))
    assert torch.equal(after.members[0, :, 2:], state.members[0, :, 2:])
    assert torch.equal(after.members[1, :, 2:], state.members[1, :1, 2:].expand(24, -1))
    torch.testing.assert_close(after.weights[1], torch.full((24,), 1 / 24).double())


def test_soft_resampling_keeps_the_mean_and_passes_gradients() -> None:
    primitive = small_primitive(torch.float64)
    gradients, means = {}, {}
    y = interactions(2, seed=9, dtype=torch.float64)[1][:2]
    seen = torch.tensor([[True] * 3 + [False] * 2, [False] * 5])
    for softness in (0.0, 0.3):
        made = silent(
            particle_filter(primitive, residual_variance=30 * primitive.residual_variance, softness=softness)
        )
        trace = made(y.expand(4000, 2, 5), seen.expand(4000, 2, 5), generator=torch.Generator().manual_seed(0))
        means[softness] = trace.state.mean.mean(0)
        trace.state.mean[..., 2:].sum().backward()
        gradients[softness] = made.model.measurement_noise.variance.raw.grad
    before, _ = made.update(made.initial_state(), y[0], seen[0])
    assert before.effective_size < 12
    for softness in (0.0, 0.3):
        torch.testing.assert_close(means[softness][2:], before.mean[2:].detach(), atol=0.02, rtol=0.02)
    assert not gradients[0.0].any()
    assert (gradients[0.3][:3].abs() > 1e-3).all()


def test_only_measured_rows_weigh() -> None:
    """Weights after one sample against the definition in numpy."""
    primitive = small_primitive(torch.float64)
    made = particle_filter(primitive, residual_variance=1000 * primitive.residual_variance)
    y = torch.tensor([0.1, math.nan, 0.2, 5.0, 5.0], dtype=torch.float64)
    seen = torch.tensor([True, False, True, False, False])
    state, likelihood = made.update(made.initial_state(), y, seen)
    h = primitive.weights.numpy().reshape(24, 5, 6) @ BSplineBasis(6)(torch.tensor(0.0).double()).numpy()
    R = 1000 * primitive.residual_variance.numpy()
    density = np.prod(
        [np.exp(-0.5 * (float(y[d]) - h[:, d]) ** 2 / R[d]) / np.sqrt(2 * np.pi * R[d]) for d in (0, 2)], 0
    )
    np.testing.assert_allclose(state.weights.detach().numpy(), density / density.sum(), rtol=1e-6)
    np.testing.assert_allclose(likelihood.item(), np.log(density.mean()), rtol=1e-6)


def test_bad_options_are_named() -> None:
    with pytest.raises(ValueError, match="softness must be at least 0 and below 1, got 1"):
        particle_filter(small_primitive(), softness=1.0)
    with pytest.raises(ValueError, match="at least 2 members"):
        particle_filter(small_primitive(), 1)


def test_restricting_is_exact() -> None:
    primitive = small_primitive(torch.float64)
    whole = particle_filter(primitive, context=BSplineBasis(4), residual_variance=300 * primitive.residual_variance)
    y, observed = interactions(2, seed=3, dtype=torch.float64).pad()
    y, observed = y[:, :20], observed[:, :20] & torch.tensor([True, False, True, False, False])
    dofs = torch.tensor([True, False, True, False, True])
    part = whole.restrict(dofs)
    a = whole(y, observed, generator=torch.Generator().manual_seed(0))
    b = part(y[..., dofs], observed[..., dofs], generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(a.projection[..., dofs], b.projection)
    torch.testing.assert_close(a.log_likelihood, b.log_likelihood)
