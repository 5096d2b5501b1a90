"""Interruptions that are made of recordings, and whether a model learns to live with them."""

from __future__ import annotations

import math

import pytest
import torch

from tests.conftest import interactions
from torch_ebip import Demonstrations, InteractionModel, learn, load_model
from torch_ebip.common.draws import seeded
from torch_ebip.learning.interruptions import again, at_speed, idle, interrupted, late, pause, undisturbed

NOISE = torch.full((5,), 0.01)


def test_a_person_who_pauses_is_where_they_were() -> None:
    values = interactions(3, seed=5)[1]
    made = pause(0.5, 1.0)(values, 30.0, NOISE, seeded(1))
    length = len(made.values) - len(values)
    assert 15 <= length <= 30
    at = int(made.source[made.over - 1])
    assert 0.2 * len(values) - 2 <= at <= 0.7 * len(values)
    torch.testing.assert_close(made.values[made.over :], values[at + 1 :])
    torch.testing.assert_close(made.values[: made.over - length], values[: at + 1])
    still = made.values[made.over - length : made.over]
    torch.testing.assert_close(still.mean(0), values[at], atol=0.01, rtol=0)
    assert still.std(0) == pytest.approx([0.01] * 5, rel=0.6)
    assert bool((made.source.diff() >= 0).all())
    begun = idle(1.0, 1.0)(values, 30.0, NOISE, seeded(2))
    assert begun.over == 31
    assert begun.source[:31].tolist() == [0] * 31


def test_the_others_are_made_of_the_recording() -> None:
    values = interactions(3, seed=5)[1]
    seen = late(0.3, 0.3)(values, 30.0, NOISE, seeded(1))
    torch.testing.assert_close(seen.values, values[int(seen.source[0]) :])
    assert int(seen.source[0]) == round(0.3 * (len(values) - 1))
    twice = again(0.4, 0.4)(values, 30.0, NOISE, seeded(1))
    torch.testing.assert_close(twice.values[twice.over :], values)
    torch.testing.assert_close(twice.values[: twice.over], values[: twice.over])
    half = at_speed(0.5)(values, 30.0, NOISE, seeded(1))
    torch.testing.assert_close(half.values[::2], values)
    torch.testing.assert_close(half.values[1], 0.5 * (values[0] + values[1]))
    same = undisturbed(values, 30.0, NOISE, seeded(1))
    assert torch.equal(same.values, values)


def test_kinds_come_in_turn_and_a_seed_reproduces() -> None:
    known = interactions(6)
    made = [interrupted(known, [undisturbed, late(0.3, 0.6)], NOISE, seeded(4)) for _ in range(2)]
    assert [len(each.values) == len(values) for each, values in zip(made[0], known, strict=True)] == [True, False] * 3
    for a, b in zip(*made, strict=True):
        assert torch.equal(a.values.nan_to_num(), b.values.nan_to_num())


@pytest.fixture(scope="module")
def model() -> InteractionModel:
    return learn(interactions(30), steps=0, scan=8)


def test_a_model_learns_to_live_with_interruptions_and_keeps_it(model: InteractionModel, tmp_path) -> None:
    """What was left out decides: interrupted, forecasts are far better, undisturbed hardly worse."""
    told = model.report["pace"]
    assert told["used"]
    assert told["with"]["interrupted"] < 0.9 * told["without"]["interrupted"]
    assert told["with"]["undisturbed"] <= 1.01 * told["without"]["undisturbed"]
    model.save(tmp_path / "model")
    kept = load_model(tmp_path / "model")
    assert kept.filter.pace is not None
    assert torch.equal(kept.filter.pace.settings, model.filter.pace.settings)
    values = interactions(2, seed=5)[1]
    for a, b in zip(model.forecast(values, [0.2, math.inf]), kept.forecast(values, [0.2, math.inf]), strict=True):
        assert a is None or not isinstance(a, torch.Tensor) or torch.equal(a, b)


def test_it_is_better_for_people_who_were_never_seen(model: InteractionModel) -> None:
    """Recordings of another seed, interrupted: error of the end after the interruption, with the bank and without."""
    without = learn(interactions(30), steps=0, scan=8, pace=False)
    assert without.filter.pace is None
    assert "pace" not in without.report
    errors = {"with": 0.0, "without": 0.0}
    kinds = [pause(1.0, 2.0), idle(1.0, 2.0), late(0.3, 0.6), again(0.3, 0.6)]
    known = interactions(16, seed=123)
    for made, values in zip(interrupted(known, kinds, NOISE, seeded(9)), known, strict=True):
        seen = made.values[: int((made.source <= 0.8 * len(values)).nonzero()[-1]) + 1]
        for name, each in (("with", model), ("without", without)):
            mean = each.forecast(seen, [math.inf]).mean[-1, 0]
            errors[name] += float((mean - values[-1])[3:].abs().mean())
    assert errors["with"] < 0.75 * errors["without"]


def test_too_few_learn_no_pace() -> None:
    assert "pace" not in learn(interactions(8), steps=0, scan=4).report


def test_sensors_that_never_move_have_no_bank_and_the_report_says_so() -> None:
    known = interactions(12)
    still = torch.tensor([True, True, True, False, False])
    values = [torch.where(still, 0.3, trajectory.nan_to_num()) for trajectory in known]
    told = learn(Demonstrations(known.layout, values, known.rate), steps=0, scan=4).report["pace"]
    assert not told["used"]
    assert "sensors that move" in told["reason"]
