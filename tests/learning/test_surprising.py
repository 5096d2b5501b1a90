"""What surprises is learned from interactions left out, and doubt from strangers made of them."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.conftest import interactions
from torch_ebip import (
    BSplineBasis,
    Demonstrations,
    InteractionPrimitive,
    StackedBasis,
    TuningSettings,
    ebip,
    learn,
    load_model,
)
from torch_ebip.common.draws import seeded
from torch_ebip.learning.caution import learn_caution
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.horizons import AHEAD
from torch_ebip.learning.objective import ForecastObjective
from torch_ebip.learning.strangers import Unlike, astray, played, unlikeness
from torch_ebip.learning.surprising import learn_surprise

KNOWN = 120


@pytest.fixture(scope="module")
def taught():
    """A filter with an honest R, and what `learn` would give it: from 120 interactions."""
    known = interactions(KNOWN)
    primitive = InteractionPrimitive.fit(known, StackedBasis([BSplineBasis(6)] * 5))
    filter = ebip(primitive, residual_variance=30 * primitive.residual_variance, square_root=True, weigh=True)
    targets = primitive.layout.controlled
    objective = ForecastObjective(primitive, targets, ahead=AHEAD)
    task = Task(primitive, objective, targets, {"all": ~targets, "hand": primitive.layout.mask(["hand"])})
    held_out = HeldOut(known, task, TuningSettings(thinning=2))
    said, remarks = learn_caution(held_out, known, filter, {"suspect": 0.01, "rejected": 0.001})
    assert not remarks
    return filter, said, held_out


@torch.no_grad()
def filtered(filter, demonstrations: Demonstrations, change=None, sensors=("hand", "gaze")):
    """The trace of what sensors say, and the index of each one's last sample."""
    y, observed = demonstrations.pad()
    seen = observed & demonstrations.layout.mask(sensors)
    y = y if change is None else change(y)
    return filter(y, seen, generator=[seeded(0, i) for i in range(len(y))]), demonstrations.lengths - 1


def test_false_alarms_are_as_rare_as_was_said(taught) -> None:
    """On 600 interactions that nobody has seen: familiarity is a chance, and sensors are hardly ever suspected."""
    filter, _, _ = taught
    trace, last = filtered(filter, interactions(600, seed=11))
    at_end = trace.familiarity.gather(1, last.unsqueeze(1)).squeeze(1)
    for chance in (0.01, 0.05, 0.2):
        error = 3 * math.sqrt(chance * (1 - chance) / 600)
        # The whole interaction decides about what is usual, fitted to 120 of them.
        assert float((at_end < chance).double().mean()) <= 2 * chance + error
    assert float((at_end < 0.2).double().mean()) >= 0.08
    suspect = (trace.counts[..., :2] < 1).any(1).double().mean(0)
    assert float(suspect.max()) <= 0.02 + 3 * math.sqrt(0.01 / 600)


@pytest.mark.parametrize("sensor", ["hand", "gaze"])
def test_one_sensor_alone_is_not_surprised_more_often(taught, sensor: str) -> None:
    """As where a session has no others, or they were lost."""
    filter, _, _ = taught
    trace, last = filtered(filter, interactions(400, seed=13), sensors=(sensor,))
    at_end = trace.familiarity.gather(1, last.unsqueeze(1)).squeeze(1)
    for chance in (0.01, 0.05):
        # Its tail is fitted to fifty interactions.
        assert float((at_end < chance).double().mean()) <= 3 * chance + 3 * math.sqrt(chance * (1 - chance) / 400)


def test_a_random_walk_and_a_sensor_that_lies_are_found(taught) -> None:
    filter, _, _ = taught
    draws = torch.Generator().manual_seed(0)
    fresh = interactions(60, seed=12)

    def walk(y):
        return y[:, :1] + 0.2 * torch.randn(y.shape, generator=draws).cumsum(1)

    trace, last = filtered(filter, fresh, walk)
    assert float((trace.familiarity.gather(1, last.unsqueeze(1)) < 0.01).double().mean()) > 0.95

    def lies(y):
        y = y.clone()
        y[..., 2] += 2.0
        return y

    trace, last = filtered(filter, fresh, lies)
    assert float((trace.counts[:, 5, 1] == 0).double().mean()) > 0.9
    assert float((trace.counts[:, 5, 0] == 1).double().mean()) > 0.9


def test_what_is_learned_is_said(taught) -> None:
    filter, said, _ = taught
    assert said["sensors"] == ["hand", "gaze"]
    assert said["chances"] == {"suspect": 0.01, "rejected": 1 / 400}  # of a hundred interactions
    doubt = said["doubt"]
    assert doubt["share"][0] == 1.0
    assert doubt["widening"][0] == 0.0
    assert doubt["share"] == sorted(doubt["share"], reverse=True)
    assert doubt["widening"] == sorted(doubt["widening"])
    assert doubt["widening"][-1] >= 1.0
    assert doubt["inflation"] == sorted(doubt["inflation"])
    assert filter.surprise.known.tolist() == [True, True, False]
    values = filter.surprise.named_values(interactions(2).layout)
    assert set(values) == {"surprise/suspect/hand", "surprise/suspect/gaze"}
    assert min(values.values()) > 1


def test_calibration_judges_nobody_and_repeats(taught) -> None:
    """What is noticed does not depend on who judged before: with a judge and without one it is the same."""
    filter, _, held_out = taught
    again, _ = learn_surprise(held_out, filter, torch.arange(KNOWN))
    alone = copy.deepcopy(filter)
    alone.analysis.surprise = None
    once_more, _ = learn_surprise(held_out, alone, torch.arange(KNOWN))
    for name, tensor in again.state_dict().items():
        if isinstance(tensor, torch.Tensor):
            assert torch.equal(tensor, once_more.state_dict()[name])


