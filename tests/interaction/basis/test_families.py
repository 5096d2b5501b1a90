"""Every family against an independent evaluation, and what all of them promise."""

import math

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre
from scipy.interpolate import BSpline

from torch_ebip import Basis, BSplineBasis, GaussianBasis, PolynomialBasis, SigmoidBasis

FAMILIES = [
    GaussianBasis(1),
    GaussianBasis(12),
    GaussianBasis(9, width=0.2, offset=True),
    SigmoidBasis(10),
    SigmoidBasis(7, offset=True),
    PolynomialBasis(0),
    PolynomialBasis(1),
    PolynomialBasis(14),
    BSplineBasis(4),
    BSplineBasis(15),
    BSplineBasis(6, degree=0),
    BSplineBasis(8, degree=1),
    BSplineBasis(9, degree=5),
]
SMOOTH = [basis for basis in FAMILIES if not (isinstance(basis, BSplineBasis) and basis.degree < 2)]
PHASES = torch.linspace(0, 1, 101, dtype=torch.float64)


def test_gaussian() -> None:
    values = GaussianBasis(12)(PHASES).numpy()
    centres = np.linspace(0, 1, 12)
    np.testing.assert_allclose(values, np.exp(-0.5 * ((PHASES.numpy()[:, None] - centres) * 11) ** 2), atol=1e-14)


def test_sigmoid() -> None:
    values = SigmoidBasis(5, width=0.1)(PHASES).numpy()
    centres = np.linspace(0, 1, 5)
    np.testing.assert_allclose(values, 1 / (1 + np.exp(-(PHASES.numpy()[:, None] - centres) / 0.1)), atol=1e-14)


def test_offset_is_a_constant_in_the_last_place() -> None:
    for basis in (GaussianBasis(6, offset=True), SigmoidBasis(6, offset=True)):
        assert basis.n_features == 6
        assert torch.equal(basis(PHASES)[:, -1], torch.ones_like(PHASES))
        assert torch.equal(basis.derivative(PHASES)[:, -1], torch.zeros_like(PHASES))


@pytest.mark.parametrize("degree", [0, 1, 2, 7, 20])
def test_polynomials_are_legendres(degree: int) -> None:
    values = PolynomialBasis(degree)(PHASES).numpy()
    scale = np.sqrt(2 * np.arange(degree + 1) + 1)
    np.testing.assert_allclose(values, legendre.legvander(2 * PHASES.numpy() - 1, degree) * scale, atol=1e-12)


def test_polynomials_are_well_conditioned_to_degree_20() -> None:
    fine = torch.linspace(0, 1, 200, dtype=torch.float64)
    features = PolynomialBasis(20)(fine)
    assert torch.linalg.cond(features.T @ features) < 30
    assert torch.linalg.cond(fine[:, None] ** torch.arange(21)) ** 2 > 1e20  # what raw powers would have


@pytest.mark.parametrize(("count", "degree"), [(4, 3), (15, 3), (6, 0), (8, 1), (9, 5)])
def test_bsplines_agree_with_scipy(count: int, degree: int) -> None:
    inner = np.linspace(0, 1, count - degree + 1)
    knots = np.concatenate([np.zeros(degree), inner, np.ones(degree)])
    basis = BSplineBasis(count, degree)
    expected = np.stack([BSpline(knots, row, degree)(PHASES.numpy()) for row in np.eye(count)], -1)
    if degree == 0:  # scipy's last piece is open at phase 1, ours closed
        expected[-1] = np.eye(count)[-1]
    np.testing.assert_allclose(basis(PHASES).numpy(), expected, atol=1e-12)
    if degree > 0:
        slopes = np.stack([BSpline(knots, row, degree).derivative()(PHASES.numpy()) for row in np.eye(count)], -1)
        np.testing.assert_allclose(basis.derivative(PHASES).numpy(), slopes, atol=1e-10)


def test_bsplines_are_exact_at_the_ends_and_sum_to_one() -> None:
    values = BSplineBasis(15)(PHASES)
    torch.testing.assert_close(values.sum(-1), torch.ones_like(PHASES))
    eye = torch.eye(15, dtype=torch.float64)
    torch.testing.assert_close(values[[0, -1]], eye[[0, -1]], atol=1e-13, rtol=0)


@pytest.mark.parametrize("basis", FAMILIES, ids=str)
def test_shapes_and_dtypes(basis: Basis) -> None:
    for dtype in (torch.float32, torch.float64):
        for shape in ((), (3,), (2, 0), (2, 3, 4)):
            phase = torch.rand(shape, dtype=dtype)
            assert basis(phase).shape == (*shape, basis.n_features)
            assert basis.derivative(phase).shape == (*shape, basis.n_features)
            assert basis(phase).dtype == dtype


@pytest.mark.parametrize("basis", SMOOTH, ids=str)
def test_derivative_is_that_of_the_values_inside_and_outside(basis: Basis) -> None:
    phase = torch.tensor([-0.7, -0.05, 0.013, 0.37, 0.62, 0.985, 1.04, 1.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(basis, (phase,), atol=1e-5)
    values = basis(phase)
    by_autograd = torch.stack(
        [torch.autograd.grad(values[:, i].sum(), phase, retain_graph=True)[0] for i in range(basis.n_features)], -1
    ) if values.requires_grad else torch.zeros_like(values)  # fmt: skip
    torch.testing.assert_close(basis.derivative(phase), by_autograd, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("basis", FAMILIES, ids=str)
def test_outside_the_interval_nothing_explodes(basis: Basis) -> None:
    far = basis(torch.tensor([-1e6, -1.0, 2.0, 1e6], dtype=torch.float64))
    slope = basis.derivative(torch.tensor([0.0, 1.0], dtype=torch.float64)).abs().max()
    ends = basis(torch.tensor([0.0, 1.0], dtype=torch.float64)).abs().max()
    assert far.abs().max() <= ends + basis.margin * slope + 1e-9


def test_a_member_beyond_the_end_keeps_a_gradient() -> None:
    for basis in SMOOTH:
        if basis.n_features > 1:
            phase = torch.tensor(1.5, requires_grad=True)
            basis(phase).square().sum().backward()
            assert phase.grad is not None
            assert phase.grad.abs() > 0


def test_equal_settings_make_equal_bases() -> None:
    assert BSplineBasis(8) == BSplineBasis(8)
    assert BSplineBasis(8) != BSplineBasis(8, degree=2)
    assert GaussianBasis(8) != GaussianBasis(8, offset=True)
    assert len({GaussianBasis(8), GaussianBasis(8), SigmoidBasis(8)}) == 2


@pytest.mark.parametrize(
    "make",
    [
        lambda: GaussianBasis(0),
        lambda: GaussianBasis(1, offset=True),
        lambda: GaussianBasis(5, width=0.0),
        lambda: SigmoidBasis(5, width=math.inf),
        lambda: SigmoidBasis(1, offset=True),
        lambda: PolynomialBasis(21),
        lambda: PolynomialBasis(-1),
        lambda: BSplineBasis(3),
        lambda: BSplineBasis(3, degree=-1),
    ],
)
def test_what_makes_no_basis(make) -> None:
    with pytest.raises(ValueError, match="Basis"):
        make()
