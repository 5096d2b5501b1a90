"""Bases on a circle against scipy and plain formulas, and what they promise."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from torch_ebip import BSplineBasis, FourierBasis, PeriodicBSplineBasis, StackedBasis
from torch_ebip.interaction.basis import PeriodicBasis

FAMILIES = [
    PeriodicBSplineBasis(4),
    PeriodicBSplineBasis(9),
    PeriodicBSplineBasis(7, degree=2),
    PeriodicBSplineBasis(8, degree=5),
    FourierBasis(1),
    FourierBasis(5),
]
PHASES = torch.linspace(0, 1, 240, dtype=torch.float64)[:-1] + 1e-3


@pytest.mark.parametrize(("count", "degree"), [(4, 3), (6, 3), (11, 2), (8, 5)])
def test_splines_are_those_of_scipy_wrapped_round(count: int, degree: int) -> None:
    knots = np.arange(-degree, count + degree + 1) / count
    expected = np.zeros((len(PHASES), count))
    for j in range(count + degree):
        one = np.zeros(count + degree)
        one[j] = 1
        expected[:, j % count] += BSpline(knots, one, degree)(PHASES.numpy())
    values = PeriodicBSplineBasis(count, degree)(PHASES)
    np.testing.assert_allclose(values.numpy(), expected, atol=1e-13)
    torch.testing.assert_close(values.sum(-1), torch.ones_like(PHASES))


def test_fourier() -> None:
    values = FourierBasis(2)(PHASES).numpy()
    x = 2 * np.pi * PHASES.numpy()
    expected = np.stack([np.ones_like(x), np.cos(x), np.cos(2 * x), np.sin(x), np.sin(2 * x)], -1)
    np.testing.assert_allclose(values, expected, atol=1e-14)


@pytest.mark.parametrize("basis", FAMILIES, ids=str)
def test_whole_cycles_make_no_difference(basis: PeriodicBasis) -> None:
    for cycles in (-2, 1, 5):
        torch.testing.assert_close(basis(PHASES + cycles), basis(PHASES))
        torch.testing.assert_close(basis.derivative(PHASES + cycles), basis.derivative(PHASES))
    assert basis(PHASES.float()).dtype == torch.float32
    torch.testing.assert_close(basis.by_function(PHASES), basis(PHASES).T)


@pytest.mark.parametrize("basis", FAMILIES, ids=str)
def test_derivatives_are_those_of_the_values_everywhere(basis: PeriodicBasis) -> None:
    phase = torch.linspace(-1.3, 2.2, 83, dtype=torch.float64).requires_grad_()
    weights = torch.randn(basis.n_features, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    (slope,) = torch.autograd.grad((basis(phase) @ weights).sum(), phase)
    torch.testing.assert_close(slope, basis.derivative(phase).detach() @ weights)


@pytest.mark.parametrize("basis", [PeriodicBSplineBasis(6), FourierBasis(3)], ids=str)
def test_the_seam_cannot_be_felt(basis: PeriodicBasis) -> None:
    """Values, slopes and curvatures on both sides of it, and as much as anywhere else: not of the one-shot basis."""
    weights = torch.randn(basis.n_features, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    step = 1e-4

    def sides(of: torch.nn.Module, at: float) -> list[float]:
        points = at + step * torch.tensor([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0], dtype=torch.float64)
        y = of(points) @ weights
        left = [y[2], (y[2] - y[1]) / step, (y[2] - 2 * y[1] + y[0]) / step**2]
        right = [y[3], (y[4] - y[3]) / step, (y[5] - 2 * y[4] + y[3]) / step**2]
        return [abs(float(a - b)) for a, b in zip(left, right, strict=True)]

    size = (1e-2, 0.2, 20.0)
    for at in (0.0, 1.0, -3.0):
        assert all(gap < most for gap, most in zip(sides(basis, at), size, strict=True))
    if isinstance(basis, PeriodicBSplineBasis):
        assert sides(BSplineBasis(6), 1.0)[2] > size[2]


def test_equal_settings_make_equal_bases_and_kinds_do_not_mix() -> None:
    assert PeriodicBSplineBasis(6) == PeriodicBSplineBasis(6, degree=3) != PeriodicBSplineBasis(7)
    assert PeriodicBSplineBasis(6) != BSplineBasis(6)
    assert FourierBasis(2) == FourierBasis(2) != FourierBasis(3)
    assert StackedBasis([FourierBasis(2), PeriodicBSplineBasis(6)]).periodic
    assert not StackedBasis([BSplineBasis(6)]).periodic
    with pytest.raises(ValueError, match="for all DoFs or for none"):
        StackedBasis([FourierBasis(2), BSplineBasis(6)])
    with pytest.raises(ValueError, match="PeriodicBSplineBasis: degree 3 needs n_features >= 4, got 3"):
        PeriodicBSplineBasis(3)
    with pytest.raises(ValueError, match="harmonics of FourierBasis"):
        FourierBasis(0)
