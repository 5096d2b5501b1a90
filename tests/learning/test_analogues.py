"""Analogues that are learned: of interactions whose future bends, through the model's file, and of few."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from tests.interaction.analogous import bent as made
from torch_ebip import (
    Demonstrations,
    ForecastObjective,
    InteractionFilter,
    InteractionPrimitive,
    Layout,
    Modality,
    TuningSettings,
    bip,
    learn,
    particle_filter,
)
from torch_ebip.interaction import AnalogueReadout, Analogues
from torch_ebip.interaction.analogues import Analogy
from torch_ebip.interaction.present import Present
from torch_ebip.learning import InteractionModel
from torch_ebip.learning.analogues import fit_analogues, moments_of, what_analogues_say
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.held_out import HeldOut, Trial
from torch_ebip.learning.recently import recent_sums
from torch_ebip.learning.said import what_it_says
from torch_ebip.learning.shares import stretching
from torch_ebip.learning.stacking import FIXED, PULLS, best_correction, best_width

QUICK = {"steps": 0, "scan": 6}


def bending(count: int, seed: int = 0) -> Demonstrations:
    """A hand that turns off to one side; the arm goes to the square of where: no line through the demonstrations."""
    draws = torch.Generator().manual_seed(seed)
    layout = Layout([Modality("hand", ["x", "y"], "m"), Modality("arm", ["a"], "rad", controlled=True)])
    paths = []
    for _ in range(count):
        length = int(torch.randint(36, 45, (), generator=draws))
        phase = torch.linspace(0, 1, length).unsqueeze(-1)
        goal = 2 * torch.rand((), generator=draws) - 1
        path = torch.cat([goal * phase.square(), phase, phase * (goal.square() - 0.33)], -1)
        paths.append(path + 0.005 * torch.randn(path.shape, generator=draws))
    return Demonstrations(layout, paths, 30.0)


@pytest.fixture(scope="module")
def bent() -> InteractionModel:
    return learn(bending(60), **QUICK)


def the_file_says_the_same(model: InteractionModel, y: torch.Tensor, folder: Path) -> InteractionModel:
    """Of a recording at horizons and between them; and a session of it forecasts. What the file holds."""
    model.save(folder / "model.safetensors")
    again, ahead = InteractionModel.load(folder / "model.safetensors"), [0.1, 0.7, math.inf]
    for ours, theirs in zip(model.forecast(y, ahead)[:2], again.forecast(y, ahead)[:2], strict=True):
        torch.testing.assert_close(ours, theirs)
    session = again.session()
    for i, row in enumerate(y[:20]):
        session.push("hand", row[:2].tolist(), i / 30)
    assert session.forecast().mean.isfinite().all()
    return again


def error(model: InteractionModel, tests: Demonstrations, share: float = 0.7) -> float:
    """Root mean squared error of the end, after a share of each."""
    misses = []
    for trajectory in tests:
        said = model.forecast(trajectory[: round(share * len(trajectory))], [math.inf])
        misses.append(float(said.mean[-1, 0, -1] - trajectory[-1, -1]))
    return float(np.sqrt(np.mean(np.square(misses))))


def test_they_bend_where_the_filter_cannot(bent: InteractionModel) -> None:
    """Strangers to both, and what is said of the models' worth is true."""
    straight = learn(bending(60), analogues=False, **QUICK)
    tests = bending(40, seed=1)
    assert isinstance(bent.filter.readout, AnalogueReadout)
    told = bent.report["analogues"]
    assert told["used"]
    assert told["crps"] < told["crps_without"]
    assert bent.report["stages"]["analogues"]["error/end"] < 0.9 * bent.report["stages"]["shrinkage"]["error/end"]
    assert error(bent, tests) < 0.9 * error(straight, tests)
    assert straight.filter.analysis.recent is None
    # What the present tells no expert tells better; then there is none.
    assert not bent.report["expert"]["used"]
    assert bent.filter.readout.expert is None
    assert "expert" not in bent.report["stages"]  # of which the verdict speaks
    assert len(bent.filter.analysis.recent.windows) == 1
    assert "analogues" not in straight.report


