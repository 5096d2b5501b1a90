"""The table of demonstrations against the demonstrations' own regressions."""

import copy

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline

from tests.conftest import small_primitive
from torch_ebip import DemonstrationTable, ebip


def test_it_is_hermites_interpolation() -> None:
    generator = torch.Generator().manual_seed(0)
    values, slopes = (torch.randn(4, 9, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    table = DemonstrationTable(values, slopes)
    phase = torch.rand(2, 6, 5, generator=generator, dtype=torch.float64)
    phase[0, 0] = torch.tensor([0.0, 1.0, 0.125, 0.5, 0.9999])
    which = torch.randint(4, (2, 6), generator=generator)
    found = table.at(which, phase)
    for b in range(2):
        for e in range(6):
            spline = CubicHermiteSpline(
                np.linspace(0, 1, 9), values[which[b, e]].numpy(), slopes[which[b, e]].numpy()
            )
            np.testing.assert_allclose(found[b, e].numpy(), spline(phase[b, e].numpy()), atol=1e-12)
    some = torch.tensor([0, 2])
    for _ in range(2):  # computed, and kept
        torch.testing.assert_close(table.at(which, phase, some), found[..., some])


def test_its_spread_is_that_of_the_values() -> None:
    values = torch.randn(4, 9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    table = DemonstrationTable(values, torch.randn(4, 9, 3, dtype=torch.float64))
    torch.testing.assert_close(table.spread(), values.var(0))
    torch.testing.assert_close(table.spread(torch.tensor([2, 0])), values.var(0)[:, [2, 0]])
    assert bool((DemonstrationTable(values[:1], values[:1]).spread() == 0).all())


def test_it_is_close_to_the_demonstrations_and_passes_gradients() -> None:
    primitive = small_primitive(torch.float64)
    table = DemonstrationTable.of(primitive)
    phase = torch.rand(24, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64, requires_grad=True)
    found = table.at(torch.arange(24), phase)
    exact = primitive.basis.project_paths(phase, primitive.weights)
    error = ((found - exact) / primitive.value_variance.sqrt()).abs().max()
    assert error < 1e-3
    slope = torch.autograd.grad(found.sum(), phase)[0]
    wanted = torch.autograd.grad(exact.sum(), phase)[0]
    torch.testing.assert_close(slope, wanted, atol=1e-2 * float(wanted.abs().max()), rtol=0)


def test_what_is_kept_follows_the_table() -> None:
    """Loaded from a state dict, moved to another dtype, narrowed: never what was kept before."""
    primitive = small_primitive()
    table, dofs = DemonstrationTable.of(primitive), torch.tensor([1, 3])
    which, phase = torch.arange(24), torch.full((24, 1), 0.4)
    before, spread = table.at(which, phase, dofs), table.spread()
    table.load_state_dict({"cells": 2 * table.cells})
    torch.testing.assert_close(table.at(which, phase, dofs), 2 * before)
    torch.testing.assert_close(table.spread(), 4 * spread)
    table.double()
    torch.testing.assert_close(table.at(which, phase.double(), dofs), 2 * before.double())
    part = ebip(primitive, weigh=True).restrict(torch.tensor([False, True, False, True, False]))
    torch.testing.assert_close(part.analysis.weighting.table.at(which, phase), before)
    table.at(which, phase.double(), dofs)
    other = copy.deepcopy(table)
    other.cells.mul_(0.5)  # as often changed as the first one was
    torch.testing.assert_close(other.at(which, phase.double(), dofs), before.double())
    with pytest.raises(ValueError, match="with at least 2 phases"):
        DemonstrationTable(torch.zeros(3, 1, 2), torch.zeros(3, 1, 2))


def test_what_is_kept_from_inference_mode_can_be_differentiated_through() -> None:
    table, dofs = DemonstrationTable.of(small_primitive()), torch.tensor([1, 3])
    which, phase = torch.arange(24), torch.full((24, 1), 0.4, requires_grad=True)
    with torch.inference_mode():
        table.spread(), table.at(which, torch.full((24, 1), 0.4), dofs)
    (table.spread(dofs).pow(phase.mean()).sum() + table.at(which, phase, dofs).square().sum()).backward()
    assert phase.grad is not None
    assert bool(phase.grad.isfinite().all())
