import numpy as np
import pytest
import torch

from torch_ebip import BSplineBasis, GaussianBasis, PolynomialBasis, StackedBasis


def stack() -> StackedBasis:
    return StackedBasis([BSplineBasis(6), BSplineBasis(6), PolynomialBasis(3), BSplineBasis(6), GaussianBasis(5)])


def test_projection_is_a_sum_for_each_dof() -> None:
    basis = stack()
    phase = torch.rand(4, 3, dtype=torch.float64)
    weights = torch.randn(4, 3, basis.n_weights, dtype=torch.float64)
    values, slopes = basis.project(phase, weights), basis.project_derivative(phase, weights)
    assert basis.n_weights == 6 + 6 + 4 + 6 + 5
    for dof, (part, where) in enumerate(zip(basis.bases, basis.weight_slices, strict=True)):
        expected = (part(phase).numpy() * weights[..., where].numpy()).sum(-1)
        np.testing.assert_allclose(values[..., dof].numpy(), expected, atol=1e-12)
        expected = (part.derivative(phase).numpy() * weights[..., where].numpy()).sum(-1)
        np.testing.assert_allclose(slopes[..., dof].numpy(), expected, atol=1e-12)


def test_paths_rows_and_covariances_are_projections() -> None:
    basis = stack()
    weights = torch.randn(4, 3, basis.n_weights, dtype=torch.float64)
    phases = torch.rand(4, 3, 6, dtype=torch.float64)
    paths = basis.project_paths(phases, weights)
    for p in range(6):
        torch.testing.assert_close(paths[:, :, p], basis.project(phases[..., p], weights))
    torch.testing.assert_close(basis.project_paths(phases, weights, [0, 2, 3]), paths[..., [0, 2, 3]])
    torch.testing.assert_close(basis.project(phases[..., 0], weights, [1, 4]), paths[:, :, 0, [1, 4]])
    rows = basis.project_rows(phases[:, 0, 0], weights)
    torch.testing.assert_close(rows, basis.project(phases[:, :1, 0], weights))
    # The variance of h over many draws is that of the covariance they were drawn with, exactly for the sample one.
    sample = weights[0].T.cov()
    values = basis.project_paths(phases[0, :1].expand(3, -1), weights[0])
    torch.testing.assert_close(basis.project_covariance(phases[0, 0], sample), values.var(0))


def test_phases_and_weights_broadcast() -> None:
    basis = stack()
    weights = torch.randn(7, basis.n_weights)
    values = basis.project(torch.rand(5, 1), weights)
    assert values.shape == (5, 7, 5)
    phase = torch.rand(())
    torch.testing.assert_close(basis.project(phase, weights)[3], basis.project(phase, weights[3]))


def test_equal_bases_are_evaluated_once() -> None:
    calls = []
    basis = stack()
    for part in basis.unique:
        part.register_forward_hook(lambda *_: calls.append(1))
    basis.project(torch.rand(2), torch.randn(2, basis.n_weights))
    assert len(calls) == 3


def test_a_selection_projects_its_own_dofs() -> None:
    basis = stack()
    dofs = torch.tensor([False, True, True, False, True])
    part = basis.select(dofs)
    weights = torch.randn(3, basis.n_weights)
    chosen = weights[:, dofs[basis.dof_of_weight()]]
    phase = torch.rand(3)
    torch.testing.assert_close(part.project(phase, chosen), basis.project(phase, weights)[:, dofs])


def test_errors() -> None:
    with pytest.raises(ValueError, match="at least one DoF"):
        StackedBasis([])
    with pytest.raises(ValueError, match="must end in 27"):
        stack().project(torch.rand(2), torch.randn(2, 26))
    with pytest.raises(ValueError, match=r"bool \[5\]"):
        stack().select(torch.ones(4, dtype=torch.bool))
