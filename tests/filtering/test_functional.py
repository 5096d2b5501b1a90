"""The kernels against plain float64 numpy written from the paper, and against the exact Kalman posterior."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from torch import Tensor

from torch_ebip.filtering.functional import (
    FactorisationError,
    Taper,
    ensemble_covariance,
    ensemble_mean,
    ensemble_update,
    ensemble_variance,
    square_root_update,
)

BOTH = ["stochastic", "square root"]


def problem(*batch: int, E: int = 9, n: int = 6, D: int = 4, dtype: torch.dtype = torch.float64, seed: int = 0):
    """Members, projections that are linear in them, y, Cholesky factor of R, draws, H."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    members, H = draw(*batch, E, n), draw(D, n)
    factor = torch.linalg.cholesky(torch.eye(D, dtype=torch.float64) + 0.3)
    y, perturbations = draw(*batch, D), draw(*batch, E, D)
    tensors = (members, members @ H.T, y, factor.expand(*batch, D, D), perturbations, H)
    return tuple(tensor.to(dtype) for tensor in tensors)


def update(kind: str, members, projections, y, factor, draws, **options):
    if kind == "stochastic":
        return ensemble_update(members, projections, y, factor, draws, **options)
    return square_root_update(members, projections, y, factor, **options)


def paper(members, projections, y, factor, draws):
    """Section IV, member by member, columns as in the paper."""
    X, HX, L = members.numpy().T, projections.numpy().T, factor.numpy()
    E = X.shape[1]
    HA = HX - HX.mean(1, keepdims=True)
    A = X - X.mean(1, keepdims=True)
    R = L @ L.T
    S = HA @ HA.T / (E - 1) + R
    K = A @ HA.T / (E - 1) @ np.linalg.inv(S)
    updated = np.empty_like(X)
    for j in range(E):
        updated[:, j] = X[:, j] + K @ (y.numpy() + L @ draws.numpy()[j] - HX[:, j])
    return updated.T, multivariate_normal(HX.mean(1), S).logpdf(y.numpy())


@pytest.mark.parametrize(("E", "n", "D"), [(9, 6, 4), (40, 6, 1), (3, 50, 7), (5, 4, 12), (2, 3, 2)])
def test_stochastic_update_is_the_papers(E: int, n: int, D: int) -> None:
    members, projections, y, factor, draws, _ = problem(E=E, n=n, D=D)
    updated, likelihood = ensemble_update(members, projections, y, factor, draws)
    expected, density = paper(members, projections, y, factor, draws)
    np.testing.assert_allclose(updated.numpy(), expected, atol=1e-10)
    assert likelihood.item() == pytest.approx(density, abs=1e-9)


@pytest.mark.parametrize(("E", "n", "D"), [(9, 6, 4), (40, 6, 1), (3, 50, 7), (5, 4, 12)])
def test_square_root_update_has_the_kalman_posterior(E: int, n: int, D: int) -> None:
    members, projections, y, factor, _, H = problem(E=E, n=n, D=D)
    updated, likelihood = square_root_update(members, projections, y, factor)
    P, m = np.cov(members.numpy().T), members.numpy().mean(0)
    H, R = H.numpy(), factor.numpy() @ factor.numpy().T
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(updated.mean(0).numpy(), m + K @ (y.numpy() - H @ m), atol=1e-10)
    np.testing.assert_allclose(np.cov(updated.numpy().T), P - K @ S @ K.T, atol=1e-10)
    assert likelihood.item() == pytest.approx(multivariate_normal(H @ m, S).logpdf(y.numpy()), abs=1e-9)


def test_weighted_square_root_update_has_the_kalman_posterior_of_weighted_moments() -> None:
    members, projections, y, factor, _, H = problem(E=12)
    weights = torch.softmax(torch.randn(12, generator=torch.Generator().manual_seed(3), dtype=torch.float64), -1)
    updated, _ = square_root_update(members, projections, y, factor, weights=weights)
    w, X = weights.numpy(), members.numpy()
    P, m = np.cov(X.T, aweights=w), np.average(X, axis=0, weights=w)
    H, R = H.numpy(), factor.numpy() @ factor.numpy().T
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(
        np.average(updated.numpy(), axis=0, weights=w), m + K @ (y.numpy() - H @ m), atol=1e-10
    )
    np.testing.assert_allclose(np.cov(updated.numpy().T, aweights=w), P - K @ S @ K.T, atol=1e-10)


