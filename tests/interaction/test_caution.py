"""Tails, doubt and bounds: against numpy, and for every forecast there can be."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import interactions, small_primitive
from tests.interaction.surprised import cautious
from torch_ebip import Forecast, ebip
from torch_ebip.interaction.bounds import Bounds, demonstrated_range
from torch_ebip.interaction.doubt import ELSEWHERE, Doubt
from torch_ebip.interaction.readout import Lead
from torch_ebip.interaction.tail import BODY, Tail, as_chances


def test_a_tail_is_the_empirical_one_and_behind_it_the_exponential() -> None:
    """Of exponential draws the chance of a large value is right within a few standard errors of Hill's estimate."""
    draws = np.random.default_rng(0).exponential(2.0, (400, 2)) * np.array([1.0, 0.1])
    tail = Tail.fit(torch.tensor(draws))
    x = torch.tensor([[0.7, 0.07], [3.0, 0.3], [12.0, 1.2]], dtype=torch.float64)
    found, true = tail.above(x), np.exp(-x.numpy() / np.array([2.0, 0.2]))
    np.testing.assert_allclose(found[:2], true[:2], atol=0.06)
    np.testing.assert_allclose(found[2], true[2], rtol=0.6)
    empirical = (draws[None] > x.numpy()[:1, None]).mean(1)
    np.testing.assert_allclose(found[:1], empirical, atol=0.05)
    for chance in (0.1, 0.01, 0.001):
        np.testing.assert_allclose(tail.above(tail.at(chance).unsqueeze(0)), chance, rtol=1e-9)


def test_chances_fall_from_one() -> None:
    tail = Tail.fit(torch.randn(50, 1, generator=torch.Generator().manual_seed(0)))
    said = tail.above(torch.linspace(-9, 9, 400).unsqueeze(-1)).squeeze(-1)
    assert (said.diff() <= 1e-6).all()
    assert float(said[0]) >= 0.95
    assert 0 < float(said[-1]) < 1e-4


def test_what_was_always_the_same_is_not_rare() -> None:
    tail = Tail.fit(torch.full((40, 1), -1.5))
    assert float(tail.above(torch.tensor([-1.5]))) > 0.9
    assert float(tail.above(torch.tensor([-1.4]))) < 0.01


def test_too_few_values_have_no_tail() -> None:
    with pytest.raises(ValueError, match="at least 20 finite values"):
        Tail.fit(torch.rand(19, 1))
    with pytest.raises(ValueError, match="at least 20 finite values"):
        Tail.fit(torch.full((30, 1), math.nan))
    with pytest.raises(ValueError, match="must not decrease"):
        Tail(torch.linspace(1, 0, len(BODY)).unsqueeze(0), torch.ones(1))
    with pytest.raises(ValueError, match="quantiles must be"):
        Tail(torch.zeros(1, 3), torch.ones(1))
    assert as_chances(0.05, 0.001) == {"suspect": 0.05, "rejected": 0.001}


@given(st.floats(-1e6, 1e6), st.floats(0, 1e3), st.floats(0, 10))
def test_bounds_hold_whatever_is_said(mean: float, variance: float, apart: float) -> None:
    """Never a quarter of the width outside; all of the range within four deviations; inside nothing changes."""
    low, high = torch.tensor([-1.0], dtype=torch.float64), torch.tensor([3.0], dtype=torch.float64)
    said = Forecast(*(torch.tensor([[x]], dtype=torch.float64) for x in (mean, variance)), torch.ones(1))
    held = Bounds(low, high)(said, torch.tensor([[apart]], dtype=torch.float64))
    assert -2.0 <= float(held.mean) <= 4.0
    assert float(held.variance) >= variance * (1 - 1e-12)
    if -1 <= mean <= 3:
        assert torch.equal(held.mean, said.mean)
        assert torch.equal(held.variance, said.variance)
    if not -7 <= mean <= 9:
        reach = 4 * float(held.variance.sqrt())
        assert float(held.mean) - reach <= -1
        assert float(held.mean) + reach >= 3
        assert float(held.variance) >= apart


def test_bounds_move_members_too_and_take_no_unit_for_another() -> None:
    bounds = Bounds(torch.zeros(1), torch.ones(1))
    members = torch.tensor([[[4.9], [5.1]]])
    said = Forecast(torch.tensor([[5.0]]), torch.tensor([[0.02]]), torch.ones(1), members)
    held = bounds(said, torch.tensor([[0.09]]))
    torch.testing.assert_close(held.members.mean(-2), held.mean)
    torch.testing.assert_close(held.members.var(-2), held.variance)
    larger = Bounds(torch.zeros(1), 1000 * torch.ones(1))(
        Forecast(1000 * said.mean, 1e6 * said.variance, said.phase), torch.tensor([[9e4]])
    )
    torch.testing.assert_close(larger.mean, 1000 * held.mean)
    torch.testing.assert_close(larger.variance, 1e6 * held.variance)
    with pytest.raises(ValueError, match="the first not above the second"):
        Bounds(torch.ones(1), torch.zeros(1))


