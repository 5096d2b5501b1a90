"""eBIP-: the mixture prior against scikit-learn's own parameters and the sample moments, and the contract."""

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from tests.filtering.contract import FilterContract
from tests.interaction.test_ebip import silent
from torch_ebip import (
    BSplineBasis,
    EnsembleFilter,
    InteractionPrimitive,
    MixturePrior,
    PolynomialBasis,
    StackedBasis,
    ebip_minus,
)
from torch_ebip.interaction.mixture import fit_responsibilities

pytestmark = pytest.mark.filterwarnings("ignore:no mixture of up to")


class TestFallback(FilterContract):
    """24 demonstrations of 30 weights: no mixture is positive definite."""

    def make(self, dtype: torch.dtype = torch.float32) -> EnsembleFilter:
        return ebip_minus(small_primitive(dtype), 30, context=BSplineBasis(4), weight_noise=0.01)

    def make_without_draws(self) -> EnsembleFilter:
        return silent(ebip_minus(small_primitive(torch.float64), 30, square_root=True))


def low_dimensional(count: int = 60) -> InteractionPrimitive:
    """Two clusters of demonstrations in 10 weights."""
    primitive = InteractionPrimitive.fit(
        interactions(count, dtype=torch.float64), StackedBasis([PolynomialBasis(1)] * 5)
    )
    primitive.weights[: count // 3] += 3.0
    return primitive


class TestMixture(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> EnsembleFilter:
        primitive = low_dimensional()
        return ebip_minus(primitive.to(dtype), 30)

    def make_without_draws(self) -> EnsembleFilter:
        return silent(ebip_minus(low_dimensional(), 30, square_root=True))


def test_singular_covariances_fall_back_with_a_warning() -> None:
    primitive = small_primitive(torch.float64)
    with pytest.warns(UserWarning, match="in 30 dimensions from 24 demonstrations; using their sample mean"):
        made = ebip_minus(primitive, 50_000)
    members = made.initial_state(generator=torch.Generator().manual_seed(0)).members.numpy()
    W, velocity = primitive.weights.numpy(), primitive.phase_velocity.numpy()
    spread = W.std(0, ddof=1)
    np.testing.assert_allclose(members[:, 2:].mean(0), W.mean(0), atol=0.02 * spread.max())
    np.testing.assert_allclose(np.corrcoef(members[:, 2:].T), np.corrcoef(W.T), atol=0.03)
    np.testing.assert_allclose(members[:, 2:].std(0), spread, rtol=0.02)
    np.testing.assert_allclose(
        [members[:, 1].mean(), members[:, 1].std()], [velocity.mean(), velocity.std(ddof=1)], rtol=0.02
    )
    assert not members[:, 0].any()
    assert abs(np.corrcoef(members[:, 1], members[:, 5])[0, 1]) < 0.02
    # Rank deficient, as in the paper: draws stay in the span of the demonstrations.
    assert np.linalg.matrix_rank(members[:1000, 2:] - W.mean(0), tol=1e-8) == 23


def test_the_mixture_has_the_components_of_em() -> None:
    """Two clusters: BIC takes two components; draws have the moments scikit-learn estimated."""
    from sklearn.mixture import GaussianMixture

    primitive = low_dimensional()
    W = primitive.weights.numpy()
    responsibilities = fit_responsibilities(primitive.weights, 4, 0)
    assert responsibilities.shape == (60, 2)
    reference = GaussianMixture(2, reg_covar=0.0, max_iter=200, random_state=0).fit((W - W.mean(0)) / W.std(0))
    made = MixturePrior(
        torch.cat([torch.zeros(60, 1), torch.ones(60, 1), primitive.weights], -1).double(), responsibilities
    )
    draws = made((), 40_000, None, torch.Generator().manual_seed(0)).numpy()[:, 2:]
    standard = (draws - W.mean(0)) / W.std(0)
    component = reference.predict(standard)
    order = np.argsort(reference.weights_)
    assert np.sort(reference.weights_) == pytest.approx([1 / 3, 2 / 3], abs=1e-3)
    for k in order:
        mine = standard[component == k]
        assert len(mine) / len(draws) == pytest.approx(reference.weights_[k], abs=0.01)
        deviation = np.sqrt(np.diag(reference.covariances_[k]))
        np.testing.assert_allclose(mine.mean(0), reference.means_[k], atol=0.03 * deviation.max())
        np.testing.assert_allclose(
            np.cov(mine.T) / deviation / deviation[:, None],
            reference.covariances_[k] / deviation / deviation[:, None],
            atol=0.05,
        )


def test_a_mixture_of_some_demonstrations() -> None:
    primitive = small_primitive(torch.float64)
    made = ebip_minus(primitive, 20_000)
    chosen = torch.tensor([[0, 3, 5, 9], [1, 2, 4, 20]])
    members = made.initial_state((2,), chosen, torch.Generator().manual_seed(0)).members[..., 2:]
    for b in range(2):
        of = primitive.weights[chosen[b]]
        torch.testing.assert_close(members[b].mean(0), of.mean(0), atol=0.03, rtol=0)
        torch.testing.assert_close(members[b].std(0), of.std(0), rtol=0.03, atol=1e-3)


def test_bad_priors_are_named() -> None:
    with pytest.raises(ValueError, match=r"responsibilities must be \[3, K\], got \(2, 1\)"):
        MixturePrior(torch.zeros(3, 4), torch.ones(2, 1))
    with pytest.raises(ValueError, match="must be numbered 0 to 23"):
        ebip_minus(small_primitive(), 4).initial_state(demonstrations=torch.tensor([24]))