@pytest.mark.parametrize("kind", BOTH)
def test_equal_weights_change_nothing(kind: str) -> None:
    *arguments, _ = problem(2)
    weights = torch.full((2, 9), 1 / 9, dtype=torch.float64)
    for a, b in zip(update(kind, *arguments), update(kind, *arguments, weights=weights), strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("kind", BOTH)
def test_a_subset_of_rows_is_an_update_with_these_rows_only(kind: str) -> None:
    members, projections, y, factor, draws, _ = problem()
    observed = torch.tensor([True, False, True, False])
    y = torch.where(observed, y, torch.nan)
    updated, likelihood = update(kind, members, projections, y, factor, draws, observed=observed)
    R = (factor @ factor.T)[observed][:, observed]
    rows = torch.linalg.cholesky(R)
    # The same perturbations in the smaller space: L_o eps, expressed in the factor of R_oo.
    small = torch.linalg.solve_triangular(rows, (draws @ factor.T)[:, observed].T, upper=False).T
    expected = update(kind, members, projections[:, observed], y[observed], rows, small)
    torch.testing.assert_close(updated, expected[0])
    torch.testing.assert_close(likelihood, expected[1])


@pytest.mark.parametrize("kind", BOTH)
def test_a_batch_is_a_loop_also_with_different_masks(kind: str) -> None:
    members, projections, y, factor, draws, _ = problem(3, 2)
    observed = torch.rand(3, 2, 4, generator=torch.Generator().manual_seed(5)) < 0.6
    observed[1, 0] = False
    observed[2, 1] = True
    y = torch.where(observed, y, torch.nan)
    updated, likelihood = update(kind, members, projections, y, factor, draws, observed=observed)
    for i in range(3):
        for j in range(2):
            at = (i, j)
            arguments = (members[at], projections[at], y[at], factor[at], draws[at])
            one, density = update(kind, *arguments, observed=observed[at])
            torch.testing.assert_close(updated[at], one)
            torch.testing.assert_close(likelihood[at], density)


@pytest.mark.parametrize("kind", BOTH)
def test_nothing_measured_changes_nothing(kind: str) -> None:
    members, projections, _, factor, draws, _ = problem(2)
    y = torch.full((2, 4), torch.nan, dtype=torch.float64)
    observed = torch.zeros(2, 4, dtype=torch.bool)
    updated, likelihood = update(kind, members, projections, y, factor, draws, observed=observed)
    assert torch.equal(updated, members)
    assert likelihood.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("kind", BOTH)
@pytest.mark.parametrize("tapered", [False, True])
def test_gradients(kind: str, tapered: bool) -> None:
    members, projections, y, factor, draws, _ = problem(2, E=5, n=3, D=3)
    observed = torch.tensor([[True, True, False], [False, True, False]])
    y = torch.where(observed, y, torch.nan)
    taper = None
    if tapered:
        cut = torch.tensor([[1, 0.5, 0.5], [0.5, 1, 0.25], [0.5, 0.25, 1]], dtype=torch.float64)
        taper = Taper(cut[torch.tensor([0, 1, 2])], cut)
    weights = torch.softmax(torch.arange(10.0, dtype=torch.float64).reshape(2, 5) / 5, -1)

    def run(members: Tensor, projections: Tensor, factor: Tensor, weights: Tensor):
        options = {"observed": observed, "taper": taper, "weights": weights}
        return update(kind, members, projections, y, torch.tril(factor), draws, **options)

    inputs = tuple(part.clone().requires_grad_() for part in (members, projections, factor, weights))
    assert torch.autograd.gradcheck(run, inputs)
    updated, likelihood = run(*inputs)
    (updated.sum() + likelihood.sum()).backward()
    assert all(part.grad is not None and part.grad.isfinite().all() for part in inputs)


@pytest.mark.parametrize("kind", BOTH)
def test_units_may_differ_by_many_orders_of_magnitude_in_single_precision(kind: str) -> None:
    """Rescaling a DoF and its noise rescales nothing else."""
    arguments = problem(E=20, dtype=torch.float64)
    members, projections, y, _, draws, _ = arguments
    deviation = torch.tensor([1.0, 0.5, 2.0, 1.0], dtype=torch.float64)
    scale = torch.tensor([1e6, 1.0, 1e-6, 1e3], dtype=torch.float64)
    expected, density = update(kind, members, projections, y, torch.diag(deviation), draws)
    single = [
        part.float() for part in (members, projections * scale, y * scale, torch.diag(deviation * scale), draws)
    ]
    updated, likelihood = update(kind, *single)
    torch.testing.assert_close(updated.double(), expected, atol=1e-4, rtol=1e-4)
    assert likelihood.item() == pytest.approx(density.item() - scale.log().sum().item(), abs=1e-3)


def test_a_taper_of_ones_is_none_and_one_of_zeros_leaves_a_block_alone() -> None:
    *arguments, _ = problem()
    ones = Taper(torch.ones(6, 4).double(), torch.ones(4, 4).double())
    plain = ensemble_update(*arguments)
    torch.testing.assert_close(ensemble_update(*arguments, taper=ones)[0], plain[0])
    state = torch.ones(6, 4).double()
    state[2] = 0
    cut, _ = ensemble_update(*arguments, taper=Taper(state, ones.observation))
    assert torch.equal(cut[:, 2], arguments[0][:, 2])
    torch.testing.assert_close(cut[:, :2], plain[0][:, :2])


def test_both_associations_of_the_gain_agree() -> None:
    """A wide state takes the E x E transform, a narrow observation the gain: same numbers."""
    members, projections, y, factor, draws, _ = problem(E=4, n=300, D=5)
    through_transform, _ = ensemble_update(members, projections, y, factor, draws)
    halves = [
        ensemble_update(members[:, part], projections, y, factor, draws)[0] for part in (slice(3), slice(3, 300))
    ]
    torch.testing.assert_close(through_transform, torch.cat(halves, -1))
    expected, _ = paper(members, projections, y, factor, draws)
    np.testing.assert_allclose(through_transform.numpy(), expected, atol=1e-10)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("localised", [False, True])
@pytest.mark.parametrize("wide", [False, True])
def test_inflation_scales_deviations_after_the_update(weighted: bool, localised: bool, wide: bool) -> None:
    """In one product with the update, against doing it afterwards; a factor of 1 changes nothing, to the bit."""
    members, projections, y, factor, draws, _ = problem(3, n=60 if wide else 6)
    weights = torch.softmax(draws[..., 0], -1) if weighted else None
    taper = None
    if localised:
        taper = Taper(torch.rand(members.shape[-1], 4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    growth = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    for update in (partial(ensemble_update, perturbations=draws), square_root_update):
        plain, _ = update(members, projections, y, factor, taper=taper, weights=weights)
        grown, _ = update(members, projections, y, factor, taper=taper, weights=weights, inflation=growth)
        mean = ensemble_mean(plain, weights).unsqueeze(-2)
        torch.testing.assert_close(grown, mean + growth.view(3, 1, 1) * (plain - mean))


def test_moments() -> None:
    members, *_ = problem(3)
    weights = torch.softmax(torch.randn(3, 9, dtype=torch.float64), -1)
    for i in range(3):
        X, w = members[i].numpy(), weights[i].numpy()
        np.testing.assert_allclose(ensemble_mean(members, weights)[i], np.average(X, axis=0, weights=w))
        np.testing.assert_allclose(ensemble_covariance(members, weights)[i], np.cov(X.T, aweights=w), atol=1e-12)
        np.testing.assert_allclose(ensemble_variance(members)[i], X.var(0, ddof=1))


def test_errors() -> None:
    members, projections, y, factor, draws, _ = problem()
    with pytest.raises(ValueError, match="same number of members, at least 2"):
        ensemble_update(members[:1], projections[:1], y, factor, draws[:1])
    with pytest.raises(ValueError, match="y must end in 4"):
        ensemble_update(members, projections, y[:3], factor, draws)
    with pytest.raises(ValueError, match=r"noise_cholesky must end in \[4, 4\]"):
        ensemble_update(members, projections, y, factor[:3], draws)
    with pytest.raises(ValueError, match="perturbations must be"):
        ensemble_update(members, projections, y, factor, draws[:3])
    with pytest.raises(ValueError, match="observed must be bool"):
        ensemble_update(members, projections, y, factor, draws, observed=torch.ones(4))


def test_a_covariance_that_cannot_be_factored_says_where() -> None:
    members, projections, y, factor, draws, _ = problem(3)
    projections = projections.clone()
    projections[1, 0, 2] = torch.nan
    with pytest.raises(FactorisationError, match=r"batch entries \[\[1\]\].*NaN or infinite"):
        ensemble_update(members, projections, y, factor, draws)
    flat = torch.zeros(3, 9, 4, dtype=torch.float64)
    with pytest.raises(FactorisationError, match="raise the floor") as caught:
        square_root_update(members, flat, y, 0 * factor + torch.diag(torch.tensor([1.0, 1.0, 0.0, 1.0])).double())
    assert caught.value.dofs == [2]