def test_far_outside_a_range_of_no_width_gradients_are_finite() -> None:
    """A DoF that never moved: where it is said to be is held, and what was said gets no NaN."""
    mean = torch.tensor([[7.0]], requires_grad=True)
    said = Forecast(mean, torch.tensor([[0.5]]), torch.ones(1))
    held = Bounds(torch.tensor([2.0]), torch.tensor([2.0]))(said, torch.tensor([[0.1]]))
    assert float(held.mean) == 2.0
    (held.mean + held.variance).sum().backward()
    assert mean.grad.isfinite().all()


def test_the_range_is_that_of_the_demonstrations() -> None:
    primitive = small_primitive(torch.float64)
    low, high = demonstrated_range(primitive)
    phase = torch.linspace(0, 1, 51, dtype=torch.float64)
    paths = np.stack([primitive.basis.project(phase, w.expand(51, -1)).numpy() for w in primitive.weights])
    np.testing.assert_allclose(low, paths.min((0, 1)))
    np.testing.assert_allclose(high, paths.max((0, 1)))


def test_doubt_is_the_formula() -> None:
    """Between its levels, and at the last of them with nobody knowing the moment; the end is the end."""
    doubt = Doubt(
        torch.tensor([1.0, 0.6, 0.2]),
        torch.tensor([0.0, 1.0, 3.0]),
        torch.tensor([2.0, 7.0]),
        (1.0, 2.0, 4.0),
        torch.tensor([0.0, 4.0, 6.0]),
    )
    f, v = torch.tensor([[3.0, -1.0], [5.0, 2.0]]), torch.tensor([[0.5, 0.1], [0.2, 0.3]])
    m, w = torch.tensor([[1.0, 1.0], [2.0, 2.0]]), torch.tensor([[0.4, 0.4], [0.1, 0.1]])
    end = torch.tensor([0.0, 1.0])
    lead = Lead(torch.rand(2), torch.rand(2), torch.rand(2), end)
    said = Forecast(f, v, torch.rand(2))
    assert doubt(said, lead, m, w, torch.tensor(0.9)) is said
    for level, share, widening, inflation, lost in (
        (1.5, 0.8, 0.5, 2.0, 0.0),
        (3.0, 0.4, 2.0, 5.0, 0.5),
        (9.0, 0.2, 3.0, 6.0, 1.0),
    ):
        ours = doubt(said, lead, m, w, torch.tensor(level))
        anywhere = np.array([2.0, 7.0])
        unit = np.maximum(w.numpy() + ELSEWHERE * anywhere, lost * (1 - end.numpy())[:, None] * anywhere)
        np.testing.assert_allclose(ours.mean, m + share * (f - m), rtol=1e-5)
        np.testing.assert_allclose(ours.variance, share**2 * (1 + inflation) * v.numpy() + widening * unit, rtol=1e-5)


def test_who_is_not_surprised_says_what_it_said() -> None:
    """In a batch, to the bit, beside one that is."""
    doubt = Doubt(torch.tensor([1.0, 0.5]), torch.tensor([0.0, 1.0]), torch.ones(1), (1.0, 2.0))
    said = Forecast(torch.rand(2, 3, 1), torch.rand(2, 3, 1), torch.rand(2, 3))
    lead = Lead(*torch.rand(4, 2, 3))
    ours = doubt(said, lead, torch.rand(2, 3, 1), torch.rand(2, 3, 1), torch.tensor([0.3, 5.0]))
    assert torch.equal(ours.mean[0], said.mean[0])
    torch.testing.assert_close(ours.variance[0], said.variance[0])
    assert not torch.equal(ours.mean[1], said.mean[1])


def test_bad_doubts_are_refused() -> None:
    with pytest.raises(ValueError, match="levels must increase"):
        Doubt(torch.ones(2), torch.zeros(2), torch.ones(1), (2.0, 1.0))
    with pytest.raises(ValueError, match="shares must lie between 0 and 1"):
        Doubt(torch.tensor([1.0, 1.5]), torch.zeros(2), torch.ones(1), (1.0, 2.0))
    with pytest.raises(ValueError, match="not negative"):
        Doubt(torch.ones(2), torch.tensor([0.0, -1.0]), torch.ones(1), (1.0, 2.0))


def test_a_filter_that_runs_away_says_so() -> None:
    """A hand that is nowhere near: the plain filter is sure of what lies far outside, a cautious one is not."""
    primitive = small_primitive()
    plain, careful = ebip(primitive, square_root=True), cautious(primitive, square_root=True)
    y = torch.where(primitive.layout.controlled, torch.nan, interactions(3, seed=5)[1])
    y[:, :3] = 30.0 + torch.arange(len(y)).unsqueeze(-1)
    low, high = demonstrated_range(primitive)
    width, arm = high - low, primitive.layout.controlled
    sure, unsure = (f.forecast(f(y).state, 1.0).select(arm) for f in (plain, careful))
    outside = torch.maximum(sure.mean - high[arm], low[arm] - sure.mean) / width[arm]
    assert float(outside.max()) > 1
    assert bool(((unsure.mean <= high[arm] + width[arm] / 4) & (unsure.mean >= low[arm] - width[arm] / 4)).all())
    reach = 4 * unsure.variance.sqrt()
    assert bool((unsure.mean - reach <= low[arm]).all())
    assert bool((unsure.mean + reach >= high[arm]).all())