def test_deviations_hold_what_they_say(bent: InteractionModel) -> None:
    inside = []
    for trajectory in bending(60, seed=2):
        said = bent.forecast(trajectory, [0.25, math.inf])
        at = round(0.5 * len(trajectory))
        truth = torch.stack([trajectory[at + round(0.25 * 30), -1], trajectory[-1, -1]])
        inside.append(((said.mean[at, :, -1] - truth).abs() <= 1.96 * said.variance[at, :, -1].sqrt()).double())
    assert 0.87 <= float(torch.stack(inside).mean()) <= 1.0


def test_who_knows_little_is_not_sure(bent: InteractionModel) -> None:
    """At the first sample, and of sensors that fell silent early, the intervals of the end still hold it."""
    least, targets = bent.filter.readout.surest, bent.layout.controlled
    assert (least[:, targets] > 0).all()
    assert (least[:, ~targets] == 0).all()
    first, silent = [], []
    for trajectory in bending(60, seed=6):
        end, shown = trajectory[-1, -1], trajectory.clone()
        shown[round(0.3 * len(trajectory)) :, :2] = torch.nan
        for where, values, at in ((first, trajectory, 0), (silent, shown, round(0.8 * len(trajectory)))):
            said = bent.forecast(values, [math.inf])
            where.append(bool((said.mean[at, 0, -1] - end).abs() <= 1.96 * said.variance[at, 0, -1].sqrt()))
    assert np.mean(first) > 0.85
    assert np.mean(silent) > 0.85


