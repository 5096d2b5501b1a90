"""Analogues against their formula in numpy; the read-out that corrects them; and the contract of every filter."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.conftest import interactions, small_primitive
from tests.filtering.contract import FilterContract
from tests.interaction.analogous import bent, heard
from tests.interaction.test_ebip import silent
from torch_ebip import Demonstrations, Forecast, InteractionPrimitive, LiveFilter, ebip
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.states import map_state
from torch_ebip.filtering.updates.recent import Line
from torch_ebip.interaction import InteractionEnsembleFilter
from torch_ebip.interaction.analogue_readout import AnalogueReadout
from torch_ebip.interaction.analogues import LEAST, REACH, UNLIKE, Analogues
from torch_ebip.interaction.compared import FAR
from torch_ebip.interaction.present import Present, prior_of
from torch_ebip.interaction.readout import Lead

END = math.inf


class TestContract(FilterContract):
    """With a read-out that bends it is a filter like others."""

    def make(self, dtype: torch.dtype = torch.float32) -> InteractionEnsembleFilter:
        return bent(small_primitive(dtype), weigh=True)

    def make_without_draws(self) -> InteractionEnsembleFilter:
        return silent(bent(small_primitive(torch.float64), weigh=True, square_root=True))


def present_of(primitive: InteractionPrimitive, seed: int = 0) -> Present:
    """Of three moments: all is seen; a DoF and all velocities are not; nothing is."""
    draws, N, D = np.random.default_rng(seed), len(primitive), primitive.layout.n_dofs
    weights = torch.tensor(draws.dirichlet(np.ones(N), 3))
    weights[:, 4] = 0
    belief = torch.ones(3, D, dtype=torch.float64)
    belief[0, 1], belief[1, 0], belief[2] = 0.4, 0.0, 0.0
    moves = torch.tensor([[True] * D, [False] * D, [True] * D])
    value, velocity = (torch.tensor(draws.standard_normal((3, D))) for _ in range(2))
    line = Line(value, velocity, belief, moves, torch.zeros_like(value))
    return Present(
        torch.tensor([0.3, 0.62, 0.9]).double(), torch.tensor([0.003, 0.0, 0.01]).double(), weights.log(), line
    )


def test_weights_are_those_of_the_formula() -> None:
    """Pair by pair, in loops."""
    primitive = small_primitive(torch.float64)
    analogues = bent(primitive).readout.analogues
    present = present_of(primitive)
    found = analogues(present)
    N, phases, step = len(primitive), np.linspace(0, 1, 41), 1e-6
    basis, weights, pace = primitive.basis, primitive.weights, primitive.phase_velocity

    def path(j: int, phase: float) -> np.ndarray:
        return basis.project(torch.tensor(phase, dtype=torch.float64), weights[j]).numpy()

    value = np.stack([[path(j, p) for p in phases] for j in range(N)])
    ends = [(max(p - step, 0.0), min(p + step, 1.0)) for p in phases]
    slope = np.stack([[(path(j, b) - path(j, a)) / (b - a) for a, b in ends] for j in range(N)])
    speed = slope * pace.numpy()[:, None, None]
    deviations = [primitive.value_variance.sqrt().numpy(), speed.reshape(-1, 5).std(0, ddof=1)]
    middle = value.mean((0, 1))
    r, t = analogues.relevance.value.detach().numpy(), analogues.tilt.value.detach().numpy()
    m, loose = analogues.memory.value.item(), analogues.looseness.value.item()
    sensors = [[0, 1], [2]]
    for row in range(3):
        phase, variance = float(present.phase[row]), float(present.variance[row])
        logits = np.full((41, N), -np.inf)
        for i, p in enumerate(phases):
            off = (p - phase) ** 2 / max(variance * loose**2, LEAST**2)
            for j in range(N):
                if off > REACH**2 or float(present.prior[row, j]) == -np.inf:
                    continue
                total = m * float(present.prior[row, j]) - 0.5 * off
                for g, (x, f) in enumerate(
                    ((present.line.value[row], value[j, i]), (present.line.velocity[row], speed[j, i]))
                ):
                    c = present.line.belief[row].numpy() * (1 if g == 0 else present.line.moves[row].numpy())
                    for dofs in sensors:
                        if c[dofs].sum() == 0:
                            continue
                        share = c[dofs] * (c[dofs] ** 2).sum() / c[dofs].sum() ** 2
                        for d, s in zip(dofs, share, strict=True):
                            off_by = middle[d] if g == 0 else 0.0
                            ours, theirs = (
                                np.clip((v - off_by) / deviations[g][d], -FAR, FAR) for v in (float(x[d]), f[d])
                            )
                            total -= 0.5 * s * r[g, d] * np.exp(t[g] * (phase - 0.5)) * (ours - theirs) ** 2
                logits[i, j] = total
        pairs = np.exp(logits - logits.max())
        pairs /= pairs.sum()
        np.testing.assert_allclose(found.weights[row].detach(), pairs.sum(0), rtol=2e-4, atol=1e-9)
        some = pairs.sum(0) > 1e-6
        where = (pairs * phases[:, None]).sum(0)[some] / pairs.sum(0)[some]
        np.testing.assert_allclose(found.phase[row].detach()[some], where, rtol=1e-4)


def test_what_came_of_them_is_at_their_own_pace() -> None:
    primitive = small_primitive(torch.float64)
    analogues, present = Analogues.of(primitive), present_of(primitive)
    analogy = analogues(present)
    asked = torch.tensor([0.1, 0.4, END], dtype=torch.float64)
    nothing = torch.zeros(3, 3, dtype=torch.float64)
    mean, variance = analogues.forecast(analogy, Lead(nothing, nothing, nothing, nothing, asked))
    w, phase = analogy.weights.detach().numpy(), analogy.phase.detach().numpy()
    there = (present.prior > -math.inf).numpy()
    unlike = UNLIKE / (UNLIKE + 1 / (w**2).sum(-1, keepdims=True))
    wide = (1 - unlike) * w + unlike * there / there.sum(-1, keepdims=True)
    for row in range(3):
        for p, seconds in enumerate(asked.tolist()):
            at = (
                np.ones(24)
                if seconds == END
                else np.clip(phase[row] + seconds * primitive.phase_velocity.numpy(), 0, 1)
            )
            paths = primitive.basis.project(torch.tensor(at), primitive.weights).numpy()
            expected = w[row] @ paths
            np.testing.assert_allclose(mean[row, p].detach(), expected, atol=2e-5)
            np.testing.assert_allclose(variance[row, p].detach(), wide[row] @ (paths - expected) ** 2, atol=2e-5)
    lead = Lead(nothing, nothing, torch.tensor([0.5, 0.8, 1.0]).double().expand(3, -1), nothing)
    mean, _ = analogues.forecast(analogy, lead)
    paths = torch.stack(
        [primitive.basis.project(torch.tensor(p).double(), primitive.weights) for p in (0.5, 0.8, 1.0)]
    )
    np.testing.assert_allclose(mean.detach(), np.einsum("rn,pnd->rpd", w, paths), atol=2e-5)


def test_what_is_exactly_there_is_found() -> None:
    """A demonstration that is seen itself, among others that differ, has nearly all the weight."""
    primitive = small_primitive(torch.float64)
    analogues = Analogues.of(primitive)
    with torch.no_grad():
        analogues.relevance.raw.fill_(4.0)
    phase = torch.tensor(0.5, dtype=torch.float64)
    value = primitive.basis.project(phase, primitive.weights)
    velocity = (
        primitive.basis.project_derivative(phase.expand(24), primitive.weights) * primitive.phase_velocity[:, None]
    )
    line = Line(
        value, velocity, torch.ones_like(value), torch.ones_like(value, dtype=torch.bool), torch.zeros_like(value)
    )
    even = torch.full((24, 24), -math.log(24), dtype=torch.float64)
    found = analogues(Present(phase.expand(24), torch.full((24,), 0.01).double(), even, line))
    assert (found.weights.argmax(-1) == torch.arange(24)).all()
    assert float(found.weights.detach().diagonal().min()) > 0.5


def test_one_that_has_all_weight_is_not_sure_of_all_that_comes() -> None:
    """As wide as a chance of 1 in 11 makes it that it is none of them; without that it would be as narrow as 0."""
    primitive = small_primitive(torch.float64)
    present = present_of(primitive)
    only = torch.full_like(present.prior, -40.0)
    only[:, 7] = 0.0
    lead = Lead(*torch.ones(4, 3, 1).double())
    paths = primitive.basis.project(torch.tensor(1.0).double(), primitive.weights)
    for unlike, share in ((UNLIKE, 1 / 11), (0.0, 0.0)):
        analogues = Analogues.of(primitive, unlike=unlike)
        with torch.no_grad():
            analogues.memory.raw.fill_(20.0)
        _, variance = analogues.forecast(analogues(present._replace(prior=only)), lead)
        apart = share * (paths - paths[7]).square().mean(0)
        np.testing.assert_allclose(variance[:, 0].detach(), apart.expand(3, -1), rtol=1e-3, atol=1e-6)


def test_units_and_places_change_nothing() -> None:
    known = interactions(dtype=torch.float64)
    factor, shift = torch.tensor([1000.0, 3.0, 0.1, 2.0, 50.0]).double(), torch.tensor([5.0, -90, 7, 1, 3]).double()
    moved = Demonstrations(known.layout, [each * factor + shift for each in known], known.rate)
    said = []
    for each in (known, moved):
        primitive = InteractionPrimitive.fit(each, small_primitive().basis)
        filter = bent(primitive, weigh=True, square_root=True)
        if each is moved:
            ratio = factor.unsqueeze(-1) / factor
            filter.readout.follow.mul_(ratio.repeat(1, len(filter.readout.levels)))
            filter.readout.correct.mul_(ratio)
        y, observed = (part[0, :20] for part in each.pad())
        trace = filter(y, observed & ~each.layout.controlled, generator=torch.Generator().manual_seed(0))
        said.append(filter.forecast(trace.state, ahead=[0.2, END]))
    torch.testing.assert_close(said[1].mean, said[0].mean * factor + shift, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(said[1].variance, said[0].variance * factor.square(), rtol=1e-5, atol=0)


def test_batch_subset_live_and_dense_say_the_same() -> None:
    primitive = small_primitive(torch.float64)
    filter = bent(primitive, weigh=True, square_root=True)
    y, observed = (part[:3, :25] for part in interactions(3, seed=7, dtype=torch.float64).pad())
    observed = observed & ~primitive.layout.controlled
    observed[1, 12:, 2] = False
    ahead = [0.1, 0.33, END]

    def draws() -> list[torch.Generator]:
        return [torch.Generator().manual_seed(i) for i in range(3)]

    state = filter(y, observed, generator=draws()).state
    said = filter.forecast(state, ahead=ahead)
    with torch.no_grad():
        trace = filter(y, observed, generator=draws())
        assert trace.engine == "span"
        torch.testing.assert_close(filter.forecast(trace.state, ahead=ahead).mean, said.mean)
        for i in range(3):
            alone = map_state(lambda part, i=i: part[i], state)
            torch.testing.assert_close(filter.forecast(alone, ahead=ahead).mean, said.mean[i])
            torch.testing.assert_close(filter.forecast(alone, ahead=ahead).variance, said.variance[i])
            live = LiveFilter(filter, observed.flatten(0, 1).any(0), generator=torch.Generator().manual_seed(i))
            for t in range(25):
                if t:
                    live.predict()
                live.update(torch.where(observed[i, t], y[i, t], torch.nan))
            torch.testing.assert_close(live.forecast(ahead=ahead).mean, said.mean[i])
            for dofs in ([False, False, False, True, True], [False, False, False, False, True], [True] + [False] * 4):
                mask = torch.tensor(dofs)
                torch.testing.assert_close(live.forecast(dofs=mask, ahead=ahead).mean, said.mean[i][:, mask])
                torch.testing.assert_close(live.forecast(0.9, mask).mean, live.forecast(0.9).mean[:, mask])
        sensors = torch.tensor([True, True, False, True, True])
        part = filter.restrict(sensors)
        trace = part(y[..., sensors], observed[..., sensors], generator=draws())
        alone = filter(y, observed & torch.tensor([True, True, False, False, False]), generator=draws())
        expected = filter.forecast(alone.state, ahead=ahead).mean[..., sensors]
        torch.testing.assert_close(part.forecast(trace.state, ahead=ahead).mean, expected)


def test_a_demonstration_that_is_no_member_has_no_say() -> None:
    primitive = small_primitive(torch.float64)
    filter = bent(primitive, weigh=True)
    chosen = torch.tensor([[2, 3, 5, 7, 7, 11]])
    state = filter.initial_state((1,), chosen)
    weights = filter.attribution(state)[0].detach()
    assert weights[[2, 3, 5, 7, 11]].sum() == pytest.approx(1.0)
    assert weights[0] == 0
    assert prior_of(state.memory, 24).exp()[0, 7] == pytest.approx(2 / 6)


def test_attribution_is_what_analogues_count() -> None:
    primitive = small_primitive(torch.float64)
    filter = bent(primitive, weigh=True)
    y, observed = (part[:2, :20] for part in interactions(2, seed=7, dtype=torch.float64).pad())
    state = filter(y, observed & ~primitive.layout.controlled, generator=torch.Generator().manual_seed(0)).state
    torch.testing.assert_close(filter.attribution(state), filter.readout.analogues(filter.present(state)).weights)
    torch.testing.assert_close(filter.attribution(state).sum(-1), torch.ones(2).double())


def test_the_forecast_is_put_together_as_it_is_written() -> None:
    """Mean and deviation between horizons, the members moved and stretched with them."""
    primitive = small_primitive(torch.float64)
    filter = bent(primitive, weigh=True)
    y, observed = (part[:2, :20] for part in interactions(2, seed=7, dtype=torch.float64).pad())
    state = filter(y, observed & ~primitive.layout.controlled, generator=torch.Generator().manual_seed(0)).state
    readout, ahead = filter.readout, torch.tensor([0.1, 0.375, END]).double()
    places = [0.005, 0.03, 0.12]  # it is surer than filters that are tuned
    readout.levels.copy_(torch.tensor(places))
    said = filter.forecast(state, ahead=ahead)
    filter.readout = None
    alone = filter.forecast(state, ahead=ahead)
    lead = filter.lead(state, alone.phase, ahead)
    mean, variance = filter.demonstrated(lead.phase)
    theirs, spread = readout.analogues.forecast(readout.analogues(filter.present(state)), lead)
    B, C, width = readout.follow.unflatten(-1, (3, 5)).transpose(1, 2), readout.correct, readout.width
    sure = np.sqrt((alone.variance / variance).detach().numpy())  # by DoF
    levels = torch.tensor(np.stack([np.interp(sure, places, row) for row in np.eye(3)], -2))  # [2, 3, J, D]
    assert 0.1 < float(levels[..., 1, :].mean()) < 0.9
    some: list[float] = []
    for p, (first, second) in enumerate(((0, 0), (1, 2), (4, 4))):
        seconds = lead.seconds[:, p]
        assert p == 2 or float((seconds - ahead[p]).abs().max()) < 1e-6
        b, c, w = ((m[first] + m[second]) / 2 for m in (B, C, width))
        f, h, m = alone.mean[:, p], theirs[:, p], mean[:, p]
        followed = sum((levels[:, p, j] * (f - h)) @ b[j].T for j in range(3))
        least = (readout.surest[first] + readout.surest[second]).numpy() / 2
        surer = torch.tensor(1 - np.minimum(sure[:, p] / least, 1) ** 2)
        stacked = h + followed + (h - m) @ c.T
        torch.testing.assert_close(said.mean[:, p], stacked + surer * (f - stacked))
        some.append(float(surer.mean()))
        deviation = torch.stack([alone.variance[:, p].sqrt(), spread[:, p].sqrt(), variance[:, p].sqrt()], -1)
        stretch = (levels[:, p].transpose(-1, -2) * (readout.stretch[first] + readout.stretch[second]) / 2).sum(-1)
        torch.testing.assert_close(said.variance[:, p].sqrt(), (w * deviation).sum(-1) * stretch)
    assert 0.02 < sum(some) / 3 < 0.98
    moments = (said.weights.unsqueeze(-1) * said.members).sum(-2)
    torch.testing.assert_close(moments, said.mean)
    assert said.crps(said.mean.detach()).isfinite().all()


def test_gradients_reach_the_noise_and_the_kernel() -> None:
    primitive = small_primitive(torch.float64)
    filter = bent(primitive, weigh=True, square_root=True)
    y, observed = (part[:2, :8] for part in interactions(2, seed=7, dtype=torch.float64).pad())
    observed = observed & ~primitive.layout.controlled
    observed[1, 3:] = False
    names = [name for name, _ in filter.named_parameters()]
    values = [parameter.detach().clone().requires_grad_() for parameter in filter.parameters()]
    state = filter.initial_state((2,), generator=torch.Generator().manual_seed(1))

    class Said(torch.nn.Module):
        """What comes out at the end."""

        def __init__(self) -> None:
            super().__init__()
            self.filter = filter

        def forward(self) -> tuple[Tensor, Tensor]:
            trace = self.filter(y, observed, state=state, generator=torch.Generator().manual_seed(2))
            said = self.filter.forecast(trace.state, ahead=[0.2, END])
            return said.mean, said.variance

    def run(*parameters: Tensor) -> tuple[Tensor, Tensor]:
        given = {f"filter.{name}": value for name, value in zip(names, parameters, strict=True)}
        return torch.func.functional_call(Said(), given)

    assert any("relevance" in name for name in names)
    assert torch.autograd.gradcheck(run, values, atol=1e-5)


def test_silence_and_faults_leave_it_finite() -> None:
    """A sensor that says nothing for long, one that never does, values that robust weights refuse."""
    primitive = small_primitive(torch.float64)
    filter = bent(primitive, weigh=True)
    state = filter.initial_state((), generator=torch.Generator().manual_seed(0))
    for _ in range(3):
        state = filter.predict(state, 3.0)
    said = filter.forecast(state, ahead=[0.1, END])
    assert said.mean.isfinite().all()
    y = torch.tensor([1e9, -1e9, math.nan, math.nan, math.nan]).double()
    after, _ = filter.update(state, y)
    assert filter.forecast(after, ahead=[0.1, END]).mean.isfinite().all()
    assert filter.attribution(after).sum().item() == pytest.approx(1.0)


@pytest.mark.parametrize("dofs", [[True, True, True, True, False], [False, False, False, False, True]])
def test_views_do_not_cut_through_what_is_forecast_together(dofs: list[bool]) -> None:
    filter = bent(small_primitive())
    with pytest.raises(ValueError, match=r"are forecast together with some of \[.*\]: keep all of them, or none"):
        filter.restrict(torch.tensor(dofs))
    assert filter.readout.together(torch.tensor(dofs)).tolist()[3:] == [True, True]
    filter.restrict(torch.tensor([True, False, False, False, False]))


def test_what_does_not_fit_is_named() -> None:
    primitive = small_primitive()
    analogues = Analogues.of(primitive)
    eye, width = torch.eye(5).repeat(5, 1, 1), torch.ones(5, 5, 3)
    with pytest.raises(ValueError, match=r"follow must be \[5, 5, 5\] and finite, got \[5, 5\]"):
        AnalogueReadout(analogues, torch.eye(5), eye, width)
    with pytest.raises(ValueError, match="width must not be negative"):
        AnalogueReadout(analogues, eye, eye, -width)
    with pytest.raises(ValueError, match=r"levels must increase from 0 or more, got \[0.5, 0.5\]"):
        AnalogueReadout(analogues, eye.repeat(1, 1, 2), eye, width, levels=[0.5, 0.5])
    with pytest.raises(ValueError, match=r"follow must be \[5, 5, 10\] and finite, got \[5, 5, 5\]"):
        AnalogueReadout(analogues, eye, eye, width, levels=[0.5, 1.0])
    with pytest.raises(ValueError, match=r"surest must be \[5, 5\] and not negative, got \[5\]"):
        AnalogueReadout(analogues, eye, eye, width, surest=torch.ones(5))
    with pytest.raises(ValueError, match=r"stretch must be \[5, 5, 1\] and positive, got \[5, 5, 1\]"):
        AnalogueReadout(analogues, eye, eye, width, stretch=torch.zeros(5, 5, 1))
    with pytest.raises(ValueError, match="seconds must increase"):
        AnalogueReadout(analogues, eye, eye, width, [0.5, 0.1, 0.2, 0.3, END])
    with pytest.raises(ValueError, match="no DoF is compared"):
        Analogues.of(primitive, torch.zeros(5, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"must be \[24\], \[2, 5\], \[5\] and \[5\], got \[23\]"):
        Analogues(analogues.table, torch.ones(23), torch.ones(2, 5), torch.zeros(5).long(), torch.ones(5).bool())
    readout = AnalogueReadout(analogues, eye, eye, width)
    said = Forecast(torch.zeros(1, 5), torch.ones(1, 5), torch.ones(1))
    with pytest.raises(ValueError, match="compares the present"):
        readout(said, Lead(*torch.zeros(4, 1)), torch.zeros(1, 5), torch.ones(1, 5))
    filter = ebip(primitive)
    filter.readout = readout
    with pytest.raises(ValueError, match="no `Recent`"):
        filter.forecast(filter.initial_state())
    by_hand = bent(primitive)
    state = by_hand.initial_state()
    with pytest.raises(ValueError, match="made by hand"):
        by_hand.forecast(state._replace(memory=state.memory._replace(origin=None)))


def test_parameters_that_change_are_noticed_and_a_table_too() -> None:
    primitive = small_primitive(torch.float64)
    analogues, present = Analogues.of(primitive), present_of(primitive)
    before = analogues(present).weights
    with torch.no_grad():
        analogues.table.cells.mul_(1.3)
    assert not torch.allclose(before, analogues(present).weights)
    with torch.no_grad():
        analogues.table.cells.div_(1.3)
        analogues.relevance.raw.add_(1.0)
    assert not torch.allclose(before, analogues(present).weights)
    view = View(torch.tensor([3, 4]), torch.arange(2))
    nothing = torch.zeros(3, 1, dtype=torch.float64)
    lead = Lead(nothing, nothing, nothing + 1, nothing)
    analogy = analogues(present)
    whole, part = analogues.forecast(analogy, lead)[0], analogues.select(view).forecast(analogy, lead)[0]
    torch.testing.assert_close(part, whole[..., 3:])


def test_silence_of_any_length_is_finite_and_has_gradients() -> None:
    """In float32 what is left of the last samples underflows piece by piece: first squares, then the rest."""
    primitive = small_primitive()
    filter = bent(primitive, weigh=True)
    y, observed = (part[0, :10] for part in interactions(1, seed=7).pad())
    began = filter(y, observed & ~primitive.layout.controlled, generator=torch.Generator().manual_seed(0)).state
    beliefs = []
    for gap in torch.arange(0.0, 4.0, 0.05).tolist():
        state = filter.predict(began, gap, generator=torch.Generator().manual_seed(1)) if gap else began
        # Of two sensors one goes on, or both are silent.
        goes_on = torch.where(torch.tensor([False, False, True, False, False]), y[-1], torch.nan)
        for now in (state, filter.update(state, goes_on)[0]):
            said = filter.forecast(now, ahead=[0.1, END])
            assert said.mean.isfinite().all(), gap
            assert said.variance.isfinite().all(), gap
            gradients = torch.autograd.grad(
                said.mean.sum() + said.variance.sum(), list(filter.readout.parameters()), retain_graph=True
            )
            assert all(gradient.isfinite().all() for gradient in gradients), gap
            beliefs.append(float(filter.present(now).line.belief.max()))
    assert min(beliefs) == 0 < max(beliefs)


def test_a_sensor_that_never_moved_says_nothing() -> None:
    """Its velocity over the demonstrations is rounding; a new one that trembles is no news."""
    known = interactions(24, dtype=torch.float64)
    constant = [torch.cat([each[:, :2], torch.full_like(each[:, :1], 100.3), each[:, 3:]], 1) for each in known]
    primitive = InteractionPrimitive.fit(
        Demonstrations(known.layout, constant, known.rate), small_primitive(torch.float64).basis
    )
    analogues, present = Analogues.of(primitive), present_of(primitive)
    assert analogues.scale[0, 2] == 0
    draws = torch.Generator().manual_seed(0)  # with other bases there is rounding
    analogues.table.cells[:, :, 1, 2] = 1e-14 * torch.randn(24, 40, generator=draws, dtype=torch.float64)
    analogues.scale[1, 2] = 1e-14
    weights = []
    for trembling in (0.0, 1e-3, -1e-3):
        velocity = present.line.velocity.clone()
        velocity[..., 2] = trembling
        weights.append(analogues(present._replace(line=present.line._replace(velocity=velocity))).weights)
    assert torch.equal(weights[0], weights[1])
    assert torch.equal(weights[0], weights[2])


def test_what_is_forecast_together_is_found_through_others() -> None:
    """The first DoF is corrected by the second, that by the third."""
    primitive = small_primitive()
    follow = torch.eye(5).repeat(5, 1, 1)
    follow[:, 0, 1] = follow[:, 1, 2] = 0.1
    readout = AnalogueReadout(Analogues.of(primitive), follow, torch.zeros(5, 5, 5), torch.ones(5, 5, 3))
    assert readout.together(torch.tensor([True, False, False, False, False])).tolist() == [True] * 3 + [False] * 2


@pytest.mark.parametrize("make", [bent, heard])
def test_an_empty_batch_is_no_error(make: Callable[..., InteractionEnsembleFilter]) -> None:
    primitive = small_primitive()
    filter = make(primitive, weigh=True)
    state = filter(torch.zeros(0, 4, primitive.layout.n_dofs)).state
    for ahead in ([], [0.1, END]):
        assert filter.forecast(state, ahead=ahead).mean.shape == (0, len(ahead), primitive.layout.n_dofs)
    assert filter.attribution(state).shape == (0, len(primitive))
    one = filter.initial_state((1,))
    assert filter.forecast(one, ahead=[]).mean.shape == (1, 0, primitive.layout.n_dofs)
    assert filter.forecast(one, torch.zeros(0)).mean.shape == (1, 0, primitive.layout.n_dofs)


def test_no_horizons_are_no_error() -> None:
    """Without a read-out; and basis functions of a phase that is NaN are NaN, not an index that there is not."""
    primitive = small_primitive()
    filter = ebip(primitive, weigh=True)
    assert filter.forecast(filter.initial_state((2,)), ahead=[]).mean.shape == (2, 0, 5)
    for basis in primitive.basis.families:
        assert basis(torch.tensor([0.5, math.nan]))[1].isnan().any()
