"""The recurrent expert that is learned: where the past tells what the present does not; and only there."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from tests.learning.test_analogues import the_file_says_the_same
from torch_ebip import (
    Demonstrations,
    ForecastObjective,
    InteractionPrimitive,
    Layout,
    Modality,
    TuningSettings,
    learn,
)
from torch_ebip.interaction.expert import SLOWER, Expert
from torch_ebip.interaction.present import recent_of
from torch_ebip.learning import InteractionModel
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.expert import FEWEST, fit_experts
from torch_ebip.learning.held_out import HeldOut


def gestures(count: int, seed: int = 0) -> Demonstrations:
    """A hand makes a gesture and rests; the arm then goes by the product of its directions."""
    draws = torch.Generator().manual_seed(seed)
    layout = Layout([Modality("hand", ["x", "y"], "m"), Modality("arm", ["a"], "rad", controlled=True)])
    paths = []
    for _ in range(count):
        length = int(torch.randint(36, 45, (), generator=draws))
        phase = torch.linspace(0, 1, length).unsqueeze(-1)
        goal = 2 * torch.rand(2, generator=draws) - 1
        hand = goal * torch.sin(math.pi * (phase / 0.35).clamp(max=1))
        product = goal.prod()
        path = torch.cat([hand, phase * product.sign() * product.abs().sqrt()], -1)
        paths.append(path + 0.01 * torch.randn(path.shape, generator=draws))
    return Demonstrations(layout, paths, 30.0)


@pytest.fixture(scope="module")
def told_before() -> InteractionModel:
    return learn(gestures(60), steps=0, scan=6)


def test_it_is_heard_where_the_past_tells_more(told_before: InteractionModel, tmp_path: Path) -> None:
    """It is in the model's file then, and the report says what it gives."""
    report, readout = told_before.report, told_before.filter.readout
    assert report["expert"]["used"]
    assert report["expert"]["crps"] < 0.97 * report["expert"]["crps_without"]
    assert report["stages"]["expert"]["error"] < 0.97 * report["stages"]["analogues"]["error"]
    assert isinstance(readout.expert, Expert)
    assert told_before.filter.analysis.recent.windows == readout.expert.windows
    the_file_says_the_same(told_before, gestures(1, seed=3)[0], tmp_path)


def test_a_model_that_grows_keeps_it(told_before: InteractionModel) -> None:
    """What it reads is scaled as it was when it learned to read."""
    more = told_before.extend(gestures(5, seed=4))
    ours, theirs = told_before.filter.readout.expert, more.filter.readout.expert
    for name in ("middle", "scale", "first", "direct", "centre"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name
    assert more.forecast(gestures(1, seed=5)[0], [math.inf]).mean.isfinite().all()


def test_few_demonstrations_have_none_and_the_report_says_so() -> None:
    model = learn(gestures(FEWEST - 10), steps=0, scan=4)
    assert any(
        f"no expert: {FEWEST - 10} demonstrations, a network needs {FEWEST}" in r for r in model.report["remarks"]
    )
    assert "expert" not in model.report
    assert len(model.filter.analysis.recent.windows) == 1


def test_what_it_is_worth_is_asked_of_one_that_did_not_see_it() -> None:
    """Nonsense in a fold changes every network but those that are trained without it; a seed gives the same again."""
    known = gestures(24)
    primitive = InteractionPrimitive.fit(known)
    targets = primitive.layout.controlled
    objective = ForecastObjective(primitive, targets, ahead=[0.1, math.inf])
    held_out = HeldOut(known, Task(primitive, objective, targets, {"all": ~targets}), TuningSettings(folds=3))
    recent = recent_of(primitive, slower=SLOWER)

    def fitted() -> list[Expert]:
        expert = Expert.of(primitive, ~targets, targets, [0.1, math.inf], hidden=8)
        return [*fit_experts(expert, held_out, recent, torch.arange(24)), expert]

    first, again = fitted(), fitted()
    held_out.values[held_out.partition.fold_of == 1, :, -1] += 3.0
    nonsense = fitted()
    for name in ("first", "last_bias", "centre"):
        found = [[getattr(expert, name) for expert in experts] for experts in (first, again, nonsense)]
        assert [torch.equal(a, b) for a, b in zip(found[0], found[1], strict=True)] == [True] * 4
        assert [torch.equal(a, b) for a, b in zip(found[0], found[2], strict=True)] == [False, True, False, False]
