"""Forecasts by seconds, and drawn towards the demonstrations: against numpy written from the definitions."""

import copy
import math

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from torch_ebip import Forecast, Shrinkage, bip, ebip, particle_filter
from torch_ebip.interaction.readout import Lead
from torch_ebip.interaction.shrinkage import LEADS

SHOWN = torch.tensor([True, True, True, False, False])


def state_of(filter, length=15):
    made = interactions(3, seed=5, dtype=torch.float64)
    y = made[0][:length].clone()
    y[:, 3:] = torch.nan
    return filter(y, generator=torch.Generator().manual_seed(0)).state


@pytest.mark.parametrize("options", [{}, {"square_root": True, "weigh": True}])
def test_seconds_ahead_are_each_members_own(options: dict) -> None:
    primitive = small_primitive(torch.float64)
    filter = ebip(primitive, **options)
    state = state_of(filter)
    ahead = [0.0, 0.1, 0.7, math.inf]
    with torch.no_grad():
        said = filter.forecast(state, ahead=ahead)
        members = state.members.numpy()
    weights = np.full(len(members), 1 / len(members)) if state.weights is None else state.weights.detach().numpy()
    for i, seconds in enumerate(ahead):
        phase = (
            np.ones(len(members)) if seconds == math.inf else members[:, 0] + np.maximum(members[:, 1], 0) * seconds
        )
        phase = np.minimum(phase, 1.0)
        values = primitive.basis.project(torch.tensor(phase), torch.tensor(members[:, 2:])).numpy()
        mean = weights @ values
        unbiased = 1 - (weights**2).sum()
        variance = weights @ (values - mean) ** 2 / unbiased
        np.testing.assert_allclose(said.mean[i].numpy(), mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(said.variance[i].numpy(), variance, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(float(said.phase[i]), weights @ phase, rtol=1e-9)
    end = filter.forecast(state, 1.0)
    np.testing.assert_allclose(said.mean[-1].numpy(), end.mean[0].detach().numpy(), rtol=1e-9)
    np.testing.assert_allclose(said.variance[-1].numpy(), end.variance[0].detach().numpy(), rtol=1e-6)


@pytest.mark.parametrize("make", [particle_filter, bip])
def test_other_filters_forecast_by_seconds_too(make) -> None:
    filter = make(small_primitive(torch.float64))
    state = state_of(filter)
    with torch.no_grad():
        said = filter.forecast(state, ahead=[0.2, math.inf])
        end = filter.forecast(state, 1.0)
    assert torch.allclose(said.mean[1], end.mean[0])
    assert torch.allclose(said.variance[1], end.variance[0], rtol=1e-5)
    assert 0 < float(said.phase[0]) <= 1


def test_members_that_run_backwards_wait() -> None:
    """However far ahead: they have no end to come to, and nothing runs out of the interaction at its beginning."""
    filter = ebip(small_primitive(torch.float64))
    state = filter.initial_state()
    members = state.deviations.clone()
    members[:, 1] = -0.7
    back = state._replace(deviations=members)
    said = filter.forecast(back, ahead=[0.0, 1.0, 1e6])
    assert torch.equal(said.phase[0], said.phase[2])
    assert torch.equal(said.mean[0], said.mean[2])


def test_a_live_forecast_does_not_look_at_all_demonstrations_again(monkeypatch: pytest.MonkeyPatch) -> None:
    filter = ebip(small_primitive(torch.float64))
    filter.readout = Shrinkage(torch.full((5, 5), 0.5, dtype=torch.float64))
    state, looked = filter.initial_state(), []
    basis = filter.basis_projection.basis
    whole = type(basis).variances
    monkeypatch.setattr(type(basis), "variances", lambda self, weights: looked.append(1) or whole(self, weights))
    first = filter.forecast(state, 1.0)
    filter.forecast(state, 0.5)
    assert len(looked) == 1
    with torch.no_grad():
        filter.prior.states[:, 2:] *= 2.0
    assert not torch.equal(filter.forecast(state, 1.0).mean, first.mean)
    assert len(looked) == 2


def test_seconds_that_are_none_are_refused() -> None:
    filter = ebip(small_primitive(torch.float64))
    state = filter.initial_state()
    for ahead in ([-0.1], [math.nan], [[0.1]]):
        with pytest.raises(ValueError, match=r"ahead must be seconds \[P\], 0 or more"):
            filter.forecast(state, ahead=ahead)
    with pytest.raises(ValueError, match="got both"):
        filter.forecast(state, 1.0, ahead=0.1)


def test_mean_and_deviation_lie_between_demonstrations_and_filter() -> None:
    primitive = small_primitive(torch.float64)
    filter = ebip(primitive, square_root=True, weigh=True)
    state = state_of(filter)
    with torch.no_grad():
        alone = filter.forecast(state, [0.6, 1.0])
        now = float(filter.phase(state))
        share = torch.linspace(0.2, 1.0, 5, dtype=torch.float64).repeat(5, 1)
        filter.readout = Shrinkage(share)
        drawn = filter.forecast(state, [0.6, 1.0])
    paths = np.stack(
        [primitive.basis.project(torch.full((24,), p, dtype=torch.float64), primitive.weights) for p in (0.6, 1.0)]
    )
    for i, phase in enumerate((0.6, 1.0)):
        s = np.interp(max(phase - now, 0), LEADS, [0.2, 0.4, 0.6, 0.8, 1.0])
        mean, deviation = paths[i].mean(0), paths[i].std(0, ddof=1)
        np.testing.assert_allclose(drawn.mean[i], mean + s * (alone.mean[i].numpy() - mean), rtol=1e-9)
        wanted = (1 - s) * deviation + s * alone.variance[i].sqrt().numpy()
        np.testing.assert_allclose(drawn.variance[i].sqrt(), wanted, rtol=1e-9)
    # What members say is what is said of them.
    spread = (drawn.members - drawn.mean.unsqueeze(-2)).square()
    ratio = (alone.members - alone.mean.unsqueeze(-2)).square()
    weights = alone.weights.unsqueeze(-1)
    assert torch.allclose((weights * drawn.members).sum(-2), drawn.mean)
    assert torch.allclose(
        (weights * spread).sum(-2) / drawn.variance, (weights * ratio).sum(-2) / alone.variance, rtol=1e-6
    )


def test_one_is_the_filter_and_nothing_is_the_mean() -> None:
    filter = ebip(small_primitive(torch.float64))
    state = state_of(filter)
    with torch.no_grad():
        alone = filter.forecast(state, 1.0)
        filter.readout = Shrinkage(torch.ones(5, 5, dtype=torch.float64))
        assert torch.allclose(filter.forecast(state, 1.0).mean, alone.mean)
        filter.readout = Shrinkage(torch.zeros(5, 5, dtype=torch.float64))
        drawn = filter.forecast(state, 1.0)
        mean, variance = filter.demonstrated(torch.ones(1, dtype=torch.float64))
    assert torch.allclose(drawn.mean, mean)
    assert torch.allclose(drawn.variance, variance)


def test_it_narrows_and_follows_with_the_filter() -> None:
    filter = ebip(small_primitive(torch.float64), square_root=True)
    share = torch.linspace(0.1, 1.0, 25, dtype=torch.float64).view(5, 5)
    filter.readout = Shrinkage(share)
    some = torch.tensor([True, True, False, False, True])
    part = filter.restrict(some)
    assert torch.equal(part.readout.share, share[some])
    assert copy.deepcopy(filter).float().readout.share.dtype == torch.float32
    whole, narrow = (each.forecast(each.initial_state(), 1.0) for each in (filter, part))
    assert torch.allclose(whole.mean[:, some], narrow.mean)


def test_shares_outside_their_range_are_refused() -> None:
    with pytest.raises(ValueError, match=r"share must be \[D, 5\] between 0 and 1"):
        Shrinkage(torch.full((2, 5), 1.5))
    with pytest.raises(ValueError, match="leads must be at least two, and increase"):
        Shrinkage(torch.ones(2, 2), leads=[0.5, 0.5])
    half = Shrinkage(torch.full((1, 5), 0.5))
    same = Forecast(torch.tensor([[2.0]]), torch.tensor([[0.0]]), torch.ones(1), torch.full((1, 3, 1), 2.0))
    lead = Lead(*torch.tensor([[0.3], [0.5], [1.0], [0.0]]))
    drawn = half(same, lead, torch.tensor([[0.0]]), torch.tensor([[9.0]]))
    assert drawn.members.isfinite().all()
