"""Robust updates: what one wild value may do, against the formulas written out, and what they cost nothing for."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.conftest import interactions, small_primitive
from torch_ebip import (
    BSplineBasis,
    Filter,
    Gate,
    Huber,
    LiveFilter,
    RobustWeights,
    StudentT,
    View,
    bip,
    ebip,
    particle_filter,
)
from torch_ebip.filtering.updates.trust import FAR, LEAST

KINDS = {"student": StudentT(4.0), "huber": Huber(2.0), "gate": Gate(5.0)}
HUMAN = torch.tensor([True, True, True, False, False])


def make(kind: str, robust: RobustWeights | None) -> Filter:
    """Filters whose R is large enough for their innovations to be ordinary."""
    primitive = small_primitive(torch.float64)
    options: dict[str, Any] = {"residual_variance": 100 * primitive.residual_variance, "robust": robust}
    if kind == "bip":
        return bip(primitive, **options)
    if kind == "particle":
        return particle_filter(primitive, **options)
    if kind == "ebip":
        return ebip(primitive, **options)
    return ebip(primitive, square_root=True, weigh=True, inflation=1.01, context=BSplineBasis(4), **options)


@pytest.mark.parametrize(
    ("robust", "z", "weight"),
    [
        (StudentT(4.0), 0.9, 1.0),
        (StudentT(4.0), 3.0, 5 / 13),
        (StudentT(4.0), -1000.0, 5 / 1_000_004),
        (Huber(2.0), 1.9, 1.0),
        (Huber(2.0), -8.0, 0.25),
        (Gate(5.0), 1.0, 1 / (1 + 0.2**8)),
        (Gate(5.0), 5.0, 0.5),
        (Gate(5.0), 25.0, 1 / (1 + 5.0**8)),
        (Gate(5.0), 1e4, LEAST),
        *((made, 2 * FAR, LEAST) for made in KINDS.values()),
    ],
)
def test_weights_are_the_published_ones_and_the_innovation_variance_grows_by_them(
    robust: RobustWeights, z: float, weight: float
) -> None:
    exact = robust.double()
    y, mean, spread, deviation = (torch.tensor([v], dtype=torch.float64) for v in (7.0, 1.0, 3.0, 0.5))
    variance = spread + deviation.square()
    y = mean + z * variance.sqrt()
    trusted = exact(y, mean, spread, deviation)
    torch.testing.assert_close(trusted.weight, torch.tensor([weight], dtype=torch.float64), rtol=1e-7, atol=0)
    torch.testing.assert_close(spread + trusted.deviation.square(), variance / trusted.weight)
    assert torch.equal(trusted.y, mean if abs(z) > FAR else y)


def test_a_thinned_sample_is_judged_by_its_own_noise() -> None:
    """Four like samples of noise R' are one of R' / 4."""
    y, mean, spread, deviation = (torch.tensor([v]) for v in (9.0, 0.0, 1.0, 2.0))
    alone = StudentT()(y, mean, spread, deviation)
    view = View(torch.tensor([0]), torch.tensor([0]), 4)
    four = StudentT().select(view)(y, mean, spread, deviation / 2)
    torch.testing.assert_close(four.weight, alone.weight)
    torch.testing.assert_close(four.deviation, alone.deviation / 2)


@pytest.mark.parametrize("robust", KINDS.values(), ids=KINDS)
def test_the_kalman_mean_moves_by_the_weighted_innovation(robust: RobustWeights) -> None:
    """Of what was measured, by w P/S (y - mean): with a square-root update the gain is Kalman's."""
    plain, made = (ebip(small_primitive(torch.float64), square_root=True, robust=r) for r in (None, robust))
    state = plain.predict(plain.initial_state(), 0.3, torch.Generator().manual_seed(0))
    h = plain.model.measurement(state.members)[:, 0]
    P, R = h.var(), plain.model.measurement_noise()[0] ** 2
    y = torch.full((5,), math.nan, dtype=torch.float64)
    y[0] = h.mean() + 6 * (P + R).sqrt()
    weight = 1 / made.analysis.trust[0].inverse(torch.tensor(6.0, dtype=torch.float64))
    assert weight < 0.5
    phase = torch.stack([state.members[:, 0], h])
    gain = torch.cov(phase)[0, 1] / (P + R)
    for filter, share in ((plain, 1.0), (made, weight)):
        moved = filter.update(state, y)[0].mean - state.mean
        torch.testing.assert_close(moved[0], share * gain * (y[0] - h.mean()))


