"""Scores of seconds ahead: against plain loops over recorded values, gaps and constants among them."""

import math

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from torch_ebip import Demonstrations, ForecastObjective, InteractionPrimitive, TuningSettings, ebip
from torch_ebip.learning import Weights
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.horizons import AHEAD, goes_on, reached, spread_ahead
from torch_ebip.learning.references import recorded

AHEAD_HERE = (0.1, 0.25, math.inf)


def gappy() -> Demonstrations:
    made = [path.clone() for path in interactions(12, dtype=torch.float64)]
    for i, path in enumerate(made):
        path[10 + i : 14 + i, 3] = torch.nan
    return Demonstrations(interactions(2).layout, made, interactions(2).rate)


def held_out(known: Demonstrations, ahead=AHEAD_HERE) -> HeldOut:
    primitive = InteractionPrimitive.fit(known)
    targets = known.layout.controlled
    task = Task(primitive, ForecastObjective(primitive, targets, ahead=ahead), targets, {"all": ~targets})
    return HeldOut(known, task, TuningSettings(folds=3, thinning=1))


def test_what_is_recorded_is_found_between_samples_and_nowhere_else() -> None:
    values = torch.arange(10.0, dtype=torch.float64).view(1, 10, 1).square()
    values[0, 6] = torch.nan
    ends, ahead = torch.tensor([[64.0]], dtype=torch.float64), torch.tensor([0.0, 0.25, 0.5, math.inf]).double()
    found = recorded(values, torch.tensor([9]), ends, torch.tensor([[0, 3, 4, 7]]), ahead, 10.0).squeeze(-1)[0]
    for k, now in enumerate((0, 3, 4, 7)):
        for p, seconds in enumerate((0.0, 0.25, 0.5)):
            at = now + 10 * seconds
            low = int(at)
            if at > 8:
                wanted = math.nan
            else:
                wanted = float(values[0, low, 0])
                wanted += (at - low) * (float(values[0, low + 1, 0]) - wanted) if at > low else 0.0
            np.testing.assert_allclose(float(found[k, p]), wanted)
        assert float(found[k, -1]) == 64.0


