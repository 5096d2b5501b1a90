"""Read-outs by their parts: each leaves out what its name says, of the filter that `learn` made."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from experiments.entries import Fold
from experiments.evaluate import Task, evaluate
from experiments.readouts import READOUTS, Forgetful, Timeless, UnseenMethod, with_readout
from tests.conftest import interactions, small_primitive
from tests.interaction.test_analogues import present_of
from torch_ebip import TuningSettings
from torch_ebip.interaction import AnalogueReadout, Analogues
from torch_ebip.interaction.horizons import LEVELS

TASK = Task({"hand": ["hand"], "both": ["hand", "gaze"]}, (0.5, 0.8), [], ["arm"], {}, None, (0.25,))


@pytest.fixture(scope="module")
def fold(tmp_path_factory: pytest.TempPathFactory) -> Fold:
    tuning = TuningSettings(steps=2, batch_size=4, validate_every=1, thinning=4)
    return Fold.of(interactions(40), TASK, 0, tuning, tmp_path_factory.mktemp("fold"), scan=4)


def test_what_is_left_out_does_not_matter() -> None:
    primitive = small_primitive(torch.float64)
    present = present_of(primitive)
    other = present._replace(prior=torch.where(present.prior > -torch.inf, 7 * present.prior, -torch.inf))
    assert not torch.allclose(Analogues.of(primitive)(present).weights, Analogues.of(primitive)(other).weights)
    torch.testing.assert_close(Forgetful.of(primitive)(present).weights, Forgetful.of(primitive)(other).weights)
    assert (Forgetful.of(primitive)(present).weights[:, 4] == 0).all()  # it was no member
    timeless = Timeless.of(primitive)
    with torch.no_grad():
        timeless.tilt.raw.fill_(0)
    later = present._replace(variance=present.variance * 3)
    torch.testing.assert_close(timeless(present).weights, timeless(later).weights)


def test_all_of_them_answer(fold: Fold) -> None:
    """Beside what `learn` returns, which they read from its folder."""
    model = fold.model()
    assert isinstance(with_readout(fold, Analogues.of).readout, AnalogueReadout)
    assert not isinstance(with_readout(fold, None).readout, AnalogueReadout)
    alone = with_readout(fold, Analogues.of, alone=True).readout
    targets = model.layout.controlled
    for follow in alone.follow.unflatten(-1, (len(LEVELS), -1)).unbind(2):
        assert follow[:, targets][:, :, targets].abs().max() == 0
        assert torch.equal(follow[:, ~targets][:, :, ~targets], torch.eye(3).expand(5, -1, -1))
    methods = {name: build(fold) for name, build in READOUTS.items()}
    values = evaluate(TASK, methods, interactions(6, seed=9))
    errors = [each for cell, each in values.items() if cell.metric == "mae"]
    said = {name: sum(float(np.nanmean(each[name])) for each in errors) for name in methods}
    # Nobody weighs members here, so that forgetting their weights changes nothing.
    assert model.filter.analysis.weighting is None
    assert said.pop("readout_again") == said["readout_no_memory"]
    # And they are too few for an expert.
    assert said.pop("readout_no_expert") == said["readout_no_memory"]
    assert len({round(v, 6) for v in said.values()}) == len(said)
    assert all(0 < v < 20 for v in said.values())


def test_an_unseen_set_is_asked_of_a_read_out_that_did_not_see_it(fold: Fold) -> None:
    method = UnseenMethod(fold)
    learned = {tuple(mask.tolist()): each for mask, each in method._methods}
    y, observed = interactions(2, seed=9).pad()
    dofs, keep = fold.known.layout.controlled, torch.tensor([[20], [20]])
    for names, mask in fold.tuned().subsets.items():
        shown = observed & mask
        expected = learned[tuple(mask.tolist())](y, shown, keep, dofs).forecast.mean
        torch.testing.assert_close(method(y, shown, keep, dofs).forecast.mean, expected, equal_nan=True)
        other = fold.tuned().subsets["both" if names == "hand" else "hand"]
        head = with_readout(fold, Analogues.of, subsets={"other": other}).readout
        kept = learned[tuple(mask.tolist())].filter.readout
        torch.testing.assert_close(kept.follow, head.follow)
