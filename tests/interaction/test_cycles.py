"""Where cycles are found in recordings, against the phases that made them."""

from __future__ import annotations

import math

import pytest
import torch

from tests.conftest import interactions
from tests.interaction.cyclic import waving
from torch_ebip import BSplineBasis, Demonstrations, InteractionPrimitive, PeriodicBSplineBasis, StackedBasis
from torch_ebip.interaction.basis.regression import samples_of
from torch_ebip.interaction.cycles import cycles_of


def errors(phases: torch.Tensor, truth: list[torch.Tensor]) -> torch.Tensor:
    """[N], root mean squared, on the circle, all turned alike."""
    off = [phases[i, : len(true)] - true for i, true in enumerate(truth)]
    turned = torch.cat([torch.polar(torch.ones_like(part), 2 * math.pi * part) for part in off]).mean()
    apart = [part - torch.angle(turned) / (2 * math.pi) for part in off]
    return torch.stack([(part - part.round()).square().mean().sqrt() for part in apart])


@pytest.mark.parametrize("anywhere", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_phases_are_those_that_made_the_recordings(seed: int, anywhere: bool) -> None:
    made = waving(seed=seed, anywhere=anywhere)
    phase = samples_of(made.recordings, periodic=True).phase
    assert errors(phase, made.phases).median() < 0.02
    assert errors(phase, made.phases).max() < 0.05
    assert (phase.diff(dim=1) >= 0).all()
    for i, true in enumerate(made.phases):
        assert float(phase[i, len(true) - 1] - phase[i, 0]) == pytest.approx(float(true[-1] - true[0]), abs=0.15)
    assert phase[:, 0].abs().max() <= 0.5
    if not anywhere:
        assert phase[:, 0].abs().max() < 0.1


def test_gaps_units_and_translation_change_next_to_nothing() -> None:
    recordings = waving().recordings
    before = samples_of(recordings, periodic=True).phase
    moved = [1000 * values.double() + 2e4 for values in recordings]
    after = samples_of(Demonstrations(recordings.layout, moved, recordings.rate), periodic=True).phase
    torch.testing.assert_close(after, before, atol=1e-4, rtol=0)
    holes = []
    for values in recordings:
        part = values.clone()
        part[5:9] = torch.nan
        part[::3, 0] = torch.nan
        holes.append(part)
    filled = samples_of(Demonstrations(recordings.layout, holes, recordings.rate), periodic=True).phase
    assert (filled - before).abs().max() < 0.05


def test_a_dof_that_stands_still_or_was_never_measured_says_nothing() -> None:
    recordings = waving().recordings
    values, measured = recordings.pad()
    before = cycles_of(values.nan_to_num(), measured, recordings.lengths)
    still = torch.cat([values.nan_to_num(), torch.full_like(values[..., :2], 3.0)], -1)
    never = torch.cat([measured, measured[..., :1], torch.zeros_like(measured[..., :1])], -1)
    after = cycles_of(still, never, recordings.lengths)
    torch.testing.assert_close(after.phase, before.phase)
    assert (after.explained > 0.9).all()


def test_what_does_not_repeat_is_named() -> None:
    with pytest.raises(ValueError, match="do not repeat"):
        InteractionPrimitive.fit(interactions(), periodic=True)
    noise = torch.Generator().manual_seed(0)
    walks = [torch.randn(80, 5, generator=noise).cumsum(0) for _ in range(8)]
    with pytest.raises(ValueError, match="do not repeat"):
        InteractionPrimitive.fit(Demonstrations(interactions().layout, walks, 30.0), periodic=True)


def test_less_than_a_cycle_is_named() -> None:
    made = waving()
    cut = [values if i != 3 else values[: int((true < 0.7).sum())] for i, (values, true) in enumerate(
        zip(made.recordings, made.phases, strict=True))]  # fmt: skip
    with pytest.raises(ValueError, match=r"recordings 3 hold less than one cycle \(of about \d+ samples\)"):
        InteractionPrimitive.fit(Demonstrations(made.recordings.layout, cut, 30.0), periodic=True)


def test_a_primitive_knows_where_its_demonstrations_are() -> None:
    made = waving(anywhere=True)
    primitive = InteractionPrimitive.fit(made.recordings, periodic=True)
    cycles = torch.stack([true[-1] - true[0] for true in made.phases]).float()
    assert (primitive.cycles - cycles).abs().max() < 0.15
    torch.testing.assert_close(primitive.durations, made.recordings.durations.float())
    last = primitive.phase_after(torch.tensor(torch.inf))
    torch.testing.assert_close(last, primitive.first_phase + primitive.cycles)
    path = primitive.basis.project(last, primitive.weights)
    measured = torch.stack([values[-1] for values in made.recordings])
    assert (path - measured).square().mean().sqrt() < 3 * primitive.residual_variance.mean().sqrt()
    part = primitive.subset([3, 1])
    assert torch.equal(part.cycles, primitive.cycles[[3, 1]])
    assert torch.equal(part.first_phase, primitive.first_phase[[3, 1]])
    more = part.extend(made.recordings.subset([5, 6, 7]))
    assert len(more) == len(more.cycles) == len(more.first_phase) == 5
    with pytest.raises(ValueError, match="need a periodic basis"):
        InteractionPrimitive.fit(made.recordings, StackedBasis([BSplineBasis(6)] * 5), periodic=True)
    assert InteractionPrimitive.fit(made.recordings, StackedBasis([PeriodicBSplineBasis(6)] * 5)).periodic


def test_phases_of_other_recordings_mean_the_same() -> None:
    """Recordings that begin anywhere, learned from in two parts: which phase is 0 was found in each anew."""
    made = waving(24, seed=2, anywhere=True)
    primitive = InteractionPrimitive.fit(made.recordings.subset(range(14)), periodic=True)
    later = made.recordings.subset(range(14, 24))
    true = torch.stack([phase[0] for phase in made.phases])
    for several in (primitive.extend(later), primitive.extend(later.subset([0]))):
        off = several.first_phase.double() - true[: len(several)]
        turned = torch.polar(torch.ones_like(off), 2 * math.pi * off)
        assert turned.mean().abs() > 0.97
        assert several.first_phase.abs().max() <= 0.5
        assert torch.angle(turned[14:].mean() / turned[:14].mean()).abs() / (2 * math.pi) < 0.02
    alone = InteractionPrimitive.fit(later, primitive.basis)
    moved = InteractionPrimitive.fit(later, primitive.basis, turned=0.25)
    phase = torch.linspace(0, 1, 7)
    torch.testing.assert_close(
        moved.basis.project_paths(phase + 0.25, moved.weights),
        alone.basis.project_paths(phase, alone.weights),
        atol=1e-4,
        rtol=1e-4,
    )
