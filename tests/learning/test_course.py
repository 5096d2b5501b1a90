"""Whether `learn` finds out that people wave, and what it makes of that."""

from __future__ import annotations

import math

import pytest
import torch

from tests.conftest import interactions
from tests.interaction.cyclic import waving
from torch_ebip import Demonstrations, InteractionModel, PeriodicBSplineBasis, StackedBasis, learn, load_model
from torch_ebip.learning.course import why_not_periodic
from torch_ebip.learning.preparing import Asked, prepared
from torch_ebip.learning.ranks import Ranks
from torch_ebip.learning.settings import settings_for


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> InteractionModel:
    folder = tmp_path_factory.mktemp("waves")
    made = learn(waving(22).recordings, steps=4, scan=6, pace=False, folder=folder, progress=lambda _: None)
    again = load_model(folder / "model.safetensors")
    values = waving(2, seed=5).recordings[0]
    assert torch.equal(again.forecast(values, [0.2]).mean, made.forecast(values, [0.2]).mean)
    return made


def test_it_finds_out_that_people_wave(model: InteractionModel) -> None:
    assert model.primitive.periodic
    course = model.report["course"]
    assert course["circle"] < 0.7 * course["once"]
    assert model.report["horizons"] == ["0.1 s", "0.25 s", "0.5 s", "1 s"]
    assert "not scored, because nobody knows when a wave ends: end" in model.report["remarks"]
    assert model.report["settings"]["periodic"] is True
    stages = model.report["stages"]
    assert min(stages["start"]["error"], stages["gradient"]["error"]) < 0.9 * stages["mean"]["error"]


def test_people_who_were_not_recorded_are_foreseen_with_honest_intervals(model: InteractionModel) -> None:
    errors, spread, inside = [], [], []
    for values in waving(10, seed=5).recordings:
        said = model.forecast(values, [0.5])
        error = said.mean[5:-15, 0, 3:] - values[20:, 3:]
        errors.append(float(error.square().mean()))
        spread.append(float(values[:, 3:].var(0).mean()))
        inside.append(float((error.abs() < 1.96 * said.variance[5:-15, 0, 3:].sqrt()).double().mean()))
    assert sum(errors) < 0.25 * sum(spread)
    assert 0.85 < sum(inside) / 10 <= 1


def test_what_does_not_repeat_is_not_taken_for_waves() -> None:
    assert "do not repeat" in str(why_not_periodic(interactions()))
    assert why_not_periodic(waving().recordings) is None
    with pytest.raises(ValueError, match="do not repeat"):
        learn(interactions(12), periodic=True, progress=lambda _: None)


def test_labels_of_what_repeats_must_be_all() -> None:
    recordings = waving(12).recordings
    labels = ["wave"] * 6 + ["shake"] * 6
    named = Demonstrations(recordings.layout, list(recordings), recordings.rate, labels=labels)
    for names, message in (
        (["wave"], "wave repeat and shake do not: a phase cannot do both; learn a model of "),
        (["nod"], "labels nod; the demonstrations have wave, shake"),
        ("nod", "labels nod"),
    ):
        with pytest.raises(ValueError, match=message):
            learn(named, periodic=names, progress=lambda _: None)
    asked = Asked(("arm",), {"all": ("hand",)}, (0.1, math.inf))
    made = prepared(named, asked, None, ["shake", "wave"], settings_for(named, 1, 0, None, {}), Ranks())
    assert made.primitive.periodic
    assert made.primitive.labels == named.labels
    assert made.task.objective.horizons == ("0.1 s",)


def test_a_periodic_basis_says_it_too() -> None:
    recordings = waving(12).recordings
    basis = StackedBasis([PeriodicBSplineBasis(7)] * 5)
    made = learn(recordings, basis=basis, steps=0, scan=4, shrink=False, pace=False, progress=lambda _: None)
    assert made.primitive.periodic
    assert made.report["horizons"][-1] == "1 s"
