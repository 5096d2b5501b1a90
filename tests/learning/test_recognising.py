"""What was seen first is remembered: recognition and error over the share seen, on generated actions."""

import math
from itertools import pairwise

import pytest
import torch

from experiments.evaluate import FilterMethod, Task, evaluate
from torch_ebip import InteractionPrimitive, ebip, learn
from torch_ebip.common.draws import seeded
from torch_ebip.learning.configuration import Task as Tuned
from torch_ebip.learning.groups import find_groups, groups_of
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.objective import ForecastObjective
from torch_ebip.learning.recognising import calibration_error, learn_recognition
from torch_ebip.learning.settings import TuningSettings
from torch_ebip.recordings import actions

SHARES = (0.2, 0.4, 0.6, 0.8, 1.0)


@pytest.fixture(scope="module")
def model():
    return learn(actions(100, 7), steps=30, seed=0, scan=24)


def test_what_was_seen_first_is_remembered(model) -> None:
    """The error of the end does not grow with what is seen, within two standard errors."""
    tests = actions(200, 8)
    task = Task({"all": ["hand"]}, SHARES, [], ["arm"], {}, None)
    values = evaluate(task, {"it": FilterMethod(model.filter, 0, dtype=torch.float32)}, tests)
    errors = [methods["it"] for cell, methods in values.items() if cell.metric == "mae"]
    for before, after in pairwise(errors):
        deviation = math.sqrt((before.var() + after.var()) / len(before))
        assert after.mean() < before.mean() + 2 * deviation
    covered = [methods["it"].mean() for cell, methods in values.items() if cell.metric == "coverage_95"]
    assert all(0.9 < share <= 1 for share in covered)
    # Which memory that takes was found out: the slow one counts.
    fast, slow = model.filter.analysis.weighting.sharpness.value.tolist()
    assert slow > fast


def test_it_recognises_and_is_as_sure_as_it_should_be(model) -> None:
    tests = actions(200, 8)
    y, measured = tests.pad()
    observed = measured & ~tests.layout.controlled
    steps = torch.stack([(tests.lengths * share).round().long() - 1 for share in SHARES], -1)
    trace = model.filter(
        torch.where(observed, y, torch.nan), observed, generator=[seeded(i) for i in range(200)], keep=steps
    )
    with torch.no_grad():
        said = model.filter.recognise(trace.kept)
    probability = torch.stack([said[label] for label in ("lift", "swing", "circle", "nod")], -1)
    wanted = torch.arange(200) % 4
    right = probability.argmax(-1) == wanted.unsqueeze(-1)
    assert right[:, 1].double().mean() >= 0.95
    assert calibration_error(probability.amax(-1).flatten(), right.flatten()) < 0.06


def test_numbers_of_recognition_are_more_likely_than_the_filters_weights() -> None:
    """On interactions left out; and a filter without evidence is refused."""
    known = actions(40, 9)
    primitive = InteractionPrimitive.fit(known)
    targets = known.layout.controlled
    task = Tuned(primitive, ForecastObjective(primitive, targets), targets, {"all": ~targets})
    held = HeldOut(known, task, TuningSettings(folds=4, thinning=4))
    filter = ebip(primitive, square_root=True, weigh=True, sharpness=[0.3, 0.3], forgetting=[6.0, 0.01])
    recognition, said = learn_recognition(held, filter, known.labels, torch.arange(40))
    assert said["log_loss"] < math.log(4) / 2
    assert recognition.sharpness.shape == (2, 6)
    later = actions(40, 10)
    y, measured = later.pad()
    observed = measured & ~targets
    half = (later.lengths // 2).unsqueeze(-1)
    state = filter(
        torch.where(observed, y, torch.nan), observed, generator=[seeded(i) for i in range(40)], keep=half
    ).kept
    losses = []
    for each in (filter.recognition, recognition):
        filter.recognition = each
        chance = torch.stack(list(filter.recognise(state).values()), -1)[:, 0]
        losses.append(float(-chance.detach()[torch.arange(40), torch.arange(40) % 4].log().mean()))
    assert losses[1] < losses[0]
    with pytest.raises(ValueError, match="weighs its members"):
        learn_recognition(held, ebip(primitive), known.labels, torch.arange(40))


def test_calibration_error_by_hand() -> None:
    probability = torch.tensor([[0.95, 0.05], [0.95, 0.05], [0.55, 0.45], [0.45, 0.55]])
    right = torch.tensor([True, False, True, True])
    assert calibration_error(probability.amax(-1), right) == pytest.approx(0.5 * 0.45 + 0.5 * 0.45)


def test_groups_are_the_actions() -> None:
    known = actions(64, 11)
    primitive = InteractionPrimitive.fit(known)
    found = find_groups(primitive, seed=0)
    assert found is not None
    pairs = set(zip(found, known.labels, strict=True))
    assert len({label for _, label in pairs}) == 4
    assert len(pairs) <= 6  # nearly one group an action
    other = InteractionPrimitive.fit(actions(8, 12), primitive.basis)
    assert len(groups_of(primitive, found, other)) == 8
    assert find_groups(primitive.subset(range(6))) is None