@pytest.mark.parametrize("rate", [24.0, 29.97, 30.0, 60.0, 120.0, 1000.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_horizon_that_is_so_many_samples_finds_them_up_to_the_last(rate: float, dtype: torch.dtype) -> None:
    """Whatever k / rate is rounded to."""
    values = torch.arange(400, dtype=dtype).view(1, 400, 1)
    every, ahead = (
        torch.arange(400).unsqueeze(0),
        torch.tensor([k / rate for k in (1, 2, 3, 5, 7, 60, 100, 300)], dtype=dtype),
    )
    found = recorded(values, torch.tensor([400]), values[:, -1], every, ahead, rate)[0, :, :, 0]
    for p, k in enumerate((1, 2, 3, 5, 7, 60, 100, 300)):
        assert torch.equal(found[: 400 - k, p], values[0, k:, 0]), k
        assert bool(found[400 - k :, p].isnan().all()), k


def test_terms_are_means_over_what_was_measured_every_horizon_alike() -> None:
    known = gappy()
    held = held_out(known)
    objective, primitive = held.task.objective, held.task.primitive
    filter = ebip(primitive, square_root=True, weigh=True)
    (shown,) = held.portions(torch.arange(12), held.task.subsets["all"])
    trial = held.filter(filter, shown, 0)
    terms = trial.terms(objective)
    said = trial.filter.forecast(trial.trace.kept, ahead=list(AHEAD_HERE)).select(shown.targets)
    scale, shares = objective.scale.numpy(), objective.shares.numpy()
    mean = said.mean.detach().numpy()
    total = 0.0
    for p in range(3):
        errors = []
        for b in range(12):
            for k in range(4):
                for d in range(2):
                    truth = float(shown.truth[b, k, p, d])
                    errors.append(0.0 if math.isnan(truth) else ((mean[b, k, p, d] - truth) / scale[p, d]) ** 2)
        total += np.mean(errors) / shares[p] / 3
    assert bool(shown.truth.isnan().any())
    assert float(terms["squared_error"].detach()) == pytest.approx(total, rel=1e-9)
    sum(terms.values()).backward()
    gradients = [parameter.grad for parameter in filter.parameters() if parameter.grad is not None]
    assert gradients
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)


def test_parts_of_a_batch_have_the_mean_of_the_whole() -> None:
    """So that processes which share a step take the same one."""
    held = held_out(gappy())
    filter = ebip(held.task.primitive, square_root=True)
    subset = held.task.subsets["all"]
    members = held.partition.members(torch.arange(12), torch.Generator())
    shares = held.shares.expand(12, -1)
    whole = held.filter(filter, held.show(torch.arange(12), subset, shares, members), 0).terms(held.task.objective)
    parts = [
        held.filter(filter, held.show(torch.arange(12)[i::3], subset, shares[i::3], members[i::3]), 0).terms(
            held.task.objective
        )
        for i in range(3)
    ]
    for name, value in whole.items():
        mean = sum(part[name] for part in parts) / 3
        assert float(mean.detach()) == pytest.approx(float(value.detach()), rel=1e-9)


def test_the_scale_is_what_the_mean_errs_there() -> None:
    primitive = small_primitive(torch.float64)
    found = spread_ahead(primitive, torch.tensor([0.1, 0.5, math.inf]).double())
    velocity = primitive.phase_velocity.numpy()
    time = np.linspace(0, 1 / velocity.min(), 201)
    phase = time * velocity[:, None]
    paths = primitive.basis.project(torch.tensor(phase).clamp(max=1), primitive.weights.unsqueeze(1)).numpy()
    squares = (paths - paths.mean(0)) ** 2 * 24 / 23
    for p, ahead in enumerate((0.1, 0.5)):
        now = phase - ahead * velocity[:, None]
        asked = (now >= 0.2) & (now <= 0.95) & (phase <= 1)
        np.testing.assert_allclose(found[p], squares[asked].mean(0), rtol=1e-9)
    np.testing.assert_allclose(found[-1], primitive.end_variance, rtol=1e-9)


def test_a_target_that_always_ends_alike_can_be_scored() -> None:
    """A wave: what it does in between differs, where it ends does not."""
    made = []
    for path in interactions(12, dtype=torch.float64):
        path = path.clone()
        path[:, 3] = path[:, 3] * torch.sin(torch.linspace(0, torch.pi, len(path)).double())
        made.append(path)
    known = Demonstrations(interactions(2).layout, made, interactions(2).rate)
    primitive = InteractionPrimitive.fit(known)
    targets = known.layout.controlled
    objective = ForecastObjective(primitive, targets, ahead=AHEAD_HERE)
    assert float(objective.scale[-1, 0]) == pytest.approx(0.1 * float(objective.scale[:, 0].max()), rel=0.5)
    assert bool((objective.scale > 0).all())


def test_horizons_behind_the_end_and_mistakes_are_named() -> None:
    primitive = small_primitive(torch.float64)
    targets = primitive.layout.controlled
    assert reached(primitive, AHEAD) == list(AHEAD)
    assert reached(primitive, (0.1, 20.0, math.inf)) == [0.1, math.inf]
    assert goes_on(primitive, torch.tensor([0.0, 20.0, math.inf]).double())[-1] == 1
    for ahead, message in (
        ([0.1, 20.0, math.inf], "20 s ahead lies behind the end of nearly all demonstrations"),
        ([0.5, 0.1], "ahead must be increasing numbers of seconds"),
        ([], "ahead must be"),
        ([-0.1, 0.5], "ahead must be increasing numbers of seconds, 0 or more"),
        ([math.nan, 0.5], "ahead must be"),
    ):
        with pytest.raises(ValueError, match=message):
            ForecastObjective(primitive, targets, ahead=ahead)
    with pytest.raises(ValueError, match="at phases or at seconds ahead, got both"):
        ForecastObjective(primitive, targets, phases=torch.tensor([1.0]), ahead=[0.1])
    names = ForecastObjective(primitive, targets, ahead=AHEAD, weights=Weights(crps=0.0)).horizons
    assert names == ("0.1 s", "0.25 s", "0.5 s", "1 s", "end")
