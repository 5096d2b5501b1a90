"""The read-out by horizon against numpy written from its docstring."""

import copy
import math

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from torch_ebip import HorizonShrinkage, ebip
from torch_ebip.common.draws import seeded
from torch_ebip.interaction.horizons import LEVELS, SECONDS

S, J = len(SECONDS), len(LEVELS)


def state_of(filter, length=15):
    made = interactions(3, seed=5, dtype=torch.float64)
    y = made[0][:length].clone()
    y[:, 3:] = torch.nan
    with torch.no_grad():
        return filter(y, generator=torch.Generator().manual_seed(0)).state


def readout(seed: int = 0) -> HorizonShrinkage:
    draws = torch.Generator().manual_seed(seed)
    share = torch.rand(5, S, J, generator=draws, dtype=torch.float64)
    return HorizonShrinkage(share, 0.5 + torch.rand(5, S, generator=draws, dtype=torch.float64))


@pytest.mark.parametrize("ahead", [None, [0.0, 0.1, 0.3, 0.8, 50.0, math.inf]])
def test_every_number_is_that_of_the_formula(ahead: list[float] | None) -> None:
    primitive = small_primitive(torch.float64)
    filter = ebip(primitive, square_root=True, weigh=True)
    state = state_of(filter)
    asked = {"phase": [0.5, 0.8, 0.97, 1.0]} if ahead is None else {"ahead": ahead}
    with torch.no_grad():
        alone = filter.forecast(state, **asked)
        now, velocity = float(filter.phase(state)), float(filter.phase_velocity(state))
        filter.readout = readout()
        drawn = filter.forecast(state, **asked)
    share, widening, near = filter.readout.share.numpy(), filter.readout.widening.numpy(), SECONDS[:-1]
    for i, phase in enumerate(alone.phase.tolist()):
        seconds = np.clip(max(phase - now, 0) / velocity, near[0], near[-1])
        end = max(phase - 0.95, 0) / 0.05 if ahead is None else float(math.isinf(ahead[i]))
        paths = primitive.basis.project(torch.full((24,), phase, dtype=torch.float64), primitive.weights).numpy()
        for d in range(5):
            own, apart = float(alone.variance[i, d]) ** 0.5, paths[:, d].std(ddof=1)
            level = np.clip(own / apart, LEVELS[0], LEVELS[-1])
            by_level = [
                (1 - end) * np.interp(seconds, near, share[d, :-1, j]) + end * share[d, -1, j] for j in range(J)
            ]
            s = np.interp(level, LEVELS, by_level)
            mean = paths[:, d].mean()
            np.testing.assert_allclose(
                float(drawn.mean[i, d]), mean + s * (float(alone.mean[i, d]) - mean), rtol=1e-8
            )
            stretched = (1 - end) * np.interp(seconds, near, widening[d, :-1]) + end * widening[d, -1]
            wanted = ((1 - s) * apart + s * own) * stretched
            np.testing.assert_allclose(float(drawn.variance[i, d]) ** 0.5, wanted, rtol=1e-8)
    weights = alone.weights.unsqueeze(-1)
    assert torch.allclose((weights * drawn.members).sum(-2), drawn.mean)
    spread = (weights * (drawn.members - drawn.mean.unsqueeze(-2)).square()).sum(-2)
    before = (weights * (alone.members - alone.mean.unsqueeze(-2)).square()).sum(-2)
    assert torch.allclose(spread / drawn.variance, before / alone.variance, rtol=1e-6)


def test_it_narrows_and_follows_with_the_filter() -> None:
    filter = ebip(small_primitive(torch.float64), square_root=True)
    filter.readout = readout()
    some = torch.tensor([True, True, False, False, True])
    part = filter.restrict(some)
    assert torch.equal(part.readout.share, filter.readout.share[some])
    assert copy.deepcopy(filter).float().readout.widening.dtype == torch.float32
    whole, narrow = (each.forecast(each.initial_state(), ahead=[0.2, 0.7]) for each in (filter, part))
    assert torch.allclose(whole.mean[:, some], narrow.mean)
    assert torch.allclose(whole.variance[:, some], narrow.variance)


def test_a_batch_equals_a_loop_and_gradients_are_finite() -> None:
    filter = ebip(small_primitive(torch.float64), square_root=True, weigh=True)
    filter.readout = readout()
    y = torch.stack([made[:20] for made in interactions(3, seed=5, dtype=torch.float64)])
    y[..., 3:] = torch.nan
    trace = filter(y, generator=[seeded(i) for i in range(3)])
    together = filter.forecast(trace.state, ahead=[0.1, 1.0, math.inf])
    for b in range(3):
        alone = filter.forecast(filter(y[b], generator=seeded(b)).state, ahead=[0.1, 1.0, math.inf])
        assert torch.allclose(together.mean[b], alone.mean)
        assert torch.allclose(together.variance[b], alone.variance)
    (together.mean.sum() + together.variance.sum()).backward()
    gradients = [parameter.grad for parameter in filter.parameters() if parameter.grad is not None]
    assert gradients
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)


def test_a_phase_that_stands_still_is_the_farthest_horizon() -> None:
    filter = ebip(small_primitive(torch.float64))
    filter.readout = readout()
    state = filter.initial_state()
    members = state.deviations.clone()
    members[:, 1] = 0
    said = filter.forecast(state._replace(deviations=members), [0.5, 1.0])
    assert bool(said.mean.isfinite().all() & said.variance.isfinite().all())


@pytest.mark.parametrize(
    ("share", "widening", "options", "message"),
    [
        (torch.full((2, S, J), 1.5), torch.ones(2, S), {}, "share must be .* between 0 and 1"),
        (torch.ones(2, S), torch.ones(2, S), {}, "share must be"),
        (torch.ones(2, S, J), torch.zeros(2, S), {}, "widening must be .* and positive"),
        (torch.ones(2, S, J), torch.ones(2, J), {}, "widening must be"),
        (
            torch.ones(2, 2, J),
            torch.ones(2, 2),
            {"seconds": [0.5, 0.5]},
            "seconds must increase",
        ),
        (torch.ones(2, S, 1), torch.ones(2, S), {"levels": [-0.5]}, "levels must increase from 0"),
        (torch.ones(2, S, 0), torch.ones(2, S), {"levels": []}, "levels must increase"),
    ],
)
def test_bad_settings_are_named(share, widening, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        HorizonShrinkage(share, widening, **options)
