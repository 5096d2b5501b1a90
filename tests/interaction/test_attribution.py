"""Forecasts as affine combinations of the demonstrations' trajectories, for every filter."""

import pytest
import torch

from tests.conftest import interactions, small_primitive
from torch_ebip import Filter, GaussianPrior, MeasurementNoise, StateSpace, bip, ebip, ebip_minus, particle_filter
from torch_ebip.interaction import InteractionEnsembleFilter
from torch_ebip.interaction.attribution import affine_coefficients

MAKERS = {
    "ebip": lambda p: ebip(p, inflation=1.01),
    "weighted": lambda p: ebip(p, square_root=True, weigh=True),
    "ebip_minus": lambda p: ebip_minus(p, 40),
    "bip": bip,
    "particle_filter": lambda p: particle_filter(p, residual_variance=1e4 * p.residual_variance),
}


@pytest.mark.filterwarnings("ignore:no mixture of up to")
@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_forecast_is_the_combination(name: str, dtype: torch.dtype) -> None:
    primitive = small_primitive(dtype)
    made: Filter = MAKERS[name](primitive)
    y, observed = interactions(3, seed=7, dtype=dtype).pad()
    seen = observed[:, :20] & torch.tensor([True, True, True, False, False])
    with torch.no_grad():
        trace = made(y[:, :20], seen, generator=torch.Generator().manual_seed(0))
        coefficients = made.attribution(trace.state)
        mean = made.forecast(trace.state, torch.tensor([0.5, 1.0])).mean
    assert coefficients.shape == (3, 24)
    torch.testing.assert_close(coefficients.sum(-1), torch.ones(3, dtype=dtype), atol=1e-4, rtol=0)
    paths = primitive.basis.project(torch.tensor([[0.5], [1.0]], dtype=dtype), primitive.weights)  # [2, 24, 5]
    combined = torch.einsum("bi,pid->bpd", coefficients, paths)
    tolerance = 2e-3 if dtype is torch.float32 else 1e-9
    torch.testing.assert_close(combined, mean, atol=tolerance, rtol=tolerance)


def test_particles_count() -> None:
    """Particles are demonstrations: the coefficient is the share of weight on each."""
    primitive = small_primitive(torch.float64)
    made = particle_filter(primitive, residual_variance=1e3 * primitive.residual_variance)
    state, _ = made.update(made.initial_state(), torch.tensor([0.0, 1.0, 0.1, 0, 0]).double())
    torch.testing.assert_close(made.attribution(state), state.weights.detach(), atol=1e-8, rtol=1e-6)
    start = ebip(primitive).initial_state()
    torch.testing.assert_close(ebip(primitive).attribution(start), torch.full((24,), 1 / 24).double())


def test_what_leaves_the_span_is_refused() -> None:
    primitive = small_primitive()
    for made, reason in (
        (ebip(primitive, weight_noise=0.1), "weights have process noise"),
        (ebip(primitive, localise=True), "covariances are localised"),
        (bip(primitive, shrinkage=0.1), "the prior covariance is shrunk"),
    ):
        with pytest.raises(ValueError, match=reason):
            made.attribution(made.initial_state())
    with pytest.raises(ValueError, match="GaussianPrior knows no demonstrations"):
        InteractionEnsembleFilter(ebip(primitive).model, GaussianPrior(torch.zeros(32), torch.eye(32)), 24)
    model = StateSpace(torch.nn.Identity(), torch.nn.Identity(), None, MeasurementNoise(torch.ones(2)), 2, 1.0)
    with pytest.raises(ValueError, match="is over a phase model and a basis projection"):
        InteractionEnsembleFilter(model, ebip(primitive).prior, 24)
    with pytest.raises(ValueError, match="outside the span"):
        affine_coefficients(torch.randn(4, 9, generator=torch.Generator().manual_seed(0)), torch.ones(9))