@pytest.mark.parametrize("kind", ["bip", "particle", "ebip", "tuned"])
@pytest.mark.parametrize("robust", KINDS.values(), ids=KINDS)
def test_spikes_do_little_and_gradients_stay_finite(kind: str, robust: RobustWeights) -> None:
    """Every tenth sample is off, by anything up to what float64 holds: forecasts stay near those without it."""
    y, clean, spiked = sequence()
    made = make(kind, robust)
    expected = made.forecast(made(clean, generator=torch.Generator().manual_seed(0)).state, torch.ones(1)).mean
    for size in (1e2, 1e4, 1e9, 1e300):
        trace = made(torch.where(spiked, size * y, clean), generator=torch.Generator().manual_seed(0))
        forecast = made.forecast(trace.state, torch.ones(1)).mean
        distance = ((forecast - expected) / small_primitive(torch.float64).end_variance.sqrt()).abs().max()
        assert distance < 1.5, (size, distance)
        if kind == "particle":
            continue  # its forecast has no gradient without soft resampling
        made.zero_grad()
        forecast.sum().backward()
        assert all(p.grad.isfinite().all() for p in made.parameters() if p.grad is not None)


@pytest.mark.parametrize("kind", ["bip", "ebip", "tuned"])
def test_without_it_the_same_spikes_ruin_the_forecast(kind: str) -> None:
    y, clean, spiked = sequence()
    made = make(kind, None)
    wild = made(torch.where(spiked, 1e4 * y, clean), generator=torch.Generator().manual_seed(0)).state
    tame = made(clean, generator=torch.Generator().manual_seed(0)).state
    distance = (made.forecast(wild, torch.ones(1)).mean - made.forecast(tame, torch.ones(1)).mean).abs()
    assert (distance / small_primitive(torch.float64).end_variance.sqrt()).max() > 5


def sequence() -> tuple[Tensor, Tensor, Tensor]:
    """An interaction of which the human is seen, without every tenth sample, and where these are."""
    y = interactions(2, seed=9, dtype=torch.float64)[1][:40].clone()
    y = torch.where(HUMAN, y, torch.nan)
    spiked = torch.zeros(40, 5, dtype=torch.bool)
    spiked[4::10] = HUMAN
    return torch.nan_to_num(y), torch.where(spiked, torch.nan, y), spiked


def test_the_scale_is_learned_from_forecasts() -> None:
    """Where every tenth sample is off, gradient descent on the forecast's error makes the tails heavier."""
    y, clean, spiked = sequence()
    made, end = make("bip", StudentT(100.0)), torch.ones(1)
    with torch.no_grad():
        plain = make("bip", None)
        target = plain.forecast(plain(clean).state, end).mean
    scale = made.trust[0].scale
    optimizer = torch.optim.Adam([scale.raw], lr=0.5)
    losses = []
    for _ in range(20):
        state = made(torch.where(spiked, 3 * y, clean)).state
        losses.append((made.forecast(state, end).mean - target).square().sum())
        optimizer.zero_grad()
        losses[-1].backward()
        optimizer.step()
    assert scale.value < 5
    assert losses[-1] < 0.01 * losses[0]


def test_infinity_is_still_refused() -> None:
    made = make("tuned", StudentT())
    y = torch.zeros(5, dtype=torch.float64)
    y[1] = math.inf
    for filter in (made, LiveFilter(made)):
        with pytest.raises(ValueError, match=r"in DoFs \[1\]"):
            filter.update(*((made.initial_state(), y) if filter is made else (y,)))


def test_a_scale_must_be_positive() -> None:
    with pytest.raises(ValueError, match="above 0"):
        StudentT(0.0)


@pytest.mark.parametrize("robust", KINDS.values(), ids=KINDS)
def test_one_wild_sample_alone_does_not_choose_the_demonstration(robust: RobustWeights) -> None:
    """Nothing else is known yet: the weights stay about even, where without robust updates one demonstration wins."""
    sizes = {}
    for kind in (None, robust):
        made = ebip(small_primitive(torch.float64), weigh=True, robust=kind)
        y = torch.full((5,), math.nan, dtype=torch.float64)
        y[0] = 1000 * small_primitive(torch.float64).value_variance[0].sqrt()
        weights = made.update(made.initial_state(), y, generator=torch.Generator().manual_seed(0))[0].weights
        sizes[kind] = float(1 / weights.detach().square().sum())
    assert sizes[None] < 3
    assert sizes[robust] > 20  # of 24
