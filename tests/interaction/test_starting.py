"""Where interactions start that are first seen anywhere: a prior over the starting phase."""

from __future__ import annotations

import pytest
import torch

from tests.conftest import interactions, small_primitive
from tests.interaction.cyclic import small_circle
from torch_ebip import InteractionModel, InteractionPrimitive, PhaseBank, bip, ebip, load_model, particle_filter
from torch_ebip.interaction.pace.beginning import begin_of

HUMAN = torch.tensor([True, True, True, False, False])


def test_phases_are_spread_evenly_over_demonstrations_in_no_order() -> None:
    primitive = small_primitive(torch.float64)
    loose = primitive.starting_at([0.5, 0.0, 0.25, 0.75])
    assert [int((loose.first_phase == phase).sum()) for phase in (0.0, 0.25, 0.5, 0.75)] == [6, 6, 6, 6]
    assert (loose.first_phase.diff() != 0).double().mean() > 0.8
    assert torch.equal(loose.weights, primitive.weights)
    assert torch.equal(loose.phase_velocity, primitive.phase_velocity)
    torch.testing.assert_close(loose.durations, (1 - loose.first_phase) * primitive.durations)
    torch.testing.assert_close(loose.phase_after(torch.tensor(torch.inf).double()), torch.ones(24).double())
    assert not primitive.first_phase.any()
    circle = small_circle().starting_at([0.1])
    torch.testing.assert_close(circle.first_phase, torch.full((24,), 0.1))
    assert torch.equal(circle.cycles, small_circle().cycles)
    for made in (ebip(loose), particle_filter(loose), bip(loose)):
        state = made.initial_state()
        assert float(made.phase(state)) == pytest.approx(float(loose.first_phase.mean()))


def test_a_bank_begins_where_they_do() -> None:
    phases = torch.linspace(0, 1, 5).double()
    found = begin_of(torch.tensor([0.0, 0.25, 0.3, 1.0]).double(), phases, False)
    torch.testing.assert_close(found, torch.tensor([0.25, 0.25 + 0.2, 0.05, 0.0, 0.25]).double())
    wrapped = begin_of(torch.tensor([-0.05, 0.95, 0.4]).double(), torch.arange(5).double() / 5, True)
    torch.testing.assert_close(wrapped, torch.tensor([0.5, 0.0, 1 / 3, 0.0, 0.5 / 3]).double())
    loose = small_primitive(torch.float64).starting_at([0.5])
    share = ebip(loose, pace=PhaseBank.of(loose, late=0.01)).initial_state().memory.pace.share
    going = share[:, :25].sum(0) + share[:, 25:].sum(0)
    assert float(going[12]) == pytest.approx(1 - 0.01 + 0.01 / 25)


def test_who_knows_that_people_are_seen_late_is_right_from_the_start() -> None:
    """First seen between 20 and 60 %, and asked after a tenth of a second: by a filter that knows, and one that does
    not, both with a bank."""
    primitive = small_primitive(torch.float64)
    loose = primitive.starting_at(torch.linspace(0.2, 0.6, 9))
    off, lost = [], []
    for each in (loose, primitive):
        made = ebip(each, square_root=True, weigh=True, pace=PhaseBank.of(each))
        errors = []
        for i, values in enumerate(interactions(40, seed=31, dtype=torch.float64)):
            first = int((0.2 + 0.4 * i / 39) * (len(values) - 1))
            y = torch.where(HUMAN, values[first : first + 4], torch.nan)
            with torch.no_grad():
                trace = made(y, generator=torch.Generator().manual_seed(0))
                said = made.forecast(trace.state, ahead=torch.tensor([0.1]).double())
            error = said.mean[0, 3:] - values[first + 6, 3:]
            errors.append(torch.stack([error, error / said.variance[0, 3:].sqrt()]))
        known = torch.stack(errors)
        known = known[~known.isnan().any(-1).any(-1)]
        off.append(float(known[:, 0].square().mean().sqrt()))
        lost.append(float((known[:, 1].abs() > 4).double().mean()))
    assert off[0] < 0.5 * off[1]
    assert lost[0] < 0.15 < 0.5 < lost[1]


def test_a_model_keeps_it(tmp_path) -> None:
    primitive = small_primitive()
    model = InteractionModel(ebip(primitive, square_root=True, weigh=True, pace=PhaseBank.of(primitive)), primitive)
    loose = model.starting_at([0.2, 0.4])
    loose.save(tmp_path / "model")
    again = load_model(tmp_path / "model")
    assert sorted(set(again.primitive.first_phase.tolist())) == pytest.approx([0.2, 0.4])
    values = interactions(2, seed=3)[1]
    torch.testing.assert_close(again.forecast(values, [0.1]).mean, loose.forecast(values, [0.1]).mean)
    assert not torch.equal(loose.forecast(values, [0.1]).mean[0], model.forecast(values, [0.1]).mean[0])


@pytest.mark.parametrize("phases", [[], [1.0], [-0.1, 0.2], [float("nan")], [[0.1, 0.2]]])
def test_phases_outside_are_named(phases: list[float]) -> None:
    with pytest.raises(ValueError, match=r"begin at phases in \[0, 1\)|phases"):
        small_primitive().starting_at(phases)


@pytest.mark.parametrize(("name", "value"), [("stop", 0.0), ("go", -1.0), ("late", 1.0), ("jump", float("inf"))])
def test_chances_that_are_none_are_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        PhaseBank.of(small_primitive(), **{name: value})


def test_a_subset_and_an_extension_keep_where_they_start() -> None:
    loose = small_primitive().starting_at([0.0, 0.5])
    part = loose.subset([0, 5, 7])
    assert torch.equal(part.first_phase, loose.first_phase[[0, 5, 7]])
    more = part.extend(interactions(2, seed=9))
    assert isinstance(more, InteractionPrimitive)
    assert more.first_phase[3:].tolist() == [0.0, 0.0]