def test_too_few_are_named_and_nothing_is_made_up() -> None:
    known = interactions(12)
    model = learn(known, steps=0, scan=4)
    assert "familiarity is NaN: 12 demonstrations, at least 20 with" in " ".join(model.report["remarks"])
    assert model.report["surprise"] == {}
    with model.session() as session:
        session.push("hand", [0.0, 1.0], 0.0)
        assert math.isnan(session.forecast().familiarity)
        assert {report.state for report in session.report().values()} == {"ok"}
    assert model.filter.bounds is not None


@pytest.mark.parametrize("chances", [{"suspect": 0.0}, {"suspect": 1.0}, {"rejected": 0.0}, {"rejected": 0.5}])
def test_bad_chances_are_refused_before_anything_is_written(chances: dict[str, float], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"suspect|rejected"):
        learn(interactions(20), folder=tmp_path / "run", **chances)
    assert not (tmp_path / "run").exists()


def test_a_model_keeps_it_and_tensorboard_shows_it(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    known = interactions(24)
    model = learn(known, steps=2, scan=4, batch_size=4, validate_every=2, folder=tmp_path)
    loaded = load_model(tmp_path)
    assert str(loaded.filter.surprise) == str(model.filter.surprise)
    y = torch.where(known.layout.controlled, torch.nan, known[0]) + 0.8
    ours, theirs = (m.filter(y, generator=seeded(0)) for m in (model, loaded))
    assert torch.equal(ours.familiarity, theirs.familiarity)
    assert torch.equal(ours.counts, theirs.counts)
    said = [m.forecast(y, [0.3, math.inf]) for m in (model, loaded, model.rebuilt(), model.extend(known))]
    assert torch.equal(said[0].variance, said[1].variance)
    assert torch.equal(said[0].variance, said[2].variance)
    assert said[3].variance.isfinite().all()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert {"surprise/familiarity", "surprise/multiple/hand", "surprise/multiple/gaze"} <= set(
        events.Tags()["histograms"]
    )


def test_strangers_are_what_they_are_called(taught) -> None:
    """Ensembles of the least alike, none of the own fold; other speeds; ways that leave their own and come back."""
    _, _, held_out = taught
    known, primitive = interactions(KNOWN), held_out.task.primitive
    apart = unlikeness(primitive)
    unlike = Unlike(held_out.partition, apart)
    members = unlike.members(torch.arange(KNOWN), torch.Generator())
    fold = held_out.partition.fold_of
    assert (fold[members] != fold.unsqueeze(1)).all()
    left = apart.gather(1, members).mean(1)
    others = torch.where(fold != fold.unsqueeze(1), apart, math.nan).nanmean(1)
    assert (left > others).all()
    for speed in (0.5, 2.0):
        fast = played(known, speed)
        assert abs(len(fast[1]) * speed - len(known[1])) <= 2
        k = 8
        np.testing.assert_allclose(fast[1][round(k / speed)], known[1][k], atol=1e-6)
    assert played(known, 0.5)[0][10:18, 0].isnan().all()
    strayed = astray(known, ~primitive.layout.controlled, torch.Generator().manual_seed(0))
    moved = torch.stack([(strayed[i] - known[i])[:, 1].abs().nan_to_num().amax() for i in range(KNOWN)])
    assert float((moved > 0.05).double().mean()) > 0.8
    assert all(torch.equal(strayed[i][:, 3:], known[i][:, 3:]) for i in range(KNOWN))
    np.testing.assert_allclose(strayed[1][[0, -1]], known[1][[0, -1]], atol=1e-5)


def without(demonstrations: Demonstrations, sensor: str, count: int) -> Demonstrations:
    """The first ``count`` never had that sensor."""
    trajectories = [trajectory.clone() for trajectory in demonstrations]
    for trajectory in trajectories[:count]:
        trajectory[:, demonstrations.layout.slice(sensor)] = torch.nan
    return Demonstrations(demonstrations.layout, trajectories, demonstrations.rate)


def test_a_recording_without_a_sensor_of_a_set_says_nothing_of_it() -> None:
    known = without(interactions(30), "gaze", 1)
    model = learn(known, steps=0, scan=4, subsets={"both": ["hand", "gaze"], "gaze": ["gaze"]})
    assert model.report["surprise"]["sensors"] == ["hand", "gaze"]
    assert model.filter.surprise.tail is not None


def test_a_sensor_that_few_recordings_have_is_named() -> None:
    model = learn(without(interactions(30), "gaze", 18), steps=0, scan=4)
    assert model.report["surprise"]["sensors"] == ["hand"]
    assert "gaze is always believed: at least 20 demonstrations" in " ".join(model.report["remarks"])
    assert model.report["surprise"]["chances"]["rejected"] == pytest.approx(1 / 120)


def test_fewer_members_do_not_claim_to_know_what_is_familiar() -> None:
    model = learn(interactions(24), steps=0, scan=4)
    few, same = model.rebuilt(n_members=10), model.rebuilt(n_members=24)
    assert (few.filter.surprise, few.filter.doubt) == (None, None)
    assert "familiarity is NaN: it was learned with more than 10 members" in " ".join(few.report["remarks"])
    assert few.report["surprise"] == {}
    assert few.filter.bounds is not None
    assert same.filter.surprise is not None
    assert same.report["surprise"] == model.report["surprise"]
