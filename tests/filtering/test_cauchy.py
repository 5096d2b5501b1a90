"""Cauchy's weights against the formula, on every carrier, and with gradients."""

import pytest
import torch

from tests.conftest import interactions, small_primitive
from torch_ebip import Cauchy, LiveFilter, ebip

HUMAN = torch.tensor([True, True, True, False, False])


def test_weights_and_deviations_are_those_of_the_formula() -> None:
    y, mean, spread, deviation = (torch.tensor(v).double() for v in ([9.0, 1.5], [1.0, 1.0], [3.0, 1.0], [0.5, 2.0]))
    trusted = Cauchy(1.7).double()(y, mean, spread, deviation)
    S = spread.numpy() + deviation.numpy() ** 2
    weight = 1 / (1 + (y - mean).numpy() ** 2 / S / 1.7**2)
    assert trusted.weight.tolist() == pytest.approx(weight.tolist(), rel=1e-6)
    assert (spread + trusted.deviation.square()).tolist() == pytest.approx((S / weight).tolist(), rel=1e-6)


def test_gradients_are_right() -> None:
    cauchy = Cauchy().double()
    arguments = [torch.tensor([v], dtype=torch.float64, requires_grad=True) for v in (4.0, 1.0, 0.5, 0.7)]

    def trusted(raw: torch.Tensor, *arguments: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        with torch.no_grad():
            cauchy.scale.raw.copy_(raw)
        scale = cauchy.scale.start * (cauchy.scale.floor + (1 - cauchy.scale.floor) * raw.exp())
        z = (arguments[0] - arguments[1]) / (arguments[2] + arguments[3].square()).sqrt()
        return 1 + (z / scale).square(), cauchy(*arguments).deviation

    raw = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda *a: cauchy(*a)[1:], arguments)
    inverse, _ = trusted(raw, *arguments)
    expected = torch.autograd.grad(inverse, raw)[0]
    found = torch.autograd.grad(1 / cauchy(*arguments).weight, cauchy.scale.raw)[0]
    torch.testing.assert_close(found, expected)


def test_both_engines_give_the_same_and_a_spike_does_little() -> None:
    made = ebip(small_primitive(torch.float64), square_root=True, robust=Cauchy())
    y = torch.where(HUMAN, interactions(2, seed=9, dtype=torch.float64)[1][:30], torch.nan)
    spiked = y.clone()
    spiked[10, :3] *= 1e4
    generator = torch.Generator().manual_seed(0)
    live = LiveFilter(made, HUMAN, generator=torch.Generator().manual_seed(0))
    dense = made(spiked, generator=generator)
    for t in range(30):
        if t:
            live.predict()
        live.update(spiked[t])
    torch.testing.assert_close(live.state.members, dense.state.members)
    clean = made(y, generator=torch.Generator().manual_seed(0))
    moved = (made.forecast(dense.state, 1.0).mean - made.forecast(clean.state, 1.0).mean).abs()
    assert (moved[0] < 0.5 * small_primitive(torch.float64).end_variance.sqrt()).all()
