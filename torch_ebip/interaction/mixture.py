"""The prior of the paper's eBIP-: a Gaussian mixture over the demonstrations' weights."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_count
from torch_ebip.common.draws import Generators, standard_normal, uniform
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.priors import check_members, check_states


class MixturePrior(nn.Module):
    """w ~ sum_k alpha_k N(mu_k, Sigma_k), phase velocity ~ N(mean, variance), phase 0: step 1 of the paper's box.

    The components are kept as the responsibilities that expectation maximisation ended with, from which one
    maximisation step gives alpha, mu and Sigma of all demonstrations or of some of them. Draws are affine
    combinations of demonstrations that have exactly these moments, so no n x n covariance is formed and it may
    be rank deficient.

    Args:
        states: [N, n], one state a demonstration: phase 0, its phase velocity, its weights.
        responsibilities: [N, K], rows sum to 1; [N, 1] of ones is the sample mean and covariance.
        moving: m, how many entries of a state come before the weights, the phase first.

    Raises:
        ValueError: fewer than two states, or responsibilities that do not fit.
    """

    states: Tensor
    responsibilities: Tensor

    def __init__(self, states: Tensor, responsibilities: Tensor, moving: int = 2) -> None:
        super().__init__()
        check_states(states)
        if responsibilities.ndim != 2 or len(responsibilities) != len(states):
            raise ValueError(f"responsibilities must be [{len(states)}, K], got {tuple(responsibilities.shape)}")
        self.register_buffer("states", owned(states))
        self.register_buffer("responsibilities", owned(responsibilities))
        self.moving = moving

    def forward(
        self,
        batch_shape: tuple[int, ...],
        n_members: int,
        chosen: Tensor | None = None,
        generator: Generators = None,
    ) -> Tensor:
        """Independent draws [*batch_shape, n_members, n].

        Args:
            batch_shape: leading dimensions.
            n_members: E.
            chosen: int64 [..., M], which demonstrations the mixture is of; broadcast to the batch; default: all.
            generator: of the draws.

        Raises:
            ValueError: an index of a demonstration that there is not, or shapes that do not broadcast.
        """
        states, shares = self.states, self.responsibilities
        if chosen is not None:
            check_members(chosen, len(states))
            states, shares = states[chosen], shares[chosen]
        states = states.expand(*batch_shape, *states.shape[-2:])
        count = states.shape[-2]
        totals = shares.sum(-2).clamp(min=torch.finfo(shares.dtype).tiny)  # [..., K], demonstrations a component
        proportions = (totals / totals.sum(-1, keepdim=True)).cumsum(-1)
        size = (*batch_shape, n_members)
        u = uniform(size, states, generator)
        component = (u.unsqueeze(-1) > proportions.unsqueeze(-2)[..., :-1]).sum(-1)  # [..., E]
        within = (shares / totals.unsqueeze(-2)).transpose(-1, -2).expand(*batch_shape, -1, -1)  # [..., K, M]
        share = within.gather(-2, component.unsqueeze(-1).expand(*size, count))  # [..., E, M], rows sum to 1
        # sum_i sqrt(share_i) z_i (w_i - mu) has the component's covariance; one component: divided by N - 1.
        correction = (count / (count - 1)) ** 0.5 if self.responsibilities.shape[1] == 1 else 1.0
        draws = standard_normal(share.shape, states, generator) * share.sqrt() * correction
        combination = share + draws - draws.sum(-1, keepdim=True) * share
        # Rows of the combination sum to 1 but for rounding: what it combines is centred first.
        m = self.moving
        middle = states[..., m:].mean(-2, keepdim=True)
        weights = middle + combination @ (states[..., m:] - middle)
        further = states[..., 1:m]  # the phase itself starts at 0
        deviation = further.std(-2, keepdim=True)
        draws = standard_normal((*size, m - 1), states, generator)
        speeds = further.mean(-2, keepdim=True) + deviation * draws
        return torch.cat([torch.zeros_like(weights[..., :1]), speeds, weights], dim=-1)

    def select(self, view: View) -> MixturePrior:
        """The prior of a view of the model."""
        part = sharing(self)
        part.register_buffer("states", self.states[:, view.state])
        return part


def fit_responsibilities(weights: Tensor, max_components: int, seed: int) -> Tensor:
    """Responsibilities [N, K] of a full-covariance mixture by EM, K by BIC (scikit-learn).

    Nothing is added to the covariances, as nothing is in the paper: with fewer demonstrations than weights they
    are singular and EM fails. What is left then is one component, the sample mean and covariance, which is
    what the authors fell back to as well.

    Args:
        weights: [N, n_weights].
        max_components: largest K to try.
        seed: of the initialisation by k-means.

    Returns:
        [N, K] in the dtype and on the device of the weights.

    Raises:
        ImportError: scikit-learn is not installed; says how to install it.
    """
    as_count("max_components", max_components)
    try:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.mixture import GaussianMixture
    except ImportError as error:
        raise ImportError(
            "the Gaussian mixture of eBIP- needs scikit-learn: pip install 'torch-ebip[methods]'"
        ) from error
    data = weights.detach().cpu().double().numpy()
    spread = data.std(0)
    # EM and BIC do not depend on the units of the weights; how well matrices are factored does.
    data = (data - data.mean(0)) / np.where(spread > 0, spread, 1)
    best: tuple[float, np.ndarray] | None = None
    for count in range(1, min(max_components, len(data)) + 1):
        mixture = GaussianMixture(count, reg_covar=0.0, max_iter=200, random_state=seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            try:
                mixture.fit(data)
            except (ValueError, np.linalg.LinAlgError):
                continue  # a covariance that is not positive definite
        score = float(mixture.bic(data))
        if np.isfinite(score) and _well_conditioned(mixture.covariances_) and (best is None or score < best[0]):
            best = score, mixture.predict_proba(data)
    if best is None:
        warnings.warn(
            f"no mixture of up to {max_components} components has positive definite covariances in "
            f"{weights.shape[1]} dimensions from {len(weights)} demonstrations; "
            "using their sample mean and covariance instead",
            stacklevel=3,
        )
        return torch.ones_like(weights[:, :1])
    return torch.as_tensor(best[1]).to(weights)


def _well_conditioned(covariances: np.ndarray) -> bool:
    """Whether matrices [K, n, n] are positive definite beyond rounding."""
    eigenvalues = np.linalg.eigvalsh(covariances)
    limit = covariances.shape[-1] * np.finfo(np.float64).eps
    return bool((eigenvalues[:, 0] > limit * eigenvalues[:, -1]).all())
