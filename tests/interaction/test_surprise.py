"""Surprise against plain numpy, what it does to an update, and that both of its forms are one."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from tests.filtering.contract import FilterContract
from tests.interaction.surprised import cautious, strict
from tests.interaction.test_ebip import silent
from torch_ebip import BSplineBasis, EnsembleFilter, LiveFilter, StudentT, ebip
from torch_ebip.common.draws import seeded
from torch_ebip.filtering.updates.surprise import Noticed, believed
from torch_ebip.interaction.surprise import InteractionSurprise
from torch_ebip.interaction.surprise_memory import (
    ABSURD,
    ALONE,
    BACK,
    BEFORE,
    HERE,
    LEAST_SAY,
    MOST,
    MOST_BIAS,
    ONE_SIDED,
    SurpriseMemory,
    state_of,
)


class TestCautious(FilterContract):
    """Every promise of a filter holds with surprise, doubt and bounds, judging at nearly every sample."""

    def make(self, dtype: torch.dtype = torch.float32) -> EnsembleFilter:
        return cautious(small_primitive(dtype), n_members=20, weigh=True, robust=StudentT(), context=BSplineBasis(4))

    def make_without_draws(self) -> EnsembleFilter:
        return silent(cautious(small_primitive(torch.float64), n_members=20, weigh=True, square_root=True))


class Oracle:
    """The docstrings of both classes in float64 numpy, one sample after the other."""

    def __init__(self, surprise: InteractionSurprise) -> None:
        names = ("mean", "variance", "noise", "usual", "usual_bias", "bias_scale", "bounds")
        self.mean, self.variance, self.noise, self.usual, self.usual_bias, self.scale, self.bounds = (
            getattr(surprise, name).double().numpy() for name in names
        )
        self.surprise, self.sensor = surprise, surprise.sensor_of_dof.numpy()
        S = self.usual.shape[-1]
        self.total, self.samples, self.level, self.last, self.lately = np.zeros((5, S))
        self.sums = np.zeros(len(self.sensor))
        self.largest, self.recent = -math.inf, 0.0
        self.by_bias = self.by_pace = 0
        self.counts = np.ones(S)
        self.body = float(surprise.tail.quantiles[0, -1])

    def forget(self, dt: float) -> None:
        keep = math.exp(-dt / self.surprise.window)
        self.total, self.samples = self.total * keep, self.samples * keep
        slowly = math.exp(-dt / self.surprise.bias_window)
        self.lately, self.sums = self.lately * slowly, self.sums * slowly
        self.recent *= math.exp(-dt / self.surprise.memory)

    def at(self, table: np.ndarray, phase: float) -> np.ndarray:
        grid = np.linspace(0, 1, len(table))
        flat = table.reshape(len(table), -1)
        return np.stack([np.interp(phase, grid, column) for column in flat.T]).reshape(table.shape[1:])

    def judge(self, y, expected, variance, phase: float, pace: float) -> np.ndarray:
        """What each sensor counts."""
        near = (y - expected) ** 2 / (variance + self.noise)
        far = (y - self.at(self.mean, phase)) ** 2 / (self.at(self.variance, phase) + self.noise)
        usual = self.at(self.usual, phase)
        S = usual.shape[-1]
        for s in range(S):
            ours = (self.sensor == s) & ~np.isnan(y)
            if ours.any():
                u = min(max(near[ours].mean() / usual[0, s], far[ours].mean() / usual[1, s]), ABSURD)
                self.last[s] = math.log(u)
                self.total[s] += min(u, MOST * math.exp(self.bounds[1, s]))
                self.samples[s] += 1
                off = (y - expected) / np.sqrt((variance + self.noise) * usual[0, s])
                self.sums[ours] += off.clip(-ONE_SIDED, ONE_SIDED)[ours]
                self.lately[s] += 1
                theirs = self.sensor == s
                bias = np.mean((self.sums[theirs] / (self.lately[s] + BEFORE)) ** 2)
                bias = self.scale[0, s] + self.scale[1, s] * math.log(
                    max(bias / self.at(self.usual_bias, phase)[s], LEAST_SAY)
                )
                low, high = self.bounds[:, s]
                falls = 2 * self.scale[1, s] * BACK / self.surprise.bias_window
                most = high + min(max(falls - (high - low), 0), math.log(MOST_BIAS))
                if bias > most:
                    self.sums[theirs] *= math.exp(-0.5 * (bias - most) / self.scale[1, s])
                    bias = most
                self.level[s] = max(math.log((self.total[s] + 1) / (self.samples[s] + 1)), bias)
                self.by_bias += bias == self.level[s]
        known = self.surprise.known.numpy()
        voices = [s for s in range(S) if self.samples[s] > HERE and known[s]]
        excess = (self.level - self.bounds[0]) / (self.bounds[1] - self.bounds[0])
        middle = max(sorted(excess[voices])[len(voices) // 2 if len(voices) > 2 else 0], 0.0) if voices else 0.0
        counts = self.counts  # of those who say nothing as they were
        for s in voices:
            alone = (self.last[s] - self.bounds[1, s] - math.log(ALONE[0])) / math.log(ALONE[1] / ALONE[0])
            x = min(max(excess[s] - middle, alone, 0.0), 1.0)
            counts[s] = 1 - x * x * (3 - 2 * x)
        if voices and not np.isnan(y).all():
            say = counts[voices] + LEAST_SAY
            whole = float((excess[voices] * say).sum() / say.sum())
            away = (pace - self.surprise.pace[0].item()) / self.surprise.pace[1].item()
            offset, scale = self.surprise.pace_scale.tolist()
            self.by_pace += offset + scale * math.log1p(away**2) > whole
            whole = max(whole, offset + scale * math.log1p(away**2))
            least = 1 / max(known.sum(), 2)
            few = ((say**2).sum() / say.sum() ** 2 - least) / (1 - least)
            offset, scale = self.surprise.alone_scale.tolist()
            whole += min(max(few, 0.0), 1.0) * (offset + scale * whole)
            self.largest, self.recent = max(self.largest, whole), max(self.recent, whole - self.body)
        return counts.copy()


def conversation(count: int = 24, gaps: bool = True, seed: int = 3):
    """Samples y, expected, variance [T, D] and phase [T] that surprise now and then."""
    draws = np.random.default_rng(seed)
    primitive = small_primitive(torch.float64)
    phase = np.linspace(-0.05, 1.05, count)
    path = primitive.basis.project(
        torch.tensor(phase).clamp(0, 1), primitive.weights.mean(0).expand(count, -1)
    ).numpy()
    off = draws.standard_normal((count, 5)) * np.where(np.arange(count) % 4 == 3, 3.0, 0.1)[:, None]
    y = path + off * np.array([1.0, 0.3, 1.0, 1.0, 1.0])
    if gaps:
        y[2, 0], y[5, 2], y[6, :2], y[8] = (math.nan,) * 4
    y[:, 3:] = math.nan
    path[4:, :3] -= np.array([0.15, 0.15, 0.1])  # from here on they differ in one direction
    return y, path + 0.05 * draws.standard_normal((count, 5)), draws.uniform(0.001, 0.05, (count, 5)), phase


@pytest.mark.parametrize("form", ["tensors", "a batch", "plain numbers"])
def test_it_is_the_formula(form: str) -> None:
    """Levels, what sensors count and the whole: of a sequence, of a batch of them, and of the fast twin."""
    surprise = strict(small_primitive(torch.float64))
    surprise.usual_bias *= 0.3
    surprise.alone_scale += torch.tensor([-0.2, -0.3])
    oracle = Oracle(surprise)
    y, expected, variance, phase = (torch.tensor(part) for part in conversation(gaps=form != "plain numbers"))
    memory = surprise.start(torch.zeros(*((2,) if form == "a batch" else ()), 3, 2, dtype=torch.float64))
    hand = torch.tensor([0, 1, 2])
    less = 0
    paces = surprise.pace[0] + surprise.pace[1] * torch.linspace(0, 20, len(y), dtype=torch.float64)
    for t in range(len(y)):
        if t:
            oracle.forget(0.05)
            memory = surprise.forget(memory, torch.tensor(0.05, dtype=torch.float64))
        wanted = oracle.judge(
            y[t].numpy(), expected[t].numpy(), variance[t].numpy(), float(phase[t]), float(paces[t])
        )
        moving = torch.stack([phase[t], paces[t]])
        if form == "plain numbers":
            with torch.no_grad():
                noticed = Noticed(y[t, hand], None, hand, expected[t, hand], variance[t, hand], moving)
                memory, counts = surprise.judge(memory, noticed)
        else:
            parts = (y[t].nan_to_num(), ~y[t].isnan(), None, expected[t], variance[t], moving)
            if form == "a batch":
                parts = tuple(None if part is None else torch.stack([part, part]) for part in parts)
            memory, counts = surprise.judge(memory, Noticed(*parts))
        one = SurpriseMemory(memory.kept[0]) if form == "a batch" else memory
        np.testing.assert_allclose(one.counts, wanted, atol=1e-12)
        np.testing.assert_allclose(one.level, oracle.level, atol=1e-12)
        np.testing.assert_allclose(
            [float(one.largest), float(one.recent)], [oracle.largest, oracle.recent], atol=1e-12
        )
        assert (counts is None) == bool((wanted == 1).all())
        if counts is not None:
            less += 1
            each = counts[0] if form == "a batch" else counts
            np.testing.assert_allclose(each[:3], wanted[surprise.sensor_of_dof[:3].numpy()], atol=1e-12)
    assert less > 3
    assert oracle.by_bias > 5
    assert 2 < oracle.by_pace < len(y)
    assert (surprise._single is not None) == (form == "plain numbers")


def test_familiarity_is_the_chance_of_the_largest_so_far() -> None:
    surprise = strict(small_primitive())
    memory = surprise.start(torch.zeros(2, 2))
    assert float(surprise.familiarity(memory)) == 1.0
    largest = torch.tensor([-0.49, 0.0, 0.3, 1.0])
    said = surprise.familiarity(SurpriseMemory(largest[:, None, None].expand(-1, 4, 8)))
    assert (said.diff() < 0).all()
    tail = surprise.tail
    assert abs(float(said[1]) - 0.5) < 0.1
    beyond = 0.2 * math.exp(-(1.0 - float(tail.quantiles[0, -1])) / float(tail.length))
    assert float(said[3]) == pytest.approx(beyond, rel=1e-4)


def test_without_calibration_nobody_is_judged_and_nothing_is_known() -> None:
    primitive = small_primitive()
    plain, listening = ebip(primitive, square_root=True), ebip(primitive, square_root=True)
    listening.analysis.surprise = InteractionSurprise.of(primitive)
    y = torch.where(primitive.layout.controlled, torch.nan, interactions(2, seed=5)[1])
    ours, theirs = (f(y, generator=seeded(0)) for f in (listening, plain))
    assert torch.equal(ours.state.members, theirs.state.members)
    assert ours.familiarity.isnan().all()
    assert theirs.familiarity is None
    assert (ours.counts == 1).all()
    assert math.isnan(float(plain.familiarity(theirs.state)))


def test_what_is_rejected_was_not_measured() -> None:
    """Within rounding: not by the state, not by the evidence, not by inflation."""
    primitive = small_primitive(torch.float64)
    filter = cautious(primitive, square_root=True, weigh=True, inflation=1.02)
    state = filter.initial_state()
    row = interactions(2, seed=5, dtype=torch.float64)[1][0]
    state, _ = filter.update(state, torch.where(primitive.layout.controlled, torch.nan, row))
    state = filter.predict(state, 1 / 30)
    mad, gone = row.clone(), row.clone()
    mad[0], gone[:2] = 40.0, torch.nan
    seen = ~primitive.layout.controlled
    ours, _ = filter.update(state, mad, seen)
    theirs, _ = filter.update(state, gone, seen & ~gone.isnan())
    assert [state_of(float(c)) for c in ours.memory.surprise.counts] == ["rejected", *["ok"] * 2]
    torch.testing.assert_close(ours.members, theirs.members, atol=1e-7, rtol=0)
    torch.testing.assert_close(ours.weights, theirs.weights, atol=1e-7, rtol=0)


@pytest.mark.parametrize("robust", [None, StudentT()])
def test_a_sensor_comes_back_when_it_agrees_whatever_robust_weights_hide(robust: StudentT | None) -> None:
    primitive = small_primitive()
    honest = 100 * primitive.residual_variance
    filter = cautious(primitive, above=1.5, square_root=True, robust=robust, residual_variance=honest)
    y = torch.where(primitive.layout.controlled, torch.nan, interactions(3, seed=5)[1].clone())
    y[5:12, :2] += 3.0
    counts = filter(y, generator=seeded(0)).counts[:, 0]
    assert (counts[5:12] < 0.01).all()
    assert (counts[24:] > 0.5).all()  # less than half a second later


def test_robust_weights_do_not_change_what_surprises() -> None:
    """They are asked afterwards: the first sample that they hide surprises as much."""
    primitive = small_primitive()
    levels = []
    for robust in (None, StudentT(1.0)):
        filter = cautious(primitive, square_root=True, robust=robust)
        state, _ = filter.update(filter.initial_state(), torch.tensor([9.0, 9.0, 0.1, math.nan, math.nan]))
        levels.append(state.memory.surprise.level)
    assert torch.equal(*levels)


def test_what_counts_less_moves_the_mean_less_and_smoothly() -> None:
    noticed = Noticed(*torch.randn(4, 3, dtype=torch.float64).abs()[:1], None, None, *torch.rand(2, 3).double(), None)
    deviation = torch.rand(3, dtype=torch.float64) + 0.1
    counts = torch.tensor([0.3, 0.9, 1.0], dtype=torch.float64, requires_grad=True)
    y, wider = believed(noticed, deviation, counts)
    gain = noticed.variance / (noticed.variance + deviation.square())
    less = noticed.variance / (noticed.variance + wider.square())
    torch.testing.assert_close(less, gain * counts)
    assert torch.equal(y, noticed.y)
    assert float(wider[2]) == float(deviation[2])
    assert torch.autograd.gradcheck(
        lambda c: believed(noticed, deviation, c)[1][:2], counts.detach().requires_grad_()
    )
    none = believed(noticed, deviation, torch.zeros(3, dtype=torch.float64))
    assert torch.equal(none[0], noticed.expected)
    assert (none[1] > 1e4 * deviation).all()


def test_live_and_dense_and_whole_sequences_say_the_same() -> None:
    primitive = small_primitive()
    filter = cautious(primitive, square_root=True, weigh=True)
    y = torch.where(primitive.layout.controlled, torch.nan, interactions(3, seed=5)[2])
    y[8:14, 2] += 2.0
    with torch.no_grad():
        dense, span = (filter(y, generator=seeded(0), engine=engine) for engine in ("dense", "span"))
    live = LiveFilter(filter, generator=seeded(0))
    for t, row in enumerate(y):
        if t:
            live.predict()
        live.update(row)
        assert float(live.familiarity) == pytest.approx(float(span.familiarity[t]), abs=1e-5)
        torch.testing.assert_close(live.counts, span.counts[t], atol=1e-4, rtol=0)
    torch.testing.assert_close(dense.surprise, span.surprise, atol=1e-4, rtol=0)
    torch.testing.assert_close(dense.counts, span.counts, atol=1e-3, rtol=0)
    assert float(span.familiarity[-1]) < 0.5
    assert float(filter.familiarity(span.state)) == float(span.familiarity[-1])


def test_a_snapshot_holds_it_and_a_copy_of_the_filter_works() -> None:
    primitive = small_primitive()
    live = LiveFilter(cautious(primitive, square_root=True), generator=seeded(0))
    row = torch.where(primitive.layout.controlled, torch.nan, interactions(3, seed=5)[2][0])
    live.update(row)
    kept = live.save()
    said = []
    for _ in range(2):
        live.load(kept)
        live.predict()
        live.update(row + 1.0)
        said.append([*live.carrier.memory.surprise, live.phase])
    assert all(torch.equal(a, b) for a, b in zip(*said, strict=True))
    assert not torch.equal(said[0][0], kept.memory.surprise.kept)


def test_who_is_not_known_has_no_say() -> None:
    """A sensor that was never shown in calibration says nothing of familiarity, in either form."""
    primitive = small_primitive()
    surprise = strict(primitive)
    surprise.known[1] = False
    gaze = torch.tensor([2])
    parts = [part[:1] for part in torch.rand(3, 1)]
    noticed = Noticed(100 + parts[0], None, gaze, *parts[1:], torch.tensor([0.3, 1.0]))
    start = surprise.start(torch.zeros(3, 2))
    with torch.no_grad():
        plain, _ = surprise.judge(start, noticed)
    tensors, counts = surprise.judge(start, noticed._replace(observed=torch.tensor([True])))
    assert counts is None
    for memory in (plain, tensors):
        assert float(surprise.familiarity(memory)) == 1.0
        assert (memory.counts == 1).all()
    torch.testing.assert_close(plain.kept, tensors.kept)


def test_an_absurd_value_of_one_sensor_reaches_no_other() -> None:
    primitive = small_primitive()
    surprise = strict(primitive)
    seen = torch.tensor([True, True, True, False, False])
    y = torch.tensor([1e30, 0.0, 0.1, 0.0, 0.0])
    noticed = Noticed(y, seen, None, torch.zeros(5), torch.ones(5), torch.tensor([0.3, 1.0]))
    memory, counts = surprise.judge(surprise.start(torch.zeros(3, 2)), noticed)
    assert counts[:2].tolist() == [0.0, 0.0]
    assert memory.kept[..., :-1, :].isfinite().all()


def test_copies_have_tables_of_their_own() -> None:
    """What is kept for rows of a live filter is not looked up for others that lie where those did."""
    primitive = small_primitive()
    filter = cautious(primitive, square_root=True)
    live = LiveFilter(filter)
    live.update(torch.where(primitive.layout.controlled, torch.nan, interactions(3, seed=5)[2][0]))
    judge = live.carrier._update.surprise
    assert judge._single is not None
    again = copy.deepcopy(judge)
    assert again._single is None
    assert again._kept is None


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"suspect": 0.0}, "suspect is a chance, between 0 and 1"),
        ({"rejected": 1.0}, "rejected is a chance, between 0 and 1"),
        ({"suspect": math.nan}, "suspect"),
        ({"suspect": 0.5}, r"suspect must be at most 0\.2"),
        ({"suspect": 0.01, "rejected": 0.02}, "rejected less than suspect"),
        ({"window": 0.0}, "window"),
        ({"memory": -1.0}, "memory"),
        ({"bias_window": 0.0}, "bias_window"),
    ],
)
def test_bad_settings_are_named(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        InteractionSurprise.of(small_primitive(), **settings)


def test_one_of_other_dofs_is_refused() -> None:
    model = ebip(small_primitive()).model
    some = model.view(torch.tensor([True, True, True, False, False]))
    part = InteractionSurprise.of(small_primitive()).select(some)
    with pytest.raises(ValueError, match="the surprise is for 3 DoFs, the model has 5"):
        part.check(model)
    with pytest.raises(ValueError, match=r"mean and variance must be \[P, 2\]"):
        InteractionSurprise(*torch.zeros(2, 4, 3), torch.ones(2), torch.zeros(2, dtype=torch.long), torch.ones(2))


@pytest.mark.parametrize("scale", [0.2, 0.5, 0.9, 2.0])
def test_a_bias_that_ends_is_forgotten_within_half_a_second(scale: float) -> None:
    """However steep its scale: from the most that it can be to below what is suspect."""
    surprise = strict(small_primitive(torch.float64))
    surprise.bias_scale[1] = scale
    hand = torch.tensor([0, 1])
    memory, dt = surprise.start(torch.zeros(3, 2)), torch.tensor(0.02, dtype=torch.float64)
    one, at = torch.ones(2, dtype=torch.float64), torch.tensor([0.3, 1.0], dtype=torch.float64)
    mean = surprise.mean[round(0.3 * (len(surprise.mean) - 1)), :2]
    for step in range(55):
        memory = surprise.forget(memory, dt)
        off = 5.0 if step < 30 else 0.0
        memory, _, _ = surprise.update(memory, Noticed(mean + off, None, hand, mean, one, at))
        if step == 29:
            assert float(memory.level[0]) >= float(surprise.bounds[1, 0])
    assert float(memory.level[0]) < float(surprise.bounds[0, 0])


def test_who_is_silent_is_as_bad_as_before_in_a_batch_as_alone() -> None:
    """Nothing is forgiven in silence, and nothing depends on who else is in the batch."""
    primitive = small_primitive()
    filter = cautious(primitive, square_root=True)
    y = torch.where(primitive.layout.controlled, torch.nan, torch.stack(list(interactions(6, seed=5))[:1]))
    y = torch.cat([y, y])[:, :25].clone()
    y[0, 3:6, :2] += 9.0
    y[0, 6:] = torch.nan
    seen = ~y.isnan()
    with torch.no_grad():
        both = filter(y, seen, generator=[seeded(0), seeded(1)])
        alone = filter(y[0], seen[0], generator=seeded(0))
    assert float(alone.counts[5, 0]) == 0.0
    assert (alone.counts[6:, 0] == 0).all()
    torch.testing.assert_close(both.counts[0], alone.counts, atol=1e-4, rtol=0)


def test_who_is_silent_while_others_speak_is_not_forgiven() -> None:
    primitive = small_primitive()
    filter = cautious(primitive, square_root=True)
    y = torch.where(primitive.layout.controlled, torch.nan, interactions(6, seed=5)[0][:25].clone())
    y[3:6, :2] += 9.0
    y[6:, :2] = torch.nan
    with torch.no_grad():
        assert (filter(y, generator=seeded(0)).counts[5:, 0] == 0).all()
    assert (filter(y, generator=seeded(0)).counts[5:, 0] == 0).all()


def test_an_entry_of_which_nothing_was_measured_stays_as_it_was() -> None:
    """Although a verdict on it would be another one by now: the sensor beside which it lied has no voice any more."""
    surprise = strict(small_primitive())
    kept = surprise.start(torch.zeros(2, 3, 2)).kept.clone()
    kept[0, 0, 1], kept[0, 0, 2], kept[0, 0, 3] = 1.0, float(surprise.bounds[1, 0]) + 0.1, 0.0
    observed = torch.tensor([[False] * 5, [True, True, True, False, False]])
    noticed = Noticed(torch.zeros(2, 5), observed, None, *torch.zeros(2, 2, 5) + 1, torch.tensor([[0.3, 1.0]] * 2))
    memory, _ = surprise.judge(SurpriseMemory(kept), noticed)
    assert torch.equal(memory.kept[0], kept[0])
    assert not torch.equal(memory.kept[1], kept[1])


def test_two_of_four_that_are_surprised_are_no_liars() -> None:
    """Beside a sensor that says nothing of the movement: as many are surprised as are not."""
    surprise = strict(small_primitive())
    noticed = Noticed(torch.zeros(1), None, None, *torch.zeros(2, 1), torch.tensor([0.5, 1.0]))
    surprise.bounds = torch.tensor([[0.0] * 4, [1.0] * 4])
    surprise.known = torch.ones(4, dtype=torch.bool)
    kept = torch.zeros(5, 8)
    kept[:4, 1] = 1.0  # all are here
    kept[:4, 2] = torch.tensor([2.0, 1.9, -3.0, -2.0])
    kept[:4, 3] = 1.0
    _, counts = surprise.verdict(SurpriseMemory(kept), noticed)
    assert float(counts[:2].min()) > 0.9
    kept[:4, 2] = torch.tensor([2.0, -1.9, -3.0, -2.0])
    _, counts = surprise.verdict(SurpriseMemory(kept), noticed)
    assert counts.tolist() == [0.0, 1.0, 1.0, 1.0]


def test_time_that_is_written_over_is_noticed() -> None:
    surprise = strict(small_primitive())
    memory = SurpriseMemory(torch.ones_like(surprise.start(torch.zeros(3, 2)).kept))
    dt = torch.tensor(0.1)
    first = surprise.forget(memory, dt).kept
    dt.fill_(1.0)
    second = surprise.forget(memory, dt).kept
    assert float(second[0, 0]) == pytest.approx(math.exp(-1.0 / surprise.window))
    assert float(first[0, 0]) == pytest.approx(math.exp(-0.1 / surprise.window))
    with torch.inference_mode():
        surprise.forget(memory, dt)
    weight = torch.ones((), requires_grad=True)
    (surprise.forget(memory, dt).kept * weight).sum().backward()
    assert weight.grad is not None


def test_absurd_values_leave_gradients_finite() -> None:
    primitive = small_primitive()
    filter = cautious(primitive, square_root=True, residual_variance=100 * primitive.residual_variance)
    y = torch.where(primitive.layout.controlled, torch.nan, interactions(3, seed=5)[1][:6].clone())
    y[4, 0] = 1e18
    forecast = filter.forecast(filter(y, generator=seeded(0)).state, 1.0)
    (forecast.mean.sum() + forecast.variance.sum()).backward()
    for name, parameter in filter.named_parameters():
        assert parameter.grad is None or parameter.grad.isfinite().all(), name


def test_another_default_device_changes_nothing() -> None:
    primitive = small_primitive()
    row = torch.where(primitive.layout.controlled, torch.nan, interactions(3, seed=5)[2][0])
    said = []
    for device in ("cpu", "meta"):
        live = LiveFilter(cautious(primitive, square_root=True), generator=seeded(0))
        with torch.device(device):
            live.update(row)
        said.append(live.carrier.memory.surprise.kept)
    assert torch.equal(*said)
