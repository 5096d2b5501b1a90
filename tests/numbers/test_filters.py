"""Whole filters in units from 1e-12 to 1e12, with gaps, few or equal members and an R near nothing.

States, forecasts and gradients are finite, or there is a `ValueError` that says what is wrong, and only where R is
many orders of magnitude below what the basis misses.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.conftest import interactions
from torch_ebip import (
    BSplineBasis,
    Demonstrations,
    EnsembleFilter,
    Filter,
    InteractionPrimitive,
    LiveFilter,
    StackedBasis,
    StudentT,
    bip,
    ebip,
    ebip_minus,
    particle_filter,
)

SEEN = torch.tensor([True, True, True, False, False])
UNIT = [0, 0, 1, 2, 2]
"""The modality of each DoF."""
MAKE: dict[str, Callable[[InteractionPrimitive], Filter]] = {
    "closed form": ebip,
    "all options": lambda p: ebip(
        p, square_root=True, weigh=True, context=BSplineBasis(4), inflation=1.01, robust=StudentT()
    ),
    "localised": lambda p: ebip(p, localise=True, weight_noise=0.1),
    "mixture": lambda p: ebip_minus(p, 20, max_components=1),
    "bip": bip,
    "particle": lambda p: particle_filter(p, softness=0.1),
}
FLOOR = -50.0
"""Of a raw parameter: exp(-50) is nothing beside the floor that `Positive` keeps."""


@dataclass(frozen=True)
class Case:
    """What is asked.

    Attributes:
        exponents: of ten, the unit of each modality.
        members: which demonstrations; None for all.
        gaps: share of the values that are missing.
        floored: whether R is at its floor.
    """

    kind: str
    dtype: torch.dtype
    exponents: tuple[int, ...]
    count: int
    members: tuple[int, ...] | None
    gaps: float
    floored: bool
    seed: int


@st.composite
def cases(draw: st.DrawFn, kinds: tuple[str, ...]) -> Case:
    count = draw(st.sampled_from([2, 3, 8]))  # 6 x 5 weights: always fewer members than weights
    members = st.lists(st.integers(0, count - 1), min_size=2, max_size=12).map(tuple)
    return Case(
        draw(st.sampled_from(kinds)),
        draw(st.sampled_from([torch.float32, torch.float64])),
        tuple(draw(st.integers(-12, 12)) for _ in range(3)),
        count,
        draw(st.one_of(st.none(), members, members.map(lambda chosen: (chosen[0],) * len(chosen)))),
        draw(st.sampled_from([0.0, 0.3, 0.9, 1.0])),
        draw(st.booleans()),
        draw(st.integers(0, 1000)),
    )


class Problem:
    """A filter and what it sees."""

    def __init__(self, case: Case) -> None:
        made = interactions(case.count + 1, case.seed, dtype=torch.float64)
        self.unit = 10.0 ** torch.tensor(case.exponents, dtype=torch.float64)[UNIT]
        trajectories = [(trajectory * self.unit).to(case.dtype) for trajectory in made]
        known = Demonstrations(made.layout, trajectories[1:], made.rate)
        self.unit = self.unit.to(case.dtype)
        self.filter = MAKE[case.kind](InteractionPrimitive.fit(known, StackedBasis([BSplineBasis(6)] * 5)))
        if case.floored:
            with torch.no_grad():
                self.filter.model.measurement_noise.variance.raw.fill_(FLOOR)
        self.members = None if case.members is None else torch.tensor(case.members)
        self.y = trajectories[0][:20]
        generator = torch.Generator().manual_seed(case.seed)
        self.observed = SEEN & ~self.y.isnan() & (torch.rand(20, 5, generator=generator) >= case.gaps)
        self.generator = generator


NAMED = r"cannot be factored|not finite|hold NaN"
"""What errors say that say what is wrong with numbers."""


def assert_allowed(error: ValueError, case: Case) -> None:
    """Errors say what is wrong, and come only where R is at its floor."""
    assert case.floored
    assert re.search(NAMED, str(error))


WILD = 1e3
"""Interactions a second. With R at its floor, a thousandth of what the basis misses, few members can throw the phase
away by more with each update, and gradients through all of them are products as large."""
MICROMETRES = Case("mixture", torch.float32, (0, -6, 0), 2, None, 0.0, True, 1)
"""A small unit and R at its floor: squares of the deviation's inverse are more than float32 holds."""

TWO = Case("bip", torch.float32, (0, 0, 0), 2, None, 0.0, False, 1)
"""A prior covariance of rank one."""


@settings(max_examples=60)
@given(cases(tuple(MAKE)))
@example(MICROMETRES)
@example(TWO)
@example(replace(TWO, floored=True, seed=0))
def test_finite_or_a_named_error(case: Case) -> None:
    problem = Problem(case)
    made, unit = problem.filter, problem.unit
    failure = None
    state = made.initial_state(demonstrations=problem.members, generator=problem.generator)
    try:
        trace = made(problem.y, problem.observed, state=state, generator=problem.generator)
    except ValueError as error:
        failure = error
    if failure is not None:
        assert_allowed(failure, case)
        return
    forecast = made.forecast(trace.state, torch.tensor([0.5, 1.0], dtype=case.dtype))
    values: list[Tensor] = [trace.phase, trace.log_likelihood, trace.projection, forecast.mean, forecast.variance]
    if case.floored and not trace.state.mean[1].abs() < WILD:
        # Thrown away so far that the last update may have overflowed: then the next one must say so.
        if not trace.state.mean.isfinite().all():
            with pytest.raises(ValueError, match=NAMED):
                made.update(trace.state, torch.where(SEEN, made.project(trace.state), math.nan).nan_to_num())
        return
    assert all(value.isfinite().all() for value in (*values, trace.state.mean))
    assert (forecast.variance >= 0).all()
    deviation = forecast.variance / unit.square()
    ((forecast.mean / unit).sum() + deviation.sum() + trace.log_likelihood.sum()).backward()
    for name, parameter in made.named_parameters():
        assert parameter.grad is None or parameter.grad.isfinite().all(), name


@settings(max_examples=40)
@given(cases(("closed form", "all options")))
@example(Case("closed form", torch.float32, (-9, 0, 0), 2, None, 0.3, True, 60))
def test_the_live_filter(case: Case) -> None:
    problem = Problem(case)
    assert isinstance(problem.filter, EnsembleFilter)
    live = LiveFilter(problem.filter, SEEN, members=problem.members, generator=problem.generator)
    failure = None
    try:
        for t in range(20):
            if t:
                live.predict()
            assert live.update(problem.y[t], problem.observed[t]).isfinite()
    except ValueError as error:
        failure = error
    if failure is not None:
        assert_allowed(failure, case)
        return
    if not live.finite:  # it says so: members so large that their variance would not be
        assert case.floored
        return
    forecast = live.forecast(torch.tensor([0.5, 1.0], dtype=case.dtype))
    assert forecast.mean.isfinite().all()
    assert forecast.variance.isfinite().all()


@pytest.mark.parametrize("kind", ["closed form", "all options"])
def test_inflation_does_not_run_away(kind: str) -> None:
    """What no sensor reduces would double with every update; a filter that nobody ends stays finite."""
    problem = Problem(Case(kind, torch.float32, (0, 0, 0), 8, None, 0.0, False, 0))
    problem.filter.inflation = 2.0
    live = LiveFilter(problem.filter, SEEN, generator=problem.generator)
    y = torch.where(problem.observed[-1], problem.y[-1], math.nan)
    for _ in range(1000):
        live.predict()
        live.update(y)
    assert live.finite
    assert live.forecast().variance.isfinite().all()
