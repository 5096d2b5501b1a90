"""The recurrent expert, against its formula in numpy; and what it changes in a forecast."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.conftest import small_primitive
from tests.filtering.contract import FilterContract
from tests.interaction.analogous import heard
from tests.interaction.test_ebip import silent
from torch_ebip import InteractionPrimitive
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.recent import Line
from torch_ebip.interaction import InteractionEnsembleFilter
from torch_ebip.interaction.analogue_readout import AnalogueReadout
from torch_ebip.interaction.expert import FAR, LIMIT, SLOWER, Expert
from torch_ebip.interaction.horizons import LEVELS, horizon_hats, level_hats
from torch_ebip.interaction.present import Present
from torch_ebip.interaction.readout import Lead, lead_of, widths_of

END = math.inf
WINDOWS = (0.03, *SLOWER)


class TestContract(FilterContract):
    """With an expert it is a filter like others."""

    def make(self, dtype: torch.dtype = torch.float32) -> InteractionEnsembleFilter:
        return heard(small_primitive(dtype), weigh=True)

    def make_without_draws(self) -> InteractionEnsembleFilter:
        return silent(heard(small_primitive(torch.float64), weigh=True, square_root=True))


def expert_of(primitive: InteractionPrimitive) -> Expert:
    expert = heard(primitive).readout.expert
    assert isinstance(expert, Expert)
    return expert


def lines(count: int = 4, dofs: int = 5, seed: int = 0) -> Line:
    """Of some moments; of the first all is seen, of the last nothing."""
    draws = torch.Generator().manual_seed(seed)

    def some(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=draws, dtype=torch.float64)

    belief = torch.rand(count, len(WINDOWS), dofs, generator=draws, dtype=torch.float64)
    belief[0], belief[-1] = 1.0, 0.0
    moves = torch.ones(count, len(WINDOWS), dofs, dtype=torch.bool)
    shape = (count, len(WINDOWS), dofs)
    return Line(3 * some(*shape), 3 * some(*shape), belief, moves, some(*shape).abs())


def present(before: Line, phase: Tensor) -> Present:
    like = phase.unsqueeze(-1)
    return Present(phase, 0 * phase, like, Line(*(part[:, 0] for part in before)), before)


def test_the_network_is_its_formula() -> None:
    """Moment by moment, in loops."""
    expert, before = expert_of(small_primitive(torch.float64)), lines()
    inputs, said = expert.inputs(before), expert.read(expert.inputs(before))
    parts = {name: part.numpy() for name, part in expert.state_dict().items() if isinstance(part, Tensor)}
    for r in range(4):
        x = []
        for i, d in enumerate(expert.seen.tolist()):
            row = []
            for w in range(len(WINDOWS)):
                value = (float(before.value[r, w, d]) - parts["middle"][i]) / parts["scale"][0, i]
                row.append(np.clip(value, -FAR, FAR) if before.belief[r, w, d] > 0 else 0.0)
            row += [
                np.clip(float(before.velocity[r, w, d]) / parts["scale"][1, i], -FAR, FAR)
                for w in range(len(WINDOWS))
            ]
            row += [float(before.age[r, -1, d]) / WINDOWS[-1], 1.0]
            x.append(np.array(row) * float(before.belief[r, 0, d]))
        np.testing.assert_allclose(inputs[r], x, rtol=1e-12)
        flat, every = np.concatenate(x), []
        for m in range(expert.networks):
            h = flat
            for name in ("first", "second"):
                a = h @ parts[name][m] + parts[f"{name}_bias"][m, 0]
                h = a / (1 + np.exp(-a))
            every.append(h @ parts["last"][m] + parts["last_bias"][m, 0] + flat @ parts["direct"][m])
        within = np.clip(np.mean(every, 0).reshape(5, -1), -LIMIT, LIMIT)
        expected = within * parts["unit"] + parts["centre"]
        np.testing.assert_allclose(said[r], expected, rtol=1e-10)


def test_it_says_what_the_network_says_at_the_horizons_and_between_them_follows_the_mean() -> None:
    primitive = small_primitive(torch.float64)
    expert, before = expert_of(primitive), lines()
    phase = torch.tensor([0.1, 0.3, 0.5, 0.2], dtype=torch.float64)
    velocity = primitive.phase_velocity.mean().expand(4)

    def said(asked: list[float]) -> Tensor:
        seconds = torch.tensor(asked, dtype=torch.float64)
        of = torch.where(seconds.isinf(), 1, phase.unsqueeze(-1) + velocity.unsqueeze(-1) * seconds.nan_to_num())
        return expert(present(before, phase), lead_of(phase, velocity, of, seconds))

    def mean(seconds: float) -> Tensor:
        at = torch.ones(4).double() if math.isinf(seconds) else (phase + velocity * seconds).clamp(max=1)
        paths = [primitive.basis.project(p, primitive.weights.mean(0)) for p in at]
        return torch.stack(paths)

    network, dofs = expert.read(expert.inputs(before)), expert.said
    horizons, left = expert.seconds.tolist(), (1 - phase) / velocity
    others = [d for d in range(5) if d not in dofs.tolist()]
    off = torch.stack([network[:, k] - mean(seconds)[:, dofs] for k, seconds in enumerate(horizons)], 1)
    for seconds in (0.0, 0.1, 0.25, 0.4, 1.0, 3.0, END):
        found, there = said([seconds])[:, 0], mean(seconds)
        torch.testing.assert_close(found[:, others], there[:, others], atol=1e-4, rtol=1e-4)
        for row in range(4):
            # What lies behind the end is asked as what is left until then.
            asked = min(seconds, float(left[row]))
            part = [np.interp(asked, horizons[:-1], off[row, :-1, i]) for i in range(len(dofs))]
            expected = off[row, -1].numpy() if seconds == END else np.array(part)
            np.testing.assert_allclose(found[row, dofs] - there[row, dofs], expected, atol=1e-4, rtol=1e-4)


def test_the_forecast_is_put_together_as_it_is_written() -> None:
    """g + sum_j v_j l_j (e - g), g being the forecast of the same read-out without an expert."""
    primitive = small_primitive(torch.float64)
    filter = heard(primitive)
    readout = filter.readout
    y = torch.randn(2, 9, 5, generator=torch.Generator().manual_seed(1)).double()
    state = filter(y, generator=torch.Generator().manual_seed(0)).state
    ahead = [0.1, 0.3, END]
    readout.surest.zero_()
    without = AnalogueReadout(
        readout.analogues,
        readout.follow,
        readout.correct,
        readout.width,
        levels=readout.levels.tolist(),
        stretch=readout.stretch,
    )
    found = filter.forecast(state, ahead=ahead)
    filter.readout = without
    g = filter.forecast(state, ahead=ahead)
    filter.readout = None
    plain = filter.forecast(state, ahead=ahead)
    seconds = torch.tensor(ahead, dtype=torch.float64)
    lead = filter.lead(state, plain.phase, seconds)
    _, variance = filter.demonstrated(lead.phase)
    levels = level_hats(widths_of(plain, variance), torch.tensor(LEVELS).double())
    at = horizon_hats(lead, readout.seconds)
    share = torch.einsum("bpk,kdj,bpdj->bpd", at, readout.heed, levels)
    share = share * readout.expert.believed(filter.present(state).before)[:, None, None]
    e = readout.expert(filter.present(state), lead)
    torch.testing.assert_close(found.mean, g.mean + share * (e - g.mean))
    torch.testing.assert_close(found.variance, g.variance)
    torch.testing.assert_close(found.members.mean(-2), found.mean, atol=0.5, rtol=0.5)


def test_it_is_believed_as_far_as_what_it_reads() -> None:
    """While sensors fade it is heard less; what was never there, or is long forgotten, does not matter to it."""
    primitive = small_primitive(torch.float64)
    filter = heard(primitive)
    expert, y = filter.readout.expert, torch.zeros(1, 5).double()
    observed = torch.tensor([True, True, False, False, False])
    state, live = filter.initial_state(), []
    for step in range(150):
        state = filter.predict(state, 1 / 30)
        if step < 30:
            state, _ = filter.update(state, y[0], observed)
        elif step >= 60:  # one of the two goes on
            state, _ = filter.update(state, y[0], observed & torch.tensor([True] + [False] * 4))
        live.append(float(expert.believed(filter.present(state).before).detach()))
    assert min(live[:30]) > 0.99
    assert max(live[38:80]) < 0.2  # a quarter of a second of silence
    assert live[-1] > 0.99


def test_it_does_not_speak_beyond_what_was_demonstrated() -> None:
    """Whatever it reads, within four deviations."""
    expert, before = expert_of(small_primitive(torch.float64)), lines()
    far = before._replace(
        value=1e9 * before.value, velocity=-1e9 * before.velocity, belief=torch.ones_like(before.belief)
    )
    off = (expert.read(expert.inputs(far)) - expert.centre) / expert.unit
    assert float(off.abs().max()) <= 4 + 1e-9


def test_what_is_not_seen_changes_nothing() -> None:
    """Neither its value nor how it moved; and a sensor that never moved says nothing."""
    expert, before = expert_of(small_primitive(torch.float64)), lines()
    belief = before.belief.clone()
    belief[:, :, 1] = 0
    said = expert.read(expert.inputs(before._replace(belief=belief)))
    absurd = before.value.clone()
    absurd[:, :, 1] = 1e6
    velocity = before.velocity.clone()
    velocity[:, :, 1] = -1e6
    again = expert.read(expert.inputs(before._replace(belief=belief, value=absurd, velocity=velocity)))
    torch.testing.assert_close(said, again)


@pytest.mark.parametrize("dofs", [[3, 4], [0, 4], [0, 1, 2]])
def test_a_view_says_the_same_of_its_dofs(dofs: list[int]) -> None:
    primitive = small_primitive(torch.float64)
    expert, before = expert_of(primitive), lines()
    phase = torch.full((4,), 0.4, dtype=torch.float64)
    nothing = torch.zeros(4, 2).double()
    lead = Lead(nothing, nothing + 0.2, nothing + 0.7, nothing)
    part = expert.select(View(torch.tensor(dofs), torch.tensor([0])))
    whole = expert(present(before, phase), lead)
    torch.testing.assert_close(part(present(before, phase), lead), whole[..., dofs])


def test_what_does_not_fit_is_named() -> None:
    primitive = small_primitive()
    controlled = primitive.layout.controlled
    filter = heard(primitive)
    readout = filter.readout
    parts = (readout.analogues, readout.follow, readout.correct, readout.width)
    with pytest.raises(ValueError, match="come together"):
        AnalogueReadout(*parts, levels=LEVELS, expert=readout.expert)
    with pytest.raises(ValueError, match=r"heed must be \[5, 5, 3\] between 0 and 1"):
        AnalogueReadout(*parts, levels=LEVELS, expert=readout.expert, heed=readout.heed + 1)
    with pytest.raises(ValueError, match="DoFs that are read and DoFs that are said"):
        Expert.of(primitive, controlled & ~controlled, controlled)
    for wrong, message in (
        ({"windows": ()}, "no window"),
        ({"windows": (-1.0,)}, "window must be a positive"),
        ({"hidden": 0}, "hidden must be"),
    ):
        with pytest.raises(ValueError, match=message):
            Expert.of(primitive, ~controlled, controlled, **wrong)
    with pytest.raises(ValueError, match="seen must be"):
        Expert.of(primitive, torch.ones(3, dtype=torch.bool), controlled)
    state = heard(primitive, slower=()).initial_state()
    with pytest.raises(ValueError, match="windows of"):
        heard(primitive, slower=()).forecast(state, ahead=[0.1])
