"""Where the gradient starts: the best of what was tried, found once."""

import json
from pathlib import Path

import pytest
import torch

from tests.conftest import interactions, small_primitive
from torch_ebip import BSplineBasis, ForecastObjective, InteractionPrimitive, TuningSettings, select_basis
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.starts import (
    SHARPNESSES,
    SLOPES,
    TRIES,
    Start,
    best_factor,
    best_start,
    scaled,
    tunable,
)


def test_the_best_factor_does_not_wander_when_asked_again(tmp_path: Path) -> None:
    primitive, made = small_primitive(), interactions()
    subsets = {"all": torch.tensor([True, True, True, False, False])}
    task = Task(primitive, ForecastObjective(primitive, ~subsets["all"]), ~subsets["all"], subsets)
    held_out = HeldOut(made, task, TuningSettings(folds=4, thinning=2))
    answers = [best_factor(held_out, scaled, 8, [1.0, 10.0], tmp_path / "scan.json") for _ in range(3)]
    assert len(set(answers)) == 1
    losses = {float(k): v for k, v in json.loads((tmp_path / "scan.json").read_text()).items()}
    assert len(losses) == 4
    assert answers[0] == min(losses, key=lambda factor: losses[factor])


def test_the_start_is_the_best_of_what_was_tried(tmp_path: Path) -> None:
    made = interactions(30)
    primitive = InteractionPrimitive.fit(made, select_basis(made, [BSplineBasis(6)]))
    layout = made.layout
    targets = layout.mask(["arm"])
    task = Task(primitive, ForecastObjective(primitive, targets), targets, {"all": ~targets})
    held_out = HeldOut(made, task, TuningSettings(folds=4, thinning=2))
    start = best_start(held_out, 100.0, 6, record=tmp_path / "scan.json")
    losses = json.loads((tmp_path / "scan.json").read_text())
    best = min(losses, key=lambda entry: entry["remaining"])
    assert start == Start(*(best[name] for name in Start._fields))
    tried = [Start(*(entry[name] for name in Start._fields)) for entry in losses]
    assert len(set(tried)) == len(tried) <= TRIES
    assert {entry["primacy"] > 0 for entry in losses} == {True, False}  # with and without what came first
    if len(tried) < TRIES:
        # Nothing beside it is better: every neighbour was tried.
        names, at = ("sharpness", "slope"), start._asdict()
        for name, axis in zip(names, (SHARPNESSES, SLOPES), strict=True):
            place = axis.index(at[name])
            for value in axis[max(place - 1, 0) : place + 2]:
                assert Start(**(at | {name: value})) in tried
    filter = tunable(primitive, start)
    shares = [start.balance * start.sharpness, (1 - start.balance) * start.sharpness]
    assert filter.analysis.weighting.sharpness.value.tolist() == pytest.approx(shares)
    ratio = filter.model.measurement_noise.variance.value / primitive.residual_variance
    assert ratio.mean().item() == pytest.approx(start.factor, rel=1e-4)
    assert best_start(held_out, 100.0, 6, record=tmp_path / "scan.json") == start


def test_one_memory_is_the_fast_one() -> None:
    made, primitive = interactions(), small_primitive()
    targets = made.layout.mask(["arm"])
    task = Task(primitive, ForecastObjective(primitive, targets), targets, {"all": ~targets})
    start = best_start(HeldOut(made, task, TuningSettings(folds=4, thinning=4)), 10.0, 4, memories=1)
    assert start.balance is None
    assert tunable(primitive, start).analysis.weighting.forgetting.value.tolist() == [6.0]
