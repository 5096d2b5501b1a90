"""What was seen of late, against a weighted least-squares line in numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from torch_ebip import Update
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.recent import HOLD, Recent
from torch_ebip.filtering.updates.weighting import Seen


def seen(y: Tensor, observed: Tensor | None = None, trust: Tensor | None = None, rows: Tensor | None = None) -> Seen:
    """A sample; members are not looked at."""
    return Seen(y, observed, trust, rows, torch.zeros(1, 1), torch.zeros(1), None)


def remembered(recent: Recent, times: list[float], values: Tensor, trust: Tensor, until: float) -> Tensor:
    """The sums at a time, after values [T, D] at times, believed as far as trust [T, D]."""
    sums, now = recent.start(values.new_zeros(1, 1)), 0.0
    for time, y, counts in zip(times, values, trust, strict=True):
        sums = recent.learn(recent.forget(sums, values.new_tensor(time - now)), seen(y, None, counts))
        now = time
    return recent.forget(sums, values.new_tensor(until - now))


@given(st.integers(0, 10_000), st.integers(3, 12), st.floats(0.02, 0.3))
def test_it_is_the_line_of_weighted_least_squares(seed: int, count: int, window: float) -> None:
    """Whatever the clock, the gaps and the trust; far from 0, too."""
    draws = np.random.default_rng(seed)
    times = np.cumsum(draws.uniform(0.005, 0.06, count))
    values, trust = draws.standard_normal((count, 2)) + 1000.0, draws.uniform(0.1, 1, (count, 2))
    now = float(times[-1] + draws.uniform(0, 0.05))
    recent = Recent(torch.full((2,), 990.0, dtype=torch.float64), window)
    line = recent.line(remembered(recent, times.tolist(), torch.tensor(values), torch.tensor(trust), now))
    for d in range(2):
        weights = trust[:, d] * np.exp((times - now) / window)
        slope, intercept = np.polyfit(times - now, values[:, d], 1, w=np.sqrt(weights))
        spread = np.average((times - now - np.average(times - now, weights=weights)) ** 2, weights=weights)
        if spread > 1.01 * (0.1 * window) ** 2:
            assert bool(line.moves[d])
            np.testing.assert_allclose(line.velocity[d], slope, rtol=1e-5, atol=1e-5)
            np.testing.assert_allclose(line.value[d], intercept, rtol=1e-9)


def test_a_line_is_continued_and_believed_less_and_less() -> None:
    recent = Recent(torch.zeros(1, dtype=torch.float64))
    times, values = [0.01 * i for i in range(1, 30)], torch.arange(1, 30, dtype=torch.float64).unsqueeze(-1) * 0.02
    beliefs = []
    for late in (0.0, 0.1, 0.2, 0.6):
        line = recent.line(remembered(recent, times, values, torch.ones_like(values), 0.29 + late))
        assert float(line.velocity) == pytest.approx(2.0, rel=1e-6)
        assert float(line.value) == pytest.approx(2.0 * (0.29 + late), rel=1e-6)
        beliefs.append(float(line.belief))
    assert beliefs[0] > 0.97
    assert beliefs == sorted(beliefs, reverse=True)
    assert beliefs[-1] < math.exp(-0.5 * (0.6 / HOLD) ** 2)


def test_one_sample_has_no_slope_and_none_no_value() -> None:
    recent = Recent(torch.tensor([5.0, 5.0]))
    sums = recent.learn(
        recent.start(torch.zeros(1, 1)), seen(torch.tensor([7.0, math.nan]), torch.tensor([True, False]))
    )
    line = recent.line(sums)
    assert line.value.tolist() == [7.0, 0.0]
    assert line.belief.tolist() == [1.0, 0.0]
    assert not line.moves.any()
    for part in line[:3]:
        assert part.isfinite().all()


def test_what_is_not_believed_is_not_remembered() -> None:
    """A spike that robust weights take for one, a sensor that is rejected, what was not measured."""
    recent = Recent(torch.zeros(1))
    sums = recent.learn(recent.start(torch.zeros(1, 1)), seen(torch.tensor([1.0])))
    again = recent.forget(sums, torch.tensor(0.01))
    for sample in (
        seen(torch.tensor([1e6]), None, torch.tensor([0.0])),
        seen(torch.tensor([1e6]), torch.tensor([False])),
        seen(torch.tensor([math.nan]), torch.tensor([False]), torch.tensor([1.0])),
    ):
        assert torch.equal(recent.learn(again, sample), again)
    doubted = recent.line(
        recent.learn(recent.start(torch.zeros(1, 1)), seen(torch.tensor([3.0]), None, torch.tensor([0.01])))
    )
    assert float(doubted.belief) == pytest.approx(0.01)


def test_a_view_writes_into_the_memory_of_all() -> None:
    recent = Recent(torch.zeros(4))
    part = recent.select(View(torch.tensor([1, 3]), torch.tensor([0])))
    sums = part.learn(part.start(torch.zeros(1, 1)), seen(torch.tensor([2.0]), rows=torch.tensor([1])))
    assert recent.line(sums).value.tolist() == [0, 0, 0, 2.0]
    narrower = part.select(View(torch.tensor([0]), torch.tensor([0])))
    assert recent.line(narrower.learn(sums, seen(torch.tensor([4.0])))).value.tolist() == [0, 4.0, 0, 2.0]


def test_several_windows_remember_what_each_would_alone() -> None:
    """Also with clocks of each entry, and what was not seen."""
    draws = torch.Generator().manual_seed(0)
    windows = (0.03, 0.2, 1.0)
    together, apart = Recent(torch.ones(3), *windows[:1], windows[1:]), [Recent(torch.ones(3), w) for w in windows]
    all_sums, each = together.start(torch.zeros(2, 1, 1)), [part.start(torch.zeros(2, 1, 1)) for part in apart]
    for _ in range(40):
        dt = 0.05 * torch.rand(2, generator=draws)
        sample = seen(torch.randn(2, 3, generator=draws), torch.rand(2, 3, generator=draws) > 0.3)
        all_sums = together.learn(together.forget(all_sums, dt), sample)
        each = [part.learn(part.forget(sums, dt), sample) for part, sums in zip(apart, each, strict=True)]
    lines = together.lines(all_sums)
    for w, (part, sums) in enumerate(zip(apart, each, strict=True)):
        for ours, theirs in zip(lines, part.line(sums), strict=True):
            torch.testing.assert_close(ours[:, w], theirs)
    for ours, theirs in zip(together.line(all_sums), lines, strict=True):
        torch.testing.assert_close(ours, theirs[:, 0])


def test_entries_of_a_batch_have_clocks_of_their_own() -> None:
    recent = Recent(torch.zeros(1, dtype=torch.float64))
    y = torch.tensor([[1.0], [2.0]], dtype=torch.float64)
    sums = recent.learn(recent.start(torch.zeros(2, 1, 1)), seen(y))
    sums = recent.forget(sums, torch.tensor([0.01, 0.02], dtype=torch.float64))
    alone = [recent.forget(sums[i], sums.new_tensor(0.0)) for i in range(2)]
    torch.testing.assert_close(sums, torch.stack(alone))
    assert sums[0, 1, 0] == pytest.approx(-0.01 * math.exp(-0.01 / 0.03))


def test_gradients_reach_what_was_measured() -> None:
    recent = Recent(torch.zeros(1, dtype=torch.float64))

    def said(a: Tensor, b: Tensor, dt: Tensor) -> tuple[Tensor, ...]:
        sums = recent.forget(recent.learn(recent.start(torch.zeros(1, 1)), seen(a)), dt)
        return recent.line(recent.learn(sums, seen(b)))[:3]

    values = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in ([0.4], [0.9], 0.02)]
    assert torch.autograd.gradcheck(said, values)


def test_what_does_not_fit_is_named() -> None:
    with pytest.raises(ValueError, match="window"):
        Recent(torch.zeros(2), 0.0)
    assert Update(recent=Recent(torch.zeros(2))).parts[-1].extra_repr() == "window=0.03 s"