def test_they_are_kept_in_the_file_and_say_the_same(bent: InteractionModel, tmp_path: Path) -> None:
    again = the_file_says_the_same(bent, bending(1, seed=3)[0], tmp_path)
    for ours, theirs in zip(bent.filter.readout.parameters(), again.filter.readout.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_a_model_that_grows_compares_with_the_new_ones_too(bent: InteractionModel) -> None:
    more = bent.extend(bending(10, seed=4))
    assert len(more.filter.readout.analogues.pace) == 70
    for ours, theirs in zip(bent.filter.readout.parameters(), more.filter.readout.parameters(), strict=True):
        assert torch.equal(ours, theirs)
    y = bending(1, seed=5)[0]
    assert more.forecast(y, [math.inf]).mean.isfinite().all()
    fewer = bent.rebuilt(30)
    assert fewer.forecast(y, [math.inf]).mean.isfinite().all()


def test_a_seed_reproduces(bent: InteractionModel) -> None:
    again = learn(bending(60), expert=False, **QUICK)
    for ours, theirs in zip(bent.filter.parameters(), again.filter.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_few_demonstrations_have_none_and_the_report_says_so() -> None:
    model = learn(interactions(12), steps=0, scan=4)
    assert not isinstance(model.filter.readout, AnalogueReadout)
    assert any("no analogues: 12 demonstrations, 20" in remark for remark in model.report["remarks"])


def test_what_analogues_are_worth_is_asked_of_those_who_did_not_see_it() -> None:
    """Nonsense in a fold changes every kernel but the one that says what analogues are worth there."""
    known = bending(24)
    primitive = InteractionPrimitive.fit(known)
    filter, targets = made(primitive), primitive.layout.controlled
    objective = ForecastObjective(primitive, targets, ahead=[0.1, math.inf])
    held_out = HeldOut(known, Task(primitive, objective, targets, {"all": ~targets}), TuningSettings(folds=3))
    with torch.no_grad():
        said = what_it_says(held_out, filter, torch.arange(24), moments_of(held_out))
    fold = held_out.partition.fold_of[said.interaction]
    nonsense = torch.where((fold == 1).view(-1, 1, 1, 1), 9 - said.wanted, said.wanted)
    found = []
    for wanted in (said.wanted, nonsense):
        analogues = Analogues.of(primitive)
        found.append([*fit_analogues(analogues, held_out, said._replace(wanted=wanted)), analogues])
    same = [torch.equal(a.relevance.raw, b.relevance.raw) for a, b in zip(*found, strict=True)]
    assert same == [False, True, False, False]
    noting = [Noting.of(primitive) for _ in range(3)]
    what_analogues_say(held_out, noting, said)
    for f, each in enumerate(noting):
        torch.testing.assert_close(torch.cat(each.asked), said.present.phase[fold == f])


class Noting(Analogues):
    """Remembers the phases that it is asked about."""

    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self.asked: list[torch.Tensor] = []

    def forward(self, present: Present) -> Analogy:
        """See `Analogues.forward`."""
        self.asked.append(present.phase)
        return super().forward(present)


def test_a_correction_is_ridge_regression_judged_by_folds() -> None:
    """The matrix that made the data, and no more of the mean than folds can show."""
    draws = np.random.default_rng(0)
    voices = torch.tensor(draws.standard_normal((60, 3, 2, 4)))
    place = torch.eye(2).double().expand(60, 3, 2, 2)
    true = torch.tensor(draws.standard_normal((2, 2, 2)))
    noise = 0.1 * torch.tensor(draws.standard_normal((60, 3, 2, 2)))
    wanted = torch.einsum("rkpj,pij->rkpi", voices[..., :2], true) + noise
    wanted[3, 1] = torch.nan
    fold = torch.arange(60) % 5
    found = best_correction(voices, place, wanted, fold, 5)
    for p in range(2):
        x, y = voices[:, :, p].reshape(-1, 4).numpy(), wanted[:, :, p].reshape(-1, 2).numpy()
        some = ~np.isnan(y).any(1)
        x, y = x[some], y[some]
        off = [
            np.abs(np.linalg.solve(x.T @ x + np.diag([a, a, b, b]), x.T @ y).T - found.whole[p].numpy()).max()
            for a in PULLS
            for b in FIXED
        ]
        assert min(off) < 1e-8
    assert float((found.whole[..., :2] - true).abs().max()) < 0.35
    assert float(found.whole[..., 2:].abs().max()) < 0.05
    left_out = (wanted - found.left_out).square().nanmean()
    assert float(left_out) < 0.3 * float(wanted.square().nanmean())


def test_the_filter_is_followed_where_it_is_sure() -> None:
    """Of values that it knows exactly where it is sure, and that are noise where it is not."""
    draws = torch.Generator().manual_seed(0)
    known, mean = torch.randn(2, 80, 3, 1, 2, generator=draws)
    sure = (torch.rand(80, 3, 1, 2, generator=draws) > 0.5).float()
    said = torch.where(sure > 0, known, torch.randn(known.shape, generator=draws))
    levels = torch.stack([sure, 1 - sure], -2)
    voices = torch.cat([(said.unsqueeze(-2) * levels).flatten(-2), mean], -1)
    place, fold = torch.ones(80, 3, 1, 1), torch.arange(80) % 5
    gated, alike = (best_correction(v, place, known, fold, 5) for v in (voices, torch.cat([said, mean], -1)))
    surely, unsurely = gated.whole[0, :, :2], gated.whole[0, :, 2:4]
    torch.testing.assert_close(surely, torch.eye(2), atol=0.1, rtol=0)
    assert float(unsurely.abs().max()) < 0.2
    errors = [float((known - each.left_out).square().mean()) for each in (gated, alike)]
    assert errors[0] < 0.7 * errors[1]


def test_widths_are_those_that_hold_the_error() -> None:
    """Of three deviations the one that tells the error is chosen, and stretched until 95 % lie within."""
    draws = np.random.default_rng(0)
    of_each = torch.tensor(draws.uniform(0.1, 3.0, (400, 2, 1, 2, 3)))
    error = 0.5 * of_each[..., 1] * torch.tensor(draws.standard_normal((400, 2, 1, 2)))
    fold = torch.arange(400) % 5
    place = torch.ones(400, 2, 1, 1).double()
    width, left_out = best_width(of_each, place, error, fold, 5)
    assert float(width[0, 0, 1]) == pytest.approx(0.5, rel=0.1)
    assert float(width[0, 0, [0, 2]].sum()) < 0.05
    assert float((error.abs() <= 1.96 * left_out).double().mean()) == pytest.approx(0.95, abs=0.015)


def test_widths_are_stretched_by_how_little_is_known() -> None:
    """Each level by its own errors; one that was hardly seen not less than the one below, nor less than 1."""
    draws = np.random.default_rng(0)
    levels = np.eye(3)[draws.integers(0, 2, (400, 2, 1, 2))]  # the last is never seen
    miss = np.abs(draws.standard_normal((400, 2, 1, 2))) * (levels @ np.array([0.5, 2.0, 9.0]))
    place, fold = torch.ones(400, 2, 1, 1).double(), torch.arange(400) % 5
    whole, each = stretching(torch.tensor(miss), place, torch.tensor(levels), fold)
    np.testing.assert_allclose(whole[0], [0.5, 2.0, 2.0], rtol=0.1)
    np.testing.assert_allclose(each, np.broadcast_to(whole, each.shape), rtol=0.1)
    known = torch.tensor(np.eye(3)[np.zeros_like(miss, dtype=int)])
    sure, _ = stretching(torch.tensor(0.5 * miss), place, known, fold)
    assert sure[0, 1:].tolist() == [1.0, 1.0]


def test_what_was_seen_of_late_is_of_all_samples() -> None:
    """As the filter itself remembers it at the full rate, however thinned it is when it learns."""
    known = interactions(6, dtype=torch.float64)
    primitive = InteractionPrimitive.fit(known)
    filter = made(primitive)
    y, observed = known.pad()
    observed = observed & ~known.layout.controlled
    keep = torch.tensor([[4, 20]] * 6)
    kept = filter(y, observed, keep=keep, generator=torch.Generator().manual_seed(0)).kept
    sums = recent_sums(filter.analysis.recent, y, observed, keep, 1 / known.rate)
    torch.testing.assert_close(sums, kept.memory.recent)
    counts = torch.ones_like(y)
    counts[:, :, 1] = 0
    refused = recent_sums(filter.analysis.recent, y, observed, keep, 1 / known.rate, counts)
    assert refused[..., 1].abs().max() == 0
    torch.testing.assert_close(refused[..., 0], sums[..., 0])


def trial_of(filter: InteractionFilter, primitive: InteractionPrimitive, thinning: int) -> tuple[HeldOut, Trial]:
    """Six interactions as others see them."""
    targets = primitive.layout.controlled
    objective = ForecastObjective(primitive, targets, ahead=[0.1, math.inf])
    task = Task(primitive, objective, targets, {"all": ~targets})
    held_out = HeldOut(interactions(24, dtype=torch.float64), task, TuningSettings(thinning=thinning))
    return held_out, next(iter(held_out.trials(filter, torch.arange(6), ~targets)))


@pytest.mark.parametrize("make", [particle_filter, bip, made])
def test_every_kind_of_filter_is_held_out_and_asked_for_the_targets_alone(
    make: Callable[[InteractionPrimitive], InteractionFilter],
) -> None:
    """Also those that remember nothing of late; and forecasts are those of the whole filter."""
    primitive = small_primitive(torch.float64)
    held_out, trial = trial_of(make(primitive), primitive, 3)
    objective, shown = held_out.task.objective, trial.shown
    whole = objective.forecast(trial.filter, trial.trace.kept, shown.now).select(shown.targets)
    torch.testing.assert_close(trial.forecast(objective).mean, whole.mean)
    torch.testing.assert_close(trial.forecast(objective).variance, whole.variance)


def test_a_thinned_interaction_knows_what_all_samples_showed_of_late() -> None:
    primitive = small_primitive(torch.float64)
    filter = made(primitive)
    _, trial = trial_of(filter, primitive, 3)
    steps = trial.shown.steps * 3
    y, observed = (part[:6] for part in interactions(24, dtype=torch.float64).pad())
    observed = observed & ~primitive.layout.controlled
    expected = recent_sums(filter.analysis.recent, y, observed, steps, 1 / 30)
    torch.testing.assert_close(trial.trace.kept.memory.recent, expected)
